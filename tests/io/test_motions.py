"""Recordings of all four motions: what is kept of each, in which units, and what need not be known."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import h5py
import numpy as np
import pytest
from stacks import SHAPE, TRAVEL, MadeUp, assert_same, plot_of, random_stack, read_all, record

from mirrorskin import hw, io

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
EACH = pytest.mark.parametrize("motion", io.MOTIONS)


def make(path, motion, truth=None, **changes):
    name, positions = SERIES[motion]
    series = {"time": TIME, name: positions} | changes
    known = {name: values for name, values in series.items() if values is not None}
    return record(
        MadeUp(random_stack(), HEADERS[motion], **known), path / f"{motion}.h5", truth=truth, block=3
    )


def put(path, name, value, units=None):
    """Replace a dataset of a file, or take it away."""
    with h5py.File(path, "r+") as file:
        if name in file:
            del file[name]
        if value is not None:
            file[name] = value
            if units is not None:
                file[name].attrs["units"] = units


def some_truth(slip=None):
    maps = np.random.default_rng(3).normal(size=(3, *SHAPE[1:])).astype(np.float32)
    return io.Truth(*maps, np.eye(5, 7, dtype=np.uint8), slip)


@EACH
@pytest.mark.parametrize("size", [1, 3, 20])
def test_where_the_body_was_comes_back_to_the_last_bit(tmp_path, motion, size):
    name, positions = SERIES[motion]
    with io.open_recording(make(tmp_path, motion)) as recording:
        found = read_all(recording, size)
        assert_same(recording.header, HEADERS[motion])
        expected = dict.fromkeys(("travel", "phase", "displacement", "twist")) | {name: positions}
        for series, values in expected.items():
            for given in (getattr(recording, series), getattr(found, series)):
                assert given is None if values is None else given.dtype == np.float64
                np.testing.assert_array_equal(given, values)
    np.testing.assert_array_equal(found.frames, random_stack())
    np.testing.assert_array_equal(found.time, TIME)


@EACH
def test_a_rewound_recording_says_the_same_again(tmp_path, motion):
    name, positions = SERIES[motion]
    with io.open_recording(make(tmp_path, motion)) as recording:
        recording.read(np.empty((5, *SHAPE[1:]), np.uint8))
        block = recording.read(np.empty((2, *SHAPE[1:]), np.uint8))
        np.testing.assert_array_equal(getattr(block, name), positions[5:7])
        recording.rewind()
        np.testing.assert_array_equal(getattr(recording.read(), name), positions[:1])


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


@pytest.mark.parametrize(
    ("motion", "axis"),
    [("vertical", "travel"), ("axial", "phase"), ("horizontal", "frame_time"), ("twist", "twist")],
)
def test_viewers_plot_the_frames_along_what_changes(tmp_path, motion, axis):
    group, signal, axes = plot_of(make(tmp_path, motion))
    assert axes == [axis, ".", "."]
    np.testing.assert_array_equal(signal, random_stack())
    np.testing.assert_array_equal(group[axis], TIME if motion == "horizontal" else SERIES[motion][1])
    assert set(group) == {"frames", axis}


@pytest.mark.parametrize("motion", ["horizontal", "twist"])
def test_viewers_need_neither_time_nor_positions(tmp_path, motion):
    name = SERIES[motion][0]
    assert plot_of(make(tmp_path, motion, **{name: None}))[2] == ["frame_time", ".", "."]
    assert plot_of(make(tmp_path, motion, **{name: None, "time": None}))[2] == []


@pytest.mark.parametrize("motion", ["horizontal", "twist"])
def test_no_method_needs_these_positions_so_they_may_be_unknown(tmp_path, motion):
    name = SERIES[motion][0]
    path = make(tmp_path, motion, **{name: None})
    with io.open_recording(path) as recording:
        assert recording.motion == motion
        assert getattr(recording, name) is None
        assert getattr(recording.read(), name) is None
    assert not [fact for fact in io.describe(path) if fact.startswith(name)]


@pytest.mark.parametrize("motion", ["horizontal", "twist"])
def test_another_s_file_says_nothing_of_positions(tmp_path, motion):
    path = tmp_path / "theirs.h5"
    with h5py.File(path, "w") as file:
        file["frames"] = random_stack()
        file[f"{STAGE}/{motion}"] = "not ours, and not looked at"
    with io.open_recording(path, motion=motion) as recording:
        found = read_all(recording, 3)
    np.testing.assert_array_equal(found.frames, random_stack())
    assert found[1:] == (None,) * 5


@pytest.mark.parametrize("motion", ["vertical", "horizontal"])
def test_positions_of_another_motion_are_not_looked_at(tmp_path, motion):
    path = make(tmp_path, motion)
    put(path, f"{STAGE}/twist", "no numbers")
    put(path, f"{STAGE}/{'travel' if motion == 'horizontal' else 'displacement'}", 0.5)
    with io.open_recording(path) as recording:
        assert recording.twist is None
    with pytest.raises(io.InputError, match=r"stage/twist holds no numbers$"):
        io.open_recording(path, motion="twist")


@pytest.mark.parametrize(
    ("motion", "name", "value", "units", "expected"),
    [
        ("horizontal", "displacement", DISPLACEMENT * 1e3, "um", DISPLACEMENT),
        ("horizontal", "displacement", DISPLACEMENT / 1e3, "m", DISPLACEMENT),
        ("horizontal", "displacement", DISPLACEMENT.astype(">f4"), None, DISPLACEMENT),
        ("twist", "twist", np.degrees(TWIST), "deg", TWIST),
        ("twist", "twist", TWIST / (2 * np.pi), "turn", TWIST),
        ("twist", "twist", TWIST * 1e3, "mrad", TWIST),
    ],
)
def test_positions_are_turned_into_our_units(tmp_path, motion, name, value, units, expected):
    path = make(tmp_path, motion)
    put(path, f"{STAGE}/{name}", value, units)
    with io.open_recording(path) as recording:
        found = getattr(recording, name)
    assert found.dtype == np.float64
    np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.parametrize("motion", ["axial", "horizontal", "twist"])
def test_the_press_is_turned_into_millimetres(tmp_path, motion):
    path = make(tmp_path, motion)
    put(path, f"{STAGE}/travel", [700.0], "um")
    with io.open_recording(path) as recording:
        assert recording.header.press == pytest.approx(0.7)
    put(path, f"{STAGE}/travel", None)
    with io.open_recording(path) as recording:
        assert recording.header.press is None
    assert "press" not in io.describe(path)


BAD: list[tuple[str, str, Any, str | None, str]] = [
    (
        "horizontal",
        "displacement",
        DISPLACEMENT.T,
        None,
        r"displacement has shape \(2, 8\) where \(8, 2\) is",
    ),
    ("horizontal", "displacement", DISPLACEMENT[:5], None, r"has shape \(5, 2\) where \(8, 2\) is needed"),
    ("horizontal", "displacement", TRAVEL, None, r"displacement has shape \(8,\) where \(8, 2\) is needed"),
    ("horizontal", "displacement", DISPLACEMENT, "deg", "displacement is in 'deg', which cannot be turned"),
    ("horizontal", "displacement", DISPLACEMENT, "px", "displacement is in 'px', which cannot be turned"),
    ("horizontal", "displacement", [["a", "b"]] * 8, None, "displacement holds no numbers"),
    ("horizontal", "displacement", h5py.SoftLink("/gone"), None, "the link displacement leads to /gone"),
    ("horizontal", "travel", TRAVEL, None, r"travel has shape \(8,\) where \(\) or \(1,\) is needed"),
    ("horizontal", "travel", np.inf, None, "travel is inf, which is not finite: correct it"),
    ("twist", "twist", DISPLACEMENT, None, r"twist has shape \(8, 2\) where \(8,\) is needed"),
    ("twist", "twist", TWIST[:7], None, r"twist has shape \(7,\) where \(8,\) is needed"),
    ("twist", "twist", 0.3, None, r"twist has shape \(\) where \(8,\) is needed"),
    ("twist", "twist", TWIST, "mm", "twist is in 'mm', which cannot be turned into rad"),
    ("twist", "travel", np.nan, None, "travel is nan, which is not finite: correct it"),
    ("twist", "travel", 1.0, "s", "travel is in 's', which cannot be turned into mm"),
]


@pytest.mark.parametrize(("motion", "name", "value", "units", "line"), BAD)
def test_what_a_recording_says_wrongly_is_told_in_one_line(tmp_path, motion, name, value, units, line):
    path = make(tmp_path, motion)
    put(path, f"{STAGE}/{name}", value, units)
    with pytest.raises(io.InputError, match=line) as caught:
        io.open_recording(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


@EACH
def test_a_recording_is_described(tmp_path, motion):
    facts = io.describe(make(tmp_path, motion))
    own = {
        "vertical": {"travel": "0 to 2.1 mm"},
        "axial": {"phase": "0 to 315 deg", "press": "1.25 mm", "tilt": f"{np.degrees(0.04):g} deg"},
        "horizontal": {
            "displacement x": "0 to 0.07 mm",
            "displacement y": "-0.3 to 0.68 mm",
            "press": "1.25 mm",
        },
        "twist": {"twist": "0 to 0.6 to -0.2 deg", "press": "1.25 mm"},
    }
    names = {"travel", "phase", "press", "tilt", "displacement x", "displacement y", "twist"}
    assert facts["motion"] == motion
    assert {name: text for name, text in facts.items() if name in names} == own[motion]


@pytest.mark.parametrize(
    ("slip", "known"),
    [(None, "height, zenith, azimuth, contact"), (np.eye(5, 7, 2), "height, zenith, azimuth, contact, slip")],
)
def test_slip_may_be_known(tmp_path, slip, known):
    truth = some_truth(None if slip is None else slip.astype(np.uint8))
    path = make(tmp_path, "twist", truth)
    with io.open_recording(path) as recording:
        assert_same(recording.truth, truth)
    assert io.describe(path)["truth"] == known
    with h5py.File(path) as file:
        assert set(file[TRUTH]) == set(known.split(", "))


def test_slip_is_read_however_it_is_written_and_must_fit(tmp_path):
    path = make(tmp_path, "horizontal", some_truth())
    put(path, f"{TRUTH}/slip", np.eye(5, 7, 1, dtype=bool))
    with io.open_recording(path) as recording:
        np.testing.assert_array_equal(recording.truth.slip, np.eye(5, 7, 1))
        assert recording.truth.slip.dtype == np.uint8
    put(path, f"{TRUTH}/slip", np.eye(7, 5))
    with pytest.raises(io.InputError, match=r"truth/slip has shape \(7, 5\) where \(5, 7\) is needed"):
        io.open_recording(path)


def test_slip_alone_is_no_truth(tmp_path):
    path = make(tmp_path, "horizontal")
    put(path, f"{TRUTH}/slip", np.eye(5, 7))
    with pytest.raises(io.InputError, match="truth has no height, zenith, azimuth, contact: simulate it"):
        io.open_recording(path)


MOVEMENTS = {
    "vertical": hw.twin.Vertical(TRAVEL),
    "axial": hw.twin.Axial(PHASE, 0.04, 0.8, (0.0, 0.5, 10.0)),
    "horizontal": hw.twin.Horizontal(DISPLACEMENT, 0.8),
    "twist": hw.twin.Twist(TWIST, 0.8),
}


@EACH
def test_the_twin_s_recording_is_the_twin(tmp_path, motion):
    twin = hw.Twin(
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
        for found, expected in zip(read_all(recording, 8), read_all(twin, 5), strict=True):
            np.testing.assert_array_equal(found, expected)
        assert_same(recording.truth, twin.truth)
        start = recording.header.start_time
        assert_same(recording.header, replace(twin.header, start_time=start))
