"""A batch on the workers of a Dask cluster: one that runs already, or one of this machine's own."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import functools
import itertools
import logging
import queue
import tempfile
import time
import uuid
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import ModuleType
from typing import Any, cast

from mirrorskin.engine.batch.jobs import Job
from mirrorskin.engine.batch.place import Place, do_at, look_around
from mirrorskin.engine.batch.plan import Plan
from mirrorskin.engine.batch.work import Outcome
from mirrorskin.engine.provenance import program_version
from mirrorskin.io import InputError
from mirrorskin.io.atomic import remove_leftovers
from mirrorskin.io.os_errors import as_input_error

PATIENCE = 30.0
"""Seconds after which a scheduler that was reached, or the last of its workers, is held to be gone."""

_REACH = 10.0  # seconds, for a first answer
_CHECK = 150.0  # seconds, for a worker to load everything from a slow disk and try its device
_LOOK = 1.0  # seconds between two looks at who the workers are
_LOSSES = 3  # workers that a job may cost before it is held to be the cause
_INSTALL = "pip install 'mirrorskin[cluster]'"

_log = logging.getLogger("mirrorskin.engine.batch")


def run_cluster(
    jobs: Iterable[Job], plan: Plan, address: str | None = None, workers: int | None = None
) -> Iterator[Outcome]:
    """Run a batch on a Dask cluster, each worker with a device of its own and one job at a time.

    A job whose worker is lost goes to another one. Closing the iterator ends the batch: jobs that run on
    workers of others are then finished by them, all else is dropped.

    Parameters
    ----------
    jobs : iterable of Job
        Workers must see their files under the same names.
    plan : Plan
    address : str, optional
        Of a scheduler that runs already, such as ``"tcp://node1:8786"``.
    workers : int, optional
        How many worker processes to start on this machine, for this batch, instead.

    Yields
    ------
    Outcome
        Of each job, as it is done.

    Raises
    ------
    InputError
        Dask is not installed, the scheduler cannot be reached or is lost, there are no workers, or one of
        them has another version of mirrorskin, does not see the files or has no device.
    """
    jobs = list(jobs)
    if not jobs:
        return
    with _connect(address, workers) as client:
        dispatch = _Dispatch(client, _Crew(client, address or "the batch's own cluster", jobs), jobs, plan)
        try:
            yield from dispatch.outcomes()
        finally:
            dispatch.cancel()


@dataclass(frozen=True, slots=True)
class _Run:
    """A job on its way: the future of its outcome, and the worker that has it."""

    job: Job
    future: Any
    worker: str


class _Dispatch:
    """Who does what: each worker has a job, and the next one; they are queued again when it is lost."""

    def __init__(self, client: Any, crew: _Crew, jobs: list[Job], plan: Plan) -> None:
        self._client = client
        self._crew = crew
        self._plan = plan
        self._waiting = deque(jobs)
        self._losses: Counter[Job] = Counter()
        self._running: dict[str, _Run] = {}
        self._ended: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def outcomes(self) -> Iterator[Outcome]:
        """Give out jobs and yield what becomes of them, until there are none."""
        while self._waiting or self._running:
            self._crew.look()
            yield from filter(None, map(self._retry, self._take_back()))
            self._give_out()
            with contextlib.suppress(queue.Empty):
                ended = self._running.pop(self._ended.get(timeout=_LOOK), None)
                if ended is not None and (outcome := self._outcome(ended)) is not None:
                    yield outcome

    def cancel(self) -> None:
        """Forget all jobs that no worker has begun."""
        futures = [run.future for run in self._running.values()]
        self._running.clear()
        if futures:
            self._client.cancel(futures)

    def _give_out(self) -> None:
        """Give each worker a job, and the next one before it asks, while there are plenty."""
        given = Counter(run.worker for run in self._running.values())
        for ahead in range(2):
            for worker, place in self._crew.places.items():
                if given[worker] <= ahead and len(self._waiting) > ahead * len(self._crew.places):
                    self._start(self._waiting.popleft(), worker, place)
                    given[worker] += 1

    def _start(self, job: Job, worker: str, place: Place) -> None:
        there = Job(job.source.absolute(), job.target.absolute())
        key = f"mirrorskin-{uuid.uuid4()}"
        future = self._client.submit(do_at, place, there, self._plan, key=key, workers=[worker], pure=False)
        self._running[key] = _Run(job, future, worker)
        future.add_done_callback(lambda future: self._ended.put(future.key))

    def _take_back(self) -> list[_Run]:
        """Return what lost workers were at; what they were to do next is queued again."""
        gone = [
            key
            for key, run in self._running.items()
            if run.worker not in self._crew.places and not run.future.done()
        ]
        begun: dict[str, _Run] = {}
        for run in map(self._running.pop, gone):  # in the order in which they were given
            run.future.cancel()
            if begun.setdefault(run.worker, run) is not run:
                self._waiting.appendleft(run.job)
        return list(begun.values())

    def _outcome(self, run: _Run) -> Outcome | None:
        """Return what became of a run that ended; None where its worker was lost, and it is queued again."""
        if run.future.status == "error":
            error = run.future.exception()
            if isinstance(error, _distributed().KilledWorker):
                return self._retry(run)
            problem = f"unexpected {type(error).__name__} on worker {run.worker}: {error}"
            return Outcome(run.job, "failed", " ".join(problem.split()), 0.0)
        if run.future.status == "finished":
            with contextlib.suppress(OSError, _distributed().CancelledError):
                outcome: Outcome = run.future.result(timeout=_REACH)
                return replace(outcome, job=run.job)
        # It was done when its worker was lost, and nobody was told yet: it will be kept.
        self._waiting.appendleft(run.job)
        return None

    def _retry(self, run: _Run) -> Outcome | None:
        """Queue a job whose worker was lost again, unless it seems to be what ends them."""
        self._losses[run.job] += 1
        losses = self._losses[run.job]
        _log.warning("worker %s was lost while it had %s", run.worker, run.job.source)
        remove_leftovers(run.job.target.parent)
        if losses <= _LOSSES:
            self._waiting.appendleft(run.job)
            return None
        remedy = "see what their logs say, and whether they have enough memory"
        problem = f"each of {losses} workers that had {run.job.source} was lost: {remedy}"
        return Outcome(run.job, "failed", problem, 0.0)


class _Crew:
    """The workers that can take part, and where each of them stands."""

    def __init__(self, client: Any, name: str, jobs: list[Job]) -> None:
        self.places: dict[str, Place] = {}
        self._client = client
        self._name = name
        self._sizes = _one_of_each_folder(job.source.absolute() for job in jobs)
        self._folder = _that_exists(jobs[0].target.absolute().parent)
        self._refused: set[str] = set()
        self._begun = False
        self._looked = self._seen = time.monotonic() - _LOOK

    def look(self) -> None:
        """Find out who came and who went, unless that was done just now.

        Raises
        ------
        InputError
            The scheduler is gone, or all workers are; or one of the first of them cannot take part.
        """
        if time.monotonic() - self._looked < _LOOK:
            return
        members = functools.partial(self._client.sync, self._client.scheduler.ncores)
        present = set(self._ask(members, PATIENCE))
        self.places = {worker: place for worker, place in self.places.items() if worker in present}
        self._admit(sorted(present - self.places.keys() - self._refused), present)
        self._looked = time.monotonic()
        if self.places:
            self._seen, self._begun = self._looked, True
        elif self._looked - self._seen > PATIENCE:
            remedy = f"start some with 'dask worker {self._client.scheduler.address}'"
            raise InputError(f"{self._name} has had no workers for {PATIENCE:g} s: {remedy}")

    def _admit(self, new: list[str], present: set[str]) -> None:
        """Let those take part that can."""
        if not new:
            return
        places = self._place(new, present)
        try:
            problems = self._check_version(new)
            fit = {worker: place for worker, place in places.items() if worker not in problems}
            problems |= self._check_sight(fit) if fit else {}
        except InputError:
            if not self._begun:
                raise
            problems = dict.fromkeys(new, f"did not answer within {_CHECK:g} s")
        for worker, problem in problems.items():
            if problem is not None:
                self._refuse(f"worker {worker} of {self._name} {problem}")
                self._refused.add(worker)
        self.places |= {worker: place for worker, place in places.items() if worker not in problems}

    def _refuse(self, message: str) -> None:
        """Tell at the beginning of a batch, when it can be mended; later the others go on without."""
        if not self._begun:
            raise InputError(message)
        _log.warning("%s", message)

    def _place(self, new: list[str], present: set[str]) -> dict[str, Place]:
        """Give each worker the first number that is free on its machine."""
        hosts = Counter(map(_host, present))
        taken = {(_host(worker), place.number) for worker, place in self.places.items()}
        places = {}
        for worker in new:
            host = _host(worker)
            number = next(number for number in itertools.count() if (host, number) not in taken)
            taken.add((host, number))
            places[worker] = Place(number, hosts[host])
        return places

    def _check_version(self, workers: list[str]) -> dict[str, str | None]:
        """Return what is wrong with those who cannot take part; None with one that was lost meanwhile."""
        # A function of Python's own: one of ours could not be read by another version, or by none.
        found, own = self._run(workers, version, "mirrorskin"), program_version()
        return {
            worker: None
            if isinstance(one, OSError)
            else f"has mirrorskin {_number(one)}, and this machine {own}: install the same on both"
            for worker, one in found.items()
            if one != own
        }

    def _check_sight(self, places: Mapping[str, Place]) -> dict[str, str | None]:
        """Return the same for those who do not see the files, or have no device."""
        with _trace(self._folder) as trace:
            found = self._run(list(places), look_around, self._sizes, trace, places)
        return {
            worker: None
            if isinstance(one, OSError)
            else f"cannot take part ({type(one).__name__}: {one})"
            if isinstance(one, Exception)
            else one
            for worker, one in found.items()
            if one is not None
        }

    def _run(self, workers: list[str], function: Callable[..., Any], *values: Any) -> dict[str, Any]:
        run = functools.partial(self._client.run, function, *values, workers=workers, on_error="return")
        return cast(dict[str, Any], self._ask(run, _CHECK))

    def _ask(self, question: Callable[..., Any], timeout: float) -> Any:
        try:
            return question(callback_timeout=timeout)
        except (OSError, _distributed().client.ClosedClientError) as error:
            problem = "does not answer" if isinstance(error, TimeoutError) else "was lost"
            remedy = "see that it runs and start the batch again, which goes on where it stopped"
            raise InputError(f"{self._name} {problem}: {remedy}") from error


@contextmanager
def _connect(address: str | None, workers: int | None) -> Iterator[Any]:
    """Connect to a scheduler, or to one of the batch's own for as long as it lasts."""
    distributed = _distributed()
    with ExitStack() as stack:
        stack.enter_context(_quiet())
        if address is None:
            address = stack.enter_context(_own_cluster(workers or 1)).scheduler_address
        yield stack.enter_context(_reach(distributed, address))


@contextmanager
def _own_cluster(workers: int) -> Iterator[Any]:
    """Start a scheduler, and worker processes that are started again when they are lost."""
    distributed = _distributed()
    import dask

    # Dask gives up those that need longer to come back: on a busy machine, that is most.
    patient = dask.config.set({"distributed.deploy.lost-worker-timeout": "1 hour"})
    with (
        patient,
        distributed.LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            memory_limit=0,  # a plan has a limit of its own
            preload=[do_at.__module__],
            dashboard_address=None,
            scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},  # else it complains of a second one
            silence_logs=logging.CRITICAL,
        ) as cluster,
    ):
        yield cluster


@contextmanager
def _quiet() -> Iterator[None]:
    """Let Dask say nothing: what goes wrong is told by outcomes and errors."""
    names = [name for name in logging.root.manager.loggerDict if name.partition(".")[0] == "distributed"]
    loggers = [logging.getLogger(name) for name in names]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def _reach(distributed: ModuleType, address: str) -> Any:
    try:
        with ThreadPoolExecutor(1) as thread:  # the caller's may have an event loop of its own
            thread.submit(asyncio.run, _greet(distributed, address)).result()
        return distributed.Client(address, timeout=_REACH, set_as_default=False)
    except (OSError, ValueError, OverflowError) as error:
        problem = " ".join(str(error).split()) or f"no answer within {_REACH:g} s"
        remedy = "start one with 'dask scheduler', and give the address that it tells"
        raise InputError(f"no Dask scheduler can be reached at {address} ({problem}): {remedy}") from error


async def _greet(distributed: ModuleType, address: str) -> None:
    """Shake hands with a scheduler: a client waits for ever for one that only listens."""
    known = distributed.Security().get_connection_args("client")
    comm = await asyncio.wait_for(distributed.comm.connect(address, timeout=0.9 * _REACH, **known), _REACH)
    await comm.close()


def _distributed() -> ModuleType:
    try:
        import distributed
    except ImportError as error:
        raise InputError(f"a cluster needs Dask, which is not installed: {_INSTALL}") from error
    found: ModuleType = distributed
    return found


@contextmanager
def _trace(folder: Path) -> Iterator[Path]:
    """Leave an empty file in a folder for a while: who sees it, sees the folder itself."""
    with ExitStack() as stack:
        with as_input_error(f"{folder} cannot be written to", "choose another folder with -o"):
            file = stack.enter_context(
                tempfile.NamedTemporaryFile(prefix=".mirrorskin-", suffix=".part", dir=folder)
            )
        with contextlib.suppress(OSError):  # a file system without locks
            fcntl.flock(file, fcntl.LOCK_EX)  # no leftover yet
        yield Path(file.name)


def _one_of_each_folder(files: Iterable[Path]) -> dict[Path, int]:
    """Return the sizes of some files: one of each folder, if it is there at all."""
    first: dict[Path, Path] = {}
    for file in files:
        if file.parent not in first and file.is_file():
            first[file.parent] = file
    return {file: file.stat().st_size for file in first.values()}


def _that_exists(folder: Path) -> Path:
    """Return a folder, or the nearest above it that is there."""
    return next(one for one in [folder, *folder.parents] if one.is_dir())


def _host(worker: str) -> str:
    return worker.rpartition(":")[0]


def _number(found: object) -> str:
    return "not installed" if isinstance(found, PackageNotFoundError) else str(found)
