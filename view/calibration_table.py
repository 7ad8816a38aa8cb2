"""The numbers of a calibration, in common units."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import Calibration
from mirrorskin.io.calibration.types import (
    BITS,
    GROUPS,
    Gel,
    Lens,
    Precession,
    References,
    Stiffness,
    WallResponse,
)

_DEGREE = math.degrees(1)


class Row(NamedTuple):
    """A number of a calibration."""

    part: str  # as its command is called
    what: str
    value: float | int | str
    sigma: float = math.nan  # standard error; NaN if unknown
    unit: str = ""

    def cells(self) -> tuple[str, str, str, str, str]:
        """Return part, quantity, value, standard error and unit as text, with the significant digits only."""
        if isinstance(self.value, str | int):
            return self.part, self.what, str(self.value), "", self.unit
        if not math.isfinite(self.value):
            return self.part, self.what, "unknown", "", self.unit
        if not (math.isfinite(self.sigma) and self.sigma > 0):
            return self.part, self.what, f"{self.value:.6g}", "", self.unit
        digits = max(0, 1 - math.floor(math.log10(self.sigma)))
        value, sigma = (f"{number:.{digits}f}" for number in (self.value, self.sigma))
        return self.part, self.what, value, sigma, self.unit


def calibration_table(calibration: Calibration) -> list[Row]:
    """Return the numbers of a calibration; for maps, their medians."""
    camera = calibration.camera
    rows = [Row("camera", "name", camera.name or "unknown")]
    rows += (
        Row("camera", f"{what} of a frame", size)
        for what, size in zip(("rows", "columns"), camera.shape, strict=True)
    )
    rows.append(Row("camera", "type of a sample", np.dtype(camera.dtype).name))
    for name, part in calibration.parts().items():
        rows += (Row(GROUPS[name], *row) for row in _TABLES[name](part))
    return rows


_Numbers = Iterator[tuple[Any, ...]]


def _references(part: References) -> _Numbers:
    yield "dark", _median(part.dark), _median(part.dark_sigma), "counts"
    yield "bright", _median(part.bright), _median(part.bright_sigma), "counts"
    for name, bit in BITS.items():
        yield name, int(np.count_nonzero(part.defects & bit)), math.nan, "pixels"


def _lens(part: Lens) -> _Numbers:
    for name, size in zip("xy", part.pixel_size, strict=True):
        yield f"pixel size along {name}", 1000 * size, 1000 * size * part.scale_sigma, "um"
    for name, value in zip(("k1", "k2", "p1", "p2", "k3"), part.distortion, strict=True):
        yield f"distortion {name}", float(value)
    yield "left on the board", part.error, math.nan, "px"


def _zenith(part: WallResponse) -> _Numbers:
    low, high = sorted(math.degrees(math.pi / 4 - math.atan(q)) for q in part.reach)
    yield "pattern", part.pattern
    yield "known on the axis from", low, math.nan, "deg"
    yield "known on the axis to", high, math.nan, "deg"
    yield "error of zenith", _median(part.zenith_sigma) * _DEGREE, math.nan, "deg"
    yield "error of azimuth x sin(zenith)", _median(part.azimuth_sigma) * _DEGREE, math.nan, "deg"
    sigma = dict(zip(part.parameters, np.sqrt(np.diag(part.covariance)).tolist(), strict=True))
    yield "radius", part.radius, sigma.get("radius", math.nan), "mm"
    yield "rim", part.rim, sigma.get("rim", math.nan), "mm"
    for name, number in zip("xy", part.axis, strict=True):
        yield f"axis {name}", number, sigma.get(f"axis_{name}", math.nan), "mm"
    for name, number in zip("xy", part.lamps, strict=True):
        yield f"lamps towards {name}", 100 * number, 100 * sigma.get(f"lamp_{name}", math.nan), "%"
    yield "scatter", part.scatter * _DEGREE, sigma.get("scatter", math.nan) * _DEGREE, "deg"
    yield "left on the balls at most", part.error * _DEGREE, math.nan, "deg"


def _precession(part: Precession) -> _Numbers:
    def angle(what: str, value: float, field: str) -> tuple[Any, ...]:
        return what, value * _DEGREE, part.sigma.get(field, math.nan) * _DEGREE, "deg"

    yield angle("half-angle", part.tilt, "tilt")
    yield angle("phase offset", part.phase_offset, "phase_offset")
    yield "direction", "with the phase" if part.direction > 0 else "against the phase"
    yield "ellipticity", part.ellipticity, part.sigma.get("ellipticity", math.nan)
    yield angle("major axis", part.major_axis, "major_axis")
    for name, value in zip("xy", part.centre, strict=True):
        yield angle(f"mean lean along {name}", value, f"centre_{name}")
    for name, value in zip("xyz", part.pivot, strict=True):
        yield f"pivot {name}", value, part.sigma.get(f"pivot_{name}", math.nan), "mm"


def _gel(part: Gel) -> _Numbers:
    sigma = part.sigma
    threshold = part.threshold * _DEGREE, sigma.get("threshold", math.nan) * _DEGREE
    yield "threshold zenith", *threshold, "deg"
    yield "flexure times modulus", part.compliance, sigma.get("compliance", math.nan), "1/mm"
    yield "travel at the touch", part.travel_zero, sigma.get("travel_zero", math.nan), "mm"
    yield "left on the ball", 1000 * part.error, math.nan, "um"


def _stiffness(part: Stiffness) -> _Numbers:
    yield "modulus", 1000 * part.modulus, 1000 * part.modulus_sigma, "kPa"
    yield "scatter of a force", 100 * part.scatter, math.nan, "%"
    yield "error of held-out forces", 100 * part.error, math.nan, "%"
    yield "presses", part.presses


def _median(values: NDArray[np.float32]) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else math.nan


_TABLES: Mapping[str, Callable[[Any], _Numbers]] = {
    "references": _references,
    "lens": _lens,
    "zenith": _zenith,
    "precession": _precession,
    "gel": _gel,
    "stiffness": _stiffness,
}
