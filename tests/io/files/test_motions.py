"""Recordings of all four motions: stored values, units, and optional values."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import h5py
import numpy as np
import pytest
from stacks import SHAPE, TRAVEL, MadeUp, assert_same, put, random_stack, read_all, record

from mirrorskin import io
from mirrorskin.io.base.types import MOTIONS
from mirrorskin.twin import Axial, Horizontal, Twin, Twist, Vertical

DETECTOR, STAGE, TRUTH = "entry/instrument/detector", "entry/instrument/stage", "entry/truth"
TIME = np.arange(8) / 30
PHASE = np.arange(8) * np.pi / 4
DISPLACEMENT = np.stack([0.01 * np.arange(8), -0.3 + 0.02 * np.arange(8) ** 2], axis=1)
TWIST = np.radians(0.2) * np.array([0, 1, 2, 3, 2, 1, 0, -1])

# What says where the body was, and the header, of each motion.
SERIES = {
    "vertical": ("travel", TRAVEL),
    "axial": ("phase", PHASE),
    "horizontal": ("displacement", DISPLACEMENT),
    "twist": ("twist", TWIST),
}
HEADERS = {
    "vertical": io.Header("vertical", start_time="now"),
    "axial": io.Header("axial", start_time="now", press=1.25, tilt=0.04, pivot=(0.5, -1.5, 40.0)),
    "horizontal": io.Header("horizontal", start_time="now", press=1.25),
    "twist": io.Header("twist", start_time="now", press=1.25),
}
EACH = pytest.mark.parametrize("motion", MOTIONS)


def make(path, motion, truth=None, **changes):
    name, positions = SERIES[motion]
    series = {"time": TIME, name: positions} | changes
    options = {name: values for name, values in series.items() if values is not None}
    return record(
        MadeUp(random_stack(), HEADERS[motion], **options), path / f"{motion}.h5", truth=truth, block=3
    )


def some_truth(slip=None):
    maps = np.random.default_rng(3).normal(size=(3, *SHAPE[1:])).astype(np.float32)
    return io.Truth(*maps, np.eye(5, 7, dtype=np.uint8), slip)


@EACH
def test_where_the_body_was_comes_back_to_the_last_bit(tmp_path, motion):
    name, positions = SERIES[motion]
    with io.open_recording(make(tmp_path, motion)) as recording:
        actual = read_all(recording, 3)
        assert_same(recording.header, HEADERS[motion])
        expected = dict.fromkeys(("travel", "phase", "displacement", "twist")) | {name: positions}
        for series, values in expected.items():
            for options in (getattr(recording, series), getattr(actual, series)):
                assert options is None if values is None else options.dtype == np.float64
                np.testing.assert_array_equal(options, values)
    np.testing.assert_array_equal(actual.frames, random_stack())
    np.testing.assert_array_equal(actual.time, TIME)


@pytest.mark.parametrize(("motion", "shape", "unit"), [("horizontal", (8, 2), "mm"), ("twist", (8,), "rad")])
def test_the_stage_has_the_layout_of_the_design(tmp_path, motion, shape, unit):
    with h5py.File(make(tmp_path, motion)) as file:
        stage = file[STAGE]
        name = SERIES[motion][0]
        assert set(stage) == {"motion", "travel", name}
        assert stage["motion"].asstr()[()] == motion
        assert (stage[name].shape, stage[name].dtype, stage[name].attrs["units"]) == (shape, "f8", unit)
        assert (stage["travel"].shape, stage["travel"].attrs["units"]) == ((), "mm")
        assert stage["travel"][()] == 1.25


BAD: list[tuple[str, str, Any, str | None, str]] = [
    ("horizontal", "displacement", DISPLACEMENT.T, None, r"has shape \(2, 8\) where \(8, 2\) is needed"),
    (
        "horizontal",
        "displacement",
        DISPLACEMENT,
        "deg",
        "displacement is in 'deg', which cannot be converted",
    ),
    ("horizontal", "travel", np.inf, None, "travel is inf, which is not finite: correct it"),
    ("twist", "twist", TWIST[:7], None, r"twist has shape \(7,\) where \(8,\) is needed"),
    ("twist", "twist", TWIST, "mm", "twist is in 'mm', which cannot be converted to rad"),
]


@pytest.mark.parametrize(("motion", "name", "value", "units", "line"), BAD)
def test_a_wrong_statement_in_a_recording_is_reported_in_one_line(tmp_path, motion, name, value, units, line):
    path = make(tmp_path, motion)
    put(path, f"{STAGE}/{name}", value, units)
    with pytest.raises(io.InputError, match=line) as caught:
        io.open_recording(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("slip", "expected"),
    [(None, "height, zenith, azimuth, contact"), (np.eye(5, 7, 2), "height, zenith, azimuth, contact, slip")],
)
def test_slip_may_be_known(tmp_path, slip, expected):
    truth = some_truth(None if slip is None else slip.astype(np.uint8))
    path = make(tmp_path, "twist", truth)
    with io.open_recording(path) as recording:
        assert_same(recording.truth, truth)
    assert io.describe(path)["truth"] == expected
    with h5py.File(path) as file:
        assert set(file[TRUTH]) == set(expected.split(", "))


@pytest.mark.parametrize(("motion", "unit"), [("horizontal", "mm"), ("twist", "rad")])
def test_what_is_known_of_the_skin_comes_back_of_the_part_that_is_read(tmp_path, motion, unit):
    count, rows, columns = SHAPE
    displacement = np.random.default_rng(5).normal(size=(*SHAPE, 2)).astype(np.float32)
    onset = np.where(np.eye(rows, columns) > 0, np.nan, 0.25).astype(np.float32)
    force = np.arange(3.0 * count).reshape(count, 3)
    truth = replace(some_truth(), force=force, displacement=displacement, slip_onset=onset)
    path = make(tmp_path, motion, truth)
    with h5py.File(path) as file:
        units = {name: file[TRUTH][name].attrs["units"] for name in ("force", "displacement", "slip_onset")}
    assert units == {"force": "N", "displacement": "mm", "slip_onset": unit}
    with io.open_recording(path) as recording:
        whole = recording.truth
    assert_same(whole, truth)
    with io.open_recording(path, frames=(1, 3), region=io.Region((1, 4), (2, 6))) as recording:
        part = recording.truth
    np.testing.assert_array_equal(part.force, force[1:3])
    np.testing.assert_array_equal(part.displacement, displacement[1:3, 1:4, 2:6])
    np.testing.assert_array_equal(part.slip_onset, onset[1:4, 2:6])


MOVEMENTS = {
    "vertical": Vertical(TRAVEL),
    "axial": Axial(PHASE, 0.04, 0.8, (0.0, 0.5, 10.0)),
    "horizontal": Horizontal(DISPLACEMENT, 0.8),
    "twist": Twist(TWIST, 0.8),
}


@EACH
def test_the_twin_s_recording_is_the_twin(tmp_path, motion):
    twin = Twin(
        object="sphere",
        shape=(10, 12),
        pixel_size=(0.5, 0.6),
        movement=MOVEMENTS[motion],
        contact="elastic",
    )
    path = record(twin, tmp_path / "twin.h5", block=3, truth=twin.truth)
    assert (twin.truth.slip is not None) == (motion in ("horizontal", "twist"))
    twin.rewind()
    with io.open_recording(path) as recording:
        for actual, expected in zip(read_all(recording, 8), read_all(twin, 5), strict=True):
            np.testing.assert_array_equal(actual, expected)
        assert_same(recording.truth, twin.truth)
        start = recording.header.start_time
        assert_same(recording.header, replace(twin.header, start_time=start))
