"""Errors of the travel are part of the standard deviation of heights."""

import numpy as np
import pytest
from bare import find_change_point, find_onset
from stacks import MadeUp

from mirrorskin import engine, io

STEP, SIGMA = 0.02, 0.002
LEVELS = {"dark": 30.0, "bright": 230.0}


def jittered(seed):
    """Frames of a press that was not quite where it should be, the travel it should have, and the onset."""
    generator = np.random.default_rng(seed)
    travel = STEP * np.arange(60)
    onset = generator.uniform(0.2, 1.0, (40, 50))
    actual = travel + generator.normal(0, SIGMA, 60)
    light = np.clip((actual[:, None, None] - onset) / (5 * STEP) + 0.5, 0, 1)
    counts = 30 + 200 * light + generator.normal(0, 1, light.shape)
    return np.clip(np.rint(counts), 0, 255).astype(np.uint8), travel, onset


@pytest.mark.parametrize(("find", "lowest"), [(find_onset, 0.5), (find_change_point, 0.2)])
def test_heights_of_a_travel_that_jitters_have_true_errors(find, lowest):
    squares = []
    for seed in range(8):
        frames, travel, onset = jittered(seed)
        result = find(frames, travel, travel_sigma=SIGMA, **LEVELS)
        valid = result.status == 1
        squares.append(np.mean(((-result.height - onset) / result.height_sigma)[valid] ** 2))
    assert lowest < np.mean(squares) < 1.5  # a change-point averages over frames


def test_without_it_the_travel_is_exact():
    frames, travel, _ = jittered(0)
    exact = engine.find_onset(frames, travel, **LEVELS).height_sigma
    sigma = engine.find_onset(frames, travel, travel_sigma=SIGMA, **LEVELS).height_sigma
    expected = np.hypot(exact, np.sqrt(2 / 3) * SIGMA)
    np.testing.assert_allclose(sigma, expected, rtol=1e-5)


def test_a_recording_stores_it(tmp_path):
    frames, travel, _ = jittered(0)

    levels = {name: np.full((40, 50), value, np.float32) for name, value in LEVELS.items()}
    source = MadeUp(frames, io.Header("vertical", travel_sigma=SIGMA, **levels), travel=travel)
    with io.Recorder(source, tmp_path / "press.h5") as recorder:
        recorder.drain(lambda frame_count: None)
    with io.open_recording(tmp_path / "press.h5") as recording:
        result = engine.reconstruct(recording)
    assert result.process["travel_sigma"] == SIGMA
    expected = engine.find_onset(frames, travel, travel_sigma=SIGMA, **LEVELS)
    np.testing.assert_array_equal(result.height_sigma, expected.height_sigma)
