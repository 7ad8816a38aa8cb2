"""A recording of a press, of its release, or of both: which frames are used, and that both are as good."""

import dataclasses
from typing import get_args

import numpy as np
import pytest
from stacks import MadeUp, ball, record

from mirrorskin import engine, io
from mirrorskin.engine.press.press import PressMethod

DOWN = 0.1 * np.arange(1, 31)
STROKE = np.concatenate([DOWN, DOWN[::-1]])  # rests for two frames at its greatest travel


def twin(travel=STROKE, **options):
    return ball((160, 160), 0.08, travel, **options)


def frames_of(source):
    return source.read(np.empty(source.shape, source.dtype)).frames


def used(result):
    return result.process["event"], result.process["first_frame"], result.process["frames"]


@pytest.mark.parametrize("method", get_args(PressMethod))
def test_each_event_is_looked_for_in_its_part_of_a_recording(tmp_path, method):
    source = twin()
    frames, header = frames_of(source), source.header
    find = engine.find_onset if method == "threshold" else engine.find_change_point
    with io.open_recording(record(twin(), tmp_path / "both.h5", block=13)) as recording:
        for event, part in (("onset", slice(0, 31)), ("release", slice(29, 60))):
            options = {"method": method, "fill": False, "memory_limit": 7 * 160 * 160}
            result = engine.reconstruct(recording, event=event, **options)
            given = find(frames[part], STROKE[part], dark=header.dark, bright=header.bright, event=event)
            np.testing.assert_array_equal(result.height, given.height)
            np.testing.assert_array_equal(result.height_sigma, given.sigma)
            np.testing.assert_array_equal(result.status, given.status)
            assert used(result) == (event, part.start, 31)


@pytest.mark.parametrize("method", get_args(PressMethod))
@pytest.mark.parametrize("noise", [0.0, 1.5, 6.0])
def test_the_heights_of_a_release_are_as_good_as_those_of_the_press(method, noise):
    source = twin(noise=noise)
    press, release = (
        engine.score(engine.reconstruct(source, event=event, method=method), source.truth).height
        for event in ("onset", "release")
    )
    # Noise decides of the few pixels whose light barely reaches the threshold.
    assert release.answered == pytest.approx(press.answered, rel=0.005)
    assert release.coverage == pytest.approx(press.coverage, rel=0.005)
    assert release.median < 1.03 * press.median
    assert release.p99 < 1.03 * press.p99
    assert abs(release.mean - press.mean) < (0.001 if noise < 2 else 0.004)
    if noise < 2 or method == "change-point":  # see the test of pixels that hover about their level
        assert release.chi_square == pytest.approx(press.chi_square, rel=0.2)


def test_a_recording_may_hold_a_release_alone():
    source = twin(DOWN[::-1], seed=3)
    result = engine.reconstruct(source, event="release", fill=False)
    assert used(result) == ("release", 0, 30)
    given = engine.find_onset(
        frames_of(twin(DOWN[::-1], seed=3)),
        DOWN[::-1],
        dark=source.header.dark,
        bright=source.header.bright,
        event="release",
    )
    np.testing.assert_array_equal(result.height, given.height)


@pytest.mark.parametrize("event", ["onset", "release"])
def test_a_body_that_rests_may_be_asked_for_either(event):
    result = engine.reconstruct(twin(np.ones(5), noise=0), event=event)
    assert used(result) == (event, 0, 5)
    assert set(np.unique(result.status)) == {2, 3}


@pytest.mark.parametrize("method", get_args(PressMethod))
@pytest.mark.parametrize(
    ("travel", "event", "words"),
    [
        (DOWN, "release", "twin: sphere: travel only rises: that is a press; give event onset"),
        (DOWN[::-1], "onset", "twin: sphere: travel only falls: that is a release; give event release"),
        (np.array([0.2, 0.2, 0.1]), "onset", "travel only falls"),
        (np.array([0.1, 0.2, 0.2]), "release", "travel only rises"),
        (STROKE, "slip", "unknown event 'slip'; known are onset, release"),
    ],
)
def test_an_event_that_is_not_there_is_refused_before_anything_is_read(method, travel, event, words):
    source = twin(travel)
    with pytest.raises(io.InputError, match=words) as caught:
        engine.reconstruct(source, event=event, method=method)
    assert "\n" not in str(caught.value)
    assert source.read().index == 0


def test_the_frames_before_a_release_are_read_but_not_looked_at(monkeypatch):
    """Were they, the first one, dark throughout, would be taken for the release."""
    pushed, done = [], []
    push = engine.OnsetSearch.push
    monkeypatch.setattr(
        engine.OnsetSearch,
        "push",
        lambda search, block: (pushed.append((block.index, len(block.frames))), push(search, block)),
    )
    limit = 2 * 8 * 160 * 160
    engine.reconstruct(twin(), event="release", memory_limit=limit, progress=done.append)
    assert pushed == [(29, 8), (37, 8), (45, 8), (53, 7)]
    assert done == [8, 16, 24, 29, 37, 45, 53, 60]
    pushed.clear()
    engine.reconstruct(twin(), event="onset", memory_limit=limit)
    assert pushed == [(0, 8), (8, 8), (16, 8), (24, 7)]


def test_a_recording_can_be_reconstructed_again_and_after_a_look_into_it():
    source = twin()
    first = engine.reconstruct(source, event="release")
    source.rewind()
    source.read(np.empty((9, 160, 160), np.uint8))
    np.testing.assert_array_equal(engine.reconstruct(source, event="release").height, first.height)


def test_without_references_a_release_is_read_twice_from_its_own_first_frame():
    source = twin()
    frames = frames_of(source)
    source.header = dataclasses.replace(source.header, dark=None, bright=None)
    result = engine.reconstruct(source, event="release", method="change-point", fill=False)
    given = engine.find_change_point(frames[29:], STROKE[29:], event="release")
    np.testing.assert_array_equal(result.height, given.height)
    assert result.process["dark"] == "each pixel's own"


def test_a_source_that_does_not_know_its_travel_beforehand_is_taken_as_a_whole():
    frames = np.full((8, 5, 7), 200, np.uint8)
    frames[4:] = 20
    levels = {"dark": 20, "bright": 220}
    lifted = MadeUp(frames, io.Header("vertical"), travel=0.8 - 0.1 * np.arange(8))
    result = engine.reconstruct(lifted, event="release", **levels)
    np.testing.assert_allclose(result.height, -0.45, rtol=1e-6)
    assert used(result) == ("release", 0, 8)
    pressed = MadeUp(frames, io.Header("vertical"), travel=0.1 * np.arange(8))
    with pytest.raises(io.InputError, match="runs back at frame 1: a release only goes up"):
        engine.reconstruct(pressed, event="release", **levels)
