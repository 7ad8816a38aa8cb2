"""The estimated frequency, compared with the Cramer-Rao bound, and its use."""

from __future__ import annotations

import numpy as np
import pytest

from mirrorskin import engine, io
from mirrorskin.engine.vibration import estimate_frequency
from mirrorskin.engine.vibration.lock_in import LockIn
from mirrorskin.io.files.arrays import ArrayRecording

RATE, COUNT, HERTZ = 60.0, 150, 7.321
TIME = np.arange(COUNT) / RATE
NOISE = 2.0


def waves(amplitude, phase, time=TIME, hertz=HERTZ, seed=1, harmonic=0.0):
    """Samples of pixels with any amplitude and phase, (T, n)."""
    angle = 2 * np.pi * hertz * time[:, np.newaxis]
    noise = np.random.default_rng(seed).normal(0, NOISE, (len(time), len(amplitude)))
    return 100 + amplitude * np.cos(angle - phase) + harmonic * np.cos(2 * angle - 0.4) + noise


def bound(amplitude, time=TIME):
    """The standard deviation of an unbiased estimate, Hz, of waves of many periods (Rife and Boorstyn)."""
    spread = np.sum((time - time.mean()) ** 2)
    return NOISE / np.sqrt(np.sum(amplitude**2) / 2 * spread) / (2 * np.pi)


@pytest.mark.parametrize("case", ["one pixel", "pixels", "uneven", "few of many"])
def test_it_reaches_the_cramer_rao_bound_and_reports_it(case):
    random = np.random.default_rng(5)
    time = np.sort(TIME + random.uniform(0, 0.3 / RATE, COUNT)) if case == "uneven" else TIME
    time = time[random.uniform(size=COUNT) > 0.1] if case == "uneven" else time
    amplitude = np.full({"one pixel": 1, "few of many": 60}.get(case, 30), 3.0)
    if case == "few of many":
        amplitude[8:] = 0
    phase = random.uniform(0, 2 * np.pi, len(amplitude))
    estimates = [estimate_frequency(waves(amplitude, phase, time, seed=seed), time) for seed in range(250)]
    error = np.array([estimate.hertz for estimate in estimates]) - HERTZ
    assert np.sqrt(np.mean(error**2)) / bound(amplitude, time) == pytest.approx(1, abs=0.12)
    assert np.mean(
        [(e / estimate.sigma) ** 2 for e, estimate in zip(error, estimates, strict=True)]
    ) == pytest.approx(1, abs=0.22)
    assert abs(error.mean()) < 4 * bound(amplitude, time) / np.sqrt(len(estimates))


def stack(frames, time):
    """Return frames in memory, with times, as a source."""
    source = ArrayRecording(frames, {"phase": np.zeros(len(frames))}, {})
    source.phase, source.time = None, time
    return source


@pytest.mark.parametrize("harmonic", [1, 2])
def test_a_lock_in_finds_the_waves_of_an_estimated_frequency(harmonic, device):
    phase = np.linspace(-1, 1, 12)
    clean = waves(np.full(12, 20.0), phase, harmonic=8.0)
    frames = np.clip(np.rint(clean), 0, 255).astype(np.uint8).reshape(COUNT, 3, 4)
    result = LockIn(harmonic=harmonic, frequency="estimate", device=device).run(stack(frames, TIME))
    assert result.process["frequency"] == pytest.approx(HERTZ, abs=4 * result.process["frequency_sigma"])
    assert result.process.get("harmonic", 1) == harmonic
    expected = {1: phase, 2: np.full(12, 0.4)}[harmonic].reshape(3, 4)
    np.testing.assert_allclose(result.modulation, {1: 20.0, 2: 8.0}[harmonic], atol=1.2)
    np.testing.assert_allclose(result.azimuth, expected, atol=0.2)
    fitted = LockIn(harmonic=harmonic, frequency=HERTZ, frame_rate=RATE).run(stack(frames, None))
    np.testing.assert_allclose(fitted.modulation, result.modulation, rtol=1e-2)


@pytest.mark.parametrize("harmonic", [1, 2, 3])
@pytest.mark.parametrize("dtype", ["uint16", "float32"])
def test_a_harmonic_is_the_fit_of_a_multiple_of_the_phase(harmonic, dtype, device):
    frames = np.random.default_rng(2).integers(0, 4096, (16, 5, 7)).astype(dtype)
    phase = np.arange(16) * np.pi / 8 + 0.1
    correlation = engine.correlate(frames, phase, harmonic=harmonic, device=device)
    same = engine.correlate(frames, harmonic * phase, device=device)
    blocks = engine.Run(engine.Correlate(harmonic=harmonic, device=device))
    for part in np.split(np.arange(16), [5, 6]):
        blocks.push(frames[part], phase=phase[part])
    for name in ("mean", "cosine", "sine", "residual"):
        np.testing.assert_array_equal(getattr(correlation, name), getattr(same, name))
        np.testing.assert_allclose(getattr(blocks.result(), name), getattr(same, name), rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize(
    ("call", "line"),
    [
        (lambda: estimate_frequency(np.zeros(5), np.arange(5)), "5 frames .* at least 8"),
        (lambda: estimate_frequency(np.zeros(9), np.arange(9)[::-1]), "times do not increase"),
        (
            lambda: estimate_frequency(waves(np.zeros(3), np.zeros(3)), TIME),
            "no oscillation exceeds the noise",
        ),
        (lambda: estimate_frequency(np.full((9, 2), np.nan), np.arange(9)), "a missing sample"),
        (
            lambda: engine.correlate(np.zeros((9, 2, 2), "u1"), np.arange(9), harmonic=0),
            "harmonic 0: a number of at least 1",
        ),
        (
            lambda: LockIn(frequency=1.0).run(stack(np.zeros((9, 2, 2), "u1"), None)),
            "the array of frames: the time of each frame is unknown: give the frame rate",
        ),
        (
            lambda: LockIn(frequency="estimate", frame_rate=-1.0),
            "frame_rate -1.*: a number in frames/s above 0",
        ),
    ],
)
def test_what_has_no_frequency_is_one_line(call, line):
    with pytest.raises(io.InputError, match=line) as caught:
        call()
    assert "\n" not in str(caught.value)
