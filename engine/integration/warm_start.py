"""Integration of slopes on the device frame after frame, one step of the solver for each frame."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mirrorskin.engine.integration.graph import LEVEL, Levelling, PixelGraph, find_components
from mirrorskin.engine.integration.multigrid import Multigrid
from mirrorskin.engine.integration.validation import Flags, Floats, Inputs
from mirrorskin.io.base.arguments import check_pixel_size
from mirrorskin.io.base.threads import ThreadSafe
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.device import Device

MAPS = {"dz_dx": "dz_dx", "dz_dy": "dz_dy", "weight_x": "map_x", "weight_y": "map_y"}
"""Slopes, NaN where undefined, and their inverse variances, 0 there; with the names of the graph's arrays."""

_FIRST_RESIDUAL, _FIRST_CYCLES = 1e-3, 30  # tolerance and limit of the first solution
_MORE_STEPS = 6  # largest number of further steps for a frame
_DEEP = 4  # frames of which one rebuilds all levels of the graph, which change by little
# Relative error above which further steps follow, and then the next frame is solved from scratch.
_LARGEST_GAP = 0.1


class WarmStartIntegrator(ThreadSafe):
    """Integrate slopes on the device frame after frame, by a step of the solver for each frame.

    Pixels that enter, as at the border of a contact, start at the heights that those around imply along the
    slopes. Further steps follow where this is not enough.

    Attributes
    ----------
    maps : dict of Array, (H, W), float32
        Written by kernels before each frame; see `MAPS`.
    gap : float
        Relative error of the heights before the last step; NaN before the first one.
    """

    gap: float

    def __init__(self, device: Device, shape: tuple[int, int], pixel_size: ArrayLike) -> None:
        self._device, self._shape, self._pixel_size = device, shape, check_pixel_size(pixel_size)
        self._graph = PixelGraph(device, shape)
        self.maps: dict[str, Array] = {name: self._graph.array(inside) for name, inside in MAPS.items()}
        self._levelling = Levelling(self._graph)
        self._multigrid: Multigrid | None = None
        self._height: Floats | None = None
        self._flags: Flags = np.zeros(shape, np.uint8)
        self._components = find_components(self._flags, by_links=False)
        self._steps, self.gap = 0, math.nan

    def push(self, typical_weight: float) -> None:
        """Enqueue one step of the heights towards the solution for the maps, without waiting for it."""
        maps: dict[str, Any] = {**self.maps}
        inputs = Inputs(**maps, pixel_size=self._pixel_size, typical_weight=typical_weight)
        self._graph.use_device_maps(inputs)
        self._flagged = self._graph.flags.last_use
        self._relief: Array | None = None
        if self._multigrid is not None and self._steps:
            self._multigrid.enter(self.maps["dz_dx"], self.maps["dz_dy"], self._pixel_size)
            self._graph.put_links(*self._multigrid.in_place())
            self._is_deep = self._steps % _DEEP == 1
            self._relief = self._multigrid.follow(None, deep=self._is_deep)
        self._device.flush()
        self._height = None

    def result(self) -> Floats:
        """Return the heights of the last maps, (H, W), mm, NaN where undefined."""
        if self._height is None:
            self._height = self._level()
        return self._height

    def _level(self) -> Floats:
        flags = self._graph.flags.read(after=self._flagged)
        if not np.array_equal(flags, self._flags):
            self._components, self._flags = find_components(flags, by_links=False), flags
        if self._components.count == 0:
            self._steps = 0
            return np.full(self._shape, np.nan, np.float32)
        relief = self._from_scratch() if self._relief is None else self._near(self._relief)
        height: Floats = self._levelling.level(self._components, relief, [LEVEL])
        self._steps += 1
        return height

    def _near(self, relief: Array) -> Array:
        """Return heights after as many steps as they need."""
        assert self._multigrid is not None
        for _ in range(_MORE_STEPS):
            self.gap = self._multigrid.gap()
            if self.gap < _LARGEST_GAP:
                return relief
            # All levels: a cycle is of no use where coarse ones join what is not joined any more.
            relief = self._multigrid.follow(None, deep=not self._is_deep)
            self._is_deep = True
        if not self._multigrid.gap() < _LARGEST_GAP:
            self._steps = -1  # the next frame begins anew
        return relief

    def _from_scratch(self) -> Array:
        links = self._graph.links()
        if self._multigrid is None:
            self._multigrid = Multigrid(links, plain=True)
        else:
            self._multigrid.rebuild(links, plain=True)
        return self._multigrid.solve(tolerance=_FIRST_RESIDUAL, limit=_FIRST_CYCLES).height
