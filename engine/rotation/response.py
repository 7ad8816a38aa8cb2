"""Conversion of counts to light under a cylindrical wall: a calibrated response, for each pixel."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.base.provenance import naming
from mirrorskin.engine.diagnosis.registration import Sight
from mirrorskin.io import Calibrated, Header, InputError, Source, WallResponse, pixel_axes
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.rotation.normals_wall import Wall
from mirrorskin.kernels.rotation.response import shade_terms

_SAMPLES = 400  # samples of the curve from which its ends and its inverse are determined
_INVERSE = 8  # coefficients of the inverse, which is only an initial value
_MAX_CURVE = 12  # largest number of coefficients of a curve
_DARK = 0.05  # share of full light: limit of darkness

HALF_WAY = 0.5
"""Initial height of the object above the rest plane, as a share of the press."""


@dataclass(frozen=True, slots=True, eq=False)
class Response:
    """Brightness of each pixel as a function of the normal; replaces a ``Scale``.

    The planes, (5, H, W), are counts without light; light per count; x and y from the wall's axis, and the
    height z of the object above the rest plane in the mean pose, mm. They are NaN where there is no response.
    """

    planes: NDArray[np.float32]
    wall: Wall
    sigma: NDArray[np.float32]  # (H, W): standard error of normals due to the calibration, radians; or NaN
    axis: tuple[float, float]  # position of the wall's axis, mm from the picture's centre
    swing_sigma: float | None  # relative standard error of the swing; None if unknown
    per_pixel = True  # as of `Scale`

    @property
    def sight(self) -> Sight:
        """Inclination of the lines of sight at the RMS distance of pixels from the axis."""
        x, y = self.planes[2:4]
        near, far = self.wall.sight
        return Sight(near + far * float(np.mean(x**2 + y**2)), self.axis)

    @property
    def table(self) -> NDArray[np.float32]:
        """The wall's parameters in the order of the names in ``normals_wall.cl``."""
        wall = self.wall
        radius, rim, scatter = wall.geometry
        low, high = wall.reach
        curve = np.polynomial.Polynomial(wall.curve).convert(
            domain=[low, high], window=[-1, 1], kind=np.polynomial.Polynomial
        )
        numbers = [radius, rim, np.sin(scatter) ** 2, *wall.sight, *(lamp / radius for lamp in wall.lamps)]
        numbers += [low, high, *wall.ends, wall.sense, *wall.pivot, (low + high) / 2, 2 / (high - low)]
        return np.array([*numbers, *wall.inverse, *_padded(curve, len(wall.curve))], np.float32)

    def thinned(self, step: int) -> Doubles:
        """Return the planes of every ``step``-th pixel, (5, n)."""
        return self.planes.reshape(5, -1)[:, ::step].astype(np.float64)

    def clear_pixels(self, wave: Doubles, step: int) -> NDArray[np.bool_]:
        """Return which of every ``step``-th pixel stay within the range of the light over a turn.

        ``wave``, (3, n), is the mean, cosine and sine of the samples, counts.
        """
        offset, per_count = self.thinned(step)[:2]
        mean, amplitude = (wave[0] - offset) * per_count, np.hypot(*wave[1:]) * np.abs(per_count)
        low, high = self.wall.ends
        with np.errstate(invalid="ignore"):
            return np.asarray((mean - amplitude > low) & (mean + amplitude < high))

    def too_level(self, mean: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Return where the surface is so level that it reflects the space above the wall's rim."""
        wall = self.wall
        rim = float(np.polynomial.polynomial.polyval(wall.reach[1], wall.curve))
        with np.errstate(invalid="ignore"):
            return np.asarray((mean - self.planes[0]) * self.planes[1] < max(rim, _DARK) + _DARK)

    def at(self, heights: ArrayLike, follows: bool = False) -> Response:
        """Return the response for other heights of the object, mm above the rest plane in the mean pose.

        ``follows`` is True for registered frames; see ``Registered``.
        """
        planes = self.planes.copy()
        planes[4] = heights
        return replace(self, planes=planes, wall=self.wall._replace(follows=follows))


def wall_response_of(source: Source) -> WallResponse | None:
    """Return the response in the calibration of a source, or None unless it is graded.

    Normals are computed with one half-angle d of the precession. If it is elliptic with ellipticity e and its
    greatest half-angle at azimuth m, the half-angle at azimuth a is d (1 + e cos 2(a - m)). Apart from the
    third harmonic, this changes the signal of a surface that faces p by d e/2 cos(a - 2m + p), like an error
    e/2 sin 2(p - m) of p. Its RMS, e / (2 sqrt 2), is added to the azimuth's error, at a zenith in mid range.
    """
    calibration = source.calibration if isinstance(source, Calibrated) else None
    if calibration is None or calibration.zenith is None or calibration.zenith.pattern != "graded":
        return None
    wall, precession = calibration.zenith, calibration.precession
    error = 0.0 if precession is None else abs(precession.ellipticity) / math.sqrt(8)
    if not error > 0:
        return wall
    zenith = math.pi / 4 - math.atan(sum(wall.reach) / 2)
    sigma = np.hypot(wall.azimuth_sigma, np.float32(error * math.sin(zenith)))
    return replace(wall, azimuth_sigma=sigma)


def initial_response(wall: WallResponse, source: Source, header: Header) -> Response:
    """Return the response for a source's pixels, with the object at half the press.

    ``header`` replaces the header of the source.
    """
    if header.pixel_size is None or header.press is None:
        missing = "pixel size" if header.pixel_size is None else "press"
        raise InputError(
            f"{source.name} has no {missing}, and the calibrated response depends on the place: record it, or"
            " give the zenith gain to do without the response"
        )
    axes = pixel_axes(source.shape[1:], header.pixel_size)
    with naming(source):
        return make_response(wall, header.dark, header.bright, axes, HALF_WAY * header.press, header.pivot)


def make_response(
    wall: WallResponse,
    dark: ArrayLike | None,
    bright: ArrayLike | None,
    axes: tuple[Doubles, Doubles],
    heights: ArrayLike,
    pivot: tuple[float, float, float] | None = None,
    follows: bool = False,
) -> Response:
    """Return the calibrated response for the pixels of a picture, with axes x and y, mm."""
    if wall.pattern != "graded":
        raise InputError("the calibration is of a uniform pattern, but normals need a graded one")
    if not 1 < len(wall.curve) <= _MAX_CURVE:
        raise InputError(
            f"the calibration's curve has {len(wall.curve)} coefficients, 2 to {_MAX_CURVE} are needed:"
            " calibrate again"
        )
    if dark is None or bright is None:
        raise InputError("the calibrated response needs dark and bright references: calibrate them as well")
    shape = len(axes[1]), len(axes[0])
    x, y = np.meshgrid(axes[0] - wall.axis[0], axes[1] - wall.axis[1])
    base = np.broadcast_to(np.asarray(dark, np.float64), shape)
    span = (np.asarray(bright, np.float64) - base) * shade(wall, x, y)
    inside = x**2 + y**2 < wall.radius**2
    with np.errstate(divide="ignore", invalid="ignore"):
        per_count = np.where(inside & np.isfinite(span) & (span > 0), 1 / span, np.nan)
    if not np.isfinite(per_count).any():
        raise InputError("bright is not above dark at any pixel: are the references swapped?")
    where = np.broadcast_to(np.asarray(heights, np.float64), shape)
    return Response(
        np.stack([base, per_count, x, y, where]).astype(np.float32),
        _wall_of(wall, (0.0, 0.0, 0.0) if pivot is None else pivot, follows),
        np.hypot(wall.zenith_sigma, wall.azimuth_sigma),
        wall.axis,
        wall.swing_sigma,
    )


def shade(wall: WallResponse, x: Doubles, y: Doubles) -> Doubles:
    """Return full light as a share of the bright reference, at positions relative to the axis, mm."""
    terms = shade_terms(x / wall.radius, y / wall.radius)
    return np.asarray(1 + np.tensordot(np.asarray(wall.shade, np.float64), terms, 1))


def _wall_of(wall: WallResponse, pivot: tuple[float, float, float], follows: bool) -> Wall:
    """Return the wall for the kernels, with the ends of the light and the curve's inverse."""
    q = np.linspace(*wall.reach, _SAMPLES)
    curve = np.asarray(wall.curve, np.float64)
    light = np.polynomial.polynomial.polyval(q, curve)
    uneven = float(np.hypot(*wall.lamps))
    inverse = np.polynomial.Polynomial.fit(
        light, q, _INVERSE - 1, domain=[light.min(), light.max()]
    ).convert()
    return Wall(
        geometry=(wall.radius, wall.rim, wall.scatter),
        sight=wall.sight,
        lamps=wall.lamps,
        curve=curve,
        reach=wall.reach,
        ends=(float(light.min()) * (1 - uneven), float(light.max()) * (1 + uneven)),
        inverse=_padded(inverse, _INVERSE),
        sense=1.0 if light[0] > light[-1] else -1.0,
        pivot=(pivot[0] - wall.axis[0], pivot[1] - wall.axis[1], pivot[2]),
        follows=follows,
    )


def _padded(polynomial: np.polynomial.Polynomial, count: int) -> Doubles:
    """Return the coefficients of a polynomial, with zeros for high orders that were trimmed."""
    numbers = np.zeros(count)
    numbers[: len(polynomial.coef)] = polynomial.coef
    return numbers
