"""Tracking of a reference's texture in later frames: displacements at a grid of nodes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.base.device_arrays import AnyArray, on_host
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.device import C_TYPES, Device
from mirrorskin.kernels.skin.displacement import AFFINE, MARGIN, PACKED, PARAMETERS
from mirrorskin.kernels.skin.slip import MAX_CHANGE, MIN_CONTRAST

ITERATIONS = 8
"""Largest number of iterations; 2 are needed with a good start."""
GRADIENT_NOISE = 1.3923
"""Variance of a cubic spline's derivative at a sample, for samples with noise of variance 1."""

_LEVELS = 4  # maximum number of resolutions
_MIN_CONVERGED = 0.5  # minimum share of windows that are found
_CONVERGED_FRACTION = 0.98  # share of the nodes that must converge; windows with little texture never do
_LAST_CHANGE = 0.03  # pixels: the linearisation error is then below 0.001 pixels
_SEPARATE_ITERATIONS, _SETTLED = 4, 0.05  # of windows without neighbours: largest number, last change, pixels
_FOLLOWED = "coefficients", "planes", "inverse", "summary", "field", "answer"
_REACH = 16  # pixels by which the samples of such a window may be displaced from its start
_FIELD_WEIGHT = 0.01  # weight of the previous field, relative to that of the median node
_TILE, _NODES = 4096, 16  # pixels and nodes per work-item on a CPU

Part = tuple[slice, slice]
"""Rows and columns of nodes, with starts and stops."""


@dataclass(frozen=True, slots=True)
class NodeField:
    """Displacement of a frame at the nodes.

    Attributes
    ----------
    moved : ndarray, (2, rows, columns), float64
        Pixels to the right and down, of the nodes that were followed; NaN where a window leaves the picture
        or has no texture.
    variance : ndarray, (rows, columns), float64
        Variance of a sample, counts^2, from the residual in the window.
    converged : ndarray, (rows, columns), bool
        Whether the frame was warped back to within half a pixel, and then has at least half of the
        reference's contrast.
    """

    moved: Doubles
    variance: Doubles
    converged: NDArray[np.bool_]


class Tracker:
    """Least squares in windows (Lucas and Kanade, 1981), which share one frame that is warped back.

    A frame F is warped back by a smooth field U: W(p) = F(p + U(p)). With the reference R and its gradient
    g, in each window ::

        R - W + g U = g a + brightness (1, x, y) + gain R

    is solved for an affine displacement a, from which the next U is computed: a Gauss-Newton step. Because a
    is the whole displacement, not an increment of U, the result of a node depends only on its window.

    The start of a frame is extrapolated from the last two. If less than half of the windows are found from
    there, coarser resolutions are tried, and then the maximum of the correlation of the whole picture.

    Parameters
    ----------
    reference : ndarray or Array, (H, W), uint8, uint16 or float32
        Frames may be in host or device memory as well.
    window, step : int
        Side of a window, and distance between nodes, pixels.
    device : Device
    """

    def __init__(
        self, reference: AnyArray, window: int, step: int, device: Device, separate: bool = False
    ) -> None:
        self._make = partial(Level, window=window, step=step, device=device, separate=separate)
        self._least = 2 * window
        self._reference = reference
        self.finest: Level = self._make(reference)
        self._fields = [self.finest.rest, self.finest.rest]

    @cached_property
    def _levels(self) -> list[Level]:
        """The reference at all resolutions, each half of the preceding one."""
        levels, counts = [self.finest], on_host(self._reference)
        for _ in range(1, _LEVELS):
            counts = cv2.pyrDown(counts.astype(np.float32))
            if min(counts.shape) < self._least:
                break
            levels.append(self._make(counts))
        return levels

    def follow(self, frame: AnyArray, stride: float = 1.0) -> NodeField:
        """Return the displacement of a frame; ``stride`` is its step as a multiple of the previous step."""
        last, before = self._fields
        begin = last + stride * (last - before)
        best, field = self.finest.follow(frame, begin, self.finest.whole)
        if np.count_nonzero(best.converged) < self.least_converged(self.finest.whole):
            best, field = self.search(on_host(frame), best, begin, field, self.finest.whole)
        self._fields = [field, last]
        return best

    def least_converged(self, part: Part) -> int:
        """Return the number of windows of a part below which `search` finds more."""
        return math.ceil(_MIN_CONVERGED * np.count_nonzero(self.finest.usable[part]))

    def search(
        self, frame: NDArray[Any], best: NodeField, begin: Doubles, field: Doubles, part: Part
    ) -> tuple[NodeField, Doubles]:
        """Return the displacement of a part of a frame and its field, by coarser resolutions if better.

        ``best`` and ``field`` were found from the start ``begin``.
        """
        for correlated in (False, True):
            if np.count_nonzero(best.converged) >= self.least_converged(part):
                break
            start = self._correlated(frame) if correlated else begin
            displacement, other = self._follow_down(frame, start, part)
            if np.count_nonzero(displacement.converged) > np.count_nonzero(best.converged):
                best, field = displacement, other
        return best, field

    def to_pixels(self, values: Doubles, on_device: bool = False) -> AnyArray:
        """Return values of the nodes, (rows, columns) or ([T,] rows, columns, n), at all pixels.

        They are cubic, linear where nodes are missing, and otherwise NaN. ``on_device``: values of (T, rows,
        columns, n) stay on the device if it can store them in one array.
        """
        return self.finest.to_pixels(values, logarithms=False, on_device=on_device)

    def positive_to_pixels(self, values: Doubles, on_device: bool = False) -> AnyArray:
        """Return values above 0 as `to_pixels` does, interpolated as logarithms to remain above 0."""
        return self.finest.to_pixels(np.log(values), logarithms=True, on_device=on_device)

    def worst_at_pixels(self, codes: NDArray[np.uint8], rank: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return at all pixels the code of highest rank of the nodes around, (T, rows, columns)."""
        ranks = rank[codes]
        for axis in (1, 2):
            ranks = np.maximum(ranks, ranks.take(np.arange(1, ranks.shape[axis] + 1), axis, mode="clip"))
        worst = np.argsort(rank).astype(np.uint8)[ranks]
        rows, columns = (place.astype(int) for place in self._places())
        return worst.take(columns, 2).take(rows, 1)

    def nearest(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return at all pixels the value of the nearest node, (rows, columns)."""
        rows, columns = (np.rint(place).astype(int) for place in self._places())
        return np.asarray(values[np.ix_(rows, columns)])

    def at_nearest_pixels(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return at all nodes the value of about the nearest pixel, (H, W)."""
        level = self.finest
        rows, columns = (
            np.clip(np.rint(level.start + level.step * np.arange(nodes)).astype(int), 0, size - 1)
            for size, nodes in zip(level.shape, level.grid, strict=True)
        )
        return np.asarray(values[np.ix_(rows, columns)])

    def _places(self) -> list[Doubles]:
        """Return rows and columns of pixels in units of the nodes' spacing."""
        level = self.finest
        return [
            np.clip((np.arange(size) - level.start) / level.step, 0, nodes - 1)
            for size, nodes in zip(level.shape, level.grid, strict=True)
        ]

    def _follow_down(self, frame: NDArray[Any], field: Doubles, part: Part) -> tuple[NodeField, Doubles]:
        """Follow a frame from the coarsest resolution to a part of the finest."""
        frames = [frame]
        for _ in self._levels[1:]:
            frames.append(cv2.pyrDown(frames[-1].astype(np.float32)))
        for number in reversed(range(len(self._levels))):
            level = self._levels[number]
            start = level.at_nodes(field, self.finest, 2.0**number)
            displacement, field = level.follow(
                frames[number], start, part if level is self.finest else level.whole
            )
            if level is not self.finest:
                field = self.finest.at_nodes(field, level, 0.5**number)
        return displacement, field

    def _correlated(self, frame: NDArray[Any]) -> Doubles:
        """Return the field of a uniform displacement, by phase correlation of the whole picture."""
        reference, moved = (
            np.nan_to_num(on_host(counts).astype(np.float64)) for counts in (self._reference, frame)
        )
        taper = cv2.createHanningWindow(frame.shape[::-1], cv2.CV_64F)
        (right, down), _ = cv2.phaseCorrelate(reference, moved, taper)
        field = self.finest.rest.copy()
        field[:2] = np.array([right, down])[:, None, None]
        return field


class Level:
    """The reference at one resolution, and its arrays on the device."""

    step: int
    measured: Doubles

    def __init__(self, reference: AnyArray, window: int, step: int, device: Device, separate: bool) -> None:
        self._device, self._window, self.step, self._separate = device, window, step, separate
        self._tile, self._nodes = (_TILE, _NODES) if device.layout.tile > 1 else (1, 1)
        self._macros: dict[str, str | int] = {"FRAME": C_TYPES[reference.dtype.name], "WINDOW": window}
        self._macros |= {"STEP": step, "TILE": self._tile, "NODES": self._nodes}
        if reference.dtype.kind == "u":
            self._macros["TOP"] = int(np.iinfo(reference.dtype).max)
        self.shape: tuple[int, int] = reference.shape
        rows, columns = self.shape
        self._first, self._halo = (step - window) // 2, 2 * window + 8
        self.start: float = self._first + (window - 1) / 2
        self.grid: tuple[int, int] = -(-rows // step), -(-columns // step)
        self.rest: NDArray[Any] = np.zeros((AFFINE if separate else 2, *self.grid))
        self.whole: Part = slice(0, self.grid[0]), slice(0, self.grid[1])
        with_halo = rows + 2 * self._halo, columns + 2 * self._halo
        shapes = {
            "coefficients": (rows + 2 * MARGIN, columns + 2 * MARGIN),
            **dict.fromkeys(("sums", "counts"), self.shape),
            "planes": (4, *with_halo),
            "difference": (2, *with_halo),
            **dict.fromkeys(("field", "next_field"), self.rest.shape),
            "answer": (AFFINE + 3, *self.grid),
            "inverse": (self._items, PACKED, self._nodes),
            "summary": (4, *self.grid),
        }
        self.maps = {
            name: device.array(name, shape, np.float32, zeroed=False) for name, shape in shapes.items()
        }
        self._dtype = reference.dtype
        self._measure_reference(reference)
        summary = self.maps["summary"].read().astype(np.float64)
        variances, self.measured = summary[:3], summary[3]
        # Information about the displacement, with all other parameters free.
        self.information: NDArray[Any] = invert_symmetric(variances)
        self.usable: NDArray[np.bool_] = np.isfinite(self.information[0])
        trust = np.nan_to_num(1 / (variances[0] + variances[2]))
        trust = trust / (trust.max() or 1.0) + 1e-9
        self._hold = _FIELD_WEIGHT * float(np.median(trust))
        self.maps["trust"] = device.from_host("trust", trust)

    def _measure_reference(self, reference: AnyArray) -> None:
        """Compute the reference's planes, and the inverse normal matrix of each node."""
        frame = {"frame": self._fit_spline(reference)}
        maps, (rows, columns) = self.maps, self.shape
        sizes: dict[str, Any] = {"rows": rows, "columns": columns}
        sums = {name: maps[name] for name in ("sums", "counts")}
        self._launch("across", rows * math.ceil(columns / self._tile), **sizes, **frame, **sums)
        wide = columns + 2 * self._halo
        self._launch(
            "planes",
            (rows + 2 * self._halo) * math.ceil(wide / self._tile),
            **sizes,
            **frame,
            **sums,
            halo=self._halo,
            **{name: maps[name] for name in ("coefficients", "planes", "difference")},
        )
        results = {name: maps[name] for name in ("planes", "inverse", "summary")}
        self._launch("normals", self._items, **self._sizes, **results)

    @property
    def _items(self) -> int:
        """Number of work-items for the windows of all nodes."""
        return self.grid[0] * math.ceil(self.grid[1] / self._nodes)

    def to_pixels(self, values: Doubles, logarithms: bool, on_device: bool) -> AnyArray:
        """Return values, or their exponentials, (rows, columns) or ([T,] rows, columns, n), at all pixels."""
        kind = values.shape[values.ndim - 1 :] if values.ndim > 2 else ()
        nodes = np.moveaxis(values.reshape(-1, *self.grid, math.prod(kind)), -1, 1)
        nbytes = 4 * math.prod(self.shape) * math.prod(kind)
        limit = max(1, self._device.max_allocation // nbytes)
        if on_device and len(nodes) <= limit:
            return self._pixels(nodes, logarithms)
        parts = [
            self._pixels(nodes[k : k + limit], logarithms).release() for k in range(0, len(nodes), limit)
        ]
        pixels = parts[0] if len(parts) == 1 else np.concatenate(parts)
        return pixels.reshape(*values.shape[:-3], *self.shape, *kind)

    def _pixels(self, values: Doubles, logarithms: bool) -> Array:
        """Return values of nodes, (T, n, rows, columns), at all pixels, (T, H, W, n)."""
        (rows, columns), (count, parts) = self.shape, values.shape[:2]
        nodes = self._device.from_host("nodes", values)
        pixels = self._device.array("pixels", (count, rows, columns, parts), np.float32, zeroed=False)
        sizes = {name: size for name, size in self._sizes.items() if name != "halo"}
        self._launch(
            "pixels",
            count * rows * math.ceil(columns / self._tile),
            **sizes,
            count=count,
            parts=parts,
            logarithms=logarithms,
            nodes=nodes,
            pixels=pixels,
        )
        return pixels

    @cached_property
    def _sizes(self) -> dict[str, int]:
        """Sizes of the picture, of the nodes, and of the halo, as arguments of kernels."""
        (rows, columns), (node_rows, node_columns) = self.shape, self.grid
        sizes = {"rows": rows, "columns": columns, "node_rows": node_rows, "node_columns": node_columns}
        return sizes | {"halo": self._halo}

    @cached_property
    def _frame(self) -> Array:
        """Memory on the device for a frame from the host."""
        return self._device.array("frame", self.shape, self._dtype, zeroed=False)

    def _fit_spline(self, frame: AnyArray, inside: Part | None = None) -> Array:
        """Compute the coefficients of a frame's spline on the device, and return the frame there.

        ``inside`` are the rows and columns of the samples to be interpolated, by default all.
        """
        coefficients, (rows, columns) = self.maps["coefficients"], self.shape
        placed = frame if isinstance(frame, Array) else self._frame
        if placed is not frame:
            placed.write(frame)
        (top, bottom), (left, right) = (
            (0, size + 2 * MARGIN)
            if part is None
            else (max(part.start, 0) + MARGIN - 2, min(part.stop, size) + MARGIN + 2)
            for part, size in zip(inside or (None, None), self.shape, strict=True)
        )
        self._launch(
            "spline",
            (bottom - top) * math.ceil((right - left) / self._tile),
            rows=rows,
            columns=columns,
            top=top,
            bottom=bottom,
            left=left,
            right=right,
            frame=placed,
            coefficients=coefficients,
        )
        return placed

    def follow(self, frame: AnyArray, field: Doubles, part: Part) -> tuple[NodeField, Doubles]:
        """Return the displacement of a frame, starting from a field, and the final field."""
        maps = self.maps
        maps["field"].write(field)
        if self._separate:
            return self._follow_separately(frame, field, part)
        self._fit_spline(frame)
        for _ in range(ITERATIONS):
            self._solve()
            last, field = field, maps["next_field"].read()
            if np.mean(np.abs(field - last) < _LAST_CHANGE) > _CONVERGED_FRACTION:
                break
            maps["field"], maps["next_field"] = maps["next_field"], maps["field"]
        answer = maps["answer"].read().astype(np.float64)
        moved = answer[:2]
        gain, squares, variances = answer[AFFINE:]
        with np.errstate(invalid="ignore"):
            converged = (np.abs(moved - last).max(axis=0) < MAX_CHANGE) & (gain > MIN_CONTRAST)
        return NodeField(moved, self._variance(gain, squares, variances), converged), field

    def _follow_separately(self, frame: AnyArray, field: Doubles, part: Part) -> tuple[NodeField, Doubles]:
        """Return the displacement of windows without neighbours, and their affine fields."""
        start = field[:2, *part].reshape(2, -1)
        self.follow_windows(frame, start.min(axis=1).tolist(), start.max(axis=1).tolist(), part)
        return self.answered(field, part)

    def answered(self, field: Doubles, part: Part) -> tuple[NodeField, Doubles]:
        """Return the displacement of windows without neighbours that were followed, and their affine fields.

        ``field`` is the one from which they were followed.
        """
        answer = self.maps["answer"].read()[:, *part].astype(np.float64)
        moved, (gain, variance, change) = answer[:AFFINE], answer[AFFINE:]
        converged = (change < MAX_CHANGE) & (gain > MIN_CONTRAST)
        field = field.copy()
        np.copyto(field[:, *part], moved, where=converged)
        return NodeField(moved[:2], variance, converged), field

    def follow_windows(
        self, frame: AnyArray, least: Sequence[float], most: Sequence[float], part: Part
    ) -> None:
        """Follow the windows of a part, from the field on the device, whose answers remain there.

        ``least`` and ``most`` are the range of the field there, pixels to the right and down.
        """
        maps, (rows, columns) = self.maps, part
        (top, bottom), (left, right) = (
            (
                math.floor(self._first + nodes.start * self.step + lowest) - _REACH,
                math.ceil(self._first + (nodes.stop - 1) * self.step + highest) + self._window + _REACH,
            )
            for nodes, lowest, highest in zip(part, reversed(least), reversed(most), strict=True)
        )
        self._fit_spline(frame, (slice(top, bottom), slice(left, right)))
        self._launch(
            "follow",
            (rows.stop - rows.start) * (columns.stop - columns.start),
            **self._sizes,
            top=rows.start,
            bottom=rows.stop,
            left=columns.start,
            right=columns.stop,
            iterations=_SEPARATE_ITERATIONS,
            settled=_SETTLED,
            **{name: maps[name] for name in _FOLLOWED},
        )

    def _variance(self, gain: Doubles, squares: Doubles, variances: Doubles) -> Doubles:
        """Return the variance of a sample from sums of squares and of the variances of differences."""
        with np.errstate(invalid="ignore", divide="ignore"):
            # The reference's noise is multiplied by the gain.
            variances = variances + (gain**2 - 1) * self.measured
            # By rounding, the sum of squares of a frame without noise may be below 0.
            return np.maximum(squares, 0) / (variances * (1 - PARAMETERS / self.measured))

    def _solve(self) -> None:
        """Warp the frame back by the field, solve all windows, and compute the next field."""
        maps, (rows, columns), sizes = self.maps, self.shape, self._sizes
        shared = {name: maps[name] for name in ("planes", "field", "difference")}
        items = rows * math.ceil(columns / self._tile)
        self._launch("warp", items, **sizes, **shared, coefficients=maps["coefficients"])
        self._launch("solve", self._items, **sizes, **shared, inverse=maps["inverse"], answer=maps["answer"])
        node_rows, node_columns = self.grid
        self._launch(
            "field",
            node_rows * math.ceil(node_columns / self._tile),
            node_rows=node_rows,
            node_columns=node_columns,
            hold=self._hold,
            **{name: maps[name] for name in ("trust", "answer", "field", "next_field")},
        )

    def at_nodes(self, field: Doubles, level: Level, scale: float) -> Doubles:
        """Return a field of another level at the nodes of this one, whose pixels are larger by a scale."""
        if level is self:
            return field
        from scipy.ndimage import map_coordinates

        places = [(self.start + self.step * np.arange(n)) * scale for n in self.grid]
        rows, columns = ((place - level.start) / level.step for place in places)
        where = np.meshgrid(rows, columns, indexing="ij")
        parts = [map_coordinates(part, where, order=1, mode="nearest") for part in field]
        moved = np.stack(parts)
        moved[:2] /= scale  # derivatives per half window are the same
        return moved

    def _launch(self, name: str, items: int, **arguments: Any) -> None:
        moved = sum(array.nbytes for array in arguments.values() if isinstance(array, Array))
        self._device.kernel("displacement", f"displacement_{name}", **self._macros)(
            items, **arguments, moved=moved
        )


def invert_symmetric(matrices: Doubles) -> Doubles:
    """Return the inverse of symmetric matrices of two rows, each (3, ...): elements 00, 10 and 11."""
    first, mixed, last = matrices
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.stack([last, -mixed, first]) / (first * last - mixed**2))
