"""The few pixels with a clipped or missing sample, or in doubt: the kernels' own reference answers them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.peers.normals.peer import ODD, Normals, Turn
from mirrorskin.kernels.normals import Answer, Limits, Variance, normals_exact


def settle_odd(frames: NDArray[Any], turn: Turn, maps: Normals) -> None:
    """Answer the pixels that a peer marked as odd in its contact map, in place.

    Parameters
    ----------
    frames : ndarray, (N, H, W)
    turn : Turn
    maps : Normals
    """
    pixels = np.flatnonzero(maps.contact == ODD)
    if len(pixels) == 0:
        return
    found = answer(frames, turn, pixels)
    flat = maps.flat()
    flat.vectors[pixels], flat.sigma[pixels] = found.vectors, found.sigma
    flat.contact[pixels], flat.mean[pixels] = found.contact, found.mean


def answer(frames: NDArray[Any], turn: Turn, pixels: NDArray[np.intp], slack: float = 1.0) -> Answer:
    """Answer some pixels of a stack, told by their numbers; limits of contact are wider by a factor."""
    phase = turn.phase
    table = np.stack([np.cos(phase), np.sin(phase), np.ones_like(phase), *turn.fit])
    scale = np.array([turn.offset, 1 / turn.gain, -np.inf, np.inf])
    noise, model, still, wild, rest = turn.limits
    limits = Limits(slack * noise, slack * model, still / slack, slack * wild, rest / slack)
    samples = frames.reshape(len(frames), -1)[:, pixels]
    variance = Variance(turn.noise**2, 0.0, 0.0)
    return normals_exact(samples, table, scale, turn.tilt, variance, limits)
