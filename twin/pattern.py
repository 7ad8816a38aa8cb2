"""The print of the patterned sheet around the body: its transmittance by position."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.io.base.types import Floats, InputError
from mirrorskin.io.formats.pictures import PICTURE_SUFFIXES, read_picture
from mirrorskin.twin.body import Body

PATTERN_NAMES = ("uniform", "linear")

_ROWS = 256  # rows of the table; linear interpolation between them is accurate to 1e-5 for the linear pattern


class Pattern(Protocol):
    """A patterned sheet around the body."""

    def table(self, body: Body, /) -> NDArray[np.float32]:
        """Return its transmittance, (rows + 2, columns + 2), as `mirrorskin.kernels.twin.wall` reads it."""


@dataclass(frozen=True, slots=True)
class Uniform:
    """A clear sheet: transmittance 1."""

    def table(self, body: Body, /) -> NDArray[np.float32]:
        """Return ones, (3, 3)."""
        return np.ones((3, 3), np.float32)


@dataclass(frozen=True, slots=True)
class Linear:
    """A sheet whose transmittance is linear in zenith, as in Figure 9 of the paper.

    A mirror at the centre of the sheet at rest shows a camera looking straight down the height z of the wall
    if its zenith is half of the angle between that point and the axis. There the transmittance is ::

        T = (zenith - lower) / (upper - lower), from 0 to 1,     zenith = atan2(radius, z) / 2

    Attributes
    ----------
    lower, upper : float
        Zeniths at which the transmittance is 0 and 1, radians.

    Raises
    ------
    InputError
        They are not in ascending order between 0 and 90 degrees.
    """

    lower: float
    upper: float

    def __post_init__(self) -> None:
        if not 0 <= self.lower < self.upper <= math.pi / 2:
            raise InputError(
                f"a pattern linear from a zenith of {self.lower} to {self.upper} rad is not "
                "possible: give the lower one first, both from 0 to pi/2"
            )

    @property
    def gain(self) -> float:
        """Share of full light per radian of zenith."""
        return 1 / (self.upper - self.lower)

    @property
    def offset(self) -> float:
        """Share of full light at zenith 0 if the line is extrapolated."""
        return -self.lower * self.gain

    def table(self, body: Body, /) -> NDArray[np.float32]:
        """Return the transmittance from the wall's rim down to the rest plane, (258, 3)."""
        height = body.height * (1 - (np.arange(_ROWS) + 0.5) / _ROWS)
        ends = 2 * self._transmittance(np.array([body.height, 0.0]), body.radius)
        inside = self._transmittance(height, body.radius)
        # Rows beyond an edge are chosen such that the interpolation is exact at the edge.
        column = np.concatenate([ends[:1] - inside[:1], inside, ends[1:] - inside[-1:]])
        return np.repeat(column.astype(np.float32)[:, np.newaxis], 3, axis=1)

    def _transmittance(self, height: Floats, radius: float) -> Floats:
        return np.clip(self.offset + self.gain * np.arctan2(radius, height) / 2, 0, 1)


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """A sheet with any picture on it, unrolled as seen when turning on the body's axis.

    Attributes
    ----------
    values : ndarray, (rows, columns), float64
        Transmittance, 0 to 1, at the middle of equal pieces of the wall, linear between them. Rows go down
        from the wall's rim; columns go counter-clockwise, from azimuth -pi to pi. Given as uint8 or uint16,
        it is divided by the type's greatest value.

    Raises
    ------
    InputError
        It is not two-dimensional, empty, of another type, or has values outside 0 to 1.
    """

    values: Floats

    def __init__(self, values: ArrayLike) -> None:
        object.__setattr__(self, "values", _transmittances(np.asarray(values)))

    def table(self, body: Body, /) -> NDArray[np.float32]:
        """Return the picture with top and bottom repeated and its sides joined, (rows + 2, columns + 2)."""
        taller = np.pad(self.values, ((1, 1), (0, 0)), "edge")
        return np.pad(taller, ((0, 0), (1, 1)), "wrap").astype(np.float32)


def make_pattern(name: str | Path, body: Body) -> Pattern:
    """Return a pattern by its name or file.

    It is "uniform"; "linear", from dark at the zenith that shows the wall's rim to clear at the zenith that
    shows the horizon; or the path of a picture, PNG or TIFF, which is converted to grey. InputError if it is
    unknown, or its file cannot be used.
    """
    if name == "uniform":
        return Uniform()
    if name == "linear":
        return linear_pattern(body)
    path = Path(name)
    if path.suffix.lower() not in PICTURE_SUFFIXES:
        names, kinds = ", ".join(PATTERN_NAMES), ", ".join(PICTURE_SUFFIXES)
        raise InputError(f"pattern {str(name)!r} is unknown: take {names} or the path of a picture ({kinds})")
    try:
        return Picture(read_picture(path))
    except InputError as error:
        raise InputError(f"pattern {error}") from None


def zenith_window(body: Body) -> tuple[float, float]:
    """Return the zeniths at which a mirror at the centre shows the wall's rim and the horizon, radians."""
    return math.atan2(body.radius, body.height) / 2, math.pi / 4


def linear_pattern(body: Body) -> Linear:
    """Return the linear pattern that spans a wall: dark at its rim, clear at the rest plane."""
    return Linear(*zenith_window(body))


def _transmittances(values: NDArray[Any]) -> Floats:
    if values.ndim != 2 or values.size == 0:
        raise InputError(
            f"a pattern has rows and columns only, but this one has shape {values.shape}: give one picture"
        )
    if values.dtype in (np.uint8, np.uint16):
        return values / float(np.iinfo(values.dtype).max)
    if values.dtype.kind != "f":
        raise InputError(
            f"a pattern cannot be {values.dtype}: give 8- or 16-bit counts, or floats from 0 to 1"
        )
    if not ((values >= 0) & (values <= 1)).all():
        raise InputError("the transmittance of a pattern is 0 to 1: scale its values to that range")
    return values.astype(np.float64)
