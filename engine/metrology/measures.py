"""Measures of a result: heights, areas, volumes, forms, texture, profiles and sections."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from html import escape
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.base.inputs import Maps, as_result
from mirrorskin.engine.metrology.extent import areas, border, heights, rim_pixels, volume
from mirrorskin.engine.metrology.fitting import FAR, FEW
from mirrorskin.engine.metrology.forms import (
    Plane,
    Polynomial,
    Sphere,
    fit_plane,
    fit_polynomial,
    fit_sphere,
)
from mirrorskin.engine.metrology.masks import Heights, Masks, in_millimetres, kept_by
from mirrorskin.engine.metrology.noise import realisations
from mirrorskin.engine.metrology.parameters import PARAMETERS
from mirrorskin.engine.metrology.patch import Patch, heights_of, patch_of
from mirrorskin.engine.metrology.profile import profile_parameters
from mirrorskin.engine.metrology.quantity import Quantity
from mirrorskin.engine.metrology.reference import subtract
from mirrorskin.engine.metrology.sections import Point, Section, along, as_point, groove, step_height
from mirrorskin.engine.metrology.sections import section as cut
from mirrorskin.engine.metrology.texture import DRAWS, FormRemoval, Roughness, roughness
from mirrorskin.io import InputError, Region, Result
from mirrorskin.io.base.arguments import check_number, checked, in_unit
from mirrorskin.io.base.findings import findings_of
from mirrorskin.io.base.types import axes_with_unit
from mirrorskin.io.model.result import in_pixels
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.numerics.least_squares import mad_sigma

FormName = Literal["plane", "sphere", "polynomial2", "polynomial3", "polynomial4", "none"]
_Form = Plane | Sphere | Polynomial

_MUCH_BETTER = 0.5  # ratio of the residuals of sphere and plane below which the sphere is chosen
_CLEAR_Z_SCORE = 2.0  # smallest step that is reported, in standard uncertainties
# Power of the pixel size that a quantity is proportional to, by unit or name. The radius of a shallow cap is
# proportional to the square of its width, and its centre is a radius away from its top.
_POWERS = {"mm2": 2, "mm3": 2, "sphere radius": 2}
_POWERS |= dict.fromkeys(("sphere centre x", "sphere centre y", "section length", "distance in space"), 1)
_POWERS |= dict.fromkeys(("step at", "plane tilt", "slope", "slope beside step", "slope beside groove"), 1)
_POWERS |= dict.fromkeys(("groove width", "groove at"), 1)
_POWERS |= {name: parameter.pixel_power for name, parameter in PARAMETERS.items() if parameter.pixel_power}
_TEXTURE = "texture"
_RATIO = 2.0  # Birge's ratio above which a surface does not have the form
_SCALE = "calibration scale"  # contribution to an uncertainty
# The contribution that quantities of a group have alone.
_CAUSES = {
    "sensor": "light, calibration",
    "form": "fit",
    "areas and volumes": "heights, border",
    "section": "heights, pixel size",
}
_SECTION = {"section length", "height difference", "distance in space", "slope"}
_SECTION |= {"step height", "step at", "slope beside step"}
_SECTION |= {"groove depth", "groove width", "groove at", "slope beside groove"}


HEALTH = ("brightness change", "brightness change to rim")
"""Quantities of the sensor, not of the surface: what `mirrorskin.engine.diagnosis.sensor_health` found."""

MAIN = (
    *(
        "step height",
        "groove depth",
        "groove width",
        "sphere radius",
        "plane tilt",
        "polynomial height range",
    ),
    *("Rq", "Pq", "Rz", "Pz", "Sq", "Sq without noise", "height range", "height above rim"),
    *("contact area", "contact area with filled", "volume above rim", "highest point", "measured area", "Sz"),
    *("sphere residual RMS", "plane residual RMS", "polynomial residual RMS", "height difference", "slope"),
    *("Sa", "Sdq without noise", "Sal", "lowest point", "median height"),
)
"""Quantities that matter most, the first ones most; see `Measures.main`."""


def group_of(name: str) -> str:
    """Return the heading under which a quantity is listed.

    Examples
    --------
    >>> [group_of(name) for name in ("highest point", "Sq", "volume above rim")]
    ['heights', 'texture: height', 'areas and volumes']
    """
    first = name.partition(" ")[0]
    if first in PARAMETERS:
        return PARAMETERS[first].group
    if first in ("plane", "sphere", "polynomial"):
        return "form"
    if name in HEALTH:
        return "sensor"
    if name in _SECTION:
        return "section"
    return "areas and volumes" if "area" in name or "volume" in name else "heights"


@dataclass(frozen=True, slots=True)
class Measures:
    """The quantities of a height map.

    Attributes
    ----------
    quantities : dict of str to Quantity
        By name, in reading order.
    notes : list of str
        Warnings and notes of the result; what is omitted, and what is assumed.
    budget : dict of str to dict of str to float
        The contributions to the standard uncertainty of each quantity, in its unit; their root sum of squares
        is the standard uncertainty.
    smooth : bool
        Whether the texture cannot be distinguished from a smooth one.
    """

    quantities: dict[str, Quantity]
    notes: list[str]
    budget: dict[str, dict[str, float]] = field(default_factory=dict)
    smooth: bool = False

    def main(self, count: int = 10) -> dict[str, Quantity]:
        """Return the quantities that matter most, at most so many, in reading order.

        Texture parameters are left out if the texture cannot be distinguished from a smooth one.
        """
        known = [name for name in MAIN if name in self.quantities]
        if self.smooth:
            known = [name for name in known if not group_of(name).startswith(_TEXTURE)]
        chosen = set(known[:count])
        return {name: quantity for name, quantity in self.quantities.items() if name in chosen}

    def _repr_html_(self) -> str:
        """Draw all quantities as a table for a notebook, after the notes."""
        rows, heading = [], ""
        for name, quantity in self.quantities.items():
            if (group := group_of(name)) != heading:
                heading = group
                rows.append(f'<tr><th colspan="3" style="text-align:left">{escape(group)}</th></tr>')
            meaning = PARAMETERS[name].meaning if name in PARAMETERS else ""
            cells = (name, str(quantity), meaning)
            rows.append(
                "<tr>"
                + "".join(f'<td style="text-align:left">{escape(cell)}</td>' for cell in cells)
                + "</tr>"
            )
        notes = "".join(f"<li>{escape(note)}</li>" for note in self.notes)
        return f"<ul>{notes}</ul><table>{''.join(rows)}</table>"


@checked(
    pixel_size=in_unit("mm"),
    s_filter=in_unit("mm", check_number),
    l_filter=in_unit("mm", check_number),
    section=lambda name, ends: tuple(as_point(name, end) for end in ends),
    noise_length=in_unit("mm", check_number),
    section_width=in_unit("mm", check_number),
)
def measure(
    result: Maps,
    *,
    pixel_size: ArrayLike | None = None,
    region: Region | None = None,
    form: FormName | None = None,
    s_filter: float | None = None,
    l_filter: float | None = None,
    section: tuple[Point, Point] | None = None,
    noise_length: float | None = None,
    section_width: float = 0.0,
    mask: Masks | None = None,
    reference: Maps | None = None,
    robust: bool | None = None,
) -> Measures:
    """Measure the height map of a result.

    Parameters
    ----------
    result : Result, mapping, xarray.Dataset, path or array_like, (H, W)
        Heights of one picture, mm, with their standard deviation, if available. An array is the height.
    pixel_size : float or (float, float), optional
        Millimetres along x and y; by default that of the result.
    region : Region, optional
        Part of the picture to measure, in its pixels; by default all of it.
    form : {"plane", "sphere", "polynomial2", "polynomial3", "polynomial4", "none"}, optional
        Form that is fitted and removed before texture is measured; by default the sphere if its residual is
        less than half of the plane's, otherwise the plane. Without a form, texture is that of the heights.
    s_filter, l_filter : float, optional
        Nesting indices, mm, of the filters that remove shorter, and longer waves from the texture
        (ISO 16610-61). With an L-filter the profile of the section is the roughness profile, with
        R-parameters; without, it is the primary profile, with P-parameters.
    section : ((float, float), (float, float)), optional
        Both ends of a section to measure, mm from the picture's centre.
    noise_length : float, optional
        Length over which errors of heights are correlated, mm: 0 for independent ones, infinity for those of
        integrated slopes. By default that of the result: 0 for a press and for heights of unknown origin.
    section_width : float
        Extent across the section over which heights are averaged, mm; its step is then an areal one.
    mask : mask, sequence of masks, or array_like, (H, W), optional
        What is left out: see `mirrorskin.engine.metrology.masks`. An array is True where to measure.
    reference : Result, mapping, xarray.Dataset, path or array_like, (H, W), optional
        Heights that are subtracted first; see `mirrorskin.engine.metrology.subtract`.
    robust : bool, optional
        Whether outliers are left out of the fit of the form; by default only of a sphere.

    Returns
    -------
    Measures
        Heights, areas, volumes, the form, texture (ISO 25178-2), and the section with its profile
        (ISO 21920-2), each with its standard uncertainty.

    Raises
    ------
    InputError
        Nothing can be measured with these options.

    Examples
    --------
    >>> x, y = np.array([-0.1, 0.0, 0.1]), np.array([0.05, -0.05])
    >>> result = Result(height=np.float32([[0, 1, 2], [0, 1, 2]]), x=x, y=y)
    >>> round(measure(result, form="none").quantities["measured area"].value, 6)
    0.06
    """
    maps = as_result(result, "result", pixel_size=pixel_size)
    if reference is not None:
        maps = subtract(maps, reference)
    if in_pixels(maps):
        _refuse_millimetres(
            mask=mask, s_filter=s_filter, l_filter=l_filter, section=section, noise_length=noise_length
        )
        maps = _along_pixels(maps)
    patch, comparable = patch_of(maps, region)
    if mask is not None:
        assert maps.x is not None  # patch_of needs both
        assert maps.y is not None
        heights_there = Heights(
            heights_of(maps).astype(np.float64), maps.x, maps.y, partial(_outliers, patch, form, maps)
        )
        patch, comparable = patch_of(maps, region, kept_by(mask, heights_there))
    if noise_length is not None:
        patch = replace(patch, noise_length=noise_length)
    outermost = rim_pixels(patch)
    quantities, notes = heights(patch, outermost), list(patch.notes)
    quantities |= areas(patch)
    quantities |= _volumes(patch, quantities.get("rim height"), outermost)
    form_removed = _remove_form(patch, form, robust, notes)
    quantities |= form_removed.quantities
    budget: dict[str, dict[str, float]] = {}
    rough = _texture(patch, form_removed, (s_filter, l_filter), notes)
    quantities |= rough.parameters
    budget |= rough.budget
    if section is not None:
        quantities |= _section(comparable, section, section_width, patch.noise_length, notes)
        quantities |= _profile(
            patch, form_removed, comparable, (section, section_width), (s_filter, l_filter), notes, budget
        )
    quantities |= _health(maps)
    lens = None if maps.calibration is None else maps.calibration.lens
    scale = 0.0 if lens is None else lens.scale_sigma
    quantities, budget = _scaled(quantities, budget, scale)
    units = {name: quantity.unit for name, quantity in quantities.items()}
    if in_pixels(maps):
        quantities = {name: quantity.in_pixels() for name, quantity in quantities.items()}
        budget = {
            name: {cause: Quantity(part, 0.0, units[name]).in_pixels().value for cause, part in parts.items()}
            for name, parts in budget.items()
        }
    size = f"the pixel size is {f'known within {100 * scale:.2g} %' if scale else 'taken as exact'}"
    if in_pixels(maps):
        size = "lengths are in pixels, whose size is unknown"
    inherited = [finding.text for finding in findings_of("result", maps.process)]
    if reference is not None:
        notes.append("heights are differences from those of the reference")
    return Measures(quantities, [*inherited, *notes, *_assumed(patch, size)], budget, rough.smooth)


def _health(result: Result) -> dict[str, Quantity]:
    """Return how much the brightness has changed since the calibration, if the result states it."""
    change, sigma = result.fitted.light_change, result.fitted.light_change_sigma
    if change is None or sigma is None:
        return {}
    parts = zip(HEALTH, (0, -1), strict=True)
    return {name: Quantity(100 * change[part], 100 * sigma[part], "%") for name, part in parts}


def _refuse_millimetres(**lengths: Any) -> None:
    """Raise InputError for arguments that are in millimetres, which heights in pixels do not have."""
    for name, value in lengths.items():
        if value is not None and not (name == "mask" and not in_millimetres(value)):
            raise InputError(
                f"{name} is in mm, and the heights are in pixels, whose size is unknown: give pixel_size, or"
                " integrate again with one"
            )


def _along_pixels(result: Result) -> Result:
    """Return a result whose places are in pixels, as its heights are."""
    rows, columns = heights_of(result).shape
    x, y, _ = axes_with_unit((rows, columns), None)
    return result.assign(x=x, y=y)


def _outliers(patch: Patch, form: FormName | None, result: Result) -> NDArray[np.bool_]:
    """Return which heights, (H, W), are outliers of the form, fitted robustly to those of a patch."""
    fitted = _fit(patch, form, True)
    residual = patch.height - np.nanmedian(patch.height) if fitted is None else fitted.residual
    distance = np.abs(residual)
    measured = np.isfinite(distance)
    found = measured & (distance > FAR * mad_sigma(residual[measured]))
    outliers = np.zeros(heights_of(result).shape, bool)
    if np.count_nonzero(found) <= FEW * np.count_nonzero(measured):
        outliers[patch.place] = found
    return outliers


def _volumes(patch: Patch, base: Quantity | None, outermost: NDArray[np.bool_] | None) -> dict[str, Quantity]:
    """Return the volume above the rim, and below the sheet's rest plane if heights are absolute."""
    volumes: dict[str, Quantity] = {}
    if base is not None:
        volumes |= volume(
            patch, base.value, "volume above rim", level_sigma=base.sigma, level_pixels=outermost
        )
    if patch.absolute:
        for name, above in volume(patch, 0.0, "volume below rest plane").items():
            volumes[name] = replace(above, value=-above.value)
    return volumes


@dataclass(frozen=True, slots=True, eq=False)
class _Removed:
    """Heights without their form, and what the removal does to errors of heights."""

    about: str  # from which texture is measured
    residual: Doubles  # (H, W), mm
    quantities: dict[str, Quantity]
    shapes: list[Doubles]  # (H, W): shapes that the form takes from the noise
    errors: list[Doubles]  # (H, W), mm: errors of the form
    sensitivity: Doubles | float  # of an error of a height that is an error of the residual


def _remove_form(patch: Patch, form: FormName | None, robust: bool | None, notes: list[str]) -> _Removed:
    """Fit the form and return what it leaves."""
    fitted = _fit(patch, form, robust)
    if fitted is None:
        return _Removed("their mean", patch.height, {}, [], [], 1.0)
    kind = type(fitted).__name__.lower()
    if fitted.outliers and (isinstance(fitted, Sphere) if robust is None else robust):
        notes.append(
            f"outliers left out of the fit of the {kind}, but not of its residual: {fitted.outliers}"
        )
    elif fitted.outliers:
        notes.append(f"outliers that the {kind} by least squares includes: {fitted.outliers}")
    if fitted.birge > _RATIO:
        notes.append(
            f"the surface is no {kind} within its errors:"
            f" what the fit leaves is {fitted.birge:.0f} times as large"
        )
    shapes, errors, sensitivity = _sensitivity(patch, fitted)
    return _Removed(f"the {kind}", fitted.residual, fitted.quantities(), shapes, errors, sensitivity)


def _sensitivity(patch: Patch, fitted: _Form) -> tuple[list[Doubles], list[Doubles], Doubles | float]:
    """Return the shapes of a form, its errors, and the share of errors of heights perpendicular to it."""
    if isinstance(fitted, Polynomial):
        return fitted.shapes, fitted.errors, 1.0
    x, y = np.meshgrid(patch.x - np.mean(patch.x), patch.y - np.mean(patch.y))
    if isinstance(fitted, Plane):
        slope, azimuth = math.radians(fitted.tilt.value), math.radians(fitted.azimuth.value)
        down, across = (
            x * math.cos(azimuth) + y * math.sin(azimuth),
            y * math.cos(azimuth) - x * math.sin(azimuth),
        )
        turn = min(math.radians(fitted.azimuth.sigma) * math.tan(slope), math.radians(fitted.tilt.sigma))
        return [x, y], [math.radians(fitted.tilt.sigma) * down, turn * across], math.cos(slope)
    x, y = np.meshgrid(patch.x - fitted.x.value, patch.y - fitted.y.value)
    radius = fitted.radius.value
    up = np.sqrt(np.maximum(1 - (x**2 + y**2) / radius**2, 0.0))  # cosine of the inclination
    return [x, y, up], [fitted.radius.sigma * up], up


def _texture(
    patch: Patch,
    removed: _Removed,
    filters: tuple[float | None, float | None],
    notes: list[str],
) -> Roughness:
    """Return the areal parameters of what the form leaves."""
    s_filter, l_filter = filters
    rough = roughness(
        removed.residual,
        patch.pixel_size,
        s_filter=s_filter,
        l_filter=l_filter,
        sigma=None if patch.sigma is None else patch.sigma * removed.sensitivity,
        noise_length=patch.noise_length,
        form=removed.shapes,
        form_errors=removed.errors,
    )
    names = (("S", s_filter), ("L", l_filter))
    used = "".join(f", {name}-filter {length:g} mm" for name, length in names if length is not None)
    notes.append(
        f"texture by ISO 25178-2 from {removed.about}{used}, over {rough.pixels} pixels, noise included"
    )
    notes.extend(rough.notes)
    if rough.left_out:
        notes.append(
            f"pixels left out of texture, too near to holes or ends for the filter: {rough.left_out}"
        )
    if rough.uncertain:
        notes.append(
            f"pixels left out of texture and lowest point, far less certain than others: {rough.uncertain}"
        )
    return rough


def _profile(
    patch: Patch,
    removed: _Removed,
    result: Result,
    line: tuple[tuple[Point, Point], float],
    filters: tuple[float | None, float | None],
    notes: list[str],
    budget: dict[str, dict[str, float]],
) -> dict[str, Quantity]:
    """Return the profile parameters of what the form leaves along a section with a width."""
    along_section = _Sampler(patch, result, *line)
    profile = along_section.cut(removed.residual)
    step = float(profile.distance[1] - profile.distance[0])
    errors: Iterator[Doubles] = iter(())
    if patch.sigma is not None:
        measured = np.isfinite(removed.residual)
        without_form = FormRemoval(measured, removed.shapes)
        drawn = realisations(
            patch.sigma * removed.sensitivity, measured, patch.pixel_size, patch.noise_length, DRAWS
        )
        errors = (along_section.cut(without_form(noise)).height for noise in drawn)
    s_filter, l_filter = filters
    try:
        quantities, parts = profile_parameters(
            profile.height, step, s_filter=s_filter, l_filter=l_filter, errors=errors
        )
    except InputError as error:
        notes.append(f"no profile parameters: {error}")
        return {}
    kind = "primary profile" if l_filter is None else f"roughness profile, L-filter {l_filter:g} mm"
    short = "without an S-filter" if s_filter is None else f"S-filter {s_filter:g} mm"
    notes.append(f"profile by ISO 21920-2 from {removed.about}: {kind}, {short}")
    for name, quantity in quantities.items():
        if name.endswith("Sm") and not math.isfinite(quantity.value):
            notes.append(f"no {name}: the profile has no peak or pit that exceeds a tenth of its height")
    budget |= parts
    return quantities


class _Sampler:
    """Values of a patch along a section of the whole picture."""

    def __init__(self, patch: Patch, result: Result, ends: tuple[Point, Point], width: float) -> None:
        self._place, self._ends, self._width = patch.place, ends, width
        self._result = result.assign(height_sigma=None, filled=None)

    def cut(self, values: Doubles) -> Section:
        """Return the section of values of the patch, as heights."""
        assert self._result.height is not None
        whole = np.full(self._result.height.shape, np.nan, np.float32)
        whole[self._place] = values
        return cut(self._result.assign(height=whole), *self._ends, width=self._width)


def _fit(patch: Patch, form: FormName | None, robust: bool | None) -> _Form | None:
    """Fit a form; by default the sphere if its residual is much smaller, otherwise the plane, if any fits."""
    cloud = patch.height, patch.x, patch.y, patch.sigma
    length, flat = patch.noise_length, bool(robust)
    if form == "plane":
        return fit_plane(*cloud, noise_length=length, robust=flat)
    if form == "sphere":
        return fit_sphere(*cloud, noise_length=length, robust=robust is not False)
    if form == "none":
        return None
    if form is not None:
        degree = int(form.removeprefix("polynomial"))
        return fit_polynomial(*cloud, degree=degree, noise_length=length, robust=flat)
    plane: Plane | None = None
    with suppress(InputError):
        plane = fit_plane(*cloud, noise_length=length, robust=flat)
        sphere = fit_sphere(*cloud, noise_length=length, robust=robust is not False)
        if sphere.rms.value < _MUCH_BETTER * plane.rms.value:
            return sphere
    return plane


def _section(
    result: Result, ends: tuple[Point, Point], width: float, noise_length: float, notes: list[str]
) -> dict[str, Quantity]:
    """Return the quantities of a section, and of a step or a groove if there is one."""
    profile = cut(result.with_fitted(height_correlation=noise_length), *ends, width=width)
    quantities = along(profile)
    ends_known = np.isfinite(profile.height[[0, -1]]) & ~profile.filled[[0, -1]]
    if not ends_known.all():
        notes.append(
            "section: an end has no measured height: difference, distance and slope end where one has"
        )
    if width:
        notes.append(f"section: heights are means over a width of {width:g} mm")
    with suppress(InputError):
        slot = groove(profile)
        if abs(slot.depth.value) > _CLEAR_Z_SCORE * slot.depth.sigma:
            return quantities | {
                "groove depth": slot.depth,
                "groove width": slot.width,
                "groove at": slot.place,
                "slope beside groove": slot.slope,
            }
    with suppress(InputError):
        step = step_height(profile)
        if abs(step.height.value) > _CLEAR_Z_SCORE * step.height.sigma:
            return quantities | {
                "step height": step.height,
                "step at": step.place,
                "slope beside step": step.slope,
            }
    notes.append("no step along the section: no two levels that differ clearly")
    return quantities


def _scaled(
    quantities: dict[str, Quantity], budget: dict[str, dict[str, float]], scale: float
) -> tuple[dict[str, Quantity], dict[str, dict[str, float]]]:
    """Add the relative uncertainty of the pixel size, ``scale``, to the quantities and to their budget."""
    scaled: dict[str, Quantity] = {}
    parts: dict[str, dict[str, float]] = {}
    for name, quantity in quantities.items():
        if name == "sphere centre z":
            change = 2 * quantities["sphere radius"].value
        else:
            own = name.removesuffix(" without noise")
            change = _POWERS.get(own, _POWERS.get(quantity.unit, 0)) * quantity.value
        scaled[name] = replace(quantity, sigma=math.hypot(quantity.sigma, scale * change))
        parts[name] = budget.get(name, {_CAUSES.get(group_of(name), "heights"): quantity.sigma})
        if scale and change:
            parts[name] = parts[name] | {_SCALE: abs(scale * change)}
    return scaled, parts


def _assumed(patch: Patch, size: str) -> list[str]:
    """Return notes on the assumptions behind values and uncertainties; ``size`` is that on the pixel size."""
    notes = [f"± is the standard uncertainty (k = 1); {size}"]
    if patch.sigma is not None:
        notes.append(f"errors of heights are {_correlation(patch.noise_length)}")
    filled = int(np.count_nonzero(np.isfinite(patch.filled)))
    if filled:
        notes.append(f"pixels filled, not measured, that count only in what says 'filled': {filled}")
    if filled and np.nanmax(patch.filled) > np.nanmax(patch.height):
        notes.append("the top was filled, not measured: 'highest point' is the highest that was measured")
    if np.count_nonzero(border(patch.contact, ends=True)) > np.count_nonzero(border(patch.contact)):
        notes.append("contact reaches the picture's border: areas and volumes are of what is seen")
    if patch.sigma is None:
        notes.append("the result has no standard deviations of heights: uncertainties of these are unknown")
    return notes


def _correlation(length: float) -> str:
    if math.isinf(length):
        return "those of integrated slopes, which neighbours share"
    if length > 0:
        return f"correlated over {length:.2g} mm"
    return "independent from pixel to pixel"
