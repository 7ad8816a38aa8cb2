"""What a rig file says: the stage's axes, the camera, and how both are opened."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mirrorskin.hw.stage import Limits


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
