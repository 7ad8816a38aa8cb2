"""A camera that fits the marks of boards on one plane."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import optimize, spatial

from mirrorskin.engine.calibration.board import FEWEST, Board, Charuco
from mirrorskin.engine.calibration.marks import Marks, centre_marks, find_marks, stretched
from mirrorskin.engine.undistort import distorted, picture_places
from mirrorskin.io import InputError, Lens

Doubles = NDArray[np.float64]

_PLANE = 8  # unknowns of the homography; those of the distortion come next, then each other board's pose
_LENS = _PLANE + 5
_LIKELY = np.array([0.3, 0.03, 0.003, 0.003, 0.008])  # standard deviations of k1, k2, p1, p2, k3 of lenses
_CUT = 3.0  # standard deviations from which on a mark pulls less
_NOISE = 0.1  # pixels, before more is known
_LEAST_NOISE = 0.003
_DIFFERENCE = 1e-6  # of unknowns of about one
_OUT = 0.9  # of the way to the corners of the map, to which standard errors are told
_NEXT = 8  # directions in which a dot's rim is looked at


@dataclass(frozen=True, slots=True, eq=False)
class CameraFit:
    """A camera that fits some marks: its unknowns, in units in which all are about one."""

    pictures: Sequence[Marks]
    unknowns: Doubles
    covariance: Doubles

    @classmethod
    def of(cls, pictures: Sequence[Marks]) -> CameraFit:
        """Fit it, twice: the second time each mark and what is likely are weighed as the noise tells."""
        fit, noise = cls(pictures, np.empty(0), np.empty((0, 0))), _NOISE
        unknowns = fit._start()
        for enough in (1e-4, 1e-8):
            found = optimize.least_squares(
                fit._misfit,
                unknowns,
                fit._slopes,
                args=(noise,),
                loss="soft_l1",
                f_scale=_CUT,
                x_scale="jac",
                ftol=enough,
                max_nfev=200,
            )
            unknowns = found.x
            fit = replace(fit, unknowns=unknowns)
            off = np.abs(np.concatenate(fit.distances()))
            noise = max(_LEAST_NOISE, 1.4826 * float(np.median(off)))
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

    def distances(self) -> list[Doubles]:
        """Return by how much the marks of each picture, (n, 2), are off."""
        return [self._seen(self.unknowns, k) - one.places for k, one in enumerate(self.pictures)]

    def errors(self) -> tuple[float, ...]:
        """Return the RMS distances of each picture's marks from where they must be, pixels."""
        return tuple(float(np.sqrt(np.mean(np.sum(one**2, axis=1)))) for one in self.distances())

    def lens(self) -> Lens:
        """Return it with the sheet's axes along those of the picture."""
        return self._lens(self.unknowns)

    def uncertainty(self) -> tuple[float, float]:
        """Return the standard errors of the scale, as a share, and of the map near its corners, pixels."""
        base = self.lens()
        x, y = (
            _OUT * (side - 1) / 2 * size for side, size in zip(base.shape[::-1], base.pixel_size, strict=True)
        )

        def told(unknowns: Doubles) -> Doubles:
            lens = self._lens(unknowns)
            corners = picture_places(lens, [-x, x, -x, x], [-y, -y, y, y])
            return np.concatenate([[math.log(lens.pixel_size[0])], *corners])

        count = self.unknowns.size
        steps = 1e-3 * np.sqrt(np.diag(self.covariance)) + 1e-12
        slopes = [(told(self.unknowns + h) - told(self.unknowns - h)) for h in np.diag(steps)]
        jacobian = np.array(slopes).reshape(count, -1) / (2 * steps[:, np.newaxis])
        variance = np.einsum("ik,ij,jk->k", jacobian, self.covariance, jacobian)
        corners = variance[1:5] + variance[5:]
        return math.sqrt(variance[0]), float(np.sqrt(np.max(corners)))

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
        rays = (marks.places - self.middle) / self.focal
        plane, _ = cv2.findHomography(marks.board / self.unit, rays, cv2.LMEDS)
        if plane is None or not np.isfinite(plane).all():
            raise InputError(f"{marks.name}: the marks that were found make no plane: show more of the board")
        return np.asarray(plane / plane[2, 2])

    def _misfit(self, unknowns: Doubles, noise: float) -> Doubles:
        """Return how far off everything is, in standard deviations, (..., m), for unknowns (..., p)."""
        off = [(self._seen(unknowns, k) - one.places) / noise for k, one in enumerate(self.pictures)]
        flat = [one.reshape(*unknowns.shape[:-1], -1) for one in off]
        return np.concatenate([*flat, unknowns[..., _PLANE:_LENS] / _LIKELY], axis=-1)

    def _slopes(self, unknowns: Doubles, noise: float) -> Doubles:
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
        angles = np.arange(_NEXT) * (math.tau / _NEXT)
        around = marks.radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        rim = self._places(unknowns, number, marks.board[:, np.newaxis] + around)
        along = np.roll(rim, -1, axis=-2) - np.roll(rim, 1, axis=-2)
        half = _NEXT // 2
        across = np.stack([along[..., :half, 1], -along[..., :half, 0]], axis=-1)
        between = (rim[..., :half, :] + rim[..., half:, :]) / 2
        weighed = across / np.linalg.norm(across, axis=-1, keepdims=True)
        normal = np.swapaxes(weighed, -1, -2) @ across
        pull = np.swapaxes(weighed, -1, -2) @ np.sum(across * between, axis=-1, keepdims=True)
        return np.asarray(np.linalg.solve(normal, pull)[..., 0])

    def _places(self, unknowns: Doubles, number: int, board: Doubles) -> Doubles:
        """Return where points of a board are seen, (..., board's shape), for unknowns (..., p)."""
        points = _whole(board.reshape(-1, 2) / self.unit)
        plane = np.concatenate([unknowns[..., :_PLANE], np.ones((*unknowns.shape[:-1], 1))], axis=-1)
        plane = plane.reshape(*unknowns.shape[:-1], 3, 3)
        if number:
            plane = plane @ _pose(unknowns[..., _LENS + 3 * (number - 1) :][..., :3])
        rays = plane @ points
        bent = distorted(rays / rays[..., 2:, :], unknowns[..., _PLANE:_LENS])
        places = np.swapaxes(bent[..., :2, :], -1, -2) * self.focal + self.middle
        return np.asarray(places.reshape(*unknowns.shape[:-1], *board.shape))

    def _lens(self, unknowns: Doubles) -> Lens:
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
    """Return points, (n, 2), behind a homography."""
    seen = plane @ _whole(points)
    return np.asarray((seen[:2] / seen[2]).T)


def _whole(points: Doubles) -> Doubles:
    """Return points, (n, 2), as (3, n) with ones."""
    return np.vstack([points.T, np.ones(len(points))])


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
    `mirrorskin.engine.calibration.marks`.

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
