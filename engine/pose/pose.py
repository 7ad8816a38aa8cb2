"""The rigid motion of an object between two results, and its covariance."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from mirrorskin.engine.base.device_arrays import device_of_maps
from mirrorskin.engine.base.inputs import Maps, as_result
from mirrorskin.engine.pose.fit import Equations, Followed, PairFit
from mirrorskin.engine.pose.maps import PoseMap
from mirrorskin.engine.pose.motion import Motion
from mirrorskin.io.base.arguments import as_array, checked, in_unit
from mirrorskin.io.base.findings import findings_of
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.device import Device

_MAX_CHI_SQUARE = 4.0  # chi square above which the motion has a note
_MAX_UNDETERMINED = 1e-3  # component of an undetermined direction above which the parameter is undetermined
_EQUAL_TOLERANCE = 0.01  # directions that differ by less are equal


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """A rigid motion x' = R x + t of an object, in millimetres from the picture's centre.

    Attributes
    ----------
    rotation : ndarray, (3,), float64
        Rotation vector of R: its axis times its angle, radians.
    translation : ndarray, (3,), float64
        t, mm.
    covariance : ndarray, (6, 6), float64
        Covariance of the small rotation d (radians) and translation e (mm) from the motion to the true one:
        x' + d x x' + e. It is 0 along `undetermined`, where it has no meaning.
    chi_square : float
        Chi square of the fit per degree of freedom; 1 if the maps differ by their standard deviations.
    pixels : int
        Pixels of the first map that have a counterpart in the second.
    undetermined : ndarray, (k, 6), float64
        Orthonormal directions (d, e) that the maps do not determine, such as a ball's spin.
    notes : tuple of str
        Warnings and notes of the results.
    """

    rotation: Doubles
    translation: Doubles
    covariance: Doubles
    chi_square: float
    pixels: int
    undetermined: Doubles
    notes: tuple[str, ...] = ()

    @property
    def motion(self) -> Motion:
        """R and t."""
        return Motion.of(self.rotation, self.translation)

    @property
    def sigma(self) -> Doubles:
        """Standard deviations of the six parts, (6,); infinite for undetermined directions."""
        free = (np.abs(self.undetermined) > _MAX_UNDETERMINED).any(axis=0)
        return np.where(free, np.inf, np.sqrt(np.diag(self.covariance)))

    def apply(self, points: ArrayLike) -> Doubles:
        """Move points, (..., 3), mm."""
        return self.motion.apply(np.asarray(as_array("points", points, "mm"), np.float64))

    def inverse(self) -> Pose:
        """Return the inverse motion and its covariance."""
        back = self.motion.inverse()
        change = back.adjoint()
        return self._changed(back, change @ self.covariance @ change.T, self.undetermined @ change.T)

    def then(self, other: Pose) -> Pose:
        """Return this motion followed by another of independent errors.

        A direction is undetermined if one of them leaves it undetermined; chi square and pixels are taken
        from ``other``.
        """
        change = other.motion.adjoint()
        covariance = change @ self.covariance @ change.T + other.covariance
        free = np.concatenate([self.undetermined @ change.T, other.undetermined])
        moved = other._changed(self.motion.then(other.motion), covariance, free)
        return replace(moved, notes=tuple(dict.fromkeys((*self.notes, *other.notes))))

    def _changed(self, motion: Motion, covariance: Doubles, free: Doubles) -> Pose:
        """Return another motion with its errors, and orthonormal undetermined directions."""
        return _pose(motion, covariance, free, self.chi_square, self.pixels, self.notes)


def _pose(
    motion: Motion, covariance: Doubles, free: Doubles, chi_square: float, pixels: int, notes: tuple[str, ...]
) -> Pose:
    """Return a motion with its errors, which are left out in undetermined directions, (k, 6)."""
    if len(free):
        directions, sizes, _ = np.linalg.svd(free.T, full_matrices=False)
        kept = directions[:, sizes > _EQUAL_TOLERANCE]
        others = np.eye(6) - kept @ kept.T
        covariance, free = others @ covariance @ others, kept.T
    return Pose(motion.vector, motion.shift, covariance, chi_square, pixels, free, notes)


IDENTITY = Pose(np.zeros(3), np.zeros(3), np.zeros((6, 6)), 1.0, 0, np.zeros((0, 6)))
"""No motion, without errors."""


@checked(pixel_size=in_unit("mm"))
def estimate_pose(
    first: Maps,
    second: Maps,
    pixel_size: ArrayLike | None = None,
    *,
    start: Pose | None = None,
    device: str | Device | None = None,
) -> Pose:
    """Find the rigid motion of an object from one result to the next, with its covariance.

    Each usable pixel of the first result is moved and compared with the second result at its new position:
    normals with normals, and heights with heights, along the second surface's normal (Chen and Medioni, Image
    and Vision Computing 10, 1992). Gauss-Newton steps from coarse to fine maps minimise the squared
    differences over the variances of both maps. If the fit from the identity is not good, a grid of rotations
    about z and shifts is tried.

    Filled pixels, and pixels within two pixels of `edges` or of the border of `contact`, are ignored. Heights
    of unknown offset were integrated from the normals and contain no further information: they only determine
    the positions of points. The pose is then relative to the coordinates of both results, and z is
    undetermined.

    The covariance is estimated from the scatter of the equations over blocks of 8 x 8 pixels, so errors of
    adjacent pixels may be correlated, and may exceed their standard deviations.

    Parameters
    ----------
    first, second : Result, mapping, xarray.Dataset or path
        ``height``, (H, W), mm, with ``height_sigma``, or ``normals``, (H, W, 3), with ``normals_sigma``, or
        both. The sizes may differ. Maps that are on a device are used there.
    pixel_size : float or (float, float), optional
        Millimetres along x and y; by default from the results.
    start : Pose, optional
        Initial motion.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.

    Returns
    -------
    Pose

    Raises
    ------
    mirrorskin.io.InputError
        Heights, standard deviations or an overlap are missing, or no direction is determined.

    Examples
    --------
    >>> import numpy as np
    >>> from mirrorskin import engine, io
    >>> def ball(at):
    ...     x, y = np.meshgrid(np.arange(-20, 21) * 0.1, np.arange(20, -21, -1) * 0.1)
    ...     z = np.sqrt(25 - (x - at) ** 2 - y**2)
    ...     normals = np.dstack([(x - at) / 5, y / 5, z / 5])
    ...     sigma = np.full(x.shape, 0.01)
    ...     return io.Result(height=z - 5, height_sigma=0.1 * sigma, normals=normals, normals_sigma=sigma)
    >>> pose = engine.pose.estimate_pose(ball(0.0), ball(0.2), pixel_size=0.1)
    >>> pose.apply([0, 0, -5]).round(3).tolist()  # the ball's centre; its spin is undetermined
    [0.2, 0.0, -5.0]
    >>> len(pose.undetermined)
    3
    """
    results = {"first": as_result(first, "first"), "second": as_result(second, "second")}
    opened = device_of_maps(device, *results.values())
    before, after = (PoseMap.of(result, pixel_size, opened) for result in results.values())
    fit = PairFit(before, after, opened)
    pose = pose_of(fit, *fit.solve(None if start is None else start.motion))
    findings = [finding for name, result in results.items() for finding in findings_of(name, result.process)]
    notes = tuple(finding.text for finding in findings)
    if pose.chi_square > _MAX_CHI_SQUARE:
        text = (
            f"the maps differ by {pose.chi_square**0.5:.2g} times their standard deviations, as with outliers"
            " or an object that changed: the motion may be wrong by more than its sigma"
        )
        notes = (*notes, text)
    return replace(pose, notes=notes)


def pose_of(fit: PairFit, motion: Motion, now: Equations, free: Doubles) -> Pose:
    """Return the pose of a fitted motion, about the picture's centre."""
    change = fit.second.at_origin
    covariance = change @ now.covariance(free) @ change.T
    return _pose(motion, covariance, (change @ free).T, now.chi_square, int(now.pixels), ())


def pose_after(before: Pose, fit: PairFit, motion: Motion, now: Equations | Followed, free: Doubles) -> Pose:
    """Return a pose followed by the inverse of a fitted motion, of independent errors."""
    back = motion.inverse()
    change = back.adjoint()
    own = change @ fit.second.at_origin
    covariance = own @ now.covariance(free) @ own.T
    if before.covariance is not IDENTITY.covariance:
        covariance += change @ before.covariance @ change.T
    undetermined = before.undetermined
    if free.size or len(undetermined):
        undetermined = np.concatenate([undetermined @ change.T, (own @ free).T])
    moved = before.motion.then(back)
    return _pose(moved, covariance, undetermined, now.chi_square, int(now.pixels), before.notes)
