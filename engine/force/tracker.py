"""Forces along a stream of results, at the rate of frames."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.base.inputs import Maps, as_result, pixel_size_of
from mirrorskin.engine.base.resample import fill_with_nearest
from mirrorskin.engine.force.blocks import BlockErrors, Blocks, Window
from mirrorskin.engine.force.halfspace import Mask, Pressed, press, punches
from mirrorskin.engine.force.normal import UNCERTAIN, check_bounds, excess_load, modulus_of, surface_of
from mirrorskin.engine.force.tangential import MIN_COVERAGE, UP, ContactShear, last_displacement
from mirrorskin.engine.metrology.patch import noise_length
from mirrorskin.io import Fitted, InputError, Result
from mirrorskin.io.base.arguments import check_count, check_number, checked, in_unit
from mirrorskin.io.base.findings import Finding, carried, in_process
from mirrorskin.io.base.threads import ThreadSafe
from mirrorskin.kernels.array_types import Doubles

Singles = NDArray[np.float32]

_TOLERANCE = 0.25  # gap in contact, standard deviations of the mean of a block
_LOOSE = 5e-4  # maximum gap in contact as a share of the maximum height; the load is corrected for it
_CLEARLY = 6.0  # standard deviations
_STALE = 0.1  # share of the contact that may change before gradients of the load are computed anew
_SAME_LOAD = 0.1  # relative change of the load after which its increase by noise is computed anew
_SHEAR_ERROR = 1e-3  # of displacements in contact under tractions that move it by 1
_ROUND_ERROR, _SMALL_ERROR = 0.0065, 0.04  # relative error of the load; see `_border_error`
_CUT_ERROR = 0.17  # the same, if the object ends in the contact
_CENTRE_ERROR = 9.5  # error of the centre of pressure, blocks, over the relative error of the load
_SHEAR_MODEL = 0.03  # relative error of the tangential force, over the share of blocks at the border
_SHEAR_STALE = 0.1  # the same, over the share of the contact that has changed since its weights were computed
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
            state = _State(blocks, self._compliance)
        heights = blocks.at_centres(blocks.means(surface)) + np.float32(travel)
        errors = BlockErrors(result.height_sigma, blocks, noise_length(result))
        state.press(heights, errors)
        axes, pressed = blocks.axes(result), state.pressed
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
        if moved is not None and covered >= MIN_COVERAGE:
            numbers |= zip(("force_x", "force_y"), young * along, strict=True)
        found: dict[str, Any] = {"contact": pressed.contact.astype(np.uint8), "pressure": pressed.strain}
        for name, (value, sigma) in numbers.items():
            by_modulus = 0.0 if name in _CENTRES else young_sigma / young * value
            found |= {name: float(value), f"{name}_sigma": math.hypot(sigma, by_modulus)}
        if pressed.load > 0:
            found["pressure"] = pressed.strain * np.float32(found["force"] / pressed.load)
        findings = _findings(pressed.contact, covered)
        if not pressed.load > 0 and _touches(surface + np.float32(travel), result.height_sigma):
            text = f"what touches is smaller than {self._binning} pixels: use a smaller binning"
            findings.append(Finding("small contact", text))
        process = in_process(findings, carried({}, result=result.process))
        fitted = Fitted(travel=float(travel))
        return Result(
            found, x=axes[0], y=axes[1], process={"modulus": float(young), **process}, fitted=fitted
        )


class _State:
    """The solution of the last result, as an initial guess of the next one."""

    def __init__(self, blocks: Blocks, compliance: float) -> None:
        self.blocks, self._compliance = blocks, compliance
        self.pressed: Pressed
        self.window: Window
        self.object: Mask  # blocks with a height
        self.inside: Mask  # blocks in the window that touch, with their four neighbours
        self._usual = 0.0  # standard deviation of a mean
        # Strains that move the contact by the forms of the blocks, and tractions that move it by 1 along x
        # and along rows; and the weights of means that these are.
        self.punches: Singles | None = None
        self.shears: Singles | None = None
        self.punch_weights: Singles
        self.shear_weights: Singles
        self._punched = self.sheared = np.zeros(0, bool)  # the contacts of these
        self._start: Pressed | None = None
        self._load, self.excess = 0.0, 0.0  # a load, and its increase by noise, as a share of it

    def press(self, heights: Singles, errors: BlockErrors) -> None:
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
        assert pressed.sheet is not None
        self.window = pressed.sheet.window
        self._usual, self.inside = errors.usual(self.window), _inside(contact[self.window])
        if self.punches is None or _changed(contact, self._punched) > _STALE:
            self.punches = punches(space, contact, self.blocks.forms, self._compliance, self.punches)
            self.punch_weights, self._punched = self.blocks.at_centres(self.punches), contact
        if abs(pressed.load - self._load) > _SAME_LOAD * self._load:
            drawn, gradient = errors.drawn(self.window), self.punches[0] * space.pixel_area
            excess = excess_load(space, heights, drawn, self._compliance, pressed, gradient)
            self._load, self.excess = pressed.load, excess / pressed.load

    def border_share(self) -> float:
        """Return the share of blocks in contact that are at its border."""
        return 1 - np.count_nonzero(self.inside) / np.count_nonzero(self.pressed.contact)

    def shear(self) -> None:
        """Find the tractions that move the contact by 1 along x, and along rows, if it has changed."""
        contact, place = self.pressed.contact, (..., *self.window)
        if self.shears is None or _changed(contact, self.sheared) > _STALE:
            system = ContactShear(contact[self.window], self.blocks.space.pixel_size, contact.shape)
            weights = system.weights(_SHEAR_ERROR, None if self.shears is None else self.shears[place])
            self.shears, self.sheared = np.zeros((2, 2, *contact.shape), np.float32), contact
            self.shears[place] = weights
            self.shear_weights = self.blocks.at_centres(self.shears)


def _touches(surface: NDArray[Any], sigma: NDArray[Any] | None) -> bool:
    """Return whether a pixel is clearly above the sheet."""
    return bool(np.any(surface > (0.0 if sigma is None else _CLEARLY * sigma)))


def _findings(contact: Mask, covered: float) -> list[Finding]:
    """Return what is wrong with a contact, of which a share is covered by displacements."""
    findings = []
    if covered < MIN_COVERAGE:
        text = f"no tangential force: {covered:.0%} of the contact has a displacement"
        findings.append(Finding("no displacement", text))
    if any(edge.any() for edge in (contact[0], contact[-1], contact[:, 0], contact[:, -1])):
        text = "the contact reaches the edge of the maps: forces lack what is outside"
        findings.append(Finding("contact at the edge", text))
    return findings


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
    state: _State, errors: BlockErrors, axes: tuple[Doubles, Doubles], common: float
) -> list[tuple[float, float]]:
    """Return the load, mm^2, and the centre of pressure along x and y, mm, with their standard deviations.

    By Betti's reciprocity, the load changes with the heights by the strain under a flat punch, and moments of
    the pressure by that under a tilted one.
    """
    assert state.punches is not None
    blocks, pressed, window = state.blocks, state.pressed, state.window
    strain, left = pressed.strain[window].astype(np.float64), pressed.gap[window]
    area, place = blocks.space.pixel_area, (slice(None), *window)
    lacking = area * np.einsum("nij,ij->n", state.punches[place], left, dtype=np.float64)
    total = pressed.load - lacking[0]
    load, centre, size, mixed = total * (1 - state.excess), [], [], np.eye(3)
    for axis, scale, part in zip(axes, blocks.scales(axes), (1, 2), strict=True):
        lever = axis - axis.mean()
        profile, inside = area * strain.sum(axis=part - 1), lever[window[2 - part]]
        middle = (float(profile @ inside) - scale * lacking[part]) / total
        centre.append(middle + float(axis.mean()))
        size.append(math.sqrt(max(float(profile @ inside**2) / total - middle**2, 0.0)))
        mixed[part, part], mixed[part, 0] = scale / total, -middle / total
    weights = np.einsum("kn,nij->kij", area * mixed, state.punch_weights[place])
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
    state.shear()
    assert state.shears is not None
    place, area = (..., *window), blocks.space.pixel_area
    contact, fine = state.sheared[window], blocks.pixels(window)
    means = blocks.means(moved[fine]).transpose(2, 0, 1)
    gaps = contact & ~np.isfinite(means).all(axis=0)
    missing = np.count_nonzero(gaps)
    covered = 1 - missing / np.count_nonzero(contact)
    if covered < MIN_COVERAGE:
        return np.zeros((2, 2)), covered
    means = np.where(contact, means, np.float32(np.nan))
    means = blocks.at_centres(means, extended=True)
    if missing:
        means = np.stack([fill_with_nearest(part) for part in means])
    means[:, ~contact] = 0
    means *= UP.astype(np.float32)
    # The force that displaces a contact by 1 is proportional to its length, and thus to the root of its area.
    grown = math.sqrt(np.count_nonzero(state.pressed.contact) / np.count_nonzero(contact))
    area *= grown
    force = area * np.einsum("klij,lij->k", state.shears[place], means, dtype=np.float64) * UP.ravel()
    errors = BlockErrors(sigma, blocks, window_size, boxes=True)
    variance = errors.variance(area * state.shear_weights[place].astype(np.float64), window).sum(axis=-1)
    changed = _changed(state.pressed.contact, state.sheared)
    rough = math.hypot(_SHEAR_MODEL * state.border_share(), _SHEAR_STALE * changed)
    sigma = np.hypot(np.sqrt(variance), rough * np.hypot(*force))
    return np.stack([force, sigma], axis=-1), covered
