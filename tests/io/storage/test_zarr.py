"""Zarr: the same recordings and results as in HDF5, in folders, zips and stores with addresses."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import threading

import h5py
import numpy as np
import pytest
from stacks import SHAPE, random_stack, read_all, record, sphere

from mirrorskin import engine, io
from mirrorskin.io.base.url import Url, path_of
from mirrorskin.io.files import zarr_export
from mirrorskin.io.storage.atomic import remove_leftovers
from mirrorskin.io.storage.hdf5 import Hdf5File
from mirrorskin.io.storage.zarr import ZarrFile, ZarrFrames

zarr = pytest.importorskip("zarr")

STACK = "entry/instrument/detector/data"
GIVEN = {"motion": "vertical", "travel": io.Steps(0.3)}


@pytest.fixture(scope="module")
def stores(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made")
    io.save_zarr(record(sphere(), folder / "press.h5", truth=sphere().truth), folder / "press.zarr")
    return folder


@pytest.fixture
def pair(stores, tmp_path):
    """A recording of a simulated press, and the same in Zarr."""
    shutil.copytree(stores, tmp_path, dirs_exist_ok=True)
    return tmp_path / "press.h5", tmp_path / "press.zarr"


@pytest.fixture
def memory(pair):
    """The same at an address."""
    import fsspec

    store = fsspec.filesystem("memory")
    io.save_zarr(pair[0], "memory://bucket/press.zarr")
    yield store
    store.rm("/bucket", recursive=True)


def bare(path, frames, **settings):
    zarr.create_array(path, data=frames, **settings)
    return path


def line(path, **options):
    """Return what is said of a stack that is refused, without its name."""
    with pytest.raises(io.InputError) as caught, io.open_recording(path, **options) as recording:
        read_all(recording, 3)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(str(path))
    return message.removeprefix(str(path))


def edit(folder, name, **changes):
    """Change the metadata of an array, and leave no copy of it elsewhere."""
    place = folder / name / "zarr.json"
    place.write_text(json.dumps(json.loads(place.read_text()) | changes))
    root = folder / "zarr.json"
    head = json.loads(root.read_text())
    head.pop("consolidated_metadata", None)
    root.write_text(json.dumps(head))
    return folder


def test_all_that_hdf5_holds_is_there_again(pair):
    with io.open_recording(pair[0]) as first, io.open_recording(pair[1]) as second:
        assert second.header.pixel_size == first.header.pixel_size
        assert (second.header.title, second.header.start_time) == (
            first.header.title,
            first.header.start_time,
        )
        assert second.travel.tolist() == first.travel.tolist()
        assert second.time.tolist() == first.time.tolist()
        np.testing.assert_array_equal(second.header.bright, first.header.bright)
        np.testing.assert_array_equal(second.truth.height, first.truth.height)
        np.testing.assert_array_equal(read_all(second, 3).frames, read_all(first, 3).frames)


def test_attributes_are_those_of_hdf5(pair):
    with h5py.File(pair[0]) as file:
        group = zarr.open_group(pair[1], mode="r")
        assert group["entry"].attrs["mirrorskin_recording"] == 1
        assert group["entry/instrument/stage/travel"].attrs["units"] == "mm"
        assert group["entry/instrument"].attrs["NX_class"] == file["entry/instrument"].attrs["NX_class"]


def test_results_are_the_same_bit_for_bit(pair):
    actual = []
    for path in pair:
        with io.open_recording(path) as recording:
            actual.append(engine.reconstruct(recording))
    for name, values in actual[0].maps().items():
        assert values.tobytes() == actual[1].maps()[name].tobytes(), name


def test_frames_are_fetched_next_to_the_kernels(pair, monkeypatch):
    threads, fetch = set(), ZarrFrames.fetch

    def noted(self, *what):
        threads.add(threading.current_thread().name.rpartition("_")[0])
        fetch(self, *what)

    monkeypatch.setattr(ZarrFrames, "fetch", noted)
    with io.open_recording(pair[1]) as recording:
        engine.reconstruct(recording)
    assert "mirrorskin-read" in threads


def test_an_address_is_a_recording_like_any_other(pair, memory):
    with io.open_recording(pair[0]) as first, io.open_recording("memory://bucket/press.zarr") as second:
        assert str(second.path) == second.name == "memory://bucket/press.zarr"
        np.testing.assert_array_equal(read_all(second, 3).frames, read_all(first, 3).frames)


def test_a_zip_is_read(pair, tmp_path):
    shutil.make_archive(str(tmp_path / "zipped.zarr"), "zip", pair[1])
    with io.open_recording(pair[0]) as first, io.open_recording(tmp_path / "zipped.zarr.zip") as second:
        np.testing.assert_array_equal(read_all(second, 3).frames, read_all(first, 3).frames)


@pytest.mark.parametrize("dtype", ["uint8", ">u2", "float32"])
@pytest.mark.parametrize("chunks", [(3, 4, 7), SHAPE, (1, 5, 7)])
def test_foreign_stacks_need_their_missing_properties(tmp_path, dtype, chunks):
    frames = random_stack(np.dtype(dtype).newbyteorder("=")).astype(dtype)
    path = bare(tmp_path / "x.zarr", frames, chunks=chunks)
    assert "does not state how the sensor moved: give --motion" in line(path)
    with io.open_recording(path, **GIVEN) as recording:
        np.testing.assert_array_equal(read_all(recording, 3).frames, frames)


def test_a_region_and_some_frames_are_cut_out(pair):
    part = io.Region((1, 4), (2, 7))
    with io.open_recording(pair[0]) as whole, io.open_recording(pair[1], region=part, frames=(2, 7)) as piece:
        np.testing.assert_array_equal(read_all(piece, 3).frames, read_all(whole, 3).frames[2:7, 1:4, 2:7])


def test_results_are_read_and_exported(pair, tmp_path):
    with io.open_recording(pair[0]) as recording:
        result = engine.reconstruct(recording)
    io.save_result(result, tmp_path / "res.h5")
    io.save_zarr(tmp_path / "res.h5", tmp_path / "res.zarr")
    again = io.open_result(tmp_path / "res.zarr")
    assert again.process == result.process
    for name, values in result.maps().items():
        np.testing.assert_array_equal(again.maps()[name], values)


def test_a_result_in_memory_is_exported(pair, tmp_path):
    with io.open_recording(pair[0]) as recording:
        result = engine.reconstruct(recording)
    io.export_result(result, tmp_path / "res.zarr")
    np.testing.assert_array_equal(io.open_result(tmp_path / "res.zarr").height, result.height)


def test_a_fingerprint_distinguishes_recordings(pair, tmp_path):
    other = record(sphere("uint16"), tmp_path / "other.h5")
    io.save_zarr(other, tmp_path / "other.zarr")
    io.save_zarr(pair[0], tmp_path / "again.zarr")
    prints = []
    for path in (pair[1], tmp_path / "again.zarr", tmp_path / "other.zarr"):
        with io.open_recording(path) as recording:
            prints.append(recording.fingerprint())
    assert prints[0] == prints[1] != prints[2]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"shape": [8, 5]}, "it is damaged"),
        ({"shape": [1 << 40, 5, 7]}, "is missing: copy it again, or write empty ones, too"),
        ({"shape": [1 << 70, 5, 7]}, "it is damaged"),
        ({"shape": [-8, 5, 7]}, "it is damaged"),
        ({"shape": "8"}, "it is damaged (the shape of"),
        ({"chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [0, 5, 7]}}}, "it is damaged"),
        ({"chunk_grid": {"name": "odd"}}, "it is damaged (the chunk grid of"),
        ({"chunk_grid": 1}, "it is damaged (the chunk grid of"),
        ({"zarr_format": 2}, "it is damaged"),
        ({"shape": [800, 5, 7]}, "is missing: copy it again, or write empty ones, too"),
        ({"data_type": "complex64"}, ""),
        ({"codecs": [{"name": "unheard-of"}]}, "needs the codec 'unheard-of'; only blosc, bytes, crc32c"),
        ({"node_type": "sheep"}, ""),
    ],
)
def test_impossible_metadata_is_refused(pair, changes, message):
    assert message in line(edit(pair[1], STACK, **changes))


def test_broken_json_is_refused(pair):
    (pair[1] / "zarr.json").write_text("{")
    assert "it is damaged" in line(pair[1])


def test_positions_that_are_no_numbers_are_refused(pair):
    travel = zarr.open_array(pair[1], path="entry/instrument/stage/travel", mode="r+")
    travel[3] = np.nan
    assert "stage/travel" in line(pair[1])


def test_a_claim_of_another_size_is_refused(pair):
    edit(pair[1], "entry/instrument/detector/dark", shape=[1 << 20, 1 << 20])
    assert "has shape (1048576, 1048576) where (5, 7) is needed" in line(pair[1])


@pytest.mark.parametrize(
    ("harm", "message"),
    [(lambda place: place.write_bytes(b"abc" * 9), "it is damaged"), (os.remove, "is missing")],
)
def test_a_damaged_chunk_is_named_by_its_frames(tmp_path, harm, message):
    path = bare(tmp_path / "x.zarr", random_stack(), chunks=(2, 5, 7))
    harm(path / "c/1/0/0")
    actual = line(path, **GIVEN)
    assert ": frames 2 to 3 of /data cannot be read" in actual
    assert message in actual


def test_what_is_not_there_is_reported_with_its_address(memory):
    assert "there is no Zarr array or group" in line(Url("memory://bucket/nothing.zarr"))


def test_a_store_that_does_not_answer_is_reported_with_its_address():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"http://127.0.0.1:{free.getsockname()[1]}/press.zarr"
    assert "the store does not answer" in line(Url(address))


def test_what_is_there_is_not_written_over(pair, memory):
    for target in (pair[1], Url("memory://bucket/press.zarr")):
        with pytest.raises(io.InputError, match="exists: remove it"):
            io.save_zarr(pair[0], target)


@pytest.mark.parametrize("remote", [False, True])
def test_nothing_is_left_of_what_could_not_be_read(pair, memory, tmp_path, remote):
    with h5py.File(pair[0], "r+") as file:
        del file["entry/instrument/stage/motion"]
        file["entry/instrument/stage/motion"] = "sideways"
    target = Url("memory://bucket/new.zarr") if remote else tmp_path / "new.zarr"
    before = sorted(tmp_path.iterdir()), memory.find("/bucket")
    with pytest.raises(io.InputError, match="sideways"):
        io.save_zarr(pair[0], target)
    assert (sorted(tmp_path.iterdir()), memory.find("/bucket")) == before


def test_of_two_writers_the_first_to_finish_wins(pair, tmp_path):
    target, other = tmp_path / "new.zarr", record(sphere("uint16"), tmp_path / "other.h5")

    def write_meanwhile(count):
        if not target.exists():
            io.save_zarr(other, target)

    with pytest.raises(io.InputError, match=r"new\.zarr was made by another program meanwhile: name another"):
        io.save_zarr(pair[0], target, write_meanwhile)
    with io.open_recording(target) as recording:
        assert recording.dtype == np.uint16
    assert not list(tmp_path.glob(".*"))


def test_of_two_writers_at_an_address_the_second_gives_up(pair, memory, monkeypatch):
    target, refused = "memory://bucket/new.zarr", []
    monkeypatch.setattr(zarr_export, "check_store", lambda target: None)  # both looked before either wrote

    def write_meanwhile(count):
        with pytest.raises(io.InputError) as caught:
            io.save_zarr(pair[0], target)
        refused.append(str(caught.value))

    io.save_zarr(pair[0], target, write_meanwhile)
    assert refused == [f"{target} is being written by another program: name another output with -o"]
    with io.open_recording(pair[0]) as first, io.open_recording(target) as second:
        np.testing.assert_array_equal(read_all(second, 3).frames, read_all(first, 3).frames)
    assert not [name for name in memory.find("/bucket") if ".mirrorskin" in name]


WRITER = """
import sys
from mirrorskin import io

def wait(count):
    print("writing", flush=True)
    sys.stdin.read()

io.save_zarr(sys.argv[1], sys.argv[2], wait)
"""


def test_what_a_killed_writer_has_left_is_removed_by_the_next(pair, tmp_path):
    command = [sys.executable, "-c", WRITER, str(pair[0]), str(tmp_path / "killed.zarr")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as writer:
        assert writer.stdout.readline() == b"writing\n"
        (part,) = tmp_path.glob(".mirrorskin-*.part")
        assert remove_leftovers(tmp_path) == []  # it is being written
        assert part.is_dir()
        writer.kill()
    assert remove_leftovers(tmp_path) == [part]
    assert not part.exists()


def test_a_folder_that_is_being_written_is_not_a_leftover_of_the_next_writer(pair, tmp_path):
    progress = []

    def write_another(count):
        if not progress:
            progress.append(count)
            io.save_zarr(pair[0], tmp_path / "second.zarr")

    io.save_zarr(pair[0], tmp_path / "first.zarr", write_another)
    for name in ("first", "second"):
        io.open_recording(tmp_path / f"{name}.zarr").close()


def test_a_path_keeps_the_slashes_of_an_address():
    url = path_of("s3://bucket/monday/press.zarr")
    assert str(url.with_name("b.zarr")) == "s3://bucket/monday/b.zarr"
    assert str(path_of("press.zarr")) == "press.zarr"


def test_lists_in_attributes_and_those_of_the_root_are_kept(tmp_path):
    flat = io.Result(height=np.zeros((4, 5), np.float32))
    for path in (tmp_path / "flat.h5", tmp_path / "flat.zarr"):
        io.save_result(flat, path)
    with Hdf5File(tmp_path / "flat.h5") as theirs, ZarrFile(tmp_path / "flat.zarr") as ours:
        for name in ("/", "/entry", "/entry/result"):
            expected = theirs.root[name].attrs
            assert set(ours.root[name].attrs) == set(expected)
            for attribute, value in expected.items():
                np.testing.assert_array_equal(
                    np.asarray(ours.root[name].attrs[attribute]).astype(str), np.asarray(value).astype(str)
                )
