"""Measures of a result: heights, areas, volumes, forms, roughness and sections."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from mirrorskin.engine.inputs import Maps, as_result
from mirrorskin.engine.metrology.extent import areas, border, heights, volume
from mirrorskin.engine.metrology.forms import Plane, Sphere, fit_plane, fit_sphere
from mirrorskin.engine.metrology.patch import Patch, patch_of
from mirrorskin.engine.metrology.quantity import Quantity
from mirrorskin.engine.metrology.sections import Point, along, step_height
from mirrorskin.engine.metrology.sections import section as cut
from mirrorskin.engine.metrology.texture import roughness
from mirrorskin.io import InputError, Region, Result
from mirrorskin.io.arguments import as_array_or_number, check_number, checked

FormName = Literal["plane", "sphere", "none"]

_MUCH_BETTER = 0.5  # ratio of the residuals of sphere and plane below which the sphere is chosen
_CLEAR = 2.0  # smallest step that is reported, in standard uncertainties
# Power of the pixel size that a quantity is proportional to, by unit or name. The radius of a shallow cap is
# proportional to the square of its width, and its centre is a radius away from its top.
_POWERS = {"mm2": 2, "mm3": 2, "sphere radius": 2}
_POWERS |= dict.fromkeys(("sphere centre x", "sphere centre y", "section length", "distance in space"), 1)
_POWERS |= dict.fromkeys(("step at", "plane tilt", "slope", "slope beside step"), 1)
_RATIO = 2.0  # Birge's ratio above which a surface does not have the form


@dataclass(frozen=True, slots=True)
class Measures:
    """The quantities of a height map.

    Attributes
    ----------
    quantities : dict of str to Quantity
        By name, in reading order.
    notes : list of str
        What is omitted, and what is assumed.
    """

    quantities: dict[str, Quantity]
    notes: list[str]


@checked(pixel_size=as_array_or_number, cutoff=check_number)
def measure(
    result: Maps,
    *,
    pixel_size: ArrayLike | None = None,
    region: Region | None = None,
    form: FormName | None = None,
    cutoff: float | None = None,
    section: tuple[Point, Point] | None = None,
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
    form : {"plane", "sphere", "none"}, optional
        Form that is fitted, and from which roughness is measured; by default the sphere if its residual is
        less than half of the plane's, otherwise the plane. Without a form, roughness is that of the heights.
    cutoff : float, optional
        Longest wavelength that counts as roughness, mm.
    section : ((float, float), (float, float)), optional
        Both ends of a section to measure, mm from the picture's centre.

    Returns
    -------
    Measures
        Heights, areas, volumes, the form, roughness, and the section, each with its standard uncertainty.

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
    patch, comparable = patch_of(maps, region)
    quantities, notes = heights(patch), list(patch.notes)
    quantities |= areas(patch)
    quantities |= _volumes(patch, quantities.get("rim height"))
    quantities |= _forms(patch, form, cutoff, notes)
    if section is not None:
        quantities |= _section(comparable, section, notes)
    lens = None if maps.calibration is None else maps.calibration.lens
    scale = 0.0 if lens is None else lens.scale_sigma
    return Measures(_scaled(quantities, scale), [*notes, *_assumed(patch, scale)])


def _volumes(patch: Patch, base: Quantity | None) -> dict[str, Quantity]:
    """Return the volume above the rim, and below the sheet's rest plane if heights are absolute."""
    volumes: dict[str, Quantity] = {}
    if base is not None:
        volumes |= volume(patch, base.value, base.sigma, "volume above rim")
    if patch.absolute:
        for name, above in volume(patch, 0.0, 0.0, "volume below rest plane").items():
            volumes[name] = replace(above, value=-above.value)
    return volumes


def _forms(
    patch: Patch, form: FormName | None, cutoff: float | None, notes: list[str]
) -> dict[str, Quantity]:
    """Return the form that fits the surface, and its roughness."""
    fitted = _fit(patch, form)
    about, residual = "their mean", patch.height
    quantities: dict[str, Quantity] = {}
    if fitted is not None:
        kind = "plane" if isinstance(fitted, Plane) else "sphere"
        about, residual, quantities = f"the {kind}", fitted.residual, fitted.quantities()
        if fitted.outliers:
            notes.append(
                f"outliers left out of the fit of the {kind}, but not of its residual: {fitted.outliers}"
            )
        if fitted.birge > _RATIO:
            notes.append(
                f"the surface is no {kind} within its errors:"
                f" what the fit leaves is {fitted.birge:.0f} times as large"
            )
    rough = roughness(residual, patch.pixel_size, cutoff=cutoff, sigma=patch.sigma)
    waves = "" if cutoff is None else f", of waves up to {cutoff:g} mm"
    notes.append(f"roughness by ISO 25178-2 from {about}{waves}, over {rough.pixels} pixels, noise included")
    if rough.left_out:
        notes.append(
            f"pixels left out of roughness, too near to holes or ends for the filter: {rough.left_out}"
        )
    if rough.uncertain:
        notes.append(
            f"pixels left out of roughness and lowest point, far less certain than others: {rough.uncertain}"
        )
    return quantities | rough.quantities()


def _fit(patch: Patch, form: FormName | None) -> Plane | Sphere | None:
    """Fit a form; by default the sphere if its residual is much smaller, otherwise the plane, if any fits."""
    cloud = patch.height, patch.x, patch.y, patch.sigma
    if form == "plane":
        return fit_plane(*cloud)
    if form == "sphere":
        return fit_sphere(*cloud)
    if form == "none":
        return None
    plane: Plane | None = None
    with suppress(InputError):
        plane = fit_plane(*cloud)
        sphere = fit_sphere(*cloud)
        if sphere.rms.value < _MUCH_BETTER * plane.rms.value:
            return sphere
    return plane


def _section(result: Result, ends: tuple[Point, Point], notes: list[str]) -> dict[str, Quantity]:
    """Return the quantities of a section, and of a step if there is one."""
    profile = cut(result, *ends)
    quantities = along(profile)
    ends_known = np.isfinite(profile.height[[0, -1]]) & ~profile.filled[[0, -1]]
    if not ends_known.all():
        notes.append(
            "section: an end has no measured height: difference, distance and slope end where one has"
        )
    with suppress(InputError):
        step = step_height(profile)
        if abs(step.height.value) > _CLEAR * step.height.sigma:
            return quantities | {
                "step height": step.height,
                "step at": step.place,
                "slope beside step": step.slope,
            }
    notes.append("no step along the section: no two levels that differ clearly")
    return quantities


def _scaled(quantities: dict[str, Quantity], scale: float) -> dict[str, Quantity]:
    """Add the relative uncertainty of the pixel size, ``scale``, to the quantities."""
    scaled: dict[str, Quantity] = {}
    for name, quantity in quantities.items():
        if name == "sphere centre z":
            change = 2 * quantities["sphere radius"].value
        else:
            change = _POWERS.get(quantity.unit, _POWERS.get(name, 0)) * quantity.value
        scaled[name] = replace(quantity, sigma=math.hypot(quantity.sigma, scale * change))
    return scaled


def _assumed(patch: Patch, scale: float) -> list[str]:
    """Return notes on the assumptions behind values and uncertainties."""
    size = f"known within {100 * scale:.2g} %" if scale else "taken as exact"
    notes = [f"± is the standard uncertainty (k = 1); the pixel size is {size}"]
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
