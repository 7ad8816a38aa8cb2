"""Scale, perspective and distortion of a camera, fitted to pictures of a board on the sheet."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.calibration.board import FEWEST, Board, Charuco
from mirrorskin.engine.calibration.marks import Marks, centre_marks, find_marks, stretch_contrast
from mirrorskin.engine.undistort import distorted, picture_places
from mirrorskin.io import InputError, Lens

Doubles = NDArray[np.float64]

_ROUNDS = 8  # of predicting marks by a fit to those found so far
_BESIDE = 1.5  # of the pitch: how far from known marks others are predicted
_FEWEST_YET = 6  # marks, before all are predicted
_LEAST_REACH, _MOST_REACH = 2.5, 12.0  # pixels around a mark; more is needed of dots only
_FAR = 0.2  # of the pitch: how far a mark may be found from where it is predicted
_OFF, _OFF_SHARE = 0.6, 3e-4  # RMS misfit of one plane, pixels, or as a share of the picture's diagonal
_MARKER = 0.1  # share by which the markers' size may differ from the given one

_PLANE = 8  # unknowns of the homography; those of the distortion come next, then each other board's pose
_LENS = _PLANE + 5
_LIKELY = np.array([0.3, 0.03, 0.003, 0.003, 0.008])  # prior standard deviations of k1, k2, p1, p2, k3
_OUTLIER = 3.0  # standard deviations from which on a mark pulls less
_NOISE, _LEAST_NOISE = 0.1, 0.003  # pixels: the first guess, and the least
_DIFFERENCE = 1e-6  # of unknowns of about one
_OUT = 0.9  # of the way to the corners of the map, for which standard errors are given
_RIM = 8  # directions in which a dot's rim is looked at


@dataclass(frozen=True, slots=True, eq=False)
class LensFit:
    """A lens, and how well it is known."""

    lens: Lens
    marks: tuple[int, ...]  # found in each picture
    errors: tuple[float, ...]  # RMS distance of each picture's marks from where the fit has them, pixels
    worst: float  # largest distance of all, pixels
    corner_sigma: float  # standard error of the map 9/10 of the way to its corners, pixels; NaN if not seen


def calibrate_lens(pictures: Sequence[tuple[str, NDArray[Any]]], board: Board) -> LensFit:
    """Find a camera's scale and distortion from pictures of one board on the sheet.

    The named ``pictures``, (H, W), uint8, uint16 or float32, are of one size; in each the board lies flat on
    the sheet, anywhere and turned in any way. InputError where it is not found, or of another kind.
    """
    if not pictures:
        raise InputError("there is no picture of a board: give at least one")
    first = pictures[0]
    for name, picture in pictures:
        if picture.shape != first[1].shape:
            sizes = " and ".join(f"{one.shape[1]} x {one.shape[0]}" for one in (first[1], picture))
            raise InputError(f"{first[0]} and {name} differ: {sizes} pixels: take all with one camera")
    return fit_lens([locate_marks(picture, board, name) for name, picture in pictures])


def fit_lens(pictures: Sequence[Marks]) -> LensFit:
    """Fit one camera to marks that were found in several pictures.

    All boards lie on one plane. A point (x, y) of it is seen by the ray H (x, y, 1), H a homography; the ray
    is distorted about the picture's centre, in units of half its diagonal. A plane determines neither a focal
    length nor the lens's axis: H and the tangential terms absorb these. Least squares with a loss that grows
    linearly from three standard deviations on; distortion has the prior of common lenses.

    The sheet's axes are turned so that the map, seen at the picture's centre, is stretched but not turned.
    Its pixels are as large as those of the picture there are in the mean.
    """
    fit = CameraFit.of(pictures)
    errors = fit.errors()
    _check_plane(pictures, errors)
    scale_sigma, corner_sigma = fit.uncertainty()
    residuals = np.concatenate(fit.residuals())
    error = float(np.sqrt(np.mean(np.sum(residuals**2, axis=1))))
    lens = replace(fit.lens(fit.unknowns), error=error, scale_sigma=scale_sigma)
    marks = tuple(len(one.board) for one in pictures)
    return LensFit(lens, marks, errors, float(np.hypot(*residuals.T).max()), corner_sigma)


def locate_marks(picture: NDArray[Any], board: Board, name: str) -> Marks:
    """Find the marks of a board to a few hundredths of a pixel.

    What OpenCV finds gives a first lens, which predicts all marks; they are centred there by symmetry.
    """
    from scipy.spatial import KDTree

    rough = find_marks(picture, board, name)
    fit = CameraFit.of([rough])
    _check_kind(rough, board, fit)
    sharp, known, marks = stretch_contrast(picture, name), rough.board, rough
    for _ in range(_ROUNDS):
        beside = KDTree(known).query(board.marks())[0] < _BESIDE * board.pitch
        marks = _centre_predicted(sharp, board, fit, beside, name)
        _check_number(marks, board, _FEWEST_YET)
        fit = CameraFit.of([marks])
        if len(marks.board) == len(known):
            break
        known = marks.board
    _check_number(marks, board, FEWEST)
    _check_plane([marks], fit.errors())
    return marks


def _centre_predicted(
    picture: Doubles, board: Board, fit: CameraFit, wanted: NDArray[np.bool_], name: str
) -> Marks:
    """Return those of the wanted marks that are found close to where a fit predicts them."""
    points = board.marks()[wanted]
    starts, pitch = fit.places(0, points), _pitch(fit.places(0, board.marks()))
    if isinstance(board, Charuco):
        # Up to the first cell inside the markers' black border, of a ninth of a marker at least.
        clear = math.sqrt(2) * ((board.square - board.marker) / 2 + board.marker / 9) / board.square
        reach = min(0.9 * clear * pitch, _MOST_REACH)
    else:
        reach = 0.45 * pitch
    places, found = centre_marks(picture, starts, max(_LEAST_REACH, reach))
    found &= np.hypot(*(places - starts).T) < max(1.0, _FAR * pitch)
    points, places = points[found], places[found]
    if len(points) == 0 or isinstance(board, Charuco):
        return Marks(name, picture.shape, points, places)
    radius = _dot_radius(picture, places, pitch) / pitch * board.pitch
    return Marks(name, picture.shape, points, places, radius)


def _pitch(places: Doubles) -> float:
    """Return the least distance of neighbours, pixels, in most of a board."""
    from scipy.spatial import KDTree

    return float(np.percentile(KDTree(places).query(places, k=2)[0][:, 1], 10))


def _dot_radius(picture: Doubles, places: Doubles, pitch: float) -> float:
    """Return the radius, pixels, of dots: of the area where it is nearer to their middle's brightness."""
    reach = math.floor(pitch / 2)
    offsets = np.arange(-reach, reach + 1)
    rows, columns = picture.shape
    areas = []
    for column, row in np.rint(places).astype(int):
        across, down = np.clip(column + offsets, 0, columns - 1), np.clip(row + offsets, 0, rows - 1)
        around = picture[np.ix_(down, across)]
        low, high = np.percentile(around, [2, 98])
        dark = around < (low + high) / 2
        areas.append(np.mean(dark == dark[reach, reach]) * dark.size)
    return math.sqrt(float(np.median(areas)) / math.pi)


def _check_kind(rough: Marks, board: Board, fit: CameraFit) -> None:
    """Refuse a picture whose marks do not lie as on the board."""
    seen = fit.places(0, rough.board)
    off = np.hypot(*(seen - rough.places).T)
    if np.mean(off < max(2.0, _FAR * _pitch(fit.places(0, board.marks())))) < 0.7:
        raise InputError(f"{rough.name} shows another board than {board}: count its columns and rows")
    if isinstance(board, Charuco):
        corners = (one.reshape(-1, 4, 2) for one in (rough.places, seen))
        around = [np.sum(np.linalg.norm(one - np.roll(one, 1, axis=1), axis=2), axis=1) for one in corners]
        marker = board.marker * float(np.median(around[0] / around[1]))
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


@dataclass(frozen=True, slots=True, eq=False)
class CameraFit:
    """A camera that fits some marks: its unknowns, in units in which all are about one."""

    pictures: Sequence[Marks]
    unknowns: Doubles
    covariance: Doubles

    @classmethod
    def of(cls, pictures: Sequence[Marks]) -> CameraFit:
        """Fit it, twice: the second time marks and prior are weighed by the noise that the first found."""
        from scipy.optimize import least_squares

        fit, noise = cls(pictures, np.empty(0), np.empty((0, 0))), _NOISE
        unknowns = fit._start()
        for tolerance in (1e-4, 1e-8):
            found = least_squares(
                fit._misfit,
                unknowns,
                fit._jacobian,
                args=(noise,),
                loss="soft_l1",
                f_scale=_OUTLIER,
                x_scale="jac",
                ftol=tolerance,
                max_nfev=200,
            )
            unknowns = found.x
            fit = replace(fit, unknowns=unknowns)
            noise = max(_LEAST_NOISE, 1.4826 * float(np.median(np.abs(np.concatenate(fit.residuals())))))
        excess = max(1.0, 2 * found.cost / max(1, found.fun.size - unknowns.size))
        return replace(fit, covariance=np.linalg.pinv(found.jac.T @ found.jac) * excess)

    @property
    def unit(self) -> float:
        """Millimetres that the unknowns take for one."""
        return float(max(np.abs(one.board).max() for one in self.pictures))

    @property
    def middle(self) -> Doubles:
        """Column and row of the picture's centre."""
        return (np.array(self.pictures[0].shape[::-1]) - 1) / 2

    @property
    def focal(self) -> float:
        """Pixels of half the picture's diagonal."""
        return math.hypot(*self.pictures[0].shape) / 2

    def places(self, number: int, board: Doubles) -> Doubles:
        """Return where points of a board, (..., 2), mm, are seen in its picture."""
        return self._places(self.unknowns, number, board)

    def residuals(self) -> list[Doubles]:
        """Return by how much the marks of each picture, (n, 2), are off, pixels."""
        return [self._seen(self.unknowns, k) - one.places for k, one in enumerate(self.pictures)]

    def errors(self) -> tuple[float, ...]:
        """Return the RMS residual of each picture, pixels."""
        return tuple(float(np.sqrt(np.mean(np.sum(one**2, axis=1)))) for one in self.residuals())

    def uncertainty(self) -> tuple[float, float]:
        """Return the standard errors of the scale, as a share, and of the map near its corners, pixels."""
        base = self.lens(self.unknowns)
        sides = zip(base.shape[::-1], base.pixel_size, strict=True)
        x, y = (_OUT * (side - 1) / 2 * size for side, size in sides)

        def scale_and_corners(unknowns: Doubles) -> Doubles:
            lens = self.lens(unknowns)
            corners = picture_places(lens, [-x, x, -x, x], [-y, -y, y, y])
            return np.concatenate([[math.log(lens.pixel_size[0])], *corners])

        steps = 1e-3 * np.sqrt(np.diag(self.covariance)) + 1e-12
        slopes = [
            scale_and_corners(self.unknowns + h) - scale_and_corners(self.unknowns - h)
            for h in np.diag(steps)
        ]
        jacobian = np.array(slopes).reshape(self.unknowns.size, -1) / (2 * steps[:, np.newaxis])
        variance = np.einsum("ik,ij,jk->k", jacobian, self.covariance, jacobian)
        return math.sqrt(variance[0]), float(np.sqrt(np.max(variance[1:5] + variance[5:])))

    def lens(self, unknowns: Doubles) -> Lens:
        """Return the lens of some unknowns, with the sheet's axes along those of the picture."""
        shape = self.pictures[0].shape
        matrix = np.array([[self.focal, 0, self.middle[0]], [0, self.focal, self.middle[1]], [0, 0, 1]])
        to_sheet = np.linalg.inv(matrix @ np.append(unknowns[:_PLANE], 1.0).reshape(3, 3))
        to_sheet = np.diag([self.unit, self.unit, 1.0]) @ to_sheet
        # Millimetres for a pixel to the right and one up, at the centre; turned so that they only stretch.
        step = 1e-3
        ways = np.array([[0, 0], [step, 0], [-step, 0], [0, -step], [0, step]])
        ends = _mapped(to_sheet, self.middle + ways)
        slopes = np.stack([ends[1] - ends[2], ends[3] - ends[4]], axis=1) / (2 * step)
        left, stretch, right = np.linalg.svd(slopes)
        turn = (left @ right).T
        move = np.eye(3)
        move[:2, :2], move[:2, 2] = turn, -turn @ ends[0]
        camera = move @ to_sheet
        size = math.sqrt(float(stretch[0] * stretch[1]))
        distortion = unknowns[_PLANE:_LENS].copy()
        return Lens((size, size), camera / camera[2, 2], distortion, matrix, (shape[0], shape[1]), math.nan)

    def _start(self) -> Doubles:
        """Return unknowns of a camera without distortion, from each picture's own homography."""
        planes = [self._plane(one) for one in self.pictures]
        unknowns = [planes[0].ravel()[:_PLANE], np.zeros(_LENS - _PLANE)]
        for plane, one in zip(planes[1:], self.pictures[1:], strict=True):
            board = one.board / self.unit
            unknowns.append(_rigid(board, _mapped(np.linalg.solve(planes[0], plane), board)))
        return np.concatenate(unknowns)

    def _plane(self, marks: Marks) -> Doubles:
        """Return the homography of one picture, from the board in units to rays."""
        import cv2

        rays = (marks.places - self.middle) / self.focal
        plane, _ = cv2.findHomography(marks.board / self.unit, rays, cv2.LMEDS)
        if plane is None or not np.isfinite(plane).all():
            raise InputError(f"{marks.name}: the marks that were found make no plane: show more of the board")
        return np.asarray(plane / plane[2, 2])

    def _misfit(self, unknowns: Doubles, noise: float) -> Doubles:
        """Return residuals in standard deviations, (..., m), for unknowns (..., p)."""
        off = [(self._seen(unknowns, k) - one.places) / noise for k, one in enumerate(self.pictures)]
        flat = [one.reshape(*unknowns.shape[:-1], -1) for one in off]
        return np.concatenate([*flat, unknowns[..., _PLANE:_LENS] / _LIKELY], axis=-1)

    def _jacobian(self, unknowns: Doubles, noise: float) -> Doubles:
        """Return the derivatives of the misfit, (m, p), by differences, all in one."""
        ways = _DIFFERENCE * np.eye(unknowns.size)
        ahead, behind = self._misfit(np.stack([unknowns + ways, unknowns - ways]), noise)
        return np.asarray((ahead - behind).T / (2 * _DIFFERENCE))

    def _seen(self, unknowns: Doubles, number: int) -> Doubles:
        """Return where the marks of a picture are seen, (..., n, 2), as they are centred."""
        marks = self.pictures[number]
        if marks.radius == 0:
            return self._places(unknowns, number, marks.board)
        # A dot is centred so that opposite parts of its rim are as far away, across the rim.
        angles = np.arange(_RIM) * (math.tau / _RIM)
        around = marks.radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        rim = self._places(unknowns, number, marks.board[:, np.newaxis] + around)
        along = np.roll(rim, -1, axis=-2) - np.roll(rim, 1, axis=-2)
        half = _RIM // 2
        across = np.stack([along[..., :half, 1], -along[..., :half, 0]], axis=-1)
        between = (rim[..., :half, :] + rim[..., half:, :]) / 2
        weighed = np.swapaxes(across / np.linalg.norm(across, axis=-1, keepdims=True), -1, -2)
        pull = weighed @ np.sum(across * between, axis=-1, keepdims=True)
        return np.asarray(np.linalg.solve(weighed @ across, pull)[..., 0])

    def _places(self, unknowns: Doubles, number: int, board: Doubles) -> Doubles:
        """Return where points of a board are seen, (..., board's shape), for unknowns (..., p)."""
        plane = np.concatenate([unknowns[..., :_PLANE], np.ones((*unknowns.shape[:-1], 1))], axis=-1)
        plane = plane.reshape(*unknowns.shape[:-1], 3, 3)
        if number:
            plane = plane @ _pose(unknowns[..., _LENS + 3 * (number - 1) :][..., :3])
        rays = plane @ _homogeneous(board.reshape(-1, 2) / self.unit)
        bent = distorted(rays / rays[..., 2:, :], unknowns[..., _PLANE:_LENS])
        places = np.swapaxes(bent[..., :2, :], -1, -2) * self.focal + self.middle
        return np.asarray(places.reshape(*unknowns.shape[:-1], *board.shape))


def _rigid(points: Doubles, seen: Doubles) -> Doubles:
    """Return the angle and shift, (3,), that bring points, (n, 2), nearest to others."""
    middle, other = points.mean(axis=0), seen.mean(axis=0)
    (xx, xy), (yx, yy) = (points - middle).T @ (seen - other)
    angle = math.atan2(xy - yx, xx + yy)
    turned = _mapped(_pose(np.array([angle, 0.0, 0.0])), middle[np.newaxis])[0]
    return np.append(angle, other - turned)


def _pose(given: Doubles) -> Doubles:
    """Return the homographies, (..., 3, 3), that turn and shift boards by (angle, x, y), (..., 3)."""
    angle, x, y = np.moveaxis(given, -1, 0)
    pose = np.zeros((*given.shape[:-1], 3, 3))
    pose[..., 0, 0] = pose[..., 1, 1] = np.cos(angle)
    pose[..., 1, 0], pose[..., 0, 1] = np.sin(angle), -np.sin(angle)
    pose[..., 0, 2], pose[..., 1, 2], pose[..., 2, 2] = x, y, 1
    return pose


def _mapped(plane: NDArray[Any], points: Doubles) -> Doubles:
    """Return points, (n, 2), mapped by a homography."""
    seen = plane @ _homogeneous(points)
    return np.asarray((seen[:2] / seen[2]).T)


def _homogeneous(points: Doubles) -> Doubles:
    return np.vstack([points.T, np.ones(len(points))])
