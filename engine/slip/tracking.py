"""Tracking of a reference's texture in later frames: displacements at a grid of nodes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from mirrorskin.kernels.array import Array
from mirrorskin.kernels.device import C_TYPES, Device
from mirrorskin.kernels.displacement import AFFINE, MARGIN, PARAMETERS, basis, interpolate_nodes, windows

Doubles = NDArray[np.float64]

ITERATIONS = 8
"""Largest number of iterations; 2 are needed with a good start."""
GRADIENT_NOISE = 1.3923
"""Variance of a cubic spline's derivative at a sample, for samples with noise of variance 1."""

_LEVELS = 4  # largest number of resolutions
_ENOUGH = 0.5  # share of the windows that must be found
_LIKE = 0.5  # smallest contrast of the same texture, relative to the reference
_MOST = 0.98  # share of the nodes that must settle; windows with little texture never do
_SETTLED = 0.03  # change, pixels, that ends iterations: the linearisation error is then below 0.001 pixels
_FARTHEST = 1.5  # largest change in one iteration, pixels
_KERNEL = np.array([1.0, 4.0, 6.0, 4.0, 1.0]) / 16  # smoothing of the field over nodes
_HOLD = 0.01  # weight of the previous field, relative to that of the median node
_TILE = 4096  # pixels of a core's work-item


@dataclass(frozen=True, slots=True)
class NodeField:
    """Displacement of a frame at the nodes.

    Attributes
    ----------
    moved : ndarray, (2, rows, columns), float64
        Pixels to the right and down; NaN where a window leaves the picture or has no texture at all.
    variance : ndarray, (rows, columns), float64
        Variance of a sample, counts^2, from the residual in the window.
    found : ndarray, (rows, columns), bool
        Whether the frame was warped back to within half a pixel, and then has at least half of the
        reference's contrast.
    """

    moved: Doubles
    variance: Doubles
    found: NDArray[np.bool_]


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
    reference : ndarray, (H, W), uint8, uint16 or float32
    window, step : int
        Pixels of a window's side, and from node to node.
    device : Device
    """

    def __init__(self, reference: NDArray[Any], window: int, step: int, device: Device) -> None:
        self._make = partial(_Level, window=window, step=step, device=device)
        self._least = 2 * window
        self._reference = reference
        self.finest: _Level = self._make(reference)
        self._fields = [self.finest.rest, self.finest.rest]

    @cached_property
    def _levels(self) -> list[_Level]:
        """The reference at all resolutions, each half of the one before."""
        levels, counts = [self.finest], self._reference
        for _ in range(1, _LEVELS):
            counts = cv2.pyrDown(counts.astype(np.float32))
            if min(counts.shape) < self._least:
                break
            levels.append(self._make(counts))
        return levels

    def follow(self, frame: NDArray[Any], stride: float = 1.0) -> NodeField:
        """Return the displacement of a frame; ``stride`` is its step as a multiple of the previous step."""
        last, before = self._fields
        begin = last + stride * (last - before)
        best, field = self.finest.follow(frame, begin)
        for correlated in (False, True):
            if np.mean(best.found) >= _ENOUGH * np.mean(self.finest.usable):
                break
            found, other = self._follow_down(frame, self._correlated(frame) if correlated else begin)
            if np.mean(found.found) > np.mean(best.found):
                best, field = found, other
        self._fields = [field, last]
        return best

    def to_pixels(self, values: Doubles) -> NDArray[np.float32]:
        """Return values of the nodes, (rows, columns, ...), at all pixels: cubic, else linear, else NaN."""
        level, fine = self.finest, np.moveaxis(values.reshape(*self.finest.grid, -1), -1, 0)
        linear = interpolate_nodes(fine, level.start, level.step, level.shape)
        for axis, place in enumerate(self._places(), 1):
            fine = _cubic(fine, place, axis)
        found = np.where(np.isfinite(fine), fine, linear).astype(np.float32)
        return np.asarray(np.moveaxis(found, 0, -1).reshape(*level.shape, *values.shape[2:]))

    def positive_to_pixels(self, values: Doubles) -> NDArray[np.float32]:
        """Return values above 0 at all pixels, interpolated as logarithms to remain above 0."""
        return np.asarray(np.exp(self.to_pixels(np.log(values))))

    def worst_at_pixels(self, codes: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return at all pixels the largest code of the nodes around, (rows, columns)."""
        places = [np.floor(place).astype(int) for place in self._places()]
        both = [[place, np.minimum(place + 1, n - 1)] for place, n in zip(places, codes.shape, strict=True)]
        corners = [codes[np.ix_(rows, columns)] for rows in both[0] for columns in both[1]]
        return np.asarray(np.max(corners, axis=0))

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

    def _follow_down(self, frame: NDArray[Any], field: Doubles) -> tuple[NodeField, Doubles]:
        """Follow a frame from the coarsest resolution to the finest."""
        frames = [frame]
        for _ in self._levels[1:]:
            frames.append(cv2.pyrDown(frames[-1].astype(np.float32)))
        for number in reversed(range(len(self._levels))):
            level = self._levels[number]
            found, field = level.follow(frames[number], level.at_nodes(field, self.finest, 2.0**number))
            if level is not self.finest:
                field = self.finest.at_nodes(field, level, 0.5**number)
        return found, field

    def _correlated(self, frame: NDArray[Any]) -> Doubles:
        """Return the field of a uniform displacement, by phase correlation of the whole picture."""
        reference, moved = (np.nan_to_num(counts.astype(np.float64)) for counts in (self._reference, frame))
        taper = cv2.createHanningWindow(frame.shape[::-1], cv2.CV_64F)
        (right, down), _ = cv2.phaseCorrelate(reference, moved, taper)
        return np.asarray(self.finest.rest + np.array([right, down])[:, None, None])


class _Level:
    """The reference at one resolution, and its arrays on the device."""

    step: int
    measured: Doubles

    def __init__(self, reference: NDArray[Any], window: int, step: int, device: Device) -> None:
        self._device, self._window, self.step = device, window, step
        self._frame_type = C_TYPES[reference.dtype.name]
        self._tile = _TILE if device.layout.tile > 1 else 1
        self.shape: tuple[int, int] = reference.shape
        rows, columns = self.shape
        self._first, self._halo = (step - window) // 2, 2 * window + 8
        self.start: float = self._first + (window - 1) / 2
        self.grid: tuple[int, int] = -(-rows // step), -(-columns // step)
        self.rest: NDArray[Any] = np.zeros((2, *self.grid))
        padded = rows + 2 * MARGIN, columns + 2 * MARGIN
        self._maps = {
            "padded": device.array("padded", padded, np.float32),
            "half": device.array("half", padded, np.float32),
            "coefficients": device.array("coefficients", padded, np.float32),
            "difference": device.given(
                "difference", np.zeros((2, rows + 2 * self._halo, columns + 2 * self._halo))
            ),
            "field": device.array("field", self.rest.shape, np.float32),
            "answer": device.array("answer", (AFFINE + 3, *self.grid), np.float32),
            "frame": device.array("frame", self.shape, reference.dtype),
        }
        self._fit_spline(reference)
        planes = self._planes(reference, self._maps["coefficients"].download())
        self._maps["planes"] = device.given("planes", planes)
        inverse, self.measured = self._invert_normals(planes)
        self._maps["inverse"] = device.given("inverse", inverse.transpose(1, 2, 0))
        # Information about the displacement, with all other parameters free.
        self.information: NDArray[Any] = np.linalg.inv(inverse[:, :2, :2]).reshape(*self.grid, 2, 2)
        self.usable: NDArray[np.bool_] = np.isfinite(self.information[..., 0, 0])
        trust = 1 / np.trace(inverse[:, :2, :2], axis1=1, axis2=2).reshape(self.grid)
        self._trust = np.nan_to_num(trust)
        self._trust += 1e-9 * self._trust.max() + np.finfo(float).tiny

    def _planes(self, reference: NDArray[Any], coefficients: NDArray[np.float32]) -> Doubles:
        """Return counts, derivatives and texture of the reference, padded."""
        counts = reference.astype(np.float64)
        if reference.dtype.kind == "u":
            counts[reference == np.iinfo(reference.dtype).max] = np.nan
        c = coefficients[MARGIN - 1 : 1 - MARGIN, MARGIN - 1 : 1 - MARGIN].astype(np.float64)
        along_x, along_y = c[:, 2:] - c[:, :-2], c[2:] - c[:-2]
        along_x = (along_x[:-2] + 4 * along_x[1:-1] + along_x[2:]) / 12
        along_y = (along_y[:, :-2] + 4 * along_y[:, 1:-1] + along_y[:, 2:]) / 12
        known = np.isfinite(counts)
        filled = np.where(known, counts, 0.0)
        size = (self._window, self._window)
        mean = cv2.blur(filled, size) / np.maximum(cv2.blur(known.astype(np.float64), size), 1e-9)
        parts = [along_x, along_y, filled - mean]
        halo = self._halo
        rest = [np.pad(np.where(known, part, 0.0), halo) for part in parts]
        return np.stack([np.pad(counts, halo, constant_values=np.nan), *rest])

    def _invert_normals(self, planes: Doubles) -> tuple[Doubles, Doubles]:
        """Return the inverse normal matrix of each node, and its number of samples."""
        rows, columns = self.grid
        first = self._halo + self._first
        normals = np.empty((rows, columns, PARAMETERS, PARAMETERS))
        for row in range(rows):
            part = basis(windows(planes, row, self.step, first, self._window, columns), self._window)
            normals[row] = part.transpose(0, 2, 1) @ part
        measured = normals[..., AFFINE, AFFINE].copy()
        normal = normals.reshape(-1, PARAMETERS, PARAMETERS)
        scale = np.sqrt(np.einsum("nii->ni", normal))
        usable = ((scale > 0) & np.isfinite(scale)).all(axis=1)
        scale[~usable], normal[~usable] = 1, np.eye(PARAMETERS)
        normal /= scale[:, :, None] * scale[:, None, :]
        usable &= np.linalg.eigvalsh(normal)[:, 0] > 1e-5  # singular otherwise, within rounding
        normal[~usable] = np.eye(PARAMETERS)
        inverse = np.linalg.inv(normal) / (scale[:, :, None] * scale[:, None, :])
        inverse[~usable] = np.nan
        return inverse, measured

    def _fit_spline(self, frame: NDArray[Any]) -> None:
        """Compute the coefficients of a frame's spline on the device."""
        maps, (rows, columns) = self._maps, self.shape
        _write(maps["frame"], frame)
        width = columns + 2 * MARGIN
        pixels = width * (rows + 2 * MARGIN)
        items = math.ceil(pixels / self._tile)
        self._launch("pad", items, rows=rows, columns=columns, frame=maps["frame"], padded=maps["padded"])
        for step, source, filtered in ((1, "padded", "half"), (width, "half", "coefficients")):
            self._launch(
                "filter", items, pixels=pixels, step=step, source=maps[source], filtered=maps[filtered]
            )

    def follow(self, frame: NDArray[Any], field: Doubles) -> tuple[NodeField, Doubles]:
        """Return the displacement of a frame, starting from a field, and the final field."""
        self._fit_spline(frame)
        for _ in range(ITERATIONS):
            answer = self._solve(field)
            last, field = field, self._next_field(field, answer[:AFFINE])
            if np.quantile(np.abs(field - last), _MOST) < _SETTLED:
                break
        moved = answer[:2]
        gain, squares, variances = answer[AFFINE:]
        with np.errstate(invalid="ignore", divide="ignore"):
            # The reference's noise is multiplied by the gain.
            variances += (gain**2 - 1) * self.measured
            variance = squares / (variances * (1 - PARAMETERS / self.measured))
            found = (np.abs(moved - last).max(axis=0) < 0.5) & (gain > _LIKE)
        return NodeField(moved, variance, found), field

    def _solve(self, field: Doubles) -> Doubles:
        """Warp the frame back by a field, and solve all windows."""
        maps, (rows, columns), (node_rows, node_columns) = self._maps, self.shape, self.grid
        _write(maps["field"], field)
        sizes = {"rows": rows, "columns": columns, "node_rows": node_rows, "node_columns": node_columns}
        sizes |= {"step": self.step, "halo": self._halo}
        shared = {name: maps[name] for name in ("planes", "field", "difference")}
        items = rows * math.ceil(columns / self._tile)
        self._launch("warp", items, **sizes, **shared, start=self.start, coefficients=maps["coefficients"])
        arrays = {"inverse": maps["inverse"], "answer": maps["answer"]}
        first = self._first + self._halo
        self._launch("solve", node_rows * node_columns, **sizes, **shared, first=first, **arrays)
        return maps["answer"].download().astype(np.float64)

    def _next_field(self, field: Doubles, affine: Doubles) -> Doubles:
        """Return the field of all windows, each weighted by how well its movement is determined.

        Each window predicts the displacement of its neighbours, (6, rows, columns), so that an affine field
        remains affine and continues where windows leave the picture. Far from all windows, the field is kept.
        """
        known = np.isfinite(affine[0])
        weight = np.where(known, self._trust, 0.0)
        hold = _HOLD * np.median(self._trust)
        y, x = np.meshgrid(*(2 * self.step / self._window * np.arange(n) for n in self.grid), indexing="ij")
        total = self._over_nodes(weight) + hold
        parts = []
        for own, centre, right, down in zip(field, affine[:2], affine[2::2], affine[3::2], strict=True):
            step = np.clip(np.nan_to_num(centre - own), -_FARTHEST, _FARTHEST)
            along_x, along_y = (weight * np.clip(np.nan_to_num(part), -1, 1) for part in (right, down))
            here = weight * (own + step) - along_x * x - along_y * y
            there = self._over_nodes(along_x) * x + self._over_nodes(along_y) * y
            parts.append((self._over_nodes(here) + there + hold * own) / total)
        return np.stack(parts)

    def _over_nodes(self, values: Doubles) -> Doubles:
        smooth = cv2.sepFilter2D(values, cv2.CV_64F, _KERNEL, _KERNEL, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(smooth, np.float64)

    def at_nodes(self, field: Doubles, level: _Level, scale: float) -> Doubles:
        """Return a field of another level's nodes at those of this one, with pixels larger by a scale."""
        if level is self:
            return field
        places = [(self.start + self.step * np.arange(n)) * scale for n in self.grid]
        rows, columns = ((place - level.start) / level.step for place in places)
        where = np.meshgrid(rows, columns, indexing="ij")
        parts = [map_coordinates(part, where, order=1, mode="nearest") / scale for part in field]
        return np.stack(parts)

    def _launch(self, name: str, items: int, **arguments: Any) -> None:
        macros: dict[str, str | int] = {"FRAME": self._frame_type, "WINDOW": self._window, "TILE": self._tile}
        moved = sum(array.nbytes for array in arguments.values() if isinstance(array, Array))
        self._device.kernel("displacement", f"displacement_{name}", **macros)(items, **arguments, moved=moved)


def _cubic(values: Doubles, places: Doubles, axis: int) -> Doubles:
    """Return values along an axis at places between them: Keys' cubic, straight at the ends."""
    last = values.shape[axis] - 1
    before = np.clip(np.floor(places).astype(int), 0, max(last - 1, 0))
    t = places - before
    bend = np.where((before > 0) & (before < last - 1), t * (1 - t) / 2, 0.0)
    weights = [-bend * (1 - t), 1 - t + bend * (2 - 3 * t), t + bend * (3 * t - 1), -bend * t]
    taps = [np.clip(before + k, 0, last) for k in (-1, 0, 1, 2)]
    shape = [-1 if one == axis else 1 for one in range(values.ndim)]
    parts = [
        weight.reshape(shape) * values.take(tap, axis) for weight, tap in zip(weights, taps, strict=True)
    ]
    return np.asarray(sum(parts))


def _write(array: Array, values: NDArray[Any]) -> None:
    array.claim()
    array.host[...] = values
    array.upload()
