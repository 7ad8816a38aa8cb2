"""A batch on this machine: a thread a device, and each takes the next job."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from queue import Empty, SimpleQueue
from threading import Event, Semaphore, Thread

from mirrorskin.engine.batch.jobs import Job, Plan
from mirrorskin.engine.batch.work import Outcome, keep_memory, run_job
from mirrorskin.kernels.device import Device, list_devices, open_device

Watch = Callable[[Job, int], None]

_INSISTS = 3  # times that Ctrl-C is pressed while a thread hangs, in a network disk perhaps
_INTERRUPTED = 130  # what shells say of a program that Ctrl-C ended


class _Stopped(BaseException):  # no Exception: nobody may take it for a recording's failure
    """The batch was ended; a job under way is given up."""


def default_devices() -> list[Device]:
    """Open the devices that a batch uses unasked: the default one, or all GPUs if that is one."""
    first = open_device()
    if first.info.kind != "gpu" or "PYOPENCL_CTX" in os.environ:
        return [first]
    kinds = [info.kind for info in list_devices()]
    return [open_device(str(number)) for number, kind in enumerate(kinds) if kind == "gpu"]


def run_local(
    jobs: Sequence[Job], plan: Plan, devices: Sequence[Device], watch: Watch | None = None
) -> Iterator[Outcome]:
    """Do jobs on devices of this machine, one at a time on each; yield what became of each, as it is done.

    ``watch`` is called by the devices' threads with the job under way and how many frames of it were read.

    Leaving the iterator early, by an exception as well, ends the batch: each device gives up its job at the
    next block of frames, or finishes it where all frames are read. Nothing half-written stays behind.

    Examples
    --------
    >>> from pathlib import Path
    >>> from mirrorskin.engine.batch.jobs import make_jobs
    >>> jobs = make_jobs(Path("data").glob("*.h5"), Path("results"))
    >>> [outcome.state for outcome in run_local(jobs, Plan(), default_devices())]  # doctest: +SKIP
    ['done', 'kept']
    """
    keep_memory()
    todo: SimpleQueue[Job] = SimpleQueue()
    for job in jobs:
        todo.put(job)
    outcomes: SimpleQueue[Outcome | BaseException] = SimpleQueue()
    stop, ended = Event(), Semaphore(0)

    def work(device: Device) -> None:
        try:
            while not stop.is_set():
                outcomes.put(run_job(job := todo.get_nowait(), plan, device, _reporter(job, watch, stop)))
        except (Empty, _Stopped):
            pass
        except BaseException as error:
            outcomes.put(error)
        finally:
            ended.release()

    threads: list[Thread] = []
    try:
        threads.extend(_started(work, device) for device in devices)
        for _ in jobs:
            outcome = outcomes.get()
            if isinstance(outcome, BaseException):
                raise outcome
            yield outcome
    finally:
        stop.set()
        _finish(threads, ended)


def _started(work: Callable[[Device], None], device: Device) -> Thread:
    thread = Thread(target=work, args=(device,))
    thread.start()
    return thread


def _finish(threads: Sequence[Thread], ended: Semaphore) -> None:
    """Wait for all threads; each releases once at its end."""
    for _ in threads:
        _wait(ended)
    for thread in threads:
        thread.join()


def _wait(ended: Semaphore) -> None:
    """Wait for a thread, as OpenCL aborts a program that leaves it at work; who insists ends it at once.

    A thread's own join must not be interrupted: some Pythons then take the thread for ended.
    """
    for _ in range(_INSISTS):
        with suppress(KeyboardInterrupt, SystemExit):
            ended.acquire()
            return
    os._exit(_INTERRUPTED)


def _reporter(job: Job, watch: Watch | None, stop: Event) -> Callable[[int], None]:
    """Report that a job begins; return what reports its frames, and gives the job up when the batch ends."""

    def report(frames: int) -> None:
        if stop.is_set():
            raise _Stopped
        if watch is not None:
            watch(job, frames)

    report(0)
    return report
