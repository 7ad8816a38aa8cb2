"""Edges in the time that is left: drawn in small parts, of normals that were when it began."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.rotation.edges import EdgeDrawing
from mirrorskin.engine.rotation.normals_window import NormalWindow
from mirrorskin.kernels.device import Device

_PARTS = 24  # of the longest kernel
_HUNGRY = 0.1  # seconds after which a part is done whether or not there is time
_GUESS = 0.005  # seconds that a part may take, where none was done yet
_CALM = 0.7  # share of the longest part's time that is kept from part to part


class SpareEdges:
    """Edges of the last normals for which there was time.

    Parameters
    ----------
    device : Device
    shape : (int, int)
        Rows and columns.

    Attributes
    ----------
    lines : ndarray, (H, W), uint8, or None
        See ``find_edges``; None until the first are drawn.
    """

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
        """Go on with the drawing for as long as there is time, at least a little now and then.

        Parameters
        ----------
        window : NormalWindow
            Whose last estimate is drawn next.
        seconds : float
        """
        begun = now = time.perf_counter()
        while begun + seconds - now > self._cost or now - self._last > _HUNGRY:
            self._part(window)
            self._last = time.perf_counter()
            self._cost = max(self._last - now, _CALM * self._cost)
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
