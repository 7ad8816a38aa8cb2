"""Heights of a press corrected for the elastomer: it touches later than eq. 3 has it, and is light before."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage, sparse
from scipy.sparse.linalg import splu

from mirrorskin.engine.errors import NotConverged
from mirrorskin.engine.integration.validation import check_pixel_size
from mirrorskin.engine.press.halfspace import HalfSpace, SlopeFit, Targets, sweep
from mirrorskin.engine.press.spline import spline_products, spline_values
from mirrorskin.io import Gel, InputError, Result, Source, pixel_axes

Doubles = NDArray[np.float64]
Mask = NDArray[np.bool_]

LEARNED_AT = 0.5
"""Share of the way from dark to bright that gels are learned with."""

_LIT, _DARK, _HIDDEN = 1, 2, 3  # of an onset's status
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
_CELLS = 32  # along a side of what turned light, were it square
_AROUND = 2  # cells beyond it
_MARGIN = 6  # cells beyond the picture's border, where the object goes on there
_SPLINES = 8  # along a side, were it square
_FEWEST_PIECES = 3
_SHARE = 0.5  # of a cell's pixels that must have turned light
_SMALL = 4  # cells of a gap that is no feature


@dataclass(frozen=True, slots=True, eq=False)
class Corrected:
    """Heights corrected for the elastomer.

    Attributes
    ----------
    height, sigma : ndarray, (H, W), float32
        Millimetres, and their standard deviations, with the correction's own. NaN where a pixel turned light
        but was never touched, unless near the contact: farther off, only smoothness is known of the object.
    touched : ndarray, (H, W), bool
        What is in contact at the greatest travel.
    """

    height: NDArray[np.float32]
    sigma: NDArray[np.float32]
    touched: Mask


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
) -> tuple[Result, str]:
    """Correct the heights of a press or a release for the elastomer, where all is known that it takes.

    Parameters
    ----------
    result : Result
        With height, its sigma and status, not filled yet.
    source : Source
        With the pixels' size.
    deepest : float
        Greatest travel of the frames that it was made of, mm.
    threshold : float
        Share of the way from dark to bright that was taken for light: as of what the gel was learned from.
    gel : Gel or None

    Returns
    -------
    Result
    str
        What was done, for the process.
    """
    assert result.height is not None
    assert result.height_sigma is not None
    assert result.status is not None
    pixel_size = source.header.pixel_size
    if gel is None:
        return result, "none: the calibration has no gel"
    if pixel_size is None:
        return result, "none: the recording has no pixel size"
    if threshold != LEARNED_AT:
        return result, f"none: the gel was learned with a threshold of {LEARNED_AT}, not of {threshold:g}"
    try:
        maps = result.height, result.height_sigma, result.status
        corrected = correct_onset(*maps, pixel_size, gel, deepest=deepest)
    except NotConverged as error:
        return result, f"none: {error}"
    lost = np.count_nonzero((result.status == _LIT) & np.isnan(corrected.height))
    said = f"corrected for the gel; {lost} pixels turned light too far from the touch"
    return replace(result, height=corrected.height, height_sigma=corrected.sigma), said


def correct_onset(
    height: ArrayLike,
    sigma: ArrayLike,
    status: ArrayLike,
    pixel_size: ArrayLike,
    gel: Gel,
    *,
    deepest: float | None = None,
) -> Corrected:
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
    Corrected

    Raises
    ------
    mirrorskin.engine.NotConverged
        Too little turned light, or no surface explains it.
    mirrorskin.io.InputError
        Maps or sizes that cannot be used.
    """
    scene = _scene_of(_maps(height, sigma, status), check_pixel_size(pixel_size), gel, deepest)
    smooth = _interpolate(scene, scene.height)
    factors, fit, form = _fit_surface(scene, _first_guess(scene))
    here, whole = (int(np.sum(part)) for part in (scene.cells.inside(fit.contact), fit.contact))
    if whole - here > _BEYOND * whole:
        raise NotConverged("much of what touches lies beyond the picture")
    change, spread, touching = _on_pixels(scene, factors - smooth, _variances(scene, fit, form), fit.contact)
    maps, own = scene.maps, spread + (_SHARE_LEFT * change) ** 2 + gel.error**2
    known = np.isfinite(maps.height) & (touching | (own <= _FARTHEST**2))
    heights = np.where(known, maps.height + change, np.nan)
    sigmas = np.where(known, np.sqrt(maps.sigma**2 + own), np.nan)
    return Corrected(heights.astype(np.float32), sigmas.astype(np.float32), touching)


class _Maps(NamedTuple):
    """Pixels: heights where they turned light, NaN elsewhere; their standard deviations, and all status."""

    height: Doubles
    sigma: Doubles
    status: NDArray[Any]


class _Scene(NamedTuple):
    """A press as the search for its surface sees it."""

    maps: _Maps
    cells: Cells
    height: Doubles  # of cells that turned light
    sampled: Mask  # some of these, all over
    dark: Mask  # cells that never did
    surface: Mask  # cells that there may be something in
    x: Doubles
    y: Doubles
    space: HalfSpace
    splines: Splines
    travel: Doubles
    gel: Gel


def _scene_of(maps: _Maps, size: tuple[float, float], gel: Gel, deepest: float | None) -> _Scene:
    """Prepare the search: cells, what may touch in them, and when to look."""
    known = np.isfinite(maps.height)
    if not known.any():
        raise NotConverged("nothing turned light")
    cells = cut_into_cells(known, size)
    means = cells.means(maps.height)
    onsets = -means[np.isfinite(means)]
    if len(onsets) < _FEWEST:
        raise NotConverged(
            f"light in {len(onsets)} places is too little to determine a surface: {_FEWEST} are needed"
        )
    dark = cells.share(maps.status == _DARK) == 1
    hidden = cells.inside(cells.share(maps.status == _HIDDEN)) >= 0.5
    surface = cells.outward(touched(cells.inside(means), cells.inside(dark), hidden))
    last = max(float(onsets.max()), -math.inf if deepest is None else deepest)
    travel = np.unique([*np.quantile(onsets, np.linspace(0, 1, _TRAVELS)), last])
    spacing = size[1] * cells.block[0], size[0] * cells.block[1]
    rows, columns = (axis * step for axis, step in zip(cells.centres(), spacing, strict=True))
    x, y = pixel_axes(maps.height.shape, size)
    left, top = x[0] - size[0] / 2, y[0] + size[1] / 2
    space, splines = HalfSpace(cells.shape, spacing[::-1]), Splines(cells.shape, spacing)
    row, column = np.indices(cells.shape)
    looked = np.isfinite(means) & ((row + 2 * column) % math.ceil(len(onsets) / _SAMPLED) == 0)
    return _Scene(
        maps, cells, means, looked, dark, surface, left + columns, top - rows, space, splines, travel, gel
    )


def _maps(height: ArrayLike, sigma: ArrayLike, status: ArrayLike) -> _Maps:
    state, heights = np.asarray(status), np.asarray(height, np.float64)
    sigmas = np.asarray(sigma, np.float64)
    if heights.ndim != 2 or 0 in heights.shape:
        raise InputError(f"heights have shape {heights.shape}: one map (H, W) is needed")
    if state.shape != heights.shape or sigmas.shape not in ((), heights.shape):
        raise InputError(
            f"sigma {sigmas.shape} and status {state.shape} do not fit heights of shape {heights.shape}:"
            " give one a pixel"
        )
    return _Maps(np.where(state == _LIT, heights, np.nan), sigmas, state)


def _on_pixels(
    scene: _Scene, factors: Doubles, variances: Doubles, contact: Mask
) -> tuple[Doubles, Doubles, Mask]:
    """Return for each pixel a surface's height, the variance, and whether there is contact; 0 elsewhere."""
    shape, box = scene.maps.height.shape, scene.cells.box
    rows, columns = scene.cells.places(shape)
    at = np.stack(np.meshgrid(rows, columns, indexing="ij"))
    height, spread, touching = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    height[box] = scene.splines.at(factors, rows, columns)
    spread[box] = ndimage.map_coordinates(variances, at, order=1, mode="nearest")
    touching[box] = ndimage.map_coordinates(1.0 * contact, at, order=1, mode="nearest")
    return height, spread, touching >= 0.5


def _interpolate(scene: _Scene, heights: Doubles) -> Doubles:
    """Return the factors of a smooth surface through heights of cells, NaN where it is free."""
    known = np.isfinite(heights).ravel()
    basis = scene.splines.basis[known]
    form = (basis.T @ basis).toarray() / _KNOWN**2 + _stiffness(scene, _BENDING[-1])
    return _solve(form, basis.T @ heights.ravel()[known] / _KNOWN**2)


def _first_guess(scene: _Scene) -> Doubles:
    """Return the factors of a surface to begin with: flat tops, and depths nearer to those of the touch."""
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
    usual = 1.4826 * float(np.median(np.abs(fit.residual)))
    worse = max(1.0, (usual / _SLOPE_ERROR) ** 2)
    variance = worse * np.asarray(basis.multiply(basis @ covariance).sum(axis=1)).ravel()
    for slope in _gel_slopes(scene, fit):
        pull = np.einsum("ki,k->i", fit.jacobian, slope / _SLOPE_ERROR**2)
        moved = basis @ np.einsum("ij,j->i", covariance, pull)
        variance += moved**2
    return variance.reshape(scene.cells.shape)


def _gel_slopes(scene: _Scene, fit: SlopeFit) -> list[Doubles]:
    """Return by how much a standard error of each of the gel's numbers changes what slopes are missing."""
    gel, sigma = scene.gel, scene.gel.sigma
    slope = math.tan(gel.threshold)
    threshold = np.full(fit.residual.shape, (1 + slope**2) * sigma.get("threshold", 0.0))
    compliance = fit.by_travel * fit.load * sigma.get("compliance", 0.0)
    r = np.hypot(*np.meshgrid(scene.x - gel.axis[0], scene.y - gel.axis[1])).ravel()[fit.cell]
    curvature = slope * r * sigma.get("curvature", 0.0)
    return [threshold, compliance, curvature]


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """Blocks of pixels in the part of the picture that turned light, and a margin.

    Attributes
    ----------
    box : (slice, slice)
        The picture's rows and columns that are in cells.
    block : (int, int)
        A cell's rows and columns of pixels.
    before : (int, int)
        Cells above the box, and to its left, that lie beyond the picture.
    shape : (int, int)
        Rows and columns of cells, with those beyond the picture.
    """

    box: tuple[slice, slice]
    block: tuple[int, int]
    before: tuple[int, int]
    shape: tuple[int, int]

    def means(self, values: Doubles) -> Doubles:
        """Return the mean of each cell's finite pixels, NaN where less than half are finite."""
        blocks = self._blocks(values)
        finite = np.isfinite(blocks)
        count = finite.sum(axis=(1, 3))
        sums = np.where(finite, blocks, 0.0).sum(axis=(1, 3))
        enough = count >= max(1.0, _SHARE * self.block[0] * self.block[1])
        return self._with_margin(np.where(enough, sums / np.maximum(count, 1), np.nan))

    def share(self, mask: Mask) -> Doubles:
        """Return which share of each cell's pixels is True."""
        return self._with_margin(self._blocks(mask.astype(np.float64), 0.0).mean(axis=(1, 3)))

    def places(self, shape: tuple[int, int]) -> tuple[Doubles, Doubles]:
        """Return where the box's rows and columns of pixels lie, in cells from the first's centre."""
        rows, columns = (
            (np.arange(some.start, min(some.stop, size)) - some.start + 0.5) / block - 0.5 + before
            for some, size, block, before in zip(self.box, shape, self.block, self.before, strict=True)
        )
        return rows, columns

    def centres(self) -> tuple[Doubles, Doubles]:
        """Return how far rows and columns of cells lie from the picture's upper left corner, in cells."""
        rows, columns = (
            some.start / block + np.arange(count) - before + 0.5
            for some, block, count, before in zip(self.box, self.block, self.shape, self.before, strict=True)
        )
        return rows, columns

    def inside(self, values: NDArray[Any]) -> NDArray[Any]:
        """Cut off the cells beyond the picture."""
        (top, bottom), (left, right) = self._margins
        return values[top : self.shape[0] - bottom, left : self.shape[1] - right]

    def outward(self, mask: Mask) -> Mask:
        """Go on beyond the picture with what a map of the cells inside has at its border."""
        return np.pad(mask, self._margins, "edge")

    @property
    def _margins(self) -> list[tuple[int, int]]:
        """Cells beyond the picture, before and behind it."""
        return [
            (ahead, count - ahead - (some.stop - some.start) // block)
            for some, block, ahead, count in zip(self.box, self.block, self.before, self.shape, strict=True)
        ]

    def _blocks(self, values: Doubles, beyond: float = np.nan) -> Doubles:
        """Return the box's pixels as (rows of cells, rows, columns of cells, columns)."""
        (rows, columns), (down, across) = (some.stop - some.start for some in self.box), self.block
        part = values[self.box]
        missing = (0, rows - part.shape[0]), (0, columns - part.shape[1])
        full = np.pad(part, missing, constant_values=beyond)
        return full.reshape(rows // down, down, columns // across, across)

    def _with_margin(self, values: Doubles) -> Doubles:
        return np.pad(values, self._margins, constant_values=np.nan)


def cut_into_cells(known: Mask, pixel_size: tuple[float, float]) -> Cells:
    """Cut what is known of a picture into cells that are about square; something must be known."""
    spacing = pixel_size[1], pixel_size[0]
    ends = [np.flatnonzero(known.any(axis=axis))[[0, -1]] for axis in (1, 0)]
    spans = [(last - first + 1) * step for (first, last), step in zip(ends, spacing, strict=True)]
    cell = math.sqrt(spans[0] * spans[1]) / _CELLS
    box, block, before, shape = [], [], [], []
    for (first, last), step, size in zip(ends, spacing, known.shape, strict=True):
        pixels = max(1, round(cell / step))
        start = max(0, first - _AROUND * pixels)
        count = math.ceil((min(size, last + 1 + _AROUND * pixels) - start) / pixels)
        ahead = _MARGIN if first == 0 else 0
        behind = _MARGIN if last == size - 1 else 0
        box.append(slice(int(start), int(start + count * pixels)))
        block.append(pixels)
        before.append(ahead)
        shape.append(count + ahead + behind)
    return Cells((box[0], box[1]), (block[0], block[1]), (before[0], before[1]), (shape[0], shape[1]))


class Splines:
    """Cubic splines over cells, from the first one's centre to the last one's.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of cells, 2 or more of each.
    spacing : (float, float)
        Distance of rows, and of columns, mm.

    Attributes
    ----------
    basis : csr_matrix, (H W, m)
        The splines at the cells.
    slopes : (csr_matrix, csr_matrix)
        Their derivatives down the picture and across it, 1/mm.
    """

    def __init__(self, shape: tuple[int, int], spacing: tuple[float, float]) -> None:
        self._shape = shape
        self._spans = [(count - 1) * step for count, step in zip(shape, spacing, strict=True)]
        size = math.sqrt(self._spans[0] * self._spans[1]) / _SPLINES
        self._pieces = [
            max(_FEWEST_PIECES, min(round(span / size), count // 2))
            for span, count in zip(self._spans, shape, strict=True)
        ]
        (y, down), (x, across) = (
            [self._values(np.arange(float(count)), axis, order) for order in (0, 1)]
            for axis, count in enumerate(shape)
        )
        self.basis = sparse.csr_matrix(sparse.kron(y, x))
        self.slopes = sparse.csr_matrix(sparse.kron(down, x)), sparse.csr_matrix(sparse.kron(y, across))

    def surface(self, factors: Doubles) -> Doubles:
        """Return a surface at the cells, (H, W), mm."""
        return np.asarray((self.basis @ factors).reshape(self._shape))

    def at(self, factors: Doubles, rows: Doubles, columns: Doubles) -> Doubles:
        """Return a surface on rows and columns that lie at places between the cells."""
        grid = factors.reshape(self._pieces[0] + 3, -1)
        return np.asarray((self._values(rows, 0) @ grid) @ self._values(columns, 1).T)

    def roughness(self) -> Doubles:
        """Return the form of the mean squared third derivatives, in all directions alike, 1/mm^4."""
        along = [
            [spline_products(count, order) * (count / span) ** (2 * order - 1) for order in range(4)]
            for count, span in zip(self._pieces, self._spans, strict=True)
        ]
        parts = [math.comb(3, order) * np.kron(along[0][order], along[1][3 - order]) for order in range(4)]
        return np.asarray(np.sum(parts, axis=0) / (self._spans[0] * self._spans[1]))

    def _values(self, places: Doubles, axis: int, order: int = 0) -> sparse.csr_matrix:
        """Return an axis' splines, or their derivatives, 1/mm, at places in cells."""
        count, pieces = self._shape[axis], self._pieces[axis]
        values = spline_values(places * pieces / (count - 1), pieces, order)
        return sparse.csr_matrix(values * (pieces / self._spans[axis]) ** order)


def touched(height: Doubles, dark: Mask, hidden: Mask) -> Mask:
    """Return which cells belong to the object's surface, by how the sheet around dark ones lies.

    Dark cells are part of it if what is around them rises towards them, as to a flat top; if it falls, they
    are the sheet that nothing touches. Small gaps are part of it, and cells that were light before the first
    frame.
    """
    lit = np.isfinite(height)
    surface = lit | hidden
    groups, count = ndimage.label(~surface)
    sizes = np.bincount(groups.ravel(), minlength=count + 1)
    for number in range(1, count + 1):
        own = groups == number
        if sizes[number] <= _SMALL or (np.any(own & dark) and _rises_to(own, height)):
            surface |= own
    return surface


def _rises_to(own: Mask, height: Doubles) -> bool:
    """Tell whether the cells around some are higher than those a little farther off."""
    square = np.ones((3, 3), bool)
    near = ndimage.binary_dilation(own, square)
    far = ndimage.binary_dilation(own, square, iterations=3)
    lit = np.isfinite(height)
    rim, ring = height[near & lit], height[far & ~near & lit]
    return bool(rim.size and ring.size and rim.mean() > ring.mean())
