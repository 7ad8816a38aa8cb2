"""The contents of a recording's file, which appears complete or not at all."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from stacks import TRAVEL, MadeUp, assert_same, random_stack, read_all, record, sphere

from mirrorskin import io
from mirrorskin.io.files.recorder import COMPRESSIONS

PHASE = np.arange(8) * np.pi / 4


def full_header():
    """An axial header with everything that a header can say."""
    return io.Header(
        "axial",
        title="a coin, drawn and dull",
        start_time="2026-01-02T03:04:05.678+01:00",
        pixel_size=(0.03, 0.04),
        dark=random_stack("float32", (5, 7), 1),
        bright=random_stack("float32", (5, 7), 2) + np.float32(100),
        press=0.7,
        tilt=np.radians(2.5),
        pivot=(0.1, -0.2, 40.0),
        zenith_gain=np.linspace(50, 60, 35).reshape(5, 7),
        zenith_offset=np.asarray(12.5),
        camera="left",
    )


def layout(path):
    """Return everything in a file: links, and the classes, types, shapes and attributes of objects."""
    actual = {}

    def look(group):
        for name in group:
            link = group.get(name, getlink=True)
            if isinstance(link, h5py.SoftLink):
                actual[f"{group.name}/{name}"] = f"-> {link.path}"
                continue
            node = group[name]
            attrs = {key: np.asarray(value).tolist() for key, value in node.attrs.items()}
            if isinstance(node, h5py.Group):
                actual[node.name] = attrs
                look(node)
            else:
                text = h5py.check_string_dtype(node.dtype)
                actual[node.name] = (node.shape, "text" if text else node.dtype.str[1:], attrs)

    with h5py.File(path) as file:
        actual["/"] = dict(file.attrs)
        look(file)
    return {name.replace("//", "/"): value for name, value in actual.items()}


def test_a_vertical_recording_has_the_layout_of_the_design(tmp_path):
    twin = sphere("uint16")
    image, mm, rad = {"interpretation": "image", "units": "counts"}, {"units": "mm"}, {"units": "rad"}
    instrument = "/entry/instrument"
    assert layout(record(twin, tmp_path / "press.h5", truth=twin.truth)) == {
        "/": {"NX_class": "NXroot", "default": "entry"},
        "/entry": {"NX_class": "NXentry", "default": "data", "mirrorskin_recording": 1},
        "/entry/title": ((), "text", {}),
        "/entry/start_time": ((), "text", {}),
        instrument: {"NX_class": "NXinstrument"},
        f"{instrument}/detector": {"NX_class": "NXdetector"},
        f"{instrument}/detector/data": ((8, 5, 7), "u2", image),
        f"{instrument}/detector/local_name": ((), "text", {}),
        f"{instrument}/detector/x_pixel_size": ((), "f8", mm),
        f"{instrument}/detector/y_pixel_size": ((), "f8", mm),
        f"{instrument}/detector/frame_time": ((8,), "f8", {"units": "s"}),
        f"{instrument}/detector/dark": ((5, 7), "f4", {"units": "counts"}),
        f"{instrument}/detector/frame_checksum": ((8,), "u4", {}),
        f"{instrument}/detector/bright": ((5, 7), "f4", {"units": "counts"}),
        f"{instrument}/stage": {"NX_class": "NXpositioner"},
        f"{instrument}/stage/motion": ((), "text", {}),
        f"{instrument}/stage/travel": ((8,), "f8", mm),
        "/entry/data": {"NX_class": "NXdata", "signal": "frames", "axes": ["travel", ".", "."]},
        "/entry/data/frames": f"-> {instrument}/detector/data",
        "/entry/data/travel": f"-> {instrument}/stage/travel",
        "/entry/truth": {"NX_class": "NXdata", "signal": "height"},
        "/entry/truth/height": ((5, 7), "f4", mm),
        "/entry/truth/zenith": ((5, 7), "f4", rad),
        "/entry/truth/azimuth": ((5, 7), "f4", rad),
        "/entry/truth/contact": ((5, 7), "u1", {}),
    }


def test_an_axial_recording_has_the_layout_of_the_design(tmp_path):
    path = record(MadeUp(random_stack(), full_header(), phase=PHASE), tmp_path / "turn.h5")
    actual = layout(path)
    stage, detector = "/entry/instrument/stage", "/entry/instrument/detector"
    assert actual["/entry/data"]["axes"] == ["phase", ".", "."]
    assert actual["/entry/data/phase"] == f"-> {stage}/phase"
    assert {name: value for name, value in actual.items() if name.startswith(f"{stage}/")} == {
        f"{stage}/motion": ((), "text", {}),
        f"{stage}/phase": ((8,), "f8", {"units": "rad"}),
        f"{stage}/tilt": ((), "f8", {"units": "rad"}),
        f"{stage}/pivot": ((3,), "f8", {"units": "mm"}),
        f"{stage}/travel": ((), "f8", {"units": "mm"}),
    }
    assert actual[f"{detector}/zenith_gain"] == ((5, 7), "f8", {"units": "1/rad"})
    assert actual[f"{detector}/zenith_offset"] == ((), "f8", {"units": "counts"})
    assert f"{detector}/frame_time" not in actual
    with h5py.File(path) as file:
        assert file["/entry/title"].asstr()[()] == "a coin, drawn and dull"
        assert file[f"{stage}/motion"].asstr()[()] == "axial"


@pytest.mark.parametrize(
    ("compression", "dtype", "block"),
    [*((item, "uint16", 3) for item in COMPRESSIONS), ("raw", "uint8", 1), ("bitshuffle", "float32", 8)],
)
def test_what_was_recorded_is_read_back(tmp_path, compression, dtype, block):
    frames, header = random_stack(dtype), full_header()
    path = record(MadeUp(frames, header, time=TRAVEL, phase=PHASE), tmp_path / "turn.h5", compression, block)
    with io.open_recording(path) as recording:
        assert (recording.shape, recording.dtype, recording.motion) == (frames.shape, dtype, "axial")
        assert_same(recording.header, header)
        assert (recording.truth, recording.travel) == (None, None)
        for size in (1, 3, 8, 20):
            recording.rewind()
            actual = read_all(recording, size)
            np.testing.assert_array_equal(actual.frames, frames)
            np.testing.assert_array_equal(actual.time, TRAVEL)
            np.testing.assert_array_equal(actual.phase, PHASE)
            assert (actual.travel, actual.displacement, actual.twist) == (None, None, None)


def test_the_twin_s_recording_is_the_twin(tmp_path):
    twin = sphere("uint16")
    path = record(twin, tmp_path / "press.h5", "bitshuffle", block=3, truth=twin.truth)
    twin.rewind()
    with io.open_recording(path) as recording:
        for actual, expected in zip(read_all(recording, 8), read_all(twin, 8), strict=True):
            np.testing.assert_array_equal(actual, expected)
        assert_same(recording.truth, twin.truth)
        for name in ("title", "pixel_size", "motion"):
            assert getattr(recording.header, name) == getattr(twin.header, name)


@pytest.mark.parametrize(
    ("error", "compression"),
    [
        (io.InputError("frame 3 is gone"), "raw"),
        (OSError(5, "the camera is gone"), "gzip"),
        (KeyboardInterrupt(), "blosc"),
    ],
)
def test_a_source_that_fails_leaves_nothing(tmp_path, compression, error):
    old = tmp_path / "old.h5"
    old.write_bytes(b"as it was")
    source = MadeUp(random_stack(), io.Header("vertical"), fails=error)
    with pytest.raises(type(error)) as caught:
        record(source, old, compression)
    assert caught.value is error
    assert source.left
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"old.h5": b"as it was"}


@pytest.mark.parametrize("announced", [7, 9])
def test_another_number_of_frames_than_announced_leaves_nothing(tmp_path, announced):
    source = MadeUp(random_stack(), io.Header("vertical"), announced=announced)
    with pytest.raises(io.InputError, match=f"made up gave 8 frames and announced {announced}"):
        record(source, tmp_path / "a.h5")
    assert list(tmp_path.iterdir()) == []


FULL_DISK = """
import resource, sys
sys.path.insert(0, sys.argv[2])
from pathlib import Path
import numpy as np
from mirrorskin import io
from mirrorskin.io.files.recorder import COMPRESSIONS
from stacks import MadeUp, random_stack, record

sys.dont_write_bytecode = True  # compiled modules would be cut off, too
resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))
folder = Path(sys.argv[1])
(folder / "old.h5").write_bytes(b"as it was")
source = [MadeUp(random_stack("uint8", (60, 40, 50)), io.Header("vertical")) for _ in COMPRESSIONS]
big = io.Result(height=np.random.default_rng(0).normal(size=(200, 200)).astype("f4"))
work = [lambda s=s, c=c: record(s, folder / "old.h5", c) for s, c in zip(source, COMPRESSIONS)]
for write in [*work, lambda: io.save_result(big, folder / "old.h5", overwrite=True)]:
    try:
        write()
    except io.InputError as error:
        print(error)
assert source[0].frames_read < 60, "went on after the disk was full"
"""


def test_a_full_disk_is_one_line_and_leaves_nothing(tmp_path):
    # A limit to the size of files stands for the full disk; -B, as half a compiled module would stay.
    # HDF5 used to crash at the end of the process.
    support = Path(sys.modules["stacks"].__file__).parent
    command = [sys.executable, "-B", "-c", FULL_DISK, str(tmp_path), str(support)]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    why = "could not be written: File too large; make room, or choose another place with -o"
    assert ended.stdout.splitlines() == [f"{tmp_path}/old.h5 {why}"] * (len(COMPRESSIONS) + 1)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"old.h5": b"as it was"}
