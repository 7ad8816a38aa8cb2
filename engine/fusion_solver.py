"""A surface from absolute heights and slopes, each as sure as it is."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from mirrorskin.engine.integration.integration import integrate
from mirrorskin.engine.integration.surface import Surface
from mirrorskin.engine.integration.validation import check_pixel_size
from mirrorskin.engine.press.holes import fill_holes
from mirrorskin.engine.press.intervals import find_spread, find_trend, look_inside
from mirrorskin.engine.rotation.normals_to_height import Slopes
from mirrorskin.io import InputError
from mirrorskin.kernels.device import Device

Doubles = NDArray[np.float64]
Mask = NDArray[np.bool_]

_EVEN = np.sqrt(3.0)  # half the width of what is spread evenly, in its standard deviations
_SHARPEST = 1e-5  # mm: no height is known better than this
_NARROWEST, _WIDEST = 2.0, 8.0  # standard deviation of a window that slopes are taken from, pixels
_NEAR = 3.0  # such windows, beyond which pixels are too far from any normal
_LEVEL = 0.05  # slope below which a surface has no terraces to speak of
_FIRM = 30.0  # how many times a height with normals around is as sure as one of the press
_OFF = 4.0  # standard deviations from those around, beyond which a height is a mistake
_ROUGH = 3.0  # mean squared error in standard deviations of what is no smooth surface
_CLAIM = 2.0  # how many times less sure than they claim heights may be, and still be believed
_SEVERAL = 6.0  # half intervals that heights go over, for their errors to be spread evenly
_NEARLY_ALL = 0.9  # of all heights, by which it is told how much of their intervals errors use
_LEAST_USED = 0.5
_LOOKS = 5  # at where the intervals lift a surface


@dataclass(frozen=True, slots=True)
class Known:
    """Heights of a press.

    Attributes
    ----------
    height, sigma : ndarray, (H, W), float64
        Millimetres, and their standard deviations; NaN where unknown.
    """

    height: Doubles
    sigma: Doubles

    @classmethod
    def of(cls, height: NDArray[np.floating], sigma: NDArray[np.floating], mask: Mask | bool = True) -> Self:
        """Take those of a map that are numbers, where they are wanted."""
        height, sigma = np.asarray(height, np.float64), np.asarray(sigma, np.float64)
        known = mask & np.isfinite(height) & (sigma >= 0) & (sigma < np.inf)
        # Where few claim to be far more sure than the others, they are mostly those whose light rose oddly.
        least = max(float(np.median(sigma[known])), _SHARPEST) if known.any() else _SHARPEST
        return cls(np.where(known, height, np.nan), np.where(known, np.maximum(sigma, least), np.nan))

    @property
    def there(self) -> Mask:
        """Where heights are known, (H, W)."""
        return np.isfinite(self.height)


class Joint:
    """Heights and slopes on their way to become one surface.

    Parameters
    ----------
    known : Known
    slopes : Slopes
        On the same pixels.
    pixel_size : float or (float, float)
        Millimetres along x and y.
    robust : bool
        Whether the surface may break, at discontinuities that are found in it.
    device : Device

    Raises
    ------
    mirrorskin.io.InputError
        There is neither a height nor a slope, or the pixel size cannot be.
    mirrorskin.engine.NotConverged
        A surface was not found.
    """

    def __init__(
        self, known: Known, slopes: Slopes, pixel_size: ArrayLike, robust: bool, device: Device
    ) -> None:
        if not (slopes.known | known.there).any():
            raise InputError("there is nothing to fuse: no pixel has a height or a normal")
        self._slopes, self._pixel_size = slopes, check_pixel_size(pixel_size)
        self._robust, self._device = robust, device
        plain = known.height, np.nan_to_num(1 / known.sigma**2)
        first = self._solve(*plain, sigma=False)
        known = _doubt(known, first, slopes)
        plain = known.height, np.nan_to_num(1 / known.sigma**2)
        longer = _extend(slopes, first, known, self._pixel_size)
        if longer is not slopes:
            self._slopes = longer
            first = self._solve(*plain, initial_heights=first.height, sigma=False)
        self._start = first.height
        self._height, self._weight = _sharpen(first, known, slopes)

    def heights(self) -> NDArray[np.float32]:
        """Return the heights alone, which is faster."""
        self._start = self._solve(self._height, self._weight, initial_heights=self._start, sigma=False).height
        return self._start

    def finish(self) -> Surface:
        """Return the whole surface, its holes filled."""
        surface = self._solve(self._height, self._weight, initial_heights=self._start)
        return _join(_fill(_tell_lone(surface, self._weight), self._pixel_size))

    def _solve(self, height: Doubles, weight: Doubles, **options: Any) -> Surface:
        return integrate(
            self._slopes.dz_dx,
            self._slopes.dz_dy,
            self._pixel_size,
            mask=self._slopes.known | (weight > 0),
            slope_weights=self._slopes.weights,
            known_heights=np.where(weight > 0, height, np.nan),
            known_height_weights=weight,
            robust=self._robust,
            device=self._device,
            **options,
        )


def _doubt(known: Known, surface: Surface, slopes: Slopes) -> Known:
    """Return heights as unsure as they are, where slopes tell that most claim to be much more sure."""
    both = known.there & slopes.known
    if not both.any():
        return known
    off = known.height[both] - surface.height[both]
    usual = float(np.median(np.abs(off - np.median(off)))) * 2 / _EVEN  # half are beyond half of an interval
    if usual < _CLAIM * float(np.median(known.sigma[both])):
        return known
    return Known(known.height, np.maximum(known.sigma, usual))


def _extend(slopes: Slopes, surface: Surface, known: Known, pixel_size: tuple[float, float]) -> Slopes:
    """Give pixels with a height but no normal, near those with one, the slopes of the heights around.

    The window spans a terrace or more. Neighbours share what they tell, so each slope counts only for its
    part of a window. Where heights do not fit a smooth surface, there are no slopes.
    """
    gaps = known.there & ~slopes.known
    if not gaps.any() or not slopes.known.any():
        return slopes
    sigma = float(np.median(known.sigma[known.there]))
    width = _window(slopes, sigma, min(pixel_size))
    reach = ndimage.uniform_filter(
        slopes.known.astype(np.float32), 2 * int(_NEAR * width) + 1, mode="constant"
    )
    gaps &= reach > 0
    weight = np.where(slopes.known, (_FIRM / sigma) ** 2, np.where(gaps, 1 / known.sigma**2, 0.0))
    height = surface.height.astype(np.float64)
    trend = find_trend(height, weight, gaps, width)
    off = np.abs(height[gaps] - trend.height) > _OFF * known.sigma[gaps]
    if off.any():  # mistakes do not tell a second time
        weight[gaps] = np.where(off, 0.0, weight[gaps])
        trend = find_trend(height, weight, gaps, width)
    smooth = trend.misfit < _ROUGH
    gaps[gaps] = smooth
    along = trend.along[:, smooth] / np.array([[pixel_size[0]], [-pixel_size[1]]])
    variance = trend.variance[:, smooth] * trend.pixels[smooth] / np.square(pixel_size)[:, np.newaxis]
    dz_dx, dz_dy, weights = slopes.dz_dx.copy(), slopes.dz_dy.copy(), slopes.weights.copy()
    dz_dx[gaps], dz_dy[gaps] = along
    weights[:, gaps] = 1 / variance
    return Slopes(dz_dx, dz_dy, weights)


def _window(slopes: Slopes, sigma: float, pixel: float) -> float:
    """Return the width of windows, in pixels, that span the terraces where slopes are as usual."""
    steepness = np.hypot(slopes.dz_dx[slopes.known], slopes.dz_dy[slopes.known])
    terrace = 2 * _EVEN * sigma / (pixel * max(float(np.median(steepness)), _LEVEL))
    return float(np.clip(terrace, _NARROWEST, _WIDEST))


def _sharpen(surface: Surface, known: Known, slopes: Slopes) -> tuple[Doubles, Doubles]:
    """Return known heights and their weights, by what their intervals say where the surface is about known.

    Heights far from it are mistakes, and get no weight. Nor do those without a normal of their own, which are
    at rims and often late, in a piece that has others. A piece of which no height is near an end of its
    interval lies on one terrace: then all of its heights together say no more than one.
    """
    size = np.bincount(surface.component[surface.component >= 0], minlength=len(surface.offset_unknown))
    joined = known.there & (size[surface.component] > 1)
    both = joined & slopes.known
    told = np.bincount(surface.component[both], minlength=size.size) > 0
    joined &= slopes.known | ~told[surface.component]
    height, weight = known.height.copy(), np.nan_to_num(1 / known.sigma**2)
    if not joined.any():
        return height, weight
    piece, half = surface.component[joined], _EVEN * known.sigma[joined]
    middle, shape = known.height[joined], surface.height[joined].astype(np.float64)
    # The mean that a solver finds is moved by mistakes, the median is not.
    lift = np.asarray(ndimage.median(middle - shape, piece, np.arange(size.size)))
    half *= _share_used(middle - shape - lift[piece], half, shape)
    for _ in range(_LOOKS):
        at = shape + lift[piece]
        spread = find_spread(middle - at, half)
        inside = look_inside(at, middle, half, spread)
        firm = np.bincount(piece, inside.weight, size.size)
        lift += np.bincount(piece, inside.weight * (inside.height - at), size.size) / np.where(firm, firm, 1)
    weight = np.nan_to_num(1 / (known.sigma**2 + spread.blur**2))
    weight[told[surface.component] & ~slopes.known & (surface.component >= 0)] = 0.0
    near = inside.weight > 0
    count = np.maximum(np.bincount(piece, near, size.size), 1)
    plain = np.where(near, weight[joined] / count[piece], 0.0)
    ends = (firm > np.bincount(piece, plain, size.size))[piece]
    height[joined] = np.where(ends, inside.height, middle)
    weight[joined] = np.where(ends, inside.weight, plain)
    return height, weight


def _share_used(error: Doubles, half: Doubles, height: Doubles) -> float:
    """Return which share of their intervals errors make use of, if heights go over several of them.

    Samples that tell more than an interval alone lie nearer to the truth. Ends that no error reaches leave
    a surface free to follow the few that are beyond.
    """
    if np.ptp(height) < _SEVERAL * float(np.median(half)):
        return 1.0
    used = np.quantile(np.abs(error) / half, _NEARLY_ALL) / _NEARLY_ALL
    return float(np.clip(used, _LEAST_USED, 1.0))


def _tell_lone(surface: Surface, weight: Doubles) -> Surface:
    """Put in the standard deviations of single pixels, which are known without drawing any."""
    assert surface.sigma is not None
    size = np.bincount(surface.component[surface.component >= 0], minlength=len(surface.offset_unknown))
    lone = (surface.component >= 0) & (weight > 0) & (size[surface.component] == 1)
    sigma = surface.sigma.copy()
    sigma[lone] = 1 / np.sqrt(weight[lone])
    return replace(surface, sigma=sigma)


def _fill(surface: Surface, pixel_size: ArrayLike) -> Surface:
    """Fill holes from the absolute heights around them; what is relative stays as it is."""
    assert surface.sigma is not None
    absolute = (surface.component >= 0) & ~_relative(surface)
    height, filled = fill_holes(np.where(absolute, surface.height, np.nan), surface.sigma, pixel_size)
    filled = np.where(surface.component < 0, filled, 0).astype(np.uint8)
    return replace(surface, height=np.where(filled, height, surface.height), filled=filled)


def _relative(surface: Surface) -> Mask:
    """Return where heights are relative: pixels of pieces without a known one."""
    return np.asarray(np.append(surface.offset_unknown, False)[surface.component])


def _join(surface: Surface) -> Surface:
    """Make one piece of neighbours whose heights are all absolute, though no slope leads across."""
    answered = (surface.component >= 0) | (surface.filled > 0)
    relative = _relative(surface)
    pieces, count = ndimage.label(answered & ~relative)
    names = np.where(relative, count + surface.component, pieces - 1)
    _, first, rank = np.unique(names[answered], return_index=True, return_inverse=True)
    order = np.argsort(np.argsort(first))
    component = np.full(answered.shape, -1, np.int32)
    component[answered] = order[rank]
    offset_unknown = np.zeros(len(first), bool)
    offset_unknown[component[relative]] = True
    return replace(surface, component=component, offset_unknown=offset_unknown)
