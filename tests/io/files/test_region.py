"""A part of a recording: a rectangle of the picture, some of its frames, and their properties."""

from __future__ import annotations

import re

import h5py
import numpy as np
import pytest
from stacks import SHAPE, MadeUp, random_stack, read_all, record

from mirrorskin import io

REGION = io.Region((1, 4), (2, 7))
PART = np.s_[1:4, 2:7]
MAP = np.arange(35.0).reshape(5, 7)


def axial(path, pivot=(0.5, -0.25, 40.0), pixel_size=(0.1, 0.2), gain=MAP, offset=7.5):
    header = io.Header(
        "axial",
        pixel_size=pixel_size,
        press=0.7,
        tilt=0.04,
        pivot=pivot,
        dark=MAP.astype("f4"),
        bright=(MAP + 200).astype("f4"),
        zenith_gain=gain,
        zenith_offset=offset,
    )
    source = MadeUp(random_stack(), header, phase=np.arange(8) / 2, time=np.arange(8) / 30)
    return record(source, path)


def test_everything_is_cut_alike(tmp_path):
    path = axial(tmp_path / "a.h5")
    with io.open_recording(path, region=REGION, frames=(2, 7)) as recording:
        header, actual = recording.header, read_all(recording, 3)
        assert (recording.shape, recording.full_shape) == ((5, 3, 5), SHAPE)
        assert (recording.origin, recording.first_frame) == ((1, 2), 2)
    np.testing.assert_array_equal(actual.frames, random_stack()[2:7][:, *PART])
    np.testing.assert_array_equal(actual.phase, np.arange(2, 7) / 2)
    np.testing.assert_array_equal(actual.time, np.arange(2, 7) / 30)
    np.testing.assert_array_equal(header.dark, MAP[PART])
    np.testing.assert_array_equal(header.bright, MAP[PART] + 200)
    np.testing.assert_array_equal(header.zenith_gain, MAP[PART])
    assert header.zenith_offset == 7.5
    assert (header.dark.dtype, header.zenith_gain.dtype) == (np.float32, np.float64)
    assert all(values.flags.c_contiguous for values in (header.dark, header.bright, header.zenith_gain))
    assert (header.press, header.tilt, header.pixel_size) == (0.7, 0.04, (0.1, 0.2))


def test_the_pivot_stays_where_it_is_on_the_object(tmp_path):
    path = axial(tmp_path / "a.h5", pivot=(0.5, -0.25, 40.0))
    x, y = io.pixel_axes((5, 7), (0.1, 0.2))
    here_x, here_y = io.pixel_axes((3, 5), (0.1, 0.2))
    with io.open_recording(path, region=REGION) as recording:
        pivot = recording.header.pivot
    np.testing.assert_allclose(pivot[0] - here_x, 0.5 - x[2:7])
    np.testing.assert_allclose(pivot[1] - here_y, -0.25 - y[1:4])
    assert pivot[2] == 40
    with io.open_recording(path, region=REGION, pixel_size=(1.0, 1.0)) as recording:
        np.testing.assert_allclose(recording.header.pivot, (0.5 - 1, -0.25 + 0, 40))
    with io.open_recording(path) as recording:
        assert recording.header.pivot == (0.5, -0.25, 40)


def test_other_series_are_cut(tmp_path):
    moves, turns = np.arange(16.0).reshape(8, 2), np.arange(8.0)
    for motion, name, values in (("horizontal", "displacement", moves), ("twist", "twist", turns)):
        header = io.Header(motion, press=0.5)
        path = record(MadeUp(random_stack(), header, **{name: values}), tmp_path / f"{motion}.h5")
        with io.open_recording(path, frames=(3, 6)) as recording:
            np.testing.assert_array_equal(getattr(read_all(recording, 2), name), values[3:6])


def test_only_the_travel_of_the_range_must_be_right(tmp_path):
    travel = np.array([0.0, 0.5, 0.2, 0.3, 0.4, np.nan, 0.6, 0.7])
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file["x"] = random_stack()
    with io.open_recording(path, motion="vertical", travel=travel, frames=(2, 5)) as recording:
        np.testing.assert_array_equal(recording.travel, travel[2:5])
    with io.open_recording(path, motion="vertical", travel=io.Steps(0.1), frames=(2, 5)) as recording:
        np.testing.assert_allclose(recording.travel, (0.2, 0.3, 0.4))
    with pytest.raises(io.InputError, match="is nan at frame 5"):
        io.open_recording(path, motion="vertical", travel=travel, frames=(3, 8))
    with pytest.raises(io.InputError, match="is nan at frame 5"):
        io.open_recording(path, motion="axial", phase=travel, frames=(3, 7))
    with pytest.raises(io.InputError, match=re.escape("has shape (3,) for 8 frames")):
        io.open_recording(path, motion="axial", phase=travel[:3], frames=(2, 5))


@pytest.mark.parametrize(
    ("rows", "columns", "line"),
    [
        ((0, 6), (0, 7), "a region of rows 0 to 6, where the picture has 5: give a start from 0"),
        ((-1, 3), (0, 7), "a region of rows -1 to 3"),
        ((0, 5), (0, 8), "a region of columns 0 to 8, where the picture has 7"),
    ],
)
def test_a_region_outside_the_picture_is_refused(tmp_path, rows, columns, line):
    path = axial(tmp_path / "a.h5")
    with pytest.raises(io.InputError, match=line) as caught:
        io.open_recording(path, region=io.Region(rows, columns))
    assert str(caught.value).startswith(str(path))
