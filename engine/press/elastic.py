"""Heights of a press corrected for the elastomer: contact comes later than in eq. 3, light before contact."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage, sparse
from scipy.sparse.linalg import splu

from mirrorskin.engine.errors import NotConverged
from mirrorskin.engine.integration.validation import check_pixel_size
from mirrorskin.engine.press.cells import Cells, cut_into_cells, touched
from mirrorskin.engine.press.halfspace import (
    HalfSpace,
    Pressed,
    SlopeFit,
    Targets,
    load_gradient,
    press,
    sweep,
)
from mirrorskin.engine.press.spline import CellSplines
from mirrorskin.io import Gel, InputError, Result, Source, pixel_axes
from mirrorskin.io.maps import PressStatus

Doubles = NDArray[np.float64]
Mask = NDArray[np.bool_]

LEARNED_AT = 0.5
"""Share of the way from dark to bright that gels are learned with."""

_FEWEST = 12  # cells that must have turned light
_SAMPLED = 250  # cells whose onsets are used; more add nothing to so few splines
_TRAVELS = 16  # at which the press is gone through
# Third derivatives that surfaces usually have, 1/mm^2, in the first steps; the last from there on.
_BENDING = 0.1, 0.1, 0.3, 1.0
_MOST_ROUNDS = 14
_DAMPING, _STUCK = 1.0, 1e3  # at first, in units of steps; beyond the second nothing moves any more
_STEP = 0.3  # mm that the surface may move in a round
_SETTLED = 0.9  # of the cost of the round before: no better is good enough
_SLOPE_ERROR = 0.006  # of the sheet, as cells so large resolve it
_ROBUST = 2.0  # errors beyond which a cell counts less
_MISFIT = 0.08  # median error of the slope beyond which the surface explains nothing
_DEPTH = 0.6  # of a depth by eq. 3: half of it on a paraboloid, more on what is steeper
_KNOWN = 0.01  # mm, of the heights that a first surface goes through
_BEYOND = 0.3  # of the touch that may lie beyond the picture, where the object is a guess
_SHARE_LEFT = 0.02  # of a change that is left, as the cells are coarse
_FARTHEST = 0.05  # mm, standard deviation up to which heights beyond the contact are kept
_RIDGE = 1e-12


def threshold_at(gel: Gel, x: ArrayLike, y: ArrayLike, azimuth: ArrayLike) -> Doubles:
    """Return the zenith that turns a pixel light.

    Seen along the axis, a mirror of zenith t shows what lies 2 t off it. Towards the azimuth the wall, of
    radius R about the axis, is ``way`` off the pixel, and its rim is as high everywhere ::

        tan 2t = way / R tan 2t0,    way = (R^2 - r^2) / (b + sqrt(b^2 + R^2 - r^2))

    with r the pixel's distance from the axis, b that along the azimuth, and t0 the threshold on the axis.

    Parameters
    ----------
    gel : Gel
    x, y : array_like
        Place, mm.
    azimuth : array_like
        Of the sheet's normal, radians.

    Returns
    -------
    ndarray, float64
        Radians, shaped as the arguments broadcast; NaN outside the wall.
    """
    across = gel.curvature * (np.asarray(x, np.float64) - gel.axis[0])
    up = gel.curvature * (np.asarray(y, np.float64) - gel.axis[1])
    room = 1 - across**2 - up**2
    along = across * np.cos(azimuth) + up * np.sin(azimuth)
    room = np.where(room > 0, room, np.nan)
    way = room / (along + np.sqrt(along**2 + room))
    return np.asarray(np.arctan(way * math.tan(2 * gel.threshold)) / 2)


def correct_press(
    result: Result,
    source: Source,
    deepest: float,
    threshold: float,
    gel: Gel | None,
) -> tuple[Result, str, PressFit | None]:
    """Correct the heights of a press or a release for the elastomer, where all is known that it takes.

    Heights are not filled yet; ``deepest`` is the greatest travel of their frames, mm, and ``threshold``
    what was taken for light, as a share from dark to bright. The text says what was done, for the process;
    without a correction there is no fit.
    """
    assert result.height is not None
    assert result.height_sigma is not None
    assert result.status is not None
    pixel_size = source.header.pixel_size
    if gel is None:
        return result, "none: the calibration has no gel", None
    if pixel_size is None:
        return result, "none: the recording has no pixel size", None
    if threshold != LEARNED_AT:
        said = f"none: the gel was learned with a threshold of {LEARNED_AT}, not of {threshold:g}"
        return result, said, None
    try:
        maps = result.height, result.height_sigma, result.status
        fit = fit_press(*maps, pixel_size, gel, deepest=deepest)
    except NotConverged as error:
        return result, f"none: {error}", None
    lost = np.count_nonzero((result.status == PressStatus.ONSET) & np.isnan(fit.height))
    said = f"corrected for the gel; {lost} pixels turned light too far from the touch"
    return result.assign(height=fit.height, height_sigma=fit.sigma), said, fit


def correct_onset(
    height: ArrayLike,
    sigma: ArrayLike,
    status: ArrayLike,
    pixel_size: ArrayLike,
    gel: Gel,
    *,
    deepest: float | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Correct heights by eq. 3 for an elastomer that gives way.

    Eq. 3 takes a pixel's travel at its onset for the object's depth there. An elastomer gives way around what
    it touches: a paraboloid touches at twice the depth; and the sheet around the contact is steep enough for
    light before it touches. So a smooth surface is fitted (cubic splines, no finer than an eighth of what
    turned light) whose press into an elastic half-space brings the sheet to the threshold's slope at each
    pixel's onset. It is found by damped Gauss-Newton steps, with third derivatives kept small, at first more
    than in the end. Its difference from a surface as smooth through the heights as given is added to these;
    so finer details stay as they were.

    Parameters
    ----------
    height, sigma : array_like, (H, W)
        As ``find_onset`` gives them, or those of a release: without friction the way does not matter.
    status : array_like, (H, W)
        0 invalid, 1 turned light, 2 never light, 3 light at start; 3 of a release means light to the end.
    pixel_size : float or (float, float)
        Millimetres, along x and y.
    gel : Gel
    deepest : float, optional
        Greatest travel, mm; by default that of the last onset.

    Returns
    -------
    height, sigma : ndarray, (H, W), float32
        Millimetres, and their standard deviations, with the correction's own. NaN where a pixel turned light
        but was never touched, unless near the contact: farther off, only smoothness is known of the object.

    Raises
    ------
    mirrorskin.engine.NotConverged
        Too little turned light, or no surface explains it.
    mirrorskin.io.InputError
        Maps or sizes that cannot be used.
    """
    fit = fit_press(height, sigma, status, pixel_size, gel, deepest=deepest)
    return fit.height, fit.sigma


def fit_press(
    height: ArrayLike,
    sigma: ArrayLike,
    status: ArrayLike,
    pixel_size: ArrayLike,
    gel: Gel,
    *,
    deepest: float | None = None,
) -> PressFit:
    """Find the surface whose press explains the onsets; see `correct_onset`."""
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
    factors, fit, form = _fit_surface(scene, _initial_surface(scene))
    here, everywhere = (int(np.sum(part)) for part in (scene.cells.inside(fit.contact), fit.contact))
    if everywhere - here > _BEYOND * everywhere:
        raise NotConverged("much of what touches lies beyond the picture")
    maps = factors - smooth, _variances(scene, fit, form), fit.contact
    change, variance, touching = _on_pixels(scene, heights.shape, *maps)
    own = variance + (_SHARE_LEFT * change) ** 2 + gel.error**2
    known = np.isfinite(heights) & (touching | (own <= _FARTHEST**2))
    heights = np.where(known, heights + change, np.nan)
    sigmas = np.where(known, np.sqrt(sigmas**2 + own), np.nan)
    return PressFit(heights.astype(np.float32), sigmas.astype(np.float32), scene, factors, fit, form)


class PressFit(NamedTuple):
    """A press that explains when pixels turned light: heights on pixels, and their surface of splines."""

    height: NDArray[np.float32]
    sigma: NDArray[np.float32]
    scene: _Scene
    factors: Doubles
    slopes: SlopeFit
    form: Doubles  # that the factors minimise: the inverse of their covariance

    def pressed(self) -> Pressed:
        """Return the press on the cells at the greatest travel."""
        surface = np.where(self.scene.surface, self.scene.splines.surface(self.factors), np.nan)
        return press(self.scene.space, surface + self.scene.travel[-1], self.scene.gel.compliance)

    def on_pixels(self, values: Doubles) -> Doubles:
        """Return a map of the cells on the pixels, 0 beyond them."""
        return _interpolated(self.scene, self.height.shape, values)

    def load_errors(self, pressed: Pressed) -> tuple[float, Doubles]:
        """Return the load's standard error by the fit, and its changes by those of the gel's numbers, mm^2.

        The changes, (3,), are by a standard error of threshold, compliance and curvature.
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
        # The stage gives way by the load, too: more compliance also takes from the depth.
        by_gel[1] -= gel.sigma.get("compliance", 0.0) * pressed.load * float(gradient.sum())
        return math.sqrt(variance), np.array(by_gel, np.float64)


class _Scene(NamedTuple):
    """A press as the search for its surface sees it."""

    cells: Cells
    height: Doubles  # of cells that turned light
    sampled: Mask  # some of these, all over
    dark: Mask  # cells that never did
    surface: Mask  # cells that there may be something in
    x: Doubles
    y: Doubles
    space: HalfSpace
    splines: CellSplines
    travel: Doubles
    gel: Gel


def _scene_of(
    heights: Doubles, status: NDArray[Any], size: tuple[float, float], gel: Gel, deepest: float | None
) -> _Scene:
    """Prepare the search: cells, what may touch in them, and when to look."""
    known = np.isfinite(heights)
    if not known.any():
        raise NotConverged("nothing turned light")
    cells = cut_into_cells(known, size)
    means = cells.means(heights)
    onsets = -means[np.isfinite(means)]
    if len(onsets) < _FEWEST:
        raise NotConverged(
            f"light in {len(onsets)} places is too little to determine a surface: {_FEWEST} are needed"
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
    looked = np.isfinite(means) & ((row + 2 * column) % math.ceil(len(onsets) / _SAMPLED) == 0)
    x, y = left + columns, top - rows
    return _Scene(cells, means, looked, dark, surface, x, y, space, splines, travel, gel)


def _on_pixels(
    scene: _Scene, shape: tuple[int, ...], factors: Doubles, variances: Doubles, contact: Mask
) -> tuple[Doubles, Doubles, Mask]:
    """Return for each pixel a surface's height, the variance, and whether there is contact; 0 elsewhere."""
    height = np.zeros(shape)
    height[scene.cells.box] = scene.splines.at(factors, *scene.cells.places(shape))
    touching = _interpolated(scene, shape, contact.astype(np.float64))
    return height, _interpolated(scene, shape, variances), touching >= 0.5


def _interpolated(scene: _Scene, shape: tuple[int, ...], values: Doubles) -> Doubles:
    """Return a map of the cells on the pixels, 0 beyond them."""
    found = np.zeros(shape)
    at = np.stack(np.meshgrid(*scene.cells.places(shape), indexing="ij"))
    found[scene.cells.box] = ndimage.map_coordinates(values, at, order=1, mode="nearest")
    return found


def _interpolate(scene: _Scene, heights: Doubles) -> Doubles:
    """Return the factors of a smooth surface through heights of cells, NaN where it is free."""
    known = np.isfinite(heights).ravel()
    basis = scene.splines.basis[known]
    form = (basis.T @ basis).toarray() / _KNOWN**2 + _stiffness(scene, _BENDING[-1])
    return _solve(form, basis.T @ heights.ravel()[known] / _KNOWN**2)


def _initial_surface(scene: _Scene) -> Doubles:
    """Return the factors of the initial surface: flat tops, and depths nearer to those of the contact."""
    lit = np.isfinite(scene.height)
    row, column = ndimage.distance_transform_edt(~lit, return_distances=False, return_indices=True)
    top = float(scene.height[lit].max())
    known = np.where(lit | scene.surface, scene.height[row, column], np.nan)
    return _interpolate(scene, top + _DEPTH * (known - top))


def _stiffness(scene: _Scene, bending: float) -> Doubles:
    return scene.splines.roughness() / bending**2


def _solve(form: Doubles, values: Doubles) -> Doubles:
    """Solve without BLAS, whose threads wait for each other longer than so little takes."""
    ridge = _RIDGE * float(np.trace(form)) / len(form)
    matrix = sparse.csc_matrix(form + ridge * np.eye(len(form)))
    return np.asarray(splu(matrix, permc_spec="NATURAL", options={"SymmetricMode": True}).solve(values))


def _fit_surface(scene: _Scene, factors: Doubles) -> tuple[Doubles, SlopeFit, Doubles]:
    """Return the surface's factors, what it would have shown, and the form that they minimise.

    Gauss and Newton's steps are damped, more after one that has made things worse (Levenberg).
    """
    lit, damping, accepted = np.isfinite(scene.height), _DAMPING, 0
    still = (scene.splines.basis.T @ scene.splines.basis).toarray() / _STEP**2
    fit = _simulate(scene, factors)
    for _ in range(_MOST_ROUNDS):
        stiffness = _stiffness(scene, _BENDING[min(accepted, len(_BENDING) - 1)])
        form, pull = _normal_equations(fit, stiffness, factors)
        step = _solve(form + damping * still, pull)
        moved = float(np.abs(scene.splines.surface(step)[lit]).max())
        tried = factors + step * min(1.0, _STEP / max(moved, _STEP))
        shown, before = _simulate(scene, tried), _cost(fit, stiffness, factors)
        after = _cost(shown, stiffness, tried)
        if after >= before:
            if damping > _STUCK:
                break
            damping *= 10
            continue
        factors, fit, accepted, damping = tried, shown, accepted + 1, damping / 3
        if accepted > len(_BENDING) and after > _SETTLED * before:
            break
    misfit = float(np.median(np.abs(fit.residual))) if fit.residual.size else math.inf
    if misfit > _MISFIT:
        raise NotConverged(f"no surface explains when the pixels turned light: slopes differ by {misfit:.2g}")
    return factors, fit, _normal_equations(fit, _stiffness(scene, _BENDING[-1]), factors)[0]


def _normal_equations(fit: SlopeFit, stiffness: Doubles, factors: Doubles) -> tuple[Doubles, Doubles]:
    """Return the normal equations of the next step: form and right side."""
    weights = np.minimum(1.0, _ROBUST * _SLOPE_ERROR / np.maximum(np.abs(fit.residual), _RIDGE))
    weights /= _SLOPE_ERROR**2
    form = np.einsum("ki,k,kj->ij", fit.jacobian, weights, fit.jacobian) + stiffness
    bend = np.einsum("ij,j->i", stiffness, factors)
    return form, np.einsum("ki,k->i", fit.jacobian, weights * fit.residual) - bend


def _cost(fit: SlopeFit, stiffness: Doubles, factors: Doubles) -> float:
    """Return what a surface costs: residual slopes, by Huber's measure, and bending."""
    wrong = np.abs(fit.residual) / _SLOPE_ERROR
    small = np.minimum(wrong, _ROBUST)
    bent = float(np.sum(factors * np.einsum("ij,j->i", stiffness, factors)))
    return float(np.sum(small * (2 * wrong - small))) + bent


def _simulate(scene: _Scene, factors: Doubles) -> SlopeFit:
    """Press a surface, and look when cells turned light."""
    height = scene.splines.surface(factors)
    down, across = (part @ factors for part in scene.splines.slopes)
    azimuth = np.arctan2(down, -across).reshape(height.shape)
    zenith = threshold_at(scene.gel, scene.x[np.newaxis], scene.y[:, np.newaxis], azimuth)
    targets = Targets(
        np.where(scene.sampled, -scene.height, np.nan), scene.dark & ~scene.surface, np.tan(zenith)
    )
    surface = np.where(scene.surface, height, np.nan)
    fit = sweep(scene.space, surface, scene.splines.basis, scene.travel, targets, scene.gel.compliance)
    return _with_flat_tops(scene, fit, targets.slope.ravel(), down, across)


def _with_flat_tops(scene: _Scene, fit: SlopeFit, limit: Doubles, down: Doubles, across: Doubles) -> SlopeFit:
    """Add the dark cells of the surface that are steeper than what is dark can be."""
    steep = np.hypot(down, across)
    cell = np.flatnonzero((scene.dark & scene.surface).ravel() & (steep > limit))
    along_y, along_x = (sparse.diags_array(part[cell] / steep[cell]) for part in (down, across))
    slopes = along_y @ scene.splines.slopes[0][cell] + along_x @ scene.splines.slopes[1][cell]
    nothing = np.zeros(len(cell))
    return SlopeFit(
        np.append(fit.residual, (limit - steep)[cell]),
        np.concatenate([fit.jacobian, slopes.toarray()]),
        np.append(fit.by_travel, nothing),
        np.append(fit.load, nothing),
        np.append(fit.cell, cell),
        fit.contact,
    )


def _variances(scene: _Scene, fit: SlopeFit, form: Doubles) -> Doubles:
    """Return the variance of the surface at each cell, mm^2: by the fit, and by what is known of the gel."""
    covariance = _solve(form, np.eye(len(form)))
    basis = scene.splines.basis
    variance = _excess(fit) * np.asarray(basis.multiply(basis @ covariance).sum(axis=1)).ravel()
    for slope in _gel_slopes(scene, fit):
        pull = np.einsum("ki,k->i", fit.jacobian, slope / _SLOPE_ERROR**2)
        moved = basis @ np.einsum("ij,j->i", covariance, pull)
        variance += moved**2
    return variance.reshape(scene.cells.shape)


def _excess(fit: SlopeFit) -> float:
    """Return by how much slopes scatter more than expected, as a factor of the variance from 1 on."""
    usual = 1.4826 * float(np.median(np.abs(fit.residual)))
    return max(1.0, (usual / _SLOPE_ERROR) ** 2)


def _gel_slopes(scene: _Scene, fit: SlopeFit) -> list[Doubles]:
    """Return by how much a standard error of each of the gel's numbers changes what slopes are missing."""
    gel, sigma = scene.gel, scene.gel.sigma
    slope = math.tan(gel.threshold)
    threshold = np.full(fit.residual.shape, (1 + slope**2) * sigma.get("threshold", 0.0))
    compliance = fit.by_travel * fit.load * sigma.get("compliance", 0.0)
    r = np.hypot(*np.meshgrid(scene.x - gel.axis[0], scene.y - gel.axis[1])).ravel()[fit.cell]
    curvature = slope * r * sigma.get("curvature", 0.0)
    return [threshold, compliance, curvature]
