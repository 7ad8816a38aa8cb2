"""A rolling shutter exposes each row at another travel; heights are corrected for it."""

import warnings

import numpy as np
import pytest
from stacks import MadeUp

from mirrorskin import engine, io

SHAPE, RATE, SPEED = (64, 40), 30.0, 1.0  # pixels; frames a second; mm/s
LEVELS = {name: np.full(SHAPE, value, np.float32) for name, value in (("dark", 30), ("bright", 230))}
DEPTH = 0.3 + 0.4 * np.linspace(0, 1, SHAPE[1]) * np.ones(SHAPE)  # mm at which pixels are touched


def press(line_time, with_line_time=True, falls=False):
    """Return a press, or its release, seen through a rolling shutter."""
    time = np.arange(36) / RATE
    late = line_time * (np.arange(SHAPE[0]) - (SHAPE[0] - 1) / 2)[:, np.newaxis]
    when = time[:, np.newaxis, np.newaxis] + late
    travel = SPEED * (time[-1] - when if falls else when)
    light = np.clip((travel - DEPTH) / 0.12 + 0.5, 0, 1)
    frames = np.rint(30 + 200 * light).astype(np.uint8)
    header = io.Header("vertical", line_time=line_time if with_line_time else None, **LEVELS)
    stated = SPEED * (time[-1] - time if falls else time)
    return MadeUp(frames, header, travel=stated, time=time)


@pytest.fixture
def error_of(tmp_path):
    """Return the errors of the heights of a press that was recorded, mm."""

    def reconstruct(source, region=None, **options):
        with io.Recorder(source, tmp_path / "press.h5", overwrite=True) as recorder:
            recorder.drain(lambda frame_count: None)
        with io.open_recording(tmp_path / "press.h5", region=region) as recording:
            height = engine.reconstruct(recording, noise=0.5, **options).height
        return height + (DEPTH if region is None else DEPTH[region.slices])

    return reconstruct


@pytest.mark.parametrize("event", ["onset", "release"])
@pytest.mark.parametrize("line_time", [4e-4, -4e-4])
def test_heights_are_those_of_the_travel_of_their_row(error_of, line_time, event):
    error = error_of(press(line_time, falls=event == "release"), event=event)
    assert np.nanmax(np.abs(error)) < 0.002


def test_without_the_line_time_heights_are_wrong_by_the_movement_of_the_body(error_of):
    error = error_of(press(4e-4, with_line_time=False))
    assert np.ptp(np.nanmean(error, axis=1)) == pytest.approx(SPEED * 4e-4 * (SHAPE[0] - 1), rel=0.05)


def test_the_line_time_can_be_given(error_of):
    assert np.nanmax(np.abs(error_of(press(4e-4, with_line_time=False), line_time=4e-4))) < 0.002


def test_a_region_has_the_rows_of_the_whole_picture(error_of):
    assert np.nanmax(np.abs(error_of(press(4e-4), io.Region.read("0,40,40x20")))) < 0.002


def test_frames_without_times_are_refused():
    source = press(4e-4)
    del source._series["time"]
    with pytest.raises(io.InputError, match="a rolling shutter needs the time of each frame"):
        engine.reconstruct(source, noise=0.5)


def test_a_body_that_rests_needs_no_correction(error_of):
    source = press(4e-4)
    source._series["travel"] = np.ones(36)
    with warnings.catch_warnings(action="ignore", category=io.MirrorskinWarning):
        np.testing.assert_allclose(error_of(source) - DEPTH, -1.0, atol=1e-6)
