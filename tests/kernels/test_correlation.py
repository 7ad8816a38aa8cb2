"""Correlation: the reference against exact numbers, and the kernels against the reference."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from launches import launch
from numpy.typing import NDArray

from mirrorskin.kernels import correlation
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.device import C_TYPES, Device

PIXELS = [1, 1300]
PHASES = np.array([0.1, 1.0, 1.7, 2.9, 3.3, 4.4, 5.2, 6.1, 7.0, 8.8, 9.1])
STEPS = {"uint8": 2**17, "uint16": 2**23}


def samples(dtype: str, pixels: int, seed: int = 0) -> NDArray[Any]:
    """Frames of a full swing, with the extreme counts among them."""
    rng = np.random.default_rng(seed)
    shape = len(PHASES), pixels
    if dtype == "float32":
        return rng.normal(1000, 3, shape).astype(dtype)
    frames = rng.integers(0, np.iinfo(dtype).max, shape, endpoint=True).astype(dtype)
    frames[:, 0] = np.iinfo(dtype).max
    return frames


def steps(dtype: str) -> NDArray[np.int32]:
    """Rows of 1, cosine and sine in whole steps."""
    rows = np.stack([np.ones_like(PHASES), *(STEPS[dtype] * f(PHASES) for f in (np.cos, np.sin))], axis=1)
    return np.rint(rows).astype(np.int32)


def fit_of(rows: NDArray[Any]) -> NDArray[np.float32]:
    """The table of the least-squares fit for sums that were made with these rows."""
    exact = np.stack([np.ones_like(PHASES), np.cos(PHASES), np.sin(PHASES)], axis=1)
    upper = np.linalg.cholesky(exact.T @ (rows[:, :1] * exact)).T
    project = (upper @ np.linalg.inv(rows.T.astype(np.float64) @ exact)).ravel()
    high = project.astype(np.float32)
    table = [high, project - high, np.linalg.inv(upper).ravel(), [1 / (len(PHASES) - 3)]]
    return np.concatenate(table).astype(np.float32)


def run(device: Device, name: str, pixels: int, arguments: list[Any], dtype: str) -> list[Any]:
    """Run a kernel; return its arrays as it leaves them."""
    arrays: list[Array] = []
    values: list[Any] = []
    for argument in arguments:
        if isinstance(argument, np.ndarray):
            arrays.append(device.array("a", argument.shape, argument.dtype))
            arrays[-1].host[...] = argument
            arrays[-1].upload()
            values.append(arrays[-1])
        else:
            values.append(argument)
    bits = 8 * np.dtype(dtype).itemsize
    kernel = device.kernel("correlation", name, FRAME=C_TYPES[dtype], BITS=bits)
    launch(kernel, -(-pixels // device.layout.tile), *values)
    return [array.download().copy() for array in arrays]


def pairs(sums: NDArray[Any]) -> NDArray[np.float64]:
    """What pairs of floats hold, as the kernels leave them."""
    return np.asarray(sums).view(np.float32).reshape(*sums.shape[:1], 2).astype(np.float64).sum(axis=1)


def close(found: list[Any], expected: Any, dtype: str) -> None:
    """Compare mean, cosine, sine and residual."""
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=3e-7, atol=1e-7 * np.abs(expected[3]).max())


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize("pixels", PIXELS)
@pytest.mark.parametrize(("count", "fresh"), [(1, 1), (11, 0), (150, 1), (150, 0)])
def test_frames_are_added(device: Device, dtype: str, pixels: int, count: int, fresh: int) -> None:
    frames, rows, stride = samples(dtype, pixels + 3), steps(dtype), pixels + 3
    place = np.arange(count, dtype=np.int32) * 5 % len(frames)
    sums = np.random.default_rng(1).integers(-(10**6), 10**6, (4, pixels))
    given = [frames, count, pixels, stride, place, rows[place], fresh, *sums.copy()]
    found = run(device, "correlation_add", pixels, given, dtype)[3:]
    correlation.correlation_add(frames[:, :pixels], place, rows[place], bool(fresh), *sums)
    np.testing.assert_array_equal(found, sums)


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize("pixels", PIXELS)
def test_counts_tell_the_fit(device: Device, dtype: str, pixels: int) -> None:
    frames, rows, place = samples(dtype, pixels), steps(dtype), np.arange(len(PHASES), dtype=np.int32)
    sums = np.zeros((4, pixels), np.int64)
    correlation.correlation_add(frames, place, rows, True, *sums)
    known = len(rows), *(np.int64(n) for n in rows.astype(np.int64).sum(axis=0)[1:])
    fit, answers = fit_of(rows), np.zeros((4, pixels), np.float32)
    found = run(device, "correlation_solve_counts", pixels, [pixels, *known, *sums, fit, *answers], dtype)[5:]
    close(found, correlation.correlation_solve_counts(*known, *sums, fit), dtype)
    given = [frames, len(frames), pixels, pixels, place, rows, *known, fit, *answers]
    at_once = run(device, "correlation_window", pixels, given, dtype)[4:]
    np.testing.assert_array_equal(at_once, found)


def test_narrow_sums_hold_a_whole_window(device: Device) -> None:
    """The largest sums there can be: saturated samples where all cosines are 1."""
    frames, place = (
        np.full((correlation.WINDOW, 5), 255, np.uint8),
        np.arange(correlation.WINDOW, dtype=np.int32),
    )
    rows = np.tile(np.array([1, STEPS["uint8"], -STEPS["uint8"]], np.int32), (len(frames), 1))
    rows[::9, 1:] = 0
    known = len(frames), *(np.int64(n) for n in rows.astype(np.int64).sum(axis=0)[1:])
    fit, answers = np.full(28, 0.001, np.float32), np.zeros((4, 5), np.float32)
    given = [frames, len(frames), 5, 5, place, rows, *known, fit, *answers]
    found = run(device, "correlation_window", 5, given, "uint8")[4:]
    close(found, correlation.correlation_window(frames, place, rows, *known, fit), "uint8")


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize("pixels", PIXELS)
@pytest.mark.parametrize("turns", [1, 50000])
def test_counts_become_pairs(device: Device, dtype: str, pixels: int, turns: int) -> None:
    frames, rows = samples(dtype, pixels), steps(dtype)
    sums = np.zeros((4, pixels), np.int64)
    correlation.correlation_add(frames, np.arange(len(rows), dtype=np.int32), rows, True, *sums)
    sums *= turns
    known = len(rows) * turns, *(np.int64(n) * turns for n in rows.astype(np.int64).sum(axis=0)[1:])
    unit = np.float32(1 / STEPS[dtype])
    given = [pixels, *known, unit, np.zeros(pixels, np.float32), *sums]
    reference, *found = run(device, "correlation_convert", pixels, given, dtype)
    expected = correlation.correlation_convert(*known, unit, *sums)
    # A mean next to a half may be rounded either way: the sums of the samples themselves are the same.
    np.testing.assert_allclose(reference, expected[0], atol=1)
    same = reference == expected[0]
    assert same.mean() > 0.9
    for one, other in zip(found, expected[1:], strict=True):
        np.testing.assert_allclose(pairs(one)[same], other[same], rtol=1e-13)


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
@pytest.mark.parametrize("pixels", PIXELS)
def test_samples_are_summed_as_in_float64(device: Device, dtype: str, pixels: int) -> None:
    frames = samples(dtype, pixels)
    basis = np.random.default_rng(2).normal(1, 3, (len(PHASES), 3)).astype(np.float32)
    kept, state = [np.zeros(pixels, np.float32), *np.zeros((4, pixels, 2), np.float32)], np.zeros((5, pixels))
    for fresh, place in ((1, [3, 1, 4]), (0, [0, 9])):
        which = np.array(place, np.int32)
        given = [frames, len(place), pixels, pixels, which, basis[place], fresh, *kept]
        kept = run(device, "correlation_sum", pixels, given, dtype)[3:]
        correlation.correlation_sum(frames, which, basis[place], bool(fresh), *state)
    np.testing.assert_array_equal(kept[0], frames[3])
    for one, other in zip(kept[1:], state[1:], strict=True):
        np.testing.assert_allclose(pairs(one), other, rtol=1e-13, atol=1e-13 * np.abs(other).max())


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
@pytest.mark.parametrize("pixels", PIXELS)
def test_a_ring_is_summed_anew(device: Device, dtype: str, pixels: int) -> None:
    frames, stride = samples(dtype, pixels), pixels + 5
    rows = np.stack([np.ones_like(PHASES), np.cos(PHASES), np.sin(PHASES)], axis=1).astype(np.float32)
    order = (np.arange(len(frames), dtype=np.int32) + 3) % len(frames)
    ring = np.zeros((len(frames), stride), dtype)
    ring[order, :pixels] = frames
    fit, answers = fit_of(rows), np.zeros((4, pixels), np.float32)
    given = [ring, len(frames), pixels, stride, order, rows, fit, *answers]
    found = run(device, "correlation_window_pairs", pixels, given, dtype)[4:]
    expected = correlation.correlation_window_pairs(ring[:, :pixels], order, rows, fit)
    close(found, expected, dtype)

    state = np.zeros((5, pixels))
    correlation.correlation_sum(ring[:, :pixels], order, rows, True, *state)
    high = state.astype(np.float32)
    held = [
        np.stack([part, whole - part], axis=1).astype(np.float32)
        for part, whole in zip(high, state, strict=True)
    ][1:]
    given = [pixels, high[0], *held, fit, *answers]
    again = run(device, "correlation_solve_pairs", pixels, given, dtype)[6:]
    close(again, expected, dtype)


def test_the_reference_is_least_squares_in_fractions() -> None:
    phases = [(1, 0), (0, 1), (-1, 0), (0, -1)]
    counts = [[10, 200], [17, 3], [12, 250], [200, 0]]
    rows = np.array([[1, c, s] for c, s in phases], np.int32)
    sums = np.zeros((4, 2), np.int64)
    correlation.correlation_add(np.array(counts, np.uint8), np.arange(4, dtype=np.int32), rows, True, *sums)
    upper = np.diag([2, np.sqrt(2), np.sqrt(2)])
    project = np.linalg.inv(upper).ravel()
    high = project.astype(np.float32)
    fit = np.concatenate([high, project - high, np.linalg.inv(upper).ravel(), [1]]).astype(np.float32)
    answers = correlation.correlation_solve_counts(4, 0, 0, *sums, fit)
    for pixel in range(2):
        column = [Fraction(row[pixel]) for row in counts]
        mean = sum(column) / 4
        cosine, sine = (column[0] - column[2]) / 2, (column[1] - column[3]) / 2
        left = sum((e - mean - c * cosine - s * sine) ** 2 for e, (c, s) in zip(column, phases, strict=True))
        expected = [float(mean), float(cosine), float(sine), float(left) ** 0.5]
        np.testing.assert_allclose([answer[pixel] for answer in answers], expected, rtol=1e-6)
