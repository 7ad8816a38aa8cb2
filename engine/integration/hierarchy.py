"""The levels of a multigrid on a device: grids of nodes with links, each half as fine as the previous one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mirrorskin.engine.integration.graph import Links
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.device import Device, Kernel
from mirrorskin.kernels.integration.multigrid import COARSEST, ROUNDS

Ints = NDArray[np.int64]

STRENGTH = 0.25
"""Relative weight from which a link joins its nodes in one aggregate; see ``multigrid_parts``."""

LANES = 16, 8, 4
"""Numbers of right sides that can be solved at once."""

_VECTOR = 16  # the length of a row is a multiple of it: two of a kernel's vectors
_BEFORE = _VECTOR  # nodes before the first level, which vectors at its left margin may read
_WIDE_TILE_MEMORY = 45056  # bytes of local memory needed; OpenCL guarantees only 32768
_TAIL_GROUP = 512  # work-items of the group that processes several levels
_TAIL_MEMORY = 49152  # maximum local memory of that group, bytes
_TAIL_NODES = 20480  # maximum nodes times lanes of the finest of these, with heights in global memory
_SUM_GROUP = 128  # work-items of a group that sums a part, which all GPUs support
_BEYOND = 64  # nodes after the last level, which vectors may read


@dataclass(frozen=True, slots=True)
class Level:
    """A grid of nodes among others in one array; see ``kernels/integration/multigrid.cl``."""

    base: int  # index of its start
    rows: int
    columns: int
    stride: int  # nodes from one row to the next

    @classmethod
    def at(cls, base: int, rows: int, columns: int) -> Level:
        """Return a level that starts at an index."""
        return cls(base, rows, columns, -(-columns // _VECTOR) * _VECTOR)

    @property
    def nodes(self) -> int:
        """Number of nodes in its rows, including the margins on their right."""
        return self.rows * self.stride

    @property
    def first(self) -> int:
        """Index of its first node."""
        return self.base + self.stride

    @property
    def end(self) -> int:
        """Index of its end."""
        return self.base + (self.rows + 2) * self.stride

    @property
    def place(self) -> dict[str, int]:
        """Arguments of kernels for the level."""
        return {"base": self.base, "rows": self.rows, "stride": self.stride}


def cut_levels(shape: tuple[int, int]) -> list[Level]:
    """Return a picture's levels, the finest first; the last one has at most `COARSEST` nodes."""
    levels = [Level.at(_BEFORE, *shape)]
    while levels[-1].nodes > COARSEST:
        fine = levels[-1]
        levels.append(Level.at(fine.end, -(-fine.rows // 2), -(-fine.columns // 2)))
    return levels


class Hierarchy:
    """All levels of a graph.

    ``graph`` contains the links of the nodes, and the weights of known heights as ``anchor`` (see
    ``kernels/integration/multigrid.cl``). ``inverse`` is the inverse of the diagonal, which cycles compute
    for large levels when they are prepared. ``to`` marks nodes that belong to the aggregate of another block.
    ``moves`` is the number of aggregates of each level that differ from blocks for this reason, and
    ``changed`` lists them; ``changes`` are the same numbers on the device.
    """

    device: Device
    anchored: bool
    to: Array
    changed: Array
    changes: Array

    def __init__(self, shape: tuple[int, int], anchored: bool, device: Device) -> None:
        self.device, self.anchored = device, anchored
        self._kernels: dict[tuple[str, int, int, bool], Kernel] = {}
        self.levels: list[Level] = cut_levels(shape)
        self.nodes: int = self.levels[-1].end + _BEYOND
        places = [[*level.place.values()] for level in self.levels]
        self.table: Array = device.from_host("levels", np.array(places), np.int32)
        self.graph: dict[str, Any] = {
            name: self.array(name) for name in ("right", "down", "falling", "rising")
        }
        self.graph["anchor"] = self.array("anchor") if anchored else device.from_host("anchor", [])
        self.inverse: Array = self.array("inverse")
        self.matrix: Array = self.array("inverse matrix", self.levels[-1].nodes ** 2)
        self._parts, self._proposed, self.to = (
            self.array(name, dtype=np.uint8) for name in ("parts", "proposed", "to")
        )
        self._touched, self.changed = (self.array(name, dtype=np.int32) for name in ("touched", "changed"))
        self.moves: NDArray[np.int32] = np.zeros(len(self.levels), np.int32)
        self._splits, self._counts, self.changes = (
            self.array(name, len(self.levels), dtype=np.int32) for name in ("splits", "moves", "changes")
        )

    def array(
        self, name: str, size: int | None = None, *, dtype: DTypeLike = np.float32, lanes: int = 1
    ) -> Array:
        """Return an array on the device, by default of all nodes, (size,) or (size, lanes)."""
        shape = (size or self.nodes,) if lanes == 1 else (size or self.nodes, lanes)
        return self.device.array(name, shape, dtype)

    def build(self, links: Links, *, plain: bool = False, strength: float = STRENGTH) -> None:
        """Build the levels of a graph of this shape.

        ``plain``: each block of 2 x 2 nodes is an aggregate. Otherwise, nodes of a block share an aggregate
        if they are connected by links of at least ``strength``, relative to the geometric mean of the largest
        weights of both nodes along the same axis.
        """
        self._admit_graph(links)
        for numbers in (self._splits, self._counts, self.changes):
            numbers.fill()
        arguments: dict[str, Any] = {"strength": strength, **self.graph}
        arguments |= {"parts": self._parts, "touched": self._touched, "splits": self._splits}
        tail = self.first_of_tail(1)
        for number in range(tail):
            if not plain:
                self.between("parts", number, **arguments, level=number)
            for turn in range(0 if plain else ROUNDS):
                old, new = (self._proposed, self.to)[:: 1 if turn % 2 else -1]
                ends = {"clear": turn < 2, "first_round": turn == 0, "last_round": turn == ROUNDS - 1}
                counts: dict[str, Any] = {"level": number, "moves": self._counts}
                self.between("move", number, **arguments, **ends, to=old, places=new, **counts)
            self._coarsen(number)
        self._build_tail(tail, plain=plain, strength=strength)
        self.moves[...] = 0 if plain else self.changes.read()

    def follow(self, links: Links | None, *, deep: bool) -> None:
        """Update a plain hierarchy for a similar graph, without copies to the host.

        ``links``: None if they are in place.
        Unless ``deep``, only the finest level is updated. Cycles must be prepared again.
        """
        if links is not None:
            self._admit_graph(links)
        tail = self.first_of_tail(1)
        if deep:
            for number in range(tail):
                self._coarsen(number)
            self._build_tail(tail, plain=True)

    def equations(self, number: int) -> tuple[Ints, Ints, Ints, Doubles, Doubles]:
        """Return a level's nodes, both ends and weights of its links, and the anchor of each node."""
        level = self.levels[number]
        rows = slice(level.first, level.end - level.stride)
        node = np.arange(rows.start, rows.stop)
        steps = {"right": 1, "down": level.stride}
        if self.links_of(level) == 8:
            steps |= {"falling": level.stride + 1, "rising": level.stride - 1}
        ends, weights = [], []
        for name, step in steps.items():
            weight = self.graph[name].read(rows)
            ends.append(node[weight > 0] + np.array([[0], [step]]))
            weights.append(weight[weight > 0].astype(np.float64))
        pull = np.zeros(len(node))
        if self.anchored:
            pull[...] = self.graph["anchor"].read(rows)
        a, b = np.concatenate(ends, axis=1)
        return node, a, b, np.concatenate(weights), pull

    def kernel(self, name: str, links: int, lanes: int = 1, *, once: bool = True) -> Kernel:
        """Return a kernel for a number of links of a node, and of right sides.

        ``once``: for levels that are visited once, where a GPU does one more step per half cycle.
        """
        kernel = self._kernels.get((name, links, lanes, once))
        if kernel is None:
            kernel = self._kernels[name, links, lanes, once] = self._build_kernel(name, links, lanes, once)
        return kernel

    def _build_kernel(self, name: str, links: int, lanes: int, once: bool) -> Kernel:
        width = 8 if self.device.layout.tile > 1 and lanes == 1 else 1
        macros = {"ANCHORED": int(self.anchored), "LINKS": links, "PART": part_of(self.device)}
        macros |= {"ROWS": tile_rows(self.device, lanes), "COLUMNS": tile_columns(self.device, lanes)}
        macros |= {"WIDTH": width, "LANES": lanes}
        macros |= {
            "GROUP": tail_group(self.device),
            "SUMS": sum_group(self.device),
            "COARSEST": COARSEST,
            "ROUNDS": ROUNDS,
        }
        macros |= {
            "NEAR_NODES": near_nodes(self.device, lanes),
            "STEPS": 3 + (once and near_nodes(self.device, 1) > 0),
        }
        return self.device.kernel("multigrid", f"multigrid_{name}", **macros)

    def places(self, number: int) -> dict[str, int]:
        """Return arguments of kernels between a level and the next coarser one."""
        fine, coarse = self.levels[number : number + 2]
        return {**fine.place, **place_of_coarse(coarse)}

    def links_of(self, level: Level) -> int:
        """Return the number of links that a level's nodes may have."""
        return 8 if level is not self.levels[0] and self.moves.any() else 4

    def over(self, name: str, level: Level, *, lanes: int = 1, **arguments: Any) -> None:
        """Run a kernel for the nodes of a level."""
        items = -(-level.nodes // self.device.layout.tile)
        kernel = self.kernel(name, self.links_of(level), lanes)
        kernel(items, **level.place, **arguments, moved=_bytes(level, arguments))

    def between(self, name: str, number: int, **arguments: Any) -> None:
        """Run a kernel for the aggregates of a level, which are the nodes of the next one."""
        fine, coarse = self.levels[number : number + 2]
        items = coarse.rows * -(-fine.stride // 2 // self.device.layout.tile)
        kernel = self.kernel(name, 8 if number else 4)
        kernel(items, **self.places(number), **arguments, moved=_bytes(fine, arguments))

    def gather(self, number: int, residual: Array, b: Array, lanes: int) -> None:
        """Sum the residual over the aggregates of a level that differ from blocks."""
        if count := int(self.moves[number]):
            items = -(-count // max(1, self.device.layout.tile // 16))
            arguments: dict[str, Any] = {"to": self.to, "changed": self.changed, "count": count}
            arguments |= {"residual": residual, "coarse_b": b}
            self.kernel("gather", 4, lanes)(items, **self.places(number), **arguments, moved=80 * count)

    def alone(self, name: str, level: Level, links: int = 4, **arguments: Any) -> None:
        """Run a kernel in one work-group, mostly on a level."""
        kernel = self.kernel(name, links)
        kernel(kernel.group, **arguments, moved=_bytes(level, arguments))

    def over_parts(self, name: str, parts: Array, *, lanes: int = 1, **arguments: Any) -> None:
        """Run a reduction over the finest level; ``parts`` receives the partial sums."""
        level = self.levels[0]
        count = -(-level.nodes // part_of(self.device))
        kernel = self.kernel(name, 4, lanes)
        items = count * sum_group(self.device)
        kernel(items, **level.place, **arguments, parts=parts, moved=_bytes(level, arguments))

    def copy_picture(self, name: str, level: Array, map_: Array, *, lanes: int = 1, **arguments: Any) -> None:
        """Copy a map of pixels to the finest level ("admit"), or back ("release")."""
        finest = self.levels[0]
        sizes = {**finest.place, "columns": finest.columns}
        items = finest.rows * -(-finest.columns // self.device.layout.tile)
        kernel = self.kernel(name, 4, lanes)
        kernel(items, **sizes, level=level, map=map_, **arguments, moved=8 * lanes * finest.nodes)

    def _admit_graph(self, links: Links) -> None:
        arrays = {name: self.graph[name] for name in ("right", "down")}
        if links.anchor is not None:
            arrays |= {"anchors": links.anchor, "anchor": self.graph["anchor"]}
        self.copy_picture("admit_graph", links.right, links.down, **arrays)

    def _coarsen(self, number: int) -> None:
        coarse = {f"coarse_{name}": array for name, array in self.graph.items()}
        moves = {"to": self.to, "touched": self._touched, "level": number, "moves": self._counts}
        moves |= {"changed": self.changed, "changes": self.changes}
        self.between("coarsen", number, **self.graph, **moves, **coarse)

    def _build_tail(self, tail: int, *, plain: bool, strength: float = STRENGTH) -> None:
        """Build the levels after a given one, in one work-group."""
        arguments: dict[str, Any] = {"from": tail, "last": len(self.levels) - 1, "levels": self.table}
        arguments |= {"plain": plain, "strength": strength, **self.graph, "inverse": self.inverse}
        arguments |= {
            "parts": self._parts,
            "proposed": self._proposed,
            "to": self.to,
            "touched": self._touched,
        }
        arguments |= {"splits": self._splits, "moves": self._counts}
        arguments |= {"changed": self.changed, "changes": self.changes, "matrix": self.matrix}
        self.alone("build", self.levels[tail], 8, **arguments)

    def first_of_tail(self, lanes: int) -> int:
        """Return the number of the finest level that one work-group processes with all coarser ones."""
        near, end = near_nodes(self.device, lanes), self.levels[-1].end
        return next(
            number
            for number, level in enumerate(self.levels)
            if number == len(self.levels) - 1
            or (number and (end - level.base + 2 <= near if near else level.nodes <= _TAIL_NODES // lanes))
        )


def place_of_coarse(coarse: Level) -> dict[str, int]:
    """Return the arguments of kernels that describe the coarser level."""
    return {f"coarse_{name}": number for name, number in coarse.place.items()}


def tile_columns(device: Device, lanes: int) -> int:
    """Return the number of columns of a work-group's tile in half a cycle."""
    if device.layout.tile == 1:
        return 32
    return 128 if lanes == 1 and device.context.devices[0].local_mem_size >= _WIDE_TILE_MEMORY else 64


def tile_rows(device: Device, lanes: int) -> int:
    """Return the number of rows of a work-group's tile."""
    return 16 if device.layout.tile == 1 and lanes > 1 else 32


def tail_group(device: Device) -> int:
    """Return the number of work-items of the group that processes all small levels."""
    lanes = min(_TAIL_GROUP, device.context.devices[0].max_work_group_size)
    return lanes if device.layout.tile == 1 else 1


def near_nodes(device: Device, lanes: int) -> int:
    """Return the number of nodes whose heights the group of the small levels keeps in local memory."""
    if device.layout.tile > 1 or lanes > 1:
        return 0
    return min(int(device.context.devices[0].local_mem_size), _TAIL_MEMORY) // 8 - 16


def choose_lanes(device: Device, sides: int) -> int:
    """Return the number of right sides to solve at once: as many as the local memory allows."""
    if sides == 1:
        return 1
    local_memory = device.context.devices[0].local_mem_size
    return next(
        lanes
        for lanes in LANES
        if lanes == LANES[-1]
        or (
            lanes < 2 * sides
            and 8 * lanes * (tile_rows(device, lanes) + 9) * (tile_columns(device, lanes) + 9) <= local_memory
        )
    )


def part_of(device: Device) -> int:
    """Return the number of nodes of a partial sum."""
    return 4096 if device.layout.tile > 1 else 2048


def sum_group(device: Device) -> int:
    """Return the number of work-items that add up a part together."""
    return 1 if device.layout.tile > 1 else _SUM_GROUP


def _bytes(level: Level, arguments: dict[str, Any]) -> int:
    """Return the bytes of a level in all arrays."""
    arrays = [value for value in arguments.values() if isinstance(value, Array)]
    return sum(min(array.nbytes, 4 * level.nodes) for array in arrays)
