"""Forces along a stream of results, at the rate of frames."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.base.inputs import Maps, as_result, pixel_size_of
from mirrorskin.engine.base.resample import fill_with_nearest
from mirrorskin.engine.force.blocks import BlockErrors, Blocks, Window
from mirrorskin.engine.force.following import ContactFollower
from mirrorskin.engine.force.following import Maps as BlockMaps
from mirrorskin.engine.force.halfspace import Mask, Pressed, press
from mirrorskin.engine.force.normal import UNCERTAIN, check_bounds, excess_load, modulus_of, surface_of
from mirrorskin.engine.force.tangential import MIN_COVERAGE, UP, last_displacement
from mirrorskin.engine.metrology.patch import noise_length
from mirrorskin.io import Fitted, InputError, Result
from mirrorskin.io.base.arguments import check_count, check_number, checked, in_unit
from mirrorskin.io.base.findings import Finding, carried, in_process
from mirrorskin.io.base.threads import ThreadSafe
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.device import Device, open_device

Singles = NDArray[np.float32]

_TOLERANCE = 0.25  # gap in contact, standard deviations of the mean of a block
_LOOSE = 5e-4  # maximum gap in contact as a share of the maximum height; the load is corrected for it
_CLEARLY = 6.0  # standard deviations
_STALE = 0.1  # share of the contact that may change before gradients of the load are computed anew
_SAME_LOAD = 0.1  # relative change of the load after which its increase by noise is computed anew
_UNITS = np.eye(2, dtype=np.float32)[:, :, np.newaxis, np.newaxis]  # displacements along x and along rows
_ROUND_ERROR, _SMALL_ERROR = 0.0065, 0.04  # relative error of the load; see `_border_error`
_CUT_ERROR = 0.17  # the same, if the object ends in the contact
_CENTRE_ERROR = 9.5  # error of the centre of pressure, blocks, over the relative error of the load
_SHEAR_MODEL = 0.03  # relative error of the tangential force, over the share of blocks at the border
_SHEAR_STALE = 0.1  # the same, over the share of the contact that has changed since its weights were computed
_CENTRES = "pressure_centre_x", "pressure_centre_y"
_CROSS = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))


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
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.

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
        device: str | Device | None = None,
    ) -> None:
        self._pixel_size, self._modulus, self._modulus_sigma = pixel_size, modulus, modulus_sigma
        self._binning, self._window_size = binning, window_size
        self._travel_sigma, self._compliance = travel_sigma, compliance
        check_bounds(travel_sigma=travel_sigma, modulus_sigma=modulus_sigma, compliance=compliance)
        if binning < 1 or window_size < 1:
            raise InputError(f"binning {binning} and window_size {window_size}: give pixels, 1 or more")
        self._device = open_device(device).with_new_queue()
        self._follower: ContactFollower | None = None
        self._state: _State | None = None

    def precompile(self, shape: tuple[int, int], dtype: object = None) -> None:
        """Compile what maps of a shape need, with another tracker, so that the first ones are not delayed."""
        trial = ForceTracker(1.0, 1.0, binning=self._binning, device=self._device)
        row, column = (np.linspace(-1, 1, size, dtype=np.float32) for size in shape)
        dome = -(row[:, np.newaxis] ** 2 + column**2)
        with suppress(InputError):  # of maps that are too small
            for _ in range(2):
                trial.push(dome, 0.5)

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
        result = as_result(maps, "maps", pixel_size=self._pixel_size)
        surface, travel = surface_of(result, travel)
        size = pixel_size_of(result, "height", self._pixel_size)
        young, young_sigma = modulus_of(result, self._modulus, self._modulus_sigma)
        moved = None if result.displacement is None else last_displacement(result)
        if moved is not None and moved[0].shape[:2] != surface.shape:
            raise InputError(
                f"displacement has shape {moved[0].shape}, height {surface.shape}: one size is needed"
            )
        if min(surface.shape) < 2 * self._binning:
            raise InputError(f"maps of {surface.shape} are too small for a binning of {self._binning} pixels")
        blocks = Blocks((surface.shape[0], surface.shape[1]), size, self._binning)
        state, self._state = self._state, None  # after an error, the next result starts anew
        if state is None or state.blocks != blocks:
            if self._follower is None or self._follower.blocks != blocks:
                self._follower = ContactFollower(blocks, self._compliance, self._device)
            state = _State(self._follower)
        state.press(_maps(surface, result.height_sigma, moved), travel)
        axes = blocks.axes(result)
        found: dict[str, Any] = {"contact": state.contact.view(np.uint8), "pressure": state.pressure}
        numbers = {"force": (0.0, 0.0), _CENTRES[0]: (math.nan, math.nan), _CENTRES[1]: (math.nan, math.nan)}
        along, covered = [(0.0, 0.0), (0.0, 0.0)], 1.0
        if state.load > 0:
            common = math.hypot(self._travel_sigma, result.fitted.height_common_sigma or 0.0)
            load, *centres = _normal(state, noise_length(result), axes, common)
            numbers = {"force": load, **dict(zip(_CENTRES, centres, strict=True))}
            found["pressure"] *= np.float32(young * load[0] / state.load)
            if moved is not None:
                along, covered = state.forces(self._window_size)
            self._state = state
        if moved is not None and covered >= MIN_COVERAGE:
            numbers |= zip(("force_x", "force_y"), along, strict=True)
        for name, (value, sigma) in numbers.items():
            scale, by_modulus = (1.0, 0.0) if name in _CENTRES else (young, young_sigma * value)
            found |= {name: scale * value, f"{name}_sigma": math.hypot(scale * sigma, by_modulus)}
        findings = _findings(state.contact, covered)
        if not state.load > 0 and _touches(surface + np.float32(travel), result.height_sigma):
            text = f"what touches is smaller than {self._binning} pixels: use a smaller binning"
            findings.append(Finding("small contact", text))
        process = in_process(findings, carried({}, result=result.process))
        fitted = Fitted(travel=float(travel))
        return Result(
            found, x=axes[0], y=axes[1], process={"modulus": float(young), **process}, fitted=fitted
        )


def _maps(
    height: NDArray[Any], sigma: NDArray[Any] | None, moved: tuple[NDArray[Any], NDArray[Any]] | None
) -> BlockMaps:
    """Return maps as a device takes them."""
    displacement, spread = (None, None) if moved is None else moved
    if spread is not None and not any(spread.strides):
        spread = np.full(height.shape, spread.flat[0]) if spread.flat[0] else None
    elif spread is not None and not spread.strides[-1]:
        spread = spread[..., 0]
    sigma, displacement, spread = (
        None if part is None else np.ascontiguousarray(part, np.float32)
        for part in (sigma, displacement, spread)
    )
    return BlockMaps(np.ascontiguousarray(height, np.float32), sigma, displacement, spread)


class _State:
    """The solution of the last result, as an initial guess of the next one.

    Maps are those of the blocks, or, if it is stated, of the follower's window.
    """

    def __init__(self, follower: ContactFollower) -> None:
        follower.reset()
        self.follower, self.blocks = follower, follower.blocks
        self.contact: Mask
        self.pressure: Singles  # over Young's modulus
        self.load = 0.0  # mm^2
        self.cut_share = 0.0  # share of the blocks at the contact's border that are next to missing heights
        self.excess = 0.0  # increase of the load by noise, as a share of it
        # In the window: weights of means that correspond to the strains under punches of the forms of the
        # blocks, (3, H, W), and their sums; weights of displacements, (2, 2, H, W), for forces along x and y.
        self.punch_weights: Singles
        self.punch_sums: Doubles
        self.shear_weights: Singles
        self._punched = self._sheared = np.zeros(follower.blocks.space.shape, bool)  # the contacts of these
        self._punches = np.zeros((3, 1, *self._punched.shape), np.float32)
        self._shears = np.zeros((2, 2, *self._punched.shape), np.float32)
        self._window: Window | None = None  # of the weights
        self._usual = 0.0  # standard deviation of a mean
        self._excess_load = 0.0  # the load at which the excess was computed

    def press(self, maps: BlockMaps, travel: float) -> None:
        """Find the contact, and its gradients if it has changed."""
        follower, space = self.follower, self.blocks.space
        if not follower.follow(maps, travel, _LOOSE, _TOLERANCE * self._usual):
            pressed = press(space, follower.surface, follower.compliance, self._pressed())
            self.contact, self.pressure, self.load = pressed.contact, pressed.strain, pressed.load
            if not pressed.load > 0:
                return
            follower.restart(pressed)
        self._weigh(maps.displacement is not None)
        window, sums = follower.window, follower.sums
        self.contact, self.pressure = follower.contact, np.zeros(space.shape, np.float32)
        np.maximum(follower.strain, 0, out=self.pressure[window])
        self.load = sums.pressure * space.pixel_area
        self.cut_share = 0.0
        if sums.lost:
            touching, known = self.contact[window], np.isfinite(follower.surface[window])
            self.cut_share = np.count_nonzero(touching & ~_inside(known)) / max(sums.border, 1)

    def _weigh(self, with_shears: bool) -> None:
        """Find the gradients anew if the contact has changed, and let the follower sum with them."""
        follower, sums, window = self.follower, self.follower.sums, self.follower.window
        has_moved, changed, changed_later = window != self._window, sums.changed, sums.changed_later
        if has_moved:  # the sums were those of other weights
            changed = float(np.count_nonzero(follower.contact ^ self._punched))
            changed_later = float(np.count_nonzero(follower.contact ^ self._sheared))
        is_stale, is_sheared = changed > _STALE * sums.contact, changed_later > _STALE * sums.contact
        if is_stale:
            self._punches = follower.load(self.blocks.forms[:, np.newaxis], self._punches)
            self._punched = follower.contact
        if with_shears and is_sheared:
            self._shears = follower.load(np.broadcast_to(_UNITS, self._shears.shape), self._shears)
            self._sheared = follower.contact
        if not (is_stale or has_moved or (with_shears and is_sheared)):
            return
        punches, sheared = self._punches[(slice(None), 0, *window)], self._sheared[window]
        self.punch_weights = self.blocks.at_centres(punches)
        self.punch_sums = self.punch_weights.sum(axis=(1, 2), dtype=np.float64)
        signs = (UP * UP[:, np.newaxis]).astype(np.float32)
        self.shear_weights = signs * self.blocks.weights_of_means(self._shears[(..., *window)], sheared)
        shears = self.shear_weights.reshape(4, *sheared.shape)
        contacts = self._punched[window][np.newaxis], sheared[np.newaxis]
        follower.weigh(np.concatenate([punches, self.punch_weights, shears, *contacts]))
        self._window = window

    def covariance(self, length: float) -> Doubles:
        """Return the covariance, (3, 3), of the sums of heights weighted by the strains under punches.

        ``length`` is that of the correlation of errors of heights, mm.
        """
        follower, sums = self.follower, self.follower.sums
        alike = self.blocks.alike(length)
        self._usual = math.sqrt(alike[0][0] * alike[1][0]) * sums.contact / sums.inverse_sigma
        if not math.isfinite(self._usual):
            self._usual = 0.0
        independent = _independent(alike, sums.covariance)
        errors = None
        if independent is None:
            errors = BlockErrors(follower.variance, self.blocks, length)
            matrix = errors.covariance(self.punch_weights)
        else:
            xx, xy, xz, yy, yz, zz = independent
            matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        if abs(self.load - self._excess_load) > _SAME_LOAD * self._excess_load:
            self._correct(errors or BlockErrors(follower.variance, self.blocks, length))
        return matrix

    def _correct(self, errors: BlockErrors) -> None:
        """Find the increase of the load by errors of heights."""
        follower, space = self.follower, self.blocks.space
        drawn = np.zeros(space.shape, np.float32)
        drawn[follower.window] = errors.drawn()
        pressed, gradient = self._pressed(), self._punches[0, 0] * space.pixel_area
        assert pressed is not None
        excess = excess_load(space, follower.surface, drawn, follower.compliance, pressed, gradient)
        self._excess_load, self.excess = self.load, excess / self.load

    def _pressed(self) -> Pressed | None:
        """Return the last press."""
        if not self.load > 0:
            return None
        gap = np.zeros(self.contact.shape, np.float32)
        gap[self.follower.window] = self.follower.gap
        return Pressed(self.pressure, self.contact, self.load, gap)

    def forces(self, window_size: int) -> tuple[list[tuple[float, float]], float]:
        """Return the forces along x and y over Young's modulus, mm^2, with their standard deviations.

        The second number is the share of the contact that has a displacement.
        """
        follower, sums, area, covered = self.follower, self.follower.sums, self.blocks.space.pixel_area, 1.0
        sheared, moved = self._sheared[follower.window], sums.displacements
        if not all(map(math.isfinite, moved)):
            means = follower.moved
            gaps = ~np.isfinite(means).all(axis=0)
            covered = 1 - np.count_nonzero(gaps & sheared) / sums.later
            if covered < MIN_COVERAGE:
                return [(0.0, 0.0)] * 2, covered
            filled = [fill_with_nearest(np.where(gaps | ~sheared, np.nan, part)) for part in means]
            moved = np.einsum("klij,lij->k", self.shear_weights, np.stack(filled)).tolist()
        # The force that displaces a contact by 1 is proportional to its length, thus to the root of its area.
        area *= math.sqrt(sums.contact / sums.later)
        along, up = (area * value for value in moved)
        variances = _independent(self.blocks.alike(window_size, boxes=True), sums.displacement_variances)
        if variances is None:
            errors = BlockErrors(follower.moved_variance, self.blocks, window_size, boxes=True)
            variances = np.diag(errors.covariance(self.shear_weights)).tolist()
        rough = math.hypot(along, up) * math.hypot(
            _SHEAR_MODEL * sums.border / sums.contact, _SHEAR_STALE * sums.changed_later / sums.contact
        )
        return [
            (force, math.hypot(area * math.sqrt(max(variance, 0.0)), rough))
            for force, variance in zip((along, up), variances, strict=True)
        ], covered


def _independent(alike: tuple[Doubles, Doubles], variances: list[float]) -> list[float] | None:
    """Return variances of sums of means, if the errors of these are independent and all of them defined."""
    rows, columns = alike
    if rows.size > 1 or columns.size > 1 or not all(map(math.isfinite, variances)):
        return None
    factor = float(rows[0] * columns[0])
    return [factor * variance for variance in variances]


def _touches(surface: NDArray[Any], sigma: NDArray[Any] | None) -> bool:
    """Return whether a pixel is clearly above the sheet."""
    return bool(np.any(surface > (0.0 if sigma is None else _CLEARLY * sigma)))


def _findings(contact: Mask, covered: float) -> list[Finding]:
    """Return what is wrong with a contact, of which a share is covered by displacements."""
    findings = []
    if covered < MIN_COVERAGE:
        text = f"no tangential force: {covered:.0%} of the contact has a displacement"
        findings.append(Finding("no displacement", text))
    x, y, width, height = cv2.boundingRect(contact.view(np.uint8))
    if width and (min(x, y) == 0 or y + height == contact.shape[0] or x + width == contact.shape[1]):
        text = "the contact reaches the edge of the maps: forces lack what is outside"
        findings.append(Finding("contact at the edge", text))
    return findings


def _inside(mask: Mask) -> Mask:
    """Return where a mask and its four neighbours are set; those outside the map are not."""
    inside = cv2.erode(mask.astype(np.uint8), _CROSS, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return inside.view(np.bool_)


def _border_error(state: _State) -> float:
    """Return the relative error of the load because blocks touch as a whole or not at all.

    It depends on the share of blocks at the border, and on how many of these are next to missing heights. It
    was measured on balls, cones, ellipsoids, pairs of balls, cylinders and punches, without noise.
    """
    share = state.follower.sums.border / state.follower.sums.contact
    return (_ROUND_ERROR + _CUT_ERROR * state.cut_share) * share**2 + _SMALL_ERROR * share**6


def _normal(
    state: _State, correlation: float, axes: tuple[Doubles, Doubles], common: float
) -> list[tuple[float, float]]:
    """Return the load, mm^2, and the centre of pressure along x and y, mm, with their standard deviations.

    By Betti's reciprocity, the load changes with the heights by the strain under a flat punch, and moments of
    the pressure by that under a tilted one. ``correlation`` is the length of errors of heights, mm.
    """
    blocks, window, sums = state.blocks, state.follower.window, state.follower.sums
    covariance, area = state.covariance(correlation), blocks.space.pixel_area
    lacking = [area * part for part in sums.lacking]
    total = state.load - lacking[0]
    load, rough = total * (1 - state.excess), _border_error(state)
    values, others = [load], [load * math.hypot(rough, UNCERTAIN * state.excess)]
    mixed = np.eye(3)
    scales, steps = blocks.scales(axes), blocks.space.pixel_size
    places = zip(
        axes, scales, steps, window[::-1], state.follower.shape[::-1],
        (sums.x, sums.y), (sums.xx, sums.yy), strict=True,
    )  # fmt: skip
    for part, (axis, scale, step, inside, length, first, second) in enumerate(places, 1):
        middle, block = float(axis[0] + axis[-1]) / 2, float(axis[-1] - axis[0]) / (axis.size - 1)
        away = float(axis[inside.start]) + block * (length - 1) / 2 - middle
        moment = area * (block * first + away * sums.pressure)
        square = area * (block * (block * second + 2 * away * first) + away**2 * sums.pressure)
        centre = (moment - scale * lacking[part]) / total
        values.append(centre + middle)
        radius = math.sqrt(max(square / total - centre**2, 0.0))
        others.append(rough * math.hypot(_CENTRE_ERROR * step, radius))
        mixed[part, part], mixed[part, 0] = scale / total, -centre / total
    mixed *= area
    variances = np.einsum("ki,kj,ij->k", mixed, mixed, covariance).tolist()
    by_common = (common * (mixed @ state.punch_sums)).tolist()
    return [
        (value, math.hypot(math.sqrt(max(variance, 0.0)), shared, other))
        for value, variance, shared, other in zip(values, variances, by_common, others, strict=True)
    ]
