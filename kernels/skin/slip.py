"""Slip of windows of the skin, by how far each is displaced in a frame: ``slip.cl`` in NumPy with float64.

A state, (`STATES`, rows, columns) of all windows, is int32, of which some planes hold float32. A displacement
is mm along x and y, y up.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.skin.displacement import AFFINE

Array = NDArray[Any]

LEARN, MEASURE, FIND_SLIP = 1, 2, 4
"""Parts of the work: noise and next start; displacements; motion and slip."""
TOUCHED, PARTIAL, FOLLOWED, SETTLED, SLIPPED, EXCEEDED, SEEN = (1 << bit for bit in range(7))
"""Flags of a window: it is in contact, at least not as a whole; it has texture; it was in contact as a whole
when it entered; it has slipped; it departed in the last frame; and it was found with this key.
"""
LEARNED, FIXED, DRIFT, TURNED, FLAGS, FITTED, ONSET, LAST = 0, 1, 3, 4, 5, 6, 7, 8
"""Planes of the state: mean variance of a sample; displacement to the window's place on the object, as it was
when the contact started, along x and y (NaN where unknown); variances of the object's motion until the window
entered, along an axis and of the angle; flags; last frame in which the window followed the object; frame in
which it started to slip; and the last of the fields of ``displacement_follow``.
"""
STATES = LAST + AFFINE
KNOWN = 9
"""Planes of the given numbers: variance of a sample; covariance xx, yy and xy of a displacement by noise; the
displacement until the key; and its covariance.
"""
SCRATCH, SUMS = 13, 8
"""Planes of the scratch, and numbers of an item of the work-group in ``sums``."""
NUMBERS = 20
"""Numbers before the maps in ``found``."""
MAPS = 9
"""Numbers of a window in ``found``: displacement, its standard deviations and covariance; status; onset."""
MAX_CHANGE, MIN_CONTRAST = 0.5, 0.5
"""Of a window that is found: largest last change, pixels; least contrast, relative to the key's."""
MIN_STEP = 0.1
"""Pixels by which the step of a window must differ from the mean one to be used."""
MEMORY, FIRST = 64, 4
"""Frames over which the noise is averaged, and those in which any residual is noise."""
KINK = 9.0
"""Squared bias of a window with a kink at its centre, relative to that of a smooth bend."""
CORRELATED_SAMPLES = 4
"""Samples over which residuals are correlated."""
LAPLACIAN_NOISE = 4 * 20 / 24**2
"""Noise of the squared bias (two standard deviations) per variance."""
_USUAL, _OUTLIER = 1.5, 9.0  # variances relative to the noise: of noise; of a window without value
_FEWEST, _ROUNDS = 4, 2  # least number of windows, and number of fits, of the motion
_CLOSE, _FAR = 9.0, 20.0  # chi square of a departure, two degrees of freedom: up to it none; from it slip
_UNKNOWN, _SLIPS, _STICKS, _NO_CONTACT, _NO_TEXTURE = range(5)  # status


def slip_windows(
    top: int,
    bottom: int,
    left: int,
    right: int,
    work: int,
    least: int,
    frame: int,
    since_key: int,
    started: int,
    apart: int,
    bend_scale: float,
    chance: float,
    grid: tuple[float, ...],
    size: tuple[float, ...],
    answer: Array,
    known: Array,
    field: Array,
    state: Array,
    scratch: Array,
    found: Array,
) -> None:
    """Find the windows that stick to the object and those that slip, from how far they are displaced.

    A window that sticks moves like a rigid body, with the object. Its motion is fitted to these windows by
    weighted least squares (Kabsch, 1976). A window slips if it departs from it by more than its errors in two
    frames, or together with a neighbour.

    Parameters
    ----------
    top, bottom, left, right : rows and columns of the windows
    work : sum of `LEARN`, `MEASURE` and `FIND_SLIP`
    least : fewest windows that converged, below which only their number is written
    frame, since_key : number of the frame, and frames since the key; 0 for the first one, which is at rest
    started : whether the contact has started
    apart, bend_scale : windows between those whose displacements show that it bends; squared length of a
        window over that of this distance, / 24
    chance : variance of a sample in a window, relative to the noise, that may be chance
    grid : x and y of the first window, and distances between windows, mm
    size : pixel size along x and y, mm
    answer, field : as of ``displacement_follow``; the field is replaced by the start of the next frame
    known, state : (`KNOWN` and `STATES`, rows, columns)
    scratch : (`SCRATCH`, rows, columns); displacement, (2,); covariance, (3,); squared bias, (2,)
    found : int32, of which some hold float32: number that converged; least and largest start, pixels to the
        right, down, right and down; windows in contact with texture, that have slipped, that were found with
        this key, and that are found; whether there is a motion, and a contact; the motion's centre, (2,), and
        displacement there, (2,), mm; sine of its angle, and cosine less 1; variance of the displacement, and
        of the angle; and the maps of all windows
    """
    part, at_rest = (slice(top, bottom), slice(left, right)), since_key == 0
    inner = (slice(None), *part)
    numbers, floats, here = found.view(np.float32), state.view(np.float32), answer[inner].astype(np.float64)
    flags, variance = state[FLAGS][part], here[AFFINE + 1]
    converged = (here[AFFINE + 2] < MAX_CHANGE) & (here[AFFINE] > MIN_CONTRAST)
    found[0] = 0 if at_rest else np.count_nonzero(converged)
    if found[0] < least:
        return
    with np.errstate(invalid="ignore", divide="ignore"):
        if work & LEARN:
            _learn(floats[LEARNED][part], variance, since_key)
            numbers[1:5] = _next_start(part, here[:AFFINE], converged, field, floats[LAST:])
        if work & MEASURE:
            usual, covariance = known[0][part], known[(slice(1, 4), *part)].astype(np.float64)
            is_found = (flags & FOLLOWED) > 0
            if not at_rest:
                is_found &= converged & (variance < _OUTLIER * usual)
            moved = np.zeros_like(here[:2]) if at_rest else here[:2] * np.array([[[size[0]]], [[-size[1]]]])
            moved = np.where(is_found, moved, np.nan)
            misfit = 1 + CORRELATED_SAMPLES * np.fmax(variance / usual - chance, 0)
            bending = np.stack([_bent(values, apart) for values in moved])
            bending = np.fmax((bend_scale * _fill(bending)) ** 2 - LAPLACIAN_NOISE * covariance[:2], 0)
            bending *= np.where(flags & PARTIAL, KINK, 1.0)
            noise = covariance * (0.0 if at_rest else misfit)
            scratch[inner][:7] = [*moved, *noise, *(0.0 * bending if at_rest else bending * is_found)]
        if work & FIND_SLIP:
            motion = np.zeros(8)
            measured = scratch[inner][:7].astype(np.float64)
            y, x = np.indices(state.shape[1:])
            places: Array = np.asarray(grid[0] + x * grid[2] + 1j * (grid[1] - y * grid[3]))[part]
            arguments = frame, measured, known[inner].astype(np.float64), state[inner], floats[inner]
            if started:
                has_motion = has_started = True
                if (fitted := _find_slip(places, *arguments)) is None:
                    has_motion = False
                else:
                    motion[:] = fitted
            else:
                has_motion = has_started = _start(*arguments)
            found[5:9] = _write_maps(part, since_key, scratch, known, state, found)
            found[9:11] = has_motion, has_started
            numbers[11:19] = motion


def _learn(learned: Array, variance: Doubles, since_key: int) -> None:
    """Average the noise of windows, except for residuals that are not noise."""
    usual = np.isfinite(variance) if since_key < FIRST else variance < _USUAL * learned
    mean = np.where(usual, learned + (variance - learned) / min(since_key, MEMORY), learned)
    learned[...] = np.where(np.isnan(mean), variance, mean)


def _next_start(
    part: tuple[slice, slice], moved: Doubles, converged: Array, field: Array, last: Array
) -> list[float]:
    """Write the fields of this frame and the start of the next one, and return its range.

    Windows outside of the part get those of the nearest ones in it.
    """
    inner = (slice(None), *part)
    now = np.where(converged, moved, field[inner])
    step = now[:2] - last[inner][:2]
    mean = step.mean(axis=(1, 2), keepdims=True)
    start = now.copy()
    start[:2] += np.where(np.abs(step - mean) > MIN_STEP, step, mean)
    rows, columns = (
        np.clip(np.arange(size), inside.start, inside.stop - 1) - inside.start
        for size, inside in zip(field.shape[1:], part, strict=True)
    )
    last[...], field[...] = (values[:, rows[:, None], columns] for values in (now, start))
    ends = start[:2].reshape(2, -1)
    return [*ends.min(axis=1), *ends.max(axis=1)]


def _bent(values: Doubles, apart: int) -> Doubles:
    """Return the sum of the second differences along both axes, as far as there are windows."""
    laplacian = np.zeros_like(values)
    for sums, moved in ((laplacian, values), (laplacian.T, values.T)):
        if len(moved) > 2 * apart:
            second = moved[: -2 * apart] + moved[2 * apart :] - 2 * moved[apart:-apart]
            sums += second[np.clip(np.arange(len(moved)) - apart, 0, len(second) - 1)]
    return laplacian


def _fill(values: Doubles) -> Doubles:
    """Return maps, (n, H, W), in which NaN is replaced by the number of the nearest window."""
    gaps = ~np.isfinite(values).all(axis=0)
    filled, numbers = values.copy(), np.argwhere(~gaps)
    for place in np.argwhere(gaps) if len(numbers) else ():
        row, column = numbers[np.argmin(((numbers - place) ** 2).sum(axis=1))]
        filled[:, place[0], place[1]] = values[:, row, column]
    return filled


def _start(frame: int, measured: Doubles, known: Doubles, state: Array, floats: Array) -> bool:
    """Let all windows in contact stick; return whether they are enough."""
    flags = state[FLAGS]
    sticks = np.isfinite(measured[0]) & ((flags & TOUCHED) > 0)
    settles = sticks & ((flags & PARTIAL) == 0)
    floats[FIXED : FIXED + 2] = np.where(sticks, measured[:2], np.nan)
    floats[DRIFT], floats[TURNED] = 0, 0
    flags[...] = np.where(settles, flags | SETTLED, flags & ~SETTLED)
    state[FITTED] = frame
    return bool(np.count_nonzero(settles) >= _FEWEST)


def _find_slip(
    places: Array, frame: int, measured: Doubles, known: Doubles, state: Array, floats: Array
) -> list[float] | None:
    """Find the windows that slip, and return the motion of those that stick; None if too few stick."""
    flags, moved = state[FLAGS], measured[0] + 1j * measured[1]
    touched, settled, slipped = ((flags & bit) > 0 for bit in (TOUCHED, SETTLED, SLIPPED))
    found, partial, fixed = np.isfinite(moved), (flags & PARTIAL) > 0, floats[FIXED] + 1j * floats[FIXED + 1]
    used = found & touched & np.isfinite(fixed)
    sticks = used & settled & ~partial & ~slipped
    bent = measured[5:7] * (partial | ~settled)
    xx, yy = (measured[2 + k] + known[6 + k] + bent[k] + floats[DRIFT] for k in range(2))
    xy, weights = measured[4] + known[8], 2 / (xx + yy)
    fits = sticks
    for _ in range(_ROUNDS):
        if np.count_nonzero(fits) < _FEWEST:
            return None
        w = weights[fits]
        total = w.sum()
        about, mean = w @ (places + fixed)[fits] / total, w @ (moved - fixed)[fits] / total
        arms, rest = places + fixed - about, moved - fixed - mean
        moments = w * np.abs(arms[fits]) ** 2
        turn = moments.sum() + np.vdot(arms[fits], w * rest[fits])
        turn = turn / abs(turn) if turn else 1 + 0j
        variance = (1 + w @ floats[DRIFT][fits]) / total
        square = moments.sum()
        angle_variance = (1 + moments @ floats[TURNED][fits]) / square if square > 0 else np.inf
        left, spread = rest - (turn - 1) * arms, variance + np.abs(arms) ** 2 * angle_variance
        spread = np.where(fits, -spread, spread)
        x, y, a, b = left.real, left.imag, xx + spread, yy + spread
        chi_square = (b * x**2 - 2 * xy * x * y + a * y**2) / (a * b - xy**2)
        before, fits = fits, sticks & (chi_square < _CLOSE)
        if (fits == before).all():
            break
    exceeds = used & (chi_square > _FAR)
    starts = exceeds & ~slipped
    padded, (rows, columns) = np.pad(starts, 1), starts.shape
    near = np.sum([padded[a : a + rows, b : b + columns] for a in range(3) for b in range(3)], axis=0)
    starts &= ((flags & EXCEEDED) > 0) | (near > 1)
    state[ONSET][starts] = state[FITTED][starts] + 1
    state[FITTED][used & (chi_square < _CLOSE)] = frame
    enters = found & touched & ~(settled | slipped | starts | (np.isfinite(fixed) & partial))
    arms = places + moved - about - mean
    entered = moved - mean + (turn.conjugate() - 1) * arms
    inherited = variance + np.abs(arms) ** 2 * angle_variance + measured[5:7].mean(axis=0) * partial
    for plane, values in (
        (FIXED, entered.real),
        (FIXED + 1, entered.imag),
        (DRIFT, inherited),
        (TURNED, np.full(found.shape, angle_variance)),
    ):
        floats[plane][enters] = values[enters]
    state[FITTED][enters] = frame
    flags &= ~EXCEEDED
    flags |= EXCEEDED * exceeds + SLIPPED * starts + SETTLED * (enters & ~partial)
    return [
        about.real, about.imag, mean.real, mean.imag, turn.imag, turn.real - 1, variance, angle_variance
    ]  # fmt: skip


def _write_maps(
    part: tuple[slice, slice], since_key: int, scratch: Array, known: Array, state: Array, found: Array
) -> list[int]:
    """Write the maps of a frame, and which windows were found; return the numbers of windows."""
    inside = np.zeros(state.shape[1:], bool)
    inside[part] = True
    floats, flags = state.view(np.float32), state[FLAGS]
    is_found = inside & np.isfinite(scratch[0])
    touched = inside & ((flags & TOUCHED) > 0)
    counted, slipped = touched & ((flags & FOLLOWED) > 0), (flags & SLIPPED) > 0
    if since_key:
        flags |= SEEN * is_found
    moved = np.where(is_found, scratch[:2] + known[4:6], np.nan)
    noise = scratch[2:5] + known[6:9]
    noise[:2] += scratch[5:7]
    noise = np.where(np.isfinite(moved[0]), noise, np.nan)
    status = np.where(
        counted, np.where(slipped, _SLIPS, _STICKS), np.where(touched, _NO_TEXTURE, _NO_CONTACT)
    )
    status[counted & ~(is_found & np.isfinite(floats[FIXED]))] = _UNKNOWN
    maps = [np.moveaxis(values, 0, -1).ravel() for values in (moved, np.sqrt(noise[:2]), noise)]
    windows = inside.size
    found.view(np.float32)[NUMBERS : NUMBERS + 7 * windows] = np.concatenate(maps)
    found[NUMBERS + 7 * windows :] = np.concatenate([status.ravel(), state[ONSET].ravel()])
    masks = counted, counted & slipped, touched & ((flags & SEEN) > 0), touched & is_found
    return [int(np.count_nonzero(mask)) for mask in masks]
