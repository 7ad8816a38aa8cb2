"""How sure heights are: noise in place of the slopes is sent through the same equations, and squared.

The heights are linear in the slopes' noise, a number of variance 1 a pixel and axis, and their variance is
the sum of the squares of what each number does: one solve each, which nobody can afford. But the numbers may
be turned into others that are just as independent: a few slow waves across the picture, and the rest. What
a wave does lasts all over the picture; it is computed wave by wave, so exactly, and so is what all known
heights of a piece have in common. What the rest does is local.
It is told from draws, whose squares are averaged and then smoothed a little along the links, but not between
pixels with and without a known height.

It costs some 80 loose solves. Exact variances over these, of pictures of 36 x 40 pixels, were 1.00 +- 0.02 in
the mean, and within 1.0 +- 0.1 for all but 2 % of the pixels of a rectangle, 5 % of a disc, 8 % of an annulus
and 9 % of a rectangle with known heights on one side; the others lie along the ends of the surface and of
known heights, where variances change from pixel to pixel. Where a fifth of the pixels are missing at random,
40 % are off by more than a tenth and 11 % by more than a fifth.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import cv2
import numpy as np

from mirrorskin.engine.integration.graph import LEVEL, Labels, LinkRoom, Links, Settler
from mirrorskin.engine.integration.validation import Floats, Inputs
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.links import KNOWN, SLOPE

WAVES, DRAWS = 24, 32
"""Waves of each axis' slopes, and draws of the rest."""
SMOOTHING = 4
"""Steps of the average along links."""
_MOST = 12  # half waves along a side
_SEED = 6
_LEAST = 0.01  # misfit of noise of variance 1 below which nothing contradicts anything

Noise = tuple[Floats, Floats, Floats]


def find_sigma(
    inputs: Inputs,
    room: LinkRoom,
    settler: Settler,
    solve: Callable[[], Array],
    links: Links | None,
    misfit: float | None,
) -> Floats:
    """Return the standard deviation to be expected of heights, (H, W), mm; NaN where there is no answer.

    Parameters
    ----------
    inputs : Inputs
    room : LinkRoom
        With these inputs; what it holds of slopes and known heights is lost.
    settler : Settler
    solve : callable
        Returns heights, loosely, for what ``room`` holds by then.
    links : Links or None
        With weights of their own.
    misfit : float or None
        Of the slopes themselves. Their weights then only tell how noisy one is against another, and how noisy
        all are is told by how much better or worse they fit than noise of variance 1. None where weights are
        inverse variances.
    """
    fields = _Fields(inputs, room, settler.labels)

    def square(noises: Iterator[Noise]) -> tuple[Floats, float]:
        total, misfits = np.zeros(room.shape, np.float32), 0.0
        for noise in noises:
            room.disturb(*noise)
            relief = solve()
            misfits += 0.0 if misfit is None else room.misfit(relief, links=links)
            cv2.accumulateSquare(settler.settle(relief, LEVEL, 0.0), total)
        return total, misfits

    waves, misfits = square(fields.waves())
    rest, more = square(fields.draws())
    variance = waves + room.smooth(rest / np.float32(DRAWS), SMOOTHING)
    unit = misfits + more / DRAWS
    factor = 1.0 if misfit is None else misfit / unit if unit > _LEAST else np.nan
    sigma: Floats = np.sqrt(variance * np.float32(factor))
    return sigma


class _Fields:
    """Noise of variance 1, times the slopes' and the known heights' own standard deviations."""

    def __init__(self, inputs: Inputs, room: LinkRoom, labels: Labels) -> None:
        self._spread_x = _deviation(inputs.weight_x, inputs.weight)
        self._spread_y = (
            self._spread_x if inputs.weight_y is None else _deviation(inputs.weight_y, inputs.weight)
        )
        self._spread_z = _deviation(inputs.height_weights, inputs.height_weight)
        self._shape, self._anchored = room.shape, inputs.heights is not None
        self._none = np.zeros(room.shape, np.float32)
        self._known = (room.flags.host & KNOWN) != 0
        self._piece = labels[self._known]
        self._common = self._none if self._piece.size == 0 else self._find_common(inputs)
        places = [np.flatnonzero((room.flags.host & SLOPE).any(axis=axis)) for axis in (1, 0)]
        self._box = tuple(slice(at[0], at[-1] + 1) if at.size else slice(0, 1) for at in places)
        lengths = [part.stop - part.start for part in self._box]
        self._down, self._across = (_cosines(length) for length in lengths)
        size = [length * pixel for length, pixel in zip(lengths, inputs.pixel_size[::-1], strict=True)]
        pairs = [(i, j) for i in range(len(self._down)) for j in range(len(self._across))]
        self._pairs = sorted(pairs, key=lambda pair: (pair[0] / size[0]) ** 2 + (pair[1] / size[1]) ** 2)[
            :WAVES
        ]

    def _find_common(self, inputs: Inputs) -> Floats:
        """Return what all known heights of a piece have in common, of norm 1 in each."""
        weights = np.ones(self._shape) if inputs.height_weights is None else inputs.height_weights
        firm = weights[self._known].astype(np.float64)
        common = self._none.copy()
        common[self._known] = np.sqrt(firm / np.bincount(self._piece, firm)[self._piece])
        return common

    def waves(self) -> Iterator[Noise]:
        """Yield each wave of the slopes, along x and y, and what known heights have in common."""
        if self._piece.size:
            yield self._none, self._none, self._common * self._spread_z
        for i, j in self._pairs:
            wave = self._none.copy()
            wave[self._box] = np.outer(self._down[i], self._across[j])
            yield wave * self._spread_x, self._none, self._none
            yield self._none, wave * self._spread_y, self._none

    def draws(self) -> Iterator[Noise]:
        """Yield noise without waves; the same each time."""
        generator = np.random.default_rng(_SEED)
        for _ in range(DRAWS):
            x, y = self._signs(generator), self._signs(generator)
            self._still(x)
            self._still(y)
            z = self._signs(generator) if self._anchored else self._none
            if self._piece.size:
                common = self._common[self._known]
                z[self._known] -= common * np.bincount(self._piece, common * z[self._known])[self._piece]
            yield x * self._spread_x, y * self._spread_y, z * self._spread_z

    def _signs(self, generator: np.random.Generator) -> Floats:
        """Return 1 or -1 for each pixel: of all numbers of variance 1 the ones whose squares vary least."""
        count = self._shape[0] * self._shape[1]
        bits = np.unpackbits(np.frombuffer(generator.bytes(-(-count // 8)), np.uint8), count=count)
        signs = np.multiply(bits.reshape(self._shape), np.float32(2))
        signs -= 1
        return signs

    def _still(self, noise: Floats) -> None:
        """Take the waves out of noise."""
        part = noise[self._box]
        share = self._down @ part @ self._across.T
        kept = np.zeros_like(share)
        rows, columns = np.transpose(self._pairs)
        kept[rows, columns] = share[rows, columns]
        part -= self._down.T @ kept @ self._across


def _deviation(weights: Floats | None, weight: float) -> Floats | np.float32:
    """Return standard deviations; 0 where nothing is known."""
    if weights is None:
        return np.float32(weight**-0.5) if weight else np.float32(0)
    return np.where(weights > 0, 1 / np.sqrt(np.where(weights > 0, weights, 1)), 0).astype(np.float32)


def _cosines(length: int) -> Floats:
    """Return cosine waves over a length, (n, length), of norm 1 and at right angles to each other."""
    wave, place = np.arange(min(length, _MOST))[:, np.newaxis], np.arange(length) + 0.5
    exact = np.cos(np.pi / length * wave * place)
    return np.asarray(exact / np.linalg.norm(exact, axis=1, keepdims=True), np.float32)
