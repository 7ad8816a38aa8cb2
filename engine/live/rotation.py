"""A rotation in progress: normals of the last turn, edges, and heights that follow."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.live.heights import HeightFollower
from mirrorskin.engine.live.press import area_of
from mirrorskin.engine.live.status import Maps
from mirrorskin.engine.provenance import attach_provenance, level_origin, naming, parameter_origin
from mirrorskin.engine.reconstruction import undistorted
from mirrorskin.engine.rotation.coarse_height import coarse_heights
from mirrorskin.engine.rotation.correlation import Correlation, Correlator
from mirrorskin.engine.rotation.design_matrix import LONGEST
from mirrorskin.engine.rotation.edges import EdgeDrawing, find_edges
from mirrorskin.engine.rotation.normals import Normals
from mirrorskin.engine.rotation.normals_kernel import NormalMethod, options_from
from mirrorskin.engine.rotation.normals_to_height import integrate_normals
from mirrorskin.engine.rotation.normals_window import NormalWindow
from mirrorskin.engine.rotation.response import initial_response, wall_response_of
from mirrorskin.engine.rotation.rotation import Rotation, rotation_maps
from mirrorskin.engine.thread_safe import ThreadSafe
from mirrorskin.io import InputError, LiveSource, Result
from mirrorskin.io.types import ProcessValue
from mirrorskin.kernels.device import Device

_FEWEST = 3  # frames that determine a wave
_PLACED = 8  # updates after which it is estimated anew how high the object stands
_WARMING = 10  # updates after which every kernel has run
_PARTS = 24  # of the longest kernel
_OVERDUE = 0.1  # seconds after which a part is done whether or not there is time
_GUESS = 0.005  # seconds that a part may take, where none was done yet
_DECAY = 0.7  # of the longest part's time, from part to part
_NO_GAIN = "none: the source has no zenith gain"
_NO_PIXEL_SIZE = "none: the source has no pixel size"


def choose_window(frames_a_turn: float, window: int | None = None) -> tuple[int, int]:
    """Return how many frames a window of one turn should have, and n, where every n-th frame is used.

    Parameters
    ----------
    frames_a_turn : float
    window : int, optional
        Frames of the window; by default as many as there are, up to 64.

    Raises
    ------
    mirrorskin.io.InputError
        A turn has fewer than three, which determine no wave, or fewer than the window.
    """
    if not _FEWEST <= frames_a_turn < math.inf:
        raise InputError(f"{frames_a_turn:g} frames a turn: at least 3 are needed; turn more slowly")
    if window is None:
        every = math.ceil(round(frames_a_turn) / LONGEST)
        return max(_FEWEST, round(frames_a_turn / every)), every
    if window > round(frames_a_turn):
        raise InputError(f"--window {window}: a turn has {round(frames_a_turn)} frames only: leave it out")
    return window, max(1, round(frames_a_turn) // window)  # within one turn


class LiveRotation(ThreadSafe):
    """Normals, edges and heights of the last frames; see `mirrorskin.engine.live.LiveEstimator`.

    Where the source's calibration says how bright a wall makes pixels look, that is used; how high the object
    stands is then estimated from the heights so far, now and then.

    Heights follow the normals in a thread of their own, by one step of a solver for each update for which
    there is time: their error stays near what changes from one to the next, and normals wait for none.
    Edges are drawn in the time that is left. Without a zenith gain there are correlations only, and without
    a pixel size no heights.

    Parameters
    ----------
    source : LiveSource
        Of axial motion; its header's tilt, zenith gain and references are used.
    window : int
        Frames that count, 3 to 64: best those of one turn; see `choose_window`.
    every : int
        Only frames whose number is a multiple of this are taken.
    method, noise, device
        As for ``estimate_normals``. Noise is estimated from the first full window otherwise.
    integrate, edges : bool
        Whether to find heights and edges.

    Raises
    ------
    mirrorskin.io.InputError
        The source is of another motion, or parameters cannot be used.
    """

    every: int

    position = "phase"
    most_updates: float = math.inf

    def __init__(
        self,
        source: LiveSource,
        *,
        window: int,
        every: int = 1,
        method: NormalMethod = "exact",
        noise: float | None = None,
        integrate: bool = True,
        edges: bool = True,
        device: str | Device | None = None,
    ) -> None:
        if source.motion != "axial":
            raise InputError(f"{source.name} is of {source.motion} motion: normals take an axial rotation")
        if every < 1:
            raise InputError(f"every {every}: a number of frames from 1 on is needed")
        self._source, self.every, self._size = source, every, window
        header, shape = source.header, source.shape[1:]
        self._method, self._header = method, header
        wall = wall_response_of(source)
        self._response = None if wall is None else initial_response(wall, source, header)
        known = header.zenith_gain is not None or wall is not None
        self._window: NormalWindow | Correlator
        if known:
            options = options_from(header, method, noise, self._response, device)
            self._window = NormalWindow(shape, source.dtype, window=window, **options)
        else:
            self._window = Correlator(shape, source.dtype, window=window, device=device)
        self._normals = self._window if isinstance(self._window, NormalWindow) else None
        self.device: Device = self._window.device
        self._edges = SpareEdges(self.device, shape) if edges and known else None
        self._heights = None
        if integrate and known and header.pixel_size is not None:
            self._heights = HeightFollower(self.device, shape, header.pixel_size)
        self.reset()

    @property
    def room(self) -> NDArray[Any]:
        """Where a source may write the next frames, (n, H, W)."""
        return self._window.room

    def warm(self) -> None:
        """Rotate a slanted plane for a while, and forget it."""
        with suppress(InputError):  # such as noise or tilt, which a plane does not determine
            for number in range(self._size + _WARMING):
                phase = 2 * np.pi * number / self._size
                self.push(self._plane(phase), phase=np.array([phase]))
                if number >= self._size:
                    self.maps()
            if self._edges is not None and self._normals is not None:
                self._edges.finish(self._normals)
        self.reset()

    def push(self, frames: NDArray[Any], *, phase: ArrayLike, lent: bool = False) -> None:
        """Take in the next frames; see `mirrorskin.engine.streaming.Estimator`."""
        with naming(self._source):
            self._window.push(frames, phase=phase, lent=lent)

    def maps(self, seconds: float = math.inf, /) -> Maps:
        """Return the maps of the last window; none until one is full. Its heights may take so long."""
        normals = self._normals
        if normals is None or not normals.is_full:
            return {}
        with naming(self._source):
            normals.estimate()
        begun, heights = time.perf_counter(), self._heights
        if heights is not None:
            heights.follow(normals)
        self._has_estimate = True
        vectors, contact = (normals.fetch_early(name) for name in ("vectors", "contact"))
        if heights is not None:
            heights.wait(seconds - (time.perf_counter() - begun))
        height = None if heights is None else heights.height
        self._updates += 1
        if height is not None and self._updates % _PLACED == 1:
            self._place(height)
        return {
            "height": height,
            "height_lag": 0 if heights is None else heights.lag,
            "normals": vectors,
            "contact": contact,
            "edges": None if self._edges is None else self._edges.lines,
            "contact_area": area_of(contact, self._source),
            "offset_unknown": height is not None,
        }

    def spare(self, seconds: float) -> None:
        """Go on with the edges."""
        if self._edges is not None and self._normals is not None and self._has_estimate:
            self._edges.work(self._normals, seconds)

    def normals(self) -> Normals:
        """Return the normals of the last window; see ``NormalWindow.result``."""
        if self._normals is None:
            raise InputError(f"{self._source.name} has no zenith gain, so no normals")
        with naming(self._source):
            return self._normals.result()

    def correlation(self) -> Correlation:
        """Return the fit of the frames in the last window; see ``Correlator.result``."""
        with naming(self._source):
            if isinstance(self._window, NormalWindow):
                return self._window.correlation()
            return self._window.result()

    def result(self) -> Result:
        """Return the maps of the last window, heights as near to their normals as ``integrate`` brings them.

        Raises
        ------
        mirrorskin.io.InputError
            The window is not full.
        """
        wave = self.correlation()
        maps: dict[str, Any] = {
            name: getattr(wave, name) for name in ("mean", "cosine", "sine", "modulation", "residual")
        }
        process: dict[str, ProcessValue] = {"live": True, "window": self._size, "every": self.every}
        if self._normals is None:
            process |= {"method": "correlation", "frames": wave.frames, "zenith": _NO_GAIN}
            return self._signed(Result(azimuth=wave.azimuth, **maps), process)
        normals = self._normals_in_place()
        edges = find_edges(normals.vectors, normals.sigma, normals.contact, device=self.device)
        systematic = None if self._response is None else self._response.sigma
        result = rotation_maps(Rotation(normals, normals.sigma, edges, self.device, {}, systematic))
        process |= self._provenance(normals)
        if self._header.pixel_size is None:
            process["height"] = _NO_PIXEL_SIZE
            return self._signed(result.assign(**maps), process)
        with naming(self._source):
            relief = integrate_normals(normals, normals.sigma, self._header.pixel_size, device=self.device)
        maps |= {"height": relief.height, "height_sigma": relief.height_sigma, "component": relief.component}
        maps["offset_unknown"] = relief.offset_unknown
        return self._signed(result.assign(**maps), {**process, **relief.process})

    def _signed(self, result: Result, process: dict[str, ProcessValue]) -> Result:
        return undistorted(attach_provenance(result, self._source, self.device, process), self._source)

    def _place(self, height: NDArray[np.float32]) -> None:
        """Set where the object is, if that matters: its pieces' tops are as high as the press is deep."""
        from scipy import ndimage

        response, normals, press = self._response, self._normals, self._header.press
        if response is None or normals is None or press is None:
            return
        piece, count = ndimage.label(np.isfinite(height), np.ones((3, 3)))
        tops = np.concatenate([[0.0], ndimage.maximum(height, piece, np.arange(1, count + 1))])
        normals.place(
            np.where(piece > 0, np.clip(press + height - tops[piece], 0, press), response.planes[4])
        )

    def _normals_in_place(self) -> Normals:
        """Return the normals of the last window, with the object placed by a first estimate of them."""
        normals, response, header = self.normals(), self._response, self._header
        if response is None or header.pixel_size is None or header.press is None:
            return normals
        assert self._normals is not None
        maps = normals.vectors, normals.contact, response.too_level(normals.mean)
        self._normals.place(coarse_heights(*maps, header.pixel_size, header.press, self.device))
        return self.normals()

    def _plane(self, phase: float) -> NDArray[Any]:
        """Return a frame of a plane whose zenith lies in the middle of what can be seen."""
        header, (rows, columns), dtype = self._header, self._source.shape[1:], self._source.dtype
        gain, offset = header.zenith_gain, header.zenith_offset
        swing = 1.0 if gain is None or header.tilt is None else gain * header.tilt
        known = [0.0 if offset is None else offset + (0.5 if gain is None else 0.5 * gain)]
        ends = [one for one in (header.dark, header.bright) if one is not None]
        level = np.mean(np.stack(np.broadcast_arrays(*ends)), axis=0) if len(ends) == 2 else known[0]
        most = np.iinfo(dtype).max if dtype.kind == "u" else np.inf
        frame = np.clip(level + swing * math.cos(phase), 0, most)
        return np.broadcast_to(np.nan_to_num(frame), (1, rows, columns)).astype(dtype)

    def _provenance(self, normals: Normals) -> dict[str, ProcessValue]:
        """Return what the normals were made with, for the process."""
        header = self._header
        scale: dict[str, ProcessValue] = {
            "zenith_gain": parameter_origin(None, header.zenith_gain, "none"),
            "zenith_offset": parameter_origin(None, header.zenith_offset, "0"),
            "low": level_origin(self._source, "dark"),
            "high": level_origin(self._source, "bright"),
        }
        if self._response is not None:
            scale = {"zenith": "calibrated"}
        return {
            "method": self._method,
            "tilt": normals.tilt,
            "tilt_from": "estimate" if header.tilt is None else "recording",
            **scale,
            "noise": normals.noise,
            "shot_noise": normals.shot,
            "turns": normals.turns,
            "frames": normals.frames,
        }

    def reset(self) -> None:
        """Forget the frames so far."""
        self._window.reset()
        self._has_estimate, self._updates = False, 0
        if self._response is not None and self._normals is not None:
            self._normals.place(self._response.planes[4])
        if self._edges is not None:
            self._edges.reset()
        if self._heights is not None:
            self._heights.reset()


class SpareEdges:
    """Edges of the last normals for which there was time: ``lines``, (H, W), None until they are drawn."""

    def __init__(self, device: Device, shape: tuple[int, int]) -> None:
        self._device = device
        self._drawing = EdgeDrawing(device, shape)
        self.reset()

    def reset(self) -> None:
        """Forget what was drawn."""
        self.lines: NDArray[np.uint8] | None = None
        self._steps: Iterator[None] | None = None
        self._cost, self._last = _GUESS, -math.inf

    def work(self, window: NormalWindow, seconds: float) -> None:
        """Go on drawing a window's last estimate for some seconds, a little now and then anyway."""
        begun = now = time.perf_counter()
        while begun + seconds - now > self._cost or now - self._last > _OVERDUE:
            self._part(window)
            self._last = time.perf_counter()
            self._cost = max(self._last - now, _DECAY * self._cost)
            now = self._last

    def finish(self, window: NormalWindow) -> None:
        """Draw once from the beginning to the end."""
        self._steps = None
        self._part(window)
        while self._steps is not None:
            self._part(window)

    def _part(self, window: NormalWindow) -> None:
        """Begin a drawing, or do a part of it, or take what was drawn."""
        if self._steps is None:
            self._drawing.take(*(window.fetch(name) for name in ("vectors", "sigma", "contact")))
            self._steps = self._drawing.steps(_PARTS)
        elif next(self._steps, self) is self:
            self.lines, self._steps = self._drawing.lines(), None
        self._device.finish()
