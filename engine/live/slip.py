"""A slide or a twist in progress: how far the skin has moved so far; where it slips is told at the end."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.live.status import Maps
from mirrorskin.engine.reconstruction import undistorted
from mirrorskin.engine.slip.displacement import STEP
from mirrorskin.engine.slip.search import WINDOW
from mirrorskin.engine.slip.slip import slip_result, slip_search
from mirrorskin.engine.thread_safe import ThreadSafe
from mirrorskin.io import LiveSource, Result
from mirrorskin.kernels.device import Device

_ROOM = 16  # frames that may wait to be taken at once
_UPDATES = 15.0  # a second, as many as people follow


class LiveSlip(ThreadSafe):
    """Displacement of the skin so far, by `SlipSearch`; see `mirrorskin.engine.live.LiveEstimator`.

    Slip is fitted to all frames together, when the result is asked for.

    Parameters
    ----------
    source : LiveSource
        Of horizontal motion or a twist, with a pixel size.
    contact : Result, path or array_like, (H, W), optional
        Where the skin touches the object in the first frame; see ``reconstruct_slip``.
    window, step, noise, device
        As for `mirrorskin.engine.find_displacement`.

    Raises
    ------
    mirrorskin.io.InputError
        The source is of another motion, or parameters cannot be used.
    """

    position: str
    device: Device

    every = 1
    most_updates = _UPDATES

    def __init__(
        self,
        source: LiveSource,
        *,
        contact: Result | str | Path | ArrayLike | None = None,
        window: int = WINDOW,
        step: int = STEP,
        noise: float | None = None,
        device: str | Device | None = None,
    ) -> None:
        self._source = source
        self._search, self._contact = slip_search(
            source,
            contact=contact,
            per_frame=False,
            window=window,
            step=step,
            noise=noise,
            memory_limit=2 * _ROOM * math.prod(source.shape[1:]) * source.dtype.itemsize,
            device=device,
        )
        self.position, self.device = self._search.position, self._search.device
        self.room: NDArray[Any] = self._search.room

    def warm(self) -> None:
        """Push a few frames of a texture, and forget them."""
        shape, dtype = self._source.shape[1:], self._source.dtype
        texture = np.random.default_rng(0).uniform(0, 200, shape).astype(dtype)
        for _ in range(3):
            self.push(texture[np.newaxis], displacement=np.zeros((1, 2)), twist=np.zeros(1))
            self.maps()
        self.reset()

    def push(
        self,
        frames: NDArray[Any],
        *,
        displacement: ArrayLike | None = None,
        twist: ArrayLike | None = None,
        lent: bool = False,
    ) -> None:
        """Take in the next frames; see `SlipSearch.push`."""
        self._search.push(frames, displacement=displacement, twist=twist, lent=lent)

    def maps(self, seconds: float = math.inf, /) -> Maps:
        """Return the displacement in the newest frame; none before the second."""
        moved = self._search.newest()
        return {} if moved is None else {"displacement": moved}

    def spare(self, seconds: float) -> None:
        """Do nothing: nothing can wait."""

    def reset(self) -> None:
        """Forget the frames so far."""
        self._search.reset()

    def result(self) -> Result:
        """Return displacement and slip of all frames, and how they were found.

        Raises
        ------
        mirrorskin.io.InputError
            See `SlipSearch.result`.
        """
        found = slip_result(self._source, self._search, contact=self._contact)
        return undistorted(found.assign(process={**found.process, "live": True}), self._source)
