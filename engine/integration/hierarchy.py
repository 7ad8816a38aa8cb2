"""The levels of a multigrid on a device: their links, and the tables of split aggregates."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from mirrorskin.engine.integration.graph import Links
from mirrorskin.engine.integration.levels import Level, cut_levels
from mirrorskin.engine.integration.split_aggregates import (
    Ints,
    Lookup,
    Odd,
    Pairs,
    Picture,
    Step,
    join,
    nothing_odd,
    step_over,
)
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.device import Device, Kernel

WIDTH = 8
"""Nodes side by side in a kernel's vectors."""

_LEAST = 1e-12  # of a component's links: anchors that are weaker leave its offset free


@dataclass(frozen=True, slots=True)
class Rows:
    """Some rows of the tables of odd nodes, or some of these nodes.

    Attributes
    ----------
    at, count : int
        The first one, and how many.
    """

    at: int = 0
    count: int = 0


@dataclass(frozen=True, slots=True)
class OddRows:
    """What is odd at one level.

    Attributes
    ----------
    nodes : Rows
        The level's nodes without a place in its picture, up to a multiple of `WIDTH`.
    graph : Rows
        The level's own links, of all nodes that are odd or have odd links.
    restrict, prolong : Rows
        To the next level's odd blocks, and from them.
    """

    nodes: Rows = Rows()
    graph: Rows = Rows()
    restrict: Rows = Rows()
    prolong: Rows = Rows()


class Hierarchy:
    """All levels of a graph.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of the picture.
    anchored : bool
        Whether there are known heights.
    device : Device

    Attributes
    ----------
    levels : list of Level
    plain, nodes : int
        Nodes of all pictures, behind which the odd ones lie, and room for all of them.
    right, down, anchor, inverse : Array, float32
        Links, known heights' weights, and one over the diagonal; see ``kernels/multigrid.cl``.
    odd : list of OddRows
        One a level.
    table : tuple of Array
        Their rows' nodes, where each begins and the last ends, and of their entries the nodes and weights.
    bottom : (Array, Array)
        Nodes of the coarsest level, and the pseudo-inverse of its matrix.
    """

    def __init__(self, shape: tuple[int, int], anchored: bool, device: Device) -> None:
        self.device, self.anchored = device, anchored
        self.levels = cut_levels(shape)
        self.plain = self.nodes = self.levels[-1].end
        self.right = device.array("right", (self.plain,), np.float32)
        self.down = device.array("down", (self.plain,), np.float32)
        self._split = device.array("split", (self.plain,), np.float32)
        for array in (self.right, self.down, self._split):
            array.upload()
        self._allocate()
        self._lookup = Lookup(self.plain)
        self._nothing = self._table([])
        self.odd: list[OddRows] = []

    def build(self, links: Links, *, plain: bool = False) -> None:
        """Take a graph of this shape; a plain one joins all that a block of pixels has."""
        finest = self.levels[0]
        self._admit_graph(links)
        self._coarsen(range(1, len(self.levels)))
        self.odd, self.table = [OddRows() for _ in self.levels], self._nothing
        odd = nothing_odd()
        if not plain:
            split = self._split.download()
            odd = self._put_right(split) if split[finest.end :].any() else odd
            self._split.upload()
        self._invert()
        self.bottom = self._solve_bottom(odd)

    def follow(self, links: Links, *, deep: bool) -> None:
        """Take a graph that is nearly the one before, a plain one; nothing goes to the host.

        The coarsest level stays as it is; unless ``deep``, so do all but the finest.
        """
        self._admit_graph(links)
        if deep:
            self._coarsen(range(1, len(self.levels)))
            self._invert()
        else:
            self._invert_level(self.levels[0])

    def kernel(self, name: str) -> Kernel:
        """Return a pass."""
        width = WIDTH if self.device.layout.tile > 1 else 1
        macros = {"ANCHORED": int(self.anchored), "PART": part_of(self.device), "WIDTH": width}
        return self.device.kernel("multigrid", f"multigrid_{name}", **macros)

    def admit(self, map_: Array, to: Array) -> None:
        """Copy a map of pixels to the finest level."""
        self.kernel("admit")(*self.picture, map_, to, moved=8 * self.levels[0].nodes)

    @property
    def picture(self) -> tuple[int, np.int32, np.int32, np.int32]:
        """Items and arguments of the passes that copy whole pictures."""
        level = self.levels[0]
        return level.rows, np.int32(level.rows), np.int32(level.columns), np.int32(level.stride)

    @property
    def graph(self) -> tuple[Array, Array, Array]:
        """The links and anchors."""
        return self.right, self.down, self.anchor

    def _allocate(self) -> None:
        """Make room for whatever each node has, odd ones included."""
        self.anchor = self.device.array("anchor", (self.nodes if self.anchored else 1,), np.float32)
        self.inverse = self.device.array("inverse", (self.nodes,), np.float32)
        self.anchor.upload()
        self.inverse.upload()

    def _admit_graph(self, links: Links) -> None:
        """Copy links and anchors to the finest level."""
        self.admit(links.right, self.right)
        self.admit(links.down, self.down)
        if links.anchor is not None:
            self.admit(links.anchor, self.anchor)

    def _coarsen(self, numbers: Iterable[int]) -> None:
        kernel = self.kernel("coarsen")
        for number in numbers:
            fine, coarse = self.levels[number - 1], self.levels[number]
            kernel(
                coarse.rows, *pair(fine, coarse), *self.graph, *self.graph, self._split, moved=11 * fine.nodes
            )

    def _invert(self) -> None:
        for level in self.levels:
            self._invert_level(level)
        for rows in self.odd:
            self.run_odd("invert", rows.graph, self.anchor, self.inverse)

    def _invert_level(self, level: Level) -> None:
        items = -(-level.nodes // self.device.layout.tile)
        moved = 12 * level.nodes
        self.kernel("invert")(items, *place(level), *self.graph, self.inverse, moved=moved)

    def over_odd(self, name: str, odd: Rows, *args: Array) -> None:
        """Run a pass over odd nodes, a multiple of `WIDTH`, as if they were rows of a picture."""
        if odd.count:
            level = Level(odd.at - WIDTH, odd.count // WIDTH, WIDTH, WIDTH)
            items = -(-level.nodes // self.device.layout.tile)
            self.kernel(name)(items, *place(level), *args, moved=12 * odd.count)

    def run_odd(self, name: str, rows: Rows, *args: Array | np.generic) -> None:
        """Run a pass over rows of the tables."""
        if rows.count:
            arguments = np.int32(rows.at), np.int32(rows.count), *self.table, *args
            self.kernel(f"{name}_odd")(rows.count, *arguments, moved=64 * rows.count)

    def _put_right(self, split: NDArray[np.float32]) -> Odd:
        """Go through the levels again, and care for what is odd; return what is at the coarsest."""
        right, down = self.right.download(), self.down.download()
        odd, following = nothing_odd(), self.plain
        tables: list[dict[str, Pairs]] = [{} for _ in self.levels]
        places = [Rows() for _ in self.levels]
        changed = odd.node
        for number in range(1, len(self.levels)):
            fine, coarse = (Picture(level, right, down) for level in self.levels[number - 1 : number + 1])
            marked = np.flatnonzero(split[coarse.level.base : coarse.level.end]) + coarse.level.base
            step = step_over(fine, odd, changed, coarse, marked, following, self._lookup)
            changed = step.blocks
            tables[number - 1] |= {"restrict": step.restrict, "prolong": step.prolong}
            odd = step.odd
            room = -(-len(odd.node) // WIDTH) * WIDTH
            places[number] = Rows(following, room)
            following += room
            self._make_room(following)
            if self.anchored and len(step.blocks):
                self._put_anchors_right(step)
            tables[number]["graph"] = step.graph
        self.right.upload()
        self.down.upload()
        self._keep(tables, places)
        return odd

    def _make_room(self, nodes: int) -> None:
        if nodes > self.nodes:
            self.nodes = -(-(2 * nodes - self.plain) // 16) * 16
            known = self.anchor.download()
            self._allocate()
            self.anchor.claim()
            self.anchor.host[: len(known)] = known
            self.anchor.upload()

    def _put_anchors_right(self, step: Step) -> None:
        anchor = self.anchor.download()
        nodes, parts = step.members
        anchor[step.blocks] = anchor[step.odd.node] = 0
        np.add.at(anchor, parts, anchor[nodes])
        self.anchor.upload()

    def _keep(self, tables: list[dict[str, Pairs]], places: list[Rows]) -> None:
        """Bring the matrices of odd nodes to the device, one after the other."""
        parts: list[tuple[Pairs, Ints]] = []
        at = 0
        for level, named in enumerate(tables):
            rows = {}
            for name, pairs in named.items():
                sorted_ = pairs.by_rows()
                first = np.flatnonzero(np.diff(sorted_.a, prepend=-1))
                parts.append((sorted_, first))
                rows[name] = Rows(at, len(first))
                at += len(first)
            self.odd[level] = OddRows(places[level], **rows)
        self.table = self._table(parts)

    def _table(self, parts: list[tuple[Pairs, Ints]]) -> tuple[Array, Array, Array, Array]:
        """Return rows of sparse matrices, each with where its rows begin."""
        whole = join(nothing_odd().links, *(pairs for pairs, _ in parts))
        ends = np.cumsum([0, *(len(pairs.a) for pairs, _ in parts)])
        nodes = [pairs.a[first] for pairs, first in parts]
        starts = [first + at for (_, first), at in zip(parts, ends, strict=False)]
        return (
            self.device.given("nodes", np.concatenate([np.zeros(0), *nodes]), np.int32),
            self.device.given("starts", np.concatenate([*starts, ends[-1:]]), np.int32),
            self.device.given("columns", whole.b, np.int32),
            self.device.given("weights", whole.weight, np.float32),
        )

    def _solve_bottom(self, odd: Odd) -> tuple[Array, Array]:
        """Return the coarsest level's nodes, and the pseudo-inverse of its matrix."""
        level = self.levels[-1]
        picture = Picture(level, self.right.download(), self.down.download())
        anchor = self.anchor.download()
        plain = np.arange(level.first, level.end - level.stride)
        links = join(picture.rightward(plain), picture.downward(plain), odd.links)
        links = links.where(links.weight > 0)
        held = np.concatenate([plain, odd.node])
        held = held[anchor[held] > 0] if self.anchored else held[:0]
        node = np.unique(np.concatenate([links.a, links.b, held]))
        a, b = np.searchsorted(node, links.a), np.searchsorted(node, links.b)
        matrix = np.zeros((len(node), len(node)))
        np.subtract.at(matrix, (a, b), links.weight)
        matrix += matrix.T
        matrix[np.diag_indices_from(matrix)] = -matrix.sum(axis=1) + (anchor[node] if self.anchored else 0)
        for array in (self.right, self.down, self.anchor):
            array.upload()
        inverse = _pseudo_inverse(matrix, anchor[node] if self.anchored else np.zeros(len(node)))
        return self.device.given("bottom", node, np.int32), self.device.given(
            "pseudo-inverse", inverse, np.float32
        )


def part_of(device: Device) -> int:
    """Return how many nodes a part of a sum has."""
    return 4096 if device.layout.tile > 1 else 64


def place(level: Level) -> tuple[np.int32, np.int32, np.int32]:
    """Return the arguments that tell where a level lies."""
    return np.int32(level.base), np.int32(level.rows), np.int32(level.stride)


def pair(fine: Level, coarse: Level) -> tuple[np.int32, ...]:
    """Return the arguments that tell where two levels lie."""
    numbers = fine.base, fine.stride, coarse.base, coarse.rows, coarse.stride
    return tuple(np.int32(number) for number in numbers)


def _pseudo_inverse(matrix: NDArray[np.float64], anchor: NDArray[np.float64]) -> NDArray[np.float64]:
    """Invert a matrix whose components' offsets are free, but for those that have an anchor."""
    count, label = connected_components(matrix != 0, directed=False)
    members = np.bincount(label, minlength=count)
    free = np.bincount(label, anchor, count) <= _LEAST * np.bincount(label, np.diagonal(matrix), count)
    typical = np.bincount(label, np.diagonal(matrix), count) / members
    same = (label[:, np.newaxis] == label) & free[label]
    mean = same / members[label]  # projects on what is free
    inverse: NDArray[np.float64] = _invert(matrix + typical[label] * mean) - mean / typical[label]
    return inverse


def _invert(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Invert a small positive definite matrix; OpenBLAS' threads would wait for each other much longer."""
    whole = matrix.copy()
    for k in range(len(whole)):
        pivot = 1 / whole[k, k]
        row = whole[k] * pivot
        column = whole[:, k].copy()
        whole -= np.multiply.outer(column, row)
        whole[k], whole[:, k] = row, -column * pivot
        whole[k, k] = pivot
    return whole
