"""One recording of a batch, from file to file: what every scheduler calls."""

from __future__ import annotations

import ctypes
import math
import os
import time
from dataclasses import dataclass, replace
from typing import Literal

from mirrorskin import io
from mirrorskin.engine.batch.jobs import Job, Plan
from mirrorskin.engine.errors import NotConverged
from mirrorskin.engine.provenance import missing_levels, naming
from mirrorskin.engine.running import run_class
from mirrorskin.engine.streaming import Progress
from mirrorskin.engine.summary import summarise
from mirrorskin.io import InputError, Recording
from mirrorskin.io.os_errors import as_input_error
from mirrorskin.io.result_file import open_process
from mirrorskin.io.types import ProcessValue
from mirrorskin.io.url import Url
from mirrorskin.kernels.device import Device, open_device
from mirrorskin.kernels.errors import DeviceError

State = Literal["done", "kept", "failed"]

_KEPT = "there already"


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a job. It can be pickled.

    It is kept if the result was there already, made of the same recording with the same parameters.
    """

    job: Job
    state: State
    message: str  # one line: what the result holds, or what is wrong and the remedy
    seconds: float
    bytes: int = 0  # of frames, unpacked, that were reconstructed
    device: str = ""  # its title
    motion: str = ""  # of the recording, if it could be opened


def find_settled(job: Job, plan: Plan) -> Outcome | None:
    """Return what became of a job with which there is nothing to do, for which no device is needed.

    Its result is there already, or its recording is not.
    """
    there = isinstance(job.source, Url) or os.path.exists(job.source)  # noqa: PTH110  # which never raises
    if there and not os.path.exists(job.target):  # noqa: PTH110
        return None
    start = time.perf_counter()
    try:
        with io.open_recording(job.source, memory_limit=plan.memory_limit, **plan.opening) as source:
            made, motion = _is_made(job, source, plan.digest(source.motion)), source.motion
    except InputError as error:
        return Outcome(job, "failed", str(error), time.perf_counter() - start)
    except Exception:
        return None  # who does the job says what is wrong
    return Outcome(job, "kept", _KEPT, time.perf_counter() - start, motion=motion) if made else None


def run_job(
    job: Job, plan: Plan, device: str | Device | None = None, progress: Progress | None = None
) -> Outcome:
    """Make a job's result, unless it is there already.

    Whatever goes wrong with one recording is in the outcome, not raised, so that the others go on.
    """
    start = time.perf_counter()
    outcome = Outcome(job, "failed", "", 0.0)
    try:
        with io.open_recording(job.source, memory_limit=plan.memory_limit, **plan.opening) as source:
            outcome = replace(outcome, motion=source.motion)
            outcome = _done(outcome, source, plan, device, progress)
    except (InputError, NotConverged, DeviceError) as error:
        outcome = replace(outcome, message=str(error))
    except MemoryError as error:
        outcome = replace(
            outcome, message=f"not enough memory ({error}): take a smaller region or fewer frames"
        )
    except Exception as error:
        outcome = replace(outcome, message=f"unexpected {type(error).__name__}: {error}")
    return replace(outcome, seconds=time.perf_counter() - start)


def _done(
    outcome: Outcome, source: Recording, plan: Plan, device: str | Device | None, progress: Progress | None
) -> Outcome:
    """Make the result of an open recording, or find it made."""
    target, digest = outcome.job.target, plan.digest(source.motion)
    if _is_made(outcome.job, source, digest):
        return replace(outcome, state="kept", message=_KEPT)
    with as_input_error(f"{target.parent} cannot be made", "choose another folder for results"):
        target.parent.mkdir(parents=True, exist_ok=True)
    io.check_output(target, outcome.job.source)
    opened = open_device(device)
    with naming(source):  # raises if the file was written to meanwhile
        result = run_class(
            plan.kind(source.motion), source, progress, device=opened, **plan.options(source.motion)
        )
    signed: dict[str, ProcessValue] = {**result.process, "batch_parameters": digest}
    io.save_result(result.assign(process=signed), target)
    return replace(
        outcome,
        state="done",
        message="; ".join(filter(None, (str(summarise(result)), missing_levels(result.process)))),
        bytes=math.prod(source.shape) * source.dtype.itemsize,
        device=opened.info.title,
    )


def _is_made(job: Job, source: Recording, digest: str) -> bool:
    """Tell whether a job's result is there, whole, and of this recording and these parameters."""
    if not job.target.exists():
        return False
    wanted = {
        "batch_parameters": digest,
        "source_fingerprint": source.fingerprint(),
        "source_modified": source.modified,
    }
    try:
        return open_process(job.target, *wanted) == wanted
    except InputError:
        return False  # damaged, or something else: it is made anew


# Of malloc.h of the GNU C library.
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
_LARGE = 8 << 20  # room for frames is larger, and often not touched: that costs nothing only if it is new
_SPARE = 256 << 20


def keep_memory() -> None:
    """Let this process keep pieces of memory up to 8 MiB that are freed, 256 MiB in all, for the next file.

    The GNU C library gives a map's memory back to the system when the map is gone, and gets it again, page by
    page and full of zeros, for the next one. That took a third of the time of small recordings: 4100 pages of
    each of 32 x 640 x 480. With another C library nothing is done.
    """
    tune = getattr(ctypes.CDLL(None), "mallopt", None)
    if tune is not None:
        tune(_MMAP_THRESHOLD, _LARGE)
        tune(_TRIM_THRESHOLD, _SPARE)
