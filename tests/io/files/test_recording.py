"""Reading our own recordings: values, units, overriding options, and refusals."""

from __future__ import annotations

import h5py
import hdf5plugin
import numpy as np
import pytest
from stacks import SHAPE, TRAVEL, MadeUp, put, random_stack, read_all, record, sphere

from mirrorskin import io

DETECTOR, STAGE, TRUTH = "entry/instrument/detector", "entry/instrument/stage", "entry/truth"
PHASE = np.arange(8) * np.pi / 4


@pytest.fixture
def press(tmp_path):
    """A vertical recording of the twin."""
    twin = sphere()
    return record(twin, tmp_path / "press.h5", truth=twin.truth)


@pytest.fixture
def turn(tmp_path):
    """An axial recording."""
    header = io.Header(
        "axial", press=0.7, tilt=0.04, pivot=(0.0, 0.0, 40.0), zenith_gain=np.full((5, 7), 50.0)
    )
    return record(MadeUp(random_stack(), header, phase=PHASE), tmp_path / "turn.h5")


@pytest.mark.parametrize(
    ("value", "units", "expected"),
    [
        (TRAVEL * 1e3, "\u00b5m", TRAVEL),
        (TRAVEL / 25.4, "inch", TRAVEL),
        (TRAVEL.astype(">f4"), None, TRAVEL),
        (np.arange(8, dtype=">i2"), "mm", np.arange(8)),
        (TRAVEL, np.bytes_("mm"), TRAVEL),
        (TRAVEL, ["mm"], TRAVEL),
        (TRAVEL, "", TRAVEL),
    ],
)
def test_travel_is_turned_into_millimetres(press, value, units, expected):
    put(press, f"{STAGE}/travel", value, units)
    with io.open_recording(press) as recording:
        np.testing.assert_allclose(recording.travel, expected, rtol=1e-6)
        assert recording.travel.dtype == np.float64


def test_other_numbers_are_turned_into_our_units(turn):
    put(turn, f"{STAGE}/phase", np.arange(8) * 45.0, "deg")
    put(turn, f"{STAGE}/tilt", [2.5], "degree")
    put(turn, f"{STAGE}/pivot", [0.0, 0.1, 4.0], "cm")
    put(turn, f"{STAGE}/travel", 700.0, "um")
    put(turn, f"{DETECTOR}/x_pixel_size", 30.0, "micrometer")
    put(turn, f"{DETECTOR}/y_pixel_size", [0.04], "mm")
    put(turn, f"{DETECTOR}/frame_time", np.arange(8) * 33.0, "ms")
    put(turn, f"{DETECTOR}/zenith_gain", 2.0, "1/deg")
    with io.open_recording(turn) as recording:
        header = recording.header
        np.testing.assert_allclose(recording.phase, PHASE)
        np.testing.assert_allclose(recording.time, np.arange(8) * 0.033)
        np.testing.assert_allclose(header.tilt, np.radians(2.5))
        np.testing.assert_allclose(header.pivot, (0, 1, 40))
        np.testing.assert_allclose(header.press, 0.7)
        np.testing.assert_allclose(header.pixel_size, (0.03, 0.04))
        np.testing.assert_allclose(header.zenith_gain, np.degrees(2.0))


def test_the_truth_is_turned_into_our_units_and_types(press):
    with h5py.File(press, "r+") as file:
        height, zenith = (np.asarray(file[f"{TRUTH}/{name}"], np.float64) for name in ("height", "zenith"))
    put(press, f"{TRUTH}/height", height * 1e3, "um")
    put(press, f"{TRUTH}/zenith", np.degrees(zenith), "deg")
    put(press, f"{TRUTH}/contact", np.ones((5, 7), bool))
    with io.open_recording(press) as recording:
        np.testing.assert_allclose(recording.truth.height, height, rtol=1e-6)
        np.testing.assert_allclose(recording.truth.zenith, zenith, rtol=1e-6)
        assert (recording.truth.height.dtype, recording.truth.contact.dtype) == (np.float32, np.uint8)


def test_a_closed_recording_keeps_its_truth_if_it_was_used(press):
    with io.open_recording(press) as used, io.open_recording(press) as other:
        height = used.truth.height
    assert used.truth.height is height
    with pytest.raises(io.InputError, match="the recording is closed: use its truth before"):
        other.truth  # noqa: B018


def test_what_is_given_overrides_the_file(press):
    with io.open_recording(press, travel=io.Steps(0.5, 1.0), pixel_size=(0.1, 0.2), tilt=0.3) as recording:
        np.testing.assert_allclose(recording.travel, 1.0 + 0.5 * np.arange(8))
        assert recording.header.pixel_size == (0.1, 0.2)
        assert recording.header.tilt == 0.3


@pytest.mark.parametrize("motion", ["axial", "horizontal"])
def test_a_motion_that_contradicts_the_file_is_refused(press, motion):
    line = f"press.h5 states the motion vertical, but --motion is {motion}: leave --motion out"
    with pytest.raises(io.InputError, match=line):
        io.open_recording(press, motion=motion, phase=io.Steps(np.pi / 4))


def test_a_motion_can_be_overridden_on_purpose(press):
    with io.open_recording(
        press, motion="axial", phase=io.Steps(np.pi / 4), override_motion=True
    ) as recording:
        np.testing.assert_allclose(recording.phase, PHASE)
        assert (recording.motion, recording.travel, recording.header.press) == ("axial", None, None)


def test_a_motion_that_agrees_with_the_file_is_taken(press):
    with io.open_recording(press, motion="vertical") as recording:
        np.testing.assert_allclose(recording.travel, TRAVEL)


def test_another_stack_of_a_recording_can_be_named(press):
    other = random_stack("uint16", seed=3)
    put(press, "entry/filtered", other)
    with io.open_recording(press, dataset="entry/filtered") as recording:
        np.testing.assert_array_equal(read_all(recording, 8)[0], other)
        np.testing.assert_allclose(recording.travel, TRAVEL)
        assert recording.dataset == "/entry/filtered"


@pytest.mark.parametrize("packing", ["raw", "gzip"])
def test_frames_are_read_into_the_given_array(tmp_path, packing):
    frames = random_stack()
    path = record(MadeUp(frames, io.Header("axial"), phase=PHASE), tmp_path / "a.h5", packing)
    buffer = np.full(SHAPE, 255, np.uint8)
    with io.open_recording(path) as recording:
        block = recording.read(buffer[:3])
        assert np.shares_memory(block.frames, buffer)
        assert not block.stays_valid
        np.testing.assert_array_equal(block.frames, frames[:3])
        assert (buffer[3:] == 255).all()


@pytest.mark.parametrize(("chunk", "sizes"), [(4, [2, 2, 3, 1, 3, 1, 3, 1]), (1, [3, 3, 3, 3, 3, 1])])
def test_reads_end_where_chunks_end(tmp_path, chunk, sizes):
    path, frames = tmp_path / "a.h5", random_stack(shape=(16, 5, 7))
    with h5py.File(path, "w") as file:
        file.create_dataset("x", data=frames, chunks=(chunk, 5, 7), compression="gzip")
    with io.open_recording(path, motion="vertical", travel=io.Steps(0.1)) as recording:
        first = recording.read(np.empty((2, 5, 7), "u1")) if chunk == 4 else None
        buffer, actual = np.empty((3, 5, 7), "u1"), [] if first is None else [first.frames]
        while (block := recording.read(buffer)) is not None:
            actual.append(block.frames.copy())
    np.testing.assert_array_equal(np.concatenate(actual), frames)
    assert [len(part) for part in actual] == sizes


def test_a_packed_chunk_may_not_be_larger_than_the_memory(tmp_path):
    path = tmp_path / "lump.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("x", (8, 500, 700), "u1", chunks=(8, 500, 700), **hdf5plugin.Bitshuffle())
        file["x"][...] = 0
        file.create_dataset("plain", (8, 500, 700), "u1", chunks=(8, 500, 700))[...] = 0
    options = {"motion": "vertical", "travel": io.Steps(0.1)}
    line = r"lump\.h5: /x is packed in chunks of 2.8 MB where memory is limited to 1 MB: raise --memory"
    with pytest.raises(io.InputError, match=line):
        io.open_recording(path, dataset="x", memory_limit=1_000_000, **options)
    with h5py.File(path, "r+") as file:
        file.create_dataset("single", (8, 500, 700), "u1", chunks=(1, 500, 700), compression="lzf")[...] = 0
    io.open_recording(path, dataset="single", memory_limit=100_000, **options).close()
    io.open_recording(path, dataset="x", memory_limit=2_800_000, **options).close()
    io.open_recording(path, dataset="plain", memory_limit=1_000_000, **options).close()


BAD = [
    (f"{STAGE}/travel", np.where(TRAVEL > 1, np.inf, TRAVEL), None, "travel is inf at frame 4"),
    (f"{STAGE}/travel", TRAVEL[:5], None, r"travel has shape \(5,\) where \(8,\) is needed: give --tr"),
    (f"{STAGE}/travel", ["0"] * 8, None, "travel contains no numbers: give --travel-step"),
    (
        f"{STAGE}/travel",
        None,
        None,
        "does not state the position of the body in each frame: give --travel-step",
    ),
    (f"{STAGE}/travel", TRAVEL, "deg", "travel is in 'deg', which cannot be converted to mm"),
    (f"{STAGE}/travel", TRAVEL, "9**9**9", r"travel is in '9\*\*9\*\*9', which cannot be converted to mm"),
    (f"{STAGE}/travel", h5py.SoftLink("../travel"), None, r"the link travel leads to \.\./travel, which"),
    (f"{STAGE}/motion", None, None, "does not state how the sensor moved: give"),
    (
        f"{STAGE}/motion",
        "sideways",
        None,
        "states the unknown motion 'sideways': give --motion, one of vertical",
    ),
    (f"{STAGE}/motion", ["vertical"] * 2, None, "stage/motion does not hold one value: write"),
    (f"{STAGE}/tilt", np.nan, None, "tilt is nan, which is not finite: give --tilt"),
    (f"{STAGE}/pivot", [0.0, 1.0], None, r"pivot has shape \(2,\) where \(3,\) is needed"),
    (f"{DETECTOR}/x_pixel_size", -0.1, None, r"pixel size \(-0.1, 0.6\) mm: give --pixel-size, above zero"),
    (f"{DETECTOR}/y_pixel_size", 0.1, "px", "y_pixel_size is in 'px', which cannot be converted to mm"),
    (f"{DETECTOR}/y_pixel_size", None, None, "states the pixel size along one axis only: give --pixel-size"),
    (f"{DETECTOR}/dark", np.zeros((7, 5)), None, r"dark has shape \(7, 5\) where \(5, 7\) is needed: give"),
    (f"{DETECTOR}/dark", np.zeros((5, 7), "S1"), None, "dark contains no numbers: give --dark, or take"),
    (f"{DETECTOR}/frame_time", np.zeros(3), None, r"frame_time has shape \(3,\) where \(8,\) is needed"),
    (f"{DETECTOR}/bright", h5py.ExternalLink("no.h5", "/x"), None, r"bright .* leads to no\.h5, which"),
    (f"{DETECTOR}/data", None, None, f"there is no /{DETECTOR}/data: name the stack with --dataset"),
    (f"{TRUTH}/height", None, None, "/entry/truth has no height: simulate it again"),
]


@pytest.mark.parametrize(("name", "value", "units", "line"), BAD)
def test_wrong_properties_of_a_recording_are_reported(press, name, value, units, line):
    put(press, name, value, units)
    with pytest.raises(io.InputError, match=line) as caught:
        io.open_recording(press)
    message = str(caught.value)
    assert message.startswith(str(press))
    assert "\n" not in message


def test_wrong_properties_of_an_axial_recording_are_reported(turn):
    put(turn, f"{STAGE}/phase", np.where(PHASE > 3, np.nan, PHASE))
    with pytest.raises(io.InputError, match=r"turn\.h5: /entry/instrument/stage/phase is nan at frame 4"):
        io.open_recording(turn)
    put(turn, f"{STAGE}/phase", None)
    with pytest.raises(
        io.InputError, match="does not state the position of the body in each frame: give --phase"
    ):
        io.open_recording(turn)


def test_a_recording_is_described(press):
    assert {name: text for name, text in io.describe(press).items() if name != "start"} == {
        "kind": "recording",
        "title": sphere().header.title,
        "motion": "vertical",
        "frames": "8 of 7 x 5, uint8",
        "storage": "in one piece",
        "pixel size": "0.5 x 0.6 mm, field 3.5 x 3 mm",
        "travel": "0 to 2.1 mm",
        "camera": "twin",
        "dark reference": "16 counts (median)",
        "bright reference": "224 counts (median)",
        "truth": "height, zenith, azimuth, contact",
    }


@pytest.mark.parametrize(
    ("compression", "storage"),
    [
        ("bitshuffle", "chunks (1, 5, 7), bitshuffle"),
        ("blosc", "chunks (1, 5, 7), blosc"),
        ("gzip", "chunks (1, 5, 7), shuffle, deflate"),
        ("lzf", "chunks (1, 5, 7), shuffle, lzf"),
    ],
)
def test_packing_is_described(tmp_path, compression, storage):
    header = io.Header("axial", tilt=np.radians(2.5))
    path = record(MadeUp(random_stack(), header, phase=PHASE), tmp_path / "a.h5", compression)
    facts = io.describe(path)
    assert facts["storage"] == storage
    assert (facts["tilt"], facts["phase"]) == ("2.5 deg", "0 to 315 deg")
    assert facts["dark reference"] == facts["truth"] == "none"
