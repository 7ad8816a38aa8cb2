"""Heights that follow slopes on the device, frame after frame, a step each."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.integration.graph import LEVEL, LinkRoom, Links, Settler, find_components
from mirrorskin.engine.integration.validation import Inputs, check_pixel_size
from mirrorskin.engine.integration.vcycle import Multigrid
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.device import Device

MAPS = "dz_dx", "dz_dy", "weight_x", "weight_y"
"""What is followed, by name: slopes, NaN where there is none, and their inverse variances, 0 there."""

_DEEP = 8  # frames after which all levels are looked at anew
_BEGIN, _MOST = 1e-3, 30  # residual, or cycles, to begin with
_FAR = 0.3  # gap from which on heights are found from scratch
_LOOK = 8  # frames after which the gap is looked at: that waits for the device


class Follower:
    """Integrate slopes that kernels leave on the device: heights are those of ``Integrator``, a step behind.

    Parameters
    ----------
    device : Device
    shape : (int, int)
        Rows and columns.
    pixel_size : array_like
        Millimetres, one number or (x, y).

    Attributes
    ----------
    maps : dict of Array, (H, W), float32
        To be written to before each frame; see `MAPS`.
    gap : float
        How far heights were from the solution before the last step that was looked at; NaN before the first.
    """

    def __init__(self, device: Device, shape: tuple[int, int], pixel_size: ArrayLike) -> None:
        self._device, self._shape, self._pixel_size = device, shape, check_pixel_size(pixel_size)
        self._room = LinkRoom(device, shape)
        self.maps = {name: self._room.array(name) for name in MAPS}
        self._settler = Settler(self._room)
        self._multigrid: Multigrid | None = None
        self.restart()

    def restart(self) -> None:
        """Forget the heights so far."""
        self._steps, self.gap = 0, math.nan

    def follow(self, typical: float) -> NDArray[np.float32]:
        """Return the heights of the maps as they are now, (H, W), mm, NaN where there is none.

        Parameters
        ----------
        typical : float
            A weight as there are many.
        """
        self.begin(typical)
        return self.end()

    def begin(self, typical: float) -> None:
        """Put on the device's queue what ``follow`` does, as far as nobody has to wait; `end` follows."""
        self._room.adopt(self._inputs(typical), *MAPS)
        self._flagged = self._room.flags.used
        self._links = self._room.join(LEVEL)
        self._relief: Array | None = None
        if self._multigrid is not None and self._steps:
            self._relief = self._multigrid.follow(self._links, deep=self._steps % _DEEP == 0)
        self._device.queue.flush()

    def end(self) -> NDArray[np.float32]:
        """Return the heights that were begun with, as ``follow`` does."""
        components = find_components(self._room.flags.see(self._flagged), cut=False)
        if components.count == 0:
            self._steps = 0
            return np.full(self._shape, np.nan, np.float32)
        relief = self._begin(self._links) if self._relief is None else self._relief
        self._settler.take(components)
        height: NDArray[np.float32] = self._settler.launch(relief, LEVEL).download().copy()
        self._steps += 1
        self._look()
        return height

    def _begin(self, links: Links) -> Array:
        """Find heights from scratch."""
        if self._multigrid is None:
            self._multigrid = Multigrid(links, plain=True)
        else:
            self._multigrid.rebuild(links, plain=True)
        return self._multigrid.solve(tolerance=_BEGIN, limit=_MOST).height

    def _look(self) -> None:
        """See now and then whether heights still follow; begin anew with the next frame if not."""
        if self._steps > 1 and self._steps % _LOOK == 0:
            assert self._multigrid is not None
            self.gap = self._multigrid.tell_gap()
            if not self.gap < _FAR:
                self._steps = 0

    def _inputs(self, typical: float) -> Inputs:
        """Say of the maps what the room wants to know."""
        dz_dx, dz_dy, weight_x, weight_y = (self.maps[name].host for name in MAPS)
        return Inputs(
            dz_dx=dz_dx,
            dz_dy=dz_dy,
            pixel_size=self._pixel_size,
            mask=None,
            edges=None,
            weight_x=weight_x,
            weight_y=weight_y,
            weight=1.0,
            typical=typical,
            absolute=True,
            heights=None,
            height_weights=None,
            height_weight=1.0,
            datum=0.0,
        )
