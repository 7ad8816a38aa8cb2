"""PyTorch on the host: large stripes of rows; each operation on all cores, in place and on bytes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from mirrorskin.bench.peers import THREADS
from mirrorskin.bench.peers.onset.peer import Heights, Levels, Peer, References
from mirrorskin.bench.peers.onset.samples import PLATEAU, SURELY
from mirrorskin.bench.peers.onset.suspects import INVALID, settle_suspects

Tensor = Any  # torch.Tensor; the library is not there where types are checked

_COUNTABLE = 255  # frames that a byte counts
_SEARCHED = 1_200_000  # pixels of a stripe at most: smaller ones pay for calls, larger ones leave the cache
_ANSWERED = 200_000  # pixels whose samples are looked at together

torch.set_num_threads(THREADS)


def first_light(frames: NDArray[Any], light: Levels, hold: int) -> NDArray[np.int32]:
    """See `Peer`; uint16 samples must be below 32768, for PyTorch cannot compare larger ones."""
    onset: NDArray[np.int32] = _onset(frames, light, hold).numpy()
    return onset


def heights(frames: NDArray[Any], travel: NDArray[np.float64], known: References, noise: float) -> Heights:
    """See `Peer`; uint16 samples must be below 32768."""
    onset = _onset(frames, known.light, 2).reshape(-1)
    flat = [_signed(values).reshape(-1) for values in known]
    status = torch.ones(len(onset), dtype=torch.uint8)
    status[onset == 0], status[onset == -1] = 3, 2
    status[(onset == INVALID) | flat[0].isnan()] = 0
    height, sigma = (torch.full((len(onset),), float("nan")) for _ in range(2))
    for pixel in (status == 1).nonzero().squeeze(1).split(_ANSWERED):
        level, light, dark = (values[pixel] for values in flat)
        samples = _Samples(_signed(frames).reshape(-1), len(onset), pixel)
        start = onset[pixel].long()
        below = _surely_dark(samples, start, light, level - np.float32(SURELY * noise).item())
        height[pixel], sigma[pixel] = _answer(
            samples, start, below, level.double(), dark.double(), torch.from_numpy(travel), noise
        )
    return Heights(*(values.numpy().reshape(frames.shape[1:]) for values in (height, sigma, status)))


class _Samples(NamedTuple):
    """The samples of some pixels in a stack, of which only a few are needed."""

    stack: Tensor
    size: int
    pixel: Tensor

    def at(self, frame: Tensor) -> Tensor:
        return self.stack.take(frame * self.size + self.pixel)

    def of(self, chosen: Tensor) -> _Samples:
        return self._replace(pixel=self.pixel[chosen])


def _surely_dark(samples: _Samples, start: Tensor, light: Tensor, level: Tensor) -> Tensor:
    """Walk back from each onset to the last frame that was surely dark; the first frame passes for dark."""
    below = start - 1
    todo = torch.arange(len(start))
    while len(todo := todo[below[todo] > 0]):
        sample = samples.of(todo).at(below[todo])
        todo = todo[(sample >= light[todo]) | (sample > level[todo])]
        below[todo] -= 1
    return below


def _answer(
    samples: _Samples, start: Tensor, below: Tensor, level: Tensor, dark: Tensor, travel: Tensor, noise: float
) -> tuple[Tensor, Tensor]:
    """Return height and sigma of pixels with an onset."""
    last = len(travel) - 1
    low, high = samples.at(start - 1).double(), samples.at(start).double()
    after = torch.fmin(samples.at((start + 1).clamp_(max=last)), samples.at((start + 2).clamp_(max=last)))
    begin, end = travel[start - 1], travel[start]
    width, step = end - begin, high - low

    sudden_step = PLATEAU * noise * math.sqrt(2)
    from_dark, to_light = low <= dark + PLATEAU * noise, high >= after - sudden_step
    hovers = (step <= sudden_step) | ((start - 2 - below) * step > 2.5 * sudden_step)
    interval = torch.where(hovers, end - travel[below], width).div_(math.sqrt(12))
    share = (torch.minimum(level, high) - low).div_(step)
    told = torch.hypot(share, 1 - share).mul_(width).mul_(noise).div_(step)

    either, both = from_dark | to_light, from_dark & to_light
    spread = torch.where(either, torch.hypot(told, interval), told)
    height = -(begin + width * torch.where(both, 0.5, share))
    return height.float(), torch.where(both | hovers, interval, spread).float()


def _signed(values: NDArray[Any]) -> Tensor:
    return torch.from_numpy(values.view(np.int16) if values.dtype == np.uint16 else values)


def _onset(frames: NDArray[Any], light: Levels, hold: int) -> Tensor:
    onset = torch.empty(frames.shape[1:], dtype=torch.int32)
    count = -(-frames.shape[1] // -(-frames[0].size // _SEARCHED))
    for row in range(0, frames.shape[1], count):
        rows = slice(row, row + count)
        onset[rows] = _stripe(frames[:, rows], light[rows] if light.ndim else light, hold)
    return onset


def _stripe(frames: NDArray[Any], light: Levels, hold: int) -> Tensor:
    """Count the frames that leave a pixel undecided: that is the number of its onset."""
    stack = _signed(frames)
    shape = stack.shape[1:]
    undecided, few = (fill(shape, dtype=torch.uint8) for fill in (torch.ones, torch.zeros))
    many, sums = torch.zeros(shape, dtype=torch.int32), torch.zeros(shape)
    for number, (frame, dark) in enumerate(zip(stack, _dark(stack, light, hold), strict=True), start=1):
        undecided.bitwise_and_(dark)
        few.add_(undecided)
        if number % _COUNTABLE == 0 or number == len(stack):
            many += few
            few.zero_()
        if frame.is_floating_point():
            sums.add_(frame)
    many.masked_fill_(undecided.bool(), -1)
    if stack.is_floating_point():
        settle_suspects(frames, light, hold, ~sums.isfinite().numpy(), many.numpy())
    return many


def _dark(stack: Tensor, light: Levels, hold: int) -> Iterator[Tensor]:
    """Yield for each frame 1 where no run of `hold` light frames begins, in a mask that is used again."""
    level = _signed(light) if light.ndim else light.item()
    # Into bytes: into booleans, read as bytes after, the same comparison takes four times as long.
    dark, after = (torch.empty(stack.shape[1:], dtype=torch.uint8) for _ in range(2))
    torch.lt(stack[0], level, out=dark)
    for frame in stack[1:]:
        torch.lt(frame, level, out=after)
        if hold == 2:
            dark.bitwise_or_(after)
        yield dark
        dark, after = after, dark
    yield dark


PEER = Peer("PyTorch", first_light, heights)
