from __future__ import annotations

import logging
import os
import socket
import sys
import threading
import time
from contextlib import closing
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from types import SimpleNamespace

import distributed
import numpy as np
import pytest
import soak
import stacks

from mirrorskin import io
from mirrorskin.engine.batch import cluster, worker
from mirrorskin.engine.batch.cluster import run_cluster
from mirrorskin.engine.batch.jobs import Job, Plan, make_jobs
from mirrorskin.engine.batch.local import default_devices, run_local
from mirrorskin.engine.batch.work import Outcome

PLAN = Plan(press={"fill": False})


@pytest.fixture(autouse=True)
def own_environment(monkeypatch):
    """Workers in this process leave its environment as it was, and nobody waits long."""
    monkeypatch.setenv("POCL_MAX_PTHREAD_COUNT", os.environ.get("POCL_MAX_PTHREAD_COUNT", "2"))
    monkeypatch.setattr(cluster, "_POLL", 0.1)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recordings")
    files = [folder / f"press-{seed}.h5" for seed in range(4)]
    for seed, file in enumerate(files):
        stacks.record(stacks.ball((6, 9), (0.5, 0.5), np.arange(8) * 0.3, seed=seed), file)
    return files


def start(workers, threads=1):
    """Start a cluster whose workers are threads of this process."""
    return distributed.LocalCluster(
        n_workers=workers,
        threads_per_worker=threads,
        processes=False,
        protocol="tcp://",
        dashboard_address=None,
        scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},
        memory_limit=0,
        silence_logs=logging.CRITICAL,
    )


@pytest.fixture(scope="module")
def two_workers():
    with start(2, threads=4) as running:
        yield running


@pytest.fixture
def address(two_workers):
    return two_workers.scheduler_address


def states(outcomes):
    return sorted(outcome.state for outcome in outcomes)


def refusal(jobs, address):
    with pytest.raises(io.InputError) as caught:
        list(run_cluster(jobs, PLAN, address))
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_batch_on_a_cluster_is_done_and_then_kept_anywhere(recordings, address, tmp_path):
    (tmp_path / "bad.h5").write_bytes(b"not HDF5")
    jobs = make_jobs([tmp_path / "bad.h5", *recordings, tmp_path / "gone.h5"], tmp_path / "results")
    assert states(run_local(jobs[1:2], PLAN, default_devices())) == ["done"]
    outcomes = list(run_cluster(jobs, PLAN, address))
    assert states(outcomes) == ["done"] * 3 + ["failed"] * 2 + ["kept"]
    assert {outcome.job for outcome in outcomes} == set(jobs)
    assert all(
        outcome.device and outcome.bytes == 8 * 6 * 9 for outcome in outcomes if outcome.state == "done"
    )
    failed = {outcome.job.source.name: outcome.message for outcome in outcomes if outcome.state == "failed"}
    assert "HDF5" in failed["bad.h5"]
    assert "gone.h5" in failed["gone.h5"]
    assert states(run_local(jobs[1:5], PLAN, default_devices())) == ["kept"] * 4


@pytest.fixture
def slow_jobs(monkeypatch):
    """Jobs that take a while and do nothing; the list of how many each worker had at once."""
    under_way, at_once = [], {}

    def run(job, plan, device):
        name = distributed.get_worker().address
        under_way.append(name)
        at_once[name] = max(at_once.get(name, 0), under_way.count(name))
        time.sleep(0.03)
        under_way.remove(name)
        return Outcome(job, "done", str(job.source.is_absolute()), 0.0)

    monkeypatch.setattr(worker, "run_job", run)
    return at_once


def test_a_worker_of_many_threads_does_one_job_at_a_time(recordings, address, tmp_path, slow_jobs):
    assert states(run_cluster(make_jobs(recordings, tmp_path) * 3, PLAN, address)) == ["done"] * 12
    assert set(slow_jobs.values()) == {1}  # a busy machine may leave all to one of the workers


def test_paths_are_those_of_here(recordings, address, tmp_path, monkeypatch, slow_jobs):
    monkeypatch.chdir(recordings[0].parent)
    results = Path(os.path.relpath(tmp_path, recordings[0].parent))
    (job,) = make_jobs([Path(recordings[0].name)], results)
    (outcome,) = run_cluster([job], PLAN, address)
    assert outcome.job == job
    assert outcome.message == "True"


def test_leaving_early_ends_the_batch(recordings, two_workers, tmp_path, slow_jobs):
    with closing(
        run_cluster(make_jobs(recordings, tmp_path) * 5, PLAN, two_workers.scheduler_address)
    ) as run:
        next(run)
    deadline = time.monotonic() + 60
    while two_workers.scheduler.tasks:
        assert time.monotonic() < deadline, "the scheduler still has jobs"
        time.sleep(0.01)
    assert not [name for name in two_workers.scheduler.worker_plugins if "mirrorskin" in name]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize("fit", [True, False])
def test_a_worker_that_comes_late_takes_part_if_it_can(fit, recordings, tmp_path, monkeypatch, slow_jobs):
    jobs = make_jobs(recordings, tmp_path) * 100
    with start(1) as running, closing(run_cluster(jobs, PLAN, running.scheduler_address)) as run:
        next(run)
        if not fit:
            monkeypatch.setattr(worker, "version", lambda _: "0.0.9")
        running.scale(2)
        events = running.scheduler.get_events
        assert any(len(slow_jobs) == 2 if fit else events("mirrorskin") for _ in run)
        assert fit or "is left out: it has mirrorskin 0.0.9" in events("mirrorskin")[0][1]
    assert len(slow_jobs) == 1 + fit


@pytest.mark.slow
@pytest.mark.parametrize(("losses", "state"), [(3, "done"), (4, "failed")])
def test_a_job_may_cost_three_workers_and_no_more(losses, state, recordings, tmp_path, monkeypatch):
    lost = []

    def lose(job, plan, device):
        if job.source == recordings[0] and len(lost) < losses:
            here = distributed.get_worker()
            lost.append(here.address)
            removed = threading.Event()

            async def remove():
                await running.scheduler.remove_worker(here.address, stimulus_id="test", close=False)
                removed.set()

            running.scheduler.loop.add_callback(remove)
            assert removed.wait(60)
        return Outcome(job, "done", "", 0.0)

    monkeypatch.setattr(worker, "run_job", lose)
    with start(6) as running:
        jobs = make_jobs(recordings, tmp_path)
        outcomes = {outcome.job: outcome for outcome in run_cluster(jobs, PLAN, running.scheduler_address)}
    assert [outcomes[job].state for job in jobs] == [state, "done", "done", "done"]
    if state == "failed":
        assert f"each of 4 workers that had {recordings[0]} was lost" in outcomes[jobs[0]].message


def test_an_unforeseen_failure_of_a_job_is_printed_in_a_line(recordings, address, tmp_path, monkeypatch):
    def fail(*_):
        raise RuntimeError("of two\nlines")

    monkeypatch.setattr(worker, "run_job", fail)
    outcomes = list(run_cluster(make_jobs(recordings, tmp_path), PLAN, address))
    assert states(outcomes) == ["failed"] * 4
    assert all("unexpected RuntimeError" in outcome.message for outcome in outcomes)
    assert all("of two lines" in outcome.message for outcome in outcomes)


@pytest.mark.slow
def test_no_scheduler_is_refused(recordings, tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "_REACH", 0.3)
    jobs = make_jobs(recordings, tmp_path)
    for address in ("tcp://127.0.0.1:1", "nonsense", "foo://127.0.0.1:8786", "tcp://127.0.0.1:99999"):
        message = refusal(jobs, address)
        assert message.startswith(f"no Dask scheduler can be reached at {address}")
        assert "dask scheduler" in message
    with socket.create_server(("127.0.0.1", 0)) as silent:
        message = refusal(jobs, f"tcp://127.0.0.1:{silent.getsockname()[1]}")
    assert "no answer within 0.3 s" in message


@pytest.mark.slow
def test_a_cluster_that_goes_away_is_reported(recordings, tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "PATIENCE", 1.0)
    with start(1) as running:
        run = run_cluster(make_jobs(recordings, tmp_path) * 50, PLAN, running.scheduler_address)
        next(run)
        monkeypatch.setattr(cluster, "_REACH", 0.3)
        running.close()
        with pytest.raises(io.InputError, match="continues where it stopped"):
            list(run)


def test_without_dask_a_remedy_is_reported(recordings, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert "pip install 'mirrorskin[cluster]'" in refusal(
        make_jobs(recordings, tmp_path), "tcp://127.0.0.1:1"
    )


def test_a_worker_that_cannot_take_part_is_refused(recordings, address, tmp_path, monkeypatch):
    def missing(name):
        raise PackageNotFoundError(name)

    jobs, own_version = make_jobs(recordings, tmp_path), cluster.version("mirrorskin")
    with monkeypatch.context() as other:
        other.setattr(cluster, "program_version", lambda: "9.9")
        message = refusal(jobs, address)
    assert f"has mirrorskin {own_version}, and this machine 9.9: install the same on both" in message
    assert message.startswith("worker tcp://127.0.0.1:")
    with monkeypatch.context() as other:
        other.setattr(cluster, "version", missing)
        assert "has mirrorskin not installed" in refusal(jobs, address)
    monkeypatch.setattr(cluster, "_one_of_each_folder", lambda _: {tmp_path / "elsewhere.h5": 10})
    message = refusal(jobs, address)
    assert f"does not see {tmp_path / 'elsewhere.h5'}: workers need the same folders" in message


def test_what_keeps_a_worker_from_taking_part(tmp_path, monkeypatch):
    def no_device(workers):
        raise worker.DeviceError("no OpenCL device found: install one")

    def look(sizes):
        return worker._problem(sizes, trace, here, 1)

    here = SimpleNamespace()
    file, trace = tmp_path / "a.h5", tmp_path / "trace"
    file.write_bytes(b"12345")
    assert f"does not see the folder {tmp_path} as it is here" in look({file: 5})
    trace.touch()
    monkeypatch.setattr(worker, "take_share", no_device)
    assert look({file: 5}) == "has no device: no OpenCL device found: install one"
    monkeypatch.setattr(worker, "take_share", lambda workers: "its share")
    assert look({file: 5}) is None
    assert here.mirrorskin_share == "its share"
    assert "does not see" in look({file: 6})
    assert "does not see" in look({tmp_path / "b.h5": 5})
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    assert f"cannot write to {tmp_path}" in look({file: 5})


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """A machine of 7 cores with such devices; what is opened is the choice."""
    monkeypatch.setattr(worker, "_NUMBERS", f"\0{str(tmp_path)[-80:]}")
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(7)))
    monkeypatch.setattr(worker, "open_device", lambda choice=None: choice)
    monkeypatch.delenv("PYOPENCL_CTX", raising=False)
    monkeypatch.delenv("POCL_MAX_PTHREAD_COUNT", raising=False)

    def of(*kinds):
        monkeypatch.setattr(worker, "list_devices", lambda: [SimpleNamespace(kind=kind) for kind in kinds])

    return of


def test_workers_take_a_machines_gpus_in_turn(machine, monkeypatch):
    machine("cpu", "gpu", "other", "gpu")
    shares = [worker.take_share(5) for _ in range(5)]
    assert [part.device for part in shares] == ["1", "3", "1", "3", "1"]
    os.close(shares[1].number)
    assert worker.take_share(5).device == "3"  # it takes the place of the one that ended
    monkeypatch.setenv("PYOPENCL_CTX", "0")
    assert worker.take_share(5).device is None


@pytest.mark.parametrize(("workers", "expected"), [(3, [3, 2, 2]), (9, [1] * 9)])
def test_the_cores_of_a_machine_are_divided(workers, expected, machine, monkeypatch):
    machine("cpu")
    shares = []
    for _ in range(workers):
        monkeypatch.setenv("POCL_MAX_PTHREAD_COUNT", "7")  # by the command line that starts them
        shares.append(worker.take_share(workers))
        assert os.environ["POCL_MAX_PTHREAD_COUNT"] == str(shares[-1].cores)
    assert [part.cores for part in shares] == expected
    assert {part.device for part in shares} == {None}
    monkeypatch.setenv("POCL_MAX_PTHREAD_COUNT", "11")
    worker.take_share(workers)
    assert os.environ["POCL_MAX_PTHREAD_COUNT"] == "11"  # who set it is obeyed


@pytest.mark.parametrize(("options", "expected"), [({}, 3), ({"threads": 7}, 7)])
def test_a_share_of_the_cores_decodes_as_well(options, expected, monkeypatch):
    here = SimpleNamespace(mirrorskin_share=SimpleNamespace(cores=3, device=None))
    monkeypatch.setattr(worker, "get_worker", lambda: here)
    monkeypatch.setattr(worker, "run_job", lambda job, plan, device: plan)
    plan = Plan({"dataset": "/a"} | options)
    plan_of_worker = worker.run_on_worker(Job(Path("a"), Path("b")), plan)
    assert plan_of_worker.opening == {"dataset": "/a", "threads": expected}
    assert plan_of_worker.digest("vertical") == plan.digest("vertical")


@pytest.mark.slow
def test_workers_of_this_machine_are_processes_of_their_own(recordings, tmp_path):
    jobs = make_jobs(recordings, tmp_path / "results")
    assert states(run_cluster(jobs, PLAN, workers=2)) == ["done"] * 4
    assert soak.leftovers(tmp_path / "results") == []
