"""The light that the camera sees in the mirror: a function of the zenith, or ray-traced to the wall."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.io.base.types import Floats, InputError
from mirrorskin.kernels.device import Device
from mirrorskin.twin.body import Body
from mirrorskin.twin.pattern import Linear, Pattern, Uniform, zenith_window
from mirrorskin.twin.skin import Sheet
from mirrorskin.twin.view import View

_PAPER = Body()


class Ideal:
    """The view of a camera looking straight down at a mirror in the centre, applied to the whole field.

    A mirror of zenith t deflects the line of sight by 2 t. A ray from the centre of the sheet at rest meets
    the wall where ::

        tan 2t >= radius / height  and  2t <= 90 degrees,   that is  t0 = 11.8 degrees <= t <= t1 = 45 degrees

    The response of the wall there is 1 inside that window and 0 outside for the uniform pattern. For the
    linear one it is a ramp from 0 at its lower zenith to 1 at its upper one, and constant beyond. The sheet
    scatters the ray uniformly over +-scatter in the plane of incidence, which is +-scatter / 2 of zenith. The
    light is the response convolved with that box, by the difference of its antiderivative G ::

        light(t) = (G(t + w) - G(t - w)) / 2w,     w = scatter / 2

    Not included: the change of the window off the axis, the effects of the sheet's height and of an oblique
    line of sight, and the horizon with the linear pattern. `Wall` traces all of these.

    Parameters
    ----------
    body : Body
    pattern : Pattern
        Uniform or Linear.

    Raises
    ------
    InputError
        Brightness would not be a function of zenith alone, or not this one: a picture, an air gap, uneven
        lamps.
    """

    def __init__(self, body: Body, pattern: Pattern) -> None:
        unfit = {
            "a picture as pattern": not isinstance(pattern, Uniform | Linear),
            "an air gap": body.air_gap != 0,
            "uneven lamps": body.asymmetry != 0,
        }
        for what, present in unfit.items():
            if present:
                raise InputError(
                    f"the ideal optics depend on the zenith only and do not support {what}: use "
                    "the optics 'cylinder'"
                )
        self._body, self._pattern = body, pattern

    def light(self, sheet: Sheet) -> NDArray[np.float32]:
        """Return the share of full light at each pixel, (H, W), float32."""
        square = sheet.dz_dx**2 + sheet.dz_dy**2
        light = np.full(square.shape, self.response(np.zeros(1))[0], np.float32)
        leans = square != 0  # most of a sheet is often level
        light[leans] = self.response(np.arctan(np.sqrt(square[leans])))
        return light

    def response(self, zenith: Floats) -> Floats:
        """Return the share of full light of a mirror with a zenith, radians; NaN for NaN."""
        if isinstance(self._pattern, Linear):
            return _ramp_response(zenith, self._pattern, self._body.scatter)
        return uniform_response(zenith, self._body)


def uniform_response(zenith: Floats, body: Body = _PAPER) -> Floats:
    """Return the share of full light that a camera sees in a mirror under a uniformly lit wall.

    It is the window of zenith (see `Ideal`) convolved with a box of half-width w = scatter / 2: two ramps,
    each 2w = 3 degrees wide for the paper's body ::

        g(t) = (clip(t + w, t0, t1) - clip(t - w, t0, t1)) / 2w
    """
    first, last = zenith_window(body)
    if body.scatter == 0:
        return np.where(np.isnan(zenith), np.nan, (zenith >= first) & (zenith <= last))
    return _boxed(lambda at: np.clip(at, first, last), zenith, body.scatter / 2)


def design_range(body: Body) -> tuple[float, float]:
    """Return the zeniths between which the linear pattern's light is exactly linear in zenith, radians.

    Outside this range, scattered rays reach beyond the pattern's ends: 13.3 to 43.5 degrees for the paper's
    body.
    """
    first, last = zenith_window(body)
    return first + body.scatter / 2, last - body.scatter / 2


def _ramp_response(zenith: Floats, pattern: Linear, scatter: float) -> Floats:
    """Convolve a ramp that is constant beyond its ends with the box of the scatter."""
    span = pattern.upper - pattern.lower
    if scatter == 0:
        return np.clip((zenith - pattern.lower) / span, 0, 1)

    def antiderivative(at: Floats) -> Floats:
        on_ramp = np.clip(at - pattern.lower, 0, span)
        return on_ramp**2 / (2 * span) + np.maximum(at - pattern.upper, 0)

    return _boxed(antiderivative, zenith, scatter / 2)


def _boxed(antiderivative: Callable[[Floats], Floats], zenith: Floats, half_width: float) -> Floats:
    upper, lower = antiderivative(zenith + half_width), antiderivative(zenith - half_width)
    return (upper - lower) / (2 * half_width)


_HALVINGS = 60
_TINY = 1e-30  # a totally reflected ray never crosses


def visible_zenith(body: Body, x: ArrayLike, y: ArrayLike, azimuth: ArrayLike) -> tuple[Floats, Floats]:
    """Return the zeniths between which a mirror shows the wall to a camera looking straight down.

    The mirror is in the rest plane, without scatter. In the direction of the azimuth the distance to the
    body's side is ::

        way = c - b,    b = x cos(azimuth) + y sin(azimuth),    c = sqrt(b^2 + radius^2 - x^2 - y^2)

    and the ray leans by twice the zenith t: it passes below the rim for ``t >= atan2(way, height) / 2``, and
    above the horizon up to 45 degrees. With an air gap it must also leave the body: it meets the side at an
    angle of cosine sin(2t) c / radius, and is totally reflected unless ::

        sin(2t) > sqrt(1 - 1 / index^2) radius / c

    Just above that limit it leaves steeply and passes above the rim within the gap; the least zenith at which
    it does not is found by bisection.

    Parameters
    ----------
    body : Body
    x, y : array_like
        Place of the mirror, mm.
    azimuth : array_like
        Of its normal, radians.

    Returns
    -------
    lower, upper : ndarray, float64
        Radians, shaped as the arguments broadcast; NaN where no mirror shows the wall, and outside the body.
    """
    x, y, azimuth = np.broadcast_arrays(
        np.asarray(x, float), np.asarray(y, float), np.asarray(azimuth, float)
    )
    half_chord_squared = body.radius**2 - x * x - y * y
    along = x * np.cos(azimuth) + y * np.sin(azimuth)
    # The distance is undefined outside the body: NaN from here on.
    cosine = np.sqrt(along * along + np.where(half_chord_squared > 0, half_chord_squared, np.nan))
    length = half_chord_squared / (cosine + along)
    lower = np.arctan2(length, body.height) / 2
    if body.air_gap > 0:
        lower = _leaves(body, length, cosine / body.radius, lower)
    return lower, np.where(np.isnan(lower), np.nan, math.pi / 4)


def _leaves(body: Body, length: Floats, cosine: Floats, lower: Floats) -> Floats:
    """Return the least zenith at which a ray leaves the body below the rim and also meets the wall below it.

    ``cosine`` is that of a horizontal ray and the side's normal. A larger zenith makes the ray meet the wall
    lower.
    """
    lowest = math.sqrt(1 - 1 / body.index**2) / cosine
    dark = np.maximum(lower, np.arcsin(np.minimum(lowest, 1)) / 2)
    light = np.full_like(dark, math.pi / 4)
    for _ in range(_HALVINGS):
        middle = (dark + light) / 2
        below = _height_at_wall(body, length, cosine, middle) <= body.height
        dark, light = np.where(below, dark, middle), np.where(below, middle, light)
    return np.where(lowest < 1, light, np.nan)


def _height_at_wall(body: Body, length: Floats, cosine: Floats, zenith: Floats) -> Floats:
    """Return the height at which a ray meets the wall across the gap."""
    level, rise = np.sin(2 * zenith), np.cos(2 * zenith)
    out = np.sqrt(np.maximum(1 - body.index**2 * (1 - (level * cosine) ** 2), 0))
    spread = np.maximum(1 - (body.index * rise) ** 2, 0)  # squared horizontal component of the refracted ray
    gap_squared = (body.radius + body.air_gap) ** 2 - body.radius**2
    towards = body.radius * out
    across = gap_squared / (towards + np.sqrt(towards**2 + spread * gap_squared + _TINY))
    return np.asarray(rise * (length / level + body.index * across))


_RAYS = 128  # rays per pixel
_FADES = 24  # the light at the wall's edges fades over the scatter divided by this
# golden angle: points at its multiples are distributed evenly over a sphere
_GOLDEN = math.pi * (3 - math.sqrt(5))


class Wall:
    """The lit wall in the mirror, by ray tracing.

    At each pixel the line of sight is reflected at the sheet's normal and scattered by its flakes
    (`scatter_rays`), and each ray reaches the wall (`mirrorskin.kernels.twin.wall`). A ray is dark if it

    - passes over the rim and leaves by the body's top;
    - goes down below the rest plane: it meets the sheet before the wall, and second reflections are ignored;
    - is totally reflected at the body's side, with an air gap;
    - starts outside the body.

    The sheet does not occlude the wall: a ray that would meet another part of the raised sheet passes through
    it, so narrow grooves with steep walls are too bright.

    Light agrees with the float64 reference within 2e-5, and within 1e-3 across a gap or less than 0.2 mm from
    the body's side. Without scatter, a ray that meets an edge within the rounding of float32 may be on either
    side.
    """

    def __init__(self, body: Body, pattern: Pattern, view: View, device: Device) -> None:
        self._body, self._device, self._shape = body, device, view.shape
        table = pattern.table(body)
        places = [view.x, view.y]
        if not view.orthographic:
            places += [view.slope_x, view.slope_y]
        self._places = device.from_host("places", np.stack([place.ravel() for place in places]))
        self._rays = device.from_host("rays", scatter_rays(body.scatter))
        self._table = device.from_host("table", table)
        self._sheet = device.array("sheet", (3, *view.shape), np.float32)
        self._light = device.array("light", view.shape, np.float32)
        self._macros = {
            "OBLIQUE": int(not view.orthographic),
            "GAP": int(body.air_gap > 0),
            "TABLE": _depends_on(table),
            "LAMPS": int(body.asymmetry > 0),
        }

    def light(self, sheet: Sheet) -> NDArray[np.float32]:
        """Return the share of full light at each pixel, (H, W), float32.

        Full light is that of the pattern's clear parts where the lamps are brightest. The sheet must be
        finite everywhere.
        """
        for plane, values in enumerate((sheet.height, sheet.dz_dx, sheet.dz_dy)):
            self._sheet.write(values, row=plane)
        body, pixels = self._body, math.prod(self._light.shape)
        rows, columns = self._table.shape
        lean = body.asymmetry_azimuth
        self._device.kernel("wall", "wall_light", **self._macros)(
            -(-pixels // self._device.layout.tile),
            pixels=pixels,
            samples=self._rays.shape[0],
            rows=rows - 2,
            columns=columns - 2,
            sheet=self._sheet,
            places=self._places,
            rays=self._rays,
            table=self._table,
            radius=body.radius,
            rim=body.height,
            gap=body.air_gap,
            index=body.index,
            scatter=body.scatter,
            fade=fade_angle(body.scatter),
            asymmetry_x=body.asymmetry * math.cos(lean),
            asymmetry_y=body.asymmetry * math.sin(lean),
            light=self._light,
            moved=sum(array.nbytes for array in (self._sheet, self._places, self._light)),
        )
        return self._light.read()


def scatter_rays(scatter: float) -> Floats:
    """Return rays scattered about a reflected one, as used by `mirrorskin.kernels.twin.wall.wall_light`.

    A ray deviates from the reflected one by the vector (u, v) across it, of length at most a = scatter. Its
    density ::

        1 / (2 pi a sqrt(a^2 - u^2 - v^2))

    is the projection of points distributed evenly over a sphere of radius a. Slices of a sphere of equal
    thickness have equal areas (Archimedes), so in every plane through the reflected ray the low-pass is a box
    from -a to a. The rays are a Fibonacci lattice: one per slice, rotated by the golden angle.

    Scatter is in radians. Rays are (S, 3): components along the reflected ray, along u and along v; without
    scatter only the reflected ray.
    """
    if scatter == 0:
        return np.array([[1.0, 0.0, 0.0]])
    number = np.arange(_RAYS) + 0.5
    u = 1 - 2 * number / _RAYS
    v = np.sqrt(1 - u * u) * np.cos(number * _GOLDEN)
    length = np.sqrt(u * u + v * v)
    across = np.sin(scatter * length) / length
    return np.stack([np.cos(scatter * length), across * u, across * v], axis=1)


def fade_angle(scatter: float) -> float:
    """Return the angle over which a ray fades at the wall's edges, radians; it hides the number of rays."""
    return 2 * scatter / _FADES


def _depends_on(table: NDArray[np.float32]) -> int:
    """Return 0 if a wall is uniform, 1 if it varies with height only, otherwise 2."""
    if (table == table[:, :1]).all():
        return int((table != table[0, 0]).any())
    return 2
