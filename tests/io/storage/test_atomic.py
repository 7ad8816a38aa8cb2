"""Files appear complete or not at all; temporary files of killed writers."""

import errno
import fcntl
import itertools
import os
import re
import stat
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from growing import Feed, stream
from stacks import record, sphere

from mirrorskin import io
from mirrorskin.io.storage.atomic import new_hdf5, remove_leftovers, write_new

# Begins a file, says so, and waits to be killed.
BEGIN = """
import sys
from pathlib import Path
from mirrorskin.io.storage.atomic import new_hdf5
with new_hdf5(Path(sys.argv[1])) as new:
    new.root["x"] = 1
    print("begun", flush=True)
    sys.stdin.read()
"""


def parts(folder):
    return sorted(folder.glob(".mirrorskin-*.part"))


def test_a_file_has_its_name_only_when_it_is_whole(tmp_path):
    with new_hdf5(tmp_path / "a.h5") as new:
        new.root["x"] = 1
        (part,) = tmp_path.iterdir()
        assert part.suffix == ".part"
    assert [path.name for path in tmp_path.iterdir()] == ["a.h5"]


def test_what_is_being_written_here_is_not_a_leftover(tmp_path):
    with new_hdf5(tmp_path / "a.h5") as new:
        assert remove_leftovers(tmp_path) == []
        new.root["x"] = 1
    assert [path.name for path in tmp_path.iterdir()] == ["a.h5"]


def test_only_what_a_killed_program_wrote_is_removed(tmp_path):
    command = [sys.executable, "-c", BEGIN, str(tmp_path / "a.h5")]
    (tmp_path / "other.part").touch()
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as writer:
        assert writer.stdout.readline() == b"begun\n"
        (part,) = parts(tmp_path)
        assert remove_leftovers(tmp_path) == []
        writer.kill()
    assert parts(tmp_path) == [part]
    assert remove_leftovers(tmp_path) == [part]
    assert [path.name for path in tmp_path.iterdir()] == ["other.part"]


def test_the_next_file_in_a_folder_takes_the_place_of_what_was_killed(tmp_path):
    command = [sys.executable, "-c", BEGIN, str(tmp_path / "a.h5")]
    with (
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as killed,
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as alive,
    ):
        assert [item.stdout.readline() for item in (killed, alive)] == [b"begun\n"] * 2
        killed.kill()
        killed.wait()
        write_new(tmp_path / "b.h5", [b"new"])
        assert len(parts(tmp_path)) == 1
        alive.communicate()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.h5", "b.h5"]


def test_a_file_that_was_taken_for_a_leftover_is_begun_again(tmp_path, monkeypatch):
    lock, locked = fcntl.flock, []

    def late(file, how):
        if not locked:
            locked.append(file)
            assert len(remove_leftovers(tmp_path)) == 1
        elif how == fcntl.LOCK_EX:
            locked.append(file)
        lock(file, how)

    monkeypatch.setattr(fcntl, "flock", late)
    with new_hdf5(tmp_path / "a.h5") as new:
        new.root["x"] = 1
    assert len(locked) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["a.h5"]


def test_a_program_that_is_ended_while_the_file_is_made_leaves_none(tmp_path, monkeypatch):
    def end(*_):
        raise SystemExit(143)

    monkeypatch.setattr(fcntl, "flock", end)
    with pytest.raises(SystemExit), new_hdf5(tmp_path / "a.h5"):
        pass
    assert not list(tmp_path.iterdir())


def test_what_a_link_leads_to_is_replaced_and_the_link_stays(tmp_path):
    (tmp_path / "far").mkdir()
    target, link = tmp_path / "far" / "result.h5", tmp_path / "link.h5"
    link.symlink_to(target)
    write_new(link, [b"new"])
    assert link.is_symlink()
    assert target.read_bytes() == b"new"


@pytest.fixture
def steps(monkeypatch, tmp_path):
    """What is synchronised to the disk, and renamed or linked, in order."""
    steps = []

    def watch(name, describe):
        call = getattr(os, name)

        def watched(*words, **options):
            what = describe(*words)
            call(*words, **options)
            steps.append(what)

        monkeypatch.setattr(os, name, watched)

    def kind(descriptor):
        return "folder" if stat.S_ISDIR(os.fstat(descriptor).st_mode) else "file"

    watch("fsync", lambda descriptor: f"synchronise {kind(descriptor)}")
    for name in ("rename", "replace", "link"):
        watch(name, lambda *_: "name")
    return steps


def write_result(path):
    io.save_result(io.Result(height=np.zeros((3, 4), "f4")), path, overwrite=True)


def write_table(path):
    write_new(path, [b"new"])


def write_calibration(path):
    levels = [np.full((5, 7), level, np.float32) for level in (10, 200, 1, 1)]
    references = io.References(*levels, np.zeros((5, 7), np.uint8))
    io.update_calibration(path, references, io.CameraId("a", (5, 7), np.dtype("u1")), {})


def write_recording(path):
    record(sphere(), path)


def write_live(path):
    stream(Feed(4), path)


def write_messages(path):
    stream(Feed(4), path.with_suffix(".mcap"))


ORDER = ["synchronise file", "name", "synchronise folder"]


@pytest.mark.parametrize("write", [write_result, write_table, write_calibration, write_recording])
def test_a_file_is_on_the_disk_before_its_name_and_then_the_name(tmp_path, steps, write):
    write(tmp_path / "a.h5")
    assert steps == ORDER


@pytest.mark.parametrize("write", [write_live, write_messages])
def test_a_live_recording_is_on_the_disk_when_it_is_complete(tmp_path, steps, write):
    write(tmp_path / "a.h5")
    assert steps == [*ORDER, "synchronise file"]


def test_a_live_recording_that_replaces_another_is_on_the_disk_first(tmp_path, steps):
    write_live(tmp_path / "a.h5")
    steps.clear()
    with io.StreamRecorder(Feed(4), tmp_path / "a.h5", overwrite=True) as recorder:
        while recorder.read() is not None:
            pass
    assert steps == [*ORDER, "synchronise file", "name", "synchronise folder"]


def test_a_folder_of_zarr_is_on_the_disk_before_its_name(tmp_path, steps):
    write_result(tmp_path / "a.zarr")
    files = sum(path.is_file() for path in (tmp_path / "a.zarr").rglob("*"))
    assert steps[-2:] == ["name", "synchronise folder"]
    last = itertools.takewhile(lambda step: step != "name", reversed(steps[:-2]))
    assert [*last].count("synchronise file") == files


def test_the_names_in_a_folder_of_zarr_are_on_the_disk_before_its_name(tmp_path, steps):
    write_result(tmp_path / "a.zarr")
    folders = 1 + sum(path.is_dir() for path in (tmp_path / "a.zarr").rglob("*"))
    last = itertools.takewhile(lambda step: step != "name", reversed(steps[:-2]))
    assert [*last].count("synchronise folder") == folders


def test_a_full_disk_that_is_only_reported_on_closing_is_an_error(tmp_path, monkeypatch):
    """Some network file systems do this, so a copy of the descriptor is closed before the renaming."""
    copy, close, copies = os.dup, os.close, set()

    def watched(descriptor):
        copies.add(copied := copy(descriptor))
        return copied

    def full(descriptor):
        close(descriptor)
        if descriptor in copies:
            copies.remove(descriptor)
            raise OSError(errno.ENOSPC, "full")

    monkeypatch.setattr(os, "dup", watched)
    monkeypatch.setattr(os, "close", full)
    with pytest.raises(io.InputError, match=r"a\.h5 could not be written: No space left on device"):
        write_table(tmp_path / "a.h5")


def test_a_folder_that_cannot_be_synchronised_is_no_failure(tmp_path, monkeypatch):
    synchronise = os.fsync

    def refuse(descriptor):
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, "not here")
        synchronise(descriptor)

    monkeypatch.setattr(os, "fsync", refuse)
    write_result(tmp_path / "a.h5")
    assert io.open_result(tmp_path / "a.h5").height.shape == (3, 4)


def refuse_to_remove(*_, **__):
    raise OSError(errno.EIO, "stays")


def test_a_temporary_file_that_stays_is_no_failure(tmp_path, monkeypatch):
    monkeypatch.setattr(Path, "unlink", refuse_to_remove)
    write_result(tmp_path / "a.h5")
    assert io.open_result(tmp_path / "a.h5").height.shape == (3, 4)


def test_a_live_recording_is_complete_although_its_temporary_files_stay(tmp_path, monkeypatch):
    write_live(tmp_path / "a.h5")
    monkeypatch.setattr(Path, "unlink", refuse_to_remove)
    with io.StreamRecorder(Feed(6), tmp_path / "a.h5", overwrite=True) as recorder:
        while recorder.read() is not None:
            pass
    with io.open_recording(tmp_path / "a.h5") as recording:
        assert (recording.shape[0], recording.state) == (6, "complete")


def test_an_error_is_reported_although_the_temporary_file_stays(tmp_path, monkeypatch):
    monkeypatch.setattr(Path, "unlink", refuse_to_remove)
    with pytest.raises(ZeroDivisionError), new_hdf5(tmp_path / "a.h5"):
        raise ZeroDivisionError


@pytest.mark.parametrize(
    ("name", "then"),
    [
        ("w.csv", ", then 'mirrorskin export' makes .csv of it"),
        ("W.TIF", ", then 'mirrorskin export' makes .tif of it"),
        ("w.html", ", then 'mirrorskin report' makes .html of it"),
        ("w.json", ""),
    ],
)
def test_a_result_with_the_suffix_of_another_format_is_refused(tmp_path, name, then):
    message = f"{tmp_path / name}: a result is HDF5 (.h5) or Zarr (.zarr): write it so{then}"
    with pytest.raises(io.InputError, match=f"^{re.escape(message)}$"):
        io.check_result_output(tmp_path / name)


@pytest.mark.parametrize("name", ["w.h5", "w.hdf5", "w.nxs", "w", "run.7"])
def test_a_result_may_have_a_suffix_of_no_other_format(tmp_path, name):
    io.check_result_output(tmp_path / name)


def test_a_file_that_is_not_a_result_may_have_any_suffix(tmp_path):
    io.check_output(tmp_path / "page.html")
