"""From counts to lights under a cylindrical wall: a calibration's response, at the places of the pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.provenance import naming
from mirrorskin.engine.rotation.design_matrix import Doubles
from mirrorskin.engine.rotation.registration import Sight
from mirrorskin.io import Calibrated, Header, InputError, Precession, Source, WallResponse, pixel_axes
from mirrorskin.kernels.normals_wall import Wall

_SAMPLES = 400  # of the curve, to find its ends and its inverse
_INVERSE = 8  # coefficients of the inverse, which is a starting point only
_MAX_CURVE = 12  # coefficients of a curve
_DARK = 0.05  # share of full light that is next to none

HALF_WAY = 0.5
"""Share of the press that an object is taken to stand at, before more is known."""


@dataclass(frozen=True, slots=True, eq=False)
class Response:
    """How bright each pixel gets from which normal; it takes the place of a ``Scale``.

    Attributes
    ----------
    planes : ndarray, (5, H, W), float32
        Counts without light; light per count; x and y from the wall's axis, and height z of the object in the
        mean pose above the rest plane, mm. NaN where a pixel has no response.
    wall : Wall
    sigma : ndarray, (H, W), float32
        Standard error of the normals that the calibration makes, radians; NaN where it is unknown.
    axis : (float, float)
        Where the wall's axis is in the picture, mm from its centre.
    """

    planes: NDArray[np.float32]
    wall: Wall
    sigma: NDArray[np.float32]
    axis: tuple[float, float]
    per_pixel = True  # each pixel has planes of its own
    ends = True  # there is a range of light out of which a sample is left out

    @property
    def sight(self) -> Sight:
        """How the lines of sight lean, in the middle of the picture's distances from the axis."""
        x, y = self.planes[2:4]
        near, far = self.wall.sight
        return Sight(near + far * float(np.mean(x**2 + y**2)), self.axis)

    @property
    def table(self) -> NDArray[np.float32]:
        """The wall's numbers in the order of the names in ``normals_wall.cl``."""
        wall = self.wall
        radius, rim, scatter = wall.geometry
        low, high = wall.reach
        curve = Polynomial(wall.curve).convert(domain=[low, high], window=[-1, 1], kind=Polynomial)
        known = [radius, rim, np.sin(scatter) ** 2, *wall.sight, *(lamp / radius for lamp in wall.lamps)]
        known += [low, high, *wall.ends, wall.sense, *wall.pivot, (low + high) / 2, 2 / (high - low)]
        return np.array([*known, *wall.inverse, *_padded(curve, len(wall.curve))], np.float32)

    def thinned(self, step: int) -> Doubles:
        """Return the planes of every ``step``-th pixel, (5, n)."""
        return self.planes.reshape(5, -1)[:, ::step].astype(np.float64)

    def clear_pixels(self, wave: Doubles, step: int) -> NDArray[np.bool_]:
        """Return which of every ``step``-th pixel stay within the range of the light over a turn.

        ``wave``, (3, n), is mean, cosine and sine of the samples, counts.
        """
        offset, per_count = self.thinned(step)[:2]
        mean, swing = (wave[0] - offset) * per_count, np.hypot(*wave[1:]) * np.abs(per_count)
        low, high = self.wall.ends
        with np.errstate(invalid="ignore"):
            return np.asarray((mean - swing > low) & (mean + swing < high))

    def too_level(self, mean: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Return where the surface is too level to be seen: it shows what lies over the wall's rim."""
        wall = self.wall
        rim = float(np.polynomial.polynomial.polyval(wall.reach[1], wall.curve))
        with np.errstate(invalid="ignore"):
            return np.asarray((mean - self.planes[0]) * self.planes[1] < max(rim, _DARK) + _DARK)

    def at(self, heights: ArrayLike, follows: bool = False) -> Response:
        """Return the same with the object at other heights, mm above the rest plane in the mean pose.

        ``follows`` is whether each pixel keeps seeing one point of the object; see ``Registered``.
        """
        planes = self.planes.copy()
        planes[4] = heights
        return replace(self, planes=planes, wall=self.wall._replace(follows=follows))


def wall_response_of(source: Source) -> WallResponse | None:
    """Return the response of a source's calibration, if it has one that gives zeniths."""
    known = source.calibration if isinstance(source, Calibrated) else None
    if known is None or known.zenith is None or known.zenith.pattern != "graded":
        return None
    return known.zenith if known.precession is None else _with_ellipse(known.zenith, known.precession)


def _with_ellipse(wall: WallResponse, precession: Precession) -> WallResponse:
    """Add to the azimuth's errors what comes of taking one half-angle d where the lean goes round an ellipse.

    Of ellipticity e the half-angle is d (1 + e cos 2(a - m)) at azimuth a, m that of the greatest. A surface
    inclined towards p so seems to change, beside the third harmonic, by d e/2 cos(a - 2m + p): as if p were
    e/2 sin 2(p - m) off, root mean square e / (2 sqrt 2). As for the rest, the zenith is in mid range.
    """
    error = abs(precession.ellipticity) / math.sqrt(8)
    if not error > 0:
        return wall
    zenith = math.pi / 4 - math.atan(sum(wall.reach) / 2)
    sigma = np.hypot(wall.azimuth_sigma, np.float32(error * math.sin(zenith)))
    return replace(wall, azimuth_sigma=sigma)


def initial_response(wall: WallResponse, source: Source, header: Header) -> Response:
    """Return the response for a source's pixels, the object taken to stand as high as half the press.

    ``header`` counts instead of the source's own.
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
    """Put a calibrated response together for the pixels of a picture."""
    if wall.pattern != "graded":
        raise InputError("the calibration is of a uniform pattern, but normals need a graded one")
    if not 1 < len(wall.curve) <= _MAX_CURVE:
        raise InputError(
            f"the calibration's curve has {len(wall.curve)} coefficients, 2 to {_MAX_CURVE} are needed:"
            " calibrate again"
        )
    if dark is None or bright is None:
        raise InputError("the calibration's response needs dark and bright references: calibrate them, too")
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
    )


def shade(wall: WallResponse, x: Doubles, y: Doubles) -> Doubles:
    """Return the share of the bright reference that full light is at places from the axis, mm."""
    u, v = x / wall.radius, y / wall.radius
    return np.asarray(
        1 + np.tensordot(np.asarray(wall.shade, np.float64), np.stack([u, v, u * u, u * v, v * v]), 1)
    )


def _wall_of(wall: WallResponse, pivot: tuple[float, float, float], follows: bool) -> Wall:
    """Return the wall as kernels take it: with the ends of the light, and the curve's inverse."""
    q = np.linspace(*wall.reach, _SAMPLES)
    curve = np.asarray(wall.curve, np.float64)
    light = np.polynomial.polynomial.polyval(q, curve)
    uneven = float(np.hypot(*wall.lamps))
    inverse = Polynomial.fit(light, q, _INVERSE - 1, domain=[light.min(), light.max()]).convert()
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


def _padded(polynomial: Polynomial, count: int) -> Doubles:
    """Return the coefficients of a polynomial, of which high ones may be missing."""
    numbers = np.zeros(count)
    numbers[: len(polynomial.coef)] = polynomial.coef
    return numbers
