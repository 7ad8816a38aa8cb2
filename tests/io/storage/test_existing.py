"""Files that a new one may replace: checked at the start, and just before the end."""

import re

import h5py
import numpy as np
import pytest
from commands import run
from growing import Feed, stream
from stacks import record, sphere

from mirrorskin import io
from mirrorskin.io.storage.atomic import new_file, write_new

MAP = np.zeros((2, 3), np.float32)
CAMERA = io.CameraId("left", (2, 3), np.dtype(np.uint8))


def foreign(path):
    with h5py.File(path, "w") as file:
        file["raw/images"] = np.zeros((3, 4, 5), np.uint8)


def behind_a_user_block(path):
    with h5py.File(path, "w", userblock_size=1024) as file:
        file["raw/images"] = np.zeros((3, 4, 5), np.uint8)


def cut_off(path):
    record(sphere(), path)
    path.write_bytes(path.read_bytes()[:3000])


def messages(path):
    stream(Feed(3), path.with_suffix(".mcap"))
    path.with_suffix(".mcap").rename(path)


def messages_without_an_index(path):
    messages(path)
    path.write_bytes(path.read_bytes()[:200])


def bytes_of(path, write, *arrays, **named):
    with path.open("wb") as file:
        write(file, *arrays, **named)


PROTECTED = {
    "a recording": [lambda path: record(sphere(), path), lambda path: stream(Feed(3), path), messages],
    "a calibration": [lambda path: io.save_calibration(io.Calibration(CAMERA), path)],
    "an HDF5 file of another program": [foreign, behind_a_user_block],
    "an HDF5 file that cannot be read": [cut_off],
    "an array": [lambda path: bytes_of(path, np.save, np.zeros((3, 4, 4)))],
    "an archive": [lambda path: bytes_of(path, np.savez, frames=np.zeros((3, 4, 4)))],
    "a video": [
        lambda path: path.write_bytes(b"RIFF\0\1\0\0AVI LIST"),
        lambda path: path.write_bytes(b"\0\0\0\x18ftypisom"),
        lambda path: path.write_bytes(b"\x1a\x45\xdf\xa3matroska"),
    ],
}
CASES = [(kind, make) for kind, makers in PROTECTED.items() for make in makers]
CASES += [("a recording", messages_without_an_index)]


@pytest.fixture(params=CASES)
def protected(request, tmp_path):
    """A file that cannot be computed again, and what it is."""
    kind, make = request.param
    make(tmp_path / "data.h5")
    return tmp_path / "data.h5", kind


def save(path):
    io.save_result(io.Result(height=MAP), path)


def calibrate(path):
    io.save_calibration(io.Calibration(CAMERA), path)


@pytest.mark.parametrize("write", [save, lambda path: write_new(path, [b"text"]), calibrate])
def test_nothing_that_can_be_computed_replaces_what_cannot(protected, write):
    path, kind = protected
    before = path.read_bytes()
    if kind == "a calibration" and write is calibrate:
        calibrate(path)
        return
    message = f"{path} is {kind}, which this command never replaces: choose another name with -o"
    with pytest.raises(io.InputError, match=f"^{re.escape(message)}$"):
        write(path)
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("replaces", ["nothing", "derived", "calibration"])
def test_a_recording_that_came_meanwhile_is_not_replaced(tmp_path, replaces):
    path = tmp_path / "a.h5"
    with pytest.raises(io.InputError, match=r"a\.h5 (exists and )?is a recording"), new_file(path, replaces):
        stream(Feed(3), path)
    assert io.describe(path)["kind"] == "recording"
    assert list(tmp_path.iterdir()) == [path]


def test_settings_are_not_replaced(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text("a = 1")
    with pytest.raises(io.InputError, match="is a file of settings, which this command never replaces"):
        write_new(path, [b"text"])
    assert path.read_text() == "a = 1"


def test_a_result_replaces_no_file_unless_that_is_asked_for(tmp_path):
    path = tmp_path / "a.h5"
    save(path)
    before = path.read_bytes()
    with pytest.raises(
        io.InputError, match=r"a\.h5 exists: add --overwrite to replace it, or choose another"
    ):
        save(path)
    assert path.read_bytes() == before
    io.save_result(io.Result(zenith=MAP), path, overwrite=True)
    assert list(io.open_result(path).maps()) == ["zenith"]


def test_a_result_that_came_meanwhile_is_not_replaced(tmp_path):
    path = tmp_path / "a.h5"
    with pytest.raises(io.InputError, match=r"a\.h5 exists: add --overwrite"), new_file(path, "unused"):
        save(path)
    assert list(io.open_result(path).maps()) == ["height"]


def test_no_result_replaces_a_recording_even_with_overwrite(tmp_path):
    path = record(sphere(), tmp_path / "a.h5")
    with pytest.raises(io.InputError, match="is a recording, which this command never replaces"):
        io.save_result(io.Result(height=MAP), path, overwrite=True)


def test_results_that_may_be_replaced_and_what_is_exported_are_replaced(tmp_path):
    for path in (tmp_path / "a.h5", tmp_path / "a"):
        save(path)
        io.save_result(io.Result(height=MAP), path, overwrite=True)
        write_new(path, [b"text"])
        write_new(path, [b"more"])
        assert path.read_bytes() == b"more"
    result = io.Result(height=MAP, x=np.arange(3.0), y=np.arange(2.0))
    for _ in range(2):
        io.export_result(result, tmp_path / "a.mcap")


# Commands, on a recording that is none of their inputs.


@pytest.fixture
def desk(tmp_path, monkeypatch):
    """A press and its result, and another recording, which is to stay; in the working directory."""
    monkeypatch.chdir(tmp_path)
    for name in ("press.h5", "precious.h5"):
        record(sphere(), tmp_path / name)
    assert run("reconstruct", "press.h5", "-o", "res.h5").code == 0
    return tmp_path


COMMANDS = [
    ["reconstruct", "press.h5"],
    ["run", "mirrorskin.engine:Onset", "press.h5"],
    ["fuse", "press.h5", "press.h5"],
    ["stitch", "res.h5", "res.h5"],
    ["correlate", "press.h5"],
    ["report", "res.h5"],
    ["calibrate", "references", "--dark", "press.h5", "--bright", "press.h5"],
    ["calibrate", "elastic", "press.h5", "--ball", "4mm"],
    ["bench", "--quick"],
]


@pytest.mark.parametrize("words", COMMANDS, ids=lambda words: words[0])
def test_no_command_writes_over_a_recording(desk, words):
    before = (desk / "precious.h5").read_bytes()
    ended = run(*words, "-o", "precious.h5")
    assert ended.code == 2, ended
    assert ended.said.count("\n") == 1
    assert (desk / "precious.h5").read_bytes() == before


@pytest.mark.parametrize("words", COMMANDS[:4], ids=lambda words: words[0])
def test_no_command_writes_over_a_result_unless_that_is_asked_for(desk, words):
    (desk / "old.h5").write_bytes((desk / "res.h5").read_bytes())
    ended = run(*words, "-o", "old.h5")
    assert ended.code == 2
    message = "old.h5 exists: add --overwrite to replace it, or choose another name with -o"
    assert ended.said == f"mirrorskin: {message}\n"


def test_a_result_is_replaced_with_overwrite(desk):
    assert run("reconstruct", "press.h5", "-o", "res.h5", "--hold", "3", "--overwrite").code == 0
    assert io.open_result("res.h5").process["hold"] == 3


@pytest.mark.parametrize("suffix", [".png", ".tif", ".csv", ".ply", ".stl", ".npz", ".mcap"])
def test_no_export_writes_over_a_recording_whatever_its_name(desk, suffix):
    path = (desk / "precious.h5").rename(desk / f"precious{suffix}")
    before = path.read_bytes()
    words = [["export", "res.h5", "-o", path.name]]
    if suffix == ".png":
        words.append(["view", "res.h5", "-o", path.name])
    for each in words:
        ended = run(*each)
        assert (ended.code, path.read_bytes() == before) == (2, True), ended
        assert f"{path.name} is a recording, which this command never replaces" in ended.said


@pytest.mark.parametrize(
    "words",
    [
        ["simulate", "vertical", "--size", "24x20", "--frames", "4"],
        ["sample", "slide"],
        ["sample", "stack"],
        ["sample", "video"],
        ["import", "frames.npy", "--motion", "vertical", "--travel-step", "0.1mm"],
    ],
    ids=lambda words: " ".join(words[:2]),
)
def test_a_recording_replaces_another_where_that_is_asked_for(desk, words):
    np.save("frames.npy", np.zeros((4, 5, 6), np.uint8))
    path = (desk / "precious.h5").rename(desk / ("precious.avi" if "video" in words else "precious.h5"))
    before = path.read_bytes()
    refused = run(*words, "-o", path.name)
    assert refused.code == 2
    assert refused.said == (
        f"mirrorskin: {path.name} exists and is a recording: add --overwrite to replace it, or choose"
        " another name with -o\n"
    )
    assert path.read_bytes() == before
    ended = run(*words, "-o", path.name, "--overwrite")
    assert ended.code == 0, ended.said
    assert path.read_bytes() != before


@pytest.mark.parametrize("sample", ["pictures", "calibration"])
def test_a_sample_of_several_files_replaces_none_of_the_user_s(desk, sample):
    path = desk / ("frame07.png" if sample == "pictures" else "ball-3.h5")
    (desk / "precious.h5").rename(path)
    before = sorted(path.name for path in desk.iterdir())
    ended = run("sample", sample, "-o", ".")
    assert ended.code == 2
    assert f"{path.name} exists and is a recording" in ended.said
    assert sorted(path.name for path in desk.iterdir()) == before
