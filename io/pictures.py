"""Frames from a folder of numbered pictures, or from the pages of a TIFF."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from numpy.typing import ArrayLike, NDArray

from mirrorskin.io.picture_files import (
    PICTURE_SUFFIXES,
    TIFF_SUFFIXES,
    count_pages,
    read_pages,
    read_picture,
)
from mirrorskin.io.positions import Positions
from mirrorskin.io.sequence import FrameSequence
from mirrorskin.io.types import Header, InputError


class Pictures(FrameSequence):
    """A stack of PNG or TIFF pictures, 8 or 16 bits or (TIFF) float32, as a source that can be rewound.

    In a folder, the frames are the pictures whose names are alike but for one number, the last that differs,
    and they come in its order: ``image2.png`` before ``image10.png``. Numbers may start anywhere; one that is
    missing is a frame that was lost, so the block after it says ``dropped``. A TIFF's pages are in order.
    Colour becomes grey as in ``picture_files.read_picture``.

    Parameters
    ----------
    path : str or Path
        A folder, or a TIFF with one page a frame.
    header : Header
    travel, phase : Positions or array_like, (T,), optional
        Millimetres and radians, one a frame, or ``Steps``, which count the frames that were lost, too.

    Attributes
    ----------
    left_out : tuple of str
        Names of the folder's files that are no frames.

    Raises
    ------
    InputError
        There is no such folder or TIFF; it holds no sequence, or several; two files have the same number; the
        first picture cannot be read; travel or phase does not fit. A later picture that cannot be read, or is
        unlike the first, is found when it is read.
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
    """Find the numbered pictures of a folder, in order, and how many are missing before each."""
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
    """Group files by what stands before and after the last number in which some of them differ."""
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
        raise InputError(f"{path} is no stack of frames: name the folder that its pictures are in")
    return count_pages(path)


def _kind(picture: NDArray[Any]) -> str:
    rows, columns = picture.shape
    return f"{columns} x {rows} {picture.dtype}"
