"""The marks of a board in a picture: found by OpenCV, then centred to a few hundredths of a pixel."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.calibration.board import Board, Charuco, Dots
from mirrorskin.io import InputError

Doubles = NDArray[np.float64]

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


@dataclass(frozen=True, slots=True, eq=False)
class Marks:
    """Marks of a board that were found in a picture."""

    name: str  # of the picture, for messages
    shape: tuple[int, int]  # its rows and columns
    board: Doubles  # (n, 2): where they are on the board, mm from its middle, y up
    places: Doubles  # (n, 2): where they are seen, column and row, 0 in the first
    radius: float = 0.0  # of dots, mm; 0 of corners


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
    if settings.maxArea <= settings.minArea:  # too few pixels for so many dots
        return None
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
