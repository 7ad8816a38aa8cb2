"""Runs of a benchmark, with the machine, as objects and as JSON files."""

from __future__ import annotations

import os
import platform
import re
import subprocess
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Annotated

import click
import msgspec
import numpy as np

from mirrorskin.io import InputError, check_output
from mirrorskin.io.base.system import read_text
from mirrorskin.io.storage.atomic import write_new
from mirrorskin.kernels.device import Device
from mirrorskin.processors import usable_cores

THREADS = usable_cores()

_PACKAGES = (
    "mirrorskin",
    "numpy",
    "pyopencl",
    "pocl-binary-distribution",
    "opencv-contrib-python-headless",
    "torch",
    "numba",
    "scipy",
    "pyamg",
)
PERCENTILES = "50", "95", "99"
LIVE_HEAD = (
    *("of", "size", "due a second", "used", "updates", "lost"),
    *(f"{percent} %, ms" for percent in PERCENTILES),
    *("processor", "as offline"),
)
"""Head of a table of `LiveRow`: rates of frames and updates, frames lost, latency, and processor time, ms."""

_Seconds = Annotated[float, msgspec.Meta(ge=0)]


class Timing(msgspec.Struct, frozen=True):
    """Seconds of one work over its rounds: median and quartiles."""

    median: _Seconds
    lower: _Seconds
    upper: _Seconds
    rounds: int

    @classmethod
    def of(cls, seconds: Sequence[float]) -> Timing:
        """Return median and quartiles of some seconds."""
        lower, median, upper = np.percentile(seconds, [25, 50, 75])
        return cls(float(median), float(lower), float(upper), len(seconds))


class Row(msgspec.Struct, frozen=True, kw_only=True):
    """One work of a case.

    Attributes
    ----------
    name : str
    wall : Timing
        By the host's clock, from the call to its return.
    processor : float
        Median seconds of processor time of all threads in a call; 0 if not measured.
    bytes, frames, operations : int
        What one call moves (input and output, each once), its frames and its multiply-adds; 0 if not counted.
    device : dict of Timing
        Time by kind (upload, kernel, download), as reported by the device.
    kernels, moved : dict of float
        Median seconds of each kernel in a call, and the bytes that it moves.
    first, compile : float
        Seconds of the first call, which warms up, and of building kernels in it.
    """

    name: str
    wall: Timing
    processor: float = 0.0
    bytes: int = 0
    frames: int = 0
    operations: int = 0
    device: dict[str, Timing] = {}
    kernels: dict[str, float] = {}
    moved: dict[str, float] = {}
    first: float = 0.0
    compile: float = 0.0

    def __post_init__(self) -> None:
        if not self.wall.median > 0:
            raise ValueError(f"wall.median of {self.name!r} is not positive")

    @property
    def is_limit(self) -> bool:
        """Whether the row measures a limit of the machine."""
        return "limit" in self.name

    @property
    def kernel(self) -> float:
        """Median seconds in kernels, as reported by the device; NaN if it reports none."""
        return self.device["kernel"].median if "kernel" in self.device else float("nan")

    @property
    def bandwidth(self) -> float:
        """Bytes per second by the host's clock."""
        return self.bytes / self.wall.median

    @property
    def kernel_bandwidth(self) -> float:
        """Bytes per second of kernel time; NaN if the device reports none."""
        return self.bytes / (self.kernel or float("nan"))


class Target(msgspec.Struct, frozen=True):
    """A target of a case: its bound and the measured value with units, and whether it was met."""

    what: str
    bound: str
    measured: str
    met: bool


class LiveRow(msgspec.Struct, frozen=True, kw_only=True):
    """One run with frames from memory at their times.

    Attributes
    ----------
    name, size : str
        What was computed, and columns x rows of a frame.
    rate : float
        Frames a second that were due.
    seconds : float
        From the first frame to the last result.
    frames, lost, updates : int
        Frames due; those among them that were not used; updates of the maps, or results of a tracker.
    latency : dict of float
        Percentiles, by their number, of the seconds from when a frame was due to the maps that include it.
    processor : float
        Seconds of processor time of all threads per frame, of a run on simulated time.
    as_offline : bool
        Whether the run on simulated time lost nothing, and its result is that without a pace.
    """

    name: str
    size: str
    rate: float
    seconds: _Seconds
    frames: int
    lost: int
    updates: int
    latency: dict[str, float]
    processor: _Seconds
    as_offline: bool

    @property
    def cells(self) -> list[str]:
        """The run as cells of a table under `LIVE_HEAD`."""
        return [
            self.name,
            self.size,
            f"{self.rate:g}",
            f"{(self.frames - self.lost) / self.seconds:.0f}",
            f"{self.updates / self.seconds:.0f}",
            str(self.lost),
            *(as_ms(self.latency[percent]) if self.latency else "" for percent in PERCENTILES),
            as_ms(self.processor),
            "yes" if self.as_offline else "no",
        ]


class Case(msgspec.Struct, frozen=True):
    """All works on one input.

    Attributes
    ----------
    name, title : str
    rows : list of Row
        First the limit with which the bandwidth of the others is compared, if any.
    absent : dict of str
        Peers that were not run, and why.
    notes : tuple of str
    targets : tuple of Target
    live : tuple of LiveRow
    """

    name: str
    title: str
    rows: list[Row] = []
    absent: dict[str, str] = {}
    notes: tuple[str, ...] = ()
    targets: tuple[Target, ...] = ()
    live: tuple[LiveRow, ...] = ()

    def share(self, row: Row) -> float:
        """Return the bandwidth of a row divided by the limit, by the clock; NaN without a limit."""
        limit = self._limit()
        return row.bandwidth / limit.bandwidth if limit else float("nan")

    def kernel_share(self, row: Row) -> float:
        """Return the same ratio for the time in kernels."""
        limit = self._limit()
        return row.kernel_bandwidth / limit.kernel_bandwidth if limit else float("nan")

    def _limit(self) -> Row | None:
        first = self.rows[0]
        return first if first.is_limit and first.bytes else None


class Machine(msgspec.Struct, frozen=True):
    """An OpenCL device."""

    name: str
    platform: str
    driver: str
    kind: str


class Run(msgspec.Struct, frozen=True, kw_only=True):
    """Cases, and the machine and versions they ran with."""

    date: str
    commit: str | None
    device: Machine
    processor: str
    threads: int
    system: str
    versions: dict[str, str | None]
    quick: bool
    cases: list[Case]

    @property
    def machine(self) -> str:
        """Device and processor in one line."""
        device = self.device
        where = f"{device.platform}: {device.name} (driver {device.driver}), {self.threads} threads"
        return f"{where}; {self.processor}"

    @property
    def title(self) -> str:
        """Device, processor, commit and date in one line."""
        code = self.commit or self.versions.get("mirrorskin")
        return f"{self.machine}; mirrorskin {code}; {self.date}"

    def as_json(self) -> bytes:
        """Return the run as JSON; a number that is not finite becomes null."""
        return msgspec.json.format(msgspec.json.encode(self)) + b"\n"


def describe_run(device: Device, cases: Sequence[Case], quick: bool) -> Run:
    """Return cases with a description of the machine, the code and the libraries."""
    info = device.info
    return Run(
        date=datetime.now(UTC).isoformat(timespec="seconds"),
        commit=_commit(),
        device=Machine(info.name, info.platform, info.driver, info.kind),
        processor=_processor(),
        threads=THREADS,
        system=f"{platform.system()} {platform.machine()}",
        versions={"Python": platform.python_version(), **{name: _version(name) for name in _PACKAGES}},
        quick=quick,
        cases=list(cases),
    )


def open_run(path: Path) -> Run:
    """Return a run from a file that `mirrorskin bench -o` or the benchmark suite wrote.

    Raises
    ------
    InputError
        The file cannot be read, or is not a run.
    """
    text = read_text(path)
    try:
        return msgspec.json.decode(text, type=Run)
    except (msgspec.DecodeError, RecursionError) as error:
        reason = str(error).replace("JSON is", "the JSON is")
        reason = reason[:1].lower() + reason[1:]
        raise InputError(f"{path}: {reason}. Specify a file that 'mirrorskin bench -o' wrote") from error


def check_run_output(path: Path | None, *inputs: Path | None) -> None:
    """Raise InputError if a run cannot be written to a path, before anything is measured."""
    if path is not None:
        if path.suffix != ".json":
            raise InputError(f"{path}: the name must end in .json")
        check_output(path, *filter(None, inputs))


def write_run(run: Run, path: Path | None) -> None:
    """Write a run, if there is a path, and report it."""
    if path is not None:
        write_new(path, [run.as_json()])
        click.echo(f"written to {path}", err=True)


def as_ms(seconds: float) -> str:
    """Return a time in milliseconds with about three digits."""
    milliseconds = 1e3 * seconds
    return f"{milliseconds:.{2 if milliseconds < 10 else 1 if milliseconds < 1000 else 0}f}"


def as_percent(ratio: float) -> str:
    """Return a ratio in percent; empty if it is not finite."""
    return f"{100 * ratio:.0f} %" if np.isfinite(ratio) else ""


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _commit() -> str | None:
    """Return the commit of the checkout, with ``-dirty`` after changes; None outside a checkout."""
    folder = Path(__file__).resolve().parent
    try:
        _git(folder, "ls-files", "--error-unmatch", Path(__file__).name)
        return _git(folder, "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*")
    except (OSError, subprocess.CalledProcessError):
        return None


def _git(folder: Path, *words: str) -> str:
    environment = {**os.environ, "GIT_OPTIONAL_LOCKS": "0"}  # 'describe' would write the index
    command = ["git", "-C", str(folder), *words]
    run = subprocess.run(command, check=True, capture_output=True, text=True, env=environment)
    return run.stdout.strip()


def _processor() -> str:
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return platform.processor()
    model = re.search(r"^model name\s*:\s*(.+)$", text, re.MULTILINE)
    return model[1] if model else platform.processor()
