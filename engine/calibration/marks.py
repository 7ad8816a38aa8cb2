"""The marks of a board in a picture, as OpenCV finds them: to a pixel or so."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from mirrorskin.engine.calibration.board import FAMILIES, Board, Charuco, Dots
from mirrorskin.io import InputError

Doubles = NDArray[np.float64]
_Scaled = tuple[int, NDArray[np.uint8]]  # how many times as large, and the picture

_FULL = 0.3  # share of saturated pixels from which on that is the likely reason
_LEAST_DOT = 9.0  # pixels of area
_FEWEST_MARKERS = 3
_ENOUGH = 0.5  # share of a board's markers, with which sharper pictures need not be looked at


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


def stretched(picture: NDArray[Any], name: str) -> Doubles:
    """Return a picture with its darkest and brightest parts at 0 and 255.

    Raises
    ------
    InputError
        It has samples that are no numbers, or is all of one brightness.
    """
    samples = np.asarray(picture, np.float64)
    if not np.isfinite(samples).all():
        raise InputError(f"{name} has samples that are no numbers: take the picture again")
    low, high = np.percentile(samples, [0.5, 99.5])
    if high <= low:
        raise InputError(_not_found(picture, name, "shows nothing: it is all of one brightness"))
    return np.asarray((samples - low) * (255 / (high - low)))


def find_marks(picture: NDArray[Any], board: Board, name: str) -> Marks:
    """Find the corners of markers of a ChArUco board, or dots, roughly.

    Parameters
    ----------
    picture : ndarray, (H, W), uint8, uint16 or float32
    board : Charuco or Dots
    name : str
        Of the picture, for messages.

    Returns
    -------
    Marks
        Of a ChArUco board these are the four corners of each marker, one after the other.

    Raises
    ------
    InputError
        The board is not in the picture.
    """
    grey = np.clip(np.rint(stretched(picture, name)), 0, 255).astype(np.uint8)
    found = _find_dots(grey, board) if isinstance(board, Dots) else _find_markers(_sharper(grey), board)
    if found is None and isinstance(board, Charuco) and _find_markers([(1, grey[:, ::-1].copy())], board):
        raise InputError(f"{name} shows {board} in a mirror: turn the board over, or flip the picture")
    if found is None:
        raise InputError(_not_found(picture, name, f"shows no board {board}"))
    return Marks(name, picture.shape, *found)


def _not_found(picture: NDArray[Any], name: str, what: str) -> str:
    """Say that there is no board, and why that is likely."""
    full = np.mean(picture == np.iinfo(picture.dtype).max) if picture.dtype.kind == "u" else 0.0
    if full > _FULL:
        return f"{name} {what}, and {full:.0%} of its pixels are saturated: expose it less"
    return f"{name} {what}: is all of it in the picture, sharp and evenly lit, and is it of that kind?"


def _find_markers(pictures: Iterable[_Scaled], board: Charuco) -> tuple[Doubles, Doubles] | None:
    """Return the corners of the markers of the family that has most of them in one of some pictures."""
    found = max(_seen_markers(pictures, board), key=lambda found: len(found[1]), default=None)
    if found is None:
        return None
    dictionary, numbers, corners = found
    told = []
    for legacy in (False, True):
        painted = board.opencv(dictionary)
        painted.setLegacyPattern(legacy)
        points = np.array(painted.getObjPoints(), np.float64)[numbers, :, :2]
        told.append(_upwards(points.reshape(-1, 2), board))
    places = corners.reshape(-1, 2)
    return min(told, key=lambda points: _unlike(points, places)), places


def _seen_markers(
    pictures: Iterable[_Scaled], board: Charuco
) -> Iterator[tuple[Any, NDArray[np.intp], Doubles]]:
    """Yield dictionaries with the numbers and corners, (n, 4, 2), of their markers in pictures."""
    families = {family: board.dictionary(family) for family in FAMILIES}
    families = {family: dictionary for family, dictionary in families.items() if dictionary is not None}
    for scale, picture in pictures:
        for family, dictionary in families.items():
            corners, numbers, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(picture)
            seen = np.empty(0, np.intp) if numbers is None else np.array(numbers, np.intp).ravel()
            known = np.flatnonzero(seen < board.columns * board.rows // 2)
            if known.size < _FEWEST_MARKERS:
                continue
            places = np.array(corners, np.float64).reshape(-1, 4, 2)[known]
            yield dictionary, seen[known], (places + 0.5) / scale - 0.5
            if known.size > _ENOUGH * board.columns * board.rows / 2:
                return
            families = {family: dictionary}
            break


def _sharper(grey: NDArray[np.uint8]) -> Iterator[_Scaled]:
    """Yield a picture, then larger and sharper ones, in which blurred markers can be read."""
    yield 1, grey
    for amount in (3.0, 8.0):
        fine = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 1.0)
        sharp = fine + amount * (fine - cv2.GaussianBlur(fine, (0, 0), 2.0))
        large = cv2.resize(sharp, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
        yield 2, np.clip(large, 0, 255).astype(np.uint8)


def _upwards(points: Doubles, board: Board) -> Doubles:
    """Bring points from the board's upper left corner, y down, to its middle, y up."""
    width, height = board.size
    return np.stack([points[:, 0] - width / 2, height / 2 - points[:, 1]], axis=1)


def _unlike(points: Doubles, places: Doubles) -> float:
    """Return how badly, pixels, a plane with points is seen at places."""
    plane, _ = cv2.findHomography(points, places, cv2.LMEDS)
    if plane is None:
        return float("inf")
    seen = cv2.perspectiveTransform(points[np.newaxis], plane)[0]
    return float(np.median(np.hypot(*(seen - places).T)))


def _find_dots(grey: NDArray[np.uint8], board: Dots) -> tuple[Doubles, Doubles] | None:
    """Return the dots of a grid, which may be dark or bright, in the order of the board."""
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
                places = np.array(centres, np.float64).reshape(-1, 2)
                return _unmirrored(board.marks(), places), places
    return None


def _unmirrored(points: Doubles, places: Doubles) -> Doubles:
    """Return the points of a grid, with columns from the other end if it would be seen in a mirror."""
    plane = np.linalg.lstsq(np.column_stack([points, np.ones(len(points))]), places, rcond=None)[0]
    # Columns run as x does, rows against y.
    return points * [-1, 1] if np.linalg.det(plane[:2]) > 0 else points


_BLUR = 1.0  # pixels
_STEPS = 20
_STILL = 1e-4  # pixels by which a place may move in the last step
_STEP = 0.25  # of the radius: the longest step
_WAY = 0.6  # of the radius: the longest way
_SPACING = 1.5  # pixels between samples,
_FEWEST, _MOST = 6, 24  # of which there are so many along a radius at least and at most
_UNLIKE = 0.3  # share of the picture's variance that may be asymmetric
_FAINT = 3.0  # counts, of a contrast of 255: the least standard deviation near a mark


def centre_marks(picture: NDArray[Any], starts: Doubles, radius: float) -> tuple[Doubles, NDArray[np.bool_]]:
    """Move places to where the picture around does not change when it is turned by half.

    A corner of a chessboard and a dot are such places, whatever symmetric blur there is, so this has no bias:
    I(q + d) = I(q - d). Solved for q by Gauss-Newton over the offsets d in a circle, weighed by
    (1 - d^2 / radius^2)^2, with the picture interpolated by cubic splines, after a slight blur: between the
    pixels of a sharp edge, splines swing.

    Parameters
    ----------
    picture : ndarray, (H, W)
        Of a contrast of about 255.
    starts : ndarray, (n, 2), float64
        Columns and rows.
    radius : float
        Pixels around a mark that are its own and symmetric.

    Returns
    -------
    places : ndarray, (n, 2), float64
    found : ndarray, (n,), bool
        Whether there is such a place near the start, all around it in the picture.
    """
    blurred = ndimage.gaussian_filter(np.asarray(picture, np.float64), _BLUR, mode="mirror")
    smooth = ndimage.spline_filter(blurred, order=3)
    offsets, weights = _circle(radius)
    places = np.array(starts, np.float64)
    step = np.full_like(places, np.inf)
    for _ in range(_STEPS):
        step = _step(smooth, places, offsets, weights, radius)
        places += step
        if np.abs(step).max(initial=0) < _STILL:
            break
    still = np.abs(step).max(axis=1) < 10 * _STILL
    near = np.hypot(*(places - starts).T) <= _WAY * radius
    inside = np.all((places >= radius) & (places <= np.array(picture.shape[::-1]) - 1 - radius), axis=1)
    return places, still & near & inside & _symmetric(smooth, places, offsets, weights)


def _circle(radius: float) -> tuple[Doubles, Doubles]:
    """Return offsets, (m, 2), in half a circle, and their weights; the other half is their mirror image."""
    count = min(max(math.ceil(radius / _SPACING), _FEWEST), _MOST)
    grid = np.arange(-count, count + 1) / count
    across, down = (one.ravel() for one in np.meshgrid(grid, grid))
    square = across**2 + down**2
    half = (square < 1) & ((down > 0) | ((down == 0) & (across > 0)))
    return np.stack([across, down], axis=1)[half] * radius, (1 - square[half]) ** 2


def _step(smooth: Doubles, places: Doubles, offsets: Doubles, weights: Doubles, radius: float) -> Doubles:
    """Return the Gauss-Newton step of each place, at most so long."""
    ahead, behind = places[:, np.newaxis] + offsets, places[:, np.newaxis] - offsets
    unlike = _look(smooth, ahead) - _look(smooth, behind)
    slope = _slopes(smooth, ahead) - _slopes(smooth, behind)
    normal = np.einsum("m,nmi,nmj->nij", weights, slope, slope) + 1e-9 * np.eye(2)
    pull = np.einsum("m,nmi,nm->ni", weights, slope, unlike)
    step = -np.linalg.solve(normal, pull[..., np.newaxis])[..., 0]
    length = np.hypot(*step.T)[:, np.newaxis]
    return np.asarray(step * np.minimum(1, _STEP * radius / np.maximum(length, 1e-12)))


def _symmetric(smooth: Doubles, places: Doubles, offsets: Doubles, weights: Doubles) -> NDArray[np.bool_]:
    """Tell around which places there is something to see, and how it is the same turned by half."""
    one, other = (_look(smooth, places[:, np.newaxis] + way * offsets) for way in (1, -1))
    share = weights / weights.sum()
    even, odd = (one + other) / 2, (one - other) / 2
    signal = (even - (even @ share)[:, np.newaxis]) ** 2 @ share
    return np.asarray((signal > _FAINT**2) & (odd**2 @ share < _UNLIKE * signal))


def _look(smooth: Doubles, places: Doubles) -> Doubles:
    """Return the picture at places, (..., 2)."""
    at = np.moveaxis(places, -1, 0)[::-1]
    return np.asarray(ndimage.map_coordinates(smooth, at, order=3, prefilter=False, mode="mirror"))


def _slopes(smooth: Doubles, places: Doubles) -> Doubles:
    """Return the picture's slopes along columns and rows, (..., 2), by differences over half a pixel."""
    ways = np.eye(2) / 4
    return np.stack(
        [2 * (_look(smooth, places + way) - _look(smooth, places - way)) for way in ways], axis=-1
    )
