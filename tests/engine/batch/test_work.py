"""One job: done, kept or failed, and never raised."""

import os
import pickle

import h5py
import numpy as np
import pytest
from batches import BAD, half_written, press, rotation
from stacks import assert_same

from mirrorskin import engine, io
from mirrorskin.engine.batch import jobs as plans
from mirrorskin.engine.batch import work
from mirrorskin.engine.batch.jobs import Job, Plan
from mirrorskin.engine.batch.work import run_job
from mirrorskin.engine.errors import NotConverged
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
    found = io.open_result(job.target)
    for name, values in expected.maps().items():
        np.testing.assert_array_equal(getattr(found, name), values, err_msg=name)
    added = {"batch_parameters": plan.digest(outcome.motion)}
    assert {**found.process, "date": ""} == {**expected.process, **added, "date": ""}


def test_an_outcome_tells_what_was_done(job):
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


def test_another_version_makes_it_anew(job, monkeypatch):
    run_job(job, Plan())
    monkeypatch.setattr(plans, "program_version", lambda: "99.0")
    assert again(job) == ("done", False)


def test_a_changed_recording_is_done_anew(job):
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
    path.write_bytes(content[:300] + bytes(1000) + content[1300:])


def emptied(path):
    path.write_bytes(b"")


def without_maps(path):
    with h5py.File(path, "r+") as file:
        del file["entry/result"]


def of_reconstruct(path):
    with h5py.File(path, "r+") as file:
        del file["entry/process/batch_parameters"]


def of_a_strange_shape(path):
    with h5py.File(path, "r+") as file:
        del file["entry/result/status"]
        file["entry/result/status"] = np.zeros((2, 2), np.uint8)


@pytest.mark.parametrize(
    "spoil", [cut, overwritten, emptied, without_maps, of_reconstruct, of_a_strange_shape]
)
def test_a_damaged_result_is_made_anew(job, spoil):
    run_job(job, Plan())
    whole = io.open_result(job.target)
    spoil(job.target)
    assert run_job(job, Plan()).state == "done"
    found = io.open_result(job.target)
    np.testing.assert_array_equal(found.height, whole.height)
    assert run_job(job, Plan()).state == "kept"


def test_a_recording_in_the_result_s_place_is_made_a_result(job):
    job.target.parent.mkdir()
    press(job.target)
    assert run_job(job, Plan()).state == "done"
    assert io.open_result(job.target).height is not None


@pytest.mark.parametrize(("make", "said"), BAD.items(), ids=[make.__name__ for make in BAD])
def test_a_bad_recording_fails_in_one_line_and_leaves_nothing(tmp_path, make, said):
    job = Job(make(tmp_path / "bad.h5"), tmp_path / "out" / "bad-result.h5")
    outcome = run_job(job, Plan())
    assert outcome.state == "failed"
    assert said in outcome.message
    assert "bad.h5" in outcome.message
    assert "\n" not in outcome.message
    assert not outcome.message.startswith("unexpected")
    assert not job.target.exists()
    assert not half_written(tmp_path)


def test_a_parameter_that_cannot_be_used_fails_with_the_file_s_name(job):
    outcome = run_job(job, Plan(press={"hold": 0}))
    assert outcome.state == "failed"
    assert outcome.message.startswith(f"{job.source}: hold 0")


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (NotConverged("it did not"), "it did not"),
        (DeviceMemoryError("no room"), "no room"),
        (ZeroDivisionError("by zero"), "unexpected ZeroDivisionError: by zero"),
        (MemoryError(), "unexpected MemoryError: "),
    ],
)
def test_what_the_engine_raises_is_told(job, monkeypatch, error, said):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr(work, "reconstruct", fail)
    outcome = run_job(job, Plan())
    assert (outcome.state, outcome.motion) == ("failed", "vertical")
    assert outcome.message.endswith(said)


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit])
def test_what_ends_the_program_is_no_failure(job, error):
    def stop(_):
        raise error

    with pytest.raises(error):
        run_job(job, Plan(), progress=stop)
    assert not job.target.exists()
    assert not half_written(job.source.parent)


def touched(path):
    os.utime(path, ns=(5, 5))


def replaced(path):
    status = path.stat()
    other = press(path.with_name("other.h5"), seed=7)
    os.utime(other, ns=(status.st_atime_ns, status.st_mtime_ns))
    other.replace(path)


@pytest.mark.parametrize("change", [touched, replaced])
def test_a_recording_that_is_written_to_meanwhile_fails(job, change):
    outcome = run_job(job, Plan(), progress=lambda frames: change(job.source))
    assert outcome.state == "failed"
    assert outcome.message.startswith(f"{job.source} was changed while it was open")
    assert not job.target.exists()


def test_a_recording_that_is_replaced_while_it_is_opened_fails(job, monkeypatch):
    opened = io.open_recording

    def replace_then(path, **options):
        source = opened(path, **options)
        replaced(path)
        return source

    monkeypatch.setattr(io, "open_recording", replace_then)
    assert "was changed while it was open" in run_job(job, Plan()).message
    assert not job.target.exists()


def test_a_result_s_folder_that_is_a_file_fails(job):
    job.target.parent.write_text("mine")
    outcome = run_job(job, Plan())
    assert (outcome.state, outcome.message) == (
        "failed",
        f"{job.target.parent} cannot be made: File exists; choose another folder for results",
    )
    assert job.target.parent.read_text() == "mine"


def test_the_same_job_makes_the_same_maps(job):
    run_job(job, Plan())
    first = io.open_result(job.target)
    job.target.unlink()
    run_job(job, Plan(memory_limit=500))
    second = io.open_result(job.target)
    process = {**second.process, "date": first.process["date"]}
    assert_same(io.Result(**second.maps(), x=second.x, y=second.y, process=process), first)
