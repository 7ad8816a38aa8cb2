"""The optics as the paper has them: how bright the mirror looks depends on its zenith alone."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from mirrorskin.hw.twin.body import Body
from mirrorskin.hw.twin.optics.pattern import Linear, Pattern, Uniform, zenith_window
from mirrorskin.hw.twin.sheet import Sheet
from mirrorskin.io.types import Floats, InputError

_PAPER = Body()


class Ideal:
    """What a camera that looks straight down sees in a mirror at the centre, taken for the whole field.

    A mirror of zenith t shows what lies 2 t off the axis. A ray from the centre of the sheet at rest meets
    the wall where ::

        tan 2t >= radius / height  and  2t <= 90 degrees,   that is  t0 = 11.8 degrees <= t <= t1 = 45 degrees

    What it meets there is the wall's response: 1 inside that window and 0 outside for the uniform pattern;
    for the linear one a ramp from 0 at its lower zenith to 1 at its upper one, which holds its ends' values
    beyond. The sheet scatters the ray evenly over +-scatter in the plane of incidence, which are +-scatter
    / 2 of zenith: the light is the response convolved with that box, by the difference of its
    antiderivative G ::

        light(t) = (G(t + w) - G(t - w)) / 2w,     w = scatter / 2

    Left out: how the window changes off the axis, how the sheet's height and an oblique line of sight change
    it, and what is dark or not beyond the horizon with the linear pattern. All of it is traced by
    `mirrorskin.hw.twin.optics.wall.Wall`.

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
        _check(body, pattern)
        self._body, self._pattern = body, pattern

    def light(self, sheet: Sheet) -> NDArray[np.float32]:
        """Return the share of full light that each pixel sees, 0 to 1.

        Parameters
        ----------
        sheet : Sheet

        Returns
        -------
        ndarray, (H, W), float32
        """
        square = sheet.dz_dx**2 + sheet.dz_dy**2
        light = np.full(square.shape, self.response(np.zeros(1))[0], np.float32)
        leans = square != 0  # most of a sheet often lies level
        light[leans] = self.response(np.arctan(np.sqrt(square[leans])))
        return light

    def response(self, zenith: Floats) -> Floats:
        """Return the share of full light that a mirror of given zenith shows.

        Parameters
        ----------
        zenith : ndarray, float64
            Radians.

        Returns
        -------
        ndarray, float64
            0 to 1, shaped as the zenith; NaN where that is NaN.
        """
        if isinstance(self._pattern, Linear):
            return _ramp_response(zenith, self._pattern, self._body.scatter)
        return uniform_response(zenith, self._body)


def uniform_response(zenith: Floats, body: Body = _PAPER) -> Floats:
    """Return the share of full light that a camera sees from a mirror under a uniformly lit wall.

    Its window of zenith (see `Ideal`) convolved with a box of half-width w = scatter / 2: two ramps, each
    2w = 3 degrees wide for the paper's body ::

        g(t) = (clip(t + w, t0, t1) - clip(t - w, t0, t1)) / 2w

    Parameters
    ----------
    zenith : ndarray, float64
        Radians.
    body : Body
        By default the paper's.

    Returns
    -------
    ndarray, float64
        0 (dark) to 1 (full light), shaped as the zenith; NaN where that is NaN.
    """
    first, last = zenith_window(body)
    if body.scatter == 0:
        return np.where(np.isnan(zenith), np.nan, (zenith >= first) & (zenith <= last))
    return _boxed(lambda at: np.clip(at, first, last), zenith, body.scatter / 2)


def design_range(body: Body) -> tuple[float, float]:
    """Return the zeniths between which the linear pattern's light is exactly linear in zenith, radians.

    Outside of it the scattered rays reach beyond the pattern's ends: 13.3 to 43.5 degrees for the paper's
    body.
    """
    first, last = zenith_window(body)
    return first + body.scatter / 2, last - body.scatter / 2


def _check(body: Body, pattern: Pattern) -> None:
    unfit = {
        "a picture as pattern": not isinstance(pattern, Uniform | Linear),
        "an air gap": body.air_gap != 0,
        "lamps that light one side more": body.asymmetry != 0,
    }
    for what, present in unfit.items():
        if present:
            raise InputError(
                f"the ideal optics know of zenith alone, not of {what}: take the optics 'cylinder'"
            )


def _ramp_response(zenith: Floats, pattern: Linear, scatter: float) -> Floats:
    """Convolve a ramp that saturates at both ends with the box of the scatter."""
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
