"""Surfaces with heights and slopes by formula, and regions for comparisons.

It shares no code with mirrorskin. All is float64; x and y are in pixels from the picture's centre, y up, and
heights in pixels too: `sample` scales them to a pixel size. So a surface is the same number of pixels large
whatever a pixel is in millimetres.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Map = NDArray[np.float64]
Mask = NDArray[np.bool_]
Place = Callable[[Map, Map], Map]
Slopes = Callable[[Map, Map], tuple[Map, Map]]

STEEP = (300.0, -170.0)  # a plane whose normal is 89.8 degrees from the camera's axis


@dataclass(frozen=True)
class Shape:
    """A surface; `side` numbers the parts between which its depth jumps, see `joined`."""

    height: Place
    slope: Slopes
    side: Callable[[Map, Map], NDArray[np.intp]] | None = None


class Sample(NamedTuple):
    """A surface at the pixels' centres, maps (H, W): heights in mm, slopes, and the number of the side."""

    height: Map
    dz_dx: Map
    dz_dy: Map
    side: NDArray[np.intp]


def places(shape: tuple[int, int]) -> tuple[Map, Map]:
    """Return x and y of the pixels' centres, (H, W)."""
    row, column = np.indices(shape, dtype=float)
    return column - 0.5 * (shape[1] - 1), 0.5 * (shape[0] - 1) - row


def sample(surface: Shape, shape: tuple[int, int], pixel_size: tuple[float, float] = (1.0, 1.0)) -> Sample:
    """Look at a surface with pixels of a size in mm; heights are in units of the pixel's width."""
    across, up = pixel_size
    x, y = places(shape)
    y = y * up / across  # the surface is as long as it is wide, the pixel need not be
    dz_dx, dz_dy = surface.slope(x, y)
    side = np.zeros(shape, np.intp) if surface.side is None else surface.side(x, y)
    return Sample(across * surface.height(x, y), dz_dx + 0 * x, dz_dy + 0 * x, side)


def plane(a: float, b: float) -> Shape:
    """Return z = a x + b y."""
    return Shape(lambda x, y: a * x + b * y, lambda x, y: (a + 0 * x, b + 0 * y))


def quadratic(xx: float, xy: float, yy: float, a: float = 0.0, b: float = 0.0) -> Shape:
    """Return z = xx x^2 + xy x y + yy y^2 + a x + b y; a saddle where xx yy < xy^2 / 4."""
    return Shape(
        lambda x, y: xx * x * x + xy * x * y + yy * y * y + a * x + b * y,
        lambda x, y: (2 * xx * x + xy * y + a, xy * x + 2 * yy * y + b),
    )


def bump(sigma: float, peak: float = 1.0, x0: float = 0.0, y0: float = 0.0) -> Shape:
    """Return a Gaussian of a width and a peak, in pixels."""

    def height(x: Map, y: Map) -> Map:
        return np.asarray(peak * np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / (2 * sigma**2)))

    def slope(x: Map, y: Map) -> tuple[Map, Map]:
        fall = -height(x, y) / sigma**2
        return fall * (x - x0), fall * (y - y0)

    return Shape(height, slope)


def cosines(wavelength: float, amplitude: float, azimuth: float = 0.5) -> Shape:
    """Return waves one across the other, the second 1.7 times as long."""
    cosine, sine = np.cos(azimuth), np.sin(azimuth)
    first, second = 2 * np.pi / wavelength, 2 * np.pi / (1.7 * wavelength)

    def height(x: Map, y: Map) -> Map:
        u, v = x * cosine + y * sine, y * cosine - x * sine
        return np.asarray(amplitude * (np.cos(first * u) + np.cos(second * v)))

    def slope(x: Map, y: Map) -> tuple[Map, Map]:
        u, v = x * cosine + y * sine, y * cosine - x * sine
        along, over = -amplitude * first * np.sin(first * u), -amplitude * second * np.sin(second * v)
        return along * cosine - over * sine, along * sine + over * cosine

    return Shape(height, slope)


def cap(radius: float) -> Shape:
    """Return the upper half of a ball, its apex at 0; NaN beyond the equator."""

    def rise(x: Map, y: Map) -> Map:
        square = radius**2 - x * x - y * y
        return np.sqrt(np.where(square > 0, square, np.nan))

    return Shape(lambda x, y: rise(x, y) - radius, lambda x, y: (-x / rise(x, y), -y / rise(x, y)))


def ball_on_plane(radius: float, lift: float, base: float = 1.0) -> Shape:
    """Return a ball's cap that stands above a level plane: side 1, which jumps to side 0.

    `base` is the cap's radius as a share of the ball's, `lift` the height of its rim above the plane. Of
    the lift, normals tell nothing: it lies on all of the rim.
    """
    ball = cap(radius)
    rim = -radius + radius * np.sqrt(1 - base**2)

    def side(x: Map, y: Map) -> NDArray[np.intp]:
        return (np.hypot(x, y) < 0.9999 * base * radius).astype(np.intp)

    def height(x: Map, y: Map) -> Map:
        return np.where(side(x, y) == 1, ball.height(x, y) - rim + lift, 0.0)

    def slope(x: Map, y: Map) -> tuple[Map, Map]:
        along, up = ball.slope(x, y)
        return np.where(side(x, y) == 1, along, 0.0), np.where(side(x, y) == 1, up, 0.0)

    return Shape(height, slope, side)


def stairs(treads: int, depth: float, rise: float, run: float) -> Shape:
    """Return stairs up along x whose faces are ramps `run` wide: all their depth is in the normals."""
    pitch = depth + run
    steepness = rise / run

    def on(x: Map) -> tuple[Map, Map]:
        place = x + 0.5 * pitch * treads
        number = np.clip(np.floor(place / pitch), 0, treads - 1)
        return number, np.clip(place - number * pitch - depth, 0, run)

    def slope(x: Map, y: Map) -> tuple[Map, Map]:
        _, up = on(x)
        return np.where((up > 0) & (up < run), steepness, 0.0), 0 * y

    def height(x: Map, y: Map) -> Map:
        number, up = on(x)
        return number * rise + steepness * up

    return Shape(height, slope)


def tear(height: float, length: float, steep: float = 0.0) -> Shape:
    """Return a sheet torn along the upper y axis: its right lip rises, over `length`, by `height`.

    Below the origin it is whole, so the normals there tell how far the lips are apart. `steep` tilts it.
    """

    def share(y: Map) -> tuple[Map, Map]:
        along = np.clip(y / length, 0, 1)
        return along * along * (3 - 2 * along), 6 * along * (1 - along) / length

    return Shape(
        lambda x, y: height * share(y)[0] * _fade(x, 0.0, 60.0)[0] * (x > 0) + steep * x,
        lambda x, y: (
            height * share(y)[0] * _fade(x, 0.0, 60.0)[1] * (x > 0) + steep,
            height * share(y)[1] * _fade(x, 0.0, 60.0)[0] * (x > 0),
        ),
        lambda x, y: np.where(y > 0, 1 + (x > 0), 0).astype(np.intp),
    )


def joined(sides: NDArray[np.intp]) -> tuple[Mask, Mask]:
    """Return whether the depth is continuous from each pixel to the next, along x (H, W-1) and y (H-1, W)."""

    def same(here: NDArray[np.intp], other: NDArray[np.intp]) -> Mask:
        return np.asarray((here == other) | (here == 0) | (other == 0))

    if sides.max() < 2:
        return sides[:, :-1] == sides[:, 1:], sides[:-1] == sides[1:]
    return same(sides[:, :-1], sides[:, 1:]), same(sides[:-1], sides[1:])


def _fade(x: Map, start: float, end: float) -> tuple[Map, Map]:
    """Fall smoothly from 1 to 0, and return the slope of it too."""
    along = np.clip((x - start) / (end - start), 0, 1)
    return 1 - along * along * (3 - 2 * along), -6 * along * (1 - along) / (end - start)


def disc(shape: tuple[int, int], fraction: float = 1.0, hole: float = 0.0) -> Mask:
    """Return a disc that fills a share of the picture's smaller side, with a hole of a share of it."""
    x, y = places(shape)
    distance = np.hypot(x, y) / (0.5 * min(shape))
    return np.asarray((distance <= fraction) & (distance >= hole))


def blobs(shape: tuple[int, int], seed: int = 0, waves: int = 5) -> Mask:
    """Return irregular regions, of about half of the picture."""
    generator = np.random.default_rng(seed)
    x, y = (place / max(shape) for place in places(shape))
    total = np.zeros(shape)
    for _ in range(12):
        a, b, phase = generator.uniform(-1, 1, 3) * (waves, waves, np.pi)
        total += np.cos(2 * np.pi * (a * x + b * y) + phase)
    return np.asarray(total > np.median(total))


def two_contacts(shape: tuple[int, int], bridge: bool = False) -> Mask:
    """Return two discs side by side, which a bridge one pixel wide may join."""
    x, y = places(shape)
    apart = 0.25 * shape[1]
    radius = min(0.8 * apart, 0.4 * shape[0])
    mask = (np.hypot(x - apart, y) <= radius) | (np.hypot(x + apart, y) <= radius)
    if bridge:
        mask[shape[0] // 2, int(shape[1] / 2 - apart) : int(shape[1] / 2 + apart)] = True
    return np.asarray(mask)


def holes(shape: tuple[int, int], fraction: float = 0.2, seed: int = 0) -> Mask:
    """Return all but a share of the pixels, missing here and there."""
    return np.random.default_rng([seed, 3]).random(shape) >= fraction


def specks(shape: tuple[int, int], seed: int = 0) -> Mask:
    """Return a disc, and single pixels round it of which no two touch."""
    mask = disc(shape, 0.6)
    spots = np.zeros(shape, bool)
    spots[1::3, 2::4] = np.random.default_rng([seed, 4]).random(spots[1::3, 2::4].shape) < 0.6
    near = mask.copy()
    near[1:] |= mask[:-1]
    near[:-1] |= mask[1:]
    near[:, 1:] |= mask[:, :-1]
    near[:, :-1] |= mask[:, 1:]
    return np.asarray(mask | (spots & ~near))


def comb(shape: tuple[int, int]) -> Mask:
    """Return teeth one pixel wide on a back one pixel wide."""
    mask = np.zeros(shape, bool)
    mask[0], mask[:, ::2] = True, True
    return mask


def spiral(shape: tuple[int, int]) -> Mask:
    """Return a corridor one pixel wide that winds from a corner to the middle."""
    mask = np.zeros(shape, bool)
    row, column, (down, right) = 0, 0, (0, 1)
    mask[0, 0] = True

    def open_ahead(down: int, right: int) -> bool:
        ahead = [(row + step * down, column + step * right) for step in (1, 2)]
        inside = [0 <= r < shape[0] and 0 <= c < shape[1] for r, c in ahead]
        return inside[0] and not mask[ahead[0]] and not (inside[1] and mask[ahead[1]])

    while open_ahead(down, right) or open_ahead(right, -down):
        if not open_ahead(down, right):
            down, right = right, -down
        row, column = row + down, column + right
        mask[row, column] = True
    return mask


def random_cuts(shape: tuple[int, int], count: int = 10, seed: int = 0, length: float = 0.4) -> Mask:
    """Return lines, straight and thin, as pixels that are on a depth discontinuity."""
    generator = np.random.default_rng([seed, 5])
    marked = np.zeros(shape, bool)
    for _ in range(count):
        start, angle = generator.uniform(0, shape), generator.uniform(0, 2 * np.pi)
        along = np.arange(0, length * max(shape) * generator.uniform(0.3, 1), 0.5)
        row = np.rint(start[0] + along * np.sin(angle)).astype(int)
        column = np.rint(start[1] + along * np.cos(angle)).astype(int)
        inside = (row >= 0) & (row < shape[0]) & (column >= 0) & (column < shape[1])
        marked[row[inside], column[inside]] = True
    return marked
