"""The twin's camera: levels, noise and quantisation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mirrorskin.io.types import FRAME_DTYPES, InputError

FRAME_RATE = 30.0

_LEVELS = {"uint8": (16.0, 224.0), "uint16": (256.0, 3584.0), "float32": (16.0, 224.0)}


@dataclass(frozen=True, slots=True)
class Camera:
    """A camera with additive Gaussian noise that depends on nothing but the seed and the frame's number.

    Attributes
    ----------
    dtype : dtype
        Of a sample: uint8, uint16 or float32.
    noise : float
        Standard deviation in raw counts.
    seed : int
        Not negative.

    Raises
    ------
    InputError
        The noise is negative or not finite, or the seed is negative.
    """

    dtype: np.dtype[Any]
    noise: float = 1.5
    seed: int = 0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.noise) and self.noise >= 0):
            raise InputError(
                f"noise {self.noise} cannot be: give its standard deviation in counts, 0 or more"
            )
        if self.seed < 0:
            raise InputError(f"seed {self.seed} cannot be: give a whole number, 0 or more")

    @property
    def dark(self) -> float:
        """Counts without light."""
        return _LEVELS[self.dtype.name][0]

    @property
    def bright(self) -> float:
        """Counts in full light."""
        return _LEVELS[self.dtype.name][1]

    def expose(self, counts: NDArray[np.float32], frame: int, out: NDArray[Any]) -> None:
        """Write one frame: counts with noise; integer types are rounded and clipped to their range.

        Parameters
        ----------
        counts : ndarray, (H, W), float32
            What a noise-free camera would see.
        frame : int
            Its number in the stack; with the seed it decides the noise.
        out : ndarray, (H, W), the camera's dtype
            Where to write.
        """
        if self.noise > 0:
            generator = np.random.default_rng((self.seed, frame))
            counts = counts + self.noise * generator.standard_normal(counts.shape, dtype=np.float32)
        if self.dtype.kind == "u":
            counts = np.clip(np.rint(counts), 0, np.iinfo(self.dtype).max)
        out[...] = counts


def frame_dtype(dtype: DTypeLike) -> np.dtype[Any]:
    """Return the dtype of frames that a user named; InputError if frames cannot be of that type."""
    try:
        kind = np.dtype(dtype)
    except TypeError:
        kind = np.dtype(object)
    if kind not in FRAME_DTYPES:
        raise InputError(f"frames cannot be {dtype}: take {', '.join(known.name for known in FRAME_DTYPES)}")
    return kind
