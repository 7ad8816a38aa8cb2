"""Calibration boards for the scale of a camera: marks, picture for printing, and mean of a recording."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.calibration.sources import read_blocks
from mirrorskin.io import InputError, Source
from mirrorskin.kernels.array_types import Doubles

FEWEST = 12
"""Marks of each picture that a fit needs."""

_FAMILIES = (
    *(f"{kind}X{kind}_{count}" for kind in (4, 5, 6, 7) for count in (50, 100, 250, 1000)),
    "APRILTAG_36h11",
)  # families of markers in OpenCV, each with its numbers of markers in ascending order
_INCH = 25.4  # mm
_DOT = 0.5  # diameter of a printed dot as a share of the pitch
_MOVED = 1.5  # minimum change from first to last frame of a moving scene, in changes between neighbours


@dataclass(frozen=True, slots=True)
class Charuco:
    """A ChArUco board: a chessboard with a black upper left corner and markers in its white squares."""

    columns: int  # squares
    rows: int
    square: float  # side of a square, mm
    marker: float  # side of a marker, mm

    def __post_init__(self) -> None:
        _check(self, min(self.square, self.marker), (self.columns - 1) * (self.rows - 1), "corners")
        if self.marker >= self.square:
            raise InputError(
                f"{self}: a marker is smaller than its square: give the square first,"
                " such as charuco:7x5:2mm:1.5mm"
            )
        if self.markers > 1000:
            raise InputError(f"{self}: the largest family has 1000 markers: take fewer squares")

    def __str__(self) -> str:
        return f"charuco:{self.columns}x{self.rows}:{self.square:g}mm:{self.marker:g}mm"

    @property
    def markers(self) -> int:
        """Number of markers."""
        return self.columns * self.rows // 2

    @property
    def pitch(self) -> float:
        """Distance of neighbouring marks, mm."""
        return self.square

    @property
    def size(self) -> tuple[float, float]:
        """Width and height, mm."""
        return self.columns * self.square, self.rows * self.square

    def marks(self) -> Doubles:
        """Return its inner corners, (n, 2), mm from its middle, y up; row by row from the top."""
        return _grid(self.columns - 1, self.rows - 1, self.square)

    def dictionaries(self) -> list[Any]:
        """Return OpenCV's smallest dictionary with enough markers for the board, of each family."""
        import cv2

        smallest: dict[str, Any] = {}
        for name in _FAMILIES:
            dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))
            if len(dictionary.bytesList) >= self.markers:
                smallest.setdefault(name.rpartition("_")[0], dictionary)
        return list(smallest.values())


@dataclass(frozen=True, slots=True)
class Dots:
    """Round dots in a square grid; ``pitch`` is the distance of their centres, mm."""

    columns: int
    rows: int
    pitch: float

    def __post_init__(self) -> None:
        _check(self, self.pitch, self.columns * self.rows, "dots")

    def __str__(self) -> str:
        return f"dots:{self.columns}x{self.rows}:{self.pitch:g}mm"

    @property
    def size(self) -> tuple[float, float]:
        """Width and height, mm."""
        return self.columns * self.pitch, self.rows * self.pitch

    def marks(self) -> Doubles:
        """Return the centres of its dots, (n, 2), mm from its middle, y up; row by row from the top."""
        return _grid(self.columns, self.rows, self.pitch)


Board = Charuco | Dots


def _check(board: Board, length: float, marks: int, noun: str) -> None:
    if not 0 < length < math.inf:
        raise InputError(f"{board}: lengths must be above zero")
    if min(board.columns, board.rows) < 3 or marks < FEWEST:
        raise InputError(f"{board} has too few {noun}: at least 3 each way and {FEWEST} in all are needed")


def _grid(columns: int, rows: int, pitch: float) -> Doubles:
    x = (np.arange(columns) - (columns - 1) / 2) * pitch
    y = ((rows - 1) / 2 - np.arange(rows)) * pitch
    return np.stack([np.tile(x, rows), np.repeat(y, columns)], axis=1)


# --- printing -----------------------------------------------------------------------------------------------


def paint_board(board: Board, dots_per_inch: float) -> NDArray[np.uint8]:
    """Paint a board for printing, black on white, with a margin as wide as a square or the pitch.

    Edges are within half a pixel of their position. Markers are of the family 4X4; the diameter of dots is
    half the pitch. InputError if the resolution is too low for the details, or the picture too large.

    Examples
    --------
    >>> paint_board(Dots(4, 3, 1.0), 254.0).shape
    (50, 60)
    """
    per_mm = dots_per_inch / _INCH
    detail = board.marker / 6 if isinstance(board, Charuco) else board.pitch * _DOT / 2
    if not per_mm * detail >= 2:
        needed = math.ceil(2 / detail * _INCH)
        raise InputError(f"{board} has details of {detail:g} mm: {needed} dots per inch or more are needed")
    width, height = (side + 2 * board.pitch for side in board.size)
    columns, rows = round(width * per_mm), round(height * per_mm)
    if columns * rows > 1 << 28:
        raise InputError(f"{board} would be {columns} x {rows} pixels: print it with fewer dots per inch")
    x = (np.arange(columns, dtype=np.float64) + 0.5) / per_mm - width / 2
    y = height / 2 - (np.arange(rows, dtype=np.float64) + 0.5) / per_mm
    if isinstance(board, Charuco):
        return _paint_charuco(board, x, y)
    off_x, off_y = (
        np.min(abs(axis[:, np.newaxis] - np.unique(centres)), axis=1)
        for axis, centres in zip((x, y), board.marks().T, strict=True)
    )
    dot = off_x**2 + off_y[:, np.newaxis] ** 2 <= (board.pitch * _DOT / 2) ** 2
    return np.where(dot, 0, 255).astype(np.uint8)


def _paint_charuco(board: Charuco, x: Doubles, y: Doubles) -> NDArray[np.uint8]:
    """Look up each pixel's square, and in a white square the cell of its marker."""
    import cv2

    dictionary = board.dictionaries()[0]
    cells = dictionary.markerSize + 2
    (column, cell_x), (row, cell_y) = (
        _cells(position / board.square, board.marker / board.square, cells, count)
        for position, count in ((x + board.size[0] / 2, board.columns), (board.size[1] / 2 - y, board.rows))
    )
    painted = np.full((y.size, x.size), 255, np.uint8)
    number = 0
    for i in range(board.rows):
        for j in range(board.columns):
            pixels = np.ix_(np.flatnonzero(row == i), np.flatnonzero(column == j))
            if (i + j) % 2 == 0:
                painted[pixels] = 0
                continue
            marker = np.pad(cv2.aruco.generateImageMarker(dictionary, number, cells), 1, constant_values=255)
            painted[pixels] = marker[np.ix_(cell_y[row == i], cell_x[column == j])]
            number += 1
    return painted


def _cells(
    position: Doubles, fraction: float, cells: int, count: int
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return squares, -1 outside the board, and cells of a marker, 0 and cells + 1 outside the marker."""
    square = np.floor(position).astype(np.intp)
    cell = np.floor(((position - square - 0.5) / fraction + 0.5) * cells).astype(np.intp) + 1
    return np.where((square >= 0) & (square < count), square, -1), np.clip(cell, 0, cells + 1)


# --- pictures -----------------------------------------------------------------------------------------------


def mean_of_still(source: Source) -> NDArray[Any]:
    """Return the mean frame of a recording in which nothing moves, (H, W), uint16 or float32.

    The mean of 8-bit frames is scaled to 16 bits, which keeps fractions of a count. InputError if there are
    no frames, or the picture changes.
    """
    total, count, steps = np.zeros(source.shape[1:]), 0, 0.0
    first = last = None
    for block in read_blocks(source):
        for frame in block.frames.astype(np.float64):
            steps += 0.0 if last is None else _change(last, frame)
            first, last = frame if first is None else first, frame
            total += frame
            count += 1
    if first is None or last is None:
        raise InputError(f"{source.name} has no frames: record the board again")
    if count > 2 and _change(first, last) > _MOVED * steps / (count - 1) + 1e-9 * np.abs(total).max():
        raise InputError(
            f"{source.name} is a sequence in which the picture changes: record the board while nothing moves"
        )
    mean = total / count
    if source.dtype.kind == "f":
        return np.asarray(mean, np.float32)
    return np.rint(mean * (257 if source.dtype.itemsize == 1 else 1)).astype(np.uint16)


def _change(frame: Doubles, second_frame: Doubles) -> float:
    """Return the RMS difference of two frames, counts, after an offset and a gain of the light are fitted."""
    first, second = frame - frame.mean(), second_frame - second_frame.mean()
    factor = np.sum(first * second) / max(np.sum(first * first), 1e-300)
    return float(np.sqrt(np.mean((second - factor * first) ** 2)))
