"""NumPy: a few thousand pixels at a time, which stay in the cache; single precision, in place."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.peers.normals.odd import settle_odd
from mirrorskin.bench.peers.normals.peer import (
    ARCSINE,
    LEAST,
    LEVEL,
    LOOKS,
    NO_ANSWER,
    ODD,
    REACH,
    Floats,
    Normals,
    Peer,
    Turn,
    tables,
)

_PIXELS = 4096  # of a tile: more leave the cache, and BLAS would send its small products to threads


def normals(frames: NDArray[Any], turn: Turn) -> Normals:
    """See `Peer`."""
    maps = Normals.empty(frames.shape[1:])
    samples, flat = frames.reshape(len(frames), -1), maps.flat()
    tile = _Tile(turn, frames.dtype, min(_PIXELS, samples.shape[1]))
    with np.errstate(invalid="ignore", divide="ignore"):
        for first in range(0, samples.shape[1], _PIXELS):
            part = samples[:, first : first + _PIXELS]
            if part.shape[1] != tile.pixels:
                tile = _Tile(turn, frames.dtype, part.shape[1])
            tile.answer(part, flat.of(slice(first, first + _PIXELS)))
    settle_odd(frames, turn, maps)
    return maps


class _Sums(NamedTuple):
    """The normal equations of a direction, (P,) each: along the meridian and across."""

    m11: Floats
    m12: Floats
    m22: Floats
    b1: Floats
    b2: Floats

    def solve(self, first: Floats, second: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the solution for a right-hand side, and one over the determinant."""
        scale: Floats = np.reciprocal(self.m11 * self.m22 - self.m12 * self.m12)
        along, across = self.m22 * first - self.m12 * second, self.m11 * second - self.m12 * first
        return along * scale, across * scale, scale


class _Tile:
    """So many pixels at a time, and room for what is computed of each of their samples."""

    def __init__(self, turn: Turn, dtype: np.dtype[Any], pixels: int) -> None:
        shape = len(turn.phase), pixels
        self.pixels = pixels
        self._turn, self._tables = turn, tables(turn, dtype)
        self._fit, self._axes, self._slants = (
            np.asarray(matrix, np.float32) for matrix in (turn.fit, turn.axes, turn.slants)
        )
        self._cos, self._sin, self._error, self._along, self._across, self._spare = (
            np.empty(shape, np.float32) for _ in range(6)
        )
        self._seen = np.empty((shape[0], 3, pixels), np.float32)

    def answer(self, raw: NDArray[Any], out: Normals) -> None:
        """Fill the maps of the pixels whose samples these are."""
        np.copyto(self._spare, raw)
        np.matmul(np.float32(self._fit[0]), self._spare, out=out.mean)
        self._take_in(raw)
        upright, cosine, sine = self._fit @ self._cos
        basis = _basis(-cosine, -sine, upright * np.float32(np.tan(self._turn.tilt)))
        for _ in range(LOOKS):
            last, sums = basis, self._look(basis)
            basis = _step(last, sums)
        out.vectors[:] = basis[:, 2].T
        self._judge(last[:, 2], sums, out)
        self._mark_odd(raw, out.contact)

    def _take_in(self, raw: NDArray[Any]) -> None:
        """Find cosine and sine of the zenith that each sample tells."""
        if self._tables is not None:
            for table, values in zip(self._tables, (self._cos, self._sin), strict=True):
                table.take(raw, out=values, mode="clip")
            return
        zenith, turn = self._spare, self._turn
        np.multiply(zenith, np.float32(1 / turn.gain), out=zenith)
        np.subtract(zenith, np.float32(turn.offset / turn.gain), out=zenith)
        np.cos(zenith, out=self._cos)
        np.sin(zenith, out=self._sin)

    def _look(self, basis: Floats) -> _Sums:
        """Compare the samples with a direction, given with its tangents along and across."""
        along, across, error, sine = self._along, self._across, self._error, self._spare
        np.matmul(self._axes, basis.reshape(3, -1), out=self._seen.reshape(len(self._axes), -1))
        by_along, by_across, cosine = (self._seen[:, k] for k in range(3))
        np.multiply(by_along, by_along, out=sine)
        np.multiply(by_across, by_across, out=error)
        np.add(sine, error, out=sine)
        np.maximum(sine, LEAST, out=sine)
        np.sqrt(sine, out=sine)
        np.divide(by_along, sine, out=along)
        np.divide(by_across, sine, out=across)
        # The sine of how much more the sample tells than it should.
        np.multiply(self._cos, sine, out=by_along)
        np.multiply(self._sin, cosine, out=error)
        np.subtract(error, by_along, out=error)
        _to_arcsine(error, by_along, by_across)
        m11, m12 = _sum(along, along), _sum(along, across)
        return _Sums(m11, m12, len(self._axes) - m11, _sum(along, error), _sum(across, error))

    def _judge(self, normal: Floats, sums: _Sums, out: Normals) -> None:
        """Fill in sigma and contact: whether noise is what is left once direction and tilt are free."""
        turn, by_tilt, error = self._turn, self._spare, self._error
        np.divide(self._slants @ normal, by_tilt, out=by_tilt)  # the sine was left there
        m13, m23, m33 = (_sum(one, by_tilt) for one in (self._along, self._across, by_tilt))
        d1, d2, scale = sums.solve(sums.b1, sums.b2)
        w1, w2, _ = sums.solve(m13, m23)
        told = np.maximum(m33 - m13 * w1 - m23 * w2, LEAST)
        pull = _sum(by_tilt, error) - m13 * d1 - m23 * d2
        more = pull / told
        left = _sum(error, error) - sums.b1 * d1 - sums.b2 * d2 - pull * more
        doubt = 3 * np.float32(turn.error) / np.sqrt(told)
        follows = more + doubt >= np.float32(turn.still - turn.tilt)
        follows &= more - doubt <= np.float32(turn.wild - turn.tilt)
        follows &= (out.mean - np.float32(turn.offset)) * np.float32(1 / turn.gain) >= np.float32(turn.rest)
        np.logical_and(left <= np.float32(turn.most), follows, out=out.contact.view(bool))
        np.multiply(np.sqrt(len(self._axes) * scale), np.float32(turn.error), out=out.sigma)
        known = out.sigma < NO_ANSWER
        if not known.all():
            out.contact[~known], out.sigma[~known], out.vectors[~known] = 0, np.nan, np.nan

    def _mark_odd(self, raw: NDArray[Any], contact: NDArray[np.uint8]) -> None:
        """Leave pixels with a clipped or missing sample to another way."""
        if not (raw.min() > self._turn.low and raw.max() < self._turn.high):
            contact[~((raw > self._turn.low) & (raw < self._turn.high)).all(axis=0)] = ODD


def _basis(x: Floats, y: Floats, z: Floats) -> Floats:
    """Return components of three vectors: the tangents up the meridian and across, and the direction."""
    out = np.empty((3, 3, len(x)), np.float32)
    flat = x * x + y * y
    scale = 1 / np.sqrt(flat + z * z)
    level = flat < LEVEL
    across = 1 / np.sqrt(np.where(level, np.float32(1), flat))
    cosine, sine = np.where(level, np.float32(1), x * across), np.where(level, np.float32(0), y * across)
    rise = np.multiply(z, scale, out=out[2, 2])
    fall = np.multiply(np.sqrt(flat), scale, out=out[2, 0])
    np.multiply(fall, cosine, out=out[0, 2])
    np.multiply(fall, sine, out=out[1, 2])
    np.multiply(-rise, cosine, out=out[0, 0])
    np.multiply(-rise, sine, out=out[1, 0])
    out[0, 1], out[1, 1], out[2, 1] = sine, -cosine, 0
    return out


def _step(basis: Floats, sums: _Sums) -> Floats:
    """Return the direction that the normal equations lead to, by a step that is not too long."""
    along, across, _ = sums.solve(sums.b1, sums.b2)
    far = np.float32(REACH**2)
    shorter = far / np.maximum(along * along + across * across, far)
    x, y, z = basis[:, 2] - basis[:, 0] * (along * shorter) - basis[:, 1] * (across * shorter)
    return _basis(x, y, z)


def _to_arcsine(x: Floats, square: Floats, spare: Floats) -> None:
    """Turn sines of small angles into the angles."""
    np.multiply(x, x, out=square)
    np.multiply(square, ARCSINE[0], out=spare)
    for term in ARCSINE[1:]:
        np.add(spare, term, out=spare)
        np.multiply(spare, square, out=spare)
    np.multiply(spare, x, out=spare)
    np.add(x, spare, out=x)


def _sum(one: Floats, other: Floats) -> Floats:
    found: Floats = np.einsum("kp,kp->p", one, other)
    return found


PEER = Peer("NumPy", normals)
