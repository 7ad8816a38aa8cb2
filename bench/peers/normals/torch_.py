"""PyTorch on the host: large tiles of pixels; each operation on all cores, in place, in single precision."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from mirrorskin.bench.peers import THREADS
from mirrorskin.bench.peers.normals.odd import settle_odd
from mirrorskin.bench.peers.normals.peer import (
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

Tensor = Any  # torch.Tensor; the library is not there where types are checked

_PIXELS = 65_536  # of a tile: smaller ones pay for calls, larger ones leave the cache

torch.set_num_threads(THREADS)


def normals(frames: NDArray[Any], turn: Turn) -> Normals:
    """See `Peer`."""
    maps = Normals.empty(frames.shape[1:])
    samples = torch.from_numpy(frames.reshape(len(frames), -1))
    flat = [torch.from_numpy(values) for values in maps.flat()]
    tile = _Tile(turn, min(_PIXELS, samples.shape[1]))
    for first in range(0, samples.shape[1], _PIXELS):
        pixels = slice(first, first + _PIXELS)
        tile.answer(samples[:, pixels], _Maps(*(values[pixels] for values in flat)))
    settle_odd(frames, turn, maps)
    return maps


class _Maps(NamedTuple):
    """As `Normals`."""

    vectors: Tensor
    sigma: Tensor
    contact: Tensor
    mean: Tensor


class _Direction(NamedTuple):
    """Cosine and sine of zenith and azimuth, (P,)."""

    ct: Tensor
    st: Tensor
    cp: Tensor
    sp: Tensor

    @classmethod
    def of(cls, x: Tensor, y: Tensor, z: Tensor) -> _Direction:
        flat = (x * x).addcmul_(y, y)
        scale, level = torch.addcmul(flat, z, z).rsqrt_(), flat < float(LEVEL)
        across = flat.masked_fill(level, 1).rsqrt_()
        cosine, sine = (x * across).masked_fill_(level, 1), (y * across).masked_fill_(level, 0)
        return cls(z * scale, flat.sqrt_().mul_(scale), cosine, sine)


class _Sums(NamedTuple):
    """The normal equations of a direction, (P,): along the meridian and across."""

    m11: Tensor
    m12: Tensor
    m22: Tensor
    b1: Tensor
    b2: Tensor

    def solve(self, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the solution for a right-hand side, and one over the determinant."""
        scale = (self.m11 * self.m22).addcmul_(self.m12, self.m12, value=-1).reciprocal_()
        along = (self.m22 * first).addcmul_(self.m12, second, value=-1).mul_(scale)
        across = (self.m11 * second).addcmul_(self.m12, first, value=-1).mul_(scale)
        return along, across, scale


class _Tile:
    """Room for what is computed of each sample of so many pixels, or of fewer."""

    def __init__(self, turn: Turn, pixels: int) -> None:
        self._turn = turn
        self._fit = torch.from_numpy(turn.fit).float()
        self._phase = torch.from_numpy(np.stack([np.cos(turn.phase), np.sin(turn.phase)])).float()
        self._upright, self._lean = np.cos(turn.tilt), np.sin(turn.tilt)
        self._room = torch.empty(8, len(turn.phase), pixels)

    def answer(self, raw: Tensor, out: _Maps) -> None:
        """Fill the maps of the pixels whose samples these are."""
        turn, room = self._turn, self._room[:, :, : raw.shape[1]]
        counts, cosines, sines = room[:3]
        counts.copy_(raw)
        torch.sum(torch.mul(counts, self._fit[0][:, None], out=sines), 0, out=out.mean)
        low, high = counts.aminmax()
        odd = (
            None
            if low > turn.low and high < turn.high
            else ~((counts > turn.low) & (counts < turn.high)).all(0)
        )
        zenith = counts.sub_(turn.offset).mul_(1 / turn.gain)
        torch.cos(zenith, out=cosines)
        torch.sin(zenith, out=sines)
        upright, along, across = (torch.mul(cosines, row[:, None], out=zenith).sum(0) for row in self._fit)
        at = _Direction.of(along.neg_(), across.neg_(), upright.mul_(self._lean / self._upright))
        for _ in range(LOOKS):
            last, sums = at, self._look(at, room)
            at = _step(last, sums)
        for k, values in enumerate((at.st * at.cp, at.st * at.sp, at.ct)):
            out.vectors[:, k] = values
        self._judge(last, sums, room, out)
        if odd is not None:
            out.contact.masked_fill_(odd, int(ODD))

    def _look(self, at: _Direction, room: Tensor) -> _Sums:
        """Compare the samples with a direction; leave derivatives, residuals and cosines of what to see."""
        _, cosines, sines, u1, u2, error, near, inverse = room
        ca, sa = self._phase[:, :, None]
        torch.mul(at.cp, ca, out=near).addcmul_(at.sp, sa)
        torch.mul(at.cp, sa, out=u2).addcmul_(at.sp, ca, value=-1).mul_(self._lean)
        torch.mul(near, at.ct * self._lean, out=u1).add_(at.st * self._upright)
        torch.mul(near, at.st * -self._lean, out=error).add_(at.ct * self._upright).mul_(sines)
        square = torch.mul(u1, u1, out=room[0]).addcmul_(u2, u2).clamp_(min=float(LEAST))
        torch.rsqrt(square, out=inverse)
        u1.mul_(inverse)
        u2.mul_(inverse)
        # The sine of how much more the sample tells than it should.
        error.addcmul_(square.mul_(inverse), cosines, value=-1).asin_()
        spare = room[0]
        m11, m12, b1, b2 = (
            torch.mul(one, other, out=spare).sum(0)
            for one, other in ((u1, u1), (u1, u2), (u1, error), (u2, error))
        )
        return _Sums(m11, m12, len(u1) - m11, b1, b2)

    def _judge(self, at: _Direction, sums: _Sums, room: Tensor, out: _Maps) -> None:
        """Fill in sigma and contact: whether noise is what is left once direction and tilt are free."""
        turn = self._turn
        spare, _, _, u1, u2, error, near, inverse = room
        u3 = near.mul_(at.st * self._upright).add_(at.ct * self._lean).mul_(inverse)
        m13, m23, m33, b3, square = (
            torch.mul(one, other, out=spare).sum(0)
            for one, other in ((u1, u3), (u2, u3), (u3, u3), (u3, error), (error, error))
        )
        d1, d2, scale = sums.solve(sums.b1, sums.b2)
        w1, w2, _ = sums.solve(m13, m23)
        told = (m33 - m13 * w1 - m23 * w2).clamp_(min=float(LEAST))
        pull = b3 - m13 * d1 - m23 * d2
        more = pull / told
        left = square - sums.b1 * d1 - sums.b2 * d2 - pull * more
        doubt = told.rsqrt_().mul_(3 * turn.error)
        follows = (more - doubt) <= turn.wild - turn.tilt
        follows &= doubt.add_(more) >= turn.still - turn.tilt
        follows &= (out.mean - turn.offset).mul_(1 / turn.gain) >= turn.rest
        torch.sqrt(scale.mul_(len(u1)), out=out.sigma).mul_(turn.error)
        known = out.sigma < float(NO_ANSWER)
        out.contact.copy_((left <= turn.most).logical_and_(follows).logical_and_(known))
        if not known.all():
            out.sigma.masked_fill_(~known, float("nan"))
            out.vectors[~known] = float("nan")


def _step(at: _Direction, sums: _Sums) -> _Direction:
    """Return the direction that the normal equations lead to, by a step that is not too long."""
    along, across, _ = sums.solve(sums.b1, sums.b2)
    shorter = REACH**2 / (along * along).addcmul_(across, across).clamp_(min=REACH**2)
    along, across = along.mul_(shorter), across.mul_(shorter)
    out = torch.addcmul(at.st, along, at.ct)
    x = (out * at.cp).addcmul_(across, at.sp, value=-1)
    y = (out * at.sp).addcmul_(across, at.cp)
    return _Direction.of(x, y, torch.addcmul(at.ct, along, at.st, value=-1))


PEER = Peer("PyTorch", normals)
