"""Registration of axial frames: resampling that compensates the motion of the object in the picture."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.base.frames import check_dtype
from mirrorskin.engine.base.sources import DerivedSource
from mirrorskin.io import Block, Header, InputError, Source, pixel_axes
from mirrorskin.io.base.types import block_memory
from mirrorskin.io.model.positions import check_phase
from mirrorskin.io.watch.traces import FrameSamples
from mirrorskin.kernels.device import C_TYPES, Device, open_device
from mirrorskin.kernels.rotation.registration import BORDER

_BLOCK = 16_000_000  # bytes of the source's frames that are read at once


@dataclass(frozen=True, slots=True)
class Sight:
    """Inclination of lines of sight towards an axis: ``lean``, mm per mm of height and mm from the axis."""

    lean: float
    axis: tuple[float, float]


class Registered(DerivedSource):
    """A source's frames, resampled as float32 so that each pixel shows one point of the object in all frames.

    This is the point that the pixel shows in the mean pose, pressed and upright: p = (x, y, height + press)
    in the body's coordinates, whose plane z = 0 is the sheet's rest plane. The body turns about the pivot q;
    at the phase alpha, the point is at ::

        p' = q + Rz(alpha) Ry(tilt) Rz(-alpha) (p - q)

    and a camera that looks straight down shows it at the pixel (p'.x, p'.y). It moves along the direction
    alpha only ::

        (p'.x, p'.y) = (x, y) + (sin(tilt) (p.z - q.z) - (1 - cos(tilt)) u) (cos(alpha), sin(alpha))

    with u = (x - q.x) cos(alpha) + (y - q.y) sin(alpha). At this pixel, eq. 10 of the paper holds for the
    normal in the mean pose.

    If the lines of sight are inclined towards an axis, by k per millimetre of distance, the point p is at the
    pixel X with (p.x, p.y) = X - k p.z (X - axis). To first order in k, the pixel's shift has an additional
    term ::

        k (p'.z - p.z) (X - axis) + k p.z (p' - p)

    A sample is interpolated from the 16 nearest pixels; see `kernels/rotation/registration.py`. It is NaN
    if any of these is outside the picture, clipped (at either end of an integer type) or not finite, or if
    the height is NaN. If ``zenith_gain`` and ``zenith_offset`` are maps, counts are converted to the scale
    of the output pixel; a pixel without a scale, such as a defect, gets the mean of two opposite
    neighbours.

    The sheet is assumed to touch all points in every pose, and no point to be hidden: a mirror skin conforms
    to the object, and a camera along the body's axis sees all parts that do not overhang.

    Attributes
    ----------
    phase : ndarray, (T,), float64, or None
        The phases of the source, if it has them in advance.
    """

    def __init__(
        self,
        source: Source,
        heights: ArrayLike,
        *,
        header: Header | None = None,
        sight: Sight | None = None,
        device: str | Device | None = None,
    ) -> None:
        super().__init__(source)
        check_dtype(source.dtype)
        self.header, self.dtype = header or source.header, np.dtype(np.float32)
        header = self.header
        self._geometry = _Geometry.of(source, header, sight)
        height = check_heights(heights, source.shape[1:])
        self.phase: NDArray[np.float64] | None = getattr(source, "phase", None)
        self.device: Device = open_device(device)
        rows, columns = self.shape[1:]
        offset, gain = _levels(header, (rows, columns))
        integer = source.dtype.kind == "u"
        self._macros: dict[str, str | int] = {
            "FRAME": C_TYPES[source.dtype.name],
            "LEVELS": int(offset.size > 1),
            **({"TOP": int(np.iinfo(source.dtype).max)} if integer else {}),
            **({"CURVED": 1} if sight is not None else {}),
        }
        padding = np.full((rows + 2 * BORDER, columns + 2 * BORDER), np.nan, np.float32)
        self._maps = {
            "padded": self.device.from_host("padded", padding),
            "offset": self.device.from_host("offset", offset),
            "gain": self.device.from_host("gain", gain),
        }
        self._height = self.device.from_host("height", height)
        places = _interpolated_pixels(offset, gain)
        self._places = self.device.from_host("places", places, np.int32) if len(places) else None
        self._noise = self.device.from_host("noise", np.zeros((2, rows, columns), np.float32))
        self._shift = self.device.array("shift", (2, 4 if sight is None else 7), np.float32)
        self._frame = self.device.array("frame", (rows, columns), source.dtype)
        self._registered = self.device.array("registered", (rows, columns), np.float32)
        length = _BLOCK // (rows * columns * source.dtype.itemsize)
        self._room = np.empty((min(max(1, length), self.shape[0]), rows, columns), source.dtype)
        self._original = FrameSamples(self.shape)

    @property
    def noise_gain(self) -> NDArray[np.float32]:
        """Factor of the noise of a sample, (H, W), RMS over the frames so far; NaN without a sample.

        It assumes that the noise of the source's pixels is independent, and equal on their common scale. The
        noise of registered neighbours is correlated.
        """
        squares, count = self._noise.read()
        gain: NDArray[np.float32] = np.sqrt(squares / np.where(count > 0, count, np.float32(np.nan)))
        return gain

    def shows_compression(self) -> bool:
        """Return whether the frames so far, before they were interpolated, show a compression with a loss.

        Interpolation changes the noise, by the fraction of a pixel that each point moves.
        """
        return self._original.compression(self.motion)

    def rewind(self) -> None:
        """Go back to the first frame, and forget the noise."""
        self._source.rewind()
        self._original = FrameSamples(self.shape)
        self._noise.fill()

    def read(self, out: NDArray[Any] | None = None, /) -> Block | None:
        """Read the next frames and resample them; see ``Source.read``."""
        out = block_memory(out, self.shape, self.dtype)
        block = self._source.read(self._room[: len(out)])
        if block is None:
            return None
        count = len(block.frames)
        self._original.push(block.frames)
        phases = check_phase(block.phase, count, f"{self.name}: the phase of frames from {block.index} on")
        for frame, phase, registered in zip(block.frames, phases, out, strict=False):
            self._shift.write(self._geometry.shift(float(phase)))
            self._frame.write(frame)
            self._resample()
            registered[:] = self._registered.read()
        return replace(block, frames=out[:count], stays_valid=False)

    def _resample(self) -> None:
        """Resample the frame on the device."""
        rows, columns = self.shape[1:]
        tile, size = self.device.layout.tile, self._registered.nbytes
        items = rows * -(-columns // tile)
        common: dict[str, Any] = {"rows": rows, "columns": columns, **self._maps}
        pad, interpolate, resample = (
            self.device.kernel("registration", f"registration_{name}", **self._macros)
            for name in ("admit", "mend", "resample")
        )
        pad(items, **common, frame=self._frame, moved=self._frame.nbytes + size)
        if self._places is not None:
            count, padded = self._places.shape[0], self._maps["padded"]
            interpolate(-(-count // tile), count=count, places=self._places, padded=padded, moved=36 * count)
        resample(
            items,
            **common,
            height=self._height,
            shift=self._shift,
            registered=self._registered,
            noise=self._noise,
            moved=7 * size,
        )


@dataclass(frozen=True, slots=True)
class _Geometry:
    """Motion of the object's points in the picture as the body tilts; lengths in mm, the tilt in radians."""

    corner: tuple[float, float]  # x and y of the first pixel
    pixel_size: tuple[float, float]
    tilt: float
    press: float
    pivot: tuple[float, float, float]
    sight: Sight | None

    @classmethod
    def of(cls, source: Source, header: Header, sight: Sight | None) -> Self:
        if source.motion != "axial":
            raise InputError(f"{source.name} has {source.motion} motion: only axial ones can be registered")
        pixel_size, tilt, press, pivot = (
            _required(source, header, name) for name in ("pixel_size", "tilt", "press", "pivot")
        )
        x, y = pixel_axes(source.shape[1:], pixel_size)
        return cls((float(x[0]), float(y[0])), pixel_size, tilt, press, pivot, sight)

    def shift(self, phase: float) -> NDArray[np.float32]:
        """Return the shifts of the points at a phase, as required by ``registration_resample``."""
        cosine, sine = math.cos(phase), math.sin(phase)
        along_x, along_y = self.pixel_size
        rise, drop = math.sin(self.tilt), 2 * math.sin(self.tilt / 2) ** 2
        outwards = (self.corner[0] - self.pivot[0]) * cosine + (self.corner[1] - self.pivot[1]) * sine
        # Shift along the phase's direction, mm: a constant, and terms per column, row and mm of height.
        moved = [
            rise * (self.press - self.pivot[2]) - drop * outwards,
            -drop * along_x * cosine,
            drop * along_y * sine,
            rise,
        ]
        if self.sight is None:
            return np.outer([cosine / along_x, -sine / along_y], moved).astype(np.float32)
        lean = self.sight.lean
        moved[0] += lean * rise * self.press * (self.press - self.pivot[2])
        moved[3] += lean * rise * (2 * self.press - self.pivot[2])
        # Rise of the point; times the lean, it is the pixel's shift per mm of distance from the axis.
        up = -rise * outwards - drop * (self.press - self.pivot[2])
        shifts = self._radial(lean * up, -lean * rise * along_x * cosine, lean * rise * along_y * sine)
        shifts[:, :4] += np.outer([cosine, sine], moved)
        return np.asarray(shifts / [[along_x], [-along_y]], np.float32)

    def _radial(self, number: float, column: float, row: float) -> NDArray[np.float64]:
        """Return the shift, mm, of pixels that move in proportion to their distance from the axis, (2, 7)."""
        assert self.sight is not None
        x, y = (corner - axis for corner, axis in zip(self.corner, self.sight.axis, strict=True))
        along_x, along_y = self.pixel_size
        return np.array(
            [
                [x * number, x * column + along_x * number, x * row, 0, along_x * column, along_x * row, 0],
                [y * number, y * column, y * row - along_y * number, 0, 0, -along_y * column, -along_y * row],
            ]
        )


def _interpolated_pixels(offset: NDArray[np.float32], gain: NDArray[np.float32]) -> NDArray[np.int32]:
    """Return the pixels without a scale between two pixels with one, (n, 5), for ``registration_mend``.

    These two are opposite neighbours, so that a slope cancels: left and right or above and below, otherwise
    the corners.
    """
    sound = np.pad(np.isfinite(offset) & np.isfinite(gain) & (gain != 0), BORDER)
    stride = sound.shape[1]
    flat = sound.reshape(-1)
    lost = np.flatnonzero(~flat)
    lost = lost[(lost > stride) & (lost < flat.size - stride - 1)]
    chosen = np.zeros((2, len(lost)), np.intp)
    for step in (stride + 1, stride - 1, stride, 1):  # in increasing order of preference
        both = flat[lost - step] & flat[lost + step]
        chosen = np.where(both, [np.full(len(lost), step), np.where(chosen[0] > 0, chosen[0], step)], chosen)
    usable = chosen[0] > 0
    lost, (first, second) = lost[usable], chosen[:, usable]
    return np.stack([lost, lost - first, lost + first, lost - second, lost + second], axis=1).astype(np.int32)


def _required(source: Source, header: Header, name: str) -> Any:
    """Return a value of a header; InputError if it is missing or not finite."""
    value = getattr(header, name)
    words = name.replace("_", " ")
    if value is None:
        raise InputError(
            f"{source.name} has no {words}, which registration needs: record it with pixel size, tilt, press"
            " and pivot"
        )
    if not np.isfinite(value).all():
        raise InputError(f"{source.name}: {words} is {value}: registration needs finite numbers")
    return value


def check_heights(heights: ArrayLike, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Return a map of the frames' size, float32, or raise InputError."""
    values = np.asarray(heights)
    if values.dtype.kind not in "iuf":
        raise InputError(f"heights are of type {values.dtype}: give millimetres")
    if values.shape != shape:
        raise InputError(
            f"heights have shape {values.shape}, the frames are {shape[0]} x {shape[1]}:"
            " give a map of the frames' size"
        )
    if not np.isfinite(values).any():
        raise InputError("no height is a number: give a map of the object's surface in mm")
    return values.astype(np.float32)


def _levels(header: Header, shape: tuple[int, int]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the offset and gain of each pixel; 0 and 1, (1, 1), if all pixels have the same."""
    offset = np.asarray(0.0 if header.zenith_offset is None else header.zenith_offset)
    gain = np.asarray(1.0 if header.zenith_gain is None else header.zenith_gain)
    if (offset == offset.flat[0]).all() and (gain == gain.flat[0]).all():
        return np.zeros((1, 1), np.float32), np.ones((1, 1), np.float32)
    gain = np.where(np.isfinite(gain) & (gain != 0), gain, np.nan)
    offset, gain = np.broadcast_to(offset, shape), np.broadcast_to(gain, shape)
    return offset.astype(np.float32), gain.astype(np.float32)
