"""The figures of ``docs/sensor.md``: the sensor's section, and errors as functions of its dimensions."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mirrorskin.evaluation.base.tables import Table
from mirrorskin.twin import Body, visible_zenith

TICKS = (0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100)


def draw_section(path: Path) -> None:
    """Draw the sensor cut through its axis, and what comes to the camera from three mirrors."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 5.4), layout="constrained")
    axes = figure.add_subplot(aspect="equal")
    body, deep = Body(), 3.0
    x = np.linspace(-body.radius, body.radius, 801)
    ball = np.sqrt(np.maximum(5.0**2 - x**2, 0.0)) - 5.0 + deep
    sheet = np.maximum(ball, 0.0)
    axes.fill_between(x, sheet, body.height, color="#dbe9f4", lw=0)
    axes.plot(x, sheet, color="black", lw=2)
    axes.fill_between(x, np.where(np.abs(x) < 5, ball, np.nan), -4.0, color="#c8c8c8", lw=0)
    for side in (-1, 1):
        wall = side * (body.radius + 0.4)
        axes.plot([wall, wall], [0, body.height], color="tab:orange", lw=3)
        for high in (12, 28):
            axes.add_patch(_circle((side * (body.radius + 4), high), 2.2))
    for zenith, colour in ((8.0, "tab:gray"), (20.0, "tab:green"), (35.0, "tab:blue")):
        _draw_ray(axes, body, deep, zenith, colour)
    axes.annotate("camera", (0, 47), ha="center")
    axes.annotate("body: clear silicone", (-16, 33), color="#30506a")
    axes.annotate("printed sheet,\nthen a diffuser", (-30, 42), color="tab:orange")
    axes.annotate("lamp", (25, 28), va="center")
    axes.annotate("mirror skin", (-16.5, 1.2))
    axes.annotate("object", (0, -2.6), ha="center")
    axes.set(xlim=(-31, 31), ylim=(-4, 50), xlabel="mm", ylabel="mm")
    figure.savefig(path, dpi=110)


def _circle(place: tuple[float, float], radius: float) -> Any:
    from matplotlib.patches import Circle

    return Circle(place, radius, color="#ffe08a", ec="tab:orange")


def _draw_ray(axes: Any, body: Body, deep: float, zenith: float, colour: str) -> None:
    """Draw what comes to the camera from a mirror of a zenith on the ball's right flank."""
    lean = math.radians(zenith)
    start = 5.0 * math.sin(lean), 5.0 * math.cos(lean) - 5.0 + deep
    along = math.sin(2 * lean), math.cos(2 * lean)
    far = min((body.radius - start[0]) / along[0], (body.height - start[1]) / along[1])
    end = start[0] + far * along[0], start[1] + far * along[1]
    axes.plot([start[0]] * 2, [start[1], 46], color=colour, lw=1.2)
    axes.plot([start[0], end[0]], [start[1], end[1]], color=colour, lw=1.2)
    dark = end[1] > body.height - 0.1
    place = end[0] + 1.2, end[1] + 0.6
    axes.annotate(f"{zenith:g} deg: {'dark' if dark else 'light'}", place, color=colour)


def draw_trades(path: Path, tables: Mapping[str, Table]) -> None:
    """Draw what is seen from where, and the error by half-angle, step and frames."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 6.2), layout="constrained")
    (zenith_axes, lean), (step, many) = figure.subplots(2, 2)
    away = np.linspace(0, 16.5, 60)
    for azimuth, name, colour in (
        (math.pi, "inward", "tab:blue"),
        (math.pi / 2, "sideways", "tab:green"),
        (0.0, "outward", "tab:red"),
    ):
        for air, style in ((0.0, "-"), (0.5, ":")):
            lower, _ = visible_zenith(Body(air_gap=air), away, 0.0, azimuth)
            label = f"faces {name}" if air == 0 else None
            zenith_axes.plot(away, np.degrees(lower), style, color=colour, label=label)
    zenith_axes.set(
        xlabel="mm off the centre", ylabel="least zenith, deg", title="where light begins (dotted: air gap)"
    )
    zenith_axes.legend(frameon=False)
    _curve(lean, tables["tilts"], "half-angle", ("zenith, RMS deg", "across, RMS deg"), "degrees")
    lean.set_title("normals by half-angle")
    _curve(
        step, tables["steps"], "step, mm", ("eq. 4: RMS", "sub-frame: RMS", "step/sqrt(12)"), "micrometres"
    )
    step.set_title("heights of a press by its step")
    _curve(many, tables["phases"], "frames a turn", ("normal, RMS deg",), "degrees")
    many.set_title("normals by frames in a turn")
    figure.savefig(path, dpi=100)


def _curve(axes: Any, table: Table, across: str, names: tuple[str, ...], unit: str) -> None:
    places = table.column(across)
    for name in names:
        axes.loglog(places, table.column(name), "--" if "sqrt" in name else "o-", label=name)
    axes.set_xticks(places, [f"{place:g}" for place in places])
    low, high = axes.get_ylim()
    ticks = [tick for tick in TICKS if low < tick < high]
    axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.set(xlabel=across, ylabel=unit)
    axes.legend(frameon=False)
