"""Reads a rig file: TOML that says how a stage and a camera are opened (``docs/rig.md``)."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mirrorskin.hw.rig.keys import Key, flag, number, one_of, read_table, several, text, whole
from mirrorskin.hw.rig.reference_files import SUFFIXES, check_references
from mirrorskin.hw.settings import Axis, CameraSettings, RigSettings, StageSettings
from mirrorskin.io import InputError
from mirrorskin.io.types import FRAME_DTYPES

_TILTS = ("pitch", "roll")
_STEEPEST = 90.0  # degrees
_USER = re.compile("//[^/]*@")


def load_rig(path: Path | str) -> RigSettings:
    """Read a rig file.

    Parameters
    ----------
    path : Path or str
        TOML as ``docs/rig.md`` describes it. Files that it names lie beside it.

    Returns
    -------
    RigSettings
        In mm, radians and seconds.

    Raises
    ------
    InputError
        The file cannot be read, or says something that is not known or cannot be used. The message names the
        file, the key and the remedy.
    """
    path = Path(path)
    said, where = _read(path), str(path)
    top = read_table(said, KEYS[""], where, tables=("stage", "camera"))
    stage = _stage(_present(said, "stage", where), where)
    camera = _camera(_present(said, "camera", where), path)
    check_references(camera, where)
    return RigSettings(path, path.stem if top["name"] is None else top["name"], stage, camera)


def _read(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            return tomllib.load(file)
    except OSError as error:
        raise InputError(
            f"{path} cannot be read: {error.strerror}; name a rig file, or write one: mirrorskin rig new"
        ) from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is no text: write a rig in TOML, as docs/rig.md tells") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is no TOML: {error}; correct it there") from error


def _present(said: Mapping[str, Any], name: str, where: str) -> Any:
    key = name.rpartition(".")[2]
    if key not in said:
        raise InputError(f"{where}: the table [{name}] is missing; add it, as docs/rig.md tells")
    return said[key]


def _stage(said: Any, where: str) -> StageSettings:
    values = read_table(said, KEYS["stage"], where, "stage", ("travel", *_TILTS))
    axes: dict[str, Axis | None] = {name: _axis(said[name], name, where) for name in _TILTS if name in said}
    if len(axes) == 1:
        has, lacks = axes, next(name for name in _TILTS if name not in axes)
        raise InputError(
            f"{where}: there is [stage.{next(iter(has))}] and no [stage.{lacks}]: "
            "a lean needs both; add the other, or leave both out"
        )
    travel = _axis(_present(said, "stage.travel", where), "travel", where)
    _check_letters({"travel": travel} | axes, where)
    if not values["press"] > travel.low:
        raise InputError(
            f"{where}: stage.press is {values['press']:g}, not above stage.travel.limits' {travel.low:g}; "
            "write the greatest travel that the skin bears, in mm"
        )
    return StageSettings(travel=travel, pitch=axes.get("pitch"), roll=axes.get("roll"), **values)


def _axis(said: Any, name: str, where: str) -> Axis:
    """Read an axis; radians leave here."""
    table = f"stage.{name}"
    values = read_table(said, KEYS[table], where, table)
    low, high = values.pop("limits")
    if not low < high:
        raise InputError(
            f"{where}: {table}.limits are out of order, {low:g} not below {high:g}: write [least, greatest]"
        )
    speed = values.pop("speed")
    if values["unit"] == "deg":
        if not low < 0 < high:
            raise InputError(
                f"{where}: {table}.limits [{low:g}, {high:g}] do not have 0 (upright) within; "
                "set zero to the machine's coordinate there, and limits on both sides of it"
            )
        low, high, speed = map(math.radians, (low, high, speed))
    return Axis(low=low, high=high, speed=speed, **values)


def _check_letters(axes: Mapping[str, Axis | None], where: str) -> None:
    """Refuse two motions of one axis."""
    taken: dict[str, str] = {}
    for name, axis in axes.items():
        letter = axis.letter if axis else ""
        if letter in taken:
            raise InputError(
                f'{where}: stage.{name}.letter is "{letter}", and so is stage.{taken[letter]}.letter: '
                "each motion needs an axis of its own; correct one of them"
            )
        taken[letter] = name


def _camera(said: Any, path: Path) -> CameraSettings:
    values = read_table(said, KEYS["camera"], str(path), "camera")
    columns, rows = values.pop("size")
    if values["zenith_gain"] is not None:
        values["zenith_gain"] = values["zenith_gain"] / math.radians(1.0)
    elif values["zenith_offset"] is not None:
        raise InputError(
            f"{path}: camera.zenith_offset is said and camera.zenith_gain is not: "
            "the one means nothing without the other; add it, or leave both out"
        )
    for name in ("dark", "bright"):
        if isinstance(values[name], str):
            values[name] = path.parent / values[name]
    source = values.pop("source")
    if values["name"] is None:
        values["name"] = _USER.sub("//", str(source))  # without the password of a stream
    if isinstance(source, str) and "://" not in source:
        source = _beside(path, source)
    return CameraSettings(source=source, shape=(rows, columns), **values)


def _beside(path: Path, name: str) -> str:
    """Return the path of a file beside the rig file; a name of none there is left as it is."""
    try:
        return str(path.parent / name) if (path.parent / name).exists() else name
    except OSError:  # it is too long, or the folder may not be looked into
        return name


def _source(value: Any) -> int | str:
    if isinstance(value, str) and value.strip() and value.isprintable():
        return value
    if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 1000:
        return value
    raise ValueError("a camera's number from 0 on, or the path or URL of a stream in quotes is needed")


def _dtype(value: Any) -> np.dtype[Any]:
    return np.dtype(one_of(*(dtype.name for dtype in FRAME_DTYPES))(value))


def _fourcc(value: Any) -> str:
    if not isinstance(value, str) or not re.fullmatch("[!-~]{2,4} {0,2}", value) or len(value) > 4:
        raise ValueError("the two to four letters of a format are needed, in quotes")
    return value.ljust(4)


def _pixel_size(value: Any) -> tuple[float, float]:
    length = number("a length above 0, in mm,", lambda value: value > 0)
    if isinstance(value, list):
        x, y = several(2, "a width and a height in mm", length)(value)
        return x, y
    side = length(value)
    return side, side


def _counts(value: Any) -> float | str:
    """Read counts, or the name of a picture's file."""
    if isinstance(value, str):
        if not value.isprintable() or Path(value).suffix.lower() not in SUFFIXES:
            raise ValueError(f"a number of counts or a file ({', '.join(SUFFIXES)}) is needed")
        return value
    counts: float = number("a number of counts, or a file in quotes,")(value)
    return counts


def _axis_keys(letter: str, unit: str, limits: str, speed: str) -> dict[str, Key]:
    words = {"mm": "mm", "deg": "degrees"}[unit]
    place = number(f"a finite number of {words}")
    bound = place if unit == "mm" else number("an angle between -90 and 90 degrees", _is_tilt)
    return {
        "letter": Key(one_of(*"XYZABC"), f'"{letter}"'),
        "direction": Key(one_of(1, -1), "1", 1),
        "zero": Key(place, "0.0", 0.0),
        "unit": Key(one_of(unit), f'"{unit}"', unit),
        "limits": Key(several(2, f"the least and the greatest value in {words}", bound), limits),
        "speed": Key(number(f"a speed above 0, in {words} a second,", _is_positive), speed),
    }


def _is_tilt(value: float) -> bool:
    return abs(value) < _STEEPEST


def _is_positive(value: float) -> bool:
    return value > 0


KEYS: Mapping[str, Mapping[str, Key]] = {
    "": {"name": Key(text("what the rig is called"), '"bench 2"', None)},
    "stage": {
        "port": Key(text("a serial port or a URL"), '"/dev/ttyUSB0"'),
        "baud": Key(whole("a number of bits a second", 300, 10_000_000), "115200", 115200),
        "home": Key(flag, "true", True),
        "timeout": Key(number("a time from 0.1 to 60 s", lambda value: 0.1 <= value <= 60), "2.0", 2.0),
        "report_rate": Key(number("a rate from 1 to 100 Hz", lambda value: 1 <= value <= 100), "20.0", 20.0),
        "press": Key(number("a finite number of mm"), "2.0"),
        "pivot": Key(several(3, "x, y and z in mm", number("each a finite number")), "[0.0, 0.0, 0.0]", None),
    },
    "stage.travel": _axis_keys("Z", "mm", "[-5.0, 3.0]", "5.0"),
    "stage.pitch": _axis_keys("X", "deg", "[-5.0, 5.0]", "20.0"),
    "stage.roll": _axis_keys("Y", "deg", "[-5.0, 5.0]", "20.0"),
    "camera": {
        "source": Key(_source, "0"),
        "size": Key(several(2, "columns and rows", whole("each", 1, 65535)), "[640, 480]"),
        "name": Key(text("what the camera is called"), '"left"', None),
        "dtype": Key(_dtype, '"uint8"', np.dtype(np.uint8)),
        "fourcc": Key(_fourcc, '"GREY"', None),
        "exposure": Key(number("a time above 0, in seconds,", _is_positive), "0.004", None),
        "gain": Key(number("a finite number"), "1.0", None),
        "rate": Key(number("a rate above 0, in Hz,", _is_positive), "60.0", None),
        "delay": Key(number("a time from 0 to 10 s", lambda value: 0 <= value <= 10), "0.03", None),
        "pixel_size": Key(_pixel_size, "0.03", None),
        "dark": Key(_counts, "12", None),
        "bright": Key(_counts, '"bright.tif"', None),
        "zenith_gain": Key(number("a number of counts a degree, other than 0,", bool), "5.7", None),
        "zenith_offset": Key(number("a number of counts"), "10", None),
    },
}
"""The keys of every table, by its dotted name; the top of the file has none."""
