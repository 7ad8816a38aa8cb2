"""A complete rig without hardware: the emulated stage moves, and the twin's camera watches."""

from __future__ import annotations

import functools
import json
import math
import os
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, suppress
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self, cast

import msgspec
import numpy as np
from numpy.typing import NDArray

from mirrorskin.hw.base.clock import SYSTEM, Clock
from mirrorskin.hw.base.emulated_file import Emulator
from mirrorskin.hw.base.rig_file import (
    CameraSettings,
    Line,
    RigFile,
    RigSettings,
    ShiftAxis,
    StageSettings,
    TiltAxis,
    TravelAxis,
    TwistAxis,
)
from mirrorskin.hw.base.stage import Position
from mirrorskin.hw.stages.grbl import GrblStage
from mirrorskin.io.base.system import translate_os_errors
from mirrorskin.io.base.types import Floats, InputError
from mirrorskin.io.storage.atomic import write_new
from mirrorskin.twin import Axial, Camera, Object, Twin, Vertical
from mirrorskin.twin.emulator.camera import TwinCamera, pose_at
from mirrorskin.twin.emulator.port import GrblLine, GrblMachine, GrblPort
from mirrorskin.twin.emulator.server import FrameServer
from mirrorskin.twin.movement import Movement, Pose
from mirrorskin.twin.slip import Grip

PRESS = 3.0
"""Maximum travel of the emulated stage, mm."""

TILT = 9.0
"""Maximum pitch and roll, degrees."""

SHIFT, TURN = 2.0, 45.0
"""Maximum displacement along x and y, mm, and maximum twist, degrees, in either direction."""

_SILENCE, _STALL = 0.07, 0.1  # silence of the emulators tolerated in motion, seconds
_SERVED = 0.5  # the same for emulators in another process, which competes for the processor
_TIMEOUT = 2.0  # maximum time for an answer of the emulated controller at rest, seconds
_LIFT = 4.0  # initial height of the body above the object, mm
_HIGHEST = 4.5  # maximum height of the body, mm
# GRBL's homing settings, in units per minute, ms and units; and for the axes X, Y, Z, A, B and C, which are
# pitch, roll, travel, x, y and twist: maximum speeds in mm or degrees per minute, accelerations, lengths.
_AXES = "XYZABC"
_HOMING = {24: 300.0, 25: 3000.0, 26: 10.0, 27: 0.5}
_SPEED = 1200.0, 1200.0, 600.0, 300.0, 300.0, 2400.0
_ACCELERATION = 800.0, 800.0, 400.0, 200.0, 200.0, 1600.0
_LENGTH = 20.0, 20.0, 10.0, 5.0, 5.0, 100.0
MACHINE = (
    _HOMING
    | dict(enumerate(_SPEED, 110))
    | dict(enumerate(_ACCELERATION, 120))
    | dict(enumerate(_LENGTH, 130))
)
"""The controller's ``$`` settings."""

_FILE, _REFERENCE = "rig.toml", "bright.npy"


class EmulatedRig:
    """A GRBL controller behind a terminal, its stage, and the twin; it runs inside ``with``.

    Initially the body is at rest, upright, 4 mm above the object. Faults of the ``machine``, and inside
    ``with`` of its ``port`` and of the ``camera``, can be triggered.

    Parameters
    ----------
    object : Object, str or Path
        Object under the sensor; see `Twin`.
    camera : Camera, optional
        Camera model of the twin; its frame rate is not used.
    rate : float
        Frames a second.
    delay, jitter : float
        Delay and jitter of the frames' arrival, seconds; see `TwinCamera`.
    seed : int
        Seed of noise and jitter.
    pivot : (float, float, float)
        Pivot of the rotation, from the rest sheet's centre, mm.
    trigger : str, optional
        The controller's output that triggers the camera, coolant or spindle; without it the camera runs
        freely.
    home : bool
        Whether the machine has switches and must be homed before it moves.
    machine : GrblMachine, optional
        Another controller with the settings ``MACHINE``, whose axes start at 0; it may lack axes.
    light : float
        Strength of the light: where it is above 1, full light is beyond the end of the camera's scale, unless
        the exposure is shortened. The rig file states exposure, levels and response for it.
    clock : Clock
        With a `SimulatedClock` waiting takes no time; the controller is then behind a line in memory.
    **scene
        Shape, pixel size, pattern, contact, optics and device: as for `Twin`.

    Examples
    --------
    >>> with EmulatedRig("coin", rate=60.0) as rig:  # doctest: +SKIP
    ...     rig.settings.stage.port
    '/dev/pts/3'
    """

    port: GrblLine
    camera: TwinCamera

    def __init__(
        self,
        object: Object | str | Path = "sphere",  # noqa: A002 - the word users know it by
        *,
        camera: Camera | None = None,
        rate: float = 30.0,
        delay: float = 0.0,
        jitter: float = 0.0,
        seed: int = 0,
        pivot: tuple[float, float, float] = (0.0, 0.0, 0.0),
        trigger: Line | None = None,
        home: bool = False,
        machine: GrblMachine | None = None,
        light: float = 1.0,
        clock: Clock = SYSTEM,
        **scene: Any,
    ) -> None:
        self._levels = replace(camera or Camera(), frame_rate=rate, seed=seed)
        of_twin: dict[str, Any] = {"shape": (240, 320), "pixel_size": 0.05, **scene}
        self._make = functools.partial(Twin, object=object, camera=self._levels, **of_twin)
        self._pivot, self._home, self._trigger, self._light = pivot, home, trigger, light
        self._seen = self._make(movement=_Anywhere(pivot))
        self._axes = _axes(home, _AXES if machine is None else machine.axes)
        start = {axis.letter: axis.zero for axis in self._axes.values()}
        start[self._axes["travel"].letter] += _LIFT
        self.machine: GrblMachine = machine or GrblMachine(
            {**MACHINE, 20: home, 22: home}, axes=_AXES, start=start, clock=clock
        )
        self._make_camera = functools.partial(
            TwinCamera,
            self._seen,
            self.where,
            delay=delay,
            jitter=jitter,
            seed=seed,
            pivot=pivot,
            light=light,
            clock=clock,
        )
        if trigger is not None:
            switched = functools.partial(self.machine.switched, trigger)
            self._make_camera = functools.partial(self._make_camera, trigger=switched)
        self.clock = clock
        self._leaving = ExitStack()

    def __enter__(self) -> Self:
        with ExitStack() as entering:
            self.port = GrblPort(self.machine) if self.clock is SYSTEM else GrblLine(self.machine)
            entering.enter_context(self.port)
            self.camera = self._make_camera()
            entering.callback(lambda: self.camera.close())
            self._leaving = entering.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None:
        self._leaving.close()

    def where(self, at: float) -> Position:
        """Return the true position of the body at a time of the clock."""
        at_machine = self.machine.position(at)
        return Position(**{name: axis.value(at_machine[axis.letter]) for name, axis in self._axes.items()})

    @property
    def grip(self) -> Grip:
        """The true force along the sheet and the slide in the newest frame; see `Twin.grip`."""
        return self._seen.grip

    def open_stage(self, settings: StageSettings, unlock: bool = False) -> GrblStage:
        """Open the emulated stage, or another one if the port differs; see ``rig.open_stage``."""
        port = self.port.open() if settings.port == self.port.url else None
        return GrblStage(settings, port, unlock=unlock, clock=self.clock)

    def open_camera(self, settings: CameraSettings) -> TwinCamera:
        """Restart the emulated camera, and return it; see ``rig.open_camera``."""
        self.camera.close()
        self.camera = self._make_camera()
        if settings.exposure is not None:
            self.camera.set_exposure(settings.exposure)
        return self.camera

    def twin(self, movement: Movement) -> Twin:
        """Return the same scene as a twin that is rendered directly, with the references of `references`.

        Its light is that of a ``light`` of 1.
        """
        return self._make(movement=movement, references="ball")

    def references(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return dark and bright references taken with a ball, (H, W), float32; see `Twin`."""
        header = self.twin(Vertical([0.0])).header
        assert header.dark is not None
        assert header.bright is not None
        return header.dark, header.bright

    @property
    def settings(self) -> RigSettings:
        """The contents of the rig file."""
        stage = StageSettings(
            port=self.port.url,
            home=self._home,
            timeout=_TIMEOUT,
            silence=_SILENCE,
            press=PRESS,
            pivot=self._pivot,
            **self._axes,
        )
        return RigSettings(Path("emulated"), "emulated rig", stage, self._camera_settings())

    def serve(self, port: int = 0) -> FrameServer:
        """Stream the camera's frames to other processes, until the returned server is closed."""
        return FrameServer(self.camera, self._seen.frame_rate, port)

    @staticmethod
    def check_folder(folder: Path) -> None:
        """Refuse a folder in which `write` must not replace a file.

        Raises
        ------
        InputError
            It contains a rig file or a ``bright.npy`` that the twin did not write, or an emulated rig that is
            still running uses it.
        """
        path, picture = folder / _FILE, folder / _REFERENCE
        with translate_os_errors(f"{path} cannot be read", "choose another folder with -o"):
            if not path.exists():
                if picture.exists():
                    raise InputError(f"{picture} exists. Delete it, or choose another folder with -o")
                return
            emulator = Emulator.read(path)
            if emulator is None or path.stat().st_uid != os.geteuid():
                raise InputError(
                    f"{path} is a rig file that mirrorskin did not write. Choose another folder with -o"
                )
        if emulator.running and emulator.process != os.getpid():
            raise InputError(
                f"{path}: an emulated rig is already running in this folder (process {emulator.process})."
                f" End it with 'kill {emulator.process}', or choose another folder with -o"
            )

    def write(self, folder: Path, source: str) -> Path:
        """Write ``rig.toml`` and the bright reference that it names; both are removed when the rig ends.

        Parameters
        ----------
        folder : Path
            Created if missing. Files of an emulated rig that was killed are replaced.
        source : str
            URL of the camera's stream; see `serve`.

        Returns
        -------
        Path
            The rig file. It appears complete, after everything else is ready.

        Raises
        ------
        InputError
            The folder cannot be written to, or contains other files of these names; see `check_folder`.
        """
        self.check_folder(folder)
        path, picture = folder / _FILE, folder / _REFERENCE
        settings, change = self.settings, msgspec.structs.replace
        measured = settings.camera.bright is not None
        bright = picture.name if measured else None
        camera = change(settings.camera, source=source, bright=bright, stall=max(_STALL, _SERVED))
        stage = change(settings.stage, silence=max(_SILENCE, _SERVED))
        file = RigFile(name=settings.name, stage=stage, camera=camera)
        text = "\n".join(_toml(msgspec.to_builtins(file)))
        emulator = Emulator.here(stage.port)
        with translate_os_errors(f"{folder} cannot be written to", "choose another folder with -o"):
            folder.mkdir(parents=True, exist_ok=True)
            self._leaving.callback(_remove, folder, emulator)
            if measured:
                array = BytesIO()
                np.save(array, self.references()[1])
                # it belongs to an emulated rig, as was checked
                write_new(picture, [array.getvalue()], replaces="anything")
            write_new(path, [f"{emulator.heading}{text}\n".encode()], replaces="anything")
        return path

    def _camera_settings(self) -> CameraSettings:
        header, levels = self._seen.header.exposed(self._light), self._levels
        gain, offset = (
            None if counts is None else float(np.mean(counts))
            for counts in (header.zenith_gain, header.zenith_offset)
        )
        bright = levels.dark + self._light * (levels.bright - levels.dark)
        rows, columns = self._seen.shape[1:]
        return CameraSettings(
            source=self._seen.name,
            size=(columns, rows),
            dtype=cast(Literal["uint8", "uint16", "float32"], self._seen.dtype.name),
            rate=self._seen.frame_rate,
            exposure=1 / self._seen.frame_rate,
            stall=_STALL,
            trigger=self._trigger,
            pixel_size=header.pixel_size,
            bright=bright if bright <= levels.top else None,
            zenith_gain=None if gain is None else gain * math.radians(1.0),
            zenith_offset=offset,
            name=header.camera,
        )


class _Anywhere(Axial):
    """Bounds the positions of the body: all phases of the lean, and the largest displacements and twists."""

    def __init__(self, pivot: tuple[float, float, float]) -> None:
        super().__init__(np.arange(8) * np.pi / 4, math.radians(math.hypot(TILT, TILT)), PRESS, pivot)

    def pose(self, place: Floats, /) -> Pose:
        """Return the pose at a phase, displaced to the limits and twisted."""
        phase, turn = float(place), math.radians(TURN)
        lean = self.tilt * math.cos(phase), self.tilt * math.sin(phase)
        x, y = np.sign(np.round([math.cos(phase), math.sin(phase)], 9)) * SHIFT
        return pose_at(Position(PRESS, *lean, x, y, turn * math.cos(4 * phase)), self.pivot)


def _remove(folder: Path, emulator: Emulator) -> None:
    """Remove the files that `EmulatedRig.write` wrote, unless those of another rig have replaced them."""
    path = folder / _FILE
    with suppress(OSError):
        if not path.exists() or Emulator.read(path) == emulator:
            path.unlink(missing_ok=True)
            (folder / _REFERENCE).unlink()


def _axes(home: bool, letters: str) -> dict[str, Any]:
    """Describe the axes: with homing they count from their upper end, otherwise from the initial position."""

    def zero(middle: float) -> float:
        return middle if home else 0.0

    upper = -_HIGHEST - 0.5 if home else -_LIFT
    pitch, roll = (
        TiltAxis(letter=letter, zero=zero(-10.0), limits=(-TILT, TILT), speed=20.0) for letter in ("X", "Y")
    )
    x, y = (
        ShiftAxis(letter=letter, zero=zero(-2.5), limits=(-SHIFT, SHIFT), speed=5.0) for letter in ("A", "B")
    )
    twist = TwistAxis(letter="C", zero=zero(-50.0), limits=(-TURN, TURN), speed=40.0)
    travel = TravelAxis(letter="Z", direction=-1, zero=upper, limits=(-_HIGHEST, PRESS), speed=10.0)
    axes = {"travel": travel, "pitch": pitch, "roll": roll, "x": x, "y": y, "twist": twist}
    return {name: axis for name, axis in axes.items() if axis.letter in letters}


def _toml(table: Mapping[str, Any], name: str = "") -> Iterator[str]:
    """Yield the lines of a table and of its sub-tables; JSON values are valid TOML."""
    if name:
        yield f"\n[{name}]"
    for key, value in table.items():
        if value is not None and not isinstance(value, dict):
            yield f"{key} = {json.dumps(value, ensure_ascii=False)}"
    for key, value in table.items():
        if isinstance(value, dict):
            yield from _toml(value, f"{name}.{key}".lstrip("."))
