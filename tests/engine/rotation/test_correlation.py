"""The correlation: least squares, however a stack is cut, for every type of frame and every phase."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.rotation.correlation import Correlation, Correlator, correlate
from mirrorskin.io import Block, InputError
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.errors import DeviceError

MEASURED = np.deg2rad([178.1, 133.4, 91.0, 44.6, 1.9, 313.7, 268.8, 226.2])
PHASES = {
    "even": 2 * np.pi * np.arange(8) / 8,
    "measured": MEASURED,
    "three": np.array([0.0, 2.0, 4.5]),
    "turns": np.tile(MEASURED, 9) + 0.01 * np.arange(72),
    "narrow": np.linspace(0, 0.6, 20),
}
WEIGHTS = {
    "all": None,
    "missing": [0, 1, 1, 0, 1, 1, 1, 1],
    "uneven": [0.5, 2, 0, 1, 1, 1, 3, 0.1],
    "late": [1] * 7 + [0.3],
}
DTYPES = ["uint8", "uint16", "float32"]
MAPS = ("mean", "cosine", "sine", "residual")
SHAPE = (3, 5)


def swing(
    dtype: str, phase: NDArray[np.float64], shape: tuple[int, int] = SHAPE, noise: float = 0.01
) -> NDArray[Any]:
    """Frames of random means and modulations with noise; the extreme counts are among them."""
    rng = np.random.default_rng(len(phase))
    top = {"uint8": 255, "uint16": 65535, "float32": 3000.0}[dtype]
    mean, azimuth = top * rng.uniform(0.3, 0.7, shape), rng.uniform(0, 2 * np.pi, shape)
    light = mean + 0.2 * top * np.cos(phase[:, np.newaxis, np.newaxis] - azimuth)
    light += noise * top * rng.normal(size=light.shape)
    if dtype == "float32":
        return light.astype(dtype)
    light[rng.random(light.shape) < 0.02] = top
    return np.rint(np.clip(light, 0, top)).astype(dtype)


def least_squares(
    frames: NDArray[Any], phase: NDArray[np.float64], weights: ArrayLike | None
) -> NDArray[np.float64]:
    """Mean, cosine, sine and residual, (4, H, W), by a general solver."""
    weight = np.ones(len(phase)) if weights is None else np.asarray(weights, np.float64)
    used = weight > 0
    root = np.sqrt(weight[used])[:, np.newaxis]
    model = np.stack([np.ones(used.sum()), np.cos(phase[used]), np.sin(phase[used])], axis=1)
    values = frames[used].reshape(used.sum(), -1).astype(np.float64)
    fit = np.linalg.lstsq(root * model, root * values, rcond=None)[0]
    left = np.sum((root * (values - model @ fit)) ** 2, axis=0)
    free = used.sum() - 3
    residual = np.sqrt(left / free) if free else np.full(left.shape, np.nan)
    return np.stack([*fit, residual]).reshape(4, *frames.shape[1:])


def stacked(found: Correlation) -> NDArray[np.float32]:
    return np.stack([getattr(found, name) for name in MAPS])


def push(
    correlator: Correlator, frames: NDArray[Any], phase: ArrayLike, weights: Any = None, cuts: Any = ()
) -> None:
    """Push frames in blocks that are cut as told."""
    phase = np.asarray(phase, np.float64)
    for start, stop in pairwise([0, *cuts, len(frames)]):
        part = None if weights is None else weights[start:stop]
        correlator.push(frames[start:stop], phase=phase[start:stop], frame_weights=part)


def same(one: Correlation, other: Correlation) -> None:
    np.testing.assert_array_equal(stacked(one), stacked(other))
    assert one.frames == other.frames


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("phases", PHASES)
def test_it_is_least_squares(device: Device, dtype: str, phases: str) -> None:
    phase = PHASES[phases]
    frames = swing(dtype, phase)
    found = correlate(frames, phase, device=device)
    expected = least_squares(frames, phase, None)
    # Cosines in steps of 2^-17: what noise does to a fit depends on them by that share, times its condition.
    model = np.stack([phase**0, np.cos(phase), np.sin(phase)], axis=1)
    share = np.linalg.cond(model) * 2.0**-17
    unsure = np.sqrt(np.diag(np.linalg.inv(model.T @ model)))[:, None, None] * np.nan_to_num(expected[3])
    error = np.abs(stacked(found)[:3] - expected[:3])
    assert np.all(error <= share * unsure + 3e-7 * np.abs(expected[:3]) + 1e-7 * np.ptp(frames))
    np.testing.assert_allclose(found.residual, expected[3], rtol=1e-4, atol=1e-5 * np.ptp(frames))
    assert stacked(found).dtype == np.float32
    assert found.frames == len(phase)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("weights", WEIGHTS)
def test_frames_count_by_their_weights(device: Device, dtype: str, weights: str) -> None:
    frames, weight = swing(dtype, MEASURED), WEIGHTS[weights]
    whole = correlate(frames, MEASURED, frame_weights=weight, device=device)
    expected = least_squares(frames, MEASURED, weight)
    for found in (whole, in_window(frames, weight, device)):
        atol = 1e-5 * expected[3].max()
        np.testing.assert_allclose(stacked(found), expected, rtol=1e-5, atol=atol)
        assert found.frames == (8 if weight is None else np.count_nonzero(weight))


def in_window(frames: NDArray[Any], weight: Any, device: Device) -> Correlation:
    """The same by a window that other frames have passed through."""
    correlator = Correlator(frames.shape[1:], frames.dtype, window=8, device=device)
    push(correlator, frames[::-1].copy(), np.arange(8.0))
    push(correlator, frames[:3], np.arange(3.0), [0.25, 0, 1])
    push(correlator, frames, MEASURED, weight, cuts=[1, 4])
    return correlator.result()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("weights", WEIGHTS)
def test_blocks_make_no_difference(device: Device, dtype: str, weights: str) -> None:
    phase = PHASES["turns"][:40]
    frames, weight = swing(dtype, phase), None if WEIGHTS[weights] is None else 5 * WEIGHTS[weights]
    for window in (None, 13):
        found = []
        for cuts in ([], [1, 2, 3, 5, 8, 13, 21, 34], [8, 9, 23, 24]):
            correlator = Correlator(SHAPE, dtype, window=window, device=device)
            push(correlator, frames, phase, weight, cuts)
            found.append(correlator.result())
        same(found[0], found[1])
        same(found[0], found[2])


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_window_forgets_what_has_left_it(device: Device, dtype: str) -> None:
    rng = np.random.default_rng(3)
    phase = 0.7 * np.arange(150.0)
    frames = swing(dtype, phase, noise=0.1)
    correlator = Correlator(SHAPE, dtype, window=9, device=device)
    push(correlator, frames, phase, cuts=np.unique(rng.integers(1, 150, 15)))
    same(correlator.result(), correlate(frames[-9:], phase[-9:], device=device))


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
def test_counts_without_noise_leave_no_residual(device: Device, dtype: str) -> None:
    top = np.iinfo(dtype).max
    mean, swings = np.meshgrid([top // 2, top // 2 + 1], [top // 2 - 2, top // 5, 1, 0])
    phase = np.pi / 2 * np.array([0, 1, 2, 3, 1, 6, 9, 100])
    light = (
        mean
        + np.rint(np.cos(phase))[:, None, None] * swings
        - np.rint(np.sin(phase))[:, None, None] * (swings // 2)
    )
    for window in (None, 8):
        correlator = Correlator(mean.shape, dtype, window=window, device=device)
        push(correlator, light.astype(dtype), phase)
        found = correlator.result()
        np.testing.assert_allclose(found.mean, mean, rtol=1e-7)
        np.testing.assert_allclose(found.cosine, swings, rtol=3e-7, atol=1e-6)
        np.testing.assert_allclose(found.sine, -(swings // 2), rtol=3e-7, atol=1e-6)
        assert np.all(found.residual <= 1e-6 * np.maximum(swings, 1))


@pytest.mark.parametrize("mean", [0.0, 100.0, 1e6])
def test_floats_without_noise_leave_but_their_rounding(device: Device, mean: float) -> None:
    phase = np.linspace(0, 12.0, 64)
    exact = mean + 50 * np.cos(phase - np.linspace(0, 6, 21)[:, np.newaxis, np.newaxis]).T
    frames = np.moveaxis(exact, 1, 0).reshape(64, 3, 7).astype(np.float32)
    rounding = np.std(frames - np.moveaxis(exact, 1, 0).reshape(64, 3, 7))
    found = correlate(frames, phase, device=device)
    assert np.all(found.residual <= 3 * rounding + 50e-7)
    np.testing.assert_allclose(found.modulation, 50, atol=rounding + 1e-5)


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize("window", [None, 64])
def test_no_sum_overflows(device: Device, dtype: str, window: int | None) -> None:
    # The worst for the products: all the light comes at the same phase. The worst for the rest: full light.
    top = np.iinfo(dtype).max
    phase = np.repeat([0, 2.0, 4.0], [62, 1, 1])
    frames = np.full((64, 1, 2), top, dtype)
    frames[62:, 0, 1] = 0
    correlator = Correlator((1, 2), dtype, window=window, device=device)
    for _ in range(10):
        push(correlator, frames, phase)
    count = 64 if window else 10 * 64
    expected = least_squares(np.tile(frames, (count // 64, 1, 1)), np.tile(phase, count // 64), None)
    np.testing.assert_allclose(stacked(correlator.result())[:3], expected[:3], rtol=2e-7, atol=1e-6 * top)


def test_many_turns_are_summed_without_loss(device: Device) -> None:
    phase = 2 * np.pi * np.arange(608) / 16
    frames = swing("uint8", phase, (1, 3))
    whole, correlator = correlate(frames, phase, device=device), Correlator((1, 3), "uint8", device=device)
    for _ in range(3):
        push(correlator, frames, phase, cuts=[100, 200, 250])
    found = correlator.result()
    np.testing.assert_allclose(stacked(found)[:3], stacked(whole)[:3], rtol=3e-7)
    np.testing.assert_allclose(found.residual, whole.residual * np.sqrt(3 * 605 / (3 * 608 - 3)), rtol=1e-6)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_sample_that_is_no_number_spoils_its_pixel_while_it_is_in_the_window(
    device: Device, bad: float
) -> None:
    frames = swing("float32", PHASES["turns"])
    frames[2, 1, 3] = bad
    clean, correlator = np.isfinite(frames[2]), Correlator(SHAPE, "float32", window=8, device=device)
    for start in range(12):
        part = slice(start, start + 1)
        correlator.push(frames[part], phase=PHASES["turns"][part])
        if start < 4:
            continue
        spoilt = start <= 9
        found = stacked(correlator.result())
        assert np.all(np.isfinite(found[:, clean]))
        assert np.all(np.isnan(found[:, ~clean])) == spoilt
    whole = correlate(frames, PHASES["turns"], device=device)
    np.testing.assert_array_equal(np.isnan(stacked(whole)), np.broadcast_to(~clean, (4, *SHAPE)))


@pytest.mark.parametrize("missing", [0, 2])
def test_what_a_missing_frame_holds_does_not_matter(device: Device, missing: int) -> None:
    frames, weights = swing("float32", MEASURED), np.ones(8)
    weights[missing], others = 0, np.arange(8) != missing
    expected = correlate(frames[others], MEASURED[others], device=device)
    frames[missing] = np.nan
    same(correlate(frames, MEASURED, frame_weights=weights, device=device), expected)
    same(in_window(frames, weights, device), expected)


@pytest.mark.parametrize("dtype", DTYPES)
def test_frames_that_are_all_the_same_have_no_modulation(device: Device, dtype: str) -> None:
    found = correlate(np.full((8, 1, 1), 77, dtype), MEASURED, device=device)
    np.testing.assert_array_equal(stacked(found)[:, 0, 0], [77, 0, 0, 0])


def test_a_window_answers_as_soon_as_its_phases_determine_a_fit(device: Device) -> None:
    frames = swing("uint8", MEASURED)
    correlator = Correlator(SHAPE, "uint8", window=8, device=device)
    for count in range(3):
        with pytest.raises(InputError, match=f"{count} frames at {count} different phases"):
            correlator.result()
        correlator.push(frames[count : count + 1], phase=MEASURED[count : count + 1])
    three = correlator.result()
    assert three.frames == 3
    assert np.isnan(three.residual).all()
    expected = least_squares(frames[:3], MEASURED[:3], None)
    np.testing.assert_allclose(stacked(three)[:3], expected[:3], rtol=1e-5)
    push(correlator, frames[3:5], MEASURED[3:5])
    five = correlator.result()
    assert five.frames == 5
    expected = least_squares(frames[:5], MEASURED[:5], None)
    np.testing.assert_allclose(five.residual, expected[3], rtol=1e-3)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("window", [None, 5])
def test_after_a_reset_nothing_is_left(device: Device, dtype: str, window: int | None) -> None:
    frames = swing(dtype, MEASURED)
    used, fresh = (Correlator(SHAPE, dtype, window=window, device=device) for _ in range(2))
    push(used, frames[::-1].copy(), MEASURED, weights=[1, 1, 0.5, 1, 1, 0.5, 1, 1])
    used.result()
    used.reset()
    with pytest.raises(InputError, match="0 frames"):
        used.result()
    for correlator in (used, fresh):
        push(correlator, frames, MEASURED, cuts=[2])
    same(used.result(), fresh.result())


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("window", [None, 8])
@pytest.mark.parametrize("weights", WEIGHTS)
def test_lent_frames_make_no_difference(device: Device, dtype: str, window: int | None, weights: str) -> None:
    frames = swing(dtype, MEASURED)
    memory = np.zeros(frames.nbytes + 64, np.uint8)  # what kernels may read beyond
    lent = memory[: frames.nbytes].view(dtype).reshape(frames.shape)
    lent[:] = frames
    one, other = (Correlator(SHAPE, dtype, window=window, device=device) for _ in range(2))
    one.push(frames, phase=MEASURED, frame_weights=WEIGHTS[weights])
    other.push(lent, phase=MEASURED, lent=True, frame_weights=WEIGHTS[weights])
    same(one.result(), other.result())


@pytest.mark.parametrize("window", [None, 6])
@pytest.mark.parametrize("weights", [None, [1, 1, 1, 0.5, 1, 1, 0, 1]])
def test_frames_may_be_written_into_the_room(device: Device, window: int | None, weights: Any) -> None:
    frames = swing("uint8", MEASURED)
    correlator = Correlator(SHAPE, "uint8", window=window, device=device)
    correlator.room[:8] = frames
    push(correlator, correlator.room[:8], MEASURED, weights)
    elsewhere = Correlator(SHAPE, "uint8", window=window, device=device)
    push(elsewhere, frames, MEASURED, weights)
    same(correlator.result(), elsewhere.result())


@pytest.mark.parametrize(
    ("dtype", "window", "weights"),
    [
        ("uint8", None, "late"),
        ("uint8", 8, "all"),
        ("uint16", None, "all"),
        ("uint16", 8, "late"),
        ("float32", None, "all"),
        ("float32", 8, "missing"),
    ],
)
def test_less_room_gives_the_same_answer(
    small_device: Device, dtype: str, window: int | None, weights: str
) -> None:
    phase, shape = PHASES["turns"][:10], (9, 48)
    frames = swing(dtype, phase, shape)
    weight = None if WEIGHTS[weights] is None else [1, 1, *WEIGHTS[weights]]
    found = []
    for limit in (10**9, 3100):
        small_device.max_allocation = limit
        correlator = Correlator(shape, dtype, window=window, device=small_device)
        push(correlator, frames[:4], phase[:4], None if weight is None else weight[:4])
        correlator.result()
        push(correlator, frames[4:], phase[4:], None if weight is None else weight[4:])
        found.append(correlator.result())
    assert len(correlator._sums.bands) > 1
    same(*found)


def test_one_row_that_does_not_fit_is_said_so(small_device: Device) -> None:
    small_device.max_allocation = 400
    with pytest.raises(DeviceError, match="one row of 100 pixels does not fit"):
        Correlator((4, 100), "uint8", device=small_device)


def test_modulation_and_azimuth_are_those_of_the_swing(device: Device) -> None:
    azimuth = np.array([[-3.0, -1.5, 0.0, 0.5, 3.1]])
    frames = (100 + 40 * np.cos(MEASURED[:, None, None] - azimuth)).astype(np.float32)
    found = correlate(frames, MEASURED, device=device)
    np.testing.assert_allclose(found.modulation, 40, rtol=1e-6)
    np.testing.assert_allclose(found.azimuth, azimuth, atol=1e-6)
    assert found.modulation.dtype == found.azimuth.dtype == np.float32


@pytest.mark.parametrize(
    ("frames", "phase", "weights", "message"),
    [
        (np.zeros((8, 2, 2), np.int16), MEASURED, None, "type int16"),
        (np.zeros((8, 2, 2)), MEASURED, None, "type float64"),
        (np.zeros((8, 2), np.uint8), MEASURED, None, "shape .8, 2."),
        (np.zeros((8, 0, 2), np.uint8), MEASURED, None, "shape .8, 0, 2."),
        (np.zeros((8, 2, 2), np.uint8), MEASURED[:7], None, "shape .7,. for 8 frames"),
        (np.zeros((2, 2, 2), np.uint8), [0, 1], None, "2 frames at 2 different phases"),
        (np.zeros((4, 2, 2), np.uint8), [0, 1, 0, 1], None, "4 frames at 2 different phases"),
        (np.zeros((3, 2, 2), np.uint8), [0, 1e-4, 2e-4], None, "too close together"),
        (np.zeros((3, 2, 2), np.uint8), [0, 1, np.nan], None, "nan at frame 2"),
        (np.zeros((3, 2, 2), np.uint8), [0, 1, 2], [1, 1, 0], "2 frames at 2 different phases"),
        (np.zeros((3, 2, 2), np.uint8), [0, 1, 2], [0, 0, 0], "all 3 frames have weight 0"),
        (np.zeros((3, 2, 2), np.uint8), [0, 1, 2], [1, -2, 1], "weight -2 at frame 1"),
        (np.zeros((3, 2, 2), np.uint8), [0, 1, 2], [1, 1, np.nan], "weight nan at frame 2"),
        (np.zeros((3, 2, 2), np.uint8), [0, 1, 2], [1, 1], "shape .2,. for 3 frames"),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line(
    frames: NDArray[Any], phase: ArrayLike, weights: Any, message: str
) -> None:
    with pytest.raises(InputError, match=message) as caught:
        correlate(frames, phase, frame_weights=weights)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("window", [0, 2, 65, -8])
def test_a_window_has_3_to_64_frames(window: int) -> None:
    with pytest.raises(InputError, match=f"window {window}: .* from 3 to 64"):
        Correlator((2, 2), "uint8", window=window)


def test_a_block_that_does_not_fit_is_refused_and_changes_nothing() -> None:
    frames = swing("uint8", MEASURED)
    for window in (None, 8):
        correlator = Correlator(SHAPE, "uint8", window=window)
        push(correlator, frames, MEASURED)
        before = correlator.result()
        wrong = [
            (Block(frames.astype(np.uint16), 8, phase=MEASURED), None, "expected uint8"),
            (Block(frames[:, 1:], 8, phase=MEASURED), None, r"expected uint8 \(n, \*\(3, 5\)\)"),
            (Block(frames[:0], 8, phase=MEASURED[:0]), None, "expected uint8"),
            (Block(frames, 8), None, "phase is missing"),
            (Block(frames, 8, phase=MEASURED[1:]), None, "for 8 frames"),
            (Block(frames, 8, phase=MEASURED), [1, 2, 3], "for 8 frames"),
            (Block(frames, 8, phase=MEASURED), -np.ones(8), "weight -1.0 at frame 0"),
        ]
        for block, weights, message in wrong:
            with pytest.raises(InputError, match=message):
                correlator.push(block.frames, phase=block.phase, frame_weights=weights)
        same(correlator.result(), before)


def test_more_frames_than_sums_hold_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mirrorskin.engine.rotation.correlation._MAX_FRAMES", 12)
    correlator = Correlator(SHAPE, "uint8")
    push(correlator, swing("uint8", MEASURED), MEASURED)
    with pytest.raises(InputError, match="sums hold 12 frames"):
        push(correlator, swing("uint8", MEASURED), MEASURED)
