"""Files appear complete or not at all; temporary files of killed writers."""

import fcntl
import re
import subprocess
import sys

import pytest

from mirrorskin import io
from mirrorskin.io.atomic import new_hdf5, remove_leftovers, write_new

# Begins a file, says so, and waits to be killed.
BEGIN = """
import sys
from pathlib import Path
from mirrorskin.io.atomic import new_hdf5
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
        assert [one.stdout.readline() for one in (killed, alive)] == [b"begun\n"] * 2
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
