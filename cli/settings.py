"""The settings of a batch, a file of TOML: what is said of stacks, and how they are reconstructed."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from mirrorskin.cli.options import MotionName
from mirrorskin.cli.quantity import angle, per_angle
from mirrorskin.cli.stack import StackOptions, stack_options
from mirrorskin.engine.batch.jobs import Plan
from mirrorskin.engine.press.onset import EVENTS
from mirrorskin.engine.press.press import METHODS
from mirrorskin.engine.rotation.normals_kernel import NORMAL_METHODS
from mirrorskin.engine.rotation.tilt import check_tilt
from mirrorskin.io import InputError

# Reads a value; the text is what to call it in messages.
_Reader = Callable[[Any, str], Any]

_ESTIMATE = "estimate"
_LONGEST = 40  # letters of a value that a message quotes


def read_settings(path: Path | None, memory_limit: int) -> Plan:
    """Read what a batch does with every recording."""
    said = {} if path is None else _read(path)
    _refuse_unknown(said, _TABLES, str(path), "table")
    stack, press, rotation = (
        _table(said.get(name, {}), f"{path}: [{name}]", readers) for name, readers in _TABLES.items()
    )
    opening: dict[str, Any] = {"dataset": stack.pop("dataset")} if "dataset" in stack else {}
    known = stack_options(**stack, where=f"{path}: [stack] ")
    _check_stack(known, f"{path}: [stack]")
    _check_press(press, f"{path}: [press]")
    return Plan(opening | known, press, rotation, memory_limit)


def _read(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            return tomllib.load(file)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}; name another with --settings") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is no text: write settings in TOML, as docs/batch.md tells") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is no TOML: {error}; mend it") from error


def _check_stack(known: StackOptions, where: str) -> None:
    """Refuse what no stack can have, before every recording fails for it."""
    if "tilt" in known:
        _check_tilt(known["tilt"], f"{where} tilt")
    if min(known.get("pixel_size", (1.0,))) <= 0:
        raise InputError(f'{where} pixel-size: a length above 0 is needed; write e.g. "0.03mm"')


def _check_press(press: Mapping[str, Any], where: str) -> None:
    """Refuse what does not go with the search for a change-point."""
    if press.get("method") != "change-point":
        return
    if not press.get("subframe", True):
        raise InputError(f"{where} subframe is false: a change-point lies between frames; leave it out")
    if press.get("threshold") in (0.0, 1.0):
        raise InputError(f"{where} threshold: a change-point needs a share between 0 and 1; write e.g. 0.5")


def _table(said: Any, where: str, readers: Mapping[str, _Reader]) -> dict[str, Any]:
    """Read the values of a table."""
    if not isinstance(said, dict):
        raise InputError(f"{where} is no table: write its name so, alone in a line, and its keys below")
    _refuse_unknown(said, readers, where, "key")
    return {_keyword(name): readers[name](value, f"{where} {name}") for name, value in said.items()}


def _refuse_unknown(said: Mapping[str, Any], known: Mapping[str, Any], where: str, what: str) -> None:
    for name in said:
        if name not in known:
            raise InputError(f"{where} has a {what} {name!r} that is not known: there are {', '.join(known)}")


def _keyword(name: str) -> str:
    """Return what the engine calls it."""
    return {"zenith-gain": "gain", "zenith-offset": "offset"}.get(name, name.replace("-", "_"))


def _text(example: str) -> _Reader:
    def read(value: Any, where: str) -> str:
        if not isinstance(value, str) or not value:
            raise InputError(f'{where} is {_toml(value)}: a text in quotes is needed; write e.g. "{example}"')
        return value

    return read


def _one_of(*known: str) -> _Reader:
    def read(value: Any, where: str) -> str:
        if value not in known:
            quoted = ", ".join(f'"{name}"' for name in known)
            raise InputError(f"{where} is {_toml(value)}: write one of {quoted}")
        return str(value)

    return read


def _number(fits: Callable[[float], bool], words: str, example: str) -> _Reader:
    def read(value: Any, where: str) -> float:
        if isinstance(value, int | float) and not isinstance(value, bool):
            with suppress(OverflowError):  # whole numbers may have any length
                if math.isfinite(value) and fits(value):
                    return float(value)
        raise InputError(f"{where} is {_toml(value)}: {words} is needed; write e.g. {example}")

    return read


def _frames(value: Any, where: str) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value < 2**31:
        raise InputError(f"{where} is {_toml(value)}: a number of frames from 1 on is needed; write e.g. 2")
    return value


def _flag(value: Any, where: str) -> bool:
    if not isinstance(value, bool):
        raise InputError(f"{where} is {_toml(value)}: write true or false")
    return value


def _motion(value: Any, where: str) -> MotionName:
    return MotionName(_one_of(*MotionName)(value, where))


def _tilt(value: Any, where: str) -> float | str:
    text = _text("2.5deg")(value, where)
    return text if text == _ESTIMATE else _check_tilt(angle(text, where), where)


def _check_tilt(radians: float, where: str) -> float:
    try:
        return check_tilt(radians)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def _gain(value: Any, where: str) -> float:
    gain = per_angle(_text("5.7/deg")(value, where), where)
    if gain == 0:
        raise InputError(f'{where} is {_toml(value)}: other than 0 is needed; write e.g. "5.7/deg"')
    return gain


def _toml(value: Any) -> str:
    """Write a value as TOML does, near enough to be recognised."""
    if isinstance(value, bool):
        return str(value).lower()
    try:
        text = f'"{value}"' if isinstance(value, str) else str(value)
    except ValueError:  # a whole number of thousands of digits
        return "out of all bounds"
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."


_COUNTS = _number(lambda value: True, "a number of counts", "12.5")
_TABLES: Mapping[str, Mapping[str, _Reader]] = {
    "stack": {
        "dataset": _text("/entry/data"),
        "motion": _motion,
        "travel-step": _text("0.1mm"),
        "travel-start": _text("0mm"),
        "phase-step": _text("45deg"),
        "tilt": _text("2.5deg"),
        "pixel-size": _text("0.03mm"),
        "region": _text("100,50,640x480"),
        "frames": _text("10:200"),
    },
    "press": {
        "event": _one_of(*EVENTS),
        "method": _one_of(*METHODS),
        "threshold": _number(lambda value: 0 <= value <= 1, "a share from 0 (dark) to 1 (bright)", "0.5"),
        "hold": _frames,
        "subframe": _flag,
        "dark": _COUNTS,
        "bright": _COUNTS,
        "noise": _number(lambda value: value >= 0, "a standard deviation in counts, not below 0,", "1.5"),
        "fill": _flag,
    },
    "rotation": {
        "method": _one_of(*NORMAL_METHODS),
        "tilt": _tilt,
        "zenith-gain": _gain,
        "zenith-offset": _COUNTS,
        "noise": _number(lambda value: value > 0, "a standard deviation in counts, above 0,", "1.5"),
        "per-turn": _flag,
        "robust": _flag,
    },
}
