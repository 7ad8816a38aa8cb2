"""One job ends as done, kept or failed, and never raises."""

import os
import pickle

import h5py
import numpy as np
import pytest
from batches import BAD, half_written, press, rotation
from stacks import put

from mirrorskin import engine, io
from mirrorskin.engine import NotConverged
from mirrorskin.engine.batch import work
from mirrorskin.engine.batch.jobs import Job, Plan
from mirrorskin.engine.batch.work import run_job
from mirrorskin.io.storage.layout import CHECKSUM
from mirrorskin.kernels.errors import DeviceMemoryError


@pytest.fixture
def job(tmp_path):
    """A press, and a result of it that is not there yet."""
    return Job(press(tmp_path / "a.h5"), tmp_path / "out" / "a-result.h5")


def again(job, plan=None):
    """Do a job once more; tell what became of it, and whether its result was left alone."""
    before = job.target.stat().st_mtime_ns, job.target.read_bytes()
    state = run_job(job, plan or Plan()).state
    return state, before == (job.target.stat().st_mtime_ns, job.target.read_bytes())


@pytest.mark.parametrize("make", [press, rotation])
def test_a_result_is_that_of_reconstruct(tmp_path, make):
    job = Job(make(tmp_path / "a.h5"), tmp_path / "a-result.h5")
    plan = Plan(press={"threshold": 0.3}, rotation={"noise": 2.0})
    outcome = run_job(job, plan)
    assert outcome.state == "done", outcome.message
    with io.open_recording(job.source) as source:
        options = plan.press if make is press else plan.rotation
        expected = engine.reconstruct(source, **options)
    stored = io.open_result(job.target)
    for name, values in expected.maps().items():
        np.testing.assert_array_equal(getattr(stored, name), values, err_msg=name)
    added = {"batch_parameters": plan.digest(outcome.motion)}
    assert {**stored.process, "date": ""} == {**expected.process, **added, "date": ""}


def test_an_outcome_states_what_was_done(job):
    outcome = run_job(job, Plan())
    assert (outcome.job, outcome.motion, outcome.bytes) == (job, "vertical", 8 * 5 * 7)
    assert outcome.message.startswith("height at 35 of 35 pixels")
    assert 0 < outcome.seconds < 60
    assert outcome.device == io.open_result(job.target).process["device"]
    assert pickle.loads(pickle.dumps(outcome)) == outcome


def test_a_finished_result_is_kept(job):
    run_job(job, Plan())
    assert again(job) == ("kept", True)
    assert again(job, Plan(rotation={"robust": True}, memory_limit=5000)) == ("kept", True)
    kept = run_job(job, Plan())
    assert (kept.motion, kept.bytes, kept.device) == ("vertical", 0, "")


@pytest.mark.parametrize(
    "plan",
    [Plan(press={"threshold": 0.6}), Plan(opening={"travel": io.Steps(0.2)}), Plan(press={"fill": False})],
)
def test_other_parameters_make_it_anew(job, plan):
    run_job(job, Plan())
    assert again(job, plan) == ("done", False)
    assert again(job, plan) == ("kept", True)


def test_a_changed_recording_is_done_anew(job):
    put(job.source, CHECKSUM, None)  # otherwise a changed frame is refused
    run_job(job, Plan())
    written = job.source.stat().st_mtime_ns
    with h5py.File(job.source, "r+") as file:
        file["entry/instrument/detector/data"][3, 2, 1] += 1
    os.utime(job.source, ns=(written, written))
    assert again(job) == ("done", False)
    os.utime(job.source, ns=(written, written + 1))
    assert again(job) == ("done", False)
    assert again(job) == ("kept", True)


def cut(path):
    path.write_bytes(path.read_bytes()[:-100])


def overwritten(path):
    content = path.read_bytes()
    place = content.index(b"OHDR")  # what describes a group or a dataset
    path.write_bytes(content[:place] + bytes(1000) + content[place + 1000 :])


def of_reconstruct(path):
    with h5py.File(path, "r+") as file:
        del file["entry/process/batch_parameters"]


@pytest.mark.parametrize("spoil", [cut, overwritten, of_reconstruct])
def test_a_damaged_result_is_made_anew(job, spoil):
    run_job(job, Plan())
    whole = io.open_result(job.target)
    spoil(job.target)
    assert run_job(job, Plan()).state == "done"
    stored = io.open_result(job.target)
    np.testing.assert_array_equal(stored.height, whole.height)
    assert run_job(job, Plan()).state == "kept"


@pytest.mark.parametrize(("make", "message"), BAD.items(), ids=[make.__name__ for make in BAD])
def test_a_bad_recording_fails_in_one_line_and_leaves_nothing(tmp_path, make, message):
    job = Job(make(tmp_path / "bad.h5"), tmp_path / "out" / "bad-result.h5")
    outcome = run_job(job, Plan())
    assert outcome.state == "failed"
    assert message in outcome.message
    assert "bad.h5" in outcome.message
    assert "\n" not in outcome.message
    assert not outcome.message.startswith("unexpected")
    assert not job.target.exists()
    assert not half_written(tmp_path)


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (NotConverged("it did not"), "it did not"),
        (DeviceMemoryError("no room"), "no room"),
        (ZeroDivisionError("by zero"), "unexpected ZeroDivisionError: by zero"),
        (MemoryError("none"), "not enough memory (none): take a smaller region or fewer frames"),
    ],
)
def test_what_the_engine_raises_is_reported(job, monkeypatch, error, message):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr(work, "run_class", fail)
    outcome = run_job(job, Plan())
    assert (outcome.state, outcome.motion) == ("failed", "vertical")
    assert outcome.message.endswith(message)


def touched(path):
    os.utime(path, ns=(5, 5))


@pytest.mark.parametrize("change", [touched])
def test_a_recording_that_is_written_to_meanwhile_fails(job, change):
    outcome = run_job(job, Plan(), progress=lambda frames: change(job.source))
    assert outcome.state == "failed"
    assert outcome.message.startswith(f"{job.source} was changed while it was open")
    assert not job.target.exists()
