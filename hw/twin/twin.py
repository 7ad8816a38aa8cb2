"""The twin as a source of frames: press the sheet on an object and watch."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from mirrorskin.hw.twin.camera import FRAME_RATE, Camera, frame_dtype
from mirrorskin.hw.twin.objects.shapes import make_object
from mirrorskin.hw.twin.optics.ideal import uniform_response
from mirrorskin.hw.twin.objects.surface import Object, zenith_azimuth
from mirrorskin.io import check_stroke
from mirrorskin.io.types import Block, Closing, Floats, Header, InputError, Motion, Truth, pixel_axes

_PIXELS_MAX = 200_000_000


class Twin(Closing):
    """The sensor, simulated in vertical motion: a `mirrorskin.io.Source` that knows the truth.

    The sheet conforms to the object (eq. 1 of the paper): a pixel is in contact in frame k when
    ``travel[k] >= -height``, on its way down as on its way up. There it takes the object's slope and shows
    ``dark + (bright - dark) g(zenith)``, with g from `uniform_response`; elsewhere it is flat and dark.
    The camera adds noise and quantises.

    Parameters
    ----------
    object : Object, str or Path
        What to press on; a name or a path goes through `make_object`.
    shape : (int, int)
        Rows and columns of a frame.
    pixel_size : float or (float, float)
        Millimetres at the sheet along x and y.
    travel : array_like, (T,)
        Millimetres that the body has been lowered in each frame: of a press, of a release, or of one after
        the other.
    dtype : dtype_like
        uint8 (levels 16 to 224), uint16 (256 to 3584) or float32 (16 to 224).
    noise : float
        Standard deviation in raw counts.
    seed : int
        The same seed gives the same frames, however they are read.

    Attributes
    ----------
    header : Header
        Its ``dark`` and ``bright`` are the camera's exact levels, free of noise.
    truth : Truth
        The object as it is; ``azimuth`` is NaN where the surface is level, ``contact`` is that at the
        greatest travel.

    Raises
    ------
    InputError
        A value cannot be, the object is unknown or its file unusable.
    """

    motion: Motion = "vertical"
    rewindable = True

    def __init__(
        self,
        *,
        object: Object | str | Path,  # noqa: A002 - the word users know it by
        shape: tuple[int, int],
        pixel_size: float | tuple[float, float],
        travel: ArrayLike,
        dtype: DTypeLike = np.uint8,
        noise: float = 1.5,
        seed: int = 0,
    ) -> None:
        field = _check_shape(shape)
        pixel = _check_pixel_size(pixel_size)
        self.travel = check_stroke(travel, np.size(travel), "travel")
        if len(self.travel) == 0:
            raise InputError("travel is empty: give the position of at least one frame, in mm")
        self._camera = Camera(frame_dtype(dtype), noise, seed)
        thing = make_object(object, field, pixel) if isinstance(object, str | Path) else object

        x, y = np.meshgrid(*pixel_axes(field, pixel))
        height = thing.height(x, y)
        zenith, azimuth = zenith_azimuth(*thing.slope(x, y))
        self._reached_at = -height  # NaN where there is no object, which no travel reaches
        self._light = self._counts(zenith)
        self._next = 0

        self.name = f"twin: {thing.name}"
        self.shape = (len(self.travel), *field)
        self.dtype = self._camera.dtype
        self.header = Header(
            motion=self.motion,
            title=f"Digital twin, {thing.name}, vertical motion",
            pixel_size=pixel,
            dark=np.full(field, self._camera.dark, np.float32),
            bright=np.full(field, self._camera.bright, np.float32),
        )
        self.truth = Truth(
            height=height.astype(np.float32),
            zenith=zenith.astype(np.float32),
            azimuth=azimuth.astype(np.float32),
            contact=(self.travel.max() >= self._reached_at).astype(np.uint8),
        )

    def rewind(self) -> None:
        """Go back to the first frame."""
        self._next = 0

    def read(self, out: NDArray[Any] | None = None, /) -> Block | None:
        """Render the next frames.

        Parameters
        ----------
        out : ndarray, (n, H, W), the source's dtype, optional
            Takes up to n frames; without it one frame comes in a new array.

        Returns
        -------
        Block or None
            The frames with their time (30 a second) and travel; None after the last.

        Raises
        ------
        InputError
            The buffer does not fit the frames.
        """
        if out is None:
            out = np.empty((1, *self.shape[1:]), self.dtype)
        if out.dtype != self.dtype or out.shape[1:] != self.shape[1:] or len(out) == 0:
            raise InputError(
                f"{self.name}: a buffer of {out.dtype} {out.shape} does not fit:"
                f" give {self.dtype} (n, {self.shape[1]}, {self.shape[2]}), n 1 or more"
            )
        first = self._next
        frames = out[: self.shape[0] - first]
        if len(frames) == 0:
            return None
        for k, frame in enumerate(frames, start=first):
            touches = self.travel[k] >= self._reached_at
            counts = np.where(touches, self._light, np.float32(self._camera.dark))
            self._camera.expose(counts, k, frame)
        self._next = first + len(frames)
        time = np.arange(first, self._next) / FRAME_RATE
        return Block(frames, index=first, time=time, travel=self.travel[first : self._next])

    def _counts(self, zenith: Floats) -> NDArray[np.float32]:
        share = np.nan_to_num(uniform_response(zenith))
        return (self._camera.dark + (self._camera.bright - self._camera.dark) * share).astype(np.float32)


def _check_shape(shape: tuple[int, int]) -> tuple[int, int]:
    if len(shape) != 2 or min(shape) < 1:
        raise InputError(f"shape {tuple(shape)} cannot be: give rows and columns, 1 or more of each")
    if shape[0] * shape[1] > _PIXELS_MAX:
        raise InputError(f"shape {tuple(shape)} is too large: {_PIXELS_MAX} pixels are the most")
    return int(shape[0]), int(shape[1])


def _check_pixel_size(pixel_size: float | tuple[float, float]) -> tuple[float, float]:
    sizes = np.asarray(pixel_size, np.float64)
    if sizes.shape not in ((), (2,)) or not (np.isfinite(sizes) & (sizes > 0)).all():
        raise InputError(f"pixel size {pixel_size} cannot be: give one positive number of mm, or x and y")
    along_x, along_y = np.broadcast_to(sizes, 2)
    return float(along_x), float(along_y)
