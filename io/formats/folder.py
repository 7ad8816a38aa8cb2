"""Folders of numbered pictures, one per frame."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.findings import Finding
from mirrorskin.io.base.opencv import to_grey
from mirrorskin.io.base.text import shortened
from mirrorskin.io.base.types import InputError
from mirrorskin.io.formats.pictures import PICTURE_SUFFIXES, decode_picture
from mirrorskin.io.formats.registry import Format, has_frames
from mirrorskin.io.model.frames import WholeFrames, lost_frames

PICTURES = Format(
    name="folder of pictures",
    suffixes=("/",),
    source="a folder of numbered pictures (PNG, TIFF, BMP, PGM, JPEG)",
    reader="FolderFrames",
    takes=("channel",),
)


_WHOLE, _DECIMAL = "[0-9]+", r"[0-9]+\.[0-9]+"
_Families = dict[tuple[str, int, str], list[tuple[int, Path]]]


class FolderFrames(WholeFrames):
    """The numbered pictures of a folder, in order.

    The frames are the pictures whose names differ in one number only, the last that varies. They are sorted
    by this number: ``image2.png`` before ``image10.png``. The first number is arbitrary. Numbers with a
    common step, such as times or positions, are consecutive frames. A missing number is a lost frame; but if
    more numbers are missing than present, only their order is used. Samples are read as in
    ``decode_picture``.

    Parameters
    ----------
    folder : Path
    channel : int, optional
        Colour to read: 0 red, 1 green, 2 blue; by default luma.
    """

    how = "picture by picture"

    def __init__(self, folder: Path, channel: int | None = None) -> None:
        numbers, self.files, self.left_out = _find_sequence(folder)
        self._channel = channel
        self.lost, numbering = _lost(numbers)
        first_of_each = {file.suffix.lower(): file for file in reversed(self.files)}
        files = sorted(first_of_each.values())
        findings = dict.fromkeys(finding for file in files for finding in self._look(file))
        kept = [finding for finding in findings if channel is None or finding.kind != "colour"]
        self.findings = (*numbering, *lost_frames(self.lost), *kept)

    def _look(self, file: Path) -> tuple[Finding, ...]:
        """Return the findings about a picture; that of the first frame determines size and type."""
        picture = decode_picture(file)
        if file == self.files[0]:
            frame = to_grey(picture.samples, str(file), self._channel)
            self.shape, self.dtype = (len(self.files), *frame.shape), frame.dtype
        return picture.findings

    def frames(self, start: int, stop: int) -> Iterator[tuple[str, NDArray[Any]]]:
        """Decode pictures."""
        for file in self.files[start:stop]:
            yield str(file), to_grey(decode_picture(file).samples, str(file), self._channel)


def _find_sequence(folder: Path) -> tuple[NDArray[np.int64], tuple[Path, ...], tuple[str, ...]]:
    """Find the numbers and files of a folder's pictures, in order, and the names of other files."""
    try:
        files = sorted(file for file in folder.iterdir() if file.is_file())
    except OSError as error:
        raise InputError(f"{folder} cannot be read: {error.strerror}") from None
    pictures = [file for file in files if file.suffix.lower() in PICTURE_SUFFIXES and file.name[0] != "."]
    rivals = _longest(_families(pictures, _WHOLE))
    if len(rivals) > 1:  # names such as z0.95.png and z1.00.png differ in both parts of the number
        decimals = _longest(_families(pictures, f"{_DECIMAL}|{_WHOLE}"))
        rivals = decimals if len(decimals) == 1 else rivals
    if not rivals:
        if stacks := [file.name for file in sorted(folder.iterdir()) if has_frames(file)]:
            names = shortened(", ".join(stacks), 100)
            raise InputError(
                f"{folder} is a folder without numbered pictures, but with {names}: name the file"
            )
        kinds = "PNG, TIFF, BMP, PGM or JPEG"
        raise InputError(
            f"{folder} is a folder without numbered pictures ({kinds}): name them frame1.png, frame2.png, ..."
        )
    if len(rivals) > 1:
        patterns = ", ".join(f"{before}#{after}" for before, _, after in list(rivals)[:3])
        raise InputError(f"{folder} contains {len(rivals)} sequences, {patterns}: keep one in the folder")
    (frames,) = (sorted(family) for family in rivals.values())
    for (number, file), (following, twin) in pairwise(frames):
        if number == following:
            raise InputError(f"{file} and {twin.name} have the same number: remove one of them")
    chosen = {file: None for _, file in frames}
    left_out = tuple(file.name for file in files if file not in chosen)
    return np.array([min(number, 2**62) for number, _ in frames]), tuple(chosen), left_out


def _longest(families: _Families) -> _Families:
    """Return the largest family of files, and all others of the same size."""
    largest = max(map(len, families.values()), default=0)
    return {key: family for key, family in families.items() if len(family) >= min(largest, 2)}


def _families(files: list[Path], pattern: str) -> _Families:
    """Group files by the text before and after the last number in which some of them differ."""
    places = {
        file: [
            (file.stem[: match.start()], match.group(), file.stem[match.end() :])
            for match in re.finditer(pattern, file.stem)
        ]
        for file in files
    }
    keys = {
        file: [
            ((before, len(text.partition(".")[2]), after), int(text.replace(".", "")))
            for before, text, after in place
        ]
        for file, place in places.items()
    }
    alike = Counter(key for items in keys.values() for key, _ in items)
    families = defaultdict(list)
    for file, items in keys.items():
        if items:
            differing = [place for place in items if alike[place[0]] > 1]
            key, number = (differing or items)[-1]
            families[key].append((number, file))
    return families


def _lost(numbers: NDArray[np.int64]) -> tuple[NDArray[np.int32], tuple[Finding, ...]]:
    """Return the number of frames lost before each number, and findings about the numbers."""
    steps = np.diff(numbers)
    stride = int(np.gcd.reduce(steps)) if steps.size else 1
    missing = steps // stride - 1
    findings = list[Finding]()
    if missing.sum() > len(numbers):
        text = (
            f"most numbers between {numbers[0]} and {numbers[-1]} in the names are missing, as in times:"
            " only their order is used; give the travel or phase of each frame"
        )
        return np.zeros(len(numbers), np.int32), (Finding("numbering", text),)
    if stride > 1:
        text = f"the numbers in the names step by {stride}: they are read as consecutive frames"
        findings.append(Finding("numbering", text, warning=False))
    return np.concatenate([[0], missing]).astype(np.int32), tuple(findings)
