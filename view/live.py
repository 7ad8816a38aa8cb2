"""Live view of a measurement in rerun."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.live.status import SHOWN, Status, Update
from mirrorskin.io import pixel_axes
from mirrorskin.io.units import numbers_with_unit
from mirrorskin.view.colours import Colours, grey, height_colours, normal_colours
from mirrorskin.view.viewer import close_stream, load_rerun, open_stream

_END = 2.0  # seconds to wait until the last pictures have reached the viewer


class LiveView:
    """The camera's picture, heights, normals, a cross-section and the area of contact, updated live.

    Parameters
    ----------
    "window", "browser", or the name of a file; see ``open_stream``.
        "window", "browser", or a file to write; see ``open_stream``.
    shape : (int, int)
        Rows and columns of the picture.
    Millimetres along x and y; without it, the cross-section is in pixels.
        Millimetres along x and y; without it, the cross-section is along pixels.

    Raises
    ------
    mirrorskin.io.InputError
        rerun is not installed or does not start, or the file cannot be written.
    """

    def __init__(
        self, where: str | Path, shape: tuple[int, int], pixel_size: tuple[float, float] | None = None
    ) -> None:
        self._x, _ = pixel_axes(shape, pixel_size or (1.0, 1.0))
        self._heights, self._lengths, self._slopes = _Range(), _Range(), _Range()
        self._greys = _Range()
        self._stream = open_stream(where, "--view")
        self._stream.send_blueprint(_blueprint(pixel_size is not None))

    def show(self, update: Update, status: Status) -> None:
        """Show the current state.

        Parameters
        ----------
        update : Update
            Maps that are None remain as they were.
        status : Status
        """
        rr, log = load_rerun(), self._stream.log
        self._stream.set_time("frame", sequence=update.frames)
        if np.isfinite(update.time):
            self._stream.set_time("time", duration=update.time)
        log("camera", rr.Image(self._greys.grey(update.picture)))
        if update.height is not None:
            log("height", rr.Image(self._heights.colour(update.height)))
            log("section/surface", rr.LineStrips2D(section(update.height, self._x)))
        if update.normals is not None:
            log("normals", rr.Image(normal_colours(update.normals, update.edges)))
        if update.displacement is not None:
            length = np.sqrt(np.sum(update.displacement**2, axis=-1))
            log("displacement", rr.Image(self._lengths.colour(length)))
        if update.slope is not None:
            log("slope", rr.Image(self._slopes.colour(update.slope)))
        if update.contact_area is not None:
            log("contact/area", rr.Scalars(update.contact_area))
        log("status", rr.TextDocument(self._status_text(update, status), media_type="text/markdown"))

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
        if update.height is not None:
            ends, unit = numbers_with_unit(self._heights.ends, "mm")
            kind = ", each piece about its mean" if update.offset_unknown else ""
            lines.append(f"heights from {ends[0]} (violet) to {ends[1]} {unit} (yellow){kind}")
        if update.displacement is not None:
            low, high = (1e3 * end for end in self._lengths.ends)
            lines.append(f"displacement from {low:.1f} (violet) to {high:.1f} µm (yellow)")
        if update.slope is not None:
            low, high = self._slopes.ends
            lines.append(f"slope from {low:.3f} (violet) to {high:.3f} (yellow)")
        if update.contact_area is not None:
            lines.append(f"contact {update.contact_area:.2f} mm²")
        return "\n\n".join(lines)


def section(height: NDArray[np.float32], x: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Return the cross-section along the middle row, one line for each piece without a gap."""
    row = height[height.shape[0] // 2].astype(np.float64)
    known = np.flatnonzero(np.isfinite(row))
    pieces = np.split(known, np.flatnonzero(np.diff(known) > 1) + 1)
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
        known = values[np.isfinite(values)]
        if known.size:
            self.ends = min(self.ends[0], float(known.min())), max(self.ends[1], float(known.max()))


def _blueprint(scaled: bool) -> Any:
    """Return the layout of the viewer."""
    import rerun.blueprint as rrb

    across = "Middle row, mm, true to scale" if scaled else "Middle row"
    return rrb.Blueprint(
        rrb.Grid(
            rrb.Spatial2DView(origin="camera", name="Camera"),
            rrb.Spatial2DView(origin="height", name="Height"),
            rrb.Spatial2DView(origin="normals", name="Normals"),
            rrb.Spatial2DView(origin="displacement", name="Displacement of the skin"),
            rrb.Spatial2DView(origin="slope", name="Slope"),
            rrb.Spatial2DView(origin="section", name=across),
            rrb.TimeSeriesView(origin="contact", name="Contact, mm²"),
            rrb.TextDocumentView(origin="status", name="Status"),
            grid_columns=3,
        ),
        rrb.TimePanel(state="collapsed", timeline="frame", play_state="following"),
        auto_views=False,
        collapse_panels=True,
    )
