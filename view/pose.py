"""Figure of a motion: the object at its first and last touch, its path, and the errors of the path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from mirrorskin.engine.pose.pose import Pose
from mirrorskin.io import InputError, Result
from mirrorskin.io.types import Floats
from mirrorskin.view.canvas import draw_image, extent, new_figure, save_figure
from mirrorskin.view.colours import SEQUENTIAL

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MICRO = 1e3  # um per mm
_COLOURS = "tab:blue", "tab:orange", "tab:green"


@dataclass(frozen=True, slots=True)
class Followed:
    """The estimated and the true motion of an object.

    Attributes
    ----------
    first, last : Result
        Results of the first and the last touch, with height, x and y.
    poses : sequence of Pose
        Motion from the first touch to each.
    vectors, shifts : ndarray, (T, 3)
        True rotation vectors, radians, and translations, mm, relative to the first touch.
    """

    first: Result
    last: Result
    poses: Sequence[Pose]
    vectors: Floats
    shifts: Floats

    @property
    def errors(self) -> Floats:
        """Small rotations and translations from the true to the estimated motion, (T, 6), radians and mm."""
        errors = []
        for pose, vector, shift in zip(self.poses, self.vectors, self.shifts, strict=True):
            rest = Rotation.from_rotvec(pose.rotation) * Rotation.from_rotvec(vector).inv()
            errors.append(np.concatenate([rest.as_rotvec(), pose.translation - rest.apply(shift)]))
        return np.array(errors)

    @property
    def sigmas(self) -> Floats:
        """Their predicted standard deviations, (T, 6)."""
        return np.array([pose.sigma for pose in self.poses])


def pose_figure(found: Followed, title: str, path: Path) -> None:
    """Draw the object, its path and the errors of the path into a PNG.

    Raises
    ------
    InputError
        Matplotlib is not installed, a result has no height, or the file cannot be written.
    """
    figure = new_figure(14, 8)
    axes = figure.subplots(2, 3)
    for one, result, name in ((axes[0, 0], found.first, "first"), (axes[1, 0], found.last, "last")):
        _draw_object(one, found, result, name)
    degrees = float(np.degrees(1.0))
    vectors = degrees * np.array([pose.rotation for pose in found.poses])
    shifts = np.array([pose.translation for pose in found.poses])
    errors, sigmas = found.errors, found.sigmas
    _draw_path(axes[0, 1], shifts, found.shifts, "translation (mm)", "xyz")
    _draw_errors(axes[0, 2], _MICRO * errors[:, 3:], _MICRO * sigmas[:, 3:], "µm")
    about = [f"about {axis}" for axis in "xyz"]
    _draw_path(axes[1, 1], vectors, degrees * found.vectors, "rotation vector (°)", about)
    _draw_errors(axes[1, 2], degrees * errors[:, :3], degrees * sigmas[:, :3], "°")
    save_figure(figure, title, path)


def _draw_object(axes: Axes, found: Followed, result: Result, name: str) -> None:
    if result.height is None or result.x is None or result.y is None:
        raise InputError("a figure of motion needs results with a height and a pixel size")
    draw_image(axes, result.height, extent(result.x, result.y), "height (mm)", cmap=SEQUENTIAL)
    path = np.array([pose.translation for pose in found.poses])
    axes.plot(found.shifts[:, 0], found.shifts[:, 1], color="w", lw=2, label="truth")
    axes.plot(path[:, 0], path[:, 1], "o", ms=4, color="tab:red", label="found")
    axes.set(xlabel="x (mm)", ylabel="y (mm)", title=f"{name} touch, and the path of the object's origin")
    axes.legend(frameon=True, loc="lower right")


def _draw_path(axes: Axes, found: Floats, truth: Floats, label: str, names: Sequence[str]) -> None:
    touch = np.arange(len(found))
    for part, name, colour in zip(range(3), names, _COLOURS, strict=True):
        axes.plot(touch, truth[:, part], color=colour, lw=1)
        axes.plot(touch, found[:, part], "o", ms=4, color=colour, label=name)
    axes.set(xlabel="touch", ylabel=label, title="estimated (dots) and true (lines)")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)


def _draw_errors(axes: Axes, errors: Floats, sigmas: Floats, unit: str) -> None:
    touch = np.arange(len(errors))
    for error, sigma, colour in zip(errors.T, sigmas.T, _COLOURS, strict=True):
        axes.fill_between(touch, -sigma, sigma, color=colour, alpha=0.2, lw=0)
        axes.plot(touch, error, "o-", ms=4, lw=1, color=colour)
    rms = np.sqrt(np.mean(errors[1:] ** 2))
    axes.set(xlabel="touch", ylabel=f"error ({unit})", title=f"error: RMS {rms:.2g} {unit}; bands: sigma")
    axes.grid(alpha=0.3)
