"""Normals of the last turn of an endless rotation, with edges and heights that follow at lower rates."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.base.options import option
from mirrorskin.engine.correlation.design_matrix import LONGEST
from mirrorskin.engine.rotation.coarse_height import coarse_heights
from mirrorskin.engine.rotation.edges import EdgeDrawing
from mirrorskin.engine.rotation.following_heights import FollowingHeights
from mirrorskin.engine.rotation.normals import Normals
from mirrorskin.engine.rotation.normals_window import NormalWindow
from mirrorskin.io import InputError, Map, Result
from mirrorskin.kernels.device import Device

if TYPE_CHECKING:
    from mirrorskin.io import Source

_UPDATES_BETWEEN_PLACINGS = 8  # updates between estimates of the object's height in the body
_MIN_FRAMES = 3  # minimum number of frames of a fit
_WARMING = 10  # number of updates that run all kernels
_PARTS = 12  # number of parts of the longest kernel of the edges
_INTERVAL = 0.5  # least seconds between the starts of drawings of edges
_PAUSE = 10.0  # the same, in durations of a drawing: on a slow device edges take a tenth of the time
_OVERDUE = 0.1  # seconds without a part after which one is run without idle time
_FIRST_COST = 0.005  # seconds: assumed duration of the first part
_LAG = {"height_lag": Map("number of updates since the frames of the heights", dtype="int64", axes="none")}
_DECAY = 0.7  # decay of the expected duration of a part, per part


def choose_window(frames_per_turn: float, window_frames: int | None = None) -> tuple[int, int]:
    """Return the number of frames of a window of one turn, and n, if every n-th frame is used.

    Parameters
    ----------
    frames_per_turn : float
    window_frames : int, optional
        Number of frames of the window; by default all of a turn, up to 64.

    Raises
    ------
    mirrorskin.io.InputError
        A turn has fewer than three frames, or fewer than the window.
    """
    if not _MIN_FRAMES <= frames_per_turn < math.inf:
        raise InputError(f"{frames_per_turn:g} frames a turn: at least 3 are needed; turn more slowly")
    if window_frames is None:
        every = math.ceil(round(frames_per_turn) / LONGEST)
        return max(_MIN_FRAMES, round(frames_per_turn / every)), every
    if window_frames > round(frames_per_turn):
        count = round(frames_per_turn)
        raise InputError(f"window_frames {window_frames}: a turn has only {count} frames. Leave it out")
    return window_frames, max(1, round(frames_per_turn) // window_frames)  # within one turn


class LastTurn(Normals):
    """Normals of the last turn of an endless rotation; while the body moves, also its edges and heights.

    Heights follow the normals in a separate thread, by at most one solver step per update: normals do not
    wait for them, and their error is similar to the changes between updates. Edges are drawn in idle time.
    With a calibrated response, the height of the object in the body is estimated at intervals from the
    heights so far.
    """

    updates_per_second = math.inf

    pixel_size: tuple[float, float] | None = option(
        default=None, unit="mm", help="pixel size along x and y, mm, for heights", python_only=True
    )
    press: float | None = option(
        default=None,
        unit="mm",
        help="depth to which the body is lowered, for a calibrated response",
        python_only=True,
    )

    def configured_for(self, source: Source) -> Self:
        """Return the operation with the source's values of options that are not given."""
        press = source.header.press if self.press is None else self.press
        pixel_size = self.pixel_size or source.header.pixel_size
        return super().configured_for(source).with_options(pixel_size=pixel_size, press=press)

    def start(self, shape: tuple[int, int], dtype: np.dtype[Any]) -> None:
        """Prepare for frames of a shape and type."""
        if self.window_frames is None:
            raise InputError("window_frames is missing: give the number of frames of a turn")
        super().start(shape, dtype)
        self._edges = IdleEdges(self.device, shape)
        self._heights = None
        if self.pixel_size is not None:
            self._heights = FollowingHeights(self.device, shape, self.pixel_size)
        self._has_estimate, self._updates = False, 0

    def preview(self, seconds: float) -> Result:
        """Return the maps of the last turn; none before the first is complete. Waits for heights."""
        window, heights = self.window, self._heights
        if not window.is_full:
            return Result()
        window.estimate()
        started = time.perf_counter()
        (contact,) = window.maps.read("contact")
        self._has_estimate = True
        if heights is not None:
            heights.follow(window, contact)
        normals, sigma = window.maps.read("vectors", "sigma")  # heights are computed meanwhile
        if heights is not None:
            heights.wait(seconds - (time.perf_counter() - started))
        height = None if heights is None else heights.height
        self._updates += 1
        if height is not None and self._updates % _UPDATES_BETWEEN_PLACINGS == 1:
            self._place(height)
        raised: dict[str, Any] = {} if heights is None else {"height_lag": heights.lag}
        if height is not None:
            raised |= {"height": height, "offset_unknown": np.ones(1, np.uint8)}
        maps = {"normals": normals, "normals_sigma": sigma, "contact": contact, "edges": self._edges.lines}
        return Result(raised | maps, declarations=_LAG)

    def idle_work(self, seconds: float) -> None:
        """Continue to draw the edges, for some seconds at most."""
        if self._has_estimate:
            self._edges.work(self.window, seconds)

    def precompile(self) -> None:
        """Push frames of a slanted plane."""
        for number in range(self.window.length + _WARMING):
            phase = 2 * np.pi * number / self.window.length
            self.push(self._plane(phase), phase=[phase])
            if number >= self.window.length:
                self.preview(math.inf)
        self._edges.finish(self.window)

    def result(self) -> Result:
        """Return the maps of the last turn; with a response, after an estimate of the object's height."""
        result = super().result()
        response = self.response
        if response is not None and self.pixel_size is not None and self.press is not None:
            level = response.too_level(result["mean"])
            maps = result["normals"], result["contact"], level
            self.window.place(coarse_heights(*maps, self.pixel_size, self.press, self.device))
            result = super().result()
        wave = self.window.correlation()
        names = ("mean", "cosine", "sine", "modulation", "residual")
        return result.assign({name: wave[name] for name in names})

    def _place(self, height: NDArray[np.float32]) -> None:
        """Set the height of the object for a response: the top of each piece is at the depth of the press."""
        import cv2
        from scipy import ndimage

        response, press = self.response, self.press
        if response is None or press is None:
            return
        count, piece = cv2.connectedComponents(np.isfinite(height).view(np.uint8), connectivity=8)
        tops = np.append(0.0, ndimage.maximum(height, piece, np.arange(1, count)))
        heights = np.where(piece > 0, np.clip(press + height - tops[piece], 0, press), response.planes[4])
        self.window.place(heights)

    def _plane(self, phase: float) -> NDArray[Any]:
        """Return a frame of a plane whose zenith is in the middle of the visible range."""
        gain = None if self.zenith_gain is None else np.asarray(self.zenith_gain, np.float64)
        tilt = None if self.tilt is None or isinstance(self.tilt, str) else np.asarray(self.tilt, np.float64)
        amplitude = 1.0 if gain is None or tilt is None else gain * tilt
        offset = np.asarray(0.0 if self.zenith_offset is None else self.zenith_offset, np.float64)
        level = offset if self.zenith_offset is None else offset + (0.5 if gain is None else 0.5 * gain)
        ends = [np.asarray(end, np.float64) for end in (self.dark, self.bright) if end is not None]
        if len(ends) == 2:
            level = np.mean(np.stack(np.broadcast_arrays(*ends)), axis=0)
        greatest = np.iinfo(self.dtype).max if self.dtype.kind == "u" else np.inf
        frame = np.clip(level + amplitude * math.cos(phase), 0, greatest)
        return np.broadcast_to(np.nan_to_num(frame), (1, *self.shape)).astype(self.dtype)


class IdleEdges:
    """Edges that are drawn in idle time, up to twice a second and for a tenth of the time.

    ``lines``, (H, W), is None until the first drawing is complete.
    """

    def __init__(self, device: Device, shape: tuple[int, int]) -> None:
        self._device = device
        self._drawing = EdgeDrawing(device, shape)
        self.lines: NDArray[np.uint8] | None = None
        self._steps: Iterator[None] | None = None
        self._cost, self._last, self._start = _FIRST_COST, -math.inf, -math.inf
        self._spent = 0.0  # seconds that the drawing took so far

    def work(self, window: NormalWindow, seconds: float) -> None:
        """Continue to draw a window's last estimate for some seconds; overdue parts are drawn in any case."""
        started = now = time.perf_counter()
        while (self._steps is not None or now - self._start > max(_INTERVAL, _PAUSE * self._spent)) and (
            started + seconds - now > self._cost or now - self._last > _OVERDUE
        ):
            self._part(window)
            self._last = time.perf_counter()
            self._spent += self._last - now
            self._cost = max(self._last - now, _DECAY * self._cost)
            now = self._last

    def finish(self, window: NormalWindow) -> None:
        """Draw all edges."""
        self._steps = None
        self._part(window)
        while self._steps is not None:
            self._part(window)

    def _part(self, window: NormalWindow) -> None:
        """Start a drawing, continue it by one part, or fetch its lines."""
        if self._steps is None:
            self._drawing.take(*window.maps.read("vectors", "sigma", "contact"))
            self._steps, self._start, self._spent = self._drawing.steps(_PARTS), time.perf_counter(), 0.0
        elif next(self._steps, self) is self:
            self.lines, self._steps = self._drawing.lines(), None
        self._device.finish()
