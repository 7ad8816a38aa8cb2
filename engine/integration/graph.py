"""The graph of an integration: pixels, links between neighbours, and connected components."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mirrorskin.engine.integration.device_inputs import sample_grid
from mirrorskin.engine.integration.validation import Flags, Inputs
from mirrorskin.kernels.array import Array, Operand
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.integration.links import DOWN, KNOWN, RIGHT, SLOPE

Labels = NDArray[np.int32]
Plane = tuple[float, float, float]
"""Slopes along x and y, and the height of the top left pixel, mm."""

LEVEL: Plane = (0.0, 0.0, 0.0)
_CHUNK, _STRIP = 256, 16  # columns and rows of a work-item on a CPU; see links.cl, components.cl
_SAMPLES = 64  # samples along each side of the picture for the mean slope
_PARTIAL_SUMS = 64  # maximum number of partial sums of a component; four times as many for work-groups
_FEW = 64  # number of components up to which a work-group sums one component, reading the picture for each
_MOST_SUMS = 1 << 22  # maximum number of partial sums of all components


@dataclass(frozen=True, slots=True)
class Links:
    """The normal equations A u = b of a weighted least-squares problem on the pixels' graph, on the device.

    The sum is that of w (u_j - u_i - d)^2 over links and a (u_i - k_i)^2 over known heights.
    """

    device: Device
    shape: tuple[int, int]  # rows and columns
    # (H, W), float32: weight w of the link to the next pixel on the right, and to the one below; 0 if none.
    right: Array
    down: Array
    anchor: Array | None  # (H, W), float32: weight a of a known height, 0 if none; None if there are none
    # (H, W), float32: right side b: at each pixel the sum of -w d over links that start there, of w d over
    # links that end there, and of a k.
    source: Array


class PixelGraph:
    """A picture's maps and links on a device; memory is reused for the next picture.

    ``flags`` is the state of each pixel (see ``kernels/integration/links.py``). ``known_heights`` are the
    maps of heights above the inputs' datum and of their weights, if any. Weights are multiplied by
    ``scale``, so that they are about 1.
    """

    device: Device
    shape: tuple[int, int]

    def __init__(self, device: Device, shape: tuple[int, int]) -> None:
        self.device, self.shape = device, shape
        self.known_heights: Mapping[str, Operand] = {}
        self._arrays: dict[str, Array] = {}

    def upload(self, inputs: Inputs) -> Flags:
        """Copy maps to the device; return the flags."""
        slopes = self._share(dz_dx=inputs.dz_dx, dz_dy=inputs.dz_dy)
        weights = self._share(map_x=inputs.weight_x, map_y=inputs.weight_y)
        heights = self._share(heights=inputs.known_heights, height_weights=inputs.known_height_weights)
        mask, edges = self._share(mask=inputs.mask), self._share(edges=inputs.edges)
        self._use(inputs, slopes, weights, heights, mask, edges)
        self._read_flags: Flags = self.flags.read()
        return self._read_flags

    def use_device_maps(self, inputs: Inputs) -> None:
        """Use the slopes and weights in this graph's arrays; the inputs' maps are not read."""
        slopes = {name: self.array(name) for name in ("dz_dx", "dz_dy")}
        self._use(inputs, slopes, {name: self.array(name) for name in ("map_x", "map_y")})

    def _use(
        self,
        inputs: Inputs,
        slopes: Mapping[str, Operand],
        weights: Mapping[str, Operand],
        heights: Mapping[str, Operand] | None = None,
        mask: Mapping[str, Operand] | None = None,
        edges: Mapping[str, Operand] | None = None,
    ) -> None:
        self._inputs, self._slopes, self._weights = inputs, slopes, weights
        self.known_heights = heights or {}
        self.scale: float = inputs.pixel_size[0] * inputs.pixel_size[1] / inputs.typical_weight
        self.flags: Array = self.array("flags", np.uint8)
        uncut = self.array("uncut", np.uint8) if edges else self.flags
        maps = {**slopes, **(mask or {}), **weights, **self.known_heights}
        self._run("links_flags", {"MASK": int(bool(mask))}, **maps, flags=uncut)
        if edges:
            self._run("links_cut", {"MASK": int(bool(mask))}, **slopes, **edges, flags=uncut, cut=self.flags)

    def set_slopes(self, inputs: Inputs) -> None:
        """Replace the slopes, and keep weights and flags."""
        self._inputs, self._slopes = inputs, self._share(dz_dx=inputs.dz_dx, dz_dy=inputs.dz_dy)

    def mean_plane(self, inputs: Inputs) -> Plane:
        """Return the plane of the mean slopes, 0 in the middle; heights above it have more digits."""
        steps = [-(-size // _SAMPLES) for size in self.shape]
        subset = tuple(slice(step // 2, None, step) for step in steps)
        valid = self._read_flags[subset] & SLOPE != 0
        if not valid.any():
            return LEVEL
        slopes = (
            sample_grid(slope, *steps) if isinstance(slope, Array) else slope[subset]
            for slope in (inputs.dz_dx, inputs.dz_dy)
        )
        x, y = (float(slope[valid].mean()) for slope in slopes)
        along_x, along_y, _ = self.steps((x, y, 0.0))
        return x, y, -(along_x * (self.shape[1] - 1) + along_y * (self.shape[0] - 1)) / 2

    def steps(self, plane: Plane) -> Plane:
        """Return the rise of a plane per column and per row, and its height at the first pixel, mm."""
        width, height = self._inputs.pixel_size
        return plane[0] * width, -plane[1] * height, plane[2]

    def links(self, plane: Plane = LEVEL) -> Links:
        """Return the normal equations of heights above a plane."""
        maps = {name: self.array(name) for name in ("right", "down", "source")}
        if self.known_heights:
            maps["anchor"] = self.array("anchor")
        self._join(plane, maps)
        return Links(self.device, self.shape, maps["right"], maps["down"], maps.get("anchor"), maps["source"])

    def put_source(self, plane: Plane, sources: Array, number: int) -> None:
        """Write only the right side, to ``sources``, (K, H, W), at a number."""
        rows, columns = self.shape
        self._join(plane, {"source": sources}, number * rows * columns)

    def put_links(self, maps: Mapping[str, Array], start: int, stride: int) -> None:
        """Write ``right``, ``down`` and ``source`` in rows that are ``stride`` apart, from ``start`` on."""
        self._join(LEVEL, maps, start, stride)

    def _join(
        self, plane: Plane, maps: Mapping[str, Array], start: int = 0, stride: int | None = None
    ) -> None:
        rows = {"start": start, "stride": stride or self.shape[1]}
        self._run("links_join", {"KEEP": int(len(maps) > 1)}, **self._problem(plane, None), **maps, **rows)

    def misfit(
        self, reliefs: Array, plane: Plane = LEVEL, links: Links | None = None, number: int = 0
    ) -> float:
        """Return the least-squares sum, without unit, for heights above a plane: ``reliefs`` at an index."""
        layout = self.device.layout
        group = layout.group if layout.tile == 1 else 1
        sums = self.array("sums", shape=(-(-self._items("links_misfit") // group),))
        macros = {"GROUP": group} if links is None else {"GROUP": group, "WEIGHTS": 3}
        problem = self._problem(plane, links)
        self._run("links_misfit", macros, **problem, reliefs=reliefs, place=number, sums=sums)
        return float(sums.read().sum(dtype=np.float64)) / self.scale

    def _problem(self, plane: Plane, links: Links | None) -> dict[str, Any]:
        """Return the arguments of the kernels for links."""
        inputs = self._inputs
        width, height = inputs.pixel_size
        weights, maps = [self.scale * inputs.weight / size**2 for size in (width, height)], self._weights
        if links is not None:
            weights, maps = [1.0, 1.0], {"map_x": links.right, "map_y": links.down}
        numbers = {"weight_x": weights[0], "weight_y": weights[1], "size_x": width, "size_y": height}
        numbers |= {"weight_z": self.scale * inputs.known_height_weight}
        numbers |= dict(zip(("plane_x", "plane_y", "plane_z"), plane, strict=True))
        return {**self._slopes, "flags": self.flags, **maps, **self.known_heights, **numbers}

    def put(self, name: str, values: NDArray[Any]) -> Array:
        """Return one of the graph's arrays, with values, (H, W)."""
        array = self.array(name, values.dtype)
        array.write(values)
        return array

    def _share(self, **maps: NDArray[Any] | None) -> dict[str, Operand]:
        """Return maps for the device: in place if it shares the host's memory, else in the graph's arrays."""
        borrow = self.device.borrow if self.device.info.shares_memory else lambda name, values: None
        return {
            name: values if isinstance(values, Array) else borrow(name, values) or self.put(name, values)
            for name, values in maps.items()
            if values is not None
        }

    def array(self, name: str, dtype: DTypeLike = np.float32, shape: tuple[int, ...] | None = None) -> Array:
        """Return one of the graph's arrays, (H, W) by default."""
        if name not in self._arrays:
            self._arrays[name] = self.device.array(name, shape or self.shape, dtype)
        return self._arrays[name]

    def _items(self, name: str) -> int:
        """Return the number of work-items of a kernel; see ``kernels/integration/links.cl``."""
        (rows, columns), tile = self.shape, self.device.layout.tile
        strip = _STRIP if tile >= _CHUNK and name in ("links_flags", "links_join", "links_misfit") else 1
        return -(-rows // strip) * -(-columns // min(tile, _CHUNK))

    def _run(self, name: str, macros: dict[str, int], **arguments: Any) -> None:
        counts = {"WEIGHTS": len(self._weights), "HEIGHTS": len(self.known_heights)}
        kernel = self.device.kernel("links", name, **{"MASK": 0, "KEEP": 0, **counts, **macros})
        moved = sum(operand.nbytes for operand in arguments.values() if isinstance(operand, Operand))
        rows, columns = self.shape
        kernel(self._items(name), rows=rows, columns=columns, **arguments, moved=moved)


@dataclass(frozen=True, slots=True)
class Components:
    """The connected components of a surface."""

    labels: Labels  # (H, W), int32: numbered in reading order of the first pixels; -1 without an answer
    offset_unknown: NDArray[np.bool_]  # (components,): whether a component has no known height

    @property
    def count(self) -> int:
        """Number of components."""
        return len(self.offset_unknown)


def _extent(used: NDArray[np.bool_]) -> slice:
    """Return the part of an axis from the first to the last used place; one place if none is used."""
    places = np.flatnonzero(used)
    return slice(places[0], places[-1] + 1) if len(places) else slice(0, 1)


def find_components(flags: Flags, by_links: bool) -> Components:
    """Label connected pixels. ``by_links``: neighbours with an answer may have no link."""
    import cv2

    answered = flags & (SLOPE | KNOWN) != 0
    used = tuple(_extent(answered.any(axis=axis)) for axis in (1, 0))
    labels = np.full(flags.shape, -1, np.int32)
    grid, part = answered[used].view(np.uint8), flags[used]
    if by_links:  # links between the pixels
        links = np.zeros((2 * grid.shape[0] - 1, 2 * grid.shape[1] - 1), np.uint8)
        links[::2, ::2] = grid
        links[::2, 1::2], links[1::2, ::2] = part[:, :-1] & RIGHT, part[:-1] & DOWN
        grid = links
    count, numbers = cv2.connectedComponents(grid, connectivity=4)
    step = 2 if by_links else 1
    np.subtract(numbers[::step, ::step], 1, out=labels[used])
    count -= 1
    unknown = np.ones(count, bool)
    unknown[labels[flags & KNOWN != 0]] = False
    for array in (labels, unknown):  # shared by the surfaces of several frames
        array.flags.writeable = False
    return Components(labels, unknown)


class Levelling:
    """Adds the plane to heights above it, and to each component its offset.

    The mean of a component without a known height becomes 0. In other components, the weighted mean
    difference from the known heights becomes 0, because a solver converges slowly to it if the weights are
    small.
    """

    def __init__(self, graph: PixelGraph) -> None:
        self._graph, self._device = graph, graph.device
        self._arrays: dict[str, Array] = {}
        self._components: Components | None = None

    def level(
        self,
        components: Components,
        reliefs: Array,
        planes: Sequence[Plane],
        datum: float = 0.0,
        on_device: bool = False,
    ) -> Any:
        """Return heights, mm, of one or several reliefs; known heights are relative to ``datum``.

        ``on_device``: as an array of the device instead of NumPy's.
        """
        graph, unknown = self._graph, components.offset_unknown
        if components is not self._components:
            self._unknown = self._device.from_host("unknown", unknown, np.uint8)
            if components.count > 1:
                graph.put("labels", components.labels)
        self._components = components
        offsets = self._array("offsets", unknown.shape)
        heights = self._device.array("levelled", reliefs.shape, np.float32, zeroed=False)
        rows, columns = graph.shape
        items = rows * -(-columns // min(self._device.layout.tile, _CHUNK))
        for number, plane in enumerate(planes):
            steps = dict(zip(("plane_x", "plane_y", "plane_z"), graph.steps(plane), strict=True))
            relief: dict[str, Any] = {"reliefs": reliefs, "place": number, **steps}
            if unknown.any():
                self._find_offsets(relief, {}, offsets, of_unknown=1, mean=0.0)
            if not unknown.all():
                self._find_offsets(relief, graph.known_heights, offsets, of_unknown=0, mean=datum)
            self._run("components_add_offsets", items, relief, offsets=offsets, heights=heights)
        return heights if on_device else heights.release()

    def _find_offsets(
        self,
        relief: dict[str, Any],
        maps: Mapping[str, Operand],
        offsets: Array,
        *,
        of_unknown: int,
        mean: float,
    ) -> None:
        """Write offsets that give components a mean height, or a mean difference from known ones, mm."""
        rows, count, layout = self._graph.shape[0], self._count, self._device.layout
        together = layout.group if layout.tile == 1 else 1
        group = together if count <= _FEW else 1
        max_strips = _PARTIAL_SUMS if layout.tile > 1 else 4 * _PARTIAL_SUMS if group > 1 else rows
        strip = max(-(-rows // max_strips), -(-rows * count // _MOST_SUMS))
        strips = -(-rows // strip)
        sums, totals = (self._array(name, (strips, count)) for name in ("sums", "totals"))
        height_maps = {"heights": None, "height_weights": None, **maps}
        sizes = {"strip": strip, "components": count}
        items = strips * (count * group if group > 1 else 1)
        self._run(
            "components_sum", items, relief, **height_maps, **sizes, sums=sums, totals=totals, group=group
        )
        high = np.float32(mean)
        self._device.kernel("components", "components_offsets", ONE=0, GROUP=together)(
            count * together, strips=strips, components=count, sums=sums, totals=totals,
            unknown=self._unknown, of_unknown=of_unknown, mean=high, mean_rest=mean - float(high),
            offsets=offsets, moved=2 * sums.nbytes,
        )  # fmt: skip

    @property
    def _count(self) -> int:
        return self._components.count if self._components else 0

    def _array(self, name: str, shape: tuple[int, ...]) -> Array:
        if name not in self._arrays or self._arrays[name].shape != shape:
            self._arrays[name] = self._device.array(name, shape, np.float32)
        return self._arrays[name]

    def _run(self, name: str, items: int, relief: dict[str, Any], group: int = 1, **arguments: Any) -> None:
        single = self._count == 1
        labels = self._graph.flags if single else self._graph.array("labels", np.int32)
        rows, columns = self._graph.shape
        kernel = self._device.kernel("components", name, ONE=int(single), GROUP=group)
        arguments |= {"flags": self._graph.flags, "labels": labels, **relief}
        kernel(items, rows=rows, columns=columns, **arguments, moved=8 * rows * columns)
