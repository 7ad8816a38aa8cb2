"""Scale, perspective and distortion of a camera, fitted to pictures of a board on the sheet."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.base.undistort import distorted, picture_places
from mirrorskin.engine.calibration.board import FEWEST, Board, Charuco
from mirrorskin.engine.calibration.marks import Marks, centre_marks, find_marks, scale_contrast
from mirrorskin.io import InputError, Lens
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.numerics import least_squares
from mirrorskin.kernels.numerics.least_squares import mad_sigma, soft_l1

_MAX_FITS = 8  # maximum number of fits; each predicts further marks
_ADJACENT = 1.5  # pitches: distance from located marks within which others are predicted
_FEWEST_YET = 6  # minimum number of marks before all are predicted
_LEAST_REACH, _MOST_REACH = 2.5, 12.0  # pixels: limits of the radius around a corner in which it is centred
_FAR = 0.2  # pitches: maximum distance of a mark from its predicted position
_OFF, _OFF_SHARE = 0.6, 3e-4  # maximum RMS residual of a picture: pixels, or share of its diagonal
_MARKER = 0.15  # greatest relative difference of the markers' size from the specified one; blur shrinks them

_PLANE = 8  # number of parameters of the homography; distortion and poses of the other boards follow
_LENS = _PLANE + 5
_LIKELY = np.array([0.3, 0.03, 0.003, 0.003, 0.008])  # prior standard deviations of k1, k2, p1, p2, k3
_LOSS = soft_l1(3.0)  # standard deviations
_NOISE, _LEAST_NOISE = 0.1, 0.003  # pixels: initial value and lower limit of the noise
_DIFFERENCE = 1e-6  # step of numerical derivatives; all parameters are of the order of 1
_OUT = 0.9  # relative distance from the map's centre to its corners at which standard errors are computed
_RIM = 8  # points on a dot's rim


@dataclass(frozen=True, slots=True, eq=False)
class LensFit:
    """A lens and its residuals."""

    lens: Lens
    marks: tuple[int, ...]  # number located in each picture
    errors: tuple[float, ...]  # RMS distance of each picture's marks from the fit, pixels
    worst: float  # largest distance of a mark, pixels
    corner_sigma: float  # standard error of the map at 90 % of the distance to its corners, pixels


def calibrate_lens(pictures: Sequence[tuple[str, NDArray[Any]]], board: Board) -> LensFit:
    """Find a camera's scale and distortion from pictures of a board on the sheet.

    Parameters
    ----------
    pictures : sequence of (str, ndarray)
        Names and pictures, (H, W), uint8, uint16 or float32, of the same size. In each the board lies flat on
        the sheet, at any position and orientation.
    board : Charuco or Dots

    Raises
    ------
    mirrorskin.io.InputError
        The board is not found, or is of another kind.
    """
    if not pictures:
        raise InputError("no picture of a board is given: at least 1 is needed")
    first = pictures[0]
    for name, picture in pictures:
        if picture.shape != first[1].shape:
            sizes = " and ".join(f"{image.shape[1]} x {image.shape[0]}" for image in (first[1], picture))
            raise InputError(f"{first[0]} and {name} differ: {sizes} pixels: take all with one camera")
    return fit_lens([locate_marks(picture, board, name) for name, picture in pictures])


def fit_lens(pictures: Sequence[Marks]) -> LensFit:
    """Fit one camera to the marks of several pictures, whose boards are in one plane.

    The ray of a point (x, y) is H (x, y, 1) with a homography H, distorted about the centre of the picture,
    in units of half its diagonal. A plane determines neither the focal length nor the optical axis; both are
    absorbed by H and the tangential terms. The loss is linear beyond three standard deviations (`soft_l1` of
    SciPy), and the prior of the distortion represents common lenses.

    The axes on the sheet are rotated so that the map at the picture's centre has no rotation. Its pixels have
    the mean size of the picture's pixels at the centre.
    """
    fit = CameraFit(pictures)
    errors = fit.errors()
    _check_plane(pictures, errors)
    scale_sigma, corner_sigma = fit.uncertainty()
    residuals = np.concatenate(fit.residuals())
    error = float(np.sqrt(np.mean(np.sum(residuals**2, axis=1))))
    lens = replace(fit.lens(fit.parameters), error=error, scale_sigma=scale_sigma)
    marks = tuple(len(picture.board) for picture in pictures)
    return LensFit(lens, marks, errors, float(np.hypot(*residuals.T).max()), corner_sigma)


def locate_marks(picture: NDArray[Any], board: Board, name: str) -> Marks:
    """Locate the marks of a board to a few hundredths of a pixel.

    A first lens is fitted to the marks found by OpenCV. It predicts all marks, which are then centred.
    """
    from scipy.spatial import KDTree

    rough = find_marks(picture, board, name)
    fit = CameraFit([rough])
    _check_kind(rough, board, fit)
    stretched, marks = scale_contrast(picture, name), rough
    for _ in range(_MAX_FITS):
        count = len(marks.board)
        adjacent = KDTree(marks.board).query(board.marks())[0] < _ADJACENT * board.pitch
        marks = _centre_predicted(stretched, board, fit, board.marks()[adjacent], name)
        _check_number(marks, board, _FEWEST_YET)
        fit = CameraFit([marks])
        if len(marks.board) == count:
            break
    _check_number(marks, board, FEWEST)
    _check_plane([marks], fit.errors())
    return marks


def _centre_predicted(picture: Doubles, board: Board, fit: CameraFit, points: Doubles, name: str) -> Marks:
    """Return the marks at points of the board, (n, 2), that are close to their places predicted by a fit."""
    starts, pitch = fit.places(0, points), _pitch(fit.places(0, board.marks()))
    reach = 0.45 * pitch
    if isinstance(board, Charuco):
        # The radius ends at the first cell inside a marker's black border, at least a ninth of a marker.
        clear = math.sqrt(2) * ((board.square - board.marker) / 2 + board.marker / 9) / board.square
        reach = min(0.9 * clear * pitch, _MOST_REACH)
    places, detected = centre_marks(picture, starts, max(_LEAST_REACH, reach))
    detected &= np.hypot(*(places - starts).T) < max(1.0, _FAR * pitch)
    points, places = points[detected], places[detected]
    if len(points) == 0 or isinstance(board, Charuco):
        return Marks(name, picture.shape, points, places)
    radius = _dot_radius(picture, places, pitch) / pitch * board.pitch
    return Marks(name, picture.shape, points, places, radius)


def _pitch(places: Doubles) -> float:
    """Return the smallest distance of neighbouring marks, pixels, as the 10 % quantile."""
    from scipy.spatial import KDTree

    return float(np.percentile(KDTree(places).query(places, k=2)[0][:, 1], 10))


def _dot_radius(picture: Doubles, places: Doubles, pitch: float) -> float:
    """Return the radius, pixels, of dots, from the area closer to the brightness of their centre."""
    reach = math.floor(pitch / 2)
    offsets = np.arange(-reach, reach + 1)
    rows, columns = picture.shape
    areas = []
    for column, row in np.rint(places).astype(int):
        near = np.clip(row + offsets, 0, rows - 1), np.clip(column + offsets, 0, columns - 1)
        around = picture[np.ix_(*near)]
        low, high = np.percentile(around, [2, 98])
        dark = around < (low + high) / 2
        areas.append(np.mean(dark == dark[reach, reach]) * dark.size)
    return math.sqrt(float(np.median(areas)) / math.pi)


def _check_kind(rough: Marks, board: Board, fit: CameraFit) -> None:
    """Raise InputError if the marks are not arranged as on the board."""
    fitted = fit.places(0, rough.board)
    residual = np.hypot(*(fitted - rough.places).T)
    if np.mean(residual < max(2.0, _FAR * _pitch(fit.places(0, board.marks())))) < 0.7:
        raise InputError(f"{rough.name} shows another board than {board}: count its columns and rows")
    if isinstance(board, Charuco):
        corners = [places.reshape(-1, 4, 2) for places in (rough.places, fitted)]
        sides = [np.linalg.norm(marker - np.roll(marker, 1, axis=1), axis=2) for marker in corners]
        measured, expected = (np.sum(lengths, axis=1) for lengths in sides)
        marker = board.marker * float(np.median(measured / expected))
        if abs(marker / board.marker - 1) > _MARKER:
            raise InputError(
                f"{rough.name} shows another board than {board}: where squares have {board.square:g} mm, "
                f"its markers have {marker:.3g} mm: measure both"
            )


def _check_plane(pictures: Sequence[Marks], errors: Sequence[float]) -> None:
    if max(errors) > max(_OFF, _OFF_SHARE * math.hypot(*pictures[0].shape)):
        worst = pictures[int(np.argmax(errors))].name
        raise InputError(
            f"{worst} does not fit a flat board on the sheet: marks are off by {max(errors):.2g} pixels RMS:"
            " lay the board flat, take it sharp, and leave the camera as it is from picture to picture"
        )


def _check_number(marks: Marks, board: Board, fewest: int) -> None:
    count = len(marks.board)
    lines = min(len(np.unique(np.rint(axis / board.pitch * 2))) for axis in marks.board.T)
    if count < fewest or lines < 3:
        raise InputError(
            f"{marks.name}: only {count} of {len(board.marks())} marks of {board} are seen, and {FEWEST} in 3"
            " lines are needed: bring more of it into the picture, sharp and evenly lit"
        )


class CameraFit:
    """A camera fitted to marks; its parameters are scaled so that all are of the order of 1."""

    def __init__(self, pictures: Sequence[Marks]) -> None:
        """Fit twice; the second fit is weighted by the noise estimated from the first."""
        self.pictures = pictures
        self._shape = pictures[0].shape
        self._unit = float(max(np.abs(picture.board).max() for picture in pictures))  # unit of lengths, mm
        self._middle = (np.array(self._shape[::-1]) - 1) / 2  # column and row of the picture's centre
        self._focal = math.hypot(*self._shape) / 2  # half the picture's diagonal, pixels
        start = self._start()
        marks = 2 * sum(len(picture.board) for picture in pictures)

        def noise(size: float) -> Doubles:
            return np.repeat([size, 1.0], [marks, _LIKELY.size])

        solution = least_squares.fit(
            self._residuals,
            start,
            jacobian=self._jacobian,
            noise=noise(_NOISE),
            rescale=lambda residuals: noise(max(_LEAST_NOISE, mad_sigma(residuals[:marks]))),
            rounds=2,
            loss=_LOSS,
        )
        self.parameters = solution.parameters
        excess = max(1.0, solution.cost / max(1, solution.residuals.size - start.size))
        self.covariance = solution.covariance() * excess

    def places(self, number: int, board: Doubles) -> Doubles:
        """Return the places of points of a board, (..., 2), mm, in a picture."""
        return self._places(self.parameters, number, board)

    def residuals(self) -> list[Doubles]:
        """Return the residuals of each picture's marks, (n, 2), pixels."""
        return [self._centres(self.parameters, k) - picture.places for k, picture in enumerate(self.pictures)]

    def errors(self) -> tuple[float, ...]:
        """Return the RMS residual of each picture, pixels."""
        return tuple(float(np.sqrt(np.mean(np.sum(part**2, axis=1)))) for part in self.residuals())

    def uncertainty(self) -> tuple[float, float]:
        """Return the relative standard error of the scale, and the map's near its corners, pixels."""
        base = self.lens(self.parameters)
        sides = zip(base.shape[::-1], base.pixel_size, strict=True)
        x, y = (_OUT * (side - 1) / 2 * size for side, size in sides)

        def scale_and_corners(parameters: Doubles) -> Doubles:
            lens = self.lens(parameters)
            corners = picture_places(lens, [-x, x, -x, x], [-y, -y, y, y])
            return np.concatenate([[math.log(lens.pixel_size[0])], *corners])

        steps = 1e-3 * np.sqrt(np.diag(self.covariance)) + 1e-12
        slopes = [
            scale_and_corners(self.parameters + h) - scale_and_corners(self.parameters - h)
            for h in np.diag(steps)
        ]
        jacobian = np.array(slopes).reshape(self.parameters.size, -1) / (2 * steps[:, np.newaxis])
        variance = np.einsum("ik,ij,jk->k", jacobian, self.covariance, jacobian)
        return math.sqrt(variance[0]), float(np.sqrt(np.max(variance[1:5] + variance[5:])))

    def lens(self, parameters: Doubles) -> Lens:
        """Return the lens of some parameters, with the sheet's axes parallel to the picture's."""
        shape = self._shape
        matrix = np.array([[self._focal, 0, self._middle[0]], [0, self._focal, self._middle[1]], [0, 0, 1]])
        to_sheet = np.linalg.inv(matrix @ np.append(parameters[:_PLANE], 1.0).reshape(3, 3))
        to_sheet = np.diag([self._unit, self._unit, 1.0]) @ to_sheet
        # Displacements, mm, of one pixel to the right and one up at the centre; their rotation is removed.
        step = 1e-3
        offsets = np.array([[0, 0], [step, 0], [-step, 0], [0, -step], [0, step]])
        ends = _mapped(to_sheet, self._middle + offsets)
        slopes = np.stack([ends[1] - ends[2], ends[3] - ends[4]], axis=1) / (2 * step)
        u, stretch, v = np.linalg.svd(slopes)
        rotation = (u @ v).T
        move = np.eye(3)
        move[:2, :2], move[:2, 2] = rotation, -rotation @ ends[0]
        camera = move @ to_sheet
        size = math.sqrt(float(stretch[0] * stretch[1]))
        distortion = parameters[_PLANE:_LENS].copy()
        return Lens((size, size), camera / camera[2, 2], distortion, matrix, (shape[0], shape[1]), math.nan)

    def _start(self) -> Doubles:
        """Return parameters of a camera without distortion, from the homography of each picture."""
        planes = [self._plane(picture) for picture in self.pictures]
        parameters = [planes[0].ravel()[:_PLANE], np.zeros(_LENS - _PLANE)]
        for plane, picture in zip(planes[1:], self.pictures[1:], strict=True):
            board = picture.board / self._unit
            parameters.append(_rigid(board, _mapped(np.linalg.solve(planes[0], plane), board)))
        return np.concatenate(parameters)

    def _plane(self, marks: Marks) -> Doubles:
        """Return the homography of one picture, from the board in units to rays."""
        import cv2

        rays = (marks.places - self._middle) / self._focal
        plane, _ = cv2.findHomography(marks.board / self._unit, rays, cv2.LMEDS)
        if plane is None or not np.isfinite(plane).all():
            raise InputError(f"{marks.name}: the marks do not determine a plane: show more of the board")
        return np.asarray(plane / plane[2, 2])

    def _residuals(self, parameters: Doubles) -> Doubles:
        """Return residuals of marks, pixels, and the distortion in standard deviations, (..., m)."""
        parts = [self._centres(parameters, k) - picture.places for k, picture in enumerate(self.pictures)]
        flat = [part.reshape(*parameters.shape[:-1], -1) for part in parts]
        return np.concatenate([*flat, parameters[..., _PLANE:_LENS] / _LIKELY], axis=-1)

    def _jacobian(self, parameters: Doubles) -> Doubles:
        """Return the derivatives of the residuals, (m, p), by central differences."""
        steps = _DIFFERENCE * np.eye(parameters.size)
        ahead, behind = self._residuals(np.stack([parameters + steps, parameters - steps]))
        return np.asarray((ahead - behind).T / (2 * _DIFFERENCE))

    def _centres(self, parameters: Doubles, number: int) -> Doubles:
        """Return the places of a picture's marks, (..., n, 2), as `centre_marks` defines them."""
        marks = self.pictures[number]
        if marks.radius == 0:
            return self._places(parameters, number, marks.board)
        # The centre of a dot has the same distance, across the rim, from opposite parts of the rim.
        angles = np.arange(_RIM) * (math.tau / _RIM)
        around = marks.radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        rim = self._places(parameters, number, marks.board[:, np.newaxis] + around)
        tangent = np.roll(rim, -1, axis=-2) - np.roll(rim, 1, axis=-2)
        half = _RIM // 2
        normal = np.stack([tangent[..., :half, 1], -tangent[..., :half, 0]], axis=-1)
        between = (rim[..., :half, :] + rim[..., half:, :]) / 2
        weighted = np.swapaxes(normal / np.linalg.norm(normal, axis=-1, keepdims=True), -1, -2)
        right_side = weighted @ np.sum(normal * between, axis=-1, keepdims=True)
        return np.asarray(np.linalg.solve(weighted @ normal, right_side)[..., 0])

    def _places(self, parameters: Doubles, number: int, board: Doubles) -> Doubles:
        """Return the places of points of a board, (..., board's shape), for parameters (..., p)."""
        plane = np.concatenate([parameters[..., :_PLANE], np.ones((*parameters.shape[:-1], 1))], axis=-1)
        plane = plane.reshape(*parameters.shape[:-1], 3, 3)
        if number:
            plane = plane @ _pose(parameters[..., _LENS + 3 * (number - 1) :][..., :3])
        rays = plane @ _homogeneous(board.reshape(-1, 2) / self._unit)
        bent = distorted(rays / rays[..., 2:, :], parameters[..., _PLANE:_LENS])
        places = np.swapaxes(bent[..., :2, :], -1, -2) * self._focal + self._middle
        return np.asarray(places.reshape(*parameters.shape[:-1], *board.shape))


def _rigid(points: Doubles, targets: Doubles) -> Doubles:
    """Return the angle and shift, (3,), that move points, (n, 2), closest to targets."""
    middle, other = points.mean(axis=0), targets.mean(axis=0)
    (xx, xy), (yx, yy) = (points - middle).T @ (targets - other)
    angle = math.atan2(xy - yx, xx + yy)
    turned = _mapped(_pose(np.array([angle, 0.0, 0.0])), middle[np.newaxis])[0]
    return np.append(angle, other - turned)


def _pose(parameters: Doubles) -> Doubles:
    """Return the homographies, (..., 3, 3), of rotations and shifts (angle, x, y), (..., 3)."""
    angle, x, y = np.moveaxis(parameters, -1, 0)
    pose = np.zeros((*parameters.shape[:-1], 3, 3))
    pose[..., 0, 0] = pose[..., 1, 1] = np.cos(angle)
    pose[..., 1, 0], pose[..., 0, 1] = np.sin(angle), -np.sin(angle)
    pose[..., 0, 2], pose[..., 1, 2], pose[..., 2, 2] = x, y, 1
    return pose


def _mapped(plane: NDArray[Any], points: Doubles) -> Doubles:
    """Return points, (n, 2), mapped by a homography."""
    rays = plane @ _homogeneous(points)
    return np.asarray((rays[:2] / rays[2]).T)


def _homogeneous(points: Doubles) -> Doubles:
    return np.vstack([points.T, np.ones(len(points))])
