"""Figure of slip: displacement of the skin and onset of slip in a slide, and the same for a twist."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import InputError, Result, Truth
from mirrorskin.io.types import Floats
from mirrorskin.view.canvas import draw_image, extent, new_figure, save_figure
from mirrorskin.view.colours import DIVERGING, ERROR, SEQUENTIAL

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MICRO = 1e3  # um per mm
_ARROWS = 12  # along each side


@dataclass(frozen=True, slots=True)
class Slipped:
    """Estimated and true slip of a slide or a twist.

    Attributes
    ----------
    found : Result
        The maps of `mirrorskin.engine.slip.Slip`.
    truth : Truth
        Truth with displacement and slip_onset.
    contact : ndarray, (H, W), bool
        Where the skin touched the object before the motion.
    closed : ndarray, (T,)
        Share of the contact that sticks, from a closed-form solution.
    x, y : ndarray, (W,) and (H,)
        mm.
    """

    found: Result
    truth: Truth
    contact: NDArray[np.bool_]
    closed: Floats
    x: Floats
    y: Floats

    def __post_init__(self) -> None:
        if self.truth.displacement is None or self.truth.slip_onset is None:
            raise InputError("a figure of slip needs a truth with displacement and slip onset: simulate one")

    @property
    def onset(self) -> Floats:
        """True onset of slip, (H, W), in contact; NaN where the skin sticks to the end."""
        assert self.truth.slip_onset is not None
        onset: Floats = np.where(self.contact, self.truth.slip_onset, np.nan).astype(np.float64)
        return onset

    @property
    def onset_error(self) -> Floats:
        """Estimated onset minus the true one, (H, W); NaN where either sticks."""
        error: Floats = self.found.slip_onset - self.onset
        return error

    @property
    def displacement_error(self) -> Floats:
        """Estimated displacement in the last frame minus the true one, (H, W, 2), mm."""
        assert self.truth.displacement is not None
        error: Floats = self.found.displacement - self.truth.displacement[-1].astype(np.float64)
        return error

    @property
    def distance(self) -> Floats:
        """Distance that the body has slid, mm, or angle that it has turned, radians, in each frame, (T,)."""
        distance = (
            self.found.slide_distance if self.found.slide_distance is not None else self.found.twist_angle
        )
        return np.asarray(distance, np.float64)

    @property
    def true_ratio(self) -> Floats:
        """True share of the contact that sticks, (T,)."""
        onset = self.onset[self.contact]
        return np.array([1 - np.mean(onset <= distance) for distance in self.distance])


def slip_figure(slid: Slipped, twisted: Slipped, title: str, path: Path) -> None:
    """Draw a slide and a twist, with truth and errors, into a PNG.

    Raises
    ------
    InputError
        Matplotlib is not installed, or the file cannot be written.
    """
    figure = new_figure(13, 11)
    axes = figure.subplots(3, 3)
    _draw_displacement(axes[0], slid)
    _draw_stick_ratio(axes[0, 2], slid, 1.0, "travelled distance (mm)", "Cattaneo and Mindlin")
    _draw_onset(axes[1, 0], slid, slid.found.slip_onset, "mm", "slide: onset, estimated")
    _draw_onset(axes[1, 1], slid, slid.onset, "mm", "slide: onset, true")
    _draw_onset_error(axes[1, 2], slid, _MICRO, "µm")
    degrees = float(np.degrees(1.0))
    _draw_onset(axes[2, 0], twisted, degrees * twisted.found.slip_onset, "°", "twist: onset, estimated")
    _draw_onset_error(axes[2, 1], twisted, degrees, "°")
    _draw_stick_ratio(axes[2, 2], twisted, degrees, "twist of the body (°)", "Lubkin")
    for one in axes[:, 0]:
        one.set(ylabel="y (mm)")
    save_figure(figure, title, path)


def _draw_displacement(axes: NDArray[np.object_], slid: Slipped) -> None:
    moved, error = (
        _MICRO * np.linalg.norm(part, axis=-1) for part in (slid.found.displacement, slid.displacement_error)
    )
    place = extent(slid.x, slid.y)
    draw_image(axes[0], moved, place, "displacement (µm)", cmap=SEQUENTIAL, vmin=0)
    step = max(1, len(slid.x) // _ARROWS)
    some = np.s_[step // 2 :: step]
    across, up = np.moveaxis(slid.found.displacement[some, some], -1, 0)
    axes[0].quiver(
        slid.x[some], slid.y[some], across, up, color="w", angles="xy", scale_units="xy", scale=1, width=6e-3
    )
    axes[0].set(title="slide: displacement of the skin, estimated")
    draw_image(
        axes[1], error, place, "error (µm)", "max", cmap=ERROR, vmin=0, vmax=np.nanpercentile(error, 99)
    )
    axes[1].set(title=f"its error: RMS {np.sqrt(np.nanmean(error**2)):.1f} µm")
    for one in axes[:2]:
        _outline(one, slid)


def _draw_onset(axes: Axes, slid: Slipped, onset: NDArray[np.floating], unit: str, title: str) -> None:
    draw_image(axes, onset, extent(slid.x, slid.y), f"onset of slip ({unit})", cmap=SEQUENTIAL, vmin=0)
    axes.set(title=title)
    _outline(axes, slid)


def _draw_onset_error(axes: Axes, slid: Slipped, scale: float, unit: str) -> None:
    error = scale * slid.onset_error
    side = float(np.nanpercentile(np.abs(error), 99))
    draw_image(
        axes, error, extent(slid.x, slid.y), f"error ({unit})", "both", cmap=DIVERGING, vmin=-side, vmax=side
    )
    axes.set(title=f"its error: RMS {np.sqrt(np.nanmean(error**2)):.2g} {unit}")
    _outline(axes, slid)


def _outline(axes: Axes, slid: Slipped) -> None:
    """Draw the border of the contact, and that of the region that sticks at the end."""
    axes.contour(slid.x, slid.y, slid.contact, [0.5], colors="k", linewidths=1)
    stuck = slid.contact & np.isnan(slid.onset)
    axes.contour(slid.x, slid.y, stuck, [0.5], colors="tab:red", linewidths=1)
    axes.set(xlabel="x (mm)")


def _draw_stick_ratio(axes: Axes, slid: Slipped, scale: float, label: str, theory: str) -> None:
    distance = scale * slid.distance
    axes.plot(distance, slid.closed, color="0.6", lw=3, label=theory)
    axes.plot(distance, slid.true_ratio, color="tab:red", lw=1, label="truth of the twin")
    axes.plot(distance, slid.found.stick_ratio, "o", ms=4, label="estimated")
    axes.set(xlabel=label, ylabel="share of the contact that sticks", ylim=(0, 1.05), title="stick ratio")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
