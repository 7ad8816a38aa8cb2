"""A job on a cluster's worker, which has its own device, or its own share of its machine's cores."""

from __future__ import annotations

import asyncio
import functools
import os
import signal
import threading
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mirrorskin.engine.batch.jobs import Job
from mirrorskin.engine.batch.memory import keep_memory
from mirrorskin.engine.batch.plan import Plan
from mirrorskin.engine.batch.work import Outcome, do
from mirrorskin.kernels.device import Device, list_devices, open_device
from mirrorskin.kernels.errors import DeviceError

_one_at_a_time = threading.Lock()


@dataclass(frozen=True, slots=True)
class Place:
    """Where a worker stands among those of its machine.

    Attributes
    ----------
    number : int
        From 0; no other worker of the machine has it.
    workers : int
        How many there are on the machine.
    """

    number: int
    workers: int


def dask_setup(worker: object) -> None:
    """Leave Ctrl-C, which a terminal sends to workers as well, to the batch that they belong to.

    Dask calls it in each worker that is told to load this module at its start.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def do_at(place: Place, job: Job, plan: Plan) -> Outcome:
    """Make a job's result on the device of this worker.

    Parameters
    ----------
    place : Place
    job : Job
        With absolute paths.
    plan : Plan

    Returns
    -------
    Outcome
    """
    opening = {"threads": _cores(place), **plan.opening}
    with _one_at_a_time:
        return do(job, replace(plan, opening=opening), open_own(place))


@functools.cache
def open_own(place: Place) -> Device:
    """Open the device of a worker: one of the machine's GPUs in turn, else a share of its cores.

    PoCL asks once in a process how many threads it may have, so this must be the first to look at OpenCL.

    Parameters
    ----------
    place : Place

    Raises
    ------
    mirrorskin.kernels.errors.DeviceError
        There is no OpenCL device, or it cannot run a kernel.
    """
    keep_memory()
    os.environ.setdefault("POCL_MAX_PTHREAD_COUNT", str(_cores(place)))
    gpus = [str(number) for number, device in enumerate(list_devices()) if device.kind == "gpu"]
    if "PYOPENCL_CTX" in os.environ or not gpus:
        return open_device()
    return open_device(gpus[place.number % len(gpus)])


async def look_around(
    sizes: Mapping[Path, int], trace: Path, places: Mapping[str, Place], dask_worker: Any
) -> str | None:
    """Find out whether this worker can take part.

    Parameters
    ----------
    sizes : mapping of Path to int
        Recordings, and how many bytes they have.
    trace : Path
        A file that lies, for now, where results will be written.
    places : mapping of str to Place
        Where each worker stands, by its address.
    dask_worker : distributed.Worker
        This worker; it is Dask that gives it.

    Returns
    -------
    str or None
        What is wrong and the remedy, as the predicate of a sentence about the worker.
    """
    return await asyncio.to_thread(_problem, sizes, trace, places[dask_worker.address])


def _problem(sizes: Mapping[Path, int], trace: Path, place: Place) -> str | None:
    share = "workers need the same folders under the same names as this machine"
    for recording, size in sizes.items():
        if not recording.is_file() or recording.stat().st_size != size:
            return f"does not see {recording}: {share}"
    if not trace.is_file():
        return f"does not see the folder {trace.parent} as it is here: {share}"
    if not os.access(trace.parent, os.W_OK):
        return f"cannot write to {trace.parent}: let it, or choose another folder with -o"
    try:
        open_own(place)
    except DeviceError as error:
        return f"has no device: {error}"
    return None


def _cores(place: Place) -> int:
    """Return how many of a machine's cores are a worker's own, at least one."""
    cores = len(os.sched_getaffinity(0))
    return max(1, cores // place.workers + (place.number < cores % place.workers))
