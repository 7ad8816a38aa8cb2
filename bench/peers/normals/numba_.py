"""Numba: tiles of pixels on all cores, each frame by frame so that the inner loops become vector code.

All that is known of a tile's pixels lies in one array, at distances that are known to the compiler: of many
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
from mirrorskin.bench.peers.normals.odd import settle_odd
from mirrorskin.bench.peers.normals.peer import (
    ARCSINE,
    LEAST,
    LEVEL,
    LOOKS,
    NO_ANSWER,
    ODD,
    REACH,
    Normals,
    Peer,
    Turn,
)

_TILE = 256  # pixels

numba.set_num_threads(min(THREADS, numba.config.NUMBA_NUM_THREADS))

_C1, _C2, _C3, _C4, _C5, _C6 = (np.float32((-1) ** k / math.factorial(2 * k)) for k in range(1, 7))
_S1, _S2, _S3, _S4, _S5, _S6 = (np.float32((-1) ** k / math.factorial(2 * k + 1)) for k in range(1, 7))
_A7, _A5, _A3 = ARCSINE
_ZERO, _ONE, _THREE, _NAN, _FAR = (np.float32(number) for number in (0, 1, 3, np.nan, REACH**2))
# Where in the array what is: the mean; the direction; its normal equations; cosines, and behind them sines.
_MEAN, _ODD, _SIGMA, _CONTACT, _X, _Y, _Z, _CT, _ST, _CP, _SP = (_TILE * k for k in range(11))
_M11, _M12, _B1, _B2, _M13, _M23, _M33, _B3, _SQUARE, _ROOM = (_TILE * k for k in range(11, 21))


def normals(frames: NDArray[Any], turn: Turn) -> Normals:
    """See `Peer`."""
    maps = Normals.empty(frames.shape[1:])
    fit = np.asarray(turn.fit, np.float32)
    phase = np.stack([np.cos(turn.phase), np.sin(turn.phase)]).astype(np.float32)
    numbers = turn.offset, 1 / turn.gain, np.cos(turn.tilt), np.sin(turn.tilt), turn.low, turn.high
    known = tuple(np.float32(number) for number in numbers)
    ends = turn.tilt, turn.error, turn.most, turn.still, turn.wild, turn.rest
    limits = tuple(np.float32(number) for number in ends)
    _normals()(frames.reshape(len(frames), -1), fit, phase, known, limits, *maps.flat())
    settle_odd(frames, turn, maps)
    return maps


@functools.cache
def _normals() -> Any:
    options = {"fastmath": {"contract"}, "error_model": "numpy"}
    parts = _take_in, _aim, _step, _judge, _put
    take_in, aim, step, judge, put = (numba.njit(part, **options) for part in parts)
    look, look_last = (numba.njit(_make_look(last), **options) for last in (False, True))

    def run(frames, fit, phase, known, limits, vectors, sigma, contact, mean):  # type: ignore[no-untyped-def]
        for tile in numba.prange(-(-len(sigma) // _TILE)):
            first, end = tile * _TILE, min(len(sigma), (tile + 1) * _TILE)
            work, trig = np.zeros(_ROOM, np.float32), np.empty((2, len(frames), _TILE), np.float32)
            count, pixels = len(frames), end - first
            take_in(frames, first, end, fit, known, trig, work)
            aim(pixels, work)
            for _ in range(LOOKS - 1):
                look(pixels, phase, known, trig, work)
                step(pixels, count, work)
                aim(pixels, work)
            look_last(pixels, phase, known, trig, work)
            judge(pixels, count, known, limits, work)
            step(pixels, count, work)
            put(first, end, work, vectors, sigma, contact, mean)

    return numba.njit(parallel=True, **options)(run)


def _take_in(frames, first, end, fit, known, trig, work):  # type: ignore[no-untyped-def]
    """Find cosine and sine of the zenith that each sample tells, their wave, and the mean of the samples."""
    offset, per_count, upright, lean, low, high = known
    slope = -upright / lean
    for k in range(len(frames)):
        # Cut from a whole row: of a part of all rows, Numba does not know that samples lie side by side.
        raw, level, along, across = frames[k, first:end], fit[0, k], slope * fit[1, k], slope * fit[2, k]
        cosines, sines = trig[0, k], trig[1, k]
        for p in range(end - first):
            count = np.float32(raw[p])
            t = (count - offset) * per_count
            y = t * t
            cosine = _ONE + y * (_C1 + y * (_C2 + y * (_C3 + y * (_C4 + y * (_C5 + y * _C6)))))
            sine = _ONE + y * (_S1 + y * (_S2 + y * (_S3 + y * (_S4 + y * (_S5 + y * _S6)))))
            cosines[p], sines[p] = cosine, t * sine
            work[_MEAN + p] += level * count
            work[_X + p] += along * cosine
            work[_Y + p] += across * cosine
            work[_Z + p] += level * cosine
            work[_ODD + p] += _ZERO if (count > low) & (count < high) else _ONE


def _aim(pixels, work):  # type: ignore[no-untyped-def]
    """Find cosines and sines of zenith and azimuth of a vector, and forget the sums."""
    for p in range(pixels):
        x, y, z = work[_X + p], work[_Y + p], work[_Z + p]
        flat = x * x + y * y
        level = flat < LEVEL
        across, scale = _ONE / math.sqrt(_ONE if level else flat), _ONE / math.sqrt(flat + z * z)
        work[_CT + p], work[_ST + p] = z * scale, flat * across * scale
        work[_CP + p], work[_SP + p] = _ONE if level else x * across, _ZERO if level else y * across
    for p in range(_M11, _ROOM):
        work[p] = _ZERO


def _make_look(last: bool) -> Any:
    """Make what compares the samples with a direction; `last`: with the tilt left free as well."""

    def look(pixels, phase, known, trig, work):  # type: ignore[no-untyped-def]
        upright, lean = known[2], known[3]
        for k in range(phase.shape[1]):
            ca, sa = phase[0, k], phase[1, k]
            cosines, sines = trig[0, k], trig[1, k]
            for p in range(pixels):
                ct, st, cp, sp = work[_CT + p], work[_ST + p], work[_CP + p], work[_SP + p]
                near, beside = cp * ca + sp * sa, cp * sa - sp * ca
                by_along, by_across = st * upright + ct * lean * near, lean * beside
                cosine, square = ct * upright - st * lean * near, by_along * by_along + by_across * by_across
                square = square if square > LEAST else LEAST
                inverse = _ONE / math.sqrt(square)
                # The sine of how much more the sample tells than it should.
                x = sines[p] * cosine - cosines[p] * square * inverse
                y = x * x
                error = x + x * y * (_A3 + y * (_A5 + y * _A7))
                u1, u2 = by_along * inverse, by_across * inverse
                work[_M11 + p] += u1 * u1
                work[_M12 + p] += u1 * u2
                work[_B1 + p] += u1 * error
                work[_B2 + p] += u2 * error
                if last:
                    u3 = (ct * lean + st * upright * near) * inverse
                    work[_M13 + p] += u1 * u3
                    work[_M23 + p] += u2 * u3
                    work[_M33 + p] += u3 * u3
                    work[_B3 + p] += u3 * error
                    work[_SQUARE + p] += error * error

    return look


def _step(pixels, count, work):  # type: ignore[no-untyped-def]
    """Move to where the normal equations lead, but not too far."""
    all_ = np.float32(count)
    for p in range(pixels):
        m11, m12, b1, b2 = work[_M11 + p], work[_M12 + p], work[_B1 + p], work[_B2 + p]
        m22 = all_ - m11
        scale = _ONE / (m11 * m22 - m12 * m12)
        along, across = (m22 * b1 - m12 * b2) * scale, (m11 * b2 - m12 * b1) * scale
        length = along * along + across * across
        shorter = _FAR / (length if length > _FAR else _FAR)
        along, across = along * shorter, across * shorter
        ct, st, cp, sp = work[_CT + p], work[_ST + p], work[_CP + p], work[_SP + p]
        out = st + along * ct
        work[_X + p], work[_Y + p] = out * cp - across * sp, out * sp + across * cp
        work[_Z + p] = ct - along * st


def _judge(pixels, count, known, limits, work):  # type: ignore[no-untyped-def]
    """Find sigma, and whether noise is what is left once direction and tilt are free."""
    offset, per_count = known[0], known[1]
    tilt, error, most, still, wild, rest = limits
    all_ = np.float32(count)
    for p in range(pixels):
        m11, m12, b1, b2 = work[_M11 + p], work[_M12 + p], work[_B1 + p], work[_B2 + p]
        m13, m23, m22 = work[_M13 + p], work[_M23 + p], all_ - m11
        scale = _ONE / (m11 * m22 - m12 * m12)
        d1, d2 = (m22 * b1 - m12 * b2) * scale, (m11 * b2 - m12 * b1) * scale
        w1, w2 = (m22 * m13 - m12 * m23) * scale, (m11 * m23 - m12 * m13) * scale
        told = work[_M33 + p] - m13 * w1 - m23 * w2
        told = told if told > LEAST else LEAST
        pull = work[_B3 + p] - m13 * d1 - m23 * d2
        more = pull / told
        left = work[_SQUARE + p] - b1 * d1 - b2 * d2 - pull * more
        doubt = _THREE * error / math.sqrt(told)
        follows = (tilt + more + doubt >= still) & (tilt + more - doubt <= wild)
        raised = (work[_MEAN + p] - offset) * per_count >= rest
        work[_CONTACT + p] = _ONE if (left <= most) & follows & raised else _ZERO
        work[_SIGMA + p] = error * math.sqrt(all_ * scale)


def _put(first, end, work, vectors, sigma, contact, mean):  # type: ignore[no-untyped-def]
    """Fill the maps of a tile."""
    for p in range(end - first):
        x, y, z = work[_X + p], work[_Y + p], work[_Z + p]
        scale = _ONE / math.sqrt(x * x + y * y + z * z)
        known = work[_SIGMA + p] < NO_ANSWER
        scale = scale if known else _NAN
        vectors[first + p, 0], vectors[first + p, 1], vectors[first + p, 2] = x * scale, y * scale, z * scale
        sigma[first + p] = work[_SIGMA + p] if known else _NAN
        odd = work[_ODD + p] > _ZERO
        contact[first + p] = ODD if odd else np.uint8(work[_CONTACT + p]) if known else np.uint8(0)
        mean[first + p] = work[_MEAN + p]


PEER = Peer("Numba", normals)
