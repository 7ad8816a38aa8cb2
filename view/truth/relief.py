"""What the figures of heights share: a map, a surface in space, and a cut; what was filled is drawn apart."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import InputError, Result, Truth
from mirrorskin.io.types import Floats
from mirrorskin.view.canvas import draw_image, extent, filled_colours
from mirrorskin.view.colours import FILLED, span

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from mpl_toolkits.mplot3d import Axes3D

_MESH = 120  # samples of a surface along its longer side
_FILLED = "orange: filled"


@dataclass(frozen=True, slots=True)
class Relief:
    """Heights as figures show them.

    Attributes
    ----------
    height : ndarray, (H, W), float32
        Millimetres; NaN without an answer.
    filled : ndarray, (H, W), bool
        Where it was not measured.
    x, y : ndarray, (W,) and (H,), float64
        Millimetres.
    levelled : bool
        Whether a component lies at the truth's mean height, as nobody knows its own.
    """

    height: NDArray[np.float32]
    filled: NDArray[np.bool_]
    x: Floats
    y: Floats
    levelled: bool

    def notes(self, missing: str) -> str:
        """Tell what colours mean, and what a level is worth."""
        filled = [_FILLED] if self.filled.any() else []
        return ", ".join([*filled, missing, *(["truth's level"] if self.levelled else [])])


def relief_of(result: Result, truth: Truth) -> Relief:
    """Return a result's heights; components of unknown offset are moved to the truth's mean height there.

    Raises
    ------
    InputError
        The result has no heights or axes, is of one row or column, or not of the truth's size.
    """
    height, x, y = result.height, result.x, result.y
    if height is None or x is None or y is None or height.ndim != 2 or min(height.shape) < 2:
        raise InputError("a figure needs heights and the pixel size, of 2 x 2 pixels at least")
    check_same_size(height.shape, truth.height)
    filled = np.zeros(height.shape, bool) if result.filled is None else result.filled.astype(bool)
    levelled = result.offset_unknown is not None and bool(result.offset_unknown.any())
    return Relief(_level(result, height, truth.height) if levelled else height, filled, x, y, levelled)


def _level(result: Result, height: NDArray[np.float32], truth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Take the mean error off each component that knows no height; one off the truth stays where it is."""
    assert result.component is not None
    assert result.offset_unknown is not None
    error = height.astype(np.float64) - truth
    told = np.isfinite(error) & (result.component >= 0)
    count, label = result.offset_unknown.size, result.component[told]
    mean = np.bincount(label, error[told], count) / np.maximum(np.bincount(label, minlength=count), 1)
    # The last one is for pixels that are in no component.
    shift = np.append(np.where(result.offset_unknown, mean, 0.0), 0.0)[result.component]
    return np.asarray(height - shift, np.float32)


def draw_map(axes: Axes, name: str, relief: Relief) -> None:
    """Draw heights by brightness, filled ones in shades of orange."""
    lowest, highest = span(relief.height)
    shades: list[str | Colormap] = ["gray", filled_colours()]
    for filled in (False, True) if relief.filled.any() else (False,):
        shown, place = np.where(relief.filled == filled, relief.height, np.nan), extent(relief.x, relief.y)
        label = "" if filled else "height (mm)"
        draw_image(axes, shown, place, label, cmap=shades[filled], vmin=lowest, vmax=highest)
    axes.axhline(0, color="tab:red", lw=0.8, ls=":")
    axes.set(xlabel="x (mm)", ylabel="y (mm)", title=f"{name}\n{relief.notes('blue: no answer')}")


def draw_surface(axes: Axes3D, name: str, relief: Relief) -> None:
    """Draw heights as a surface in space; filled ones have a colour of their own."""
    step = max(1, max(relief.height.shape) // _MESH)
    lowest, highest = span(relief.height)
    height, filled = relief.height[::step, ::step], relief.filled[::step, ::step]
    shown = np.where((height >= lowest) & (height <= highest) | filled, height, np.nan)
    across, up = np.meshgrid(relief.x[::step], relief.y[::step])
    # One surface with colours of its own, as Matplotlib would not know which of two lies in front.
    colours = {"facecolors": _colours(shown, filled), "shade": False} if filled.any() else {"cmap": "viridis"}
    axes.plot_surface(across, up, shown, rstride=1, cstride=1, linewidth=0, antialiased=True, **colours)
    axes.set_box_aspect((np.ptp(relief.x), np.ptp(relief.y), 0.45 * np.ptp(relief.x)), zoom=1.15)
    axes.set(xlabel="x (mm)", ylabel="y (mm)", title=f"{name} (mm)\n{relief.notes('holes: no answer')}")


def _colours(height: NDArray[np.float32], filled: NDArray[np.bool_]) -> Floats:
    """Return the colours of a surface, (H, W, 4): by height, and of what was filled."""
    from matplotlib import colormaps
    from matplotlib.colors import Normalize, to_rgba

    known = height[np.isfinite(height)]
    colours = np.array(colormaps["viridis"](Normalize(known.min(), known.max())(np.nan_to_num(height))))
    colours[filled] = to_rgba(FILLED)
    return colours


def draw_cuts(axes: Axes, reliefs: Mapping[str, Relief], truth: Truth) -> None:
    """Draw heights on the middle row against the truth; filled ones are open circles."""
    row = len(truth.height) // 2
    any_relief = next(iter(reliefs.values()))
    axes.plot(any_relief.x, truth.height[row], color="0.6", lw=3, label="truth")
    dots_on_row(axes, {name: relief.height[row] for name, relief in reliefs.items()}, reliefs)
    opened = any(relief.filled[row].any() for relief in reliefs.values())
    title = "cut across the middle" + ("; open circles: filled" if opened else "")
    axes.set(xlabel="x (mm)", ylabel="height (mm)", title=title)
    lowest = min(span(relief.height)[0] for relief in reliefs.values())
    axes.set_ylim(1.35 * lowest - 0.02, -0.12 * lowest + 0.02)
    axes.grid(alpha=0.3)
    axes.legend(loc="lower center", ncols=2, markerscale=2)


def dots_on_row(axes: Axes, values: Mapping[str, NDArray[np.float32]], reliefs: Mapping[str, Relief]) -> None:
    """Draw values along the middle row, (W,), in the colours and with the names of the reliefs."""
    for number, (name, relief) in enumerate(reliefs.items()):
        filled = relief.filled[len(relief.filled) // 2]
        # The first lies on top, small enough to show the others round it.
        style: dict[str, Any] = {"ms": 3 + number, "zorder": 9 - number, "color": f"C{number}", "ls": ""}
        axes.plot(relief.x, np.where(filled, np.nan, values[name]), marker=".", label=name, **style)
        if filled.any():
            axes.plot(relief.x, np.where(filled, values[name], np.nan), marker="o", mfc="none", **style)


def check_same_size(shape: tuple[int, ...], truth: NDArray[np.float32]) -> None:
    """Raise InputError unless a result and the truth are of one stack."""
    if truth.shape != shape:
        raise InputError(f"the result is {shape} pixels, the truth {truth.shape}: not of one stack")
