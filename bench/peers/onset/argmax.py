"""NumPy as one writes it first: compare the whole stack, and ask for the first true."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.peers.onset.peer import Levels, Peer
from mirrorskin.bench.peers.onset.suspects import settle_suspects


def first_light(frames: NDArray[Any], light: Levels, hold: int) -> NDArray[np.int32]:
    """See `Peer`."""
    is_light = frames >= light
    if hold == 2:
        is_light[:-1] &= is_light[1:]
    onset = np.where(is_light.any(axis=0), is_light.argmax(axis=0), -1).astype(np.int32)
    if frames.dtype.kind == "f":
        settle_suspects(frames, light, hold, ~np.isfinite(frames).all(axis=0), onset)
    return onset


PEER = Peer("NumPy argmax", first_light, whole_stack=True)
