"""Forces along a stream of results, at the rate of frames."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import cholesky, toeplitz

from mirrorskin.engine.base.inputs import Maps, as_result, pixel_size_of
from mirrorskin.engine.base.resample import fill_with_nearest
from mirrorskin.engine.force.halfspace import HalfSpace, Mask, Pressed, press, punches, window_of
from mirrorskin.engine.force.normal import UNCERTAIN, check_bounds, excess_load, modulus_of, surface_of
from mirrorskin.engine.force.tangential import MIN_COVERAGE, UP, ContactShear, last_displacement
from mirrorskin.engine.metrology.patch import noise_length
from mirrorskin.io import Fitted, InputError, Result, pixel_axes
from mirrorskin.io.base.arguments import check_count, check_number, checked, in_unit
from mirrorskin.io.base.findings import Finding, carried, in_process
from mirrorskin.io.base.threads import ThreadSafe
from mirrorskin.kernels.array_types import Doubles

Singles = NDArray[np.float32]
Window = tuple[slice, slice]

_TOLERANCE = 0.25  # gap in contact, standard deviations of the mean of a block
_LOOSE = 5e-4  # maximum gap in contact as a share of the maximum height; the load is corrected for it
_STALE = 0.05  # share of the contact that may change before gradients of the load are computed anew
_SAME_LOAD = 0.1  # relative change of the load after which its increase by noise is computed anew
_SHEAR_ERROR = 1e-3  # of displacements in contact under tractions that move it by 1
_MARGIN = 0.1  # of the window around a contact, as a share of the contact's length
_ROUND_ERROR, _SMALL_ERROR = 0.0065, 0.04  # relative error of the load; see `_border_error`
_CUT_ERROR = 0.17  # the same, if the object ends in the contact
_CENTRE_ERROR = 9.5  # error of the centre of pressure, blocks, over the relative error of the load
_SHEAR_MODEL = 0.03  # relative error of the tangential force, over the share of blocks at the border
_CENTRES = "pressure_centre_x", "pressure_centre_y"


class ForceTracker(ThreadSafe):
    """Computes forces and the centre of pressure of each result of a stream, on averaged maps.

    Maps are averaged over blocks of ``binning`` pixels a side. The solution of the result before is the
    initial guess: of the contact and its pressure, of the pressure under a flat punch of the contact's shape,
    which propagates errors of heights, and of the traction that displaces the contact by 1, which gives the
    tangential force. The models are those of `find_force` and `find_tangential_force`.

    Parameters
    ----------
    pixel_size : float or (float, float), optional
        Millimetres along x and y; by default that of the results.
    modulus : float, optional
        Young's modulus, MPa; by default that of the results' calibration.
    binning : int
        Side of the blocks, pixels.
    modulus_sigma : float
        Standard deviation of the modulus, MPa; by default that of the calibration if the modulus is.
    travel_sigma : float
        Standard deviation of the travel, or of an error common to all heights, mm.
    compliance : float
        Compliance of the stage times the modulus, 1/mm, as in `find_force`.
    window_size : int
        Side of the windows in which displacements were estimated, pixels; errors are correlated within it.

    Examples
    --------
    A paraboloid in silicone of 0.1 MPa moves to the right. Hertz's formula gives 0.078 N.

    >>> import numpy as np
    >>> x = 0.05 * np.arange(-64, 64) + 0.025
    >>> tracker = ForceTracker(0.05, modulus=0.1)
    >>> for centre in (0.1, 0.2, 0.3):
    ...     found = tracker.push(-((x - centre) ** 2 + x[:, np.newaxis] ** 2) / 6, travel=0.4)
    ...     print(round(found.force, 3), round(found.pressure_centre_x, 2))
    0.078 0.1
    0.078 0.2
    0.078 0.3
    """

    @checked(
        pixel_size=in_unit("mm"),
        modulus=in_unit("MPa", check_number),
        binning=check_count,
        modulus_sigma=in_unit("MPa", check_number),
        travel_sigma=in_unit("mm", check_number),
        compliance=check_number,
        window_size=check_count,
    )
    def __init__(
        self,
        pixel_size: ArrayLike | None = None,
        modulus: float | None = None,
        *,
        binning: int = 4,
        modulus_sigma: float = 0.0,
        travel_sigma: float = 0.0,
        compliance: float = 0.0,
        window_size: int = 1,
    ) -> None:
        self._pixel_size, self._modulus, self._modulus_sigma = pixel_size, modulus, modulus_sigma
        self._binning, self._window_size = binning, window_size
        self._travel_sigma, self._compliance = travel_sigma, compliance
        check_bounds(travel_sigma=travel_sigma, modulus_sigma=modulus_sigma, compliance=compliance)
        if binning < 1 or window_size < 1:
            raise InputError(f"binning {binning} and window_size {window_size}: give pixels, 1 or more")
        self._state: _State | None = None

    def push(self, maps: Maps, travel: float | None = None) -> Result:
        """Return the forces of the next result.

        Parameters
        ----------
        maps : Result, mapping, xarray.Dataset, path or array_like
            Height and its standard deviation, as for `find_force`; with a ``displacement``, (H, W, 2), also
            the tangential force, as of `find_tangential_force`.
        travel : float, optional
            Downward displacement of the body, mm; by default ``travel`` of the result's ``fitted``.

        Returns
        -------
        Result
            ``pressure``, MPa, and ``contact``, of the blocks; ``force``, N, and ``pressure_centre_x`` and
            ``pressure_centre_y``, mm, NaN if nothing touches; with a displacement of at least 80 % of the
            contact ``force_x`` and ``force_y``, N. Each has a standard deviation.

        Raises
        ------
        mirrorskin.io.InputError
            Maps that `find_force` refuses.
        mirrorskin.engine.NotConverged
            The contact was not found. The next result starts anew.
        """
        result = as_result(maps, "maps")
        surface, travel = surface_of(result, travel)
        size = pixel_size_of(result, "height", self._pixel_size)
        young, young_sigma = modulus_of(result, self._modulus, self._modulus_sigma)
        moved = None if result.displacement is None else last_displacement(result)
        if moved is not None and moved[0].shape[:2] != surface.shape:
            raise InputError(
                f"displacement has shape {moved[0].shape}, height {surface.shape}: one size is needed"
            )
        blocks = _Blocks((surface.shape[0], surface.shape[1]), size, self._binning)
        state, self._state = self._state, None  # after an error, the next result starts anew
        if state is None or state.blocks != blocks:
            state = _State(blocks, self._compliance)
        heights = blocks.at_centres(blocks.means(surface)) + np.float32(travel)
        errors = _Errors(result.height_sigma, blocks, *blocks.alike(noise_length(result)))
        state.press(heights, errors)
        axes, pressed, findings = blocks.axes(result), state.pressed, list[Finding]()
        numbers = dict.fromkeys(("force", *_CENTRES), (0.0, 0.0)) | dict.fromkeys(
            _CENTRES, (math.nan, math.nan)
        )
        along, covered = np.zeros((2, 2)), 1.0
        if pressed.load > 0:
            common = math.hypot(self._travel_sigma, result.fitted.height_common_sigma or 0.0)
            (load, load_sigma), *centres = _normal(state, errors, axes, common)
            numbers |= {"force": (young * load, young * load_sigma)} | dict(
                zip(_CENTRES, centres, strict=True)
            )
            if moved is not None:
                along, covered = _tangential(state, *moved, self._window_size)
            self._state = state
        if covered < MIN_COVERAGE:
            text = f"no tangential force: {covered:.0%} of the contact has a displacement"
            findings.append(Finding("no displacement", text))
        elif moved is not None:
            numbers |= zip(("force_x", "force_y"), young * along, strict=True)
        if any(edge.any() for edge in (*pressed.contact[[0, -1]], *pressed.contact[:, [0, -1]].T)):
            text = "the contact reaches the edge of the maps: forces lack what is outside"
            findings.append(Finding("contact at the edge", text))
        found: dict[str, Any] = {"contact": pressed.contact.astype(np.uint8), "pressure": pressed.strain}
        for name, (value, sigma) in numbers.items():
            by_modulus = 0.0 if name in _CENTRES else young_sigma / young * value
            found |= {name: float(value), f"{name}_sigma": math.hypot(sigma, by_modulus)}
        if pressed.load > 0:
            found["pressure"] = pressed.strain * np.float32(found["force"] / pressed.load)
        process = in_process(findings, {"modulus": float(young), **carried({}, result=result.process)})
        fitted = Fitted(travel=float(travel))
        return Result(
            found, x=axes[0], y=axes[1], process={"modulus": float(young), **process}, fitted=fitted
        )


class _State:
    """The solution of the last result, as an initial guess of the next one."""

    def __init__(self, blocks: _Blocks, compliance: float) -> None:
        self.blocks, self._compliance = blocks, compliance
        self.pressed: Pressed
        self.window: Window
        self.object: Mask  # blocks with a height
        self.inside: Mask  # blocks in the window that touch, with their four neighbours
        self._usual = 0.0  # standard deviation of a mean
        self.punches: Singles | None = None  # strains that move the contact by the forms of the blocks
        self.shears: Singles | None = None  # tractions that move the contact by 1 along x, and along rows
        self._punched = self.sheared = np.zeros(0, bool)  # the contacts of these
        self._start: Pressed | None = None
        self._load, self.excess = 0.0, 0.0  # a load, and its increase by noise, as a share of it

    def press(self, heights: Singles, errors: _Errors) -> None:
        """Find the contact, and its gradients if it has changed."""
        space, start = self.blocks.space, self._start
        self.object = np.isfinite(heights)
        tolerance = _LOOSE * float(np.max(heights, where=self.object, initial=0))
        if start is not None:
            tolerance = max(tolerance, _TOLERANCE * self._usual)
        self._start = self.pressed = pressed = press(space, heights, self._compliance, start, tolerance)
        if not pressed.load > 0:
            return
        contact = pressed.contact
        self.window, _ = window_of(space, contact, _MARGIN)
        self._usual, self.inside = errors.usual(self.window), _inside(contact[self.window])
        if self.punches is None or _changed(contact, self._punched) > _STALE:
            self.punches = punches(space, contact, self.blocks.forms, self._compliance, self.punches)
            self._punched = contact
        if abs(pressed.load - self._load) > _SAME_LOAD * self._load:
            drawn, gradient = errors.drawn(self.window), self.punches[0] * space.pixel_area
            excess = excess_load(space, heights, drawn, self._compliance, pressed, gradient)
            self._load, self.excess = pressed.load, excess / pressed.load

    def border_share(self) -> float:
        """Return the share of blocks in contact that are at its border."""
        return 1 - np.count_nonzero(self.inside) / np.count_nonzero(self.pressed.contact)

    def shear(self) -> Singles:
        """Return the tractions that move the contact by 1 along x, and along rows, in the window."""
        contact, place = self.pressed.contact, (..., *self.window)
        if self.shears is None or _changed(contact, self.sheared) > _STALE:
            system = ContactShear(contact[self.window], self.blocks.space.pixel_size, contact.shape)
            weights = system.weights(_SHEAR_ERROR, None if self.shears is None else self.shears[place])
            self.shears, self.sheared = np.zeros((2, 2, *contact.shape), np.float32), contact
            self.shears[place] = weights
        return self.shears[place]


def _changed(contact: Mask, before: Mask) -> float:
    """Return by how many pixels a contact differs from another, as a share of it."""
    return np.count_nonzero(contact ^ before) / np.count_nonzero(contact)


def _inside(mask: Mask) -> Mask:
    """Return where a mask and its four neighbours are set; those outside the map are not."""
    inside = np.zeros_like(mask)
    near = mask[2:, 1:-1] & mask[:-2, 1:-1] & mask[1:-1, 2:] & mask[1:-1, :-2]
    np.logical_and(mask[1:-1, 1:-1], near, out=inside[1:-1, 1:-1])
    return inside


def _border_error(state: _State) -> float:
    """Return the relative error of the load because blocks touch as a whole or not at all.

    It depends on the share of blocks at the border, and on how many of these are next to missing heights. It
    was measured on balls, cones, ellipsoids, pairs of balls, cylinders and punches, without noise.
    """
    contact, known = (mask[state.window] for mask in (state.pressed.contact, state.object))
    share, cut = state.border_share(), 0.0
    if not known.all():
        cut = np.count_nonzero(contact & ~_inside(known)) / np.count_nonzero(contact & ~state.inside)
    return (_ROUND_ERROR + _CUT_ERROR * cut) * share**2 + _SMALL_ERROR * share**6


def _normal(
    state: _State, errors: _Errors, axes: tuple[Doubles, Doubles], common: float
) -> list[tuple[float, float]]:
    """Return the load, mm^2, and the centre of pressure along x and y, mm, with their standard deviations.

    By Betti's reciprocity, the load changes with the heights by the strain under a flat punch, and moments of
    the pressure by that under a tilted one.
    """
    assert state.punches is not None
    blocks, pressed, window = state.blocks, state.pressed, state.window
    strain, left = pressed.strain[window].astype(np.float64), pressed.gap[window]
    area = blocks.space.pixel_area
    gradients = state.punches[(slice(None), *window)].astype(np.float64) * area
    total = pressed.load - np.sum(gradients * left, axis=(1, 2))[0]
    load, centre, size = total * (1 - state.excess), [], []
    for axis, scale, part in zip(axes, blocks.scales(axes), (1, 2), strict=True):
        lever = axis - axis.mean()
        profile, inside = area * strain.sum(axis=part - 1), lever[window[2 - part]]
        moment = float(profile @ inside)
        gradient = scale * gradients[part]
        middle = (moment - float(np.sum(gradient * left))) / total
        centre.append(middle + float(axis.mean()))
        size.append(math.sqrt(max(float(profile @ inside**2) / total - middle**2, 0.0)))
        gradients[part] = (gradient - middle * gradients[0]) / total
    weights: Doubles = blocks.at_centres(gradients)
    spread = np.hypot(np.sqrt(errors.variance(weights, window)), common * weights.sum(axis=(1, 2)))
    rough = _border_error(state)
    others = [load * math.hypot(rough, UNCERTAIN * state.excess)]
    for step, length in zip(blocks.space.pixel_size, size, strict=True):
        others.append(rough * math.hypot(_CENTRE_ERROR * step, length))
    return [
        (value, math.hypot(own, other))
        for value, own, other in zip((load, *centre), spread, others, strict=True)
    ]


def _tangential(
    state: _State, moved: NDArray[Any], sigma: NDArray[Any], window_size: int
) -> tuple[Doubles, float]:
    """Return the forces along x and y over Young's modulus with their standard deviations, (2, 2), mm^2.

    The second number is the share of the contact that has a displacement.
    """
    blocks, window = state.blocks, state.window
    weights = state.shear().astype(np.float64) * blocks.space.pixel_area
    contact, fine = state.sheared[window], blocks.pixels(window)
    means = np.stack([blocks.means(moved[..., part][fine]) for part in (0, 1)])
    means[:, ~contact] = np.nan
    gaps = contact & ~np.isfinite(means).all(axis=0)
    covered = 1 - np.count_nonzero(gaps) / np.count_nonzero(contact)
    if covered < MIN_COVERAGE:
        return np.zeros((2, 2)), covered
    means = blocks.at_centres(means, extended=True)
    if gaps.any():
        means = np.stack([fill_with_nearest(part) for part in means])
    force = np.sum(weights * np.where(contact, means * UP, 0.0), axis=(1, 2, 3)) * UP.ravel()
    variance = np.zeros(2)
    alike = blocks.alike(window_size, boxes=True)
    for part in (0, 1):
        spread = _Errors(np.broadcast_to(sigma[..., part], moved.shape[:2]), blocks, *alike)
        variance += spread.variance(blocks.at_centres(weights[:, part]), window)
    sigma = np.hypot(np.sqrt(variance), _SHEAR_MODEL * state.border_share() * np.hypot(*force))
    return np.stack([force, sigma], axis=-1), covered


@dataclass(frozen=True)
class _Blocks:
    """Blocks of pixels, whose means are the maps of the tracker."""

    shape: tuple[int, int]  # of the pixels
    pixel_size: tuple[float, float]
    binning: int

    def __post_init__(self) -> None:
        if min(self.shape) < 2 * self.binning:
            raise InputError(f"maps of {self.shape} are too small for a binning of {self.binning} pixels")

    @cached_property
    def space(self) -> HalfSpace:
        """The half-space of the blocks."""
        rows, columns = (size // self.binning for size in self.shape)
        return HalfSpace(
            (rows, columns), (self.pixel_size[0] * self.binning, self.pixel_size[1] * self.binning)
        )

    @cached_property
    def forms(self) -> Singles:
        """The forms of a flat punch, and of those tilted along x and y, (3, H, W): 1, and -1 to 1."""
        rows, columns = self.space.shape
        flat = np.ones((rows, columns), np.float32)
        x, y = np.linspace(-1, 1, columns), np.linspace(1, -1, rows)
        return np.stack([flat, flat * x.astype(np.float32), flat * y[:, np.newaxis].astype(np.float32)])

    def axes(self, result: Result) -> tuple[Doubles, Doubles]:
        """Return x and y of the blocks' centres, mm."""
        x, y = result.x, result.y
        if x is None or y is None:
            x, y = pixel_axes(self.shape, self.pixel_size)
        rows, columns = self.space.shape
        first, last = 0, self.binning - 1
        x, y = (
            (axis[first :: self.binning][:n] + axis[last :: self.binning][:n]) / 2
            for axis, n in ((x, columns), (y, rows))
        )
        return x, y

    def scales(self, axes: tuple[Doubles, Doubles]) -> tuple[float, float]:
        """Return half of the lengths of the axes, along x and along y."""
        (x, y) = axes
        return float(x[-1] - x[0]) / 2, float(y[0] - y[-1]) / 2

    def pixels(self, window: Window) -> Window:
        """Return the pixels of the blocks in a window."""
        rows, columns = (slice(part.start * self.binning, part.stop * self.binning) for part in window)
        return rows, columns

    def means(self, values: NDArray[Any]) -> Singles:
        """Return the means of blocks, NaN where most of a block is undefined."""
        step = self.binning
        rows, columns = (size // step for size in values.shape)
        values = values[: rows * step, : columns * step]
        strips = sum((values[k::step] for k in range(1, step)), start=values[0::step])
        means = sum((strips[:, k::step] for k in range(1, step)), start=strips[:, 0::step])
        means = (means / step**2).astype(np.float32)
        gaps = np.isnan(means)
        if step > 1 and gaps.any():
            parts = values.reshape(rows, step, columns, step).transpose(0, 2, 1, 3)[gaps]
            finite = np.isfinite(parts)
            count = np.count_nonzero(finite, axis=(1, 2))
            total = np.where(finite, parts, 0).sum(axis=(1, 2))
            means[gaps] = np.where(2 * count >= step**2, total / np.maximum(count, 1), np.nan)
        return means

    def at_centres(self, means: NDArray[Any], extended: bool = False) -> NDArray[Any]:
        """Return values at the centres of blocks, (..., H, W), from means, which are lower on a dome.

        The difference is 1/24 of the second differences of the means, less the same of pixels. The operator
        is symmetric inside a map, so it also converts weights of values to weights of means. Next to missing
        values the second difference is taken for 0, or ``extended``, for that of the next block inside.
        """
        values = means.copy()
        factor = means.dtype.type((1 - 1 / self.binning**2) / 24)
        for axis in (-2, -1):
            bend = np.diff(means, 2, axis=axis)
            if extended:
                for ahead, behind in ((slice(1, None), slice(-1)), (slice(-1), slice(1, None))):
                    one, other = (
                        (..., part, slice(None))[: 3 if axis == -2 else 2] for part in (ahead, behind)
                    )
                    bend[one] = np.where(np.isnan(bend[one]), bend[other], bend[one])
            inner = values[..., 1:-1, :] if axis == -2 else values[..., 1:-1]
            inner -= factor * np.where(np.isfinite(bend), bend, means.dtype.type(0))
        return values

    def alike(self, length: float, boxes: bool = False) -> tuple[Doubles, Doubles]:
        """Return the covariances of means along rows and along columns, if pixels have the variance 1.

        Errors of pixels are correlated over a Gaussian ``length``, mm, or are those of overlapping ``boxes``,
        whose length is in pixels.
        """
        (rows, columns), (width, height) = self.space.shape, self.pixel_size
        along_rows, along_columns = (length, length) if boxes else (length / height, length / width)
        step = self.binning
        return _alike(rows, step, along_rows, boxes), _alike(columns, step, along_columns, boxes)


@lru_cache(maxsize=16)
def _alike(count: int, binning: int, length: float, boxes: bool) -> Doubles:
    """Return the covariance of means along an axis, (n, n), for a variance of 1; see `_Blocks.alike`."""
    inside = np.arange(binning)
    lag = np.abs(np.arange(count)[:, np.newaxis, np.newaxis] * binning + inside[:, np.newaxis] - inside)
    if boxes:
        near = np.maximum(1 - lag / length, 0)
    else:
        near = np.exp(-0.5 * (lag / length) ** 2) if length else (lag == 0).astype(np.float64)
    return np.asarray(toeplitz(near.mean(axis=(1, 2))))


class _Errors:
    """Errors of means: standard deviations of pixels, (H, W), if known, and how means are alike."""

    def __init__(
        self, sigma: NDArray[Any] | None, blocks: _Blocks, along_rows: Doubles, along_columns: Doubles
    ) -> None:
        self._sigma, self._blocks, self._alike = sigma, blocks, (along_rows, along_columns)
        self._found: tuple[Window, Doubles] | None = None

    def usual(self, window: Window) -> float:
        """Return the usual standard deviation of a mean in a window."""
        rows, columns = self._alike
        return float(np.median(self._spread(window))) * math.sqrt(rows[0, 0] * columns[0, 0])

    def variance(self, weights: Doubles, window: Window) -> Doubles:
        """Return the variances of sums of means, weighted by (n, H, W) in a window."""
        rows, columns = self._inner(window)
        shares = weights * self._spread(window)
        return np.asarray(np.sum(shares * (rows @ shares @ columns), axis=(1, 2)))

    def drawn(self, window: Window) -> Singles:
        """Return random errors of means, (H, W), 0 outside a window."""
        errors = np.zeros(self._blocks.space.shape, np.float32)
        rows, columns = (
            cholesky(part + 1e-9 * part[0, 0] * np.eye(len(part)), lower=True) for part in self._inner(window)
        )
        spread = self._spread(window)
        errors[window] = spread * (rows @ np.random.default_rng(0).normal(size=spread.shape) @ columns.T)
        return errors

    def _inner(self, window: Window) -> tuple[Doubles, Doubles]:
        rows, columns = (
            part[: inner.stop - inner.start, : inner.stop - inner.start]
            for part, inner in zip(self._alike, window, strict=True)
        )
        return rows, columns

    def _spread(self, window: Window) -> Doubles:
        """Return the RMS standard deviation of a block's pixels, in a window; where unknown, the nearest."""
        if self._sigma is None:
            return np.zeros([part.stop - part.start for part in window])
        if self._found is None or self._found[0] != window:
            square = self._blocks.means(self._sigma[self._blocks.pixels(window)] ** 2)
            square = fill_with_nearest(square) if np.isfinite(square).any() else np.zeros_like(square)
            self._found = window, np.sqrt(square).astype(np.float64)
        return self._found[1]
