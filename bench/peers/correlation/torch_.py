"""PyTorch on the host: large tiles of pixels; each operation on all cores, in place, in single precision."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mirrorskin.bench.peers import THREADS
from mirrorskin.bench.peers.correlation.peer import Doubles, Peer, Wave
from mirrorskin.engine.rotation.design_matrix import basis, fit_matrix

_SAMPLES = 2_097_152  # of a tile: smaller ones pay for calls, larger ones leave the cache

torch.set_num_threads(THREADS)


def correlate(frames: NDArray[Any], phase: Doubles) -> Wave:
    """See `Peer`."""
    maps = Wave.empty(frames.shape[1:])
    raw = torch.from_numpy(frames.reshape(len(frames), -1))
    flat = [torch.from_numpy(values) for values in maps.flat()]
    size = _SAMPLES // len(frames)
    room = torch.empty(len(frames), min(size, raw.shape[1]))
    fit, model = torch.from_numpy(fit_matrix(phase)).float(), basis(phase)
    gram = torch.from_numpy(model.T @ model).float()
    for first in range(0, raw.shape[1], size):
        pixels = slice(first, first + size)
        part = raw[:, pixels]
        # Small numbers, of whose squares no digit is lost.
        x = room[:, : part.shape[1]].copy_(part)
        reference = x[0].clone()
        wave = fit @ x.sub_(reference)
        left = x.square_().sum(0).sub_((gram @ wave).mul_(wave).sum(0)).clamp_(min=0)
        torch.add(wave[0], reference, out=flat[0][pixels])
        for values, found in zip(flat[1:3], wave[1:], strict=True):
            values[pixels] = found
        torch.sqrt(left.div_(len(frames) - 3), out=flat[3][pixels])
    return maps


def slide(sums: NDArray[np.int32], now: NDArray[Any], gone: NDArray[Any], basis: NDArray[np.int32]) -> None:
    """See `Peer`."""
    come, go = (torch.from_numpy(frame).int() for frame in (now, gone))
    *totals, square = torch.from_numpy(sums)
    for total, more, less in zip(totals, basis[:3].tolist(), basis[3:].tolist(), strict=True):
        total.add_(come, alpha=more).sub_(go, alpha=less)
    square.addcmul_(come, come).addcmul_(go, go, value=-1)


PEER = Peer("PyTorch", correlate, slide)
