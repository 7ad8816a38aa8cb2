"""A worker of a Dask cluster: the check whether it can take part, its share of the machine, and its jobs."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.metadata import version
from itertools import count
from pathlib import Path
from typing import Any

from distributed import WorkerPlugin, get_worker

from mirrorskin.engine.batch.jobs import Job, Plan
from mirrorskin.engine.batch.work import Outcome, keep_memory, run_job
from mirrorskin.kernels.device import Device, list_devices, open_device
from mirrorskin.kernels.errors import DeviceError
from mirrorskin.processors import POCL_THREADS, usable_cores

RESOURCE = "mirrorskin"
"""Dask resource: an enlisted worker has one and each job needs one, so that a worker runs one job at a time.
Also the topic of the events with the reasons why workers are left out."""

# Names of abstract sockets, which are not files (unix(7)).
_NUMBERS = f"\0mirrorskin-{getattr(os, 'getuid', int)()}-worker-"


@dataclass(frozen=True, slots=True)
class Share:
    """A worker's share of its machine."""

    device: Device
    cores: int
    number: int


class Enlist(WorkerPlugin):
    """Checks whether a worker can take part; Dask runs it on current and on later workers."""

    program: str
    sizes: Mapping[Path, int]
    trace: Path

    def __init__(self, program: str, sizes: Mapping[Path, int], trace: Path) -> None:
        self.program, self.sizes, self.trace = program, sizes, trace

    async def setup(self, worker: Any) -> None:
        """Create the resource that jobs need on a worker that can take part; called by Dask."""
        installed = version("mirrorskin")
        problem = None
        if installed != self.program:
            problem = f"has mirrorskin {installed}, and the batch {self.program}"
        problem = problem or await check_worker(self.sizes, self.trace, worker)
        if problem is not None:
            worker.log_event(RESOURCE, f"worker {worker.address} is left out: it {problem}")
        await worker.set_resources(**{RESOURCE: int(problem is None)})


async def check_worker(sizes: Mapping[Path, int], trace: Path, dask_worker: Any) -> str | None:
    """Return the reason why a worker cannot take part, and the remedy: the predicate of a sentence."""
    host = dask_worker.address.rpartition(":")[0]
    workers = [other for other in await dask_worker.scheduler.ncores() if other.rpartition(":")[0] == host]
    return await asyncio.to_thread(_problem, sizes, trace, dask_worker, max(1, len(workers)))


def run_on_worker(job: Job, plan: Plan) -> Outcome:
    """Run a job, whose paths are absolute, on the device of this worker."""
    worker: Any = get_worker()
    own_share: Share = worker.mirrorskin_share
    opening = {"threads": own_share.cores, **plan.opening}
    return run_job(job, replace(plan, opening=opening), own_share.device)


def dask_setup(worker: object) -> None:
    """Ignore Ctrl-C, which a terminal also sends to workers: the batch handles it.

    Dask calls this in each worker that preloads the module.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def take_share(workers: int) -> Share:
    """Return the next share of a machine with a number of workers.

    PoCL reads its number of threads once per process, so this must precede any other use of OpenCL.
    """
    keep_memory()
    number, held = _take_number()
    cores = usable_cores()
    threads = max(1, cores // workers + (number < cores % workers))
    if os.environ.get(POCL_THREADS, str(cores)) == str(cores):  # the command line states those of all workers
        os.environ[POCL_THREADS] = str(threads)
    gpus = [str(index) for index, device in enumerate(list_devices()) if device.kind == "gpu"]
    choice = None if "PYOPENCL_CTX" in os.environ or not gpus else gpus[number % len(gpus)]
    return Share(open_device(choice), threads, held)


def _take_number() -> tuple[int, int]:
    """Return the first number that no other worker of this machine has, and the socket that reserves it."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as held:
        for number in count():
            with suppress(OSError):  # the number is in use
                held.bind(f"{_NUMBERS}{number}")
                return number, held.detach()
    raise AssertionError


def _problem(sizes: Mapping[Path, int], trace: Path, worker: Any, workers: int) -> str | None:
    remedy = "workers need the same folders under the same names as this machine"
    for recording, size in sizes.items():
        if not recording.is_file() or recording.stat().st_size != size:
            return f"does not see {recording}: {remedy}"
    if not trace.is_file():
        return f"does not see the folder {trace.parent} as it is here: {remedy}"
    if not os.access(trace.parent, os.W_OK):
        return f"cannot write to {trace.parent}: let it, or choose another folder with -o"
    try:
        if not hasattr(worker, "mirrorskin_share"):
            worker.mirrorskin_share = take_share(workers)
    except DeviceError as error:
        return f"has no device: {error}"
    return None
