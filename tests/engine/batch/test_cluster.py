from __future__ import annotations

import asyncio
import dataclasses
import errno
import logging
import os
import socket
import sys
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
from mirrorskin.engine.batch import cluster, place
from mirrorskin.engine.batch.cluster import run_cluster
from mirrorskin.engine.batch.jobs import Job, make_jobs
from mirrorskin.engine.batch.local import default_devices, run_local
from mirrorskin.engine.batch.place import Place
from mirrorskin.engine.batch.plan import Plan
from mirrorskin.engine.batch.work import Outcome
from mirrorskin.io.atomic import remove_leftovers

PLAN = Plan(press={"fill": False})


@pytest.fixture(autouse=True)
def own_environment(monkeypatch):
    """Workers in this process leave its environment as it was, and nobody waits long."""
    monkeypatch.setenv("POCL_MAX_PTHREAD_COUNT", os.environ.get("POCL_MAX_PTHREAD_COUNT", "2"))
    monkeypatch.setattr(cluster, "_LOOK", 0.1)


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
    with start(2) as running:
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


def test_a_batch_on_a_cluster_is_done_and_then_kept(recordings, address, tmp_path):
    jobs = make_jobs(recordings, tmp_path / "results")
    outcomes = list(run_cluster(jobs, PLAN, address))
    assert states(outcomes) == ["done"] * 4
    assert {outcome.job for outcome in outcomes} == set(jobs)
    assert all(outcome.device and outcome.bytes == 8 * 6 * 9 for outcome in outcomes)
    assert states(run_cluster(jobs, PLAN, address)) == ["kept"] * 4
    assert states(run_local(jobs, PLAN, default_devices())) == ["kept"] * 4


def test_what_is_done_here_is_kept_on_a_cluster(recordings, address, tmp_path):
    jobs = make_jobs(recordings, tmp_path / "results")
    assert states(run_local(jobs[:3], PLAN, default_devices())) == ["done"] * 3
    assert states(run_cluster(jobs, PLAN, address)) == ["done"] + ["kept"] * 3


def test_paths_are_those_of_here(recordings, address, tmp_path, monkeypatch):
    monkeypatch.chdir(recordings[0].parent)
    results = Path(os.path.relpath(tmp_path, recordings[0].parent))
    (job,) = make_jobs([Path(recordings[0].name)], results)
    monkeypatch.setattr(place, "do", lambda job, *_: Outcome(job, "done", str(job.source.is_absolute()), 0.0))
    (outcome,) = run_cluster([job], PLAN, address)
    assert outcome.job == job
    assert outcome.message == "True"


def test_one_bad_recording_does_not_stop_the_rest(recordings, address, tmp_path):
    (tmp_path / "bad.h5").write_bytes(b"not HDF5")
    jobs = make_jobs([tmp_path / "bad.h5", *recordings, tmp_path / "gone.h5"], tmp_path / "results")
    outcomes = list(run_cluster(jobs, PLAN, address))
    assert states(outcomes) == ["done"] * 4 + ["failed"] * 2
    failed = {outcome.job.source.name: outcome.message for outcome in outcomes if outcome.state == "failed"}
    assert "not HDF5" in failed["bad.h5"] or "HDF5" in failed["bad.h5"]
    assert "gone.h5" in failed["gone.h5"]


def test_a_worker_of_many_threads_does_one_job_at_a_time(recordings, tmp_path, monkeypatch):
    under_way, most = [], []

    def slowly(job, plan, device):
        under_way.append(job)
        most.append(len(under_way))
        time.sleep(0.02)
        under_way.remove(job)
        return Outcome(job, "done", "", 0.0)

    monkeypatch.setattr(place, "do", slowly)
    with start(1, threads=4) as running:
        jobs = make_jobs(recordings, tmp_path / "results")
        assert states(run_cluster(jobs, PLAN, running.scheduler_address)) == ["done"] * 4
    assert most == [1] * 4


def test_leaving_early_ends_the_batch(recordings, two_workers, tmp_path):
    jobs = make_jobs(recordings, tmp_path / "results")
    with closing(run_cluster(jobs, PLAN, two_workers.scheduler_address)) as run:
        next(run)
    deadline = time.monotonic() + 10
    while two_workers.scheduler.tasks:
        assert time.monotonic() < deadline, "the scheduler still has jobs"
        time.sleep(0.01)
    assert len(soak.results(tmp_path / "results")) < 4


@pytest.fixture
def used(monkeypatch):
    """The places of the workers that did a job, each of which takes a while and does nothing."""
    places = []

    def note(job, plan, place):
        places.append(place)
        time.sleep(0.03)
        return Outcome(job, "done", "", 0.0)

    monkeypatch.setattr(place, "open_own", lambda place: place)
    monkeypatch.setattr(place, "do", note)
    return places


def test_a_worker_that_comes_late_takes_part(recordings, tmp_path, used):
    jobs = make_jobs(recordings, tmp_path) * 5
    with start(1) as running, closing(run_cluster(jobs, PLAN, running.scheduler_address)) as run:
        next(run)
        assert set(used) == {Place(0, 1)}
        running.scale(2)
        assert len(list(run)) == 19
    assert set(used) == {Place(0, 1), Place(1, 2)}


def test_a_late_worker_that_cannot_take_part_is_left_out(recordings, tmp_path, monkeypatch, caplog, used):
    jobs = make_jobs(recordings, tmp_path) * 5
    with start(1) as running, closing(run_cluster(jobs, PLAN, running.scheduler_address)) as run:
        next(run)
        monkeypatch.setattr(cluster, "version", lambda _: "0.0.9")
        running.scale(2)
        assert len(list(run)) == 19
    assert set(used) == {Place(0, 1)}
    assert "has mirrorskin 0.0.9" in caplog.text


def test_a_late_worker_that_does_not_answer_is_left_out(recordings, tmp_path, monkeypatch, caplog, used):
    def wait_in_vain(*_):
        raise io.InputError("it does not answer")

    jobs = make_jobs(recordings, tmp_path) * 5
    with start(1) as running, closing(run_cluster(jobs, PLAN, running.scheduler_address)) as run:
        next(run)
        monkeypatch.setattr(cluster._Crew, "_check_version", wait_in_vain)
        running.scale(2)
        assert len(list(run)) == 19
    assert set(used) == {Place(0, 1)}
    assert "did not answer" in caplog.text


def test_a_job_that_fails_in_an_unforeseen_way_is_told_in_a_line(recordings, address, tmp_path, monkeypatch):
    def fail(*_):
        raise RuntimeError("of two\nlines")

    monkeypatch.setattr(cluster, "do_at", fail)
    outcomes = list(run_cluster(make_jobs(recordings, tmp_path), PLAN, address))
    assert states(outcomes) == ["failed"] * 4
    assert all("unexpected RuntimeError" in outcome.message for outcome in outcomes)
    assert all("of two lines" in outcome.message for outcome in outcomes)


def test_no_scheduler_is_refused(recordings, tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "_REACH", 0.3)
    jobs = make_jobs(recordings, tmp_path)
    begun = time.monotonic()
    for address in (
        "tcp://127.0.0.1:1",
        "nonsense",
        "foo://127.0.0.1:8786",
        "tcp://a:b",
        "tcp://127.0.0.1:99999",
    ):
        message = refusal(jobs, address)
        assert message.startswith(f"no Dask scheduler can be reached at {address}")
        assert "dask scheduler" in message
    assert time.monotonic() - begun < 5


def test_who_listens_and_says_nothing_is_no_scheduler(recordings, tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "_REACH", 0.3)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        message = refusal(make_jobs(recordings, tmp_path), f"tcp://127.0.0.1:{silent.getsockname()[1]}")
    assert "no answer within 0.3 s" in message


def test_a_scheduler_without_workers_is_refused(recordings, tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "PATIENCE", 0.3)
    with start(0) as running:
        message = refusal(make_jobs(recordings, tmp_path), running.scheduler_address)
    assert f"no workers for 0.3 s: start some with 'dask worker {running.scheduler_address}'" in message


def test_a_cluster_that_goes_away_is_told(recordings, tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "PATIENCE", 1.0)
    with start(1) as running:
        run = run_cluster(make_jobs(recordings, tmp_path) * 50, PLAN, running.scheduler_address)
        next(run)
        running.close()
        with pytest.raises(io.InputError, match="goes on where it stopped"):
            list(run)


def test_without_dask_a_remedy_is_told(recordings, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert "pip install 'mirrorskin[cluster]'" in refusal(
        make_jobs(recordings, tmp_path), "tcp://127.0.0.1:1"
    )


def test_another_version_on_a_worker_is_refused(recordings, address, tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "program_version", lambda: "9.9")
    own = cluster.version("mirrorskin")
    message = refusal(make_jobs(recordings, tmp_path), address)
    assert f"has mirrorskin {own}, and this machine 9.9: install the same on both" in message
    assert "worker tcp://127.0.0.1:" in message


def test_a_worker_without_mirrorskin_is_refused(recordings, address, tmp_path, monkeypatch):
    def missing(name):
        raise PackageNotFoundError(name)

    monkeypatch.setattr(cluster, "version", missing)
    assert "has mirrorskin not installed" in refusal(make_jobs(recordings, tmp_path), address)


def test_a_worker_that_does_not_see_the_recordings_is_refused(recordings, address, tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "_one_of_each_folder", lambda _: {tmp_path / "elsewhere.h5": 10})
    message = refusal(make_jobs(recordings, tmp_path), address)
    assert f"does not see {tmp_path / 'elsewhere.h5'}: workers need the same folders" in message


def test_a_folder_that_cannot_be_written_to_is_refused(recordings, address, tmp_path, monkeypatch):
    def refuse(**_):
        raise PermissionError(errno.EACCES, "no")

    monkeypatch.setattr(cluster.tempfile, "NamedTemporaryFile", refuse)
    message = refusal(make_jobs(recordings, tmp_path / "new" / "results"), address)
    assert message == f"{tmp_path} cannot be written to: Permission denied; choose another folder with -o"


def test_a_trace_is_no_leftover_and_leaves_none(tmp_path):
    with cluster._trace(tmp_path) as trace:
        assert trace.parent == tmp_path
        assert remove_leftovers(tmp_path) == []
        assert trace.exists()
    assert list(tmp_path.iterdir()) == []


def test_a_batch_of_nothing_needs_nobody():
    assert list(run_cluster([], PLAN, "tcp://127.0.0.1:1")) == []


def look(sizes, trace, here=Place(0, 1)):  # noqa: B008 - frozen
    worker = SimpleNamespace(address="tcp://a:1")
    return asyncio.run(place.look_around(sizes, trace, {"tcp://a:1": here}, worker))


def test_what_keeps_a_worker_from_taking_part(tmp_path, monkeypatch):
    file, trace = tmp_path / "a.h5", tmp_path / "trace"
    file.write_bytes(b"12345")
    assert f"does not see the folder {tmp_path} as it is here" in look({file: 5}, trace)
    trace.touch()
    assert look({file: 5}, trace) is None
    assert "does not see" in look({file: 6}, trace)
    assert "does not see" in look({tmp_path / "b.h5": 5}, trace)
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    assert f"cannot write to {tmp_path}" in look({file: 5}, trace)


def test_a_worker_without_a_device_is_refused(tmp_path, monkeypatch):
    def nothing(_):
        raise place.DeviceError("no OpenCL device found: install one")

    monkeypatch.setattr(place, "open_own", nothing)
    trace = tmp_path / "trace"
    trace.touch()
    assert look({}, trace) == "has no device: no OpenCL device found: install one"


def test_workers_take_a_machines_gpus_in_turn(monkeypatch):
    kinds = ["cpu", "gpu", "other", "gpu"]
    monkeypatch.setattr(place, "list_devices", lambda: [SimpleNamespace(kind=kind) for kind in kinds])
    monkeypatch.setattr(place, "open_device", lambda choice=None: choice)
    monkeypatch.delenv("PYOPENCL_CTX", raising=False)
    open_own = place.open_own.__wrapped__
    assert [open_own(Place(number, 5)) for number in range(5)] == ["1", "3", "1", "3", "1"]
    monkeypatch.setenv("PYOPENCL_CTX", "0")
    assert open_own(Place(1, 5)) is None
    monkeypatch.delenv("PYOPENCL_CTX")
    monkeypatch.setattr(place, "list_devices", lambda: [SimpleNamespace(kind="cpu")])
    assert open_own(Place(1, 5)) is None


@pytest.mark.parametrize(("cores", "workers"), [(2, 2), (8, 3), (5, 5), (7, 1), (64, 6)])
def test_the_cores_of_a_machine_are_divided(cores, workers, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)))
    monkeypatch.setattr(place, "list_devices", list)
    monkeypatch.setattr(place, "open_device", lambda choice=None: choice)
    shares = []
    for number in range(workers):
        monkeypatch.delenv("POCL_MAX_PTHREAD_COUNT", raising=False)
        place.open_own.__wrapped__(Place(number, workers))
        shares.append(int(os.environ["POCL_MAX_PTHREAD_COUNT"]))
    assert sum(shares) == cores
    assert max(shares) - min(shares) <= 1


def test_more_workers_than_cores_have_one_each(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    assert [place._cores(Place(number, 3)) for number in range(3)] == [1, 1, 1]


@pytest.mark.parametrize(("given", "expected"), [({}, 3), ({"threads": 7}, 7)])
def test_a_share_of_the_cores_decodes_as_well(given, expected, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(6)))
    monkeypatch.setattr(place, "open_own", lambda _: None)
    monkeypatch.setattr(place, "do", lambda job, plan, device: plan)
    plan = Plan({"dataset": "/a"} | given)
    done = place.do_at(Place(1, 2), Job(Path("a"), Path("b")), plan)
    assert done.opening == {"dataset": "/a", "threads": expected}
    assert done.digest("vertical") == plan.digest("vertical")


def test_who_set_the_number_of_threads_is_obeyed(monkeypatch):
    monkeypatch.setenv("POCL_MAX_PTHREAD_COUNT", "11")
    monkeypatch.setattr(place, "open_device", lambda choice=None: choice)
    place.open_own.__wrapped__(Place(0, 2))
    assert os.environ["POCL_MAX_PTHREAD_COUNT"] == "11"


def test_each_machine_counts_its_own_workers():
    crew = cluster._Crew(None, "a cluster", [Job(Path("/a.h5"), Path("/b.h5"))])
    crew.places = {"tcp://a:1": Place(0, 3), "tcp://a:3": Place(2, 3)}
    present = {*crew.places, "tcp://a:9", "tcp://a:8", "tcp://b:1", "tcp://[::1]:7"}
    places = crew._place(["tcp://a:8", "tcp://a:9", "tcp://b:1", "tcp://[::1]:7"], present)
    assert places == {
        "tcp://a:8": Place(1, 4),
        "tcp://a:9": Place(3, 4),
        "tcp://b:1": Place(0, 1),
        "tcp://[::1]:7": Place(0, 1),
    }


@dataclasses.dataclass
class Future:
    """A job's future, which is done at once or never."""

    key: str
    outcome: Outcome | None

    @property
    def status(self):
        return "pending" if self.outcome is None else "finished"

    def add_done_callback(self, tell):
        if self.outcome is not None:
            tell(self)

    def result(self, timeout):
        return self.outcome

    def done(self):
        return self.outcome is not None

    def cancel(self):
        pass


class Unlucky:
    """A crew of one, and the client: the worker leaves as often as is said, and another comes."""

    def __init__(self, losses):
        self.places, self.given, self._losses = {}, [], losses

    def look(self):
        self.places = {f"tcp://a:{len(self.given)}": Place(0, 1)}

    def submit(self, function, place, job, plan, key, workers, pure):
        self.given.append((job.source.name, *workers))
        return Future(key, None if len(self.given) <= self._losses else Outcome(job, "done", "", 0.0))


@pytest.mark.parametrize(("losses", "state"), [(0, "done"), (1, "done"), (3, "done"), (4, "failed")])
def test_a_job_may_cost_three_workers_and_no_more(losses, state, monkeypatch, tmp_path):
    monkeypatch.setattr(cluster, "_LOOK", 0.001)
    crew = Unlucky(losses)
    jobs = [Job(tmp_path / name, tmp_path / f"{name}-result") for name in ("first", "second")]
    first, second = cluster._Dispatch(crew, crew, jobs, PLAN).outcomes()
    assert (first.job, first.state) == (jobs[0], state)
    assert (second.job, second.state) == (jobs[1], "done")
    attempts = losses + (state == "done")
    assert crew.given == [("first", f"tcp://a:{n}") for n in range(attempts)] + [
        ("second", f"tcp://a:{attempts}")
    ]
    assert (
        first.message == "" or f"each of {losses} workers that had {jobs[0].source} was lost" in first.message
    )


class Deadly(Unlucky):
    """The same, where the job that is named first ends its worker, with all that the worker was given."""

    def look(self):
        worker = f"tcp://a:{sum(name == 'first' for name, _ in self.given)}"
        self.places = {worker: Place(0, 1)}

    def submit(self, function, place, job, plan, key, workers, pure):
        self.given.append((job.source.name, *workers))
        lost = ("first", *workers) in self.given
        return Future(key, None if lost else Outcome(job, "done", "", 0.0))


def test_only_the_job_that_was_begun_is_blamed(monkeypatch, tmp_path):
    monkeypatch.setattr(cluster, "_LOOK", 0.001)
    names = ["first", "second", "third", "fourth"]
    crew = Deadly(0)
    jobs = [Job(tmp_path / name, tmp_path / f"{name}-result") for name in names]
    outcomes = list(cluster._Dispatch(crew, crew, jobs, PLAN).outcomes())
    assert {outcome.job.source.name: outcome.state for outcome in outcomes} == {
        "first": "failed",
        "second": "done",
        "third": "done",
        "fourth": "done",
    }
    given = [name for name, _ in crew.given]
    assert given.count("first") == 4
    assert given.count("second") == 5  # four times behind the first, and then its turn


def test_a_job_that_was_done_when_its_worker_was_lost_is_asked_for_again(monkeypatch, tmp_path, caplog):
    def lose(self, timeout):
        monkeypatch.undo()
        raise TimeoutError

    monkeypatch.setattr(Future, "result", lose)
    crew = Unlucky(0)
    (outcome,) = cluster._Dispatch(crew, crew, [Job(tmp_path / "a", tmp_path / "b")], PLAN).outcomes()
    assert outcome.state == "done"
    assert len(crew.given) == 2
    assert "was lost" not in caplog.text  # nobody is blamed
