"""Frames are compared with their checksums when they are read, whatever stores them."""

import shutil
import zlib

import h5py
import numpy as np
import pytest
from stacks import put, random_stack, read_all, record, sphere

from mirrorskin import engine, io
from mirrorskin.io.base.checksums import checksums
from mirrorskin.io.files.recorder import COMPRESSIONS
from mirrorskin.io.storage.layout import CHECKSUM, STACK

REFUSED = (
    "frames 3, 6 differ from what was recorded: copy the file again, or use the frames as they are with"
    " --no-verify"
)


def flip(path, *numbers):
    """Flip one bit in some frames of a recording."""
    with h5py.File(path, "r+") as file:
        for number in numbers:
            frame = file[STACK][number]
            frame.view(np.uint8)[2, 1] ^= 4
            file[STACK][number] = frame
    return path


@pytest.fixture
def press(tmp_path):
    return record(sphere(), tmp_path / "press.h5")


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_damaged_frames_are_refused_with_their_numbers(tmp_path, compression, dtype):
    path = flip(record(sphere(dtype), tmp_path / "a.h5", compression), 3, 6)
    with io.open_recording(path) as recording, pytest.raises(io.InputError, match=f": {REFUSED}$"):
        read_all(recording, 8)


def test_damage_in_chunks_of_several_frames_is_refused(press):
    with h5py.File(press, "r+") as file:
        frames = file[STACK][()]
        del file[STACK]
        file.create_dataset(STACK, data=frames, chunks=(5, *frames.shape[1:]), compression="gzip")
    flip(press, 6)
    with io.open_recording(press) as recording, pytest.raises(io.InputError, match="frame 6 differs"):
        read_all(recording, 1)


def test_damage_in_a_store_of_zarr_is_refused(press, tmp_path):
    flip(press, 3, 6)
    io.save_zarr(press, tmp_path / "a.zarr", verify=False)
    with io.open_recording(tmp_path / "a.zarr") as recording, pytest.raises(io.InputError, match=REFUSED):
        read_all(recording, 8)


def test_damage_in_frames_that_are_left_out_is_no_obstacle(press):
    flip(press, 1)
    with io.open_recording(press, frames=(2, 8)) as recording:
        assert read_all(recording, 3).frames.shape[0] == 6


@pytest.mark.parametrize("dataset", [STACK, "/entry/data/frames"])
def test_damage_is_refused_by_every_name_of_the_stack(press, dataset):
    flip(press, 3, 6)
    with io.open_recording(press, dataset=dataset) as recording, pytest.raises(io.InputError, match=REFUSED):
        read_all(recording, 8)


def test_a_damaged_frame_that_is_read_alone_is_refused(press):
    flip(press, 3)
    with io.open_recording(press) as recording, pytest.raises(io.InputError, match="frame 3 differs"):
        recording.frame(3)


def test_damaged_frames_are_used_without_verification(press):
    sound = press.with_name("sound.h5")
    shutil.copy(press, sound)
    flip(press, 3)
    with io.open_recording(press, verify=False) as recording, io.open_recording(sound) as other:
        assert np.count_nonzero(read_all(recording, 8).frames != read_all(other, 8).frames) == 1


@pytest.mark.parametrize("opening", [{"region": io.Region((1, 4), (0, 7))}, {"verify": False}])
def test_frames_that_are_not_verified_are_noted(press, opening):
    notes = [finding for finding in io.check(press, **opening).findings if finding.kind == "unverified"]
    assert [note.warning for note in notes] == [False]


def test_a_result_notes_that_its_frames_are_not_verified(press):
    with io.open_recording(press, verify=False) as recording:
        result = engine.run(recording, engine.Onset)
    assert "not compared with their checksums" in result.process["notes"]


def test_verified_frames_leave_no_note(press):
    assert not [finding for finding in io.check(press).findings if finding.kind == "unverified"]


def test_a_recording_without_checksums_is_read(press):
    put(press, CHECKSUM, None)
    flip(press, 3)
    with io.open_recording(press) as recording:
        assert read_all(recording, 8).frames.shape[0] == 8


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.zeros(7, np.uint32), r"has shape \(7,\) where \(8,\) is needed"),
        (np.zeros(8, np.float32), "is of type float32 where uint32 is needed"),
        (np.zeros(8, np.uint64), "is of type uint64 where uint32 is needed"),
        (b"none", "contains no numbers"),
    ],
)
def test_checksums_that_cannot_be_used_are_refused(press, values, message):
    put(press, CHECKSUM, values)
    with pytest.raises(io.InputError, match=rf"press.h5: {CHECKSUM} {message}: .*--no-verify$"):
        io.open_recording(press)


def test_checksums_that_cannot_be_used_are_not_read_without_verification(press):
    put(press, CHECKSUM, np.zeros(7, np.uint32))
    with io.open_recording(press, verify=False) as recording:
        assert read_all(recording, 8).frames.shape[0] == 8


def test_checksums_are_the_crc_of_zlib():
    frames = random_stack("uint16", (3, 50, 70))
    assert checksums(frames[:, ::2]).tolist() == [zlib.crc32(frame[::2].tobytes()) for frame in frames]
