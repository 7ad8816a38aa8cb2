"""The rig file: TOML that describes a stage and a camera.

Each class is a table of the file, and each of its fields a key in the file's units; properties return mm,
radians and seconds.
"""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar, cast

import msgspec
from msgspec import Meta

from mirrorskin.hw.base.drivers import CAMERAS, STAGES, built_in, camera_driver, driver_names, is_class
from mirrorskin.hw.base.emulated_file import Emulator
from mirrorskin.hw.base.references import SUFFIXES, check_references
from mirrorskin.hw.base.stage import Limits
from mirrorskin.io import InputError
from mirrorskin.io.base.settings_file import load_toml
from mirrorskin.io.base.types import PROPERTIES

_USER = re.compile("//[^/]*@")
_STEEPEST = 90.0  # degrees
_ROUND = 360.0  # degrees
_CELL = 65535  # rows or columns

# What rig files can name, from the declarations of the drivers.
_STAGES = [f'"{driver.name}"' for driver in built_in(STAGES)]
_CAMERAS = [f"{driver.name}:" for driver in built_in(CAMERAS) if driver.name]
_FORMATS = [driver for driver in reversed(built_in(CAMERAS)) if driver.formats]
_FIRMWARE_HELP = ", ".join([*_STAGES, 'or a class as "module:Class" or "file.py:Class",'])
_SOURCE_HELP = "".join(f"{name}, " for name in _CAMERAS)
_FOURCC = rf"^({'|'.join(driver.formats for driver in _FORMATS)})\Z"
_FOURCC_HELP = ", or ".join(driver.formats_help for driver in _FORMATS)
# Parts of the template.
_OTHER_STAGES = ", ".join(_STAGES[1:])
_SERIALS = "".join(f"{name}SERIAL, " for name in _CAMERAS)
_TRIGGERED = " or ".join(_CAMERAS)
_STAGE_LINES, _CAMERA_LINES = (
    "".join(prop.line(name) for name, prop in PROPERTIES.items() if prop.of == table)
    for table in ("stage", "camera")
)

Text = Annotated[str, Meta(pattern=r"^[^\x00-\x1f\x7f]*[^\s\x00-\x1f\x7f][^\x00-\x1f\x7f]*\Z")]
Line = Literal["coolant", "spindle"]
"""An output of the controller that can be switched on and off."""

_Model = TypeVar("_Model", bound=msgspec.Struct)
Letter = Literal["X", "Y", "Z", "A", "B", "C"]
_Side = Annotated[float, Meta(gt=0)]
_Pixels = Annotated[int, Meta(ge=1, le=_CELL)]
_Picture = Annotated[str, Meta(pattern=rf"(?i)^[^\x00-\x1f\x7f]*({'|'.join(map(re.escape, SUFFIXES))})\Z")]
_Reference = Annotated[
    float | _Picture,
    Meta(description=f"a number of counts, or a file ({', '.join(SUFFIXES)}) in quotes,", examples=[12]),
]


class Axis(msgspec.Struct, frozen=True, kw_only=True):
    """An axis of the machine, and its motion; see the classes below.

    The machine coordinate is ``zero + direction * value``, with the value in the axis's own unit.
    """

    letter: Annotated[Letter, Meta(description="one of X, Y, Z, A, B, C, in quotes,", examples=["Z"])]
    direction: Annotated[Literal[1, -1], Meta(description="1 or -1", examples=[1])] = 1
    unit: str
    zero: float
    limits: tuple[float, float]
    speed: float
    steps: Annotated[float, Meta(gt=0, description="a number above 0", examples=[250.0])] | None = None

    def __post_init__(self) -> None:
        low, high = self.limits
        if not low < high:
            raise ValueError(
                f"limits are in the wrong order, {low:g} is not below {high:g}: write [least, greatest]"
            )

    @property
    def scale(self) -> float:
        """Machine units per mm or rad."""
        return math.degrees(1.0) if self.unit == "deg" else 1.0

    @property
    def low(self) -> float:
        """Least value allowed, mm or rad."""
        return self._converted(self.limits[0])

    @property
    def high(self) -> float:
        """Greatest value allowed, mm or rad."""
        return self._converted(self.limits[1])

    @property
    def top_speed(self) -> float:
        """Greatest speed, mm/s or rad/s."""
        return self._converted(self.speed)

    def coordinate(self, value: float) -> float:
        """Return the machine coordinate of a value, mm or rad."""
        return self.zero + self.direction * value * self.scale

    def value(self, coordinate: float) -> float:
        """Return the value, mm or rad, at a machine coordinate."""
        return self.direction * (coordinate - self.zero) / self.scale + 0.0  # avoids -0

    def _converted(self, value: float) -> float:
        return math.radians(value) if self.unit == "deg" else value


class TravelAxis(Axis, frozen=True, kw_only=True):
    """The axis along the sheet's normal; its value is the travel, positive down."""

    zero: Annotated[float, Meta(description="a finite number of mm", examples=[0.0])] = 0.0
    unit: Literal["mm"] = "mm"
    limits: Annotated[
        tuple[float, float],
        Meta(description="a list of the least and the greatest value, in mm,", examples=[[-5.0, 3.0]]),
    ]
    speed: Annotated[float, Meta(gt=0, description="a speed above 0, in mm a second,", examples=[5.0])]


class CentredAxis(Axis, frozen=True, kw_only=True):
    """An axis that must include 0, where the body is before and after a scan."""

    _ZERO: ClassVar[str] = "where the body is lowered"

    def __post_init__(self) -> None:
        Axis.__post_init__(self)
        low, high = self.limits
        if not low < 0 < high:
            raise ValueError(
                f"limits [{low:g}, {high:g}] do not include 0 ({self._ZERO}); set zero to the "
                "machine coordinate there, and limits on both sides of it"
            )


class ShiftAxis(CentredAxis, frozen=True, kw_only=True):
    """An axis along the sheet, x or y; the body is lowered at 0."""

    zero: Annotated[float, Meta(description="a finite number of mm", examples=[0.0])] = 0.0
    unit: Literal["mm"] = "mm"
    limits: Annotated[
        tuple[float, float],
        Meta(description="a list of the least and the greatest value, in mm,", examples=[[-2.0, 2.0]]),
    ]
    speed: Annotated[float, Meta(gt=0, description="a speed above 0, in mm a second,", examples=[1.0])]


class AngleAxis(CentredAxis, frozen=True, kw_only=True):
    """An axis that rotates the body."""

    zero: Annotated[float, Meta(description="a finite number of degrees", examples=[0.0])] = 0.0
    unit: Literal["deg"] = "deg"
    speed: Annotated[float, Meta(gt=0, description="a speed above 0, in degrees a second,", examples=[20.0])]


class TwistAxis(AngleAxis, frozen=True, kw_only=True):
    """The axis that turns the body about its own axis; the body is lowered at 0."""

    limits: Annotated[
        tuple[
            Annotated[float, Meta(ge=-_ROUND, le=_ROUND)],
            Annotated[float, Meta(ge=-_ROUND, le=_ROUND)],
        ],
        Meta(
            description="a list of the least and the greatest angle, from -360 to 360 degrees,",
            examples=[[-45.0, 45.0]],
        ),
    ]


class TiltAxis(AngleAxis, frozen=True, kw_only=True):
    """An axis of the lean, pitch or roll; 0 is upright."""

    _ZERO = "upright"
    limits: Annotated[
        tuple[
            Annotated[float, Meta(gt=-_STEEPEST, lt=_STEEPEST)],
            Annotated[float, Meta(gt=-_STEEPEST, lt=_STEEPEST)],
        ],
        Meta(
            description="a list of the least and the greatest angle, between -90 and 90 degrees,",
            examples=[[-5.0, 5.0]],
        ),
    ]


def _with_properties(table: str) -> Callable[[type[_Model]], type[_Model]]:
    """Add the declared properties of recordings to the keys of a table."""
    keys = []
    for name, prop in PROPERTIES.items():
        low, high = prop.within
        number = Annotated[float, Meta(ge=low, le=high)]
        meta = Meta(description=prop.needed, examples=[float(prop.example)])
        if prop.of == table:
            keys.append((name, Annotated[number | None, meta], None))

    def add(model: type[_Model]) -> type[_Model]:
        about: dict[str, Any] = {
            "bases": (model,),
            "module": model.__module__,
            "namespace": {"__doc__": model.__doc__},
        }
        whole = msgspec.defstruct(model.__name__, keys, frozen=True, kw_only=True, **about)
        return cast("type[_Model]", whole)

    return add


@_with_properties("stage")
class StageSettings(msgspec.Struct, frozen=True, kw_only=True):
    """The connection and the limits of the stage: the table ``[stage]``.

    In Python, ``firmware`` may also be a stage class itself.
    """

    port: Annotated[Text, Meta(description="a serial port or a URL, in quotes,", examples=["/dev/ttyUSB0"])]
    firmware: Annotated[
        str,
        Meta(
            pattern=r"^([A-Za-z_]\w*|[^\x00-\x1f\x7f]+:[A-Za-z_]\w*)\Z",
            description=_FIRMWARE_HELP,
            examples=["grbl"],
        ),
    ] = "grbl"
    baud: Annotated[
        int,
        Meta(
            ge=300,
            le=10_000_000,
            description="a number of bits a second, from 300 to 10000000,",
            examples=[115200],
        ),
    ] = 115200
    home: Annotated[bool, Meta(description="true or false", examples=[True])] = True
    timeout: Annotated[float, Meta(ge=0.1, le=60, description="a time from 0.1 to 60 s", examples=[2.0])] = (
        2.0
    )
    report_rate: Annotated[
        float, Meta(ge=1, le=100, description="a rate from 1 to 100 Hz", examples=[20.0])
    ] = 20.0
    silence: Annotated[float, Meta(ge=0.02, le=5, description="a time from 0.02 to 5 s", examples=[0.07])] = (
        0.07
    )
    press: Annotated[float, Meta(description="a finite number of mm", examples=[2.0])]
    pivot: Annotated[
        tuple[float, float, float] | None,
        Meta(description="a list of x, y and z, in mm,", examples=[[0.0, 0.0, 0.0]]),
    ] = None
    travel: TravelAxis
    pitch: TiltAxis | None = None
    roll: TiltAxis | None = None
    x: ShiftAxis | None = None
    y: ShiftAxis | None = None
    twist: TwistAxis | None = None

    def __post_init__(self) -> None:
        if (self.pitch is None) != (self.roll is None):
            has, lacks = ("pitch", "roll") if self.roll is None else ("roll", "pitch")
            raise ValueError(
                f"there is [stage.{has}] but no [stage.{lacks}]: a lean needs both; add the "
                "other, or remove both"
            )
        taken: dict[str, str] = {}
        for name, axis in self.axes.items():
            if axis.letter in taken:
                raise ValueError(
                    f'{name}.letter is "{axis.letter}", and so is {taken[axis.letter]}.letter: '
                    "each motion needs an axis of its own; correct one of them"
                )
            taken[axis.letter] = name
        if not self.press > self.travel.low:
            raise ValueError(
                f"press is {self.press:g}, not above travel.limits' {self.travel.low:g}; write "
                "the greatest travel that the skin tolerates, in mm"
            )

    @property
    def axes(self) -> dict[str, Axis]:
        """The axes of the stage, by motion: travel, pitch, roll, x, y, twist."""
        named = {name: getattr(self, name) for name in ("travel", "pitch", "roll", "x", "y", "twist")}
        return {name: axis for name, axis in named.items() if axis is not None}

    @property
    def limits(self) -> Limits:
        """Limits of the axes, of the half-angle of a precession, and of the press."""
        reaches = [reach for axis in (self.pitch, self.roll) if axis for reach in (-axis.low, axis.high)]
        travel = (self.travel.low, self.travel.high)
        sideways = {
            name: (axis.low, axis.high) for name, axis in self.axes.items() if name in ("x", "y", "twist")
        }
        press = min(self.press, self.travel.high)
        return Limits(travel, max(0.0, min(reaches, default=0.0)), press, **sideways)


@_with_properties("camera")
class CameraSettings(msgspec.Struct, frozen=True, kw_only=True):
    """The settings of the camera and the meaning of its counts: the table ``[camera]``."""

    source: Annotated[
        Annotated[int, Meta(ge=0, lt=1000)] | Text,
        Meta(
            description=f"a camera's number from 0 on, or {_SOURCE_HELP}a path or a URL in quotes,",
            examples=[0],
        ),
    ]
    size: Annotated[
        tuple[_Pixels, _Pixels],
        Meta(description=f"a list of columns and rows, each from 1 to {_CELL},", examples=[[640, 480]]),
    ]
    name: Annotated[Text, Meta(description="what the camera is called, in quotes,", examples=["left"])] = ""
    dtype: Literal["uint8", "uint16", "float32"] = "uint8"
    fourcc: Annotated[
        Annotated[str, Meta(pattern=_FOURCC)] | None,
        Meta(
            description=f"a format of {_FOURCC_HELP}, in quotes,",
            examples=["GREY"],
        ),
    ] = None
    exposure: Annotated[
        Annotated[float, Meta(gt=0)] | None,
        Meta(description="a time above 0, in seconds,", examples=[0.004]),
    ] = None
    gain: Annotated[float | None, Meta(description="a finite number", examples=[1.0])] = None
    rate: Annotated[
        Annotated[float, Meta(gt=0)] | None, Meta(description="a rate above 0, in Hz,", examples=[60.0])
    ] = None
    trigger: Line | None = None
    trigger_input: Annotated[
        Text | None, Meta(description="what the camera calls it, in quotes,", examples=["Line0"])
    ] = None
    delay: Annotated[
        Annotated[float, Meta(ge=0, le=10)] | None,
        Meta(description="a time from 0 to 10 s", examples=[0.03]),
    ] = None
    stall: Annotated[float, Meta(ge=0.02, le=5, description="a time from 0.02 to 5 s", examples=[0.1])] = 0.1
    pixel_size: Annotated[
        _Side | tuple[_Side, _Side] | None,
        Meta(description="a length above 0, in mm, or a list of a width and a height", examples=[0.03]),
    ] = None
    dark: _Reference | None = None
    bright: _Reference | None = None
    zenith_gain: Annotated[
        float | None, Meta(description="a number of counts a degree, other than 0,", examples=[5.7])
    ] = None
    zenith_offset: Annotated[float | None, Meta(description="a number of counts", examples=[10])] = None

    def __post_init__(self) -> None:
        if not self.name:
            msgspec.structs.force_setattr(self, "name", _USER.sub("//", str(self.source)))
        if self.fourcc is not None:
            msgspec.structs.force_setattr(self, "fourcc", self.fourcc.ljust(4))
            driver = camera_driver(self.source)
            if driver.formats and not re.fullmatch(driver.formats, self.fourcc):
                raise ValueError(
                    f'fourcc is "{self.fourcc}": this source needs {driver.formats_help}; or leave it out'
                )
        if self.trigger_input is not None and self.trigger is None:
            raise ValueError("trigger_input is given without trigger: add trigger, or remove trigger_input")
        if self.zenith_gain == 0:
            raise ValueError("zenith_gain is 0: write the counts per degree, e.g. 5.7, or leave it out")
        if self.zenith_gain is None and self.zenith_offset is not None:
            raise ValueError(
                "zenith_offset is given without zenith_gain, and has no meaning alone: add "
                "zenith_gain, or remove zenith_offset"
            )

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.size[1], self.size[0]

    @property
    def streamed(self) -> bool:
        """Whether it is a stream, whose delay differs for each connection."""
        return isinstance(self.source, str) and "://" in self.source

    @property
    def pixel_sides(self) -> tuple[float, float] | None:
        """Width and height of a pixel at the sheet, mm."""
        side = self.pixel_size
        return (side, side) if isinstance(side, float | int) else side

    @property
    def counts_per_radian(self) -> float | None:
        """The zenith gain, counts per radian."""
        return None if self.zenith_gain is None else self.zenith_gain / math.radians(1.0)


@dataclass(frozen=True, slots=True)
class RigSettings:
    """A rig: file, name, stage and camera."""

    path: Path
    name: str
    stage: StageSettings
    camera: CameraSettings


class RigFile(msgspec.Struct, frozen=True, kw_only=True):
    """The whole file."""

    name: Annotated[
        Text | None, Meta(description="what the rig is called, in quotes,", examples=["bench 2"])
    ] = None
    stage: StageSettings
    camera: CameraSettings


def load_rig(path: Path | str) -> RigSettings:
    """Read a rig file.

    Parameters
    ----------
    path : Path or str
        TOML with the keys of ``TEMPLATE``. Files that it names are relative to its folder.

    Returns
    -------
    RigSettings
        With the paths of those files.

    Raises
    ------
    InputError
        The file is invalid, or belongs to an emulated rig that has ended.

    Examples
    --------
    >>> load_rig("rig.toml").stage.press  # doctest: +SKIP
    2.0
    """
    path = Path(path)
    file = load_toml(path, RigFile, "'mirrorskin rig new' writes a template")
    _check_emulator(path)
    camera = file.camera
    resolved: dict[str, Any] = {
        name: str(path.parent / file_name)
        for name in ("dark", "bright")
        if isinstance(file_name := getattr(camera, name), str)
    }
    if isinstance(camera.source, str) and not camera.streamed:
        driver = camera_driver(camera.source)
        resolved["source"] = camera.source if driver.name else _next_to(path, camera.source)
    camera = msgspec.structs.replace(camera, **resolved)
    check_references(camera, str(path))
    firmware = file.stage.firmware
    if firmware.isidentifier() and all(firmware != driver.name for driver in built_in(STAGES)):
        names = driver_names(STAGES)  # packages are only asked if none is built in
        if firmware not in names:
            raise InputError(
                f"{path}: stage.firmware is {firmware}, and there are {', '.join(names)}; or name a class, as"
                ' in "my_stage.py:MyStage"'
            )
    stage = msgspec.structs.replace(file.stage, firmware=_next_to(path, firmware))
    return RigSettings(path, file.name or path.stem, stage, camera)


def _check_emulator(path: Path) -> None:
    """Refuse the file of an ended emulated rig, whose port may belong to another terminal now."""
    emulator = Emulator.read(path)
    if emulator is None or emulator.running:
        return
    folder = shlex.quote(str(path.parent))
    raise InputError(
        f"{path}: the emulated rig has ended, its port {emulator.port} is gone. Start it again with"
        f" 'mirrorskin twin serve -o {folder} --background'"
    )


def _next_to(path: Path, name: str) -> str:
    """Return the path of a file, or of a class's module, next to the rig file; other names as they are."""
    place, _, kind = name.rpartition(":") if is_class(name) else (name, "", "")
    file = path.parent / (f"{place.replace('.', '/')}.py" if kind and not place.endswith(".py") else place)
    try:
        present = file.is_file() if kind else file.exists()
    except OSError:  # too long, or the folder cannot be read
        present = False
    if not present:
        return name
    return f"{file}:{kind}" if kind else str(file)


TEMPLATE = f"""\
# A rig for mirrorskin: the stage that moves the sensor's body, and the camera that watches its skin.
# Lines that start with # show optional settings.

name = "bench"

[stage]
port = "/dev/ttyUSB0"           # or COM3, socket://192.168.0.7:23, rfc2217://host:port
# firmware = "grbl"             # or {_OTHER_STAGES}, or a class of your own as "my_stage.py:MyStage"
# baud = 115200
home = true                     # the stage has limit switches, and must be homed before it moves
# timeout = 2.0                 # s to wait for an answer
# report_rate = 20.0            # Hz: rate of position queries at rest
# silence = 0.07                # s without an answer, in motion, after which the stage is stopped
press = 2.0                     # mm: maximum travel, even if the axis allows more
{_STAGE_LINES}# pivot = [0.0, 0.0, 0.0]       # mm from the centre of the sheet: pivot of the body's rotation

[stage.travel]                  # mm, positive down, 0 where the skin is just above the object
letter = "Z"
direction = -1                  # this machine counts upwards
zero = -20.0                    # the machine's coordinate at which the travel is 0
# unit = "mm"
limits = [-10.0, 3.0]
speed = 5.0                     # mm/s
# steps = 250.0                 # per mm: required value of the controller's $102

[stage.pitch]                   # degrees, 0 upright; remove pitch and roll if the stage only presses
letter = "X"
direction = 1
zero = 0.0
# unit = "deg"
limits = [-5.0, 5.0]
speed = 20.0                    # degrees/s
# steps = 250.0

[stage.roll]
letter = "Y"
direction = 1
zero = 0.0
# unit = "deg"
limits = [-5.0, 5.0]
speed = 20.0
# steps = 250.0

# [stage.x]                     # mm to the right in the picture, 0 where the body is lowered
# letter = "A"
# direction = 1
# zero = 0.0
# unit = "mm"
# limits = [-2.0, 2.0]
# speed = 1.0                   # mm/s
# steps = 250.0

# [stage.y]                     # mm up the picture
# letter = "B"
# direction = 1
# zero = 0.0
# unit = "mm"
# limits = [-2.0, 2.0]
# speed = 1.0
# steps = 250.0

# [stage.twist]                 # degrees about the body's axis, counter-clockwise in the picture
# letter = "C"
# direction = 1
# zero = 0.0
# unit = "deg"
# limits = [-45.0, 45.0]
# speed = 20.0                  # degrees/s
# steps = 250.0

[camera]
source = 0                      # a camera's number, or in quotes a file, a URL, {_SERIALS}or a
                                # class of your own as "my_camera.py:MyCamera"
size = [640, 480]               # columns, rows
# name = "left"                 # name in recordings and calibrations; by default the source
# dtype = "uint8"
# fourcc = "GREY"
# exposure = 0.004              # s
# gain = 1.0
# rate = 60.0                   # Hz
# trigger = "coolant"           # or "spindle": the controller's output that triggers camera or lamp, in steps
# trigger_input = "Line0"       # the input of a {_TRIGGERED} camera to which this output is connected
# stall = 0.1                   # s without a frame, in motion, after which the stage is stopped
# delay = 0.03                  # s from the middle of the exposure to the arrival; measured for a stream
{_CAMERA_LINES}pixel_size = 0.03               # mm at the sheet
# dark = 12                     # counts without light, or a picture file
# bright = "bright.tif"         # counts in full light, or a picture file
# zenith_gain = 5.7             # counts per degree of zenith
# zenith_offset = 10            # counts at zenith 0
"""
"""A template of a rig file with every key."""
