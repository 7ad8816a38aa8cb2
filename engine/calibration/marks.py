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

_SATURATED = 0.3  # share of saturated pixels above which a message names them as the reason
_LEAST_DOT = 9.0  # pixels: least area of a dot
_FEWEST_MARKERS = 3  # of a picture
_ENOUGH = 0.5  # share of a board's markers with which sharpened pictures are not searched

_BLUR = 1.0  # pixels, standard deviation
_STEPS = 20  # Gauss-Newton steps, at most
_CONVERGED = 1e-4  # pixels: size of the last step
_STEP, _SHIFT = 0.25, 0.6  # longest step, and longest distance from the start, as shares of the radius
_SPACING, _FEWEST_SAMPLES, _MOST_SAMPLES = 1.5, 6, 24  # pixels between samples along a radius; their number
_ASYMMETRIC = 0.3  # greatest share of the variance around a mark that is asymmetric
_FAINT = 3.0  # counts, at a contrast of 255: least standard deviation around a mark


@dataclass(frozen=True, slots=True, eq=False)
class Marks:
    """Marks of a board that were found in a picture."""

    name: str  # of the picture, for messages
    shape: tuple[int, int]  # rows and columns of the picture
    board: Doubles  # (n, 2): positions on the board, mm from its middle, y up
    places: Doubles  # (n, 2): column and row in the picture, 0 for the first
    radius: float = 0.0  # of dots, mm; 0 for corners


def stretch_contrast(picture: NDArray[Any], name: str) -> Doubles:
    """Scale a picture so that its 0.5 % and 99.5 % quantiles are 0 and 255."""
    samples = np.asarray(picture, np.float64)
    if not np.isfinite(samples).all():
        raise InputError(f"{name} has samples that are not finite: take the picture again")
    low, high = np.percentile(samples, [0.5, 99.5])
    if high <= low:
        raise InputError(_not_found(picture, name, "shows nothing: its brightness is the same everywhere"))
    return np.asarray((samples - low) * (255 / (high - low)))


def find_marks(picture: NDArray[Any], board: Board, name: str) -> Marks:
    """Find the corners of a ChArUco board's markers (four each, marker by marker), or dots, approximately."""
    grey = np.clip(np.rint(stretch_contrast(picture, name)), 0, 255).astype(np.uint8)
    if isinstance(board, Dots):
        positions = _find_dots(grey, board)
    else:
        positions = _find_markers(_sharpened(grey), board)
        if positions is None and _find_markers(iter([(1, grey[:, ::-1].copy())]), board):
            raise InputError(f"{name} shows {board} in a mirror: turn the board over, or flip the picture")
    if positions is None:
        raise InputError(_not_found(picture, name, f"shows no board {board}"))
    return Marks(name, picture.shape, *positions)


def _not_found(picture: NDArray[Any], name: str, problem: str) -> str:
    full = np.mean(picture == np.iinfo(picture.dtype).max) if picture.dtype.kind == "u" else 0.0
    if full > _SATURATED:
        return f"{name} {problem}, and {full:.0%} of its pixels are saturated: expose it less"
    return f"{name} {problem}: is all of it in the picture, sharp and evenly lit, and is it of that kind?"


def _find_markers(
    pictures: Iterator[tuple[int, NDArray[np.uint8]]], board: Charuco
) -> tuple[Doubles, Doubles] | None:
    """Return the corners of the markers in the (scale, picture) that has most of them."""
    import cv2

    most = max(_detect_markers(pictures, board), key=lambda detected: len(detected[1]), default=None)
    if most is None:
        return None
    dictionary, numbers, corners = most
    places = corners.reshape(-1, 2)
    width, height = board.size
    candidates = []
    for legacy in (False, True):
        layout = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square, board.marker, dictionary)
        layout.setLegacyPattern(legacy)
        points = np.array(layout.getObjPoints(), np.float64)[numbers, :, :2].reshape(-1, 2)
        # OpenCV's origin is the board's upper left corner, with y down; here it is the middle, with y up.
        candidates.append(np.stack([points[:, 0] - width / 2, height / 2 - points[:, 1]], axis=1))
    return min(candidates, key=lambda points: _plane_error(points, places)), places


def _detect_markers(
    pictures: Iterator[tuple[int, NDArray[np.uint8]]], board: Charuco
) -> Iterator[tuple[Any, NDArray[np.intp], Doubles]]:
    """Yield dictionaries with the numbers and corners, (n, 4, 2), of their markers in (scale, picture)s."""
    import cv2

    dictionaries = board.dictionaries()
    for scale, picture in pictures:
        for dictionary in dictionaries:
            corners, numbers, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(picture)
            seen = np.empty(0, np.intp) if numbers is None else np.array(numbers, np.intp).ravel()
            on_board = np.flatnonzero(seen < board.markers)
            if on_board.size < _FEWEST_MARKERS:
                continue
            places = np.array(corners, np.float64).reshape(-1, 4, 2)[on_board]
            yield dictionary, seen[on_board], (places + 0.5) / scale - 0.5
            if on_board.size > _ENOUGH * board.columns * board.rows / 2:
                return
            dictionaries = [dictionary]
            break


def _sharpened(grey: NDArray[np.uint8]) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Yield (scale, picture): the picture, then enlarged and sharpened ones, which show blurred markers."""
    import cv2

    yield 1, grey
    for amount in (3.0, 8.0):
        fine = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 1.0)
        sharp = fine + amount * (fine - cv2.GaussianBlur(fine, (0, 0), 2.0))
        large = cv2.resize(sharp, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
        yield 2, np.clip(large, 0, 255).astype(np.uint8)


def _plane_error(points: Doubles, places: Doubles) -> float:
    """Return the median distance, pixels, of points of a plane from their places, after a homography."""
    import cv2

    plane, _ = cv2.findHomography(points, places, cv2.LMEDS)
    if plane is None:
        return float("inf")
    seen = cv2.perspectiveTransform(points[np.newaxis], plane)[0]
    return float(np.median(np.hypot(*(seen - places).T)))


def _find_dots(grey: NDArray[np.uint8], board: Dots) -> tuple[Doubles, Doubles] | None:
    """Return the dots of a grid, dark or bright, in the order of the board."""
    import cv2

    settings = cv2.SimpleBlobDetector_Params()  # type: ignore[attr-defined]
    settings.minArea, settings.maxArea = _LEAST_DOT, grey.size / (board.columns * board.rows)
    if settings.maxArea <= settings.minArea:  # fewer pixels than the dots need
        return None
    settings.minDistBetweenBlobs = 3.0
    detector = cv2.SimpleBlobDetector_create(settings)  # type: ignore[attr-defined]
    for picture in (grey, 255 - grey):
        for flags in (cv2.CALIB_CB_SYMMETRIC_GRID, cv2.CALIB_CB_SYMMETRIC_GRID | cv2.CALIB_CB_CLUSTERING):
            complete, centres = cv2.findCirclesGrid(
                picture, (board.columns, board.rows), flags=flags, blobDetector=detector
            )
            if complete:
                places, points = np.array(centres, np.float64).reshape(-1, 2), board.marks()
                fit = np.linalg.lstsq(np.column_stack([points, np.ones(len(points))]), places, rcond=None)[0]
                # Rows run against y: otherwise OpenCV numbered the grid as in a mirror.
                return points * [-1, 1] if np.linalg.det(fit[:2]) > 0 else points, places
    return None


# --- centring -----------------------------------------------------------------------------------------------


def centre_marks(picture: NDArray[Any], starts: Doubles, radius: float) -> tuple[Doubles, NDArray[np.bool_]]:
    """Move places to the centres of point symmetry: I(q + d) = I(q - d) for the offsets d in a circle.

    A corner of a chessboard and a dot are such centres under any symmetric blur, so q has no bias. It is
    found by Gauss-Newton steps with the weights (1 - d^2 / radius^2)^2. The picture is interpolated by cubic
    splines after a slight blur, because splines oscillate next to a sharp edge.

    ``picture`` has a contrast of about 255, ``starts`` are columns and rows, (n, 2), and ``radius`` is the
    circle's, pixels. Returned are the places, and whether there is such a centre near the start, with the
    whole circle in the picture.
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
    near = np.hypot(*(places - starts).T) <= _SHIFT * radius
    inside = np.all((places >= radius) & (places <= np.array(picture.shape[::-1]) - 1 - radius), axis=1)
    return places, still & near & inside & _is_symmetric(smooth, places, offsets, weights)


def _half_disc(radius: float) -> tuple[Doubles, Doubles]:
    """Return offsets, (m, 2), in half a disc, and their weights; the other half is symmetric."""
    count = min(max(math.ceil(radius / _SPACING), _FEWEST_SAMPLES), _MOST_SAMPLES)
    grid = np.arange(-count, count + 1) / count
    x, y = (axis.ravel() for axis in np.meshgrid(grid, grid))
    square = x**2 + y**2
    half = (square < 1) & ((y > 0) | ((y == 0) & (x > 0)))
    return np.stack([x, y], axis=1)[half] * radius, (1 - square[half]) ** 2


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
    """Return which places have enough contrast around them, most of it symmetric."""
    ahead, behind = (_interpolate(smooth, places[:, np.newaxis] + sign * offsets) for sign in (1, -1))
    share = weights / weights.sum()
    even, odd = (ahead + behind) / 2, (ahead - behind) / 2
    signal = (even - (even @ share)[:, np.newaxis]) ** 2 @ share
    return np.asarray((signal > _FAINT**2) & (odd**2 @ share < _ASYMMETRIC * signal))


def _interpolate(smooth: Doubles, places: Doubles) -> Doubles:
    """Return the picture's values at places, (..., 2)."""
    from scipy import ndimage

    coordinates = np.moveaxis(places, -1, 0)[::-1]
    return np.asarray(ndimage.map_coordinates(smooth, coordinates, order=3, prefilter=False, mode="mirror"))


def _gradient(smooth: Doubles, places: Doubles) -> Doubles:
    """Return the picture's slopes along columns and rows, (..., 2), by differences over half a pixel."""
    steps = np.eye(2) / 4
    slopes = [2 * (_interpolate(smooth, places + h) - _interpolate(smooth, places - h)) for h in steps]
    return np.stack(slopes, axis=-1)
