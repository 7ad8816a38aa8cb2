"""Live view of a measurement in rerun."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.live.status import SHOWN, Status, Update
from mirrorskin.io import Result
from mirrorskin.io.base.types import axes_with_unit
from mirrorskin.io.base.units import numbers_with_unit
from mirrorskin.io.model.maps import is_deviation
from mirrorskin.io.model.result import display_order
from mirrorskin.view.drawing.colours import Colours, grey, height_colours, normal_colours
from mirrorskin.view.result.scale import displayed_values, in_figure_unit
from mirrorskin.view.result.sheet import sheet_of
from mirrorskin.view.viewer import close_stream, load_rerun, open_stream

_END = 2.0  # seconds to wait until the last pictures have reached the viewer


class LiveView:
    """The camera's picture, the maps of the operation, and a cross-section of its heights, updated live.

    Parameters
    ----------
    where : str or Path
        "window", "browser", or a file to write; see ``open_stream``.
    shape : (int, int)
        Rows and columns of the picture.
    pixel_size : (float, float), optional
        Millimetres along x and y; without it, the cross-section is along pixels.

    Raises
    ------
    mirrorskin.io.InputError
        rerun is not installed or does not start, or the file cannot be written.
    """

    def __init__(
        self, where: str | Path, shape: tuple[int, int], pixel_size: tuple[float, float] | None = None
    ) -> None:
        self._x, _, unit = axes_with_unit(shape, pixel_size)
        self._ranges: dict[str, _Range] = {}
        self._titles: dict[str, str] = {}
        self._greys, self._scaled = _Range(), unit == "mm"
        self._stream = open_stream(where, "--view")
        self._stream.send_blueprint(_blueprint({}, self._scaled))

    def show(self, update: Update, status: Status) -> None:
        """Show the current state.

        Parameters
        ----------
        update : Update
            Maps that it lacks remain as they were.
        status : Status
        """
        rr, log = load_rerun(), self._stream.log
        self._arrange(update)
        self._stream.set_time("frame", sequence=update.frames)
        if np.isfinite(update.time):
            self._stream.set_time("time", duration=update.time)
        log("camera", rr.Image(self._greys.grey(update.picture)))
        for name in shown_maps(update.maps):
            log(f"maps/{name}", rr.Image(self._colours(update.maps, name)))
        if update.height is not None:
            log("section/surface", rr.LineStrips2D(section(update.height, self._x)))
        for name, value in update.maps.numbers().items():
            log(f"numbers/{name}", rr.Scalars(value))
        log("status", rr.TextDocument(self._status_text(update, status), media_type="text/markdown"))

    def _arrange(self, update: Update) -> None:
        """Add a view for each map that was not shown before."""
        titles = {name: update.maps.declaration(name).title_of(name) for name in shown_maps(update.maps)}
        if titles.keys() - self._titles.keys():
            self._titles |= titles
            self._stream.send_blueprint(_blueprint(self._titles, self._scaled))

    def _colours(self, maps: Result, name: str) -> Colours:
        """Return the colours of a map, as its declaration determines them."""
        declared = maps.declaration(name)
        if declared.sampling == "direction":
            return normal_colours(maps[name], maps.edges)
        values = displayed_values(sheet_of(maps), name)
        if declared.components:
            values = np.sqrt(np.sum(values**2, axis=-1))
        return self._ranges.setdefault(name, _Range()).colour(values)

    def close(self) -> None:
        """Wait for the last pictures to arrive, and disconnect from the viewer, which stays open."""
        close_stream(self._stream, _END)

    def _status_text(self, update: Update, status: Status) -> str:
        """Return the current state as text."""
        lines = [
            f"**{status.rate:.1f} frames/s**, {status.used} used, {status.skipped} skipped,"
            f" {status.dropped} dropped, {status.updates} updates"
        ]
        if (shown := status.latency.get(SHOWN)) is not None:
            lines.append(
                f"from frame to map {1e3 * shown.median:.1f} ms, 99 % below {1e3 * shown.p99:.1f} ms"
            )
        unknown, height = update.offset_unknown, update.maps.name_of("height")
        for name in shown_maps(update.maps):
            if name in self._ranges:
                declared = update.maps.declaration(name)
                ends, unit = numbers_with_unit(self._ranges[name].ends, declared.figure_unit)
                about = ", each piece about its mean" if name == height and np.any(unknown) else ""
                low, high = f"{ends[0]} (violet)", f"{ends[1]} {unit}".rstrip()
                lines.append(f"{declared.title_of(name)} from {low} to {high} (yellow){about}")
        for name, value in update.maps.numbers().items():
            declared = update.maps.declaration(name)
            lines.append(f"{declared.title_of(name)} {in_figure_unit(value, declared)}")
        return "\n\n".join(lines)


def shown_maps(maps: Result) -> list[str]:
    """Return the names of the maps that are shown: without standard deviations and minor ones.

    Edges are drawn over normals.
    """
    declarations = {name: maps.declaration(name) for name in display_order(maps) if not is_deviation(name)}
    return [
        name
        for name, declaration in declarations.items()
        if declaration.overview and not declaration.included_in and name != "edges"
    ]


def section(height: NDArray[np.float32], x: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Return the cross-section along the middle row, one line for each piece without a gap."""
    row = height[height.shape[0] // 2].astype(np.float64)
    columns = np.flatnonzero(np.isfinite(row))
    pieces = np.split(columns, np.flatnonzero(np.diff(columns) > 1) + 1)
    return [np.stack([x[piece], -row[piece]], axis=1) for piece in pieces if len(piece) > 1]


class _Range:
    """The lowest and the highest value so far, so that colours do not flicker."""

    def __init__(self) -> None:
        self.ends = (np.inf, -np.inf)

    def colour(self, values: NDArray[Any]) -> Colours:
        """Return colours from violet to yellow, (H, W, 3)."""
        self._widen(values)
        return height_colours(values, *self.ends)

    def grey(self, values: NDArray[Any]) -> Colours:
        """Return shades from black to white, (H, W)."""
        if values.dtype == np.uint8:
            return values
        self._widen(values)
        return grey(values, *self.ends)

    def _widen(self, values: NDArray[Any]) -> None:
        finite = values[np.isfinite(values)]
        if finite.size:
            self.ends = min(self.ends[0], float(finite.min())), max(self.ends[1], float(finite.max()))


def _blueprint(titles: Mapping[str, str], scaled: bool) -> Any:
    """Return the layout of the viewer, with a view for each map."""
    import rerun.blueprint as rrb

    across = "Middle row, mm, true to scale" if scaled else "Middle row, along pixels"
    return rrb.Blueprint(
        rrb.Grid(
            rrb.Spatial2DView(origin="camera", name="Camera"),
            *(rrb.Spatial2DView(origin=f"maps/{name}", name=title) for name, title in titles.items()),
            rrb.Spatial2DView(origin="section", name=across),
            rrb.TimeSeriesView(origin="numbers", name="Numbers"),
            rrb.TextDocumentView(origin="status", name="Status"),
            grid_columns=3,
        ),
        rrb.TimePanel(state="collapsed", timeline="frame", play_state="following"),
        auto_views=False,
        collapse_panels=True,
    )
