"""One job of a batch, from file to file, as run by every scheduler."""

from __future__ import annotations

import ctypes
import math
import os
import time
from dataclasses import dataclass, replace
from typing import Literal

from mirrorskin import io
from mirrorskin.engine.base.errors import NotConverged
from mirrorskin.engine.base.provenance import naming
from mirrorskin.engine.base.reconstruction import run_class
from mirrorskin.engine.base.running import Progress
from mirrorskin.engine.base.summary import summarise
from mirrorskin.engine.batch.jobs import Job, Plan
from mirrorskin.io import InputError, Recording
from mirrorskin.io.base.system import translate_os_errors
from mirrorskin.io.base.types import ProcessValue
from mirrorskin.io.base.url import Url
from mirrorskin.io.files.result_file import open_process
from mirrorskin.kernels.device import Device, open_device
from mirrorskin.kernels.errors import DeviceError

State = Literal["done", "kept", "failed"]

_KEPT = "there already"


@dataclass(frozen=True, slots=True)
class Outcome:
    """The outcome of a job; can be pickled.

    A result is kept if it was computed from the same recording with the same parameters.
    """

    job: Job
    state: State
    message: str  # one line: a summary of the result, or the problem and the remedy
    seconds: float
    bytes: int = 0  # size of the reconstructed frames, uncompressed
    device: str = ""  # title of the device
    motion: str = ""  # motion of the recording, if it could be opened
    warned: bool = False  # whether the result, computed now, has warnings
    brightness_change: float | None = None  # mean of the result's `light_change`, if it was computed now


def find_settled(job: Job, plan: Plan) -> Outcome | None:
    """Return the outcome of a job that needs no device: the result exists, or the recording does not."""
    exists = isinstance(job.source, Url) or os.path.exists(job.source)  # noqa: PTH110  # which never raises
    if exists and not os.path.exists(job.target):  # noqa: PTH110
        return None
    start = time.perf_counter()
    try:
        with io.open_recording(job.source, memory_limit=plan.memory_limit, **plan.opening) as source:
            valid, motion = _has_result(job, source, plan.digest(source.motion)), source.motion
    except InputError as error:
        return Outcome(job, "failed", str(error), time.perf_counter() - start)
    except Exception:
        return None  # `run_job` reports the error
    return Outcome(job, "kept", _KEPT, time.perf_counter() - start, motion=motion) if valid else None


def run_job(
    job: Job, plan: Plan, device: str | Device | None = None, progress: Progress | None = None
) -> Outcome:
    """Compute and save a job's result, unless it exists.

    Errors are returned in the outcome, not raised, so that the batch continues.
    """
    start = time.perf_counter()
    outcome = Outcome(job, "failed", "", 0.0)
    try:
        with io.open_recording(job.source, memory_limit=plan.memory_limit, **plan.opening) as source:
            outcome = replace(outcome, motion=source.motion)
            outcome = _compute(outcome, source, plan, device, progress)
    except (InputError, NotConverged, DeviceError) as error:
        outcome = replace(outcome, message=str(error))
    except MemoryError as error:
        outcome = replace(
            outcome, message=f"not enough memory ({error}): take a smaller region or fewer frames"
        )
    except Exception as error:
        outcome = replace(outcome, message=f"unexpected {type(error).__name__}: {error}")
    return replace(outcome, seconds=time.perf_counter() - start)


def _compute(
    outcome: Outcome, source: Recording, plan: Plan, device: str | Device | None, progress: Progress | None
) -> Outcome:
    """Compute and save the result of an open recording, unless it exists."""
    target, digest = outcome.job.target, plan.digest(source.motion)
    if _has_result(outcome.job, source, digest):
        return replace(outcome, state="kept", message=_KEPT)
    with translate_os_errors(f"{target.parent} cannot be created", "choose another folder for results"):
        target.parent.mkdir(parents=True, exist_ok=True)
    io.check_output(target, outcome.job.source)
    opened = open_device(device)
    with naming(source):  # raises if the file has been modified
        result = run_class(
            plan.kind(source.motion), source, progress, device=opened, **plan.options(source.motion)
        )
    warnings, notes = (str(result.process.get(kind, "")) for kind in ("warnings", "notes"))
    if plan.strict and warnings:
        raise InputError(f"{source.name}: {warnings}")
    process: dict[str, ProcessValue] = {**result.process, "batch_parameters": digest}
    io.save_result(result.assign(process=process), target, overwrite=True)
    return replace(
        outcome,
        state="done",
        message="; ".join(filter(None, (str(summarise(result)), notes, warnings))),
        bytes=math.prod(source.shape) * source.dtype.itemsize,
        device=opened.info.title,
        warned=bool(warnings),
        brightness_change=(result.fitted.light_change or (None,))[0],
    )


def _has_result(job: Job, source: Recording, digest: str) -> bool:
    """Return whether a job has a valid result, of this recording and these parameters."""
    if not job.target.exists():
        return False
    signature = {
        "batch_parameters": digest,
        "source_fingerprint": source.fingerprint(),
        "source_modified": source.modified,
    }
    try:
        return open_process(job.target, *signature) == signature
    except InputError:
        return False  # damaged, or another file: it is replaced


_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # parameters of mallopt, from malloc.h of the GNU C library
_LARGE = 8 << 20  # bytes: larger blocks, such as those of frames, are returned to the system
_CACHE = 256 << 20  # bytes of freed memory that the process keeps


def keep_memory() -> None:
    """Let this process keep freed blocks of up to 8 MiB, 256 MiB in total, for the next file.

    Otherwise the GNU C library returns the memory of each map to the system, and gets it again page by page,
    filled with zeros. That took a third of the time of small recordings (4100 pages for 32 x 640 x 480).
    Other C libraries are not affected.
    """
    tune = getattr(ctypes.CDLL(None), "mallopt", None)
    if tune is not None:
        tune(_MMAP_THRESHOLD, _LARGE)
        tune(_TRIM_THRESHOLD, _CACHE)
