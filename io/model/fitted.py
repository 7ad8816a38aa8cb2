"""Facts about the maps of a result that later stages need: each value is declared once.

Result files and the documentation are derived from these declarations.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mirrorskin.io.base.selection import Region
from mirrorskin.io.model.parameters import Parameter, documented, parameter, parameters

_TYPES: Mapping[str, type] = {"integer": int, "flag": bool, "text": str}


@documented
@dataclass(frozen=True, slots=True)
class Fitted:
    """Facts about the maps of a result that later stages need; None if unknown."""

    noise: float | None = parameter("standard deviation of a sample", "counts", default=None)
    shot_noise: float | None = parameter(
        "increase of the variance of a sample per count of brightness", "counts", default=None
    )
    tilt: float | None = parameter("half-angle of the precession", "rad", default=None)
    turns: int | None = parameter("number of turns that the normals are the mean of", default=None)
    frames: int | None = parameter("number of frames that were used", default=None)
    pixel_gain_sigma: float | None = parameter(
        "relative standard deviation of the gains of pixels, which is part of `normals_sigma`", default=None
    )
    light_variance: tuple[float, float] | None = parameter(
        "variance a + b sin(zenith)^2 of the normals because of errors that all pixels have in common, which"
        " is part of `normals_sigma`: a and b",
        "rad^2",
        default=None,
    )
    common_errors: tuple[float, ...] | None = parameter(
        "modes of these errors: of each, along the meridian and across it, the factors of 25 functions of the"
        ' normal and of the place (see the documentation, "Normals from a rotation")',
        "rad",
        shape=("n",),
        default=None,
        valid=lambda factors: len(factors) % 50 == 0 and bool(np.isfinite(factors).all()),
    )
    light_change: tuple[float, float, float, float] | None = parameter(
        "relative change of the brightness since the calibration, or from what the stated zenith gain and"
        " tilt predict: mean over the pixels that show it, increase from the centre of the picture to the"
        " right and to the upper border, and from the centre to the rim",
        default=None,
        valid=lambda change: bool(np.isfinite(change).all()),
    )
    light_change_sigma: tuple[float, float, float, float] | None = parameter(
        "standard deviations of `light_change`, with those of the calibration",
        default=None,
        valid=lambda sigma: bool(np.isfinite(sigma).all()),
    )
    slope_direction: float | None = parameter(
        "direction of `slope`, counter-clockwise from x", "rad", default=None
    )
    registered: bool | None = parameter(
        "whether frames were registered: maps then show points of the object", default=None
    )
    event: str | None = parameter("event of a press whose heights these are: onset or release", default=None)
    first_frame: int | None = parameter("number of the first frame that was used", default=None)
    frame_travel: tuple[float, ...] | None = parameter(
        "travel of the frames between which an event was searched for, in their order",
        "mm",
        shape=("T",),
        default=None,
        valid=lambda travel: bool(np.isfinite(travel).all()),
    )
    footprint: float | None = parameter(
        "variance of the area that a pixel sees, if it is clearly larger than the pixel",
        "pixels^2",
        default=None,
    )
    threshold: float | None = parameter("share of the range from dark to bright of an event", default=None)
    dark_level: float | None = parameter(
        "level of dark pixels, if it is the same for all", "counts", default=None
    )
    bright_level: float | None = parameter(
        "level of bright pixels, if it is the same for all", "counts", default=None
    )
    travel: float | None = parameter("travel at which the maps are valid", "mm", default=None)
    integration: str | None = parameter("integration method: direct, multigrid or robust", default=None)
    integration_iterations: int | None = parameter("iterations of the solver", default=None)
    integration_residual: float | None = parameter("relative residual that the solver left", default=None)
    integration_converged: bool | None = parameter("whether the residual is small enough", default=None)
    integration_invalid: int | None = parameter(
        "number of wanted pixels whose slopes are not finite", "pixels", default=None
    )
    height_correlation: float | None = parameter(
        "length over which errors of fused heights are correlated", "mm", default=None
    )
    height_common_sigma: float | None = parameter(
        "standard deviation of the error that heights of a press have in common because of gamma and drift",
        "mm",
        default=None,
    )
    common_height_sigma: float | None = parameter(
        "standard deviation of the common height of a fused surface, from the steps of the press, which is"
        " part of `height_sigma`",
        "mm",
        default=None,
    )
    disagreement: float | None = parameter(
        "RMS by which heights and normals of a fused surface contradict each other, which is part of"
        " `height_sigma`",
        "mm",
        default=None,
    )
    source_frames: tuple[int, int] | None = parameter(
        "first frame of the recording, and the end, if all frames between them were used", default=None
    )
    source_region: tuple[int, int, int, int] | None = parameter(
        "first row and end, first column and end, in the camera's picture",
        "pixels",
        default=None,
        valid=lambda ends: 0 <= ends[0] < ends[1] and 0 <= ends[2] < ends[3],
    )
    undistorted: bool | None = parameter(
        "whether maps were resampled from the camera's pixels to positions on the sheet", default=None
    )

    @property
    def region(self) -> Region | None:
        """The region of the camera's picture from which the maps were computed."""
        ends = self.source_region
        return None if ends is None else Region(ends[:2], ends[2:])

    @property
    def place(self) -> Fitted:
        """The facts about the position of the pixels alone."""
        return Fitted(source_region=self.source_region, undistorted=self.undistorted)

    def values(self) -> dict[str, Any]:
        """Return the known values, by name.

        Examples
        --------
        >>> (Fitted(tilt=0.05, turns=2) | Fitted(turns=1)).values()
        {'tilt': 0.05, 'turns': 1}
        """
        values = {name: getattr(self, name) for name in parameters(self)}
        return {name: value for name, value in values.items() if value is not None}

    def __or__(self, other: Fitted) -> Fitted:
        """Return the values of both; those of the other one have priority."""
        return replace(self, **other.values())

    def encode(self) -> str:
        """Return the known values as JSON."""
        return json.dumps(self.values())

    @staticmethod
    def decode(text: str) -> Fitted:
        """Return the values written by `encode`; ValueError if the text is no JSON."""
        values = json.loads(text)
        return taken_from(values if isinstance(values, dict) else {})


def taken_from(values: Mapping[str, Any]) -> Fitted:
    """Return those of some values that are declared, by name and type; others are ignored.

    Examples
    --------
    >>> taken_from({"noise": 1.5, "turns": "all", "program": "mirrorskin"}).values()
    {'noise': 1.5}
    """
    declared = parameters(Fitted)
    return Fitted(
        **{name: _as_declared(value, declared[name]) for name, value in values.items() if name in declared}
    )


def _as_declared(value: Any, declared: Parameter) -> Any:
    """Return a value in its declared type, or None if it has another one."""
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, list | tuple):
        return _as_declared_tuple(value, declared)
    if isinstance(value, bool) != (declared.kind == "flag"):
        return None
    if declared.kind == "number" and isinstance(value, int | float):
        return float(value)
    return value if isinstance(value, _TYPES.get(declared.kind, ())) else None


def _as_declared_tuple(values: Sequence[Any], declared: Parameter) -> tuple[Any, ...] | None:
    """Return several values in their declared type, or None if they have another one."""
    numbers = declared.kind == "numbers"
    fits = all(type(item) in ((int, float) if numbers else (int,)) for item in values)
    fits &= declared.kind.endswith("s") and (
        isinstance(declared.shape[0], str) or declared.shape[0] == len(values)
    )
    if not fits or (declared.valid is not None and not declared.valid(values)):
        return None
    return tuple(map(float, values)) if numbers else tuple(values)
