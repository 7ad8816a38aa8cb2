"""Boards that show a camera's scale: painted for printing, and found again in pictures."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import InputError, Source

Doubles = NDArray[np.float64]

FEWEST = 12
"""Marks that a fit needs of each picture."""

_FAMILIES = (
    *(f"{kind}X{kind}_{count}" for kind in (4, 5, 6, 7) for count in (50, 100, 250, 1000)),
    "APRILTAG_36h11",
)
_INCH = 25.4
_DOT = 0.5  # diameter of a printed dot as a share of the pitch
_MOVED = 1.5  # times as much change between the first and the last frame as between neighbours
_BLOCK = 16  # frames

_SATURATED = 0.3  # share of saturated pixels from which on that is the likely reason of a failure
_LEAST_DOT = 9.0  # pixels of area
_FEWEST_MARKERS = 3
_ENOUGH = 0.5  # share of a board's markers with which sharpened pictures need not be searched

_BLUR = 1.0  # pixels
_STEPS = 20
_CONVERGED = 1e-4  # pixels
_STEP, _WAY = 0.25, 0.6  # longest step and longest way to a mark's centre, of the radius
_SPACING, _FEWEST_SAMPLES, _MOST_SAMPLES = 1.5, 6, 24  # pixels between samples along a radius, and how many
_ASYMMETRIC = 0.3  # share of the picture's variance that may be asymmetric
_FAINT = 3.0  # counts, of a contrast of 255: the least standard deviation near a mark


@dataclass(frozen=True, slots=True)
class Charuco:
    """A ChArUco board: a chessboard, black in its upper left corner, with markers in its white squares.

    Attributes
    ----------
    columns, rows : int
        Squares.
    square, marker : float
        Millimetres along an edge.
    """

    columns: int
    rows: int
    square: float
    marker: float

    def __post_init__(self) -> None:
        _check(self, min(self.square, self.marker), (self.columns - 1) * (self.rows - 1), "corners")
        if self.marker >= self.square:
            raise InputError(
                f"{self}: a marker lies within its square: give the square first,"
                " such as charuco:7x5:2mm:1.5mm"
            )
        if self.columns * self.rows // 2 > 1000:
            raise InputError(f"{self}: no family has so many markers: take fewer squares")

    def __str__(self) -> str:
        return f"charuco:{self.columns}x{self.rows}:{self.square:g}mm:{self.marker:g}mm"

    @property
    def pitch(self) -> float:
        """Millimetres from mark to mark."""
        return self.square

    @property
    def size(self) -> tuple[float, float]:
        """Width and height, mm."""
        return self.columns * self.square, self.rows * self.square

    def marks(self) -> Doubles:
        """Return where its inner corners are, (n, 2), mm from its middle, y up; row by row from the top."""
        return _grid(self.columns - 1, self.rows - 1, self.square)

    def dictionaries(self) -> list[Any]:
        """Return OpenCV's smallest dictionary of each family that has as many markers as the board."""
        import cv2

        found: dict[str, Any] = {}
        for name in _FAMILIES:
            dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))
            if len(dictionary.bytesList) >= self.columns * self.rows // 2:
                found.setdefault(name.rpartition("_")[0], dictionary)
        return list(found.values())


@dataclass(frozen=True, slots=True)
class Dots:
    """Round dots in a square grid; ``pitch`` is in mm from centre to centre."""

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
        """Return where the dots are, (n, 2), mm from the board's middle, y up; row by row from the top."""
        return _grid(self.columns, self.rows, self.pitch)


Board = Charuco | Dots


def _check(board: Board, length: float, marks: int, noun: str) -> None:
    if not 0 < length < math.inf:
        raise InputError(f"{board}: lengths are above zero")
    if min(board.columns, board.rows) < 3 or marks < FEWEST:
        raise InputError(f"{board} has too few {noun}: 3 each way and {FEWEST} in all are needed")


def _grid(columns: int, rows: int, pitch: float) -> Doubles:
    x = (np.arange(columns) - (columns - 1) / 2) * pitch
    y = ((rows - 1) / 2 - np.arange(rows)) * pitch
    return np.stack([np.tile(x, rows), np.repeat(y, columns)], axis=1)


# --- painting -----------------------------------------------------------------------------------------------


def paint_board(board: Board, dots_per_inch: float) -> NDArray[np.uint8]:
    """Paint a board for printing, black on white, with a margin as wide as a square or the pitch.

    Parameters
    ----------
    board : Charuco or Dots
        Markers are those of the family 4X4; dots are half as wide as the pitch.
    dots_per_inch : float
        Of the printer.

    Returns
    -------
    ndarray, (H, W), uint8
        Edges lie where they belong to half a pixel.

    Raises
    ------
    mirrorskin.io.InputError
        The details are finer than the pixels.

    Examples
    --------
    >>> paint_board(Dots(4, 3, 1.0), 254.0).shape
    (50, 60)
    """
    per_mm = dots_per_inch / _INCH
    fine = board.marker / 6 if isinstance(board, Charuco) else board.pitch * _DOT / 2
    if not per_mm * fine >= 2:
        needed = math.ceil(2 / fine * _INCH)
        raise InputError(f"{board} has details of {fine:g} mm: {needed} dots per inch or more are needed")
    width, height = (side + 2 * board.pitch for side in board.size)
    columns, rows = round(width * per_mm), round(height * per_mm)
    if columns * rows > 1 << 28:
        raise InputError(f"{board} would be {columns} x {rows} pixels: print it with fewer dots per inch")
    x = (np.arange(columns, dtype=np.float64) + 0.5) / per_mm - width / 2
    y = height / 2 - (np.arange(rows, dtype=np.float64) + 0.5) / per_mm
    if isinstance(board, Charuco):
        return _paint_charuco(board, x, y)
    across, down = (
        np.min(abs(axis[:, np.newaxis] - np.unique(places)), axis=1)
        for axis, places in zip((x, y), board.marks().T, strict=True)
    )
    dot = across**2 + down[:, np.newaxis] ** 2 <= (board.pitch * _DOT / 2) ** 2
    return np.where(dot, 0, 255).astype(np.uint8)


def _paint_charuco(board: Charuco, x: Doubles, y: Doubles) -> NDArray[np.uint8]:
    """Look up each pixel's square, and in a white square its marker's cell."""
    import cv2

    dictionary = board.dictionaries()[0]
    cells = dictionary.markerSize + 2
    (column, across), (row, down) = (
        _cells(along / board.square, board.marker / board.square, cells, count)
        for along, count in ((x + board.size[0] / 2, board.columns), (board.size[1] / 2 - y, board.rows))
    )
    painted = np.full((y.size, x.size), 255, np.uint8)
    number = 0
    for i in range(board.rows):
        for j in range(board.columns):
            place = np.ix_(np.flatnonzero(row == i), np.flatnonzero(column == j))
            if (i + j) % 2 == 0:
                painted[place] = 0
                continue
            marker = np.pad(cv2.aruco.generateImageMarker(dictionary, number, cells), 1, constant_values=255)
            painted[place] = marker[np.ix_(down[row == i], across[column == j])]
            number += 1
    return painted


def _cells(along: Doubles, share: float, cells: int, count: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the square of each place, -1 outside, and the cell of its marker, 0 and cells + 1 beside it."""
    square = np.floor(along).astype(np.intp)
    cell = np.floor(((along - square - 0.5) / share + 0.5) * cells).astype(np.intp) + 1
    return np.where((square >= 0) & (square < count), square, -1), np.clip(cell, 0, cells + 1)


# --- pictures -----------------------------------------------------------------------------------------------


def mean_of_still(source: Source) -> NDArray[Any]:
    """Return the mean frame of a recording in which nothing moves, (H, W), uint16 or float32.

    What was of 8 bits has 16, and so fractions of a count.

    Raises
    ------
    InputError
        There are no frames, or the picture changes from the first to the last.
    """
    if source.rewindable:
        source.rewind()
    count, *shape = source.shape
    buffer = np.empty((max(1, min(count, _BLOCK)), *shape), source.dtype)
    total, number, steps = np.zeros(shape), 0, 0.0
    first = last = None
    while (block := source.read(buffer)) is not None:
        for frame in block.frames.astype(np.float64):
            steps += 0.0 if last is None else _change(last, frame)
            first, last = frame if first is None else first, frame
            total += frame
            number += 1
    if first is None or last is None:
        raise InputError(f"{source.name} has no frames: record the board again")
    if number > 2 and _change(first, last) > _MOVED * steps / (number - 1) + 1e-9 * np.abs(total).max():
        raise InputError(
            f"{source.name} is a sequence in which the picture changes: record the board while nothing moves"
        )
    mean = total / number
    if source.dtype.kind == "f":
        return np.asarray(mean, np.float32)
    return np.rint(mean * (257 if source.dtype.itemsize == 1 else 1)).astype(np.uint16)


def _change(one: Doubles, other: Doubles) -> float:
    """Return by how much two frames differ, but for an offset and a factor of the light, counts RMS."""
    first, second = one - one.mean(), other - other.mean()
    factor = np.sum(first * second) / max(np.sum(first * first), 1e-300)
    return float(np.sqrt(np.mean((second - factor * first) ** 2)))


@dataclass(frozen=True, slots=True, eq=False)
class Marks:
    """Marks of a board that were found in a picture.

    Attributes
    ----------
    name : str
        Of the picture, for messages.
    shape : (int, int)
        Its rows and columns.
    board : ndarray, (n, 2), float64
        Where they are on the board, mm from its middle, y up.
    places : ndarray, (n, 2), float64
        Where they are seen: column and row, 0 in the first.
    radius : float
        Of dots, mm; 0 of corners.
    """

    name: str
    shape: tuple[int, int]
    board: Doubles
    places: Doubles
    radius: float = 0.0


def stretch_contrast(picture: NDArray[Any], name: str) -> Doubles:
    """Return a picture with its darkest and brightest parts at 0 and 255, or raise InputError."""
    samples = np.asarray(picture, np.float64)
    if not np.isfinite(samples).all():
        raise InputError(f"{name} has samples that are no numbers: take the picture again")
    low, high = np.percentile(samples, [0.5, 99.5])
    if high <= low:
        raise InputError(_not_found(picture, name, "shows nothing: it is all of one brightness"))
    return np.asarray((samples - low) * (255 / (high - low)))


def find_marks(picture: NDArray[Any], board: Board, name: str) -> Marks:
    """Find the marker corners of a ChArUco board (four of each, marker by marker), or dots, roughly.

    Raises InputError if the board is not in the picture.
    """
    grey = np.clip(np.rint(stretch_contrast(picture, name)), 0, 255).astype(np.uint8)
    if isinstance(board, Dots):
        found = _find_dots(grey, board)
    else:
        found = _find_markers(_sharpened(grey), board)
        if found is None and _find_markers(iter([(1, grey[:, ::-1].copy())]), board):
            raise InputError(f"{name} shows {board} in a mirror: turn the board over, or flip the picture")
    if found is None:
        raise InputError(_not_found(picture, name, f"shows no board {board}"))
    return Marks(name, picture.shape, *found)


def _not_found(picture: NDArray[Any], name: str, what: str) -> str:
    full = np.mean(picture == np.iinfo(picture.dtype).max) if picture.dtype.kind == "u" else 0.0
    if full > _SATURATED:
        return f"{name} {what}, and {full:.0%} of its pixels are saturated: expose it less"
    return f"{name} {what}: is all of it in the picture, sharp and evenly lit, and is it of that kind?"


def _find_markers(
    pictures: Iterator[tuple[int, NDArray[np.uint8]]], board: Charuco
) -> tuple[Doubles, Doubles] | None:
    """Return the corners of the markers in the (scale, picture) that has most of them."""
    import cv2

    found = max(_detect_markers(pictures, board), key=lambda found: len(found[1]), default=None)
    if found is None:
        return None
    dictionary, numbers, corners = found
    places = corners.reshape(-1, 2)
    width, height = board.size
    candidates = []
    for legacy in (False, True):
        known = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square, board.marker, dictionary)
        known.setLegacyPattern(legacy)
        points = np.array(known.getObjPoints(), np.float64)[numbers, :, :2].reshape(-1, 2)
        # From the board's upper left corner, y down, to its middle, y up.
        candidates.append(np.stack([points[:, 0] - width / 2, height / 2 - points[:, 1]], axis=1))
    return min(candidates, key=lambda points: _plane_error(points, places)), places


def _detect_markers(
    pictures: Iterator[tuple[int, NDArray[np.uint8]]], board: Charuco
) -> Iterator[tuple[Any, NDArray[np.intp], Doubles]]:
    """Yield dictionaries with the numbers and corners, (n, 4, 2), of their markers in pictures."""
    import cv2

    dictionaries = board.dictionaries()
    for scale, picture in pictures:
        for dictionary in dictionaries:
            corners, numbers, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(picture)
            seen = np.empty(0, np.intp) if numbers is None else np.array(numbers, np.intp).ravel()
            known = np.flatnonzero(seen < board.columns * board.rows // 2)
            if known.size < _FEWEST_MARKERS:
                continue
            places = np.array(corners, np.float64).reshape(-1, 4, 2)[known]
            yield dictionary, seen[known], (places + 0.5) / scale - 0.5
            if known.size > _ENOUGH * board.columns * board.rows / 2:
                return
            dictionaries = [dictionary]
            break


def _sharpened(grey: NDArray[np.uint8]) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Yield a picture, then larger and sharper ones, in which blurred markers can be read."""
    import cv2

    yield 1, grey
    for amount in (3.0, 8.0):
        fine = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 1.0)
        sharp = fine + amount * (fine - cv2.GaussianBlur(fine, (0, 0), 2.0))
        large = cv2.resize(sharp, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
        yield 2, np.clip(large, 0, 255).astype(np.uint8)


def _plane_error(points: Doubles, places: Doubles) -> float:
    """Return how badly, pixels, a plane with points is seen at places."""
    import cv2

    plane, _ = cv2.findHomography(points, places, cv2.LMEDS)
    if plane is None:
        return float("inf")
    seen = cv2.perspectiveTransform(points[np.newaxis], plane)[0]
    return float(np.median(np.hypot(*(seen - places).T)))


def _find_dots(grey: NDArray[np.uint8], board: Dots) -> tuple[Doubles, Doubles] | None:
    """Return the dots of a grid, which may be dark or bright, in the order of the board."""
    import cv2

    settings = cv2.SimpleBlobDetector_Params()  # type: ignore[attr-defined]
    settings.minArea, settings.maxArea = _LEAST_DOT, grey.size / (board.columns * board.rows)
    settings.minDistBetweenBlobs = 3.0
    detector = cv2.SimpleBlobDetector_create(settings)  # type: ignore[attr-defined]
    for picture in (grey, 255 - grey):
        for flags in (cv2.CALIB_CB_SYMMETRIC_GRID, cv2.CALIB_CB_SYMMETRIC_GRID | cv2.CALIB_CB_CLUSTERING):
            there, centres = cv2.findCirclesGrid(
                picture, (board.columns, board.rows), flags=flags, blobDetector=detector
            )
            if there:
                places, points = np.array(centres, np.float64).reshape(-1, 2), board.marks()
                fit = np.linalg.lstsq(np.column_stack([points, np.ones(len(points))]), places, rcond=None)[0]
                # Columns run as x does, rows against y: otherwise the grid was seen in a mirror.
                return points * [-1, 1] if np.linalg.det(fit[:2]) > 0 else points, places
    return None


# --- centring -----------------------------------------------------------------------------------------------


def centre_marks(picture: NDArray[Any], starts: Doubles, radius: float) -> tuple[Doubles, NDArray[np.bool_]]:
    """Move places to where the picture around does not change when it is turned by half.

    A corner of a chessboard and a dot are such places whatever symmetric blur there is, so this has no bias:
    I(q + d) = I(q - d). Solved for q by Gauss-Newton over the offsets d in a circle, weighed by
    (1 - d^2 / radius^2)^2, with the picture (contrast about 255) interpolated by cubic splines after a slight
    blur: between the pixels of a sharp edge, splines swing. ``starts``, (n, 2), are columns and rows.

    Returned are the places, and whether there is such a place near the start, all around it in the picture.
    """
    from scipy import ndimage

    blurred = ndimage.gaussian_filter(np.asarray(picture, np.float64), _BLUR, mode="mirror")
    smooth = ndimage.spline_filter(blurred, order=3)
    offsets, weights = _half_disc(radius)
    places = np.array(starts, np.float64)
    step = np.full_like(places, np.inf)
    for _ in range(_STEPS):
        step = _gauss_newton_step(smooth, places, offsets, weights, radius)
        places += step
        if np.abs(step).max(initial=0) < _CONVERGED:
            break
    still = np.abs(step).max(axis=1) < 10 * _CONVERGED
    near = np.hypot(*(places - starts).T) <= _WAY * radius
    inside = np.all((places >= radius) & (places <= np.array(picture.shape[::-1]) - 1 - radius), axis=1)
    return places, still & near & inside & _is_symmetric(smooth, places, offsets, weights)


def _half_disc(radius: float) -> tuple[Doubles, Doubles]:
    """Return offsets, (m, 2), in half a disc, and their weights; the other half is their mirror image."""
    count = min(max(math.ceil(radius / _SPACING), _FEWEST_SAMPLES), _MOST_SAMPLES)
    grid = np.arange(-count, count + 1) / count
    across, down = (one.ravel() for one in np.meshgrid(grid, grid))
    square = across**2 + down**2
    half = (square < 1) & ((down > 0) | ((down == 0) & (across > 0)))
    return np.stack([across, down], axis=1)[half] * radius, (1 - square[half]) ** 2


def _gauss_newton_step(
    smooth: Doubles, places: Doubles, offsets: Doubles, weights: Doubles, radius: float
) -> Doubles:
    ahead, behind = places[:, np.newaxis] + offsets, places[:, np.newaxis] - offsets
    residual = _interpolate(smooth, ahead) - _interpolate(smooth, behind)
    slope = _gradient(smooth, ahead) - _gradient(smooth, behind)
    normal = np.einsum("m,nmi,nmj->nij", weights, slope, slope) + 1e-9 * np.eye(2)
    pull = np.einsum("m,nmi,nm->ni", weights, slope, residual)
    step = -np.linalg.solve(normal, pull[..., np.newaxis])[..., 0]
    length = np.hypot(*step.T)[:, np.newaxis]
    return np.asarray(step * np.minimum(1, _STEP * radius / np.maximum(length, 1e-12)))


def _is_symmetric(smooth: Doubles, places: Doubles, offsets: Doubles, weights: Doubles) -> NDArray[np.bool_]:
    """Return around which places there is something to see, and how it is the same turned by half."""
    one, other = (_interpolate(smooth, places[:, np.newaxis] + way * offsets) for way in (1, -1))
    share = weights / weights.sum()
    even, odd = (one + other) / 2, (one - other) / 2
    signal = (even - (even @ share)[:, np.newaxis]) ** 2 @ share
    return np.asarray((signal > _FAINT**2) & (odd**2 @ share < _ASYMMETRIC * signal))


def _interpolate(smooth: Doubles, places: Doubles) -> Doubles:
    """Return the picture at places, (..., 2)."""
    from scipy import ndimage

    at = np.moveaxis(places, -1, 0)[::-1]
    return np.asarray(ndimage.map_coordinates(smooth, at, order=3, prefilter=False, mode="mirror"))


def _gradient(smooth: Doubles, places: Doubles) -> Doubles:
    """Return the picture's slopes along columns and rows, (..., 2), by differences over half a pixel."""
    ways = np.eye(2) / 4
    return np.stack(
        [2 * (_interpolate(smooth, places + way) - _interpolate(smooth, places - way)) for way in ways],
        axis=-1,
    )
