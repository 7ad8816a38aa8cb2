"""Pictures while the body still moves, in rerun: on this machine alone, or into a file."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.live.types import SHOWN, Status, Update
from mirrorskin.io import InputError, check_output, pixel_axes

WINDOW, BROWSER = "window", "browser"
"""Where pictures can be shown, besides a file."""

Colours = NDArray[np.uint8]

_HERE = "127.0.0.1"
_START = 20.0  # seconds for the viewer to listen
_END = 2.0  # seconds for the last pictures to reach it
_MISSING = (176, 196, 222)  # red, green and blue of what has no answer: as in figures
_EDGE = (0, 0, 0)
_MEMORY = "1GB"  # of pictures that the viewer keeps, the newest ones
_VIEWERS: list[subprocess.Popen[bytes]] = []  # they outlive their views


class LiveView:
    """The camera's picture, heights, normals, a cross-section and the area of contact, as they come.

    Parameters
    ----------
    where : str or Path
        "window" starts rerun's own viewer, "browser" one in a browser; both are reached from this machine
        only. Anything else is a file to write, which ``rerun FILE`` shows.
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
        rr = _rerun()
        self._x, _ = pixel_axes(shape, pixel_size or (1.0, 1.0))
        self._heights = _Range()
        self._greys = _Range()
        self._stream = rr.RecordingStream("mirrorskin", send_properties=False)
        if str(where) in (WINDOW, BROWSER):
            self._connect(str(where))
        else:
            check_output(Path(where))
            self._stream.save(where)
        self._stream.send_blueprint(_blueprint(pixel_size is not None))

    def show(self, update: Update, status: Status) -> None:
        """Show what is known now.

        Parameters
        ----------
        update : Update
            Maps that are not known are left as they were.
        status : Status
        """
        rr, log = _rerun(), self._stream.log
        self._stream.set_time("frame", sequence=update.frames)
        if np.isfinite(update.time):
            self._stream.set_time("time", duration=update.time)
        log("camera", rr.Image(self._greys.grey(update.picture)))
        if update.height is not None:
            log("height", rr.Image(self._heights.colour(update.height)))
            log("section/surface", rr.LineStrips2D(section(update.height, self._x)))
        if update.normals is not None:
            log("normals", rr.Image(normal_colours(update.normals, update.edges)))
        if update.contact_area is not None:
            log("contact/area", rr.Scalars(update.contact_area))
        log("status", rr.TextDocument(self._told(update, status), media_type="text/markdown"))

    def close(self) -> None:
        """Let the last pictures arrive, and let go of the viewer, which stays open."""
        with suppress(RuntimeError, ValueError):  # the viewer was closed
            self._stream.flush(timeout_sec=_END)
        with suppress(RuntimeError, ValueError):
            self._stream.disconnect()

    def _connect(self, where: str) -> None:
        """Start a viewer, and wait until it listens."""
        port = _free_port()
        words = [sys.executable, "-m", "rerun", "--bind", _HERE, "--port", str(port)]
        words += ["--server-memory-limit", _MEMORY, "--memory-limit", _MEMORY]
        if where == BROWSER:
            words += ["--web-viewer", "--web-viewer-port", str(_free_port())]
        quiet = subprocess.DEVNULL
        # In a session of its own, for Ctrl-C ends the run and leaves its pictures there.
        viewer = subprocess.Popen(words, stdin=quiet, stdout=quiet, stderr=quiet, start_new_session=True)
        _VIEWERS.append(viewer)
        deadline = time.monotonic() + _START
        while not _listens(port):
            if viewer.poll() is not None or time.monotonic() > deadline:
                viewer.kill()
                viewer.wait()
                remedy = f"take --view {BROWSER}, or --view FILE.rrd" if where == WINDOW else "see 'rerun'"
                raise InputError(f"rerun's viewer does not start here: {remedy}")
            time.sleep(0.05)
        self._stream.connect_grpc(f"rerun+http://{_HERE}:{port}/proxy")

    def _told(self, update: Update, status: Status) -> str:
        """Return the state of things as a text."""
        lines = [
            f"**{status.rate:.1f} frames/s**, {status.used} used, {status.skipped} skipped,"
            f" {status.dropped} dropped, {status.updates} updates"
        ]
        if (shown := status.latency.get(SHOWN)) is not None:
            lines.append(
                f"from frame to map {1e3 * shown.median:.1f} ms, 99 % below {1e3 * shown.p99:.1f} ms"
            )
        if update.height is not None:
            low, high = self._heights.ends
            kind = ", each piece about its mean" if update.offset_unknown else ""
            lines.append(f"heights from {low:.3f} (violet) to {high:.3f} mm (yellow){kind}")
        if update.contact_area is not None:
            lines.append(f"contact {update.contact_area:.2f} mm²")
        return "\n\n".join(lines)


def section(height: NDArray[np.float32], x: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Return the cross-section along the middle row, one line for each piece without a gap.

    Parameters
    ----------
    height : ndarray, (H, W), float32
        Millimetres.
    x : ndarray, (W,), float64
        Millimetres.

    Returns
    -------
    list of ndarray, (n, 2), float64
        x and, as pictures run down, minus the height.
    """
    row = height[height.shape[0] // 2].astype(np.float64)
    known = np.flatnonzero(np.isfinite(row))
    pieces = np.split(known, np.flatnonzero(np.diff(known) > 1) + 1)
    return [np.stack([x[piece], -row[piece]], axis=1) for piece in pieces if len(piece) > 1]


def normal_colours(normals: NDArray[np.float32], edges: NDArray[np.uint8] | None = None) -> Colours:
    """Return the customary colours: red, green and blue for x, y and z from -1 to 1; edges are black.

    Parameters
    ----------
    normals : ndarray, (H, W, 3), float32
    edges : ndarray, (H, W), uint8, optional

    Returns
    -------
    ndarray, (H, W, 3), uint8
    """
    colours: Colours = ((np.nan_to_num(normals) + 1) * 127.5).astype(np.uint8)
    colours[np.isnan(normals[..., 2])] = _MISSING
    if edges is not None:
        colours[edges > 0] = _EDGE
    return colours


class _Range:
    """The lowest and the highest value so far, so that colours do not flicker."""

    def __init__(self) -> None:
        self.ends = (np.inf, -np.inf)

    def colour(self, values: NDArray[Any]) -> Colours:
        """Return colours from violet to yellow, (H, W, 3)."""
        colours = cv2.cvtColor(cv2.applyColorMap(self.grey(values), cv2.COLORMAP_VIRIDIS), cv2.COLOR_BGR2RGB)
        colours[np.isnan(values)] = _MISSING
        return np.asarray(colours)

    def grey(self, values: NDArray[Any]) -> Colours:
        """Return shades from black to white, (H, W)."""
        if values.dtype == np.uint8:
            return values
        known = values[np.isfinite(values)]
        if known.size:
            self.ends = min(self.ends[0], float(known.min())), max(self.ends[1], float(known.max()))
        low, high = self.ends
        span = high - low if high > low else 1.0
        return np.asarray(np.nan_to_num((values - low) * (255 / span)).clip(0, 255), np.uint8)


def _blueprint(scaled: bool) -> Any:
    """Return where everything stands."""
    import rerun.blueprint as rrb

    across = "Middle row, mm, true to scale" if scaled else "Middle row"
    return rrb.Blueprint(
        rrb.Grid(
            rrb.Spatial2DView(origin="camera", name="Camera"),
            rrb.Spatial2DView(origin="height", name="Height"),
            rrb.Spatial2DView(origin="normals", name="Normals"),
            rrb.Spatial2DView(origin="section", name=across),
            rrb.TimeSeriesView(origin="contact", name="Contact, mm²"),
            rrb.TextDocumentView(origin="status", name="Status"),
            grid_columns=3,
        ),
        rrb.TimePanel(state="collapsed", timeline="frame", play_state="following"),
        auto_views=False,
        collapse_panels=True,
    )


def _rerun() -> Any:
    if find_spec("rerun") is None:
        raise InputError("live pictures need rerun: pip install 'mirrorskin[live]'")
    import rerun

    return rerun


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((_HERE, 0))
        return int(probe.getsockname()[1])


def _listens(port: int) -> bool:
    with suppress(OSError), socket.create_connection((_HERE, port), timeout=0.2):
        return True
    return False
