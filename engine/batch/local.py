"""A batch on this machine, with one thread per device."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from queue import Empty, SimpleQueue
from threading import Event, Semaphore, Thread

from mirrorskin.engine.batch.jobs import Job, Plan
from mirrorskin.engine.batch.work import Outcome, keep_memory, run_job
from mirrorskin.kernels.device import ALL, Device, open_device, open_devices

Watch = Callable[[Job, int], None]

_INTERRUPTS = 3  # number of Ctrl-C that end the process immediately, if a thread waits for a network disk
_INTERRUPTED = 130  # exit status of programs ended by Ctrl-C


class _Stopped(BaseException):  # not an Exception, which would be reported as a failure of the recording
    """The batch was ended; the running job is abandoned."""


def default_devices() -> list[Device]:
    """Open the devices that a batch uses by default: the default device, or all GPUs if it is a GPU."""
    first = open_device()
    if first.info.kind != "gpu" or "PYOPENCL_CTX" in os.environ:
        return [first]
    return open_devices(ALL)


def run_local(
    jobs: Sequence[Job], plan: Plan, devices: Sequence[Device], watch: Watch | None = None
) -> Iterator[Outcome]:
    """Run jobs on devices of this machine, one at a time on each, and yield the outcomes as they are ready.

    ``watch`` is called in the devices' threads with the running job and the number of its frames read so far.

    Closing the iterator, or an exception, ends the batch: each device abandons its job at the next block of
    frames, or finishes it if all frames have been read. No incomplete files are left.

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
        for device in devices:
            thread = Thread(target=work, args=(device,))
            thread.start()
            threads.append(thread)
        for _ in jobs:
            outcome = outcomes.get()
            if isinstance(outcome, BaseException):
                raise outcome
            yield outcome
    finally:
        stop.set()
        _finish(threads, ended)


def _finish(threads: Sequence[Thread], ended: Semaphore) -> None:
    """Wait for all threads; each releases the semaphore once at its end."""
    for _ in threads:
        _wait(ended)
    for thread in threads:
        thread.join()


def _wait(ended: Semaphore) -> None:
    """Wait for the end of a thread, since OpenCL aborts a program that exits earlier.

    Repeated interrupts end the program at once. `Thread.join` must not be interrupted: some versions of
    Python then consider the thread as ended.
    """
    for _ in range(_INTERRUPTS):
        with suppress(KeyboardInterrupt, SystemExit):
            ended.acquire()
            return
    os._exit(_INTERRUPTED)


def _reporter(job: Job, watch: Watch | None, stop: Event) -> Callable[[int], None]:
    """Report the start of a job; return a function that reports its frames and stops it with the batch."""

    def report(frames: int) -> None:
        if stop.is_set():
            raise _Stopped
        if watch is not None:
            watch(job, frames)

    report(0)
    return report
