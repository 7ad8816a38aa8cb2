"""The scale and distortion of a camera, from pictures of a board that lies on the sheet."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import spatial

from mirrorskin.engine.calibration.lens.board import FEWEST, Board, Charuco
from mirrorskin.engine.calibration.lens.camera import CameraFit
from mirrorskin.engine.calibration.lens.marks import Marks, find_marks, stretched
from mirrorskin.engine.calibration.lens.symmetry import centre_marks
from mirrorskin.io import InputError, Lens

Doubles = NDArray[np.float64]

_ROUNDS = 8  # of looking where a fit to the marks so far has those beside them
_BESIDE = 1.5  # of the pitch: how far beside
_FEWEST_YET = 6  # marks, before all are looked for
_LEAST_REACH, _MOST_REACH = 2.5, 12.0  # pixels around a mark; more is needed of dots only
_FAR = 0.2  # of the pitch: how far a mark may be found from where it must be
_OFF = 0.6  # pixels RMS by which pictures of one board may differ from one plane,
_OFF_SHARE = 3e-4  # or this share of the picture's diagonal
_MARKER = 0.1  # share by which the markers' size may differ from what was told


@dataclass(frozen=True, slots=True, eq=False)
class LensFit:
    """A lens, and how well it is known.

    Attributes
    ----------
    lens : Lens
    marks : tuple of int
        How many marks were found in each picture.
    errors : tuple of float
        RMS distance, pixels, of each picture's marks from where the fit has them.
    worst : float
        The largest distance of all, pixels.
    corner_sigma : float
        Standard error, pixels, of where the map is seen nine tenths of the way to its corners; NaN where that
        is not seen. Pictures with the board near the corners make it less.
    """

    lens: Lens
    marks: tuple[int, ...]
    errors: tuple[float, ...]
    worst: float
    corner_sigma: float


def calibrate_lens(pictures: Sequence[tuple[str, NDArray[Any]]], board: Board) -> LensFit:
    """Learn a camera's scale and distortion from pictures of one board on the sheet.

    Parameters
    ----------
    pictures : sequence of (str, ndarray)
        Names for messages, and pictures, (H, W), uint8, uint16 or float32, all of one size. In each the board
        lies flat on the sheet, anywhere and turned in any way.
    board : Charuco or Dots

    Returns
    -------
    LensFit

    Raises
    ------
    mirrorskin.io.InputError
        The board is not found in a picture, or too little of it; it is of another kind, or does not lie on
        one plane; pictures of different sizes.
    """
    if not pictures:
        raise InputError("there is no picture of a board: give at least one")
    first = pictures[0]
    for name, picture in pictures:
        if picture.shape != first[1].shape:
            sizes = " and ".join(f"{one.shape[1]} x {one.shape[0]}" for one in (first[1], picture))
            raise InputError(f"{first[0]} and {name} differ: {sizes} pixels: take all with one camera")
    return fit_lens([locate_marks(picture, board, name) for name, picture in pictures])


def locate_marks(picture: NDArray[Any], board: Board, name: str) -> Marks:
    """Find the marks of a board to a few hundredths of a pixel.

    What OpenCV finds tells a first lens, which tells where all marks must be; there they are centred, see
    `mirrorskin.engine.calibration.lens.symmetry`.

    Raises
    ------
    mirrorskin.io.InputError
        As for `calibrate_lens`.
    """
    rough = find_marks(picture, board, name)
    fit = CameraFit.of([rough])
    _check_kind(rough, board, fit)
    sharp, known, marks = stretched(picture, name), rough.board, rough
    for _ in range(_ROUNDS):
        beside = spatial.KDTree(known).query(board.marks())[0] < _BESIDE * board.pitch
        marks = _centred(sharp, board, fit, beside, name)
        _check_number(marks, board, _FEWEST_YET)
        fit = CameraFit.of([marks])
        if len(marks.board) == len(known):
            break
        known = marks.board
    _check_number(marks, board, FEWEST)
    _check_plane([marks], fit.errors())
    return marks


def _centred(picture: Doubles, board: Board, fit: CameraFit, wanted: NDArray[np.bool_], name: str) -> Marks:
    """Return those of the wanted marks that are found close to where a fit has them."""
    points = board.marks()[wanted]
    starts, pitch = fit.places(0, points), _pitch(fit.places(0, board.marks()))
    places, found = centre_marks(picture, starts, max(_LEAST_REACH, _reach(board, pitch)))
    found &= np.hypot(*(places - starts).T) < max(1.0, _FAR * pitch)
    points, places = points[found], places[found]
    if len(points) == 0 or isinstance(board, Charuco):
        return Marks(name, picture.shape, points, places)
    radius = _dot_radius(picture, places, pitch) / pitch * board.pitch
    return Marks(name, picture.shape, points, places, radius)


def fit_lens(pictures: Sequence[Marks]) -> LensFit:
    """Fit one camera to marks that were found in several pictures.

    All boards lie on one plane. A point (x, y) of it is seen by the ray H (x, y, 1), H a homography; the
    ray is distorted about the picture's centre, in units of half its diagonal. A plane tells neither
    a focal length nor where the lens's axis is: H and the tangential terms hold what these would change. It
    is a fit of least squares, with a loss that grows linearly from three standard deviations on. What boards
    that fill little of the picture do not tell of the distortion is taken to be small, as of common lenses.

    The sheet's axes are turned so that the map, seen at the picture's centre, is stretched but not turned.
    Its pixels are as large as those of the picture there are in the mean.

    Parameters
    ----------
    pictures : sequence of Marks

    Returns
    -------
    LensFit

    Raises
    ------
    mirrorskin.io.InputError
        The boards do not lie on one plane.
    """
    fit = CameraFit.of(pictures)
    errors = fit.errors()
    _check_plane(pictures, errors)
    scale_sigma, corner_sigma = fit.uncertainty()
    everything = np.concatenate(fit.distances())
    error = float(np.sqrt(np.mean(np.sum(everything**2, axis=1))))
    lens = replace(fit.lens(), error=error, scale_sigma=scale_sigma)
    marks = tuple(len(one.board) for one in pictures)
    return LensFit(lens, marks, errors, float(np.hypot(*everything.T).max()), corner_sigma)


def _check_kind(rough: Marks, board: Board, fit: CameraFit) -> None:
    """Refuse a picture whose marks do not lie as on the board."""
    seen = fit.places(0, rough.board)
    pitch = _pitch(fit.places(0, board.marks()))
    off = np.hypot(*(seen - rough.places).T)
    if np.mean(off < max(2.0, _FAR * pitch)) < 0.7:
        raise InputError(f"{rough.name} shows another board than {board}: count its columns and rows")
    if isinstance(board, Charuco):
        sides = [_sides(one.reshape(-1, 4, 2)) for one in (rough.places, seen)]
        marker = board.marker * float(np.median(sides[0] / sides[1]))
        if abs(marker / board.marker - 1) > _MARKER:
            raise InputError(
                f"{rough.name} shows another board than {board}: where squares have {board.square:g} mm, "
                f"its markers have {marker:.3g} mm: measure both"
            )


def _check_plane(pictures: Sequence[Marks], errors: Sequence[float]) -> None:
    """Refuse marks that do not fit one plane."""
    if max(errors) > max(_OFF, _OFF_SHARE * math.hypot(*pictures[0].shape)):
        worst = pictures[int(np.argmax(errors))].name
        raise InputError(
            f"{worst} does not fit a flat board on the sheet: marks are off by {max(errors):.2g} pixels RMS:"
            " lay the board flat, take it sharp, and leave the camera as it is from picture to picture"
        )


def _check_number(marks: Marks, board: Board, fewest: int) -> None:
    """Refuse a picture with too few marks, or with marks in too few lines."""
    count = len(marks.board)
    lines = min(len(np.unique(np.rint(axis / board.pitch * 2))) for axis in marks.board.T)
    if count < fewest or lines < 3:
        raise InputError(
            f"{marks.name}: only {count} of {len(board.marks())} marks of {board} are seen, and {FEWEST} in 3"
            " lines are needed: bring more of it into the picture, sharp and evenly lit"
        )


def _reach(board: Board, pitch: float) -> float:
    """Return how far around a mark its picture is symmetric and tells something, pixels."""
    if not isinstance(board, Charuco):
        return 0.45 * pitch
    # Up to the first cell inside the markers' black border, of a ninth of a marker at least.
    clear = math.sqrt(2) * ((board.square - board.marker) / 2 + board.marker / 9) / board.square
    return min(0.9 * clear * pitch, _MOST_REACH)


def _pitch(places: Doubles) -> float:
    """Return the least distance of neighbours, pixels, in most of a board."""
    return float(np.percentile(spatial.KDTree(places).query(places, k=2)[0][:, 1], 10))


def _dot_radius(picture: Doubles, places: Doubles, pitch: float) -> float:
    """Return the radius, pixels, of dots: of the area where it is nearer to their middle's brightness."""
    reach = math.floor(pitch / 2)
    offsets = np.arange(-reach, reach + 1)
    rows, columns = picture.shape
    areas = []
    for column, row in np.rint(places).astype(int):
        around = picture[
            np.ix_(np.clip(row + offsets, 0, rows - 1), np.clip(column + offsets, 0, columns - 1))
        ]
        low, high = np.percentile(around, [2, 98])
        dark = around < (low + high) / 2
        areas.append(np.mean(dark == dark[reach, reach]) * dark.size)
    return math.sqrt(float(np.median(areas)) / math.pi)


def _sides(corners: Doubles) -> Doubles:
    """Return the circumference of each quadrilateral, (n, 4, 2)."""
    return np.asarray(np.sum(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2), axis=1))
