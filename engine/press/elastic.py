"""Correction of a press for the elastomer: contact is deeper than in eq. 3, and light precedes contact."""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage, sparse
from scipy.sparse.linalg import splu

from mirrorskin.engine.base.errors import NotConverged
from mirrorskin.engine.force.halfspace import (
    HalfSpace,
    Pressed,
    SlopeFit,
    Targets,
    load_gradient,
    press,
    sweep,
)
from mirrorskin.engine.press.cells import Cells, split_into_cells, touched
from mirrorskin.engine.press.spline import CellSplines
from mirrorskin.io import Gel, InputError, Result, Source, pixel_axes
from mirrorskin.io.base.arguments import check_pixel_size
from mirrorskin.io.model.maps import PressStatus
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.numerics import least_squares
from mirrorskin.kernels.numerics.least_squares import mad_sigma

Mask = NDArray[np.bool_]

LEARNED_AT = 0.5
"""Threshold at which gels are calibrated, as a share of the range from dark to bright."""

_MIN_CELLS = 12  # minimum number of cells that turned light
_SAMPLED = 250  # cells whose onsets are fitted; the splines have too few coefficients to need more
_TRAVELS = 16  # travels at which the press is simulated
_BENDING = 1.0  # expected third derivatives of the surface, 1/mm^2
# Stages of the fit, which is stiff at first: bending, number of steps, relative decrease of the cost.
_STAGES = (0.1, 1, 0.0), (0.1, 1, 0.0), (0.3, 1, 0.0), (_BENDING, 1, 0.0), (_BENDING, 10, 0.1)
_RELAXED, _STUCK = 3.0, 1e3  # divisor of the damping from step to step, and its limit; see `_MAX_CHANGE`
_MAX_CHANGE = 0.3  # mm: largest change of the surface in a step
_SLOPE_ERROR = 0.006  # standard deviation of the sheet's slope at the resolution of cells
_LOSS = least_squares.huber(2.0)  # of slopes, in units of `_SLOPE_ERROR`
_MISFIT = 0.08  # largest median slope residual of an accepted fit
_DEPTH = (
    0.6  # initial depth over that of eq. 3; the exact ratio is 0.5 for a paraboloid, more for steeper tips
)
_INITIAL_ERROR = 0.01  # mm: standard deviation of heights in `_interpolate`
_MAX_OUTSIDE = 0.3  # largest share of the contact outside the picture, where the object is extrapolated
_SHARE_LEFT = 0.02  # standard deviation of a correction over the correction, from the size of cells
_MAX_OUTER_SIGMA = 0.05  # mm: largest standard deviation of heights that are kept outside the contact
_RIDGE = 1e-12  # relative


def threshold_at(gel: Gel, x: ArrayLike, y: ArrayLike, azimuth: ArrayLike) -> Doubles:
    """Return the zenith angle at which a pixel turns light.

    Seen along the axis, a mirror of zenith t reflects a direction 2 t off the axis. At the sheet normal's
    azimuth, the wall (radius R about the axis, rim at one height) is at the distance d from the pixel ::

        tan 2t = d / R tan 2t0,    d = (R^2 - r^2) / (b + sqrt(b^2 + R^2 - r^2))

    with r the pixel's distance from the axis, b its component along the azimuth, and t0 the threshold on the
    axis.

    Parameters
    ----------
    gel : Gel
    x, y : array_like
        Position, mm.
    azimuth : array_like
        Azimuth of the sheet's normal, radians.

    Returns
    -------
    ndarray, float64
        Radians, shaped as the arguments broadcast; NaN outside the wall.
    """
    across = gel.curvature * (np.asarray(x, np.float64) - gel.axis[0])
    up = gel.curvature * (np.asarray(y, np.float64) - gel.axis[1])
    square = 1 - across**2 - up**2  # (R^2 - r^2) / R^2
    along = across * np.cos(azimuth) + up * np.sin(azimuth)
    square = np.where(square > 0, square, np.nan)
    distance = square / (along + np.sqrt(along**2 + square))
    return np.asarray(np.arctan(distance * math.tan(2 * gel.threshold)) / 2)


def correct_press(
    result: Result, source: Source, deepest: float, threshold: float, gel: Gel | None
) -> tuple[Result, str, PressFit | None]:
    """Correct the heights of a press or a release for the elastomer, if gel, pixel size and threshold permit.

    Holes must not be filled yet. ``deepest`` is the greatest travel, mm, and ``threshold`` that of the
    heights, as a share. Also returns an entry of ``process``, and the fit if there was a correction.
    """
    pixel_size = source.header.pixel_size
    if gel is None:
        return result, "none: the calibration has no gel", None
    if pixel_size is None:
        return result, "none: the recording has no pixel size", None
    if threshold != LEARNED_AT:
        reason = f"the gel was learned with a threshold of {LEARNED_AT}, not of {threshold:g}"
        return result, f"none: {reason}", None
    try:
        maps = result["height"], result["height_sigma"], result["status"]
        fit = fit_press(*maps, pixel_size, gel, deepest=deepest)
    except NotConverged as error:
        return result, f"none: {error}", None
    lost = np.count_nonzero((result["status"] == PressStatus.ONSET) & np.isnan(fit.height))
    summary = f"corrected for the gel; {lost} pixels turned light too far from the touch"
    return result.assign(height=fit.height, height_sigma=fit.sigma), summary, fit


def fit_press(
    height: ArrayLike,
    sigma: ArrayLike,
    status: ArrayLike,
    pixel_size: ArrayLike,
    gel: Gel,
    *,
    deepest: float | None = None,
) -> PressFit:
    """Fit the surface whose press into the elastomer explains the onsets, and correct heights with it.

    Eq. 3 assumes that the travel at a pixel's onset equals the depth of the object there. An elastomer,
    however, is indented around the contact: a paraboloid touches a point at twice its depth, and the sheet
    around a contact is steep enough to turn light before it touches. Therefore a smooth surface is fitted
    (cubic splines, no finer than an eighth of the lit area), such that its press into an elastic half-space
    brings the sheet to the threshold's slope at the onset of each pixel. The fit uses Levenberg-Marquardt
    steps with penalised third derivatives; the penalty is larger in the first steps. The correction is the
    difference between this surface and an equally smooth one through the uncorrected heights, so finer
    details are preserved.

    Parameters
    ----------
    height, sigma : array_like, (H, W)
        As returned by ``find_onset``, mm, of a press or (without friction, equivalently) a release.
    status : array_like, (H, W)
        0 invalid, 1 turned light, 2 never light, 3 light at start; of a release, 3 is light until the end.
    pixel_size : float or (float, float)
        Millimetres, along x and y.
    gel : Gel
    deepest : float, optional
        Greatest travel, mm; by default that of the last onset.

    Returns
    -------
    PressFit
        ``height`` and ``sigma``, (H, W) mm, include the correction and its uncertainty. They are NaN where a
        pixel turned light without contact, except near the contact: farther away, the surface is determined
        by the penalty only.

    Raises
    ------
    mirrorskin.engine.NotConverged
        Too few pixels turned light, or no surface explains the onsets.
    mirrorskin.io.InputError
        Maps or sizes that cannot be used.
    """
    heights, sigmas, state = np.asarray(height, np.float64), np.asarray(sigma, np.float64), np.asarray(status)
    if heights.ndim != 2 or 0 in heights.shape:
        raise InputError(f"heights have shape {heights.shape}: one map (H, W) is needed")
    if state.shape != heights.shape or sigmas.shape not in ((), heights.shape):
        raise InputError(
            f"sigma {sigmas.shape} and status {state.shape} do not fit heights of shape {heights.shape}:"
            " give one a pixel"
        )
    heights = np.where(state == PressStatus.ONSET, heights, np.nan)
    scene = _scene_of(heights, state, check_pixel_size(pixel_size), gel, deepest)
    smooth = _interpolate(scene, scene.height)
    surface = _fit_surface(scene, _initial_surface(scene))
    factors, fit, form = surface.parameters, surface.slopes, surface.equations()[0]
    here, everywhere = (int(np.sum(part)) for part in (scene.cells.inside(fit.contact), fit.contact))
    if everywhere - here > _MAX_OUTSIDE * everywhere:
        raise NotConverged("much of the contact is outside the picture")
    change = _splines_on_pixels(scene, heights.shape, factors - smooth)
    variance = _on_pixels(scene, heights.shape, _variances(scene, fit, form))
    contact = _on_pixels(scene, heights.shape, fit.contact.astype(np.float64)) >= 0.5
    variance = variance + (_SHARE_LEFT * change) ** 2 + gel.error**2
    usable = np.isfinite(heights) & (contact | (variance <= _MAX_OUTER_SIGMA**2))
    heights = np.where(usable, heights + change, np.nan)
    sigmas = np.where(usable, np.sqrt(sigmas**2 + variance), np.nan)
    return PressFit(heights.astype(np.float32), sigmas.astype(np.float32), scene, factors, fit, form)


class PressFit(NamedTuple):
    """A fitted press: corrected heights of pixels, and the spline surface."""

    height: NDArray[np.float32]
    sigma: NDArray[np.float32]
    scene: _Scene
    factors: Doubles  # coefficients of the surface's splines
    slopes: SlopeFit
    form: Doubles  # matrix of the normal equations: the inverse covariance of the factors

    def pressed(self) -> Pressed:
        """Return the press at the greatest travel, on the cells."""
        surface = np.where(self.scene.surface, self.scene.splines.surface(self.factors), np.nan)
        return press(self.scene.space, surface + self.scene.travel[-1], self.scene.gel.compliance)

    def on_pixels(self, values: Doubles) -> Doubles:
        """Interpolate a map of cells to pixels; 0 outside the cells."""
        return _on_pixels(self.scene, self.height.shape, values)

    @property
    def pixels_of_a_spline(self) -> float:
        """Number of pixels over the number of coefficients of the surface."""
        return max(1.0, self.height[self.scene.cells.box].size / len(self.factors))

    def by_compliance(self) -> Doubles:
        """Return the derivative of the heights by the gel's compliance, (H, W), mm per 1/mm.

        A stage that gives way more lowers the body less at each onset, so all heights are larger.
        """
        slope = self.slopes.by_travel * self.slopes.load / _SLOPE_ERROR**2
        moved = _solve(self.form, np.einsum("ki,k->i", self.slopes.jacobian, slope))
        return _splines_on_pixels(self.scene, self.height.shape, moved)

    def load_errors(self, pressed: Pressed) -> tuple[float, Doubles]:
        """Return the load's standard error from the fit, and its changes with the gel's parameters, mm^2.

        The changes, (3,), are for one standard error of threshold, compliance and curvature.
        """
        gel = self.scene.gel
        gradient = load_gradient(self.scene.space, pressed.contact, gel.compliance)
        by_factors = self.scene.splines.basis.T @ gradient.ravel()
        moved = _solve(self.form, by_factors)
        variance = _excess(self.slopes) * float(np.sum(by_factors * moved))
        by_gel = [
            np.sum(moved * np.einsum("ki,k->i", self.slopes.jacobian, slope / _SLOPE_ERROR**2))
            for slope in _gel_slopes(self.scene, self.slopes)
        ]
        # The stage deflects under the load as well: a larger compliance also reduces the depth.
        by_gel[1] -= gel.sigma.get("compliance", 0.0) * pressed.load * float(gradient.sum())
        return math.sqrt(variance), np.array(by_gel, np.float64)


class _Scene(NamedTuple):
    """The data of a fit: a press, averaged over cells."""

    cells: Cells
    height: Doubles  # mean of a cell's lit pixels, mm; NaN without
    sampled: Mask  # lit cells that are fitted, evenly spread
    dark: Mask  # cells that never turned light
    surface: Mask  # cells that may contain the object
    x: Doubles  # centres of columns, mm
    y: Doubles  # centres of rows, mm
    space: HalfSpace
    splines: CellSplines
    travel: Doubles  # at which the press is simulated, mm
    gel: Gel


def _scene_of(
    heights: Doubles, status: NDArray[Any], size: tuple[float, float], gel: Gel, deepest: float | None
) -> _Scene:
    """Average a press over cells, and choose the cells and the travels of the simulation."""
    lit = np.isfinite(heights)
    if not lit.any():
        raise NotConverged("nothing turned light")
    cells = split_into_cells(lit, size)
    means = cells.means(heights)
    onsets = -means[np.isfinite(means)]
    if len(onsets) < _MIN_CELLS:
        raise NotConverged(
            f"{len(onsets)} cells of the picture turned light, too little for a surface:"
            f" {_MIN_CELLS} are needed"
        )
    dark = cells.share(status == PressStatus.NEVER_LIGHT) == 1
    hidden = cells.inside(cells.share(status == PressStatus.LIGHT_AT_START)) >= 0.5
    surface = cells.outward(touched(cells.inside(means), cells.inside(dark), hidden))
    last = max(float(onsets.max()), -math.inf if deepest is None else deepest)
    travel = np.unique([*np.quantile(onsets, np.linspace(0, 1, _TRAVELS)), last])
    spacing = size[1] * cells.block[0], size[0] * cells.block[1]
    rows, columns = (axis * step for axis, step in zip(cells.centres(), spacing, strict=True))
    x, y = pixel_axes(heights.shape, size)
    left, top = x[0] - size[0] / 2, y[0] + size[1] / 2
    space, splines = HalfSpace(cells.shape, spacing[::-1]), CellSplines(cells.shape, spacing)
    row, column = np.indices(cells.shape)
    sampled = np.isfinite(means) & ((row + 2 * column) % math.ceil(len(onsets) / _SAMPLED) == 0)
    x, y = left + columns, top - rows
    return _Scene(cells, means, sampled, dark, surface, x, y, space, splines, travel, gel)


def _splines_on_pixels(scene: _Scene, shape: tuple[int, ...], factors: Doubles) -> Doubles:
    """Return the surface of splines at pixels, (H, W) mm; 0 outside the cells."""
    pixels = np.zeros(shape)
    pixels[scene.cells.box] = scene.splines.at(factors, *scene.cells.places(shape))
    return pixels


def _on_pixels(scene: _Scene, shape: tuple[int, ...], values: Doubles) -> Doubles:
    pixels = np.zeros(shape)
    at = np.stack(np.meshgrid(*scene.cells.places(shape), indexing="ij"))
    pixels[scene.cells.box] = ndimage.map_coordinates(values, at, order=1, mode="nearest")
    return pixels


def _interpolate(scene: _Scene, heights: Doubles) -> Doubles:
    """Return the factors of a smooth surface through heights of cells, which are NaN where it is free."""
    fixed = np.isfinite(heights).ravel()
    basis = scene.splines.basis[fixed]
    form = (basis.T @ basis).toarray() / _INITIAL_ERROR**2 + _stiffness(scene, _BENDING)
    return _solve(form, basis.T @ heights.ravel()[fixed] / _INITIAL_ERROR**2)


def _initial_surface(scene: _Scene) -> Doubles:
    """Return the factors of the initial surface: flat tops, and the reduced depths of eq. 3."""
    lit = np.isfinite(scene.height)
    row, column = ndimage.distance_transform_edt(~lit, return_distances=False, return_indices=True)
    top = float(scene.height[lit].max())
    heights = np.where(lit | scene.surface, scene.height[row, column], np.nan)
    return _interpolate(scene, top + _DEPTH * (heights - top))


def _stiffness(scene: _Scene, bending: float) -> Doubles:
    return scene.splines.roughness() / bending**2


def _solve(form: Doubles, values: Doubles) -> Doubles:
    """Solve a symmetric system without BLAS: for systems this small, its threads cost more than they save."""
    ridge = _RIDGE * float(np.trace(form)) / len(form)
    matrix = sparse.csc_matrix(form + ridge * np.eye(len(form)))
    return np.asarray(splu(matrix, permc_spec="NATURAL", options={"SymmetricMode": True}).solve(values))


def _fit_surface(scene: _Scene, factors: Doubles) -> _Surface:
    """Return the surface whose press explains the onsets."""
    lit = np.isfinite(scene.height)

    def shorten(step: Doubles) -> Doubles:
        return step / max(1.0, float(np.abs(scene.splines.surface(step)[lit]).max()) / _MAX_CHANGE)

    still = (scene.splines.basis.T @ scene.splines.basis).toarray() / _MAX_CHANGE**2
    surface = _Surface(scene, _stiffness(scene, _BENDING), None, factors)
    for number, (bending, steps, tolerance) in enumerate(_STAGES):
        surface = least_squares.descend(
            functools.partial(_Surface, scene, _stiffness(scene, bending), surface),
            surface.parameters,
            shorten=shorten,
            damping=least_squares.Damping(_RELAXED**-number, _RELAXED, _STUCK, still),
            tolerance=tolerance,
            steps=steps,
            solve=_solve,
        )
    misfit = float(np.median(np.abs(surface.slopes.residual))) if surface.slopes.residual.size else math.inf
    if misfit > _MISFIT:
        raise NotConverged(f"no surface explains when the pixels turned light: slopes differ by {misfit:.2g}")
    return surface


class _Surface:
    """Factors of a surface, with the cost of its slopes and its bending: a model of `least_squares`."""

    def __init__(
        self, scene: _Scene, stiffness: Doubles, before: _Surface | None, parameters: Doubles
    ) -> None:
        self.parameters: Doubles = parameters
        same = before if before is not None and before.parameters is parameters else None
        self.slopes: SlopeFit = _simulate(scene, parameters) if same is None else same.slopes
        self._stiffness, self._residual = stiffness, self.slopes.residual / _SLOPE_ERROR
        self._bend = np.einsum("ij,j->i", stiffness, parameters)
        self.cost: float = _LOSS.cost(self._residual) + float(np.sum(parameters * self._bend))

    def equations(self) -> tuple[Doubles, Doubles]:
        """Return the matrix and the right side of the next step's normal equations."""
        jacobian, weights = self.slopes.jacobian / _SLOPE_ERROR, _LOSS.weights(self._residual)
        form = np.einsum("ki,k,kj->ij", jacobian, weights, jacobian) + self._stiffness
        return form, np.einsum("ki,k->i", jacobian, weights * self._residual) - self._bend


def _simulate(scene: _Scene, factors: Doubles) -> SlopeFit:
    """Press a surface, and compare the sheet's slope with the threshold's when cells turned light.

    Dark cells of the surface are flat tops; they add residuals where they are steeper than the threshold.
    """
    height = scene.splines.surface(factors)
    down, across = (part @ factors for part in scene.splines.slopes)
    azimuth = np.arctan2(down, -across).reshape(height.shape)
    limit = np.tan(threshold_at(scene.gel, scene.x[np.newaxis], scene.y[:, np.newaxis], azimuth))
    targets = Targets(np.where(scene.sampled, -scene.height, np.nan), scene.dark & ~scene.surface, limit)
    surface = np.where(scene.surface, height, np.nan)
    fit = sweep(scene.space, surface, scene.splines.basis, scene.travel, targets, scene.gel.compliance)
    steep, limit = np.hypot(down, across), limit.ravel()
    cell = np.flatnonzero((scene.dark & scene.surface).ravel() & (steep > limit))
    along_y, along_x = (sparse.diags_array(part[cell] / steep[cell]) for part in (down, across))
    slopes = along_y @ scene.splines.slopes[0][cell] + along_x @ scene.splines.slopes[1][cell]
    zeros = np.zeros(len(cell))
    return SlopeFit(
        np.append(fit.residual, (limit - steep)[cell]),
        np.concatenate([fit.jacobian, slopes.toarray()]),
        np.append(fit.by_travel, zeros),
        np.append(fit.load, zeros),
        np.append(fit.cell, cell),
        fit.contact,
    )


def _variances(scene: _Scene, fit: SlopeFit, form: Doubles) -> Doubles:
    """Return the variance of the surface at each cell, mm^2, from the fit and from the gel's parameters."""
    covariance = _solve(form, np.eye(len(form)))
    basis = scene.splines.basis
    variance = _excess(fit) * np.asarray(basis.multiply(basis @ covariance).sum(axis=1)).ravel()
    for slope in _gel_slopes(scene, fit):
        pull = np.einsum("ki,k->i", fit.jacobian, slope / _SLOPE_ERROR**2)
        moved = basis @ np.einsum("ij,j->i", covariance, pull)
        variance += moved**2
    return variance.reshape(scene.cells.shape)


def _excess(fit: SlopeFit) -> float:
    """Return the ratio of the observed to the expected variance of slopes, at least 1."""
    return max(1.0, (mad_sigma(fit.residual) / _SLOPE_ERROR) ** 2)


def _gel_slopes(scene: _Scene, fit: SlopeFit) -> list[Doubles]:
    """Return the changes of slope residuals by one standard error of each of the gel's parameters."""
    gel, sigma = scene.gel, scene.gel.sigma
    slope = math.tan(gel.threshold)
    threshold = np.full(fit.residual.shape, (1 + slope**2) * sigma.get("threshold", 0.0))
    compliance = fit.by_travel * fit.load * sigma.get("compliance", 0.0)
    r = np.hypot(*np.meshgrid(scene.x - gel.axis[0], scene.y - gel.axis[1])).ravel()[fit.cell]
    curvature = slope * r * sigma.get("curvature", 0.0)
    return [threshold, compliance, curvature]
