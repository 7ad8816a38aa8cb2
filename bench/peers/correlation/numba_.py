"""Numba: tiles of pixels on all cores, each frame by frame so that the inner loops become vector code.

What is known of a tile's pixels lies in one array, at distances that are known to the compiler: of many
arrays it would not tell that they do not overlap, and make scalar code.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.peers import THREADS
from mirrorskin.bench.peers.correlation.peer import Doubles, Peer, Wave
from mirrorskin.engine.rotation.design_matrix import basis

_TILE = 1024  # pixels
_SUM, _COSINE, _SINE, _SQUARE, _FIRST, _ROOM = (_TILE * k for k in range(6))
_SIDE = 4  # frames that are added together

numba.set_num_threads(min(THREADS, numba.config.NUMBA_NUM_THREADS))


def correlate(frames: NDArray[Any], phase: Doubles) -> Wave:
    """See `Peer`."""
    maps = Wave.empty(frames.shape[1:])
    model = basis(phase)
    solve = np.linalg.inv(model.T @ model).astype(np.float32)
    _correlate()(frames.reshape(len(frames), -1), model.T.astype(np.float32), solve, *maps.flat())
    return maps


def slide(sums: NDArray[np.int32], now: NDArray[Any], gone: NDArray[Any], basis: NDArray[np.int32]) -> None:
    """See `Peer`."""
    _slide()(sums.reshape(4, -1), now.reshape(-1), gone.reshape(-1), basis)


@functools.cache
def _correlate() -> Any:
    options = {"fastmath": {"contract"}, "error_model": "numpy"}
    add, add_one, put = (numba.njit(part, **options) for part in (_add, _add_one, _put))

    def run(frames, model, solve, mean, cosine, sine, residual):  # type: ignore[no-untyped-def]
        for tile in numba.prange(-(-len(mean) // _TILE)):
            first, end = tile * _TILE, min(len(mean), (tile + 1) * _TILE)
            work = np.zeros(_ROOM, np.float32)
            work[_FIRST : _FIRST + end - first] = frames[0, first:end]
            whole = len(frames) // _SIDE * _SIDE
            for k in range(0, whole, _SIDE):
                add(frames, k, first, end, model, work)
            for k in range(whole, len(frames)):
                add_one(frames[k, first:end], model[:, k], work)
            put(len(frames), first, end, solve, work, mean, cosine, sine, residual)

    return numba.njit(parallel=True, **options)(run)


def _add(frames, k, first, end, model, work):  # type: ignore[no-untyped-def]
    """Add four frames to the sums, less the first sample of each pixel."""
    one, two, three, four = (
        frames[k, first:end],
        frames[k + 1, first:end],
        frames[k + 2, first:end],
        frames[k + 3, first:end],
    )
    c1, c2, c3, c4 = model[1, k], model[1, k + 1], model[1, k + 2], model[1, k + 3]
    s1, s2, s3, s4 = model[2, k], model[2, k + 1], model[2, k + 2], model[2, k + 3]
    for p in range(end - first):
        reference = work[_FIRST + p]
        a, b = np.float32(one[p]) - reference, np.float32(two[p]) - reference
        c, d = np.float32(three[p]) - reference, np.float32(four[p]) - reference
        work[_SUM + p] += a + b + c + d
        work[_COSINE + p] += c1 * a + c2 * b + c3 * c + c4 * d
        work[_SINE + p] += s1 * a + s2 * b + s3 * c + s4 * d
        work[_SQUARE + p] += a * a + b * b + c * c + d * d


def _add_one(frame, model, work):  # type: ignore[no-untyped-def]
    """Add one frame."""
    cosine, sine = model[1], model[2]
    for p in range(len(frame)):
        x = np.float32(frame[p]) - work[_FIRST + p]
        work[_SUM + p] += x
        work[_COSINE + p] += cosine * x
        work[_SINE + p] += sine * x
        work[_SQUARE + p] += x * x


def _put(count, first, end, solve, work, mean, cosine, sine, residual):  # type: ignore[no-untyped-def]
    """Fill the maps of a tile."""
    share = np.float32(1 / (count - 3))
    for p in range(end - first):
        x, y, z = work[_SUM + p], work[_COSINE + p], work[_SINE + p]
        a = solve[0, 0] * x + solve[0, 1] * y + solve[0, 2] * z
        b = solve[1, 0] * x + solve[1, 1] * y + solve[1, 2] * z
        c = solve[2, 0] * x + solve[2, 1] * y + solve[2, 2] * z
        left = work[_SQUARE + p] - a * x - b * y - c * z
        mean[first + p] = work[_FIRST + p] + a
        cosine[first + p], sine[first + p] = b, c
        residual[first + p] = math.sqrt(max(left, np.float32(0)) * share)


@functools.cache
def _slide() -> Any:
    move = numba.njit(_move)

    def run(sums, now, gone, basis):  # type: ignore[no-untyped-def]
        for tile in numba.prange(-(-len(now) // _TILE)):
            first, end = tile * _TILE, min(len(now), (tile + 1) * _TILE)
            rows = sums[0, first:end], sums[1, first:end], sums[2, first:end], sums[3, first:end]
            move(*rows, now[first:end], gone[first:end], basis)

    return numba.njit(parallel=True)(run)


def _move(total, cosine, sine, square, now, gone, basis):  # type: ignore[no-untyped-def]
    """Move a tile's sums on; two at a time, whose overlap the compiler still checks."""
    for p in range(len(now)):
        come, go = np.int32(now[p]), np.int32(gone[p])
        total[p] += np.int32(basis[0] * come - basis[3] * go)
        square[p] += np.int32(come * come - go * go)
    for p in range(len(now)):
        come, go = np.int32(now[p]), np.int32(gone[p])
        cosine[p] += np.int32(basis[1] * come - basis[4] * go)
        sine[p] += np.int32(basis[2] * come - basis[5] * go)


PEER = Peer("Numba", correlate, slide)
