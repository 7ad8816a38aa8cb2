"""The twin's camera: each pixel's levels, noise and quantisation."""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mirrorskin.io.base.types import FRAME_DTYPES, InputError
from mirrorskin.kernels.device import C_TYPES, Device, open_device
from mirrorskin.twin.body import check_values

_UINT8: np.dtype[Any] = np.dtype(np.uint8)
_DARK, _BRIGHT = 16.0, 224.0  # counts of 8 bits
_BITS = {"uint8": (8,), "uint16": (12, 10, 16), "float32": ()}  # the default first
_LEAST_GAIN = 0.05  # relative to the nominal gain; a pixel with less would be a defect
_NOISE_MAX = 2.0**16
_ELECTRONS_MIN = 1e-3
_SPREAD_MAX = 100.0
_WORD = 2**64
_MAPS = 0x6D617073  # separates the random stream of the pixels' deviations from others of the same seed


@dataclass(frozen=True, slots=True)
class Camera:
    """The model of a camera; its noise depends only on the seed, the frame's number and the pixel.

    Attributes
    ----------
    dtype : dtype
        Of a sample: uint8, uint16 or float32.
    noise : float
        Standard deviation of the read noise, raw counts.
    seed : int
        From 0 to 2^64 - 1.
    bits : int
        Of a sample: 8 for uint8; 12 unless given, 10 or 16 for uint16. None for float32, which is neither
        rounded nor clipped.
    electrons : float
        Electrons of one count of light, of this camera's own bits, 0.001 or more: a signal of S counts has
        shot noise of the variance S / electrons. Infinite for none.
    gain_deviation : float
        Relative standard deviation of the pixels' gains; below 1. Gains are at least 0.05.
    offset_deviation : float
        Standard deviation of the pixels' counts without light.
    frame_rate : float
        Frames per second.
    exposure : float
        Seconds during which a frame gathers light, at most a frame's; 0: the body stands still meanwhile.
        The mean of 5 poses stands for the light of a body that moves; of a vertical press in `conform` and
        `ideal` it is exact.
    point_spread : float
        Standard deviation of a point's Gaussian image, pixels.
    distance : float
        Millimetres of the pinhole above the sheet's rest plane; infinite for a telecentric lens.

    Raises
    ------
    InputError
        A value is invalid.
    """

    dtype: np.dtype[Any] = _UINT8
    noise: float = 1.5
    seed: int = 0
    _: KW_ONLY
    bits: int | None = None
    electrons: float = math.inf
    gain_deviation: float = 0.0
    offset_deviation: float = 0.0
    frame_rate: float = 30.0
    exposure: float = 0.0
    point_spread: float = 0.0
    distance: float = math.inf

    def __post_init__(self) -> None:
        kind = frame_dtype(self.dtype)
        choices = _BITS[kind.name]
        bits = choices[0] if self.bits is None and choices else self.bits
        if bits is not None and bits not in choices:
            remedy = f"take {', '.join(map(str, sorted(choices)))}" if choices else "leave them out"
            raise InputError(f"frames of {kind.name} cannot have {bits} bits: {remedy}")
        object.__setattr__(self, "dtype", kind)
        object.__setattr__(self, "bits", bits)
        period = 1 / self.frame_rate if self.frame_rate > 0 else 0.0
        whole = isinstance(self.seed, int | np.integer)
        rules = {
            "noise": (0 <= self.noise <= _NOISE_MAX, "its standard deviation in counts, 0 to 65536"),
            "seed": (whole and 0 <= self.seed < _WORD, "a whole number, 0 or more, of 64 bits"),
            "electrons": (self.electrons >= _ELECTRONS_MIN, "electrons per count of light, 0.001 or more"),
            "gain_deviation": (
                0 <= self.gain_deviation < 1,
                "a share of the gain, 0 or more and less than 1",
            ),
            "offset_deviation": (0 <= self.offset_deviation <= _NOISE_MAX, "counts, 0 to 65536"),
            "frame_rate": (0 < self.frame_rate < math.inf, "frames in a second, more than 0"),
            "exposure": (0 <= self.exposure <= period, f"seconds, 0 to a frame's {period:.6g}"),
            "point_spread": (0 <= self.point_spread <= _SPREAD_MAX, "pixels, 0 to 100"),
            "distance": (self.distance > 0, "millimetres above the sheet, more than 0"),
        }
        check_values(self, "camera", rules)

    @property
    def dark(self) -> float:
        """Nominal counts without light."""
        return _DARK * self._scale

    @property
    def bright(self) -> float:
        """Nominal counts in full light."""
        return _BRIGHT * self._scale

    @property
    def top(self) -> float:
        """The largest count; infinite for float32."""
        return math.inf if self.bits is None else 2.0**self.bits - 1

    @property
    def _scale(self) -> float:
        return 1.0 if self.bits is None else 2.0 ** (self.bits - 8)


class Sensor:
    """The pixels of a camera, on a device: they turn light into counts.

    A pixel's counts are ``offset + (full - offset) light`` and noise; integers are rounded, half to even, and
    clipped to the camera's bits. ``offset`` and ``full``, (H, W), are each pixel's exact counts without light
    and in full light.
    """

    camera: Camera
    dtype: np.dtype[Any]
    offset: NDArray[np.float32]

    def __init__(self, camera: Camera, shape: tuple[int, int], device: str | Device | None = None) -> None:
        self.camera, self.dtype = camera, camera.dtype
        self.device: Device = open_device(device)
        self.offset, span = _levels(camera, shape)
        self.full: NDArray[Any] = self.offset + span
        self.offset.flags.writeable = self.full.flags.writeable = False
        self._shape, self._pixels = shape, shape[0] * shape[1]
        self._quarter = -(-self._pixels // 4)  # the generator produces four numbers at a time
        size = (4 * self._quarter,)
        self._light = self.device.array("light", size, np.float32)
        self._offset = self.device.array("offset", size, np.float32)
        self._span = self.device.array("span", size, np.float32)
        self._counts = self.device.array("counts", size, self.dtype)
        for array, values in ((self._offset, self.offset), (self._span, span)):
            array.write(values.ravel())

    def expose(self, light: NDArray[np.float32], frame: int, out: NDArray[Any]) -> None:
        """Write one frame for the mean light over its exposure.

        The frame's number, a 64-bit integer, determines the noise; negative numbers can be used for frames
        outside the stack.
        """
        self._light.write(self._spread(np.broadcast_to(light, self._shape)).ravel())
        camera, quarter = self.camera, self._quarter
        kernel = self.device.kernel(
            "exposure",
            "expose",
            FRAME=C_TYPES[self.dtype.name],
            WHOLE=int(camera.bits is not None),
            SHOT=int(math.isfinite(camera.electrons)),
        )
        kernel(
            -(-quarter // self.device.layout.tile),
            light=self._light,
            offset=self._offset,
            span=self._span,
            quarter=quarter,
            frame=int(frame) % _WORD,
            seed=camera.seed,
            read=camera.noise,
            grain=1 / camera.electrons,
            top=camera.top,
            counts=self._counts,
            moved=self._pixels * (3 * 4 + self.dtype.itemsize),
        )
        out[...] = self._counts.read()[: self._pixels].reshape(self._shape)

    def _spread(self, light: NDArray[np.float32]) -> NDArray[np.float32]:
        """Blur light by the lens; values at the picture's edge continue beyond it."""
        if self.camera.point_spread == 0:
            return light
        import cv2

        sigma = self.camera.point_spread
        edge = cv2.BORDER_REPLICATE
        return np.asarray(
            cv2.GaussianBlur(light, (0, 0), sigmaX=sigma, sigmaY=sigma, borderType=edge), light.dtype
        )


def frame_dtype(dtype: DTypeLike) -> np.dtype[Any]:
    """Return the dtype of frames that a user specified; InputError if it is not supported."""
    try:
        kind = np.dtype(dtype)
    except TypeError:
        kind = np.dtype(object)
    if kind not in FRAME_DTYPES:
        raise InputError(
            f"frames cannot be {dtype}: take {', '.join(allowed.name for allowed in FRAME_DTYPES)}"
        )
    return kind


def _levels(camera: Camera, shape: tuple[int, int]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Draw each pixel's counts without light, and their increase in full light."""
    generator = np.random.default_rng((camera.seed, _MAPS))
    gain = 1 + camera.gain_deviation * generator.standard_normal(shape)
    offset = camera.dark + camera.offset_deviation * generator.standard_normal(shape)
    span = (camera.bright - camera.dark) * np.maximum(gain, _LEAST_GAIN)
    return offset.astype(np.float32), span.astype(np.float32)
