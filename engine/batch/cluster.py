"""A batch on the workers of a Dask cluster: a running one, or a local one for this batch."""

from __future__ import annotations

import asyncio
import functools
import logging
import os
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

from mirrorskin.engine.base.provenance import program_version
from mirrorskin.engine.batch.jobs import Job, Plan
from mirrorskin.engine.batch.work import Outcome
from mirrorskin.io import InputError
from mirrorskin.io.base.system import lock, translate_os_errors
from mirrorskin.io.storage.atomic import remove_leftovers

PATIENCE = 30.0
"""Timeout, s, of a scheduler after the first contact, and of a cluster without workers."""

_REACH = 10.0  # seconds: timeout of the first answer
_CHECK = 150.0  # seconds: timeout of the check of a worker, which may load modules from a slow disk
_POLL = 1.0  # seconds between queries of the workers

_log = logging.getLogger("mirrorskin.engine.batch")


def run_cluster(
    jobs: Iterable[Job], plan: Plan, address: str | None = None, workers: int | None = None
) -> Iterator[Outcome]:
    """Run a batch on a Dask cluster; each worker has its own device and runs one job at a time.

    The cluster is that of a running scheduler at ``address``, such as ``"tcp://node1:8786"``, or ``workers``
    local processes that are started for this batch. All workers must see the files under the same names. A
    job whose worker is lost is given to another one. Closing the iterator ends the batch: jobs that are
    running on a remote cluster are finished there, all others are cancelled.
    """
    jobs, plan = list(jobs), plan.for_other_processes()
    if not jobs:
        return
    with _connect(address, workers) as client:
        batch = _Batch(client, address or "the batch's own cluster", plan)
        with batch.enlisted(jobs):
            yield from batch.outcomes(jobs)


class _Batch:
    """A batch in progress on a cluster."""

    def __init__(self, client: Any, name: str, plan: Plan) -> None:
        self._client, self._name, self._plan = client, name, plan
        self._running: dict[str, tuple[Job, Any]] = {}
        self._ended: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._present: set[str] = set()
        self._polled, self._alive = 0.0, time.monotonic()

    @contextmanager
    def enlisted(self, jobs: list[Job]) -> Iterator[None]:
        """Enlist suitable workers, including those that join later; at the end, cancel the remaining jobs."""
        from mirrorskin.engine.batch.worker import RESOURCE, Enlist, check_worker

        sizes = _one_of_each_folder(job.source.absolute() for job in jobs)
        name, program = f"mirrorskin-{uuid.uuid4()}", program_version()
        with _trace(_nearest_existing(jobs[0].target.absolute().parent)) as trace:
            # A function of the standard library, since another version of mirrorskin may not have ours.
            for worker, installed in self._run(version, "mirrorskin").items():
                if installed != program:
                    has = "not installed" if isinstance(installed, PackageNotFoundError) else installed
                    remedy = "install the same on both"
                    self._refuse(worker, f"has mirrorskin {has}, and this machine {program}: {remedy}")
            for worker, problem in self._run(check_worker, sizes, trace).items():
                if isinstance(problem, Exception):
                    self._refuse(worker, f"cannot take part ({type(problem).__name__}: {problem})")
                if problem is not None:
                    self._refuse(worker, problem)
            self._client.subscribe_topic(RESOURCE, lambda event: _log.warning("%s", event[1]))
            self._client.register_plugin(Enlist(program, sizes, trace), name=name)
            try:
                yield
            finally:
                self._client.cancel([future for _, future in self._running.values()])
                with suppress(OSError, InputError):
                    self._ask(self._client.scheduler.unregister_worker_plugin, _REACH, name=name)

    def outcomes(self, jobs: list[Job]) -> Iterator[Outcome]:
        """Submit jobs, one per worker, and yield their outcomes.

        Dask gives a job whose worker is lost to another worker, at most three times.
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

        absolute = Job(job.source.absolute(), job.target.absolute())
        key = f"mirrorskin-{uuid.uuid4()}"
        future = self._client.submit(
            run_on_worker, absolute, self._plan, key=key, resources={RESOURCE: 1}, pure=False
        )
        self._running[key] = job, future
        future.add_done_callback(lambda future: self._ended.put(future.key))

    def _outcome(self, key: str) -> Outcome | None:
        """Return the outcome of a job; None if it is repeated because the worker with the answer was lost."""
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
        """Check that there are a scheduler and workers, and remove partial files of lost workers."""
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
        """Call a function on each worker, and return its results or exceptions."""
        run = functools.partial(self._client.run, function, *values, on_error="return")
        answers: dict[str, Any] = self._checked(run, _CHECK)
        # An OSError means that the worker was lost.
        return {worker: answer for worker, answer in answers.items() if not isinstance(answer, OSError)}

    def _ask(self, question: Callable[..., Any], timeout: float, **values: Any) -> Any:
        """Call a method of the scheduler."""
        return self._checked(functools.partial(self._client.sync, question, **values), timeout)

    def _checked(self, call: Callable[..., Any], timeout: float) -> Any:
        """Call a function; InputError if the scheduler does not answer or is lost."""
        from distributed.client import ClosedClientError

        try:
            return call(callback_timeout=timeout)
        except (OSError, ClosedClientError) as error:
            raise self._lost("does not answer" if isinstance(error, TimeoutError) else "was lost") from None

    def _lost(self, problem: str) -> InputError:
        remedy = "check that it runs and start the batch again, which continues where it stopped"
        return InputError(f"{self._name} {problem}: {remedy}")


@contextmanager
def _connect(address: str | None, workers: int | None) -> Iterator[Any]:
    """Connect to a scheduler; without an address, start a local cluster for the batch."""
    try:
        import distributed
    except ImportError:
        install = "pip install 'mirrorskin[cluster]'"
        raise InputError(f"a cluster needs Dask, which is not installed: {install}") from None
    with ExitStack() as stack:
        stack.enter_context(_quiet())
        if address is None:
            address = stack.enter_context(_local_cluster(workers or 1)).scheduler_address
        yield stack.enter_context(_reach(distributed, address))


@contextmanager
def _local_cluster(workers: int) -> Iterator[Any]:
    """Start a scheduler, and worker processes that are restarted when they are lost."""
    import dask
    from distributed import LocalCluster

    start: Any = LocalCluster  # not typed
    # Dask's default timeout of a restart is too short for a busy machine.
    patient = dask.config.set({"distributed.deploy.lost-worker-timeout": "1 hour"})
    with (
        patient,
        _without_current_folder(),
        start(
            n_workers=workers,
            threads_per_worker=1,
            memory_limit=0,  # the plan has its own limit
            preload=["mirrorskin.engine.batch.worker"],
            dashboard_address=None,
            scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},  # avoids a warning if the port is in use
            silence_logs=logging.CRITICAL,
        ) as cluster,
    ):
        yield cluster


@contextmanager
def _without_current_folder() -> Iterator[None]:
    """Let new processes of Python, which start as "python -c", import nothing from the current folder."""
    before = os.environ.get("PYTHONSAFEPATH")
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ["PYTHONSAFEPATH"]
        else:
            os.environ["PYTHONSAFEPATH"] = before


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress Dask's messages: outcomes and errors describe all faults."""
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
        with ThreadPoolExecutor(1) as thread:  # the caller's thread may have an event loop
            thread.submit(asyncio.run, _greet(distributed, address)).result()
        return distributed.Client(address, timeout=_REACH, set_as_default=False)
    except (OSError, ValueError, OverflowError) as error:
        problem = " ".join(str(error).split()) or f"no answer within {_REACH:g} s"
        remedy = "start one with 'dask scheduler', and give the address that it prints"
        raise InputError(f"no Dask scheduler can be reached at {address} ({problem}): {remedy}") from error


async def _greet(distributed: ModuleType, address: str) -> None:
    """Connect once with a timeout: a client waits forever for a port that accepts but does not answer."""
    security = distributed.Security().get_connection_args("client")
    comm = await asyncio.wait_for(distributed.comm.connect(address, timeout=0.9 * _REACH, **security), _REACH)
    await comm.close()


@contextmanager
def _trace(folder: Path) -> Iterator[Path]:
    """Create a temporary empty file in a folder: a worker that sees it sees the folder itself."""
    with ExitStack() as stack:
        with translate_os_errors(f"{folder} cannot be written to", "choose another folder with -o"):
            file = stack.enter_context(
                tempfile.NamedTemporaryFile(prefix=".mirrorskin-", suffix=".part", dir=folder)
            )
        with suppress(OSError):  # the file system may not support locks
            lock(file)  # so that it is not removed as a leftover
        yield Path(file.name)


def _one_of_each_folder(files: Iterable[Path]) -> dict[Path, int]:
    """Return the size of one existing file of each folder."""
    first: dict[Path, Path] = {}
    for file in files:
        if file.parent not in first and file.is_file():
            first[file.parent] = file
    return {file: file.stat().st_size for file in first.values()}


def _nearest_existing(folder: Path) -> Path:
    """Return a folder, or its nearest existing parent."""
    return next(parent for parent in [folder, *folder.parents] if parent.is_dir())
