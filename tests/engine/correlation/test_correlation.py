"""The correlation is the least-squares fit for any division of a stack, type of frame and phase."""

from itertools import pairwise

import numpy as np
import pytest

from mirrorskin.engine import Correlate, Run, correlate
from mirrorskin.io import InputError, MirrorskinWarning

MEASURED = np.deg2rad([178.1, 133.4, 91.0, 44.6, 1.9, 313.7, 268.8, 226.2])
PHASES = {
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
SHAPE = (3, 5)


def swing(dtype, phase, shape=SHAPE, noise=0.01):
    """Frames of random means and modulations with noise; the extreme counts are among them."""
    random = np.random.default_rng(len(phase))
    top = {"uint8": 255, "uint16": 65535, "float32": 3000.0}[dtype]
    mean, azimuth = top * random.uniform(0.3, 0.7, shape), random.uniform(0, 2 * np.pi, shape)
    light = mean + 0.2 * top * np.cos(phase[:, np.newaxis, np.newaxis] - azimuth)
    light += noise * top * random.normal(size=light.shape)
    if dtype == "float32":
        return light.astype(dtype)
    light[random.random(light.shape) < 0.02] = top
    return np.rint(np.clip(light, 0, top)).astype(dtype)


def least_squares(frames, phase, weights=None):
    """Mean, cosine, sine and residual, (4, H, W), by a general solver."""
    weight = np.ones(len(phase)) if weights is None else np.asarray(weights, np.float64)
    used = weight > 0
    root = np.sqrt(weight[used])[:, np.newaxis]
    model = np.stack([np.ones(used.sum()), np.cos(phase[used]), np.sin(phase[used])], axis=1)
    values = frames[used].reshape(used.sum(), -1).astype(np.float64)
    fit = np.linalg.lstsq(root * model, root * values, rcond=None)[0]
    squares = np.sum((root * (values - model @ fit)) ** 2, axis=0)
    free = used.sum() - 3
    residual = np.sqrt(squares / free) if free else np.full(squares.shape, np.nan)
    return np.stack([*fit, residual]).reshape(4, *frames.shape[1:])


def stacked(correlation):
    return np.stack([correlation.mean, correlation.cosine, correlation.sine, correlation.residual])


def push(run, frames, phase, weights=None, cuts=()):
    """Push frames in blocks that are cut as told."""
    for start, stop in pairwise([0, *cuts, len(frames)]):
        part = None if weights is None else weights[start:stop]
        run.push(frames[start:stop], phase=phase[start:stop], frame_weights=part)
    return run


def same(first, other):
    np.testing.assert_array_equal(stacked(first), stacked(other))
    assert first.process["frames"] == other.process["frames"]


@pytest.mark.parametrize(
    ("dtype", "phases"),
    [
        ("uint8", "measured"),
        ("uint8", "narrow"),
        ("uint16", "three"),
        ("uint16", "turns"),
        ("float32", "turns"),
    ],
)
def test_it_is_least_squares(device, dtype, phases):
    phase = PHASES[phases]
    frames = swing(dtype, phase)
    correlation, expected = correlate(frames, phase, device=device), least_squares(frames, phase)
    # Cosines in steps of 2^-17: what noise does to a fit depends on them by that share, times its condition.
    model = np.stack([phase**0, np.cos(phase), np.sin(phase)], axis=1)
    tolerance = np.linalg.cond(model) * 2.0**-17
    sigma = np.sqrt(np.diag(np.linalg.inv(model.T @ model)))[:, None, None] * np.nan_to_num(expected[3])
    error = np.abs(stacked(correlation)[:3] - expected[:3])
    assert np.all(error <= tolerance * sigma + 3e-7 * np.abs(expected[:3]) + 1e-7 * np.ptp(frames))
    np.testing.assert_allclose(correlation.residual, expected[3], rtol=1e-4, atol=1e-5 * np.ptp(frames))
    assert stacked(correlation).dtype == np.float32
    assert correlation.process["frames"] == len(phase)


def in_window(frames, weight, device):
    """The same by a window that other frames have passed through."""
    run = Run(Correlate(window_frames=8, device=device))
    push(run, frames[::-1].copy(), np.arange(8.0))
    push(run, frames[:3], np.arange(3.0), [0.25, 0, 1])
    return push(run, frames, MEASURED, weight, cuts=[1, 4]).result()


@pytest.mark.parametrize(
    ("dtype", "weights"),
    [("uint8", "all"), ("uint8", "uneven"), ("uint16", "missing"), ("uint16", "late"), ("float32", "uneven")],
)
def test_frames_count_by_their_weights(device, dtype, weights):
    frames, weight = swing(dtype, MEASURED), WEIGHTS[weights]
    whole = correlate(frames, MEASURED, frame_weights=weight, device=device)
    expected = least_squares(frames, MEASURED, weight)
    for correlation in (whole, in_window(frames, weight, device)):
        np.testing.assert_allclose(stacked(correlation), expected, rtol=1e-5, atol=1e-5 * expected[3].max())
        assert correlation.process["frames"] == (8 if weight is None else np.count_nonzero(weight))


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_window_forgets_what_has_left_it(device, dtype):
    phase = 0.7 * np.arange(150.0)
    frames, cuts = swing(dtype, phase, noise=0.1), np.unique(np.random.default_rng(3).integers(1, 150, 15))
    run = push(Run(Correlate(window_frames=9, device=device)), frames, phase, cuts=cuts)
    same(run.result(), correlate(frames[-9:], phase[-9:], device=device))


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
def test_counts_without_noise_leave_no_residual(device, dtype):
    top = np.iinfo(dtype).max
    mean, swings = np.meshgrid([top // 2, top // 2 + 1], [top // 2 - 2, top // 5, 1, 0])
    phase = np.pi / 2 * np.array([0, 1, 2, 3, 1, 6, 9, 100])
    cosine, sine = np.rint([np.cos(phase), np.sin(phase)])[:, :, None, None]
    light = (mean + cosine * swings - sine * (swings // 2)).astype(dtype)
    for window in (None, 8):
        result = push(Run(Correlate(window_frames=window, device=device)), light, phase).result()
        np.testing.assert_allclose(result.mean, mean, rtol=1e-7)
        np.testing.assert_allclose(result.cosine, swings, rtol=3e-7, atol=1e-6)
        np.testing.assert_allclose(result.sine, -(swings // 2), rtol=3e-7, atol=1e-6)
        assert np.all(result.residual <= 1e-6 * np.maximum(swings, 1))


@pytest.mark.parametrize("mean", [0.0, 1e6])
def test_floats_without_noise_leave_but_their_rounding(device, mean):
    phase, azimuth = np.linspace(0, 12.0, 64), np.linspace(-3, 3, 21).reshape(3, 7)
    exact = mean + 50 * np.cos(phase[:, None, None] - azimuth)
    frames = exact.astype(np.float32)
    rounding, correlation = np.std(frames - exact), correlate(frames, phase, device=device)
    assert np.all(correlation.residual <= 3 * rounding + 50e-7)
    np.testing.assert_allclose(correlation.modulation, 50, atol=rounding + 1e-5)
    np.testing.assert_allclose(correlation.azimuth, azimuth, atol=0.1 * rounding + 1e-6)


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize("window", [None, 64])
def test_no_sum_overflows(device, dtype, window):
    # The worst for the products: all the light comes at the same phase. The worst for the rest: full light.
    top = np.iinfo(dtype).max
    phase = np.repeat([0, 2.0, 4.0], [62, 1, 1])
    frames = np.full((64, 1, 2), top, dtype)
    frames[62:, 0, 1] = 0
    run = Run(Correlate(window_frames=window, device=device))
    for _ in range(10):
        push(run, frames, phase)
    turns = 1 if window else 10
    expected = least_squares(np.tile(frames, (turns, 1, 1)), np.tile(phase, turns))
    np.testing.assert_allclose(stacked(run.result())[:3], expected[:3], rtol=2e-7, atol=1e-6 * top)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_sample_that_is_not_a_number_spoils_its_pixel_while_it_is_in_the_window(device, bad):
    phase = PHASES["turns"]
    frames = swing("float32", phase)
    frames[2, 1, 3] = bad
    clean, run = np.isfinite(frames[2]), Run(Correlate(window_frames=8, device=device))
    for start in range(12):
        push(run, frames[start : start + 1], phase[start : start + 1])
        if start >= 4:
            maps = stacked(run.result())
            assert np.all(np.isfinite(maps[:, clean]))
            assert np.all(np.isnan(maps[:, ~clean])) == (start <= 9)
    whole = correlate(frames, phase, device=device)
    np.testing.assert_array_equal(np.isnan(stacked(whole)), np.broadcast_to(~clean, (4, *SHAPE)))


@pytest.mark.parametrize("missing", [0, 2])
def test_what_a_missing_frame_holds_does_not_matter(device, missing):
    frames, weights = swing("float32", MEASURED), np.ones(8)
    weights[missing], others = 0, np.arange(8) != missing
    expected = correlate(frames[others], MEASURED[others], device=device)
    frames[missing] = np.nan
    same(correlate(frames, MEASURED, frame_weights=weights, device=device), expected)
    same(in_window(frames, weights, device), expected)


def test_a_window_answers_as_soon_as_its_phases_determine_a_fit(device):
    frames = swing("uint8", MEASURED)
    run = Run(Correlate(window_frames=8, device=device))
    for count in range(3):
        message = f"{count} frames? at {count}.* phases?" if count else "none have been pushed"
        with pytest.raises(InputError, match=message):
            run.result()
        push(run, frames[count : count + 1], MEASURED[count : count + 1])
    three = run.result()
    assert np.isnan(three.residual).all()
    np.testing.assert_allclose(stacked(three)[:3], least_squares(frames[:3], MEASURED[:3])[:3], rtol=1e-5)
    five = push(run, frames[3:5], MEASURED[3:5]).result()
    assert (three.process["frames"], five.process["frames"]) == (3, 5)
    np.testing.assert_allclose(five.residual, least_squares(frames[:5], MEASURED[:5])[3], rtol=1e-3)


@pytest.mark.parametrize(
    ("frames", "phase", "weights", "message"),
    [
        (np.zeros((4, 2, 2), np.uint8), [0, 1, 0, 1], None, "4 frames at 2 different phases"),
        (np.zeros((3, 2, 2), np.uint8), [0, 1, 2], [1, 1, 0], "2 frames at 2 different phases"),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line(frames, phase, weights, message):
    with pytest.raises(InputError, match=message) as caught:
        correlate(frames, phase, frame_weights=weights)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("window", [None, 8])
def test_a_block_that_does_not_fit_is_refused_and_changes_nothing(window, monkeypatch):
    monkeypatch.setattr("mirrorskin.engine.correlation.correlation._MAX_FRAMES", 12)
    frames = swing("uint8", MEASURED)
    run = push(Run(Correlate(window_frames=window)), frames, MEASURED)
    before = run.result()
    with pytest.raises(InputError, match=r"weight -1\.0 at frame 0"):
        run.push(frames, phase=MEASURED, frame_weights=-np.ones(8))
    if window is None:
        with pytest.raises(InputError, match="at most 12 frames can be summed"):
            run.push(frames, phase=MEASURED)
    same(run.result(), before)


def test_phases_in_degrees_are_reported():
    frames = swing("uint8", MEASURED)
    with pytest.warns(MirrorskinWarning, match="phases step by 4[0-9.]* rad from frame to frame: are they"):
        correlate(frames, np.degrees(MEASURED))
