"""Rooflines: what kernels reach, by the operations that they do with a byte, below what the device can do."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mirrorskin.bench.report import is_limit
from mirrorskin.bench.run import Data
from mirrorskin.view.canvas import new_figure, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_WIDTH, _HEIGHT = 13, 7  # inches of one device's picture
_GIGA = 1e9
_LARGE = 0.5  # of the most bytes of a limit or a kernel, from which others count: fewer may lie in a cache
_MARGIN = 2.5  # factor by which the axes go beyond what they show
_STYLES = {"read": "-", "triad": "--"}
_COLOURS = "#0072b2", "#d55e00", "#009e73", "#b5508f", "#b07d00", "#2b9ad6", "#6a3d9a", "#555555"
_ROOF, _INSIDE = "#333333", "#f4f6f8"
_LINES = 24  # of names that a picture is high
_SHARE = 0.69  # of the width for the roof, the rest is for names
_DISC = 13  # points
_BESIDE = 1.08  # factor by which a text is above or below its slope
_NUMBER: dict[str, Any] = {"ha": "center", "va": "center_baseline", "color": "white", "fontsize": 7.5}


@dataclass(frozen=True, slots=True)
class Point:
    """A kernel on one size and type: bytes, operations and seconds of a turn, and the share of its limit."""

    bytes: float
    operations: float
    seconds: float
    share: float | None = None

    @property
    def intensity(self) -> float:
        """Operations with each byte."""
        return self.operations / self.bytes

    @property
    def rate(self) -> float:
        """Operations per second."""
        return self.operations / self.seconds


@dataclass(frozen=True, slots=True)
class Kernel:
    """A kernel in all sizes and types."""

    name: str
    case: str
    points: tuple[Point, ...]

    @property
    def best(self) -> Point:
        """Where it does most of those with so many bytes that they lie in memory."""
        most = max(point.bytes for point in self.points)
        return max((one for one in self.points if one.bytes >= _LARGE * most), key=lambda one: one.rate)


@dataclass(frozen=True, slots=True)
class Roofline:
    """What a device can do, bytes and multiply-adds a second, and its kernels."""

    bandwidths: dict[str, float]
    peak: float
    kernels: tuple[Kernel, ...]

    def allowed(self, intensity: float) -> float:
        """Return how many operations per second memory and arithmetic allow."""
        return min(intensity * max(self.bandwidths.values()), self.peak)

    def share(self, point: Point) -> float:
        """Return how much of what is allowed a point reaches; of memory as it was when the two took turns."""
        if point.share is None:
            return point.rate / self.allowed(point.intensity)
        return max(point.share, point.rate / self.peak)


def roofline_of(cases: Iterable[Data]) -> Roofline | None:
    """Return the roofline of the cases of one machine; None where they have no limit or no operations."""
    rows = [(case["name"], row) for case in cases for row in case["rows"] if _ran_kernels(row)]
    limits = [row for _, row in rows if is_limit(row)]
    points: dict[tuple[str, str], list[Point]] = {}
    for case, row in rows:
        if not is_limit(row) and row["bytes"] and row["operations"]:
            name = row["name"].partition(", ")[0]
            points.setdefault((case, name), []).append(_point(row))
    bandwidths = _bandwidths(limits)
    if not points or not bandwidths:
        return None
    peak = max((_point(row).rate for row in limits if row["operations"]), default=np.inf)
    kernels = (Kernel(name, case, tuple(mine)) for (case, name), mine in points.items())
    return Roofline(bandwidths, peak, tuple(sorted(kernels, key=lambda kernel: kernel.best.intensity)))


def draw_rooflines(rooflines: Mapping[str, Roofline], path: Path) -> None:
    """Draw the rooflines of machines, by their titles and one below the other, into a PNG.

    Raises InputError where Matplotlib is not installed, or the file cannot be written.
    """
    figure = new_figure(_WIDTH, _HEIGHT * len(rooflines))
    every = figure.subplots(len(rooflines), 2, squeeze=False, width_ratios=[_SHARE, 1 - _SHARE])
    for (axes, names), (title, roofline) in zip(every, rooflines.items(), strict=True):
        _draw_roof(axes, roofline)
        _draw_kernels(axes, roofline.kernels)
        _draw_list(names, roofline)
        axes.set_title(title, loc="left", fontsize=9, color="0.35")
    save_figure(figure, "What the kernels reach of the limits of memory and arithmetic", path)


def _ran_kernels(row: Data) -> bool:
    return "kernel" in row["device"] and row["device"]["kernel"]["median"] > 0


def _point(row: Data) -> Point:
    return Point(row["bytes"], row["operations"], row["device"]["kernel"]["median"], row["kernel_share"])


def _bandwidths(limits: Sequence[Data]) -> dict[str, float]:
    found = {}
    for name in _STYLES:
        mine = [row for row in limits if row["name"].startswith(name)]
        most = max((row["bytes"] for row in mine), default=0)
        rates = [_bandwidth(row) for row in mine if row["bytes"] >= max(1, _LARGE * most)]
        if rates:
            found[name] = max(rates)
    return found


def _bandwidth(row: Data) -> float:
    return float(row["bytes"] / row["device"]["kernel"]["median"])


def _draw_roof(axes: Axes, roofline: Roofline) -> None:
    points = [point for kernel in roofline.kernels for point in kernel.points]
    ridges = [roofline.peak / bandwidth for bandwidth in roofline.bandwidths.values()]
    across = [point.intensity for point in points] + [ridge for ridge in ridges if np.isfinite(ridge)]
    left, right = min(across) / _MARGIN, max(across) * _MARGIN
    top = max(roofline.allowed(right), *(point.rate for point in points))
    x = np.geomspace(left, right, 200)
    axes.set(xscale="log", yscale="log", xlim=(left, right))
    axes.set(ylim=(min(point.rate for point in points) / _GIGA / _MARGIN, top / _GIGA * _MARGIN))
    axes.fill_between(x, 0, [roofline.allowed(one) / _GIGA for one in x], color=_INSIDE, zorder=0)
    for name, bandwidth in roofline.bandwidths.items():
        slope = np.append(x[x * bandwidth < roofline.peak], min(roofline.peak / bandwidth, right))
        axes.plot(slope, slope * bandwidth / _GIGA, _STYLES[name], color=_ROOF, lw=1.6, zorder=2)
        above = bandwidth == max(roofline.bandwidths.values())
        _name_slope(axes, f"{name}: {bandwidth / _GIGA:.1f} GB/s", bandwidth / _GIGA, above=above)
    if np.isfinite(roofline.peak):
        axes.plot([min(ridges), right], [roofline.peak / _GIGA] * 2, color=_ROOF, lw=1.6, zorder=2)
        said = f"multiply-adds: {roofline.peak / _GIGA:.0f} G/s"
        axes.annotate(said, (right, roofline.peak / _GIGA), (-6, 4), textcoords="offset points", ha="right")
    axes.set(xlabel="multiply-adds with each byte that must move", ylabel="G multiply-adds / s")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")
    axes.grid(which="major", color="0.88", lw=0.6, zorder=1)
    axes.spines[["top", "right"]].set_visible(False)


def _name_slope(axes: Axes, said: str, bandwidth: float, *, above: bool) -> None:
    """Write beside a slope, in its direction."""
    (left, right), (bottom, _) = axes.get_xlim(), axes.get_ylim()
    x = max(left, bottom / bandwidth) * (right / left) ** 0.02
    axes.text(
        x,
        x * bandwidth * (_BESIDE if above else 1 / _BESIDE),
        said,
        va="bottom" if above else "top",
        rotation=float(np.degrees(np.arctan(bandwidth))),
        rotation_mode="anchor",
        transform_rotates_text=True,
        fontsize=9,
        color=_ROOF,
    )


def _draw_kernels(axes: Axes, kernels: Sequence[Kernel]) -> None:
    """Draw each kernel with its number, and small where it is in other sizes and types."""
    for number, (kernel, colour) in enumerate(zip(kernels, _colours(kernels), strict=True), 1):
        across = [point.intensity for point in kernel.points]
        up = [point.rate / _GIGA for point in kernel.points]
        axes.plot(across, up, "o", ms=3.5, color=colour, alpha=0.4, mew=0, zorder=3)
        place = kernel.best.intensity, kernel.best.rate / _GIGA
        axes.plot(*place, "o", ms=_DISC, color=colour, mec="white", mew=0.8, zorder=4)
        axes.text(*place, str(number), zorder=5, **_NUMBER)


def _draw_list(axes: Axes, roofline: Roofline) -> None:
    """Name the kernels, with the share of what memory and arithmetic allow them."""
    axes.set(xlim=(0, 1), ylim=(max(len(roofline.kernels), _LINES) + 0.5, -0.5))
    axes.axis("off")
    axes.text(0, 0, "kernel", va="center_baseline", weight="bold")
    axes.text(1, 0, "of its roof", va="center_baseline", ha="right", weight="bold")
    for y, (kernel, colour) in enumerate(zip(roofline.kernels, _colours(roofline.kernels), strict=True), 1):
        axes.plot(0.03, y, "o", ms=11, color=colour)
        axes.text(0.03, y, str(y), **_NUMBER)
        axes.text(0.08, y, kernel.name, va="center_baseline", fontsize=9)
        axes.text(
            1, y, f"{100 * roofline.share(kernel.best):.0f} %", va="center_baseline", ha="right", fontsize=9
        )


def _colours(kernels: Sequence[Kernel]) -> list[str]:
    """Return a colour for each kernel: one for all of a case."""
    cases = dict(zip(dict.fromkeys(kernel.case for kernel in kernels), cycle(_COLOURS), strict=False))
    return [cases[kernel.case] for kernel in kernels]
