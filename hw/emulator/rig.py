"""A whole rig without hardware: the emulated stage moves, and the twin's camera sees it."""

from __future__ import annotations

import functools
import json
import math
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from mirrorskin.hw.emulator.camera import TwinCamera
from mirrorskin.hw.emulator.port import GrblMachine, GrblPort
from mirrorskin.hw.emulator.server import FrameServer
from mirrorskin.hw.rig_file import Axis, CameraSettings, RigSettings, StageSettings
from mirrorskin.hw.stage import Position
from mirrorskin.hw.twin import Axial, Body, Camera, ContactName, Object, OpticsName, Twin, Vertical
from mirrorskin.hw.twin.movement import Movement
from mirrorskin.io.types import InputError

PRESS = 3.0
"""Greatest travel that the emulated stage allows, mm."""

TILT = math.radians(9.0)
"""Greatest pitch and roll, radians."""

_LIFT = 4.0  # how far above the object the body begins, mm
_HIGHEST = 4.5  # and how far it can be lifted
_BAUD = 115200
_SPEEDS = {"tilt": math.radians(20.0), "travel": 10.0}  # rad/s, mm/s
# What GRBL is told of homing, in units a minute, ms and units; and of its axes X, Y, Z, which are pitch, roll
# (these count degrees) and travel: greatest speeds in units a minute, accelerations, lengths.
_HOMING = {24: 300.0, 25: 3000.0, 26: 10.0, 27: 0.5}
_SPEED, _ACCELERATION, _LENGTH = (1200.0, 1200.0, 600.0), (800.0, 800.0, 400.0), (20.0, 20.0, 10.0)
_MACHINE = (
    _HOMING
    | dict(enumerate(_SPEED, 110))
    | dict(enumerate(_ACCELERATION, 120))
    | dict(enumerate(_LENGTH, 130))
)


class EmulatedRig:
    """A GRBL controller behind a terminal, its stage, and the twin on it; it runs within ``with``.

    The body begins at rest, upright, 4 mm above the object.

    Parameters
    ----------
    object : Object, str or Path
        What lies under the sensor; see `Twin`.
    shape : (int, int)
        Rows and columns.
    pixel_size : float or (float, float)
        Millimetres.
    pattern, contact, optics, body
        As for `Twin`.
    camera : Camera, optional
        What the twin's frames are like; its frame rate is not used.
    rate : float
        Frames a second.
    delay, jitter : float
        Of the frames' arrival, seconds; see `TwinCamera`.
    seed : int
        Of noise and jitter.
    pivot : (float, float, float)
        What the body turns about, from the rest sheet's centre, mm.
    home : bool
        Whether the machine has switches, and must find them before it moves.
    device : str or Device, optional
        What renders.

    Attributes
    ----------
    machine : GrblMachine
    port : GrblPort
    camera : TwinCamera
        Both from the entering on. Their faults can be asked for.
    settings : RigSettings
        What a rig file would say, from the entering on; the bright reference is the nominal one.

    Raises
    ------
    InputError
        A value cannot be.
    """

    port: GrblPort
    camera: TwinCamera

    def __init__(
        self,
        object: Object | str | Path = "sphere",  # noqa: A002 - the word users know it by
        *,
        shape: tuple[int, int] = (240, 320),
        pixel_size: float | tuple[float, float] = 0.05,
        pattern: str | Path = "uniform",
        contact: ContactName = "conform",
        optics: OpticsName = "ideal",
        body: Body | None = None,
        camera: Camera | None = None,
        rate: float = 30.0,
        delay: float = 0.0,
        jitter: float = 0.0,
        seed: int = 0,
        pivot: tuple[float, float, float] = (0.0, 0.0, 0.0),
        home: bool = False,
        device: str | None = None,
    ) -> None:
        self._levels = replace(camera or Camera(), frame_rate=rate, seed=seed)
        self._make = functools.partial(
            Twin,
            object=object,
            shape=shape,
            pixel_size=pixel_size,
            pattern=pattern,
            contact=contact,
            optics=optics,
            body=body,
            camera=self._levels,
            device=device,
        )
        self._pivot, self._home = pivot, home
        farthest = Axial(np.arange(8) * np.pi / 4, math.hypot(TILT, TILT), PRESS, pivot)
        self._seen = self._make(movement=farthest)
        self._axes = _axes(home)
        start = {axis.letter: axis.zero for axis in self._axes.values()}
        start[self._axes["travel"].letter] += _LIFT
        self.machine = GrblMachine({**_MACHINE, 20: home, 22: home}, start=start)
        self._make_camera = functools.partial(
            TwinCamera, self._seen, self.where, delay=delay, jitter=jitter, seed=seed, pivot=pivot
        )
        self._leaving = ExitStack()

    def __enter__(self) -> Self:
        with ExitStack() as entering:
            self.port = entering.enter_context(GrblPort(self.machine))
            self.camera = self._make_camera()
            entering.callback(self.camera.close)
            self._leaving = entering.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None:
        self._leaving.close()

    def where(self, at: float) -> Position:
        """Tell where the body truly is at a time of `time.monotonic`."""
        at_machine = self.machine.position(at)
        return Position(**{name: axis.value(at_machine[axis.letter]) for name, axis in self._axes.items()})

    def twin(self, movement: Movement) -> Twin:
        """Make the same scene as a twin that is rendered directly; its references are `references`."""
        return self._make(movement=movement, references="ball")

    def references(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Take dark and bright references with a ball, as a lab does, (H, W), float32; see `Twin`."""
        header = self.twin(Vertical([0.0])).header
        dark, bright = header.dark, header.bright
        assert dark is not None and bright is not None  # noqa: PT018 - a twin has both
        return dark, bright

    @property
    def settings(self) -> RigSettings:
        """What a rig file would say."""
        stage = StageSettings(
            port=self.port.url,
            baud=_BAUD,
            home=self._home,
            timeout=2.0,
            report_rate=20.0,
            press=PRESS,
            pivot=self._pivot,
            **self._axes,
        )
        return RigSettings(Path("emulated"), "emulated rig", stage, self._camera_settings())

    def serve(self, port: int = 0) -> FrameServer:
        """Stream the camera's frames to other processes, until what is returned is closed."""
        return FrameServer(self.camera, self._seen.frame_rate, port)

    def write(self, folder: Path, source: str) -> Path:
        """Write a rig file and the bright reference, with the stream's URL as camera; see `write_rig`."""
        settings = self.settings
        camera = replace(settings.camera, source=source)
        return write_rig(replace(settings, camera=camera), self.references()[1], folder)

    def _camera_settings(self) -> CameraSettings:
        header = self._seen.header
        gain, offset = (
            None if counts is None else float(np.mean(counts))
            for counts in (header.zenith_gain, header.zenith_offset)
        )
        return CameraSettings(
            source=self._seen.name,
            shape=self._seen.shape[1:],
            dtype=self._seen.dtype,
            rate=self._seen.frame_rate,
            pixel_size=header.pixel_size,
            bright=self._levels.bright,
            zenith_gain=gain,
            zenith_offset=offset,
            name=header.camera,
        )


def _axes(home: bool) -> dict[str, Axis]:
    """Describe the axes: one that has homed counts from its upper end, another from where it began."""
    middle, upper = (-10.0, -_HIGHEST - 0.5) if home else (0.0, -_LIFT)
    return {
        "travel": Axis("Z", -1, upper, -_HIGHEST, PRESS, _SPEEDS["travel"], "mm"),
        "pitch": Axis("X", 1, middle, -TILT, TILT, _SPEEDS["tilt"], "deg"),
        "roll": Axis("Y", 1, middle, -TILT, TILT, _SPEEDS["tilt"], "deg"),
    }


_FIRST = "# An emulated rig; it is there as long as the program that wrote this runs.\n"


def write_rig(settings: RigSettings, bright: NDArray[np.float32], folder: Path) -> Path:
    """Write ``rig.toml``, and the bright reference as ``bright.npy`` beside it.

    Parameters
    ----------
    settings : RigSettings
        What to write but the references; see ``docs/rig.md`` for the keys.
    bright : ndarray, (H, W), float32
        Counts in full light.
    folder : Path
        Made where it is missing. Files of an emulated rig that was there before are replaced.

    Returns
    -------
    Path
        The rig file.

    Raises
    ------
    InputError
        The folder cannot be written to, or has a rig file of someone else's.
    """
    path, picture = folder / "rig.toml", folder / "bright.npy"
    try:
        if path.exists() and not path.read_text(errors="replace").startswith(_FIRST):
            raise InputError(f"{path} is a rig file that someone else wrote: name another folder with -o")
        folder.mkdir(parents=True, exist_ok=True)
        np.save(picture, bright)
        camera = replace(settings.camera, bright=Path(picture.name))
        path.write_text(_FIRST + _text(replace(settings, camera=camera)))
    except OSError as error:
        raise InputError(f"{folder} cannot be written to: {error.strerror}; name another with -o") from None
    return path


def _text(settings: RigSettings) -> str:
    stage, camera = settings.stage, settings.camera
    tables: dict[str, dict[str, object]] = {
        "": {"name": settings.name},
        "stage": {
            "port": stage.port,
            "baud": stage.baud,
            "home": stage.home,
            "timeout": stage.timeout,
            "report_rate": stage.report_rate,
            "press": stage.press,
            "pivot": stage.pivot,
        },
        **{f"stage.{name}": _axis(axis) for name, axis in stage.axes.items()},
        "camera": {
            "name": camera.name,
            "source": camera.source,
            "size": camera.shape[::-1],
            "dtype": camera.dtype.name,
            "rate": camera.rate,
            "delay": camera.delay,
            "pixel_size": camera.pixel_size,
            "dark": camera.dark,
            "bright": camera.bright,
            "zenith_gain": None if camera.zenith_gain is None else camera.zenith_gain * math.radians(1.0),
            "zenith_offset": camera.zenith_offset,
        },
    }
    return "\n".join(
        (f"[{table}]\n" if table else "")
        + "".join(f"{key} = {_value(value)}\n" for key, value in said.items() if value is not None)
        for table, said in tables.items()
    )


def _axis(axis: Axis) -> dict[str, object]:
    """Tell an axis in its own unit."""
    scale = axis.scale
    return {
        "letter": axis.letter,
        "direction": axis.direction,
        "zero": axis.zero,
        "unit": axis.unit,
        "limits": (round(axis.low * scale, 9), round(axis.high * scale, 9)),
        "speed": round(axis.speed * scale, 9),
    }


def _value(value: object) -> str:
    """Write a value in TOML: what JSON writes of text, numbers and lists is TOML as well."""
    return json.dumps(str(value) if isinstance(value, Path) else value, ensure_ascii=False)
