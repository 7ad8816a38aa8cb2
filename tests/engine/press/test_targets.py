"""The whole path on the twin, scored against the tests' own geometry (tests/support/geometry.py)."""

import geometry
import numpy as np
import pytest
from stacks import ball

from mirrorskin import engine, io

SHAPE, PIXEL, NOISE = (480, 480), 0.025, 1.5
DARK, BRIGHT = geometry.LEVELS["uint8"]


class Spiked:
    """A source whose samples are replaced by full white here and there."""

    def __init__(self, source, share, seed=0):
        self._source, self._share, self._random = source, share, np.random.default_rng(seed)

    def __getattr__(self, name):
        return getattr(self._source, name)

    def read(self, out=None, /):
        block = self._source.read(out)
        if block is not None:
            block.frames[self._random.random(block.frames.shape) < self._share] = 255
        return block


def press(step, count, spikes=0.0):
    """Press the twin on the sphere; return the result and the height error, (H, W), mm."""
    travel = step * np.arange(1, count + 1)
    twin = ball(SHAPE, PIXEL, travel, noise=NOISE, seed=7)
    result = engine.reconstruct(Spiked(twin, spikes) if spikes else twin, fill=False)
    return result, result.height - geometry.sphere(SHAPE, PIXEL).height


def populations(step, count):
    """Tell the pixels that must turn light, by 3 sigma of the noise, and those that must stay dark."""
    surface = geometry.sphere(SHAPE, PIXEL)
    touched = geometry.first_contact(surface.height, step * np.arange(1, count + 1)) < count
    margin = geometry.light_level(surface.zenith, DARK, BRIGHT) - (DARK + BRIGHT) / 2
    clear = touched & (margin > 3 * NOISE)
    return clear, ~touched | ~(margin > -3 * NOISE)


@pytest.mark.parametrize(("step", "count", "rms"), [(0.1, 30, 0.030), (0.01, 300, 0.0035)])
def test_the_sphere_is_measured_to_the_limit_of_its_steps(step, count, rms):
    result, error = press(step, count)
    clear, dark = populations(step, count)
    answered = np.isfinite(error)
    errors = error[clear & answered]
    assert np.sqrt(np.mean(errors**2)) <= rms
    assert abs(np.mean(errors)) <= 0.03 * step
    assert np.mean(answered[clear]) >= 0.99
    assert np.mean(answered[dark]) <= 0.001
    assert np.mean((errors / result.height_sigma[clear & answered]) ** 2) == pytest.approx(1, abs=0.1)


def test_the_populations_are_worth_the_name():
    clear, dark = populations(0.1, 30)
    assert clear.sum() > 50_000
    assert dark.sum() > 50_000
    assert not np.any(clear & dark)


def test_spikes_harm_few_pixels():
    _, calm = press(0.1, 30)
    _, spiked = press(0.1, 30, spikes=0.01)
    worse = np.nan_to_num(np.abs(spiked), nan=np.inf) > np.nan_to_num(np.abs(calm), nan=np.inf) + 1e-6
    invented = np.isnan(calm) & np.isfinite(spiked)
    assert 0 < np.mean(worse | invented) <= 0.015


def test_a_rendered_recording_gives_what_the_twin_gives(tmp_path):
    travel = 0.1 * np.arange(1, 31)
    twin = ball((60, 70), 0.15, travel)
    direct = engine.reconstruct(twin)
    twin.rewind()
    with io.Recorder(twin, tmp_path / "sphere.h5", "bitshuffle", truth=twin.truth) as recorder:
        recorder.drain(lambda done: None)
    with io.open_recording(tmp_path / "sphere.h5") as recording:
        stored = engine.reconstruct(recording)
        score = engine.score(stored, recording.truth).height
        assert stored.process["source_fingerprint"] == recording.fingerprint()
    np.testing.assert_array_equal(direct.height, stored.height)
    np.testing.assert_array_equal(direct.status, stored.status)
    assert score.rms < 0.2
