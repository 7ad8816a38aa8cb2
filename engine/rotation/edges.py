"""Edges: where the normal jumps, and where contact ends (paper, section 4.2)."""

from __future__ import annotations

import math
from collections.abc import Iterator

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

_SHORTER = 4  # by how much other kernels are shorter than the longest one
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
    drawing = EdgeDrawing(open_device(device), shape)
    drawing.take(vectors, sigma, contact)
    for _ in drawing.steps():
        pass
    return drawing.lines()


class EdgeDrawing:
    """The maps of one picture on a device, and the kernels over them, which may be run in parts.

    Parameters
    ----------
    device : Device
    shape : (int, int)
        Rows and columns.
    """

    def __init__(self, device: Device, shape: tuple[int, int]) -> None:
        rows, columns = shape
        self._device, self._shape = device, (rows, columns)
        cells = (6, rows + 2 * MARGIN, columns + 2 * MARGIN)
        self._maps = {
            "vectors": self._room("vectors", (rows, columns, 3), np.float32),
            "sigma": self._room("sigma", shape, np.float32),
            "contact": self._room("contact", shape, np.uint8),
            "doubt": self._device.given("doubt", np.ones(shape), np.uint8),
            **{name: self._room(name, shape, np.uint8) for name in _FLAGS},
            "strength": self._room("strength", shape, np.float32),
            **{name: self._room(name, cells, np.float32) for name in ("cells", "joined")},
        }
        self._tables = {chosen: self._place(chosen) for chosen in (NEAR, FINE, COARSE)}

    def take(
        self, vectors: NDArray[np.float32], sigma: NDArray[np.float32], contact: NDArray[np.uint8]
    ) -> None:
        """Take the maps of a picture; see ``find_edges``."""
        for name, values in (("vectors", vectors), ("sigma", sigma), ("contact", contact != 0)):
            array = self._maps[name]
            array.claim()
            array.host[...] = values
            array.upload()

    def steps(self, parts: int = 1) -> Iterator[None]:
        """Put the kernels on the queue, the longest in so many parts, and yield after each."""
        rows, fewer = self._shape[0] + 2 * MARGIN, -(-parts // _SHORTER)
        yield from self._run("edges_clean", fewer, self._tiles, "contact", "clean")
        yield from self._run("edges_cells", fewer, rows, "vectors", "sigma", "contact", "clean", "cells")
        yield from self._look(NEAR, parts, "cells", "lines", "more")
        yield from self._look(FINE, parts, "cells", "more", "lines")
        yield from self._run("edges_join", fewer, rows, "cells", "lines", "joined")
        yield from self._look(COARSE, parts, "joined", "lines", "more")
        yield from self._run("edges_bound", fewer, self._tiles, "clean", "more", "lines")

    def lines(self) -> NDArray[np.uint8]:
        """Return the edges, once all steps are done."""
        return self._maps["lines"].download().copy()

    def _place(self, chosen: Pass) -> tuple[Array, Array]:
        """Return the pairs of cells that a pass compares."""
        places, distances = pairs(chosen)
        return (
            self._device.given("places", places, np.int32),
            self._device.given("distances", distances, np.float32),
        )

    def _look(self, chosen: Pass, parts: int, cells: str, before: str, after: str) -> Iterator[None]:
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
        limits = LIMITS.jump, LIMITS.bend, LIMITS.sure, LIMITS.quiet, LIMITS.floor, LIMITS.lowest
        rows, columns = self._shape
        run = min(self._device.layout.tile, 64)
        found = "doubt", "strength", "ways"
        items, fewer = rows * -(-columns // run), -(-parts // _SHORTER)
        jumps = cells, *self._tables[chosen], *limits, *found
        yield from self._run("edges_jumps", parts, items, *jumps, **macros)
        thin = "strength", "ways", before, after
        yield from self._run("edges_thin", fewer, self._tiles, *thin, **macros)

    @property
    def _tiles(self) -> int:
        rows, columns = self._shape
        return int(-(-rows * columns // self._device.layout.tile))

    def _room(self, name: str, shape: tuple[int, ...], dtype: type[np.generic]) -> Array:
        array = self._device.array(name, shape, dtype)
        array.upload()
        return array

    def _run(
        self, name: str, parts: int, items: int, *arguments: str | float | Array, **macros: str | int
    ) -> Iterator[None]:
        values: list[Array | np.generic] = [np.int32(size) for size in self._shape]
        for one in arguments:
            kept = self._maps[one] if isinstance(one, str) else one
            values.append(kept if isinstance(kept, Array) else np.float32(kept))
        moved = sum(one.host.nbytes for one in values if isinstance(one, Array))
        kernel, part = self._device.kernel("edges", name, **macros), -(-items // parts)
        for first in range(0, items, part):
            count = min(part, items - first)
            kernel(count, *values, moved=moved * count // items, first_item=first)
            yield
