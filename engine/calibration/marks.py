"""The marks of a board in a picture: found by OpenCV, then centred to a few hundredths of a pixel."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.calibration.board import Board, Charuco, Dots
from mirrorskin.io import InputError
from mirrorskin.kernels.array_types import Doubles

Singles = NDArray[np.float32]
Bytes = NDArray[np.uint8]

_SATURATED = 0.3  # share of saturated pixels above which a message states them as the reason
_LEAST_DOT = 9.0  # pixels: minimum area of a dot
_RANGE = 0.5, 99.5  # percentiles between which a picture's contrast is measured
_LEAST_MARKER = 12.0  # pixels: minimum side of a marker
_FEWEST_MARKERS = 3  # minimum number of markers in a picture
_ENOUGH_MARKERS = 0.5  # share of a board's markers from which on sharpened pictures are not searched
_SAME_BOARD = 0.7  # minimum share of the markers of a clear picture that are on one plane
_OFF_PLANE = 0.35  # maximum distance of a marker's corner from the plane of others, as a share of its side
_OFF_GRID = 0.25  # maximum distance of a dot from the grid, as a share of the pitch
_MOST_BLOBS = 2  # maximum number of blobs per dot that are searched
_DARK = 25.0  # brightness, at a contrast of 255, below which details are not normalised by brightness
_LIGHT = 16  # parts of a picture's longer side within which the light is assumed to be even

_SEARCH_BLUR = 1.0  # pixels, standard deviation
_MAX_STEPS = 20  # maximum number of Gauss-Newton steps
_CONVERGED = 1e-4  # pixels: size of the last step
_STEP, _SHIFT = 0.25, 0.6  # longest step, and longest distance from the start, as shares of the radius
_SPACING, _FEWEST_SAMPLES, _MOST_SAMPLES = 1.5, 6, 24  # pixels between samples along a radius; their number
_UNEVEN = 8.0  # F ratio of the light's slopes and of their noise above which the picture is corrected
_ASYMMETRIC = 0.3  # greatest share of the variance around a mark that is asymmetric
_MIN_CONTRAST = 3.0  # counts, at a contrast of 255: least standard deviation around a mark


@dataclass(frozen=True, slots=True, eq=False)
class Marks:
    """Marks of a board that were found in a picture."""

    name: str  # name of the picture, for messages
    shape: tuple[int, int]  # rows and columns of the picture
    board: Doubles  # (n, 2): positions on the board, mm from its middle, y up
    places: Doubles  # (n, 2): column and row in the picture, 0 for the first
    radius: float = 0.0  # of dots, mm; 0 for corners


def scale_contrast(picture: NDArray[Any], name: str) -> Doubles:
    """Scale a picture so that its 0.5 % and 99.5 % quantiles differ by 255; 0 stays 0."""
    samples = np.asarray(picture, np.float64)
    if not np.isfinite(samples).all():
        raise InputError(f"{name} has samples that are not finite: take the picture again")
    low, high = np.percentile(samples, _RANGE)
    if high <= low:
        raise InputError(_not_found(picture, name, "shows nothing: its brightness is the same everywhere"))
    return np.asarray(samples * (255 / (high - low)))


def find_marks(picture: NDArray[Any], board: Board, name: str) -> Marks:
    """Find approximate positions of the markers' corners of a ChArUco board (four each), or of dots."""
    scaled = np.asarray(scale_contrast(picture, name), np.float32)
    if isinstance(board, Dots):
        positions = _find_dots(scaled, board)
    else:
        positions = _find_markers(_marker_pictures(scaled), board)
        if positions is None and _find_markers([(1, _as_bytes(scaled[:, ::-1]))], board):
            raise InputError(f"{name} shows {board} in a mirror: turn the board over, or flip the picture")
    if positions is None:
        raise InputError(_not_found(picture, name, f"shows no board {board}"))
    return Marks(name, picture.shape, *positions)


def _not_found(picture: NDArray[Any], name: str, problem: str) -> str:
    full = np.mean(picture == np.iinfo(picture.dtype).max) if picture.dtype.kind == "u" else 0.0
    if full > _SATURATED:
        return f"{name} {problem}, and {full:.0%} of its pixels are saturated: expose it less"
    return f"{name} {problem}: is all of it in the picture, sharp and evenly lit, and is it of that kind?"


def _as_bytes(samples: NDArray[Any]) -> Bytes:
    """Return a picture whose 0.5 % and 99.5 % quantiles are 0 and 255."""
    low, high = np.percentile(samples, _RANGE)
    shown = np.clip(np.rint((samples - low) * (255 / max(high - low, 1e-9))), 0, 255)
    return np.asarray(shown, np.uint8)


def _band(scaled: Singles, fine: float, coarse: float) -> Singles:
    """Return details between two widths, pixels, relative to the brightness around them."""
    import cv2

    near, far = (cv2.GaussianBlur(scaled, (0, 0), width) for width in (fine, coarse))
    return np.asarray((near - far) / np.maximum(far, _DARK), np.float32)


def _find_markers(pictures: Iterable[tuple[int, Bytes]], board: Charuco) -> tuple[Doubles, Doubles] | None:
    """Return the corners of the markers in pairs (scale, picture) that are on one plane.

    If the first picture shows many markers, most of them in another arrangement, all of these are returned.
    """
    corners_by_layout: dict[
        int, list[tuple[Doubles, Doubles]]
    ] = {}  # by layout: corners on the board, and their places
    families = [(dictionary, _layouts(board, dictionary)) for dictionary in board.dictionaries()]
    best: tuple[Doubles, Doubles] | None = None
    for scale, picture in pictures:
        for family in families:
            numbers, places = _detect_markers(picture, family[0], board.markers)
            for layout in family[1]:
                markers = corners_by_layout.setdefault(id(layout), [])
                markers.append((layout[numbers], (places + 0.5) / scale - 0.5))
                planar = _on_one_plane(markers)
                if planar is not None and (best is None or len(planar[0]) > len(best[0])):
                    best, families = planar, [family]
        if best is not None and len(best[0]) > 4 * _ENOUGH_MARKERS * board.markers:
            break
    points, places = max(
        (markers[0] for markers in corners_by_layout.values()), key=lambda pair: len(pair[0])
    )
    consistent = 0 if best is None else len(best[0]) // 4
    if len(points) > max(_ENOUGH_MARKERS * board.markers, consistent / _SAME_BOARD):
        return points.reshape(-1, 2), places.reshape(-1, 2)
    return best


def _layouts(board: Charuco, dictionary: Any) -> list[Doubles]:
    """Return the corners of all markers, (n, 4, 2), on the present and on the former boards of OpenCV."""
    import cv2

    layouts = []
    for legacy in (False, True):
        layout = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square, board.marker, dictionary)
        layout.setLegacyPattern(legacy)
        corners = np.array(layout.getObjPoints(), np.float64)[..., :2]
        # OpenCV's origin is the board's upper left corner, with y down; here it is the middle, with y up.
        layouts.append((corners - np.array(board.size) / 2) * [1, -1])
    return layouts


def _detect_markers(picture: Bytes, dictionary: Any, count: int) -> tuple[NDArray[np.intp], Doubles]:
    """Return the numbers of markers below a count, and their corners, (n, 4, 2); some are wrong."""
    import cv2

    settings = cv2.aruco.DetectorParameters()
    settings.minMarkerPerimeterRate = 4 * _LEAST_MARKER / max(picture.shape)
    settings.adaptiveThreshWinSizeMax, settings.adaptiveThreshWinSizeStep = 63, 20
    settings.adaptiveThreshConstant = 3
    settings.polygonalApproxAccuracyRate = 0.06
    settings.perspectiveRemovePixelPerCell, settings.perspectiveRemoveIgnoredMarginPerCell = 8, 0.25
    settings.errorCorrectionRate = 1.0
    corners, numbers, _ = cv2.aruco.ArucoDetector(dictionary, settings).detectMarkers(picture)
    ids = np.empty(0, np.intp) if numbers is None else np.array(numbers, np.intp).ravel()
    places = np.array(corners, np.float64).reshape(-1, 4, 2)
    return ids[ids < count], places[ids < count]


def _on_one_plane(markers: list[tuple[Doubles, Doubles]]) -> tuple[Doubles, Doubles] | None:
    """Return the corners of the markers that a homography maps to their places; None if there are too few."""
    import cv2

    points, places = (np.concatenate(parts) for parts in zip(*markers, strict=True))
    if len(points) < _FEWEST_MARKERS:
        return None
    side = float(np.median(np.linalg.norm(places - np.roll(places, 1, axis=1), axis=2)))
    plane, _ = cv2.findHomography(points.reshape(-1, 2), places.reshape(-1, 2), cv2.RANSAC, _OFF_PLANE * side)
    if plane is None:
        return None
    errors = np.linalg.norm(cv2.perspectiveTransform(points, plane) - places, axis=2).max(axis=1)
    order = np.argsort(errors)
    first = np.unique(points[order, 0], axis=0, return_index=True)[1]  # the best of each marker
    good = order[first][errors[order[first]] < _OFF_PLANE * side]
    if len(good) < _FEWEST_MARKERS:
        return None
    return points[good].reshape(-1, 2), places[good].reshape(-1, 2)


def _marker_pictures(scaled: Singles) -> Iterator[tuple[int, Bytes]]:
    """Yield (scale, picture): the picture, then evenly lit, enlarged and sharpened ones."""
    import cv2

    yield 1, _as_bytes(scaled)
    even = _band(scaled, 0.5, max(scaled.shape) / _LIGHT)
    for fine, amount in ((1.0, 3.0), (1.5, 8.0), (2.0, 8.0)):
        smooth = cv2.GaussianBlur(even, (0, 0), fine)
        sharp = smooth + amount * (smooth - cv2.GaussianBlur(smooth, (0, 0), 2 * fine))
        yield 2, _as_bytes(cv2.resize(sharp, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC))


def _find_dots(scaled: Singles, board: Dots) -> tuple[Doubles, Doubles] | None:
    """Return the dots of a grid, dark or bright, in the order of the board."""
    import cv2

    count, points = board.columns * board.rows, board.marks()
    settings = cv2.SimpleBlobDetector_Params()  # type: ignore[attr-defined]
    settings.minArea, settings.maxArea = _LEAST_DOT, scaled.size / count
    if settings.maxArea <= settings.minArea:  # fewer pixels than the dots need
        return None
    settings.minDistBetweenBlobs = 3.0
    detector = cv2.SimpleBlobDetector_create(settings)  # type: ignore[attr-defined]
    for picture in _dot_pictures(scaled, math.sqrt(settings.maxArea)):
        blobs = np.array([blob.pt for blob in detector.detect(picture)], np.float32).reshape(-1, 1, 2)
        if not count <= len(blobs) <= _MOST_BLOBS * count:
            continue
        for flags in (cv2.CALIB_CB_SYMMETRIC_GRID, cv2.CALIB_CB_SYMMETRIC_GRID | cv2.CALIB_CB_CLUSTERING):
            complete, centres = cv2.findCirclesGrid(  # type: ignore[call-overload]  # None: places of blobs
                blobs, (board.columns, board.rows), flags, None, cv2.CirclesGridFinderParameters()
            )
            if not complete:
                continue
            places = np.array(centres, np.float64).reshape(-1, 2)
            plane, _ = cv2.findHomography(points, places, cv2.LMEDS)
            if plane is None:
                continue
            errors = cv2.perspectiveTransform(points[np.newaxis], plane)[0] - places
            steps = np.diff(places.reshape(board.rows, board.columns, 2), axis=1)
            if np.hypot(*errors.T).max() < _OFF_GRID * np.median(np.linalg.norm(steps, axis=2)):
                # Rows run against y: otherwise OpenCV numbered the grid as in a mirror.
                return points * [1 if np.linalg.det(plane) < 0 else -1, 1], places
    return None


def _dot_pictures(scaled: Singles, pitch: float) -> Iterator[Bytes]:
    """Yield the picture, then evenly lit and smoother ones, each with dark and with bright dots."""
    yield from (grey := _as_bytes(scaled), 255 - grey)
    width = 2.0
    while width == 2.0 or width < pitch / 8:
        band = _as_bytes(_band(scaled, width, 3 * width))
        yield from (band, 255 - band)
        width *= 1.5


# --- centring -----------------------------------------------------------------------------------------------


def centre_marks(picture: NDArray[Any], starts: Doubles, radius: float) -> tuple[Doubles, NDArray[np.bool_]]:
    """Move places to the centres of point symmetry: I(q + d) = I(q - d) for the offsets d in a circle.

    A corner of a chessboard and a dot are such centres under any symmetric blur, so q is unbiased. It is
    found by Gauss-Newton steps with the weights (1 - d^2 / radius^2)^2. The picture is interpolated by cubic
    splines after a slight blur, because splines oscillate next to a sharp edge.

    A gradient of the light shifts such a centre. The light is estimated from the asymmetries around all
    marks, as the exponential of a quadratic polynomial, and the picture is divided by it.

    ``picture`` has a contrast of about 255, ``starts`` are columns and rows, (n, 2), and ``radius`` is the
    radius of the circle, pixels. Return the positions, and whether there is such a centre near the start with
    the whole circle in the picture.
    """
    from scipy import ndimage

    blurred = ndimage.gaussian_filter(np.asarray(picture, np.float64), _SEARCH_BLUR, mode="mirror")
    disc = _half_disc(radius)
    places, inside, light = np.array(starts, np.float64), np.ones(len(starts), bool), np.ones_like(blurred)
    for last in (False, True):
        smooth = ndimage.spline_filter(blurred / light, order=3)
        places, still = _centre(smooth, places, *disc, radius)
        near = np.hypot(*(places - starts).T) <= _SHIFT * radius
        inside = np.all((places >= radius) & (places <= np.array(picture.shape[::-1]) - 1 - radius), axis=1)
        accepted = still & near & inside & _is_symmetric(smooth, places, *disc)
        if last or not accepted.any():
            break
        light = _light(smooth, places[accepted], *disc)
    return places, accepted


def _centre(
    smooth: Doubles, places: Doubles, offsets: Doubles, weights: Doubles, radius: float
) -> tuple[Doubles, NDArray[np.bool_]]:
    """Return centres of symmetry near places, and which of the iterations converged."""
    step = np.full_like(places, np.inf)
    for _ in range(_MAX_STEPS):
        step = _gauss_newton_step(smooth, places, offsets, weights)
        length = np.hypot(*step.T)[:, np.newaxis]
        step *= np.minimum(1, _STEP * radius / np.maximum(length, 1e-12))
        places = places + step
        if np.abs(step).max(initial=0) < _CONVERGED:
            break
    return places, np.abs(step).max(axis=1) < 10 * _CONVERGED


def _light(smooth: Doubles, places: Doubles, offsets: Doubles, weights: Doubles) -> Doubles:
    """Return the light of all pixels, estimated from the asymmetry of marks; 1 if insignificant."""
    slopes = -_gauss_newton_step(smooth, places, offsets, weights, light=True)[:, 2:] / 2
    rows, columns = smooth.shape
    (x, y), ones, zeros = (places - [columns / 2, rows / 2]).T, np.ones(len(places)), np.zeros(len(places))
    terms = np.hstack([[ones, zeros, x, y, zeros], [zeros, ones, zeros, x, y]]).T
    measured = slopes.T.ravel()
    solution = np.linalg.lstsq(terms, measured, rcond=None)[0]
    explained = float(np.sum((terms @ solution) ** 2)) / len(solution)
    free = len(measured) - len(solution)
    if free < 1 or explained < _UNEVEN * float(np.sum((measured - terms @ solution) ** 2)) / free:
        return np.ones_like(smooth)
    across, down, xx, xy, yy = solution
    x, y = np.arange(columns) - columns / 2, (np.arange(rows) - rows / 2)[:, np.newaxis]
    return np.asarray(np.exp(across * x + down * y + xx * x**2 / 2 + xy * x * y + yy * y**2 / 2))


def _half_disc(radius: float) -> tuple[Doubles, Doubles]:
    """Return offsets, (m, 2), in half a disc, and their weights; the other half is symmetric."""
    count = min(max(math.ceil(radius / _SPACING), _FEWEST_SAMPLES), _MOST_SAMPLES)
    grid = np.arange(-count, count + 1) / count
    x, y = (axis.ravel() for axis in np.meshgrid(grid, grid))
    square = x**2 + y**2
    half = (square < 1) & ((y > 0) | ((y == 0) & (x > 0)))
    return np.stack([x, y], axis=1)[half] * radius, (1 - square[half]) ** 2


def _gauss_newton_step(
    smooth: Doubles, places: Doubles, offsets: Doubles, weights: Doubles, light: bool = False
) -> Doubles:
    """Return the step of each place; with the light, also minus twice its relative slopes."""
    ahead, behind = places[:, np.newaxis] + offsets, places[:, np.newaxis] - offsets
    forward, backward = _interpolate(smooth, ahead), _interpolate(smooth, behind)
    slope = _gradient(smooth, ahead) - _gradient(smooth, behind)
    if light:
        mean = (forward + backward)[..., np.newaxis] / 2
        slope = np.concatenate([slope, mean * offsets], axis=-1)
    normal = np.einsum("m,nmi,nmj->nij", weights, slope, slope) + 1e-9 * np.eye(slope.shape[-1])
    pull = np.einsum("m,nmi,nm->ni", weights, slope, forward - backward)
    return np.asarray(-np.linalg.solve(normal, pull[..., np.newaxis])[..., 0])


def _is_symmetric(smooth: Doubles, places: Doubles, offsets: Doubles, weights: Doubles) -> NDArray[np.bool_]:
    """Return which places have enough contrast around them, most of it symmetric."""
    ahead, behind = (_interpolate(smooth, places[:, np.newaxis] + sign * offsets) for sign in (1, -1))
    relative_weights = weights / weights.sum()
    even, odd = (ahead + behind) / 2, (ahead - behind) / 2
    signal = (even - (even @ relative_weights)[:, np.newaxis]) ** 2 @ relative_weights
    return np.asarray((signal > _MIN_CONTRAST**2) & (odd**2 @ relative_weights < _ASYMMETRIC * signal))


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
