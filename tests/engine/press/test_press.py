"""From a source of a press or its release to a result: used frames and levels, and accuracy."""

import dataclasses
from functools import partial
from typing import get_args

import geometry
import numpy as np
import pytest
from presses import random_press
from stacks import MadeUp, ball, record

from mirrorskin import engine, io
from mirrorskin.engine.press.press import PressMethod
from mirrorskin.kernels.device import open_device

DOWN = 0.1 * np.arange(1, 31)
STROKE = np.concatenate([DOWN, DOWN[::-1]])  # rests for two frames at its greatest travel
SHAPE = (120, 120)
METHODS = get_args(PressMethod)
FIND = {"threshold": engine.find_onset, "change-point": partial(engine.find_change_point, blur=0)}


def twin(travel=STROKE, **header):
    source = ball(SHAPE, 0.1, travel, noise=6.0 if header else 1.5, seed=7)
    source.header = dataclasses.replace(source.header, **header)
    return source


def frames_of(source):
    return source.read(np.empty(source.shape, source.dtype)).frames


def used(result):
    return result.process["event"], result.process["first_frame"], result.process["frames"]


def assert_found(result, onset):
    np.testing.assert_array_equal(result.height, onset.height)
    np.testing.assert_allclose(result.height_sigma, onset.height_sigma, rtol=1e-3)  # own levels are rounded
    np.testing.assert_array_equal(result.status, onset.status)


@pytest.mark.parametrize("method", METHODS)
def test_each_event_is_looked_for_in_its_part_of_a_recording(tmp_path, method):
    source = twin()
    frames, levels = frames_of(source), {"dark": source.header.dark, "bright": source.header.bright}
    with io.open_recording(record(twin(), tmp_path / "both.h5", block=13)) as recording:
        for event, part in (("onset", slice(0, 31)), ("release", slice(29, 60))):
            options = {"method": method, "blur": 0, "fill": False, "memory_limit": 7 * frames[0].size}
            result = engine.reconstruct(recording, event=event, **options)
            assert_found(result, FIND[method](frames[part], STROKE[part], **levels, event=event, blur=0))
            assert used(result) == (event, part.start, 31)
            assert result.process["method"] == method
            assert result.process["dark"] == result.process["bright"] == "map of the recording"


@pytest.mark.parametrize("method", METHODS)
def test_the_heights_of_a_release_are_as_good_as_those_of_the_press(method):
    source = ball((160, 160), 0.08, STROKE, noise=1.5)
    press, release = (
        engine.score(engine.reconstruct(source, event=event, method=method), source.truth).height
        for event in ("onset", "release")
    )
    # Noise decides of the few pixels whose light barely reaches the threshold.
    assert release.answered == pytest.approx(press.answered, rel=0.005)
    assert release.median < 1.03 * press.median
    assert release.p99 < 1.03 * press.p99
    assert abs(release.mean - press.mean) < 0.001
    assert release.chi_square == pytest.approx(press.chi_square, rel=0.2)


def test_the_frames_before_a_release_are_read_but_not_looked_at(monkeypatch):
    """Were they, the first one, dark throughout, would be taken for the release."""
    pushed, counts, push = [], [], engine.Onset.push

    def note(search, frames, *, travel, **options):
        pushed.append(len(frames))
        push(search, frames, travel=travel, **options)

    monkeypatch.setattr(engine.Onset, "push", note)
    limit = 2 * 8 * SHAPE[0] * SHAPE[1]
    engine.reconstruct(twin(), event="release", memory_limit=limit, progress=counts.append)
    assert pushed == [8, 8, 8, 7]
    assert counts == [8, 16, 24, 29, 37, 45, 53, 60]


def test_a_recording_can_be_reconstructed_again_and_after_a_look_into_it():
    source = twin()
    first = engine.reconstruct(source, event="release")
    source.rewind()
    source.read(np.empty((9, *SHAPE), np.uint8))
    np.testing.assert_array_equal(engine.reconstruct(source, event="release").height, first.height)


@pytest.mark.filterwarnings("ignore::mirrorskin.io.MirrorskinWarning")
def test_a_body_that_rests_may_be_asked_for_either():
    for event in ("onset", "release"):
        result = engine.reconstruct(ball((40, 40), 0.3, np.ones(5), noise=0), event=event)
        assert used(result) == (event, 0, 5)
        assert set(np.unique(result.status)) == {2, 3}


@pytest.mark.parametrize(
    ("travel", "options", "words"),
    [
        (DOWN, {"event": "release"}, "twin: sphere: travel only rises: that is a press; give event onset"),
        (DOWN[::-1], {}, "twin: sphere: travel only falls: that is a release; give event release"),
        (np.array([0.2, 0.2, 0.1]), {}, "travel only falls"),
        (np.array([0.1, 0.2, 0.2]), {"event": "release"}, "travel only rises"),
        (DOWN, {"method": "change-point", "subframe": False}, "needs method 'threshold'"),
    ],
)
def test_what_cannot_be_done_is_refused_before_anything_is_read(travel, options, words):
    source = twin(travel)
    with pytest.raises(io.InputError, match=words) as caught:
        engine.reconstruct(source, **options)
    assert "\n" not in str(caught.value)
    assert source.read().index == 0


@pytest.mark.parametrize("missing", [{"dark": None}, {"dark": None, "bright": None}])
def test_a_change_between_unknown_levels_is_read_twice(missing):
    counts, source, limit = [], twin(DOWN, **missing), 2 * 16 * SHAPE[0] * SHAPE[1]
    options = {"method": "change-point", "blur": 0, "fill": False}
    result = engine.reconstruct(source, **options, memory_limit=limit, progress=counts.append)
    source.rewind()
    assert_found(result, engine.find_change_point(frames_of(source), DOWN, blur=0))
    assert counts == [16, 30, 16, 30]
    assert result.process["dark"] == result.process["bright"] == "each pixel's own"
    source = twin(**missing)
    result = engine.reconstruct(source, event="release", **options)
    source.rewind()
    assert_found(
        result, engine.find_change_point(frames_of(source)[29:], STROKE[29:], event="release", blur=0)
    )


def test_a_source_that_cannot_be_read_twice_needs_its_levels():
    source = MadeUp(random_press("uint8", 20, (6, 7)), io.Header("vertical"), travel=np.arange(20) * 0.1)
    with pytest.raises(io.InputError, match=r"made up cannot be read twice.*: give dark and bright"):
        engine.reconstruct(source, method="change-point", dark=20)
    assert source.frames_read == 0
    result = engine.reconstruct(source, method="change-point", dark=20, bright=220)
    assert result.process["frames"] == source.frames_read == 20


def test_a_source_that_does_not_know_its_travel_beforehand_is_taken_as_a_whole():
    frames = np.full((8, 5, 7), 200, np.uint8)
    frames[4:] = 20
    lifted = MadeUp(frames, io.Header("vertical"), travel=0.8 - 0.1 * np.arange(8))
    result = engine.reconstruct(lifted, event="release", dark=20, bright=220)
    np.testing.assert_allclose(result.height, -0.45, rtol=1e-6)
    assert used(result) == ("release", 0, 8)
    pressed = MadeUp(frames, io.Header("vertical"), travel=0.1 * np.arange(8))
    with pytest.raises(io.InputError, match="runs back at frame 1: a release only goes up"):
        engine.reconstruct(pressed, event="release", dark=20, bright=220)


def test_options_replace_fields_of_the_recording():
    options = {"dark": 40, "bright": np.full(SHAPE, 180.0), "noise": 3.0, "threshold": 0.3, "hold": 2}
    result = engine.reconstruct(twin(DOWN), fill=False, **options)
    assert_found(result, engine.find_onset(frames_of(twin(DOWN)), DOWN, **options))
    options_used = {name: result.process[name] for name in options}
    assert options_used == {"dark": 40.0, "bright": "map given", "noise": 3.0, "threshold": 0.3, "hold": 2}


def test_a_result_outlives_its_recording(tmp_path):
    frames, travel = random_press("uint8", 20, (64, 64), seed=4), 0.1 * np.arange(20)
    path = tmp_path / "press.h5"
    with io.Recorder(MadeUp(frames, io.Header("vertical"), travel=travel), path) as recorder:
        recorder.drain(lambda frame_count: None)
    with io.open_recording(path) as recording:
        result = engine.run(recording, engine.Onset(noise=5.0, device=open_device()))
    path.unlink()
    expected = engine.run(frames, engine.Onset(noise=5.0), travel=travel)
    np.testing.assert_array_equal(result.height, expected.height)


class Spiked:
    """A source whose samples are replaced by full white here and there."""

    def __init__(self, source, gain):
        self._source, self._share, self._random = source, gain, np.random.default_rng(0)

    def __getattr__(self, name):
        return getattr(self._source, name)

    def read(self, out=None, /):
        block = self._source.read(out)
        if block is not None:
            block.frames[self._random.random(block.frames.shape) < self._share] = 255
        return block


@pytest.mark.filterwarnings("ignore::mirrorskin.io.MirrorskinWarning")
@pytest.mark.parametrize(("step", "count", "rms"), [(0.1, 30, 0.030), (0.01, 300, 0.0035)])
def test_the_sphere_is_measured_to_the_limit_of_its_steps(step, count, rms):
    shape, pixel, noise, (dark, bright) = (480, 480), 0.025, 1.5, geometry.LEVELS["uint8"]
    travel, surface = step * np.arange(1, count + 1), geometry.sphere(shape, pixel)
    result = engine.reconstruct(ball(shape, pixel, travel, noise=noise, seed=7), fill=False)
    error = result.height - surface.height
    # Pixels that must turn light, by 3 sigma of the noise, and those that must stay dark.
    touched = geometry.first_contact(surface.height, travel) < count
    margin = geometry.light_level(surface.zenith, dark, bright) - (dark + bright) / 2
    clear, never = touched & (margin > 3 * noise), ~touched | ~(margin > -3 * noise)
    answered = np.isfinite(error)
    errors = error[clear & answered]
    assert min(clear.sum(), never.sum()) > 50_000
    assert np.sqrt(np.mean(errors**2)) <= rms
    assert abs(np.mean(errors)) <= 0.03 * step
    assert np.mean(answered[clear]) >= 0.99
    assert np.mean(answered[never]) <= 0.001
    # The sphere bends inside pixels, and nobody characterised the camera: see `Header.prior`.
    assert 0.5 < np.mean((errors / result.height_sigma[clear & answered]) ** 2) < 1.1
    if step == 0.1:
        spiked = engine.reconstruct(
            Spiked(ball(shape, pixel, travel, noise=noise, seed=7), 0.01), fill=False
        ).height
        calm, wrong = np.abs(error), np.abs(spiked - surface.height)
        worse = np.nan_to_num(wrong, nan=np.inf) > np.nan_to_num(calm, nan=np.inf) + 1e-6
        assert 0 < np.mean(worse | (np.isnan(calm) & np.isfinite(wrong))) <= 0.015
