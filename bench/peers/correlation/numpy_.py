"""NumPy: a few pixels at a time, which stay in the cache; single precision, in place."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.peers.correlation.peer import Doubles, Peer, Wave
from mirrorskin.engine.rotation.design_matrix import basis, fit_matrix

_SAMPLES = 65_536  # of a tile: more leave the cache, and BLAS would send its small products to threads
_PIXELS = 16_384  # of a tile of one frame


def correlate(frames: NDArray[Any], phase: Doubles) -> Wave:
    """See `Peer`."""
    maps = Wave.empty(frames.shape[1:])
    raw, flat = frames.reshape(len(frames), -1), maps.flat()
    size = _SAMPLES // len(frames)
    room = np.empty((len(frames), size), np.float32)
    fit, model = fit_matrix(phase).astype(np.float32), basis(phase)
    gram = (model.T @ model).astype(np.float32)
    for first in range(0, raw.shape[1], size):
        pixels = slice(first, first + size)
        reference = raw[0, pixels].astype(np.float32)
        # Small numbers, of whose squares no digit is lost.
        x = np.subtract(raw[:, pixels], reference, out=room[:, : len(reference)])
        wave = fit @ x
        left = np.einsum("kp,kp->p", x, x) - np.einsum("kp,kp->p", wave, gram @ wave)
        np.add(wave[0], reference, out=flat.mean[pixels])
        flat.cosine[pixels], flat.sine[pixels] = wave[1:]
        np.sqrt(np.maximum(left, 0) / np.float32(len(frames) - 3), out=flat.residual[pixels])
    return maps


def slide(sums: NDArray[np.int32], now: NDArray[Any], gone: NDArray[Any], basis: NDArray[np.int32]) -> None:
    """See `Peer`."""
    flat, new, old = sums.reshape(4, -1), now.reshape(-1), gone.reshape(-1)
    room = np.empty((3, _PIXELS), np.int32)
    for first in range(0, len(new), _PIXELS):
        pixels = slice(first, first + _PIXELS)
        come, go, spare = room[:, : len(new[pixels])]
        np.copyto(come, new[pixels])
        np.copyto(go, old[pixels])
        for total, more, less in zip(flat[:3, pixels], basis[:3], basis[3:], strict=True):
            np.add(total, np.multiply(come, more, out=spare), out=total)
            np.subtract(total, np.multiply(go, less, out=spare), out=total)
        np.add(flat[3, pixels], np.multiply(come, come, out=come), out=flat[3, pixels])
        np.subtract(flat[3, pixels], np.multiply(go, go, out=go), out=flat[3, pixels])


PEER = Peer("NumPy", correlate, slide)
