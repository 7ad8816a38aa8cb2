"""Each recording has a result with its own name, and none is overwritten."""

from pathlib import Path

import pytest

from mirrorskin import io
from mirrorskin.engine.batch.jobs import make_jobs


def named(*words, folder="out"):
    """Return the results' names in the folder."""
    jobs = make_jobs(map(Path, words), Path(folder))
    return [str(job.target.relative_to(folder)) for job in jobs]


def test_a_result_has_its_recording_s_name():
    assert named("a.h5", "deep/er/b.nxs", "/tmp/c") == ["a-result.h5", "b-result.h5", "c-result.h5"]


def test_a_recording_that_is_named_twice_is_one_job():
    jobs = make_jobs([Path("a.h5"), Path("x/../a.h5"), Path.cwd() / "a.h5", Path("b.h5")], Path("out"))
    assert [job.target.name for job in jobs] == ["a-result.h5", "b-result.h5"]


def test_recordings_of_one_name_keep_their_folders_below_the_common_one():
    words = ("/data/mon/one/x.h5", "/data/tue/x.h5", "/data/x.h5", "/elsewhere/y.h5")
    assert named(*words) == ["mon/one/x-result.h5", "tue/x-result.h5", "x-result.h5", "y-result.h5"]


def test_recordings_that_differ_in_their_ending_keep_it():
    assert named("x.h5", "x.nxs") == ["x.h5-result.h5", "x.nxs-result.h5"]
    assert named("a/x.h5", "a/x.nxs", "b/x.h5") == ["a/x.h5-result.h5", "a/x.nxs-result.h5", "b/x-result.h5"]


def test_a_result_that_is_a_recording_of_the_batch_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(io.InputError, match=r"x-result\.h5 is one of the recordings"):
        make_jobs([Path("x.h5"), Path("x-result.h5")], Path())
    Path("x-result.h5").touch()
    Path("y.h5").symlink_to("x-result.h5")
    with pytest.raises(io.InputError, match=r"x-result\.h5 is one of the recordings"):
        make_jobs([Path("x.h5"), Path("y.h5")], Path())


def test_two_recordings_with_one_result_are_refused():
    with pytest.raises(io.InputError, match=r"x\.h5-result\.h5 would be the result of two"):
        make_jobs([Path("x.h5"), Path("x.nxs"), Path("x.h5.h5")], Path("out"))
