"""Figure of forces: the pressure of a press, and estimated against true forces."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import InputError, Result
from mirrorskin.view.canvas import draw_image, extent, new_figure, save_figure
from mirrorskin.view.colours import SEQUENTIAL

_KILO = 1e3  # kPa per MPa


def force_figure(
    results: Mapping[str, Result],
    truths: Mapping[str, float],
    pressure: NDArray[np.float32],
    title: str,
    path: Path,
) -> None:
    """Draw the pressure of the last result, a cut through it with the truth, and all forces into a PNG.

    Parameters
    ----------
    results : mapping
        Results with ``force`` by name; the last one also with ``pressure``, ``x`` and ``y``.
    truths : mapping
        True forces by the same names, N.
    pressure : ndarray, (H, W), float32
        True pressure of the last result, MPa.
    title : str
    path : Path
        PNG to write.

    Raises
    ------
    InputError
        Matplotlib is not installed, a result has no force or no pressure of that size, or the file cannot be
        written.
    """
    last, shown = list(results.items())[-1]
    lacking = [name for name, result in results.items() if result.force is None or result.force_sigma is None]
    if lacking:
        raise InputError(f"{lacking[0]} has no force: reconstruct it with a modulus")
    if shown.pressure is None or shown.x is None or shown.y is None or shown.pressure.shape != pressure.shape:
        raise InputError(f"{last} has no pressure of the truth's size: reconstruct it with a modulus")
    figure = new_figure(14, 4.8)
    grid = figure.add_gridspec(2, 3, height_ratios=[2, 1])
    axes = figure.add_subplot(grid[:, 0])
    found, true = _KILO * shown.pressure, _KILO * pressure
    draw_image(axes, found, extent(shown.x, shown.y), "pressure (kPa)", cmap=SEQUENTIAL, vmin=0)
    axes.axhline(0, color="tab:red", lw=0.8, ls=":")
    axes.set(xlabel="x (mm)", ylabel="y (mm)", title=last)
    axes = figure.add_subplot(grid[:, 1])
    row = len(found) // 2
    axes.plot(shown.x, true[row], color="0.6", lw=3, label="truth")
    axes.plot(shown.x, found[row], ".", ms=4, label="found")
    axes.set(xlabel="x (mm)", ylabel="pressure (kPa)", title="cut across the middle")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    force, sigma, truth = (
        np.array(part, np.float64)
        for part in zip(
            *((result.force, result.force_sigma, truths[name]) for name, result in results.items()),
            strict=True,
        )
    )
    axes = figure.add_subplot(grid[0, 2])
    axes.plot([0, truth.max()], [0, truth.max()], color="0.6", lw=1)
    axes.errorbar(truth, force, sigma, fmt=".", capsize=3)
    off = (force - truth) / truth
    rms, chi_square = 100 * np.sqrt(np.mean(off**2)), np.mean(((force - truth) / sigma) ** 2)
    axes.set(
        ylabel="estimated force (N)",
        title=f"{len(force)} presses: RMS error {rms:.2g} %, chi2 {chi_square:.2f}",
    )
    axes.tick_params(labelbottom=False)
    axes.grid(alpha=0.3)
    below = figure.add_subplot(grid[1, 2], sharex=axes)
    below.axhline(0, color="0.6", lw=1)
    below.errorbar(truth, 100 * off, 100 * sigma / truth, fmt=".", capsize=3)
    below.set(xlabel="true force (N)", ylabel="error (%)")
    below.grid(alpha=0.3)
    save_figure(figure, title, path)
