"""Frames from a video file."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.io.frames import FrameSequence, quiet_opencv
from mirrorskin.io.positions import Positions
from mirrorskin.io.types import Floats, Header, InputError

# OpenCV takes these from the environment only: no messages, and no frame of which the end is missing.
_FFMPEG = {"OPENCV_FFMPEG_LOGLEVEL": "-8", "OPENCV_FFMPEG_CAPTURE_OPTIONS": "fflags;discardcorrupt"}


class Video(FrameSequence):
    """The frames of an AVI or MP4 as grey uint8, as a source that can be rewound.

    The file is decoded once to count its frames, because what containers say is often wrong. Grey is the
    luma of ITU-R BT.601 of what a player shows, in full range (0 to 255); a rotation that the file asks
    for is applied, so ``shape`` is that of the upright picture. ``time`` is what the file says of each
    frame, from the first; where that does not increase, the frame's number over the frame rate.
    """

    def __init__(
        self,
        path: str | Path,
        header: Header,
        travel: ArrayLike | Positions | None = None,
        phase: ArrayLike | Positions | None = None,
    ) -> None:
        self._path = Path(path)
        if not self._path.is_file():
            raise InputError(f"{path}: there is no such file")
        shape, time = self._survey()
        super().__init__(str(path), header, shape, np.dtype(np.uint8), travel=travel, phase=phase, time=time)
        self._capture = self._open()

    def rewind(self) -> None:
        """Go back to the first frame."""
        super().rewind()
        self._capture.release()
        self._capture = self._open()

    def close(self) -> None:
        """Close the file."""
        self._capture.release()

    def _fill(self, start: int, out: NDArray[Any]) -> None:
        with quiet_opencv() as cv2:
            for index, frame in enumerate(out, start):
                decoded, picture = self._capture.read()
                if not decoded:
                    raise InputError(
                        f"{self.name}: frame {index} cannot be decoded any more: was it changed?"
                    )
                if picture.shape[:2] != frame.shape:
                    raise InputError(
                        f"{self.name}: the size of the picture changes at frame {index}: cut it there"
                    )
                frame[...] = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)

    def _open(self) -> Any:
        with quiet_opencv() as cv2, _ffmpeg_settings():
            capture = cv2.VideoCapture(str(self._path.absolute()), cv2.CAP_FFMPEG)
            if not capture.isOpened():
                raise InputError(f"{self._path} cannot be opened as a video: it is damaged, cut off, or none")
            # FFmpeg's tags of the deeper pixel formats end in the number of bits.
            bits = int(capture.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT)) >> 24
            if 8 < bits <= 16:
                raise InputError(
                    f"{self._path} has {bits} bits a sample, but only 8 would be read: "
                    "save it as 16-bit pictures"
                )
            capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
            return capture

    def _survey(self) -> tuple[tuple[int, int, int], Floats | None]:
        """Decode all frames once: how many, how large, and when."""
        capture = self._open()
        stamps: list[float] = []
        with quiet_opencv() as cv2:
            declared, rate = capture.get(cv2.CAP_PROP_FRAME_COUNT), capture.get(cv2.CAP_PROP_FPS)
            decoded, first = capture.read()
            while decoded:
                stamps.append(capture.get(cv2.CAP_PROP_POS_MSEC))
                decoded = capture.grab()
        capture.release()
        if not stamps:
            raise InputError(f"{self._path} has no frames that can be decoded")
        if len(stamps) < declared:
            raise InputError(
                f"{self._path} should have {declared:.0f} frames, but {len(stamps)} can be decoded: "
                "it is damaged or cut off; copy it again, or encode anew what there is"
            )
        return (len(stamps), *first.shape[:2]), _times(np.asarray(stamps) / 1000, rate)


def _times(stamps: Floats, rate: float) -> Floats | None:
    if np.all(np.isfinite(stamps)) and np.all(np.diff(stamps) > 0):
        return np.asarray(stamps - stamps[0])
    return np.arange(len(stamps)) / rate if 0 < rate < np.inf else None


@contextmanager
def _ffmpeg_settings() -> Iterator[None]:
    added = {name: value for name, value in _FFMPEG.items() if name not in os.environ}
    os.environ.update(added)
    try:
        yield
    finally:
        for name in added:
            del os.environ[name]
