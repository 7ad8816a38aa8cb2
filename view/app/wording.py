"""A result as a command and as a Python script that compute the same numbers again."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from typing import Any

from mirrorskin import io
from mirrorskin.engine.base.options import Option, plain
from mirrorskin.view.app.session import Session

_WITH_UNIT = ("mm", "rad", "MPa", "N", "s")


def as_command(session: Session) -> str:
    """Return the command that computes the current result."""
    assert session.whole is not None
    words = ["mirrorskin", "reconstruct"] if session.is_method else ["mirrorskin", "run", session.kind_name]
    words += [str(session.path or session.name), *session.opening.words]
    if session.region is not None:
        words += ["--region", session.region.text]
    if session.frames is not None:
        words += ["--frames", f"{session.frames[0]}:{'' if session.frames[1] is None else session.frames[1]}"]
    if session.opening.calibration is not None:
        words += ["--calibration", str(session.opening.calibration)]
    if session.opening.device is not None:
        words += ["--device", session.opening.device]
    for name, value in session.changed.items():
        words += _flag(session.kind.options[name], value)
    return shlex.join([*words, "-o", "result.h5"])


def _flag(option: Option, value: Any) -> list[str]:
    """Return an option with its value; numbers have all their digits, and a unit where one is needed."""
    name = option.name.replace("_", "-")
    if option.kind == "flag":
        return [f"--{name}" if value else f"--no-{name}"]
    values = [*value] if isinstance(value, list | tuple) else [value]
    return [f"--{name}={','.join(_number(option.unit, item) for item in values)}"]


def _number(unit: str, value: Any) -> str:
    if isinstance(value := plain(value), str):
        return value
    if unit == "counts/rad":
        return f"{value!r}/rad"
    return f"{value!r}{unit}" if unit in _WITH_UNIT or unit == "mm/N" else repr(value)


def as_python(session: Session) -> str:
    """Return the Python script that computes the current result."""
    opening = session.opening
    options = dict(session.changed)
    if opening.device is not None:
        options["device"] = opening.device
    words = [f"{name}={plain(value)!r}" for name, value in options.items()]
    calibration = [] if opening.calibration is None else [repr(str(opening.calibration))]
    lines = ["from mirrorskin import engine, io"]
    if session.is_method:
        call = f"engine.reconstruct({', '.join(['recording', *calibration, *words])})"
    elif session.kind_name.startswith("mirrorskin.engine:") and not calibration:
        call = f"engine.run(recording, engine.{session.kind.__name__}({', '.join(words)}))"
    else:
        lines = [
            "from mirrorskin import io",
            "from mirrorskin.engine.base.reconstruction import load_operation, run_class",
        ]
        where = f"load_operation({session.kind_name!r})"
        places = ["None", *calibration] if calibration else []
        call = f"run_class({', '.join([where, 'recording', *places, *words])})"
    lines += [
        "",
        f"with io.open_recording({', '.join(_opening(session))}) as recording:",
        f"    result = {call}",
    ]
    return "\n".join([*lines, 'io.save_result(result, "result.h5")', ""])


def _opening(session: Session) -> Iterator[str]:
    """Yield the arguments of `io.open_recording`."""
    assert session.whole is not None
    yield repr(str(session.path or session.name))
    for name, value in session.opening.keywords.items():
        if hasattr(value, "positions") and not isinstance(value, io.Steps):  # listed in a file
            yield f"{name}={list(map(float, value.positions(session.whole.shape[0])))}"
        else:
            yield f"{name}={'io.' if isinstance(value, io.Steps) else ''}{value!r}"
    if session.region is not None:
        yield f"region=io.{session.region!r}"
    if session.frames is not None:
        yield f"frames={session.frames!r}"
