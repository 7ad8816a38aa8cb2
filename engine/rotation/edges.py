"""Edges: where the normal jumps, and where contact ends (paper, section 4.2)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.base.device_arrays import AnyArray, as_any_array, device_of
from mirrorskin.io import InputError
from mirrorskin.io.base.arguments import checked, in_unit
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.rotation.edges import COARSE, FINE, MARGIN, NEAR, Limits, Pass, pairs

LIMITS = Limits(
    jump=math.radians(10.0),
    bend=math.radians(5.0),
    significance=3.5,
    quiet=math.radians(1.2),
    floor=math.radians(0.05),
    lowest=math.radians(5.0),
)
"""Limits of edges, for the kernels and their reference."""

_CHUNK = 64  # pixels of a row that a work-item processes on a CPU; see edges.cl
_SHORTER = 4  # approximate ratio of the run times of the longest kernel and the others


@checked(
    normals=partial(as_any_array, components=True),
    normals_sigma=in_unit("rad", as_any_array),
    contact=as_any_array,
)
def find_edges(
    normals: AnyArray,
    normals_sigma: AnyArray,
    contact: AnyArray,
    *,
    device: str | Device | None = None,
) -> Any:
    """Draw thin lines where the normal jumps by more than 10 degrees, and where contact ends.

    A continuous bend is not a jump, and a jump must exceed 3.5 standard errors. Flags of contact that nearly
    all neighbours contradict are ignored. Where contact ends, the pixels in contact with one of four
    neighbours out of contact are drawn. The border of the picture is not an edge.

    Parameters
    ----------
    normals : ndarray or device array, (H, W, 3), float32
        Unit vectors; NaN where undefined.
    normals_sigma : ndarray or device array, (H, W), float32
        Their predicted RMS angular error, radians.
    contact : ndarray or device array, (H, W), uint8
        1 where there is contact in every frame.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``. All maps are in its memory at once, 74 bytes per pixel.

    Returns
    -------
    ndarray, (H, W), uint8, or `mirrorskin.kernels.array.Array` if the normals are on a device
        1 on edges.

    Raises
    ------
    mirrorskin.io.InputError
        Maps of different sizes.
    mirrorskin.kernels.errors.DeviceError
        No device, or one without memory for the maps.

    Examples
    --------
    Two planes that lean 20 degrees to either side of a ridge:

    >>> import numpy as np
    >>> from mirrorskin import engine
    >>> lean = np.radians(20) * np.sign(np.arange(20) - 9.5) * np.ones((20, 1))
    >>> normals = np.stack([np.sin(lean), 0 * lean, np.cos(lean)], axis=-1).astype(np.float32)
    >>> sigma, contact = np.full((20, 20), 0.01, np.float32), np.ones((20, 20), np.uint8)
    >>> np.flatnonzero(engine.find_edges(normals, sigma, contact)[10]).tolist()
    [9]
    """
    shape: tuple[int, int] = contact.shape
    if contact.ndim != 2 or normals.shape != (*shape, 3) or normals_sigma.shape != shape or 0 in shape:
        shapes = f"normals {normals.shape}, normals_sigma {normals_sigma.shape} and contact {shape}"
        raise InputError(f"{shapes} do not fit: (H, W, 3), (H, W) and (H, W) are needed")
    drawing = EdgeDrawing(device_of(device, normals, normals_sigma, contact), shape)
    drawing.take(normals, normals_sigma, contact)
    for _ in drawing.steps():
        pass
    return drawing.drawn if isinstance(normals, Array) else drawing.lines()


class EdgeDrawing:
    """The maps of one picture on a device, and the kernels that draw edges, which can be run in parts."""

    def __init__(self, device: Device, shape: tuple[int, int]) -> None:
        self._device, self._shape = device, shape
        cells = (6, shape[0] + 2 * MARGIN, shape[1] + 2 * MARGIN)
        kinds: dict[str, tuple[tuple[int, ...], type[np.generic]]] = {
            "vectors": ((*shape, 3), np.float32),
            **dict.fromkeys(("sigma", "strength"), (shape, np.float32)),
            **dict.fromkeys(
                ("contact", "clean", "undecided", "lines", "more", "directions"), (shape, np.uint8)
            ),
            **dict.fromkeys(("cells", "joined"), (cells, np.float32)),
        }
        # Every kernel writes its maps completely, so they need no initialisation.
        self._maps = {name: device.array(name, *kind, zeroed=False) for name, kind in kinds.items()}

    def take(
        self,
        vectors: AnyArray,
        sigma: AnyArray,
        contact: AnyArray,
    ) -> None:
        """Copy the maps of a picture to the device, unless they are there; see `find_edges`."""
        for name, values in (("vectors", vectors), ("sigma", sigma), ("contact", contact)):
            if isinstance(values, Array) and values.dtype == self._maps[name].dtype:
                self._maps[name] = values
            else:
                array = np.asarray(values)
                self._maps[name].write(array != 0 if name == "contact" else array)

    def steps(self, parts: int = 1) -> Iterator[None]:
        """Enqueue the kernels, the longest ones in ``parts`` parts, and yield after each."""
        maps, fewer = self._maps, -(-parts // _SHORTER)
        rows, columns = (size + 2 * MARGIN for size in self._shape)
        chunk = min(self._device.layout.tile, _CHUNK)
        cells, pixels = rows * -(-columns // chunk), self._shape[0] * -(-self._shape[1] // chunk)
        contact: dict[str, Any] = {name: maps[name] for name in ("contact", "clean")}
        normals: dict[str, Any] = {name: maps[name] for name in ("vectors", "sigma", "cells")}
        yield from self._run("edges_clean", fewer, pixels, **contact)
        yield from self._run("edges_cells", fewer, cells, **contact, **normals)
        yield from self._draw(NEAR, parts, "cells", "lines", "more")
        yield from self._draw(FINE, parts, "cells", "more", "lines")
        joined: dict[str, Any] = {"cells": maps["cells"], "edges": maps["lines"], "joined": maps["joined"]}
        yield from self._run("edges_join", fewer, cells, **joined)
        yield from self._draw(COARSE, parts, "joined", "lines", "more")
        drawn: dict[str, Any] = {"clean": maps["clean"], "edges": maps["more"], "drawn": maps["lines"]}
        yield from self._run("edges_bound", fewer, self._tiles, **drawn)

    @property
    def drawn(self) -> Array:
        """The edges, once all steps are done."""
        return self._maps["lines"]

    def lines(self) -> NDArray[np.uint8]:
        """Return a copy of the edges, once all steps are done."""
        return self.drawn.read()

    def _draw(self, chosen: Pass, parts: int, cells: str, before: str, after: str) -> Iterator[None]:
        """Add the lines of one pass."""
        macros: dict[str, str | int] = {
            "SPACING": chosen.spacing,
            "STEPS": chosen.steps,
            "MIN_PAIRS": f"{chosen.min_pairs}f",
            "REACH": chosen.reach,
            "GUARD": chosen.guard,
            "PART": f"{chosen.part}f",
            "FIRST": int(chosen is NEAR),
            "LAST": int(chosen is COARSE),
        }
        maps, (rows, columns) = self._maps, self._shape
        jumps: dict[str, Any] = {name: maps[name] for name in ("strength", "directions")}
        yield from self._run(
            "edges_jumps",
            parts,
            rows * -(-columns // min(self._device.layout.tile, _CHUNK)),
            macros,
            cells=maps[cells],
            pairs=_pairs_on(self._device, chosen),
            jump=LIMITS.jump,
            bend=LIMITS.bend,
            significance=LIMITS.significance,
            quiet=LIMITS.quiet,
            floor_=LIMITS.floor,
            lowest=LIMITS.lowest,
            undecided=maps["undecided"],
            **jumps,
        )
        lines: dict[str, Any] = {"edges": maps[before], "added": maps[after]}
        yield from self._run("edges_thin", -(-parts // _SHORTER), self._tiles, macros, **jumps, **lines)

    @property
    def _tiles(self) -> int:
        rows, columns = self._shape
        return int(-(-rows * columns // self._device.layout.tile))

    def _run(
        self,
        name: str,
        parts: int,
        items: int,
        macros: dict[str, str | int] | None = None,
        **arguments: Any,
    ) -> Iterator[None]:
        """Run a kernel over its items in ``parts`` parts."""
        rows, columns = self._shape
        moved = sum(array.nbytes for array in arguments.values() if isinstance(array, Array))
        kernel = self._device.kernel("edges", name, **(macros or {}))
        part = -(-items // (parts * kernel.group)) * kernel.group  # so that no item is run twice
        for first in range(0, items, part):
            count = min(part, items - first)
            part_bytes = moved * count // items
            kernel(count, rows=rows, columns=columns, **arguments, moved=part_bytes, first_item=first)
            yield


def _pairs_on(device: Device, chosen: Pass) -> Array:
    """Return the pairs of a pass on a device, where they stay: columns, rows and distance of each."""
    name = f"pairs of edges, {chosen}"
    table = device.cache.get(name)
    if table is None:
        places, distances = pairs(chosen)
        values = np.concatenate([places, distances[..., np.newaxis]], axis=-1)
        table = device.cache[name] = device.from_host("pairs", values)
    assert isinstance(table, Array)
    return table
