"""A batch on the workers of a Dask cluster: one that runs already, or one of this machine's own."""

from __future__ import annotations

import asyncio
import fcntl
import functools
import logging
import queue
import tempfile
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import ModuleType
from typing import Any

from mirrorskin.engine.batch.jobs import Job, Plan
from mirrorskin.engine.batch.work import Outcome
from mirrorskin.engine.provenance import program_version
from mirrorskin.io import InputError
from mirrorskin.io.atomic import remove_leftovers
from mirrorskin.io.os_errors import as_input_error

PATIENCE = 30.0
"""Seconds after which a scheduler that was reached, or the last of its workers, is taken for lost."""

_REACH = 10.0  # seconds, for a first answer
_CHECK = 150.0  # seconds, for a worker to load everything from a slow disk and try its device
_POLL = 1.0  # seconds between two looks at the workers

_log = logging.getLogger("mirrorskin.engine.batch")


def run_cluster(
    jobs: Iterable[Job], plan: Plan, address: str | None = None, workers: int | None = None
) -> Iterator[Outcome]:
    """Run a batch on a Dask cluster, each worker with a device of its own and one job at a time.

    The cluster is that of a scheduler that runs already, at ``address``, such as ``"tcp://node1:8786"``, or
    consists of so many ``workers``, processes of this machine that are started for this batch. All workers
    must see the files under the same names. A job whose worker is lost goes to another one. Closing the
    iterator ends the batch: jobs that run on workers of others are finished by them, all else is dropped.
    """
    jobs = list(jobs)
    if not jobs:
        return
    with _connect(address, workers) as client:
        batch = _Batch(client, address or "the batch's own cluster", plan)
        with batch.enlisted(jobs):
            yield from batch.outcomes(jobs)


class _Batch:
    """Jobs on their way through a cluster."""

    def __init__(self, client: Any, name: str, plan: Plan) -> None:
        self._client, self._name, self._plan = client, name, plan
        self._running: dict[str, tuple[Job, Any]] = {}
        self._ended: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._present: set[str] = set()
        self._polled, self._alive = 0.0, time.monotonic()

    @contextmanager
    def enlisted(self, jobs: list[Job]) -> Iterator[None]:
        """Let workers take part that can, also those that come later; at the end, drop what is not begun."""
        from mirrorskin.engine.batch.worker import RESOURCE, Enlist, check_worker

        sizes = _one_of_each_folder(job.source.absolute() for job in jobs)
        name, own = f"mirrorskin-{uuid.uuid4()}", program_version()
        with _trace(_nearest_existing(jobs[0].target.absolute().parent)) as trace:
            # A function of Python's own: one of ours could not be read by another version, or by none.
            for worker, found in self._run(version, "mirrorskin").items():
                if found != own:
                    has = "not installed" if isinstance(found, PackageNotFoundError) else found
                    remedy = "install the same on both"
                    self._refuse(worker, f"has mirrorskin {has}, and this machine {own}: {remedy}")
            for worker, found in self._run(check_worker, sizes, trace).items():
                if isinstance(found, Exception):
                    self._refuse(worker, f"cannot take part ({type(found).__name__}: {found})")
                if found is not None:
                    self._refuse(worker, found)
            self._client.subscribe_topic(RESOURCE, lambda event: _log.warning("%s", event[1]))
            self._client.register_plugin(Enlist(own, sizes, trace), name=name)
            try:
                yield
            finally:
                self._client.cancel([future for _, future in self._running.values()])
                with suppress(OSError, InputError):
                    self._ask(self._client.scheduler.unregister_worker_plugin, _REACH, name=name)

    def outcomes(self, jobs: list[Job]) -> Iterator[Outcome]:
        """Give out jobs, one for each worker, and yield what becomes of them.

        Dask itself gives a job whose worker is lost to another, and gives it up with the fourth.
        """
        waiting = deque(jobs)
        while waiting or self._running:
            self._poll()
            while waiting and len(self._running) < max(1, len(self._present)):
                self._submit(waiting.popleft())
            with suppress(queue.Empty):
                outcome = self._outcome(self._ended.get(timeout=_POLL))
                if outcome is not None:
                    yield outcome

    def _submit(self, job: Job) -> None:
        from mirrorskin.engine.batch.worker import RESOURCE, run_on_worker

        there = Job(job.source.absolute(), job.target.absolute())
        key = f"mirrorskin-{uuid.uuid4()}"
        future = self._client.submit(
            run_on_worker, there, self._plan, key=key, resources={RESOURCE: 1}, pure=False
        )
        self._running[key] = job, future
        future.add_done_callback(lambda future: self._ended.put(future.key))

    def _outcome(self, key: str) -> Outcome | None:
        """Return what became of a job; None if its worker was lost with the answer, and it is done again."""
        import distributed

        job, future = self._running[key]
        try:
            outcome: Outcome = replace(future.result(timeout=_REACH), job=job)
        except TimeoutError:
            future.add_done_callback(lambda future: self._ended.put(future.key))
            return None
        except distributed.CancelledError as error:
            raise self._lost("was lost") from error
        except distributed.KilledWorker as error:
            losses, remedy = error.allowed_failures + 1, "see their logs, and whether they have enough memory"
            problem = f"each of {losses} workers that had {job.source} was lost: {remedy}"
            outcome = Outcome(job, "failed", problem, 0.0)
        except Exception as error:
            problem = f"unexpected {type(error).__name__} on a worker: {error}"
            outcome = Outcome(job, "failed", " ".join(problem.split()), 0.0)
        del self._running[key]
        return outcome

    def _poll(self) -> None:
        """See that there is a scheduler and workers, and clear away what lost workers had begun to write."""
        now = time.monotonic()
        if now - self._polled < _POLL:
            return
        processing = self._ask(self._client.scheduler.processing, PATIENCE)
        lost = self._present - processing.keys()
        for worker in lost:
            _log.warning("worker %s was lost", worker)
        if lost:
            for folder in {job.target.parent for job, _ in self._running.values()}:
                remove_leftovers(folder)
        self._present, self._polled = set(processing), now
        working = any(processing.values()) or not self._ended.empty()
        if working or (processing and not self._running):
            self._alive = now
        elif now - self._alive > PATIENCE:
            remedy = f"start some with 'dask worker {self._client.scheduler.address}'"
            raise InputError(f"{self._name} has had no workers for {PATIENCE:g} s: {remedy}")

    def _refuse(self, worker: str, problem: str) -> None:
        raise InputError(f"worker {worker} of {self._name} {problem}")

    def _run(self, function: Callable[..., Any], *values: Any) -> dict[str, Any]:
        """Call a function on each worker, and return what it returned or raised."""
        run = functools.partial(self._client.run, function, *values, on_error="return")
        try:
            found: dict[str, Any] = run(callback_timeout=_CHECK)
        except (OSError, _closed()) as error:
            raise self._lost("does not answer" if isinstance(error, TimeoutError) else "was lost") from error
        return {worker: one for worker, one in found.items() if not isinstance(one, OSError)}  # it was lost

    def _ask(self, question: Callable[..., Any], timeout: float, **values: Any) -> Any:
        """Ask the scheduler something."""
        try:
            return self._client.sync(question, callback_timeout=timeout, **values)
        except (OSError, _closed()) as error:
            raise self._lost("does not answer" if isinstance(error, TimeoutError) else "was lost") from error

    def _lost(self, problem: str) -> InputError:
        remedy = "see that it runs and start the batch again, which goes on where it stopped"
        return InputError(f"{self._name} {problem}: {remedy}")


@contextmanager
def _connect(address: str | None, workers: int | None) -> Iterator[Any]:
    """Connect to a scheduler, or to one of the batch's own for as long as it lasts."""
    try:
        import distributed
    except ImportError as error:
        install = "pip install 'mirrorskin[cluster]'"
        raise InputError(f"a cluster needs Dask, which is not installed: {install}") from error
    with ExitStack() as stack:
        stack.enter_context(_quiet())
        if address is None:
            address = stack.enter_context(_own_cluster(workers or 1)).scheduler_address
        yield stack.enter_context(_reach(distributed, address))


@contextmanager
def _own_cluster(workers: int) -> Iterator[Any]:
    """Start a scheduler, and worker processes that are started again when they are lost."""
    import dask
    from distributed import LocalCluster

    start: Any = LocalCluster  # which has no types
    # Dask gives up those that need longer to come back: on a busy machine, that is most.
    patient = dask.config.set({"distributed.deploy.lost-worker-timeout": "1 hour"})
    with (
        patient,
        start(
            n_workers=workers,
            threads_per_worker=1,
            memory_limit=0,  # a plan has a limit of its own
            preload=["mirrorskin.engine.batch.worker"],
            dashboard_address=None,
            scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},  # else it complains of a second one
            silence_logs=logging.CRITICAL,
        ) as cluster,
    ):
        yield cluster


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep Dask's own messages off the terminal: outcomes and errors have what went wrong."""
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
        remedy = "start one with 'dask scheduler', and give the address that it prints"
        raise InputError(f"no Dask scheduler can be reached at {address} ({problem}): {remedy}") from error


async def _greet(distributed: ModuleType, address: str) -> None:
    """Shake hands with a scheduler: a client waits for ever for one that only listens."""
    known = distributed.Security().get_connection_args("client")
    comm = await asyncio.wait_for(distributed.comm.connect(address, timeout=0.9 * _REACH, **known), _REACH)
    await comm.close()


def _closed() -> type[Exception]:
    from distributed.client import ClosedClientError

    closed: type[Exception] = ClosedClientError
    return closed


@contextmanager
def _trace(folder: Path) -> Iterator[Path]:
    """Leave an empty file in a folder for a while: who sees it, sees the folder itself."""
    with ExitStack() as stack:
        with as_input_error(f"{folder} cannot be written to", "choose another folder with -o"):
            file = stack.enter_context(
                tempfile.NamedTemporaryFile(prefix=".mirrorskin-", suffix=".part", dir=folder)
            )
        with suppress(OSError):  # a file system without locks
            fcntl.flock(file, fcntl.LOCK_EX)  # no leftover yet
        yield Path(file.name)


def _one_of_each_folder(files: Iterable[Path]) -> dict[Path, int]:
    """Return the sizes of some files: one of each folder, if it is there at all."""
    first: dict[Path, Path] = {}
    for file in files:
        if file.parent not in first and file.is_file():
            first[file.parent] = file
    return {file: file.stat().st_size for file in first.values()}


def _nearest_existing(folder: Path) -> Path:
    """Return a folder, or the nearest above it that is there."""
    return next(one for one in [folder, *folder.parents] if one.is_dir())
