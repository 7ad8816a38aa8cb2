"""The half that cameras share: frames wait in a ring, are counted, and are taken."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mirrorskin.hw.camera import Counts, Frames, Tally
from mirrorskin.hw.errors import HardwareError
from mirrorskin.hw.ring import Ring, usual_slots
from mirrorskin.io.types import Closing


class ThreadedCamera(Closing):
    """A ``mirrorskin.hw.camera.Camera`` but for the thread that brings the frames, and ``close``.

    That thread fills ``_slot()`` and calls ``_put``, again and again, and ``_fail`` when it gives up.

    Parameters
    ----------
    name : str
        What messages call it.
    shape : (int, int)
        Rows and columns.
    dtype : dtype
        uint8, uint16 or float32.
    rate : float, optional
        Frames a second, if it is known.
    slots : int, optional
        Frames that may wait; see ``mirrorskin.hw.ring.usual_slots``.
    """

    def __init__(
        self,
        name: str,
        shape: tuple[int, int],
        dtype: DTypeLike,
        rate: float | None = None,
        slots: int | None = None,
    ) -> None:
        self.name = name
        self.shape, self.dtype = shape, np.dtype(dtype)
        slots = usual_slots(shape, dtype, rate) if slots is None else slots
        self._ring = Ring(shape, dtype, slots, name)
        self._tally = Tally()
        self._number = 0
        self._reconnects = 0

    @property
    def counts(self) -> Counts:
        """What it did so far."""
        return self._tally.counts(self._ring.dropped, self._reconnects)

    @property
    def latest(self) -> float:
        """When the newest frame arrived, monotonic seconds; -inf before the first."""
        return self._tally.latest

    @property
    def error(self) -> HardwareError | None:
        """Why no more frames will come; None while they may."""
        return self._ring.error

    def take(self, most: int, timeout: float) -> Frames:
        """Take the oldest frames that wait, or wait for one; see ``Camera.take``."""
        return self._ring.take(most, timeout)

    def flush(self) -> None:
        """Forget the frames that wait; they do not count as dropped."""
        self._ring.flush()

    def _slot(self) -> NDArray[Any]:
        """Return the place for the next frame, (H, W); see ``Ring.slot``."""
        return self._ring.slot()

    def _put(self, time: float, lost: int = 0) -> None:
        """Let readers have what is in the slot, which arrived at a time, after so many lost frames."""
        self._tally.add(time)
        self._ring.put(time, self._number + lost, lost)
        self._number += lost + 1

    def _fail(self, message: str) -> None:
        """Tell readers that no more frames will come, and why."""
        self._ring.fail(HardwareError(message))
