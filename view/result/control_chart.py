"""Control charts of the measures of many results."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from mirrorskin.engine.metrology import Table
from mirrorskin.io import InputError
from mirrorskin.view.drawing.canvas import new_figure

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_RANGE = 1.128  # mean range of two normal variates, in standard deviations (ISO 7870-2, d2)
_CONTROL = 3  # standard deviations of the control limits from the mean
_COVERAGE = 2  # of the error bars
_WIDTH, _HEIGHT, _EXTRA = 8.0, 2.1, 0.9  # inches: of the page, of a panel, and for the labels below
_MOST_LABELS = 40  # results whose names are written
_LONGEST = 24  # letters of a name


def control_chart(table: Table) -> Figure:
    """Draw a control chart of individual values (ISO 7870-2), a panel for each quantity.

    Parameters
    ----------
    table : Table
        Its quantities with limits are drawn, or the five that matter most.

    Returns
    -------
    Figure
        Values with expanded uncertainties (k = 2); the mean and the control limits at three standard
        deviations, from the mean difference of results that follow each other; a trend, if one is clear; and
        the limits of the table.

    Raises
    ------
    InputError
        No result has a quantity.
    """
    shown = [name for name in table.main() if np.isfinite(table.values(name)[0]).any()]
    if not shown:
        raise InputError("no result has a quantity to draw: nothing was measured")
    figure = new_figure(_WIDTH, _HEIGHT * len(shown) + _EXTRA)
    panels = figure.subplots(len(shown), 1, sharex=True, squeeze=False)[:, 0]
    for axes, name in zip(panels, shown, strict=True):
        _draw(axes, table, name)
    labels = [row.name if len(row.name) <= _LONGEST else f"…{row.name[1 - _LONGEST :]}" for row in table.rows]
    last = panels[-1]
    if len(labels) <= _MOST_LABELS:
        last.set_xticks(np.arange(1, len(labels) + 1), labels, rotation=60, ha="right", fontsize=7)
    else:
        last.set_xlabel("number of the result")
    entries = _legend(list(panels))
    figure.legend(
        list(entries.values()), list(entries), loc="outside upper right", ncols=4, fontsize=8, frameon=False
    )
    return figure


def _legend(panels: Sequence[Axes]) -> dict[str, Artist]:
    """Return the entries of all panels by their text."""
    entries: dict[str, Artist] = {}
    for axes in panels:
        for handle, text in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(text, handle)
    return entries


def _draw(axes: Axes, table: Table, name: str) -> None:
    """Draw one quantity over the number of the result."""
    values, sigmas = table.values(name)
    number = np.arange(1, values.size + 1)
    unit = table.unit(name)
    axes.set_ylabel(f"{name}\n({unit})" if unit else name, fontsize=8)
    axes.grid(axis="y", alpha=0.3)
    bars = _COVERAGE * np.nan_to_num(sigmas)
    axes.errorbar(
        number, values, bars, fmt="o-", color="tab:blue", lw=0.8, ms=4, capsize=2, label="value, k = 2"
    )
    known = values[np.isfinite(values)]
    mean = float(np.mean(known))
    axes.axhline(mean, color="0.3", lw=1, label="mean")
    if known.size > 2:
        reach = _CONTROL * float(np.mean(np.abs(np.diff(known)))) / _RANGE
        for bound in (mean - reach, mean + reach):
            axes.axhline(bound, color="0.3", lw=1, ls=":", label="control limits")
    trend = table.trend(name)
    if trend is not None:
        axes.plot(number, trend.line, color="tab:orange", lw=1.4, label="trend")
    if name not in table.limits:
        return
    low, high = table.limits[name].within(name, unit)
    for bound in (low, high):
        if math.isfinite(bound):
            axes.axhline(bound, color="tab:red", lw=1.2, ls="--", label="limits")
    outside = np.array(
        [table.limits[name].judge(name, row.quantity(name)) == "outside" for row in table.rows]
    )
    axes.plot(number[outside], values[outside], "s", color="tab:red", ms=8, mfc="none", label="outside")
