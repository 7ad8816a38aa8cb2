"""Edges: where the normal jumps, and where contact ends (paper, section 4.2)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import InputError
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.device import Device, open_device
from mirrorskin.kernels.edges import COARSE, FINE, MARGIN, NEAR, Limits, Pass, pairs

LIMITS = Limits(
    jump=math.radians(10.0),
    bend=math.radians(5.0),
    sure=3.5,
    quiet=math.radians(1.2),
    floor=math.radians(0.05),
    lowest=math.radians(5.0),
)
"""What the device and its reference are told."""

_FLAGS = ("clean", "lines", "more", "ways")


def find_edges(
    vectors: NDArray[np.float32],
    sigma: NDArray[np.float32],
    contact: NDArray[np.uint8],
    *,
    device: str | Device | None = None,
) -> NDArray[np.uint8]:
    """Draw thin lines where the normal jumps by more than 10 degrees, and where contact ends.

    A steady bend is no jump, and a jump must be 3.5 of its standard errors. Flags of contact that nearly
    all neighbours contradict are mistakes. Where contact ends, the last pixels in contact are drawn:
    those with one of four neighbours out of it. The picture's border is no edge.

    Parameters
    ----------
    vectors : ndarray, (H, W, 3), float32
        Unit normals; NaN where there is none.
    sigma : ndarray, (H, W), float32
        Their predicted RMS angular error, radians.
    contact : ndarray, (H, W), uint8
        1 where there is contact in every frame.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``. It holds all maps at once, 74 bytes a pixel.

    Returns
    -------
    ndarray, (H, W), uint8
        1 on edges.

    Raises
    ------
    mirrorskin.io.InputError
        The maps are not of one size.
    mirrorskin.kernels.errors.DeviceError
        No device, or one without room for the maps.
    """
    shape = contact.shape
    if contact.ndim != 2 or vectors.shape != (*shape, 3) or sigma.shape != shape or 0 in shape:
        told = f"vectors {vectors.shape}, sigma {sigma.shape} and contact {shape}"
        raise InputError(f"{told} do not fit: (H, W, 3), (H, W) and (H, W) are needed")
    return _Drawing(open_device(device), vectors, sigma, contact).draw()


class _Drawing:
    """The maps of one picture on a device, and the kernels over them."""

    def __init__(
        self,
        device: Device,
        vectors: NDArray[np.float32],
        sigma: NDArray[np.float32],
        contact: NDArray[np.uint8],
    ) -> None:
        rows, columns = contact.shape
        self._device, self._shape = device, (rows, columns)
        cells = (6, rows + 2 * MARGIN, columns + 2 * MARGIN)
        self._maps = {
            "vectors": self._device.given("vectors", vectors, np.float32),
            "sigma": self._device.given("sigma", sigma, np.float32),
            "contact": self._device.given("contact", contact != 0, np.uint8),
            "doubt": self._device.given("doubt", np.ones(contact.shape), np.uint8),
            **{name: self._room(name, contact.shape, np.uint8) for name in _FLAGS},
            "strength": self._room("strength", contact.shape, np.float32),
            **{name: self._room(name, cells, np.float32) for name in ("cells", "joined")},
        }

    def draw(self) -> NDArray[np.uint8]:
        """Return the edges."""
        rows = self._shape[0] + 2 * MARGIN
        self._run("edges_clean", self._tiles, "contact", "clean")
        self._run("edges_cells", rows, "vectors", "sigma", "contact", "clean", "cells")
        self._look(NEAR, "cells", "lines", "more")
        self._look(FINE, "cells", "more", "lines")
        self._run("edges_join", rows, "cells", "lines", "joined")
        self._look(COARSE, "joined", "lines", "more")
        self._run("edges_bound", self._tiles, "clean", "more", "lines")
        return self._maps["lines"].download().copy()

    def _look(self, chosen: Pass, cells: str, before: str, after: str) -> None:
        """Add the lines of one pass."""
        macros: dict[str, str | int] = {
            "SPACING": chosen.spacing,
            "STEPS": chosen.steps,
            "LEAST": f"{chosen.least}f",
            "REACH": chosen.reach,
            "GUARD": chosen.guard,
            "PART": f"{chosen.part}f",
            "LAST": int(chosen is COARSE),
        }
        places, distances = pairs(chosen)
        table = (
            self._device.given("places", places, np.int32),
            self._device.given("distances", distances, np.float32),
        )
        limits = LIMITS.jump, LIMITS.bend, LIMITS.sure, LIMITS.quiet, LIMITS.floor, LIMITS.lowest
        rows, columns = self._shape
        run = min(self._device.shape.tile, 64)
        found = "doubt", "strength", "ways"
        self._run("edges_jumps", rows * -(-columns // run), cells, *table, *limits, *found, **macros)
        self._run("edges_thin", self._tiles, "strength", "ways", before, after, **macros)

    @property
    def _tiles(self) -> int:
        rows, columns = self._shape
        return int(-(-rows * columns // self._device.shape.tile))

    def _room(self, name: str, shape: tuple[int, ...], dtype: type[np.generic]) -> Array:
        array = self._device.array(name, shape, dtype)
        array.upload()
        return array

    def _run(self, name: str, items: int, *arguments: str | float | Array, **macros: str | int) -> None:
        values: list[Array | np.generic] = [np.int32(size) for size in self._shape]
        for one in arguments:
            kept = self._maps[one] if isinstance(one, str) else one
            values.append(kept if isinstance(kept, Array) else np.float32(kept))
        moved = sum(one.host.nbytes for one in values if isinstance(one, Array))
        self._device.kernel("edges", name, **macros)(items, *values, moved=moved)
