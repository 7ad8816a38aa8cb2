"""Frames of other programs as sources that are read in order: folders of pictures, TIFF, videos."""

from __future__ import annotations

import math
import os
import re
from abc import ABC, abstractmethod
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.io.arrays import NUMPY_SUFFIXES, open_array
from mirrorskin.io.os_errors import check_regular, check_unpacked
from mirrorskin.io.pictures import (
    PICTURE_SUFFIXES,
    TIFF_SUFFIXES,
    count_pages,
    quiet_opencv,
    read_pages,
    read_picture,
)
from mirrorskin.io.positions import Positions, Steps, along, check_phase, check_strokes
from mirrorskin.io.recording import Recording, open_recording
from mirrorskin.io.types import Block, Closing, Floats, Header, InputError, block_memory
from mirrorskin.io.url import is_zarr, path_of

MCAP_SUFFIX = ".mcap"
# OpenCV reads these from the environment only: no messages, and no incomplete last frame.
# Playlists are not opened, because they name other files and addresses.
_CONTAINERS = "avi,mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,mpeg,mpegts,asf,flv,ogg,nut"
_FFMPEG = {
    "OPENCV_FFMPEG_LOGLEVEL": "-8",
    "OPENCV_FFMPEG_CAPTURE_OPTIONS": (
        f"fflags;discardcorrupt|protocol_whitelist;file|format_whitelist;{_CONTAINERS}"
    ),
}


def open_frames(
    path: str | Path,
    header: Header,
    travel: ArrayLike | Positions | None = None,
    phase: ArrayLike | Positions | None = None,
    topic: str | None = None,
    progress: Callable[[int], None] | None = None,
) -> FrameSequence | Recording:
    """Open numbered pictures, a TIFF, a video, NumPy arrays, a Zarr stack, or ROS 2 messages in MCAP.

    Parameters
    ----------
    path : str or Path
    header : Header
        The motion, and other properties of all frames.
    travel, phase : Positions or array_like, (T,), optional
        Millimetres and radians, one per frame, or ``Steps``; an MCAP file may contain them.
    topic : str, optional
        Topic of the images, if an MCAP file has more than one.
    progress : callable, optional
        Called with the number of frames of a video counted so far.

    Returns
    -------
    FrameSequence or Recording
        A source that can be rewound.

    Raises
    ------
    InputError
        The path contains no such frames, or travel or phase is missing or does not fit them.

    Examples
    --------
    >>> open_frames("pictures", Header("vertical"), travel=Steps(0.1)).shape  # doctest: +SKIP
    (240, 480, 640)
    """
    path = path_of(path)
    messages = path.suffix.lower() == MCAP_SUFFIX
    if topic is not None and not messages:
        raise InputError(f"{path}: only an MCAP file has topics: leave --topic out")
    if path.suffix.lower() in NUMPY_SUFFIXES:
        where = {"travel": travel, "phase": phase}
        known = {"tilt": header.tilt, "pixel_size": header.pixel_size, "title": header.title}
        return open_array(path, None, where, known, header.motion, None, None)
    if is_zarr(path):
        size = header.pixel_size
        return open_recording(
            path, motion=header.motion, travel=travel, phase=phase, tilt=header.tilt, pixel_size=size
        )
    for motion, name, positions, options in (
        ("vertical", "travel", travel, "--travel-step or --travel"),
        ("axial", "phase", phase, "--phase-step or --phases"),
    ):
        if header.motion == motion and positions is None and not messages:
            raise InputError(f"{path}: frames of {motion} motion need their {name}: give {options}")
        if header.motion != motion and positions is not None:
            raise InputError(f"{path}: frames of {header.motion} motion have no {name}: leave {options} out")
    if messages:
        from mirrorskin.io.mcap import Messages

        return Messages(path, header, travel, phase, topic)
    pictures = path.is_dir() or path.suffix.lower() in PICTURE_SUFFIXES
    return Pictures(path, header, travel, phase) if pictures else Video(path, header, travel, phase, progress)


class FrameSequence(Closing, ABC):
    """A source of frames of another program, read in order and rewindable."""

    name: str
    header: Header
    shape: tuple[int, int, int]
    dtype: np.dtype[Any]
    left_out: tuple[str, ...]

    rewindable = True

    def __init__(
        self,
        name: str,
        header: Header,
        shape: tuple[int, int, int],
        dtype: np.dtype[Any],
        *,
        travel: ArrayLike | Positions | None = None,
        phase: ArrayLike | Positions | None = None,
        time: Floats | None = None,
        lost: Sequence[int] | None = None,
        left_out: tuple[str, ...] = (),
    ) -> None:
        self.name, self.header, self.motion = name, header, header.motion
        self.shape, self.dtype, self.left_out = shape, dtype, left_out
        self._lost = lost or [0] * shape[0]
        self._time = time
        travel, phase = self._along(travel), self._along(phase)
        self.travel: NDArray[np.float64] | None = (
            None if travel is None else check_strokes(travel, shape[0], f"{name}: travel")
        )
        self._phase = None if phase is None else check_phase(phase, shape[0], f"{name}: phase")
        self._next = 0

    def read(self, out: NDArray[Any] | None = None, /) -> Block | None:
        """Read the next frames."""
        out = block_memory(out, self.shape, self.dtype)
        start = self._next
        if start == self.shape[0]:
            return None
        stop = min(start + len(out), self.shape[0])
        stop = next((k for k in range(start + 1, stop) if self._lost[k]), stop)
        frames = out[: stop - start]
        self._fill(start, frames)
        self._next = stop
        series = {"time": self._time, "travel": self.travel, "phase": self._phase}
        known: dict[str, Any] = {name: one[start:stop] for name, one in series.items() if one is not None}
        return Block(frames, start, **known, dropped=self._lost[start])

    def rewind(self) -> None:
        """Go back to the first frame."""
        self._next = 0

    @abstractmethod
    def _fill(self, start: int, out: NDArray[Any]) -> None:
        """Read the frames from number ``start`` on into the whole of ``out``."""

    def _along(self, given: ArrayLike | Positions | None) -> ArrayLike | None:
        """Return positions as numbers; with steps, lost frames count, too."""
        if isinstance(given, Steps):
            taken = np.arange(self.shape[0]) + np.cumsum(self._lost)
            return np.asarray(given.start + given.step * taken)
        return along(given, self.shape[0])


class Pictures(FrameSequence):
    """A stack of PNG or TIFF pictures, 8 or 16 bits or (TIFF) float32, as a source that can be rewound.

    In a folder, the frames are the pictures whose names differ in one number only, the last that varies,
    in the order of this number: ``image2.png`` before ``image10.png``. Numbers may start anywhere. A missing
    number is a lost frame, which is counted in ``dropped`` of the next block. A TIFF's pages are in order.
    Colour is converted to grey as in ``read_picture``.
    """

    def __init__(
        self,
        path: str | Path,
        header: Header,
        travel: ArrayLike | Positions | None = None,
        phase: ArrayLike | Positions | None = None,
    ) -> None:
        self._path = Path(path)
        self._folder = _find_sequence(self._path) if self._path.is_dir() else None
        count = len(self._folder.files) if self._folder else _count_frames(self._path)
        self._first, first = next(self._pictures(0, 1))
        super().__init__(
            str(path),
            header,
            (count, *first.shape),
            first.dtype,
            travel=travel,
            phase=phase,
            lost=self._folder.lost if self._folder else None,
            left_out=self._folder.left_out if self._folder else (),
        )

    def _fill(self, start: int, out: NDArray[Any]) -> None:
        for frame, (label, picture) in zip(out, self._pictures(start, start + len(out)), strict=True):
            if picture.shape != frame.shape or picture.dtype != frame.dtype:
                raise InputError(
                    f"{label} is {_kind(picture)}, but {self._first} is {_kind(frame)}: "
                    "all frames must have the same size and depth"
                )
            frame[...] = picture

    def _pictures(self, start: int, stop: int) -> Iterator[tuple[str, NDArray[Any]]]:
        if self._folder is None:
            return read_pages(self._path, start, stop)
        return ((str(file), read_picture(file)) for file in self._folder.files[start:stop])


class _Folder(NamedTuple):
    files: list[Path]
    lost: list[int]
    left_out: tuple[str, ...]


def _find_sequence(folder: Path) -> _Folder:
    """Find the numbered pictures of a folder, in order, and the number of missing ones before each."""
    try:
        files = sorted(file for file in folder.iterdir() if file.is_file())
    except OSError as error:
        raise InputError(f"{folder} cannot be read: {error.strerror}") from error
    families = _families([f for f in files if f.suffix.lower() in PICTURE_SUFFIXES and f.name[0] != "."])
    if not families:
        raise InputError(
            f"{folder} holds no numbered PNG or TIFF pictures: name them frame1.png, frame2.png, ..."
        )
    most = max(map(len, families.values()))
    rivals = [family for family in families if len(families[family]) >= min(most, 2)]
    if len(rivals) > 1:
        patterns = ", ".join(f"{before}#{after}" for before, after in rivals[:3])
        raise InputError(f"{folder} holds {len(rivals)} sequences, {patterns}: keep one in the folder")
    frames = sorted(families[rivals[0]])
    for (number, file), (following, twin) in pairwise(frames):
        if number == following:
            raise InputError(f"{file} and {twin.name} have the same number: remove one of them")
    numbers = [number for number, _ in frames]
    chosen = {file: None for _, file in frames}
    lost = [0, *(after - before - 1 for before, after in pairwise(numbers))]
    return _Folder(list(chosen), lost, tuple(file.name for file in files if file not in chosen))


def _families(files: list[Path]) -> dict[tuple[str, str], list[tuple[int, Path]]]:
    """Group files by the text before and after the last number in which some of them differ."""
    places = {
        file: [
            (file.stem[: match.start()], int(match.group()), file.stem[match.end() :])
            for match in re.finditer("[0-9]+", file.stem)
        ]
        for file in files
    }
    alike = Counter((before, after) for found in places.values() for before, _, after in found)
    families = defaultdict(list)
    for file, found in places.items():
        if found:
            differing = [place for place in found if alike[place[0], place[2]] > 1]
            before, number, after = (differing or found)[-1]
            families[before, after].append((number, file))
    return families


def _count_frames(path: Path) -> int:
    if not path.exists():
        raise InputError(f"{path}: there is no such file or folder")
    if path.suffix.lower() not in TIFF_SUFFIXES:
        raise InputError(f"{path} is not a stack of frames: name the folder that contains its pictures")
    return count_pages(path)


def _kind(picture: NDArray[Any]) -> str:
    rows, columns = picture.shape
    return f"{columns} x {rows} {picture.dtype}"


class Video(FrameSequence):
    """The frames of an AVI or MP4 as grey uint8, as a source that can be rewound.

    The file is decoded once to count its frames, because the number in the container is often wrong. Grey is
    the luma of ITU-R BT.601 of the displayed picture, in full range (0 to 255); the rotation stored in the
    file is applied, so ``shape`` is that of the upright picture. ``time`` is the time stamp of each frame
    relative to the first; if these do not increase, it is computed from the frame rate.
    """

    def __init__(
        self,
        path: str | Path,
        header: Header,
        travel: ArrayLike | Positions | None = None,
        phase: ArrayLike | Positions | None = None,
        progress: Callable[[int], None] | None = None,
    ) -> None:
        self._path = Path(path)
        check_regular(self._path, "name a video, a TIFF or a folder of pictures")
        shape, time = self._survey(progress)
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
            size = [int(capture.get(one)) for one in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)]
            check_unpacked(3 * math.prod(size), f"{self._path}: a frame", "encode it in a smaller size")
            # The low-order digits of FFmpeg's tags of high-bit-depth formats are the number of bits.
            bits = int(capture.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT)) >> 24
            if 8 < bits <= 16:
                raise InputError(
                    f"{self._path} has {bits} bits a sample, but only 8 would be read: "
                    "save it as 16-bit pictures"
                )
            capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
            return capture

    def _survey(self, progress: Callable[[int], None] | None) -> tuple[tuple[int, int, int], Floats | None]:
        """Decode all frames once: their number, size, and times."""
        capture = self._open()
        stamps: list[float] = []
        with quiet_opencv() as cv2:
            declared, rate = capture.get(cv2.CAP_PROP_FRAME_COUNT), capture.get(cv2.CAP_PROP_FPS)
            decoded, first = capture.read()
            while decoded:
                stamps.append(capture.get(cv2.CAP_PROP_POS_MSEC))
                if progress:
                    progress(len(stamps))
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
