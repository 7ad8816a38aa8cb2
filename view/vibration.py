"""Figure of vibration: an oscillating press, a rocking body, and a growing contact."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import InputError, Result
from mirrorskin.io.types import Floats
from mirrorskin.view.canvas import draw_image, extent, new_figure, save_figure
from mirrorskin.view.colours import DIVERGING, SEQUENTIAL

_MICRO = 1e3  # um per mm
_WIDE = 4.0  # range of the histograms, standard deviations


@dataclass(frozen=True, slots=True)
class Vibration:
    """Estimated and true results of three vibrations.

    Attributes
    ----------
    strokes : sequence of (float, float, float)
        Number of strokes down, RMS error of the height, and RMS of its predicted standard deviation, mm.
    press : Result
        Result of all strokes, with height, hysteresis and their sigmas.
    height : ndarray, (H, W)
        True height, mm.
    hysteresis : float
        True hysteresis, mm.
    rocked : Result
        Result with slope and its sigma, x and y.
    slope : ndarray, (H, W)
        True slope along the direction of rocking.
    dithered : Result
        Result with growth, x and y, and the area's growth in its process.
    growth : float
        True growth of the area, mm^2/mm.
    """

    strokes: Sequence[tuple[float, float, float]]
    press: Result
    height: NDArray[np.floating]
    hysteresis: float
    rocked: Result
    slope: NDArray[np.floating]
    dithered: Result
    growth: float

    @property
    def deviations(self) -> dict[str, Floats]:
        """Errors divided by standard deviations, where defined, by name of the map."""
        press, rocked = self.press, self.rocked
        if press.height is None or press.hysteresis is None or rocked.slope is None:
            raise InputError("a figure of vibration needs heights, a hysteresis and a slope")
        assert press.height_sigma is not None
        assert press.hysteresis_sigma is not None
        assert rocked.slope_sigma is not None
        assert rocked.contact is not None
        touched = np.where(rocked.contact == 1, rocked.slope, np.nan)
        lag = np.where(np.isfinite(self.height), press.hysteresis - self.hysteresis, np.nan)
        found = {
            "height": (press.height - self.height) / press.height_sigma,
            "hysteresis": lag / press.hysteresis_sigma,
            "slope": (touched - self.slope) / rocked.slope_sigma,
        }
        return {name: one[np.isfinite(one)].astype(np.float64) for name, one in found.items()}


def vibration_figure(found: Vibration, title: str, path: Path) -> None:
    """Draw the results of vibrations, with truth and errors, into a PNG.

    Raises
    ------
    InputError
        Matplotlib is not installed, a map is missing, or the file cannot be written.
    """
    off = found.deviations
    press, rocked, dithered = found.press, found.rocked, found.dithered
    assert press.hysteresis is not None
    assert rocked.slope is not None
    if dithered.growth is None or any(one is None for one in (rocked.x, rocked.y, dithered.x, dithered.y)):
        raise InputError("a figure of vibration needs a growth, and results with a pixel size")
    assert rocked.x is not None
    assert rocked.y is not None
    assert dithered.x is not None
    assert dithered.y is not None
    figure = new_figure(15, 8)
    grid = figure.add_gridspec(2, 3)

    axes = figure.add_subplot(grid[0, 0])
    count, error, sigma = np.array(found.strokes).T
    axes.loglog(count, _MICRO * error, "o", label="RMS error")
    axes.loglog(count, _MICRO * sigma, "-", label="predicted")
    axes.loglog(count, _MICRO * error[0] / np.sqrt(count), ":", color="0.6", label="as a mean would")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("")
    axes.yaxis.set_minor_formatter("{x:g}")
    axes.set(xlabel="strokes down", ylabel="height (µm)", title="an oscillating press")
    axes.grid(alpha=0.3, which="both")
    axes.legend(frameon=False)

    axes = figure.add_subplot(grid[0, 1])
    hysteresis = _MICRO * press.hysteresis[np.isfinite(press.hysteresis + found.height)]
    low, high = np.percentile(hysteresis, [0.2, 99.8]).tolist()
    axes.hist(hysteresis, np.linspace(low, high, 60).tolist(), color="tab:blue", alpha=0.7)
    axes.axvline(_MICRO * found.hysteresis, color="tab:red", label="truth")
    axes.set(xlabel="release - onset (µm)", ylabel="pixels")
    axes.set(title=f"hysteresis: mean {hysteresis.mean():.2f} µm, truth {_MICRO * found.hysteresis:.0f} µm")
    axes.legend(frameon=False)

    axes = figure.add_subplot(grid[0, 2])
    bins = np.linspace(-_WIDE, _WIDE, 65)
    for name, values in off.items():
        label = f"{name}: chi2 {np.mean(values**2):.2f}"
        axes.hist(values, bins.tolist(), density=True, histtype="step", lw=1.5, label=label)
    axes.plot(bins, np.exp(-(bins**2) / 2) / np.sqrt(2 * np.pi), color="0.6", label="normal")
    axes.set(ylim=(0, 1.6 * axes.get_ylim()[1]))
    axes.set(xlabel="error / standard deviation", title="errors against their prediction")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)

    touched = np.where(rocked.contact == 1, rocked.slope, np.nan)
    place, side = extent(rocked.x, rocked.y), float(np.nanmax(np.abs(found.slope)))
    axes = figure.add_subplot(grid[1, 0])
    draw_image(axes, touched, place, "slope along it", cmap=DIVERGING, vmin=-side, vmax=side)
    axes.set(xlabel="x (mm)", ylabel="y (mm)", title="a rocking body: slope along one direction")
    axes = figure.add_subplot(grid[1, 1])
    wrong = touched - found.slope
    side = 4 * float(np.nanstd(wrong))
    draw_image(axes, wrong, place, "error of the slope", "both", cmap=DIVERGING, vmin=-side, vmax=side)
    axes.set(xlabel="x (mm)", title=f"minus the truth: RMS {np.sqrt(np.nanmean(wrong**2)):.3f}")

    axes = figure.add_subplot(grid[1, 2])
    place, most = extent(dithered.x, dithered.y), float(np.nanpercentile(dithered.growth, 99.5))
    draw_image(axes, dithered.growth, place, "growth (1/mm)", "max", cmap=SEQUENTIAL, vmin=0, vmax=most)
    area = float(dithered.process.get("area_growth", np.nan))
    axes.set(xlabel="x (mm)", title=f"dither: area grows by {area:.2f} mm²/mm, truth {found.growth:.2f}")
    save_figure(figure, title, path)
