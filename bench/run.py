"""A run as plain data: the machine it was made on, and its cases; as JSON, checked when it is read again."""

from __future__ import annotations

import json
import math
import os
import platform
import re
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any, Never

from mirrorskin.bench.harness import THREADS, Case, Row
from mirrorskin.io import InputError
from mirrorskin.io.os_errors import MAX_TEXT_BYTES, read_regular
from mirrorskin.kernels.device import Device

Run = dict[str, Any]
Data = Mapping[str, Any]

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
_HUGE = 1e300

# What a run is made of: a type, a list of one kind, an object of named kinds, or of any names ("*").
_TIMING = {"median": float, "lower": float, "upper": float, "rounds": float}
_ROW = {
    "name": str,
    "bytes": float,
    "frames": float,
    "operations": float,
    "wall": _TIMING,
    "device": {"*": _TIMING},
    "kernels": {"*": float},
    "moved": {"*": float},
    "first": float,
    "compile": float,
    "bandwidth": float,
    "share": float | None,
    "kernel_share": float | None,
}
_TARGET = {"what": str, "bound": str, "measured": str, "met": bool}
_CASE = {
    "name": str,
    "title": str,
    "rows": [_ROW],
    "absent": {"*": str},
    "notes": [str],
    "targets": [_TARGET],
}
_RUN = {
    "date": str,
    "commit": str | None,
    "device": {"name": str, "platform": str, "driver": str, "kind": str},
    "processor": str,
    "threads": float,
    "system": str,
    "versions": {"*": str | None},
    "quick": bool,
    "cases": [_CASE],
}
_LATER: Mapping[str, Any] = {
    "operations": 0,
    "moved": {},
    "notes": [],
    "targets": [],
}  # the first runs had none
_CALLED = {str: "a text", float: "a number", bool: "true or false"}


def as_data(device: Device, cases: Sequence[Case], quick: bool) -> Run:
    """Return everything about a run as what JSON knows; a number that there is not is None."""
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": _commit(),
        "device": asdict(device.info),
        "processor": _processor(),
        "threads": THREADS,
        "system": f"{platform.system()} {platform.machine()}",
        "versions": {"Python": platform.python_version(), **{name: _version(name) for name in _PACKAGES}},
        "quick": quick,
        "cases": [_case(case) for case in cases],
    }


def open_run(path: Path) -> Run:
    """Return a run that ``mirrorskin bench -o`` wrote, also an earlier version of it.

    Raises
    ------
    InputError
        The file cannot be read, is no JSON, or is not a run of the benchmark.
    """
    data = read_regular(path, limit=MAX_TEXT_BYTES)
    try:
        run = json.loads(data.decode(), parse_constant=_refuse)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is no JSON: name a file that 'mirrorskin bench -o' wrote") from error
    try:
        _check(run, _RUN, "it")
    except _WrongError as error:
        raise InputError(f"{path}: {error}: name a file that 'mirrorskin bench -o' wrote") from error
    return dict(run)


class _WrongError(Exception):
    """Data is not of the kind it should be; the message says where."""


def _refuse(word: str) -> Never:
    raise ValueError(f"JSON knows no {word}")


def _check(value: Any, kind: Any, where: str) -> None:
    """Raise unless a value is of a kind; what later versions added is filled in."""
    if isinstance(kind, list):
        _require(isinstance(value, list), f"{where} is not a list")
        for number, one in enumerate(value):
            _check(one, kind[0], f"{where}[{number}]")
    elif isinstance(kind, dict):
        _require(isinstance(value, dict), f"{where} is not an object")
        if "*" in kind:
            kind = dict.fromkeys(value, kind["*"])
        for name, inner in kind.items():
            inside = name if where == "it" else f"{where}.{name}"
            if name in _LATER:
                value.setdefault(name, type(_LATER[name])())
            _require(name in value, f"{inside} is missing")
            _check(value[name], inner, inside)
            if where.endswith("wall"):
                _require(value[name] > 0, f"{inside} is not a positive number")
    elif kind in (str, float, bool):
        _require(_fits(value, kind), f"{where} is not {_CALLED[kind]}")
    else:  # a type, or null
        inner = kind.__args__[0]
        _require(value is None or _fits(value, inner), f"{where} is not {_CALLED[inner]} or null")


def _fits(value: Any, kind: type) -> bool:
    if kind is float:
        return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < _HUGE
    return isinstance(value, kind)


def _require(fits: bool, said: str) -> None:
    if not fits:
        raise _WrongError(said)


def _case(case: Case) -> dict[str, Any]:
    return {
        "name": case.name,
        "title": case.title,
        "rows": [_row(case, row) for row in case.rows],
        "absent": case.absent,
        "notes": list(case.notes),
        # Numbers of NumPy were compared, and JSON does not know its bool.
        "targets": [{**asdict(target), "met": bool(target.met)} for target in case.targets],
    }


def _row(case: Case, row: Row) -> dict[str, Any]:
    shares = {"share": case.share(row), "kernel_share": case.kernel_share(row)}
    return {
        "name": row.name,
        "bytes": row.bytes,
        "frames": row.frames,
        "operations": row.operations,
        **asdict(row.measured),
        "bandwidth": row.bandwidth,
        **{name: share if math.isfinite(share) else None for name, share in shares.items()},
    }


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _commit() -> str | None:
    """Return the commit of our checkout, with ``-dirty`` after changes; None where this is not one."""
    here = Path(__file__).resolve().parent
    try:
        _git(here, "ls-files", "--error-unmatch", "__init__.py")
        return _git(here, "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*")
    except (OSError, subprocess.CalledProcessError):
        return None


def _git(folder: Path, *words: str) -> str:
    # Told to leave the index alone: a benchmark writes nothing into a checkout.
    environment = {**os.environ, "GIT_OPTIONAL_LOCKS": "0"}
    command = ["git", "-C", str(folder), *words]
    run = subprocess.run(command, check=True, capture_output=True, text=True, env=environment)
    return run.stdout.strip()


def _processor() -> str:
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return platform.processor()
    found = re.search(r"^model name\s*:\s*(.+)$", text, re.MULTILINE)
    return found[1] if found else platform.processor()
