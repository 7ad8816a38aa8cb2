"""What a rig file says: the stage's axes, the camera, and how both are opened."""

from __future__ import annotations

import difflib
import math
import re
import tomllib
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mirrorskin.hw.rig.references import SUFFIXES, check_references
from mirrorskin.hw.stage import Limits
from mirrorskin.io import InputError
from mirrorskin.io.types import FRAME_DTYPES


@dataclass(frozen=True, slots=True)
class Axis:
    """One axis of the machine, and the motion that it makes.

    The machine's coordinate is ``zero + direction * value``, with the value in the axis's own unit.

    Attributes
    ----------
    letter : str
        The machine's name of it: X, Y, Z, A, B or C.
    direction : int
        1 if the value grows with the machine's coordinate, -1 if it falls.
    zero : float
        The machine's coordinate at which the value is 0, in ``unit``.
    low, high : float
        Least and greatest value allowed: mm of a travel, rad of a tilt.
    speed : float
        Greatest speed: mm/s or rad/s.
    unit : str
        What the machine counts this axis in: "mm" or "deg".
    """

    letter: str
    direction: int
    zero: float
    low: float
    high: float
    speed: float
    unit: str

    @property
    def scale(self) -> float:
        """The machine's units in one mm or rad."""
        return math.degrees(1.0) if self.unit == "deg" else 1.0

    def coordinate(self, value: float) -> float:
        """Return the machine's coordinate at a value, mm or rad."""
        return self.zero + self.direction * value * self.scale

    def value(self, coordinate: float) -> float:
        """Return the value, mm or rad, at a coordinate of the machine."""
        return self.direction * (coordinate - self.zero) / self.scale + 0.0  # no minus zero


@dataclass(frozen=True, slots=True)
class StageSettings:
    """How the stage is reached, and what it may do.

    Attributes
    ----------
    port : str
        A serial port or a URL of pyserial.
    baud : int
        Bits per second.
    home : bool
        Whether the stage has switches to home against.
    timeout : float
        Longest wait for an answer, seconds.
    report_rate : float
        How often its position is asked for, Hz.
    travel : Axis
        Along the sheet's normal, positive down, mm.
    pitch, roll : Axis or None
        The two components of the lean, rad; a stage has both or none.
    press : float
        Greatest travel allowed, mm.
    pivot : (float, float, float) or None
        What the body turns about, mm from the sheet's centre.
    """

    port: str
    baud: int
    home: bool
    timeout: float
    report_rate: float
    travel: Axis
    pitch: Axis | None
    roll: Axis | None
    press: float
    pivot: tuple[float, float, float] | None

    @property
    def axes(self) -> dict[str, Axis]:
        """The axes that the stage has, by the motion they make: travel, pitch, roll."""
        named = {"travel": self.travel, "pitch": self.pitch, "roll": self.roll}
        return {name: axis for name, axis in named.items() if axis is not None}

    @property
    def limits(self) -> Limits:
        """What the stage may do: its travel, its greatest half-angle all the way round, its press."""
        reaches = [reach for axis in (self.pitch, self.roll) if axis for reach in (-axis.low, axis.high)]
        travel = (self.travel.low, self.travel.high)
        return Limits(travel, max(0.0, min(reaches, default=0.0)), min(self.press, self.travel.high))


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """How the camera is opened, and what its counts mean.

    Attributes
    ----------
    source : int or str
        The number of a camera, or the path or URL of a stream.
    shape : (int, int)
        Rows and columns.
    dtype : dtype
        Type of a sample: uint8, uint16 or float32.
    fourcc : str or None
        The format asked of the camera, four letters; None leaves it.
    exposure : float or None
        Seconds; None leaves it.
    gain : float or None
        In the camera's own unit; None leaves it.
    rate : float or None
        Frames per second; None leaves it.
    delay : float or None
        From the middle of the exposure to the frame's arrival, seconds; None if it is not known.
    pixel_size : (float, float) or None
        Width and height of a pixel at the sheet, mm.
    dark, bright : float or Path or None
        Counts without light, and off the contact: one number, or a picture's file.
    zenith_gain : float or None
        Counts per radian of zenith.
    zenith_offset : float or None
        Counts at zenith 0.
    name : str
        What it is called in recordings, and by which calibrations know it.
    """

    source: int | str
    shape: tuple[int, int]
    dtype: np.dtype[Any]
    fourcc: str | None = None
    exposure: float | None = None
    gain: float | None = None
    rate: float | None = None
    delay: float | None = None
    pixel_size: tuple[float, float] | None = None
    dark: float | Path | None = None
    bright: float | Path | None = None
    zenith_gain: float | None = None
    zenith_offset: float | None = None
    name: str = ""


@dataclass(frozen=True, slots=True)
class RigSettings:
    """A rig: its file, its name, its stage and its camera.

    Attributes
    ----------
    path : Path
        The file that said so.
    name : str
        What the rig is called.
    stage : StageSettings
        The stage.
    camera : CameraSettings
        The camera.
    """

    path: Path
    name: str
    stage: StageSettings
    camera: CameraSettings


# Reads a value; raises ValueError, which tells what is needed instead.
Reader = Callable[[Any], Any]

REQUIRED = object()
"""The default of a key that must be said."""

_LONGEST = 40  # letters of a value that a message quotes


@dataclass(frozen=True, slots=True)
class Key:
    """What is known of a key.

    Attributes
    ----------
    read : callable
        Reads its value; raises ValueError, which tells what is needed instead.
    example : str
        A value, as TOML writes it.
    default : object
        What holds if it is not said; ``REQUIRED`` if it must be.
    """

    read: Reader
    example: str
    default: Any = REQUIRED


def read_table(
    said: Any, keys: Mapping[str, Key], where: str, name: str = "", tables: Collection[str] = ()
) -> dict[str, Any]:
    """Read the values of a table; what is not said gets its default.

    Parameters
    ----------
    said : object
        The table as TOML gives it.
    keys : mapping
        What it may hold.
    where : str
        The file, for messages.
    name : str
        The table's dotted name; empty at the top of the file.
    tables : collection of str
        Names of tables in it, which are read elsewhere.

    Raises
    ------
    InputError
        It is no table, a key is not known or missing, or a value is not what it may be.
    """
    if not isinstance(said, dict):
        raise InputError(
            f"{where}: {name} is {quote(said)}: write [{name}] alone in a line, and its keys below"
        )
    for key in said:
        if key not in keys and key not in tables:
            raise InputError(f"{where}: {_dotted(name, key)} is not known: {_suggest(key, [*keys, *tables])}")
    return {key: _value(said, key, keys[key], where, name) for key in keys}


def _value(said: Mapping[str, Any], key: str, known: Key, where: str, name: str) -> Any:
    dotted = _dotted(name, key)
    if key not in said:
        if known.default is REQUIRED:
            raise InputError(f"{where}: {dotted} is missing; write {key} = {known.example} in [{name}]")
        return known.default
    try:
        return known.read(said[key])
    except ValueError as error:
        raise InputError(
            f"{where}: {dotted} is {quote(said[key])}: {error}; write e.g. {key} = {known.example}"
        ) from error


def _dotted(table: str, key: str) -> str:
    shown = key if key.isprintable() and key else repr(key)
    return f"{table}.{shown}" if table else shown


def _suggest(key: str, known: Collection[str]) -> str:
    close = difflib.get_close_matches(key.lower().replace("-", "_"), known, n=1)
    return f"did you mean {close[0]}?" if close else f"there are {', '.join(known)}"


def quote(value: Any) -> str:
    """Write a value as TOML does, near enough to be recognised."""
    if isinstance(value, dict):
        return "a table"
    if isinstance(value, bool):
        return str(value).lower()
    try:
        text = f'"{value}"' if isinstance(value, str) else str(value)
    except ValueError:  # a whole number of thousands of digits
        return "out of all bounds"
    text = "".join(letter if letter.isprintable() else "?" for letter in text)
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."


def number(words: str, fits: Callable[[float], bool] = lambda value: True) -> Reader:
    """Return what reads a finite number that fits; `words` name such a number."""

    def read(value: Any) -> float:
        if isinstance(value, int | float) and not isinstance(value, bool):
            try:
                known = float(value)
            except OverflowError:  # whole numbers may have any length
                known = math.inf
            if math.isfinite(known) and fits(known):
                return known
        raise ValueError(f"{words} is needed")

    return read


def whole(words: str, least: int, most: int) -> Reader:
    """Return what reads a whole number from `least` to `most`."""

    def read(value: Any) -> int:
        if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
            raise ValueError(f"{words} from {least} to {most} is needed")
        return value

    return read


def one_of(*known: str | int) -> Reader:
    """Return what reads one of several words or whole numbers."""

    def read(value: Any) -> str | int:
        for one in known:
            if type(value) is type(one) and value == one:
                return one
        raise ValueError(f"one of {', '.join(map(quote, known))} is needed")

    return read


def several(count: int, words: str, read_one: Reader) -> Reader:
    """Return what reads an array of `count` values of one kind."""

    def read(value: Any) -> tuple[Any, ...]:
        if not isinstance(value, list) or len(value) != count:
            raise ValueError(f"{words} are needed, in [ ]")
        return tuple(map(read_one, value))

    return read


def text(words: str) -> Reader:
    """Return what reads a text that is not empty, in one line."""

    def read(value: Any) -> str:
        if not isinstance(value, str) or not value.strip() or not value.isprintable():
            raise ValueError(f"{words} is needed, a text in quotes")
        return value

    return read


def flag(value: Any) -> bool:
    """Read true or false."""
    if not isinstance(value, bool):
        raise ValueError("true or false is needed")
    return value


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


"""A rig file to begin with."""

TEMPLATE = """\
# A rig for mirrorskin: what moves the sensor's body, and what looks at its skin (docs/rig.md).
# Lines that begin with # show what may be said as well.

name = "bench"

[stage]
port = "/dev/ttyUSB0"           # or COM3, socket://192.168.0.7:23, rfc2217://host:port
# baud = 115200
home = true                     # the stage has switches, and must home before it moves
# timeout = 2.0                 # s that an answer may take
# report_rate = 20.0            # Hz: how often it is asked where it rests
press = 2.0                     # mm: greatest travel, whatever the axis could do
# pivot = [0.0, 0.0, 0.0]       # mm from the centre of the sheet: what the body turns about

[stage.travel]                  # mm, positive down, 0 where the skin is just above the object
letter = "Z"
direction = -1                  # this machine counts upwards
zero = -20.0                    # the machine's coordinate at which the travel is 0
# unit = "mm"
limits = [-10.0, 3.0]
speed = 5.0                     # mm/s

[stage.pitch]                   # degrees, 0 upright; leave pitch and roll out if the stage only presses
letter = "X"
direction = 1
zero = 0.0
# unit = "deg"
limits = [-5.0, 5.0]
speed = 20.0                    # degrees/s

[stage.roll]
letter = "Y"
direction = 1
zero = 0.0
# unit = "deg"
limits = [-5.0, 5.0]
speed = 20.0

[camera]
source = 0                      # a camera's number, or a file or URL in quotes
size = [640, 480]               # columns, rows
# name = "left"                 # what recordings and calibrations call it; without it, the source
# dtype = "uint8"
# fourcc = "GREY"
# exposure = 0.004              # s
# gain = 1.0
# rate = 60.0                   # Hz
# delay = 0.03                  # s from the middle of the exposure to the frame's arrival, if it is known
pixel_size = 0.03               # mm at the sheet
# dark = 12                     # counts without light, or a picture's file
# bright = "bright.tif"         # counts in full light, or a picture's file
# zenith_gain = 5.7             # counts per degree of zenith
# zenith_offset = 10            # counts at zenith 0
"""
"""Says every key; what is left out has its default."""
