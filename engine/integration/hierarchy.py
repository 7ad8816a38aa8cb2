"""The levels of a multigrid on a device: their links, and the tables of nodes that split aggregates add."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.integration.graph import Links
from mirrorskin.engine.integration.levels import Level, cut_levels
from mirrorskin.engine.integration.split_aggregates import Coarsening, ExtraNodes, Grid, Ints, Lookup, Pairs
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.device import Device, Kernel

WIDTH = 8
"""Nodes side by side in a kernel's vectors."""

STRENGTH = 0.25
"""Of links that join what cycles move as one."""

_LEAST = 1e-12  # of a component's links: anchors that are weaker leave its offset free


@dataclass(frozen=True, slots=True)
class Rows:
    """Some rows of the tables of extra nodes, or some of these nodes: the first one, and how many."""

    at: int = 0
    count: int = 0


@dataclass(slots=True)
class ExtraRows:
    """What the extra nodes of one level need."""

    # The level's nodes without a place in its grid, up to a multiple of `WIDTH`.
    nodes: Rows = field(default_factory=Rows)
    # The level's own links, of all nodes that are extra or linked with one.
    graph: Rows = field(default_factory=Rows)
    # To the next level's split aggregates, and from them.
    restrict: Rows = field(default_factory=Rows)
    prolong: Rows = field(default_factory=Rows)
    # The split blocks that its extra nodes come from; None where it has none.
    step: Coarsening | None = None


class Hierarchy:
    """All levels of a graph.

    ``in_grids`` nodes have a place in a level's grid, the extra ones lie behind them, and there is room for
    ``nodes``. ``graph`` has their links right and down, and known heights' weights as anchor (see
    ``kernels/multigrid.cl``); ``inverse`` is one over the diagonal. ``table`` has the rows for extra nodes,
    which ``extra`` counts level by level: the rows' nodes, where each begins and the last ends, and of their
    entries the nodes and weights. ``bottom`` has the coarsest level's nodes and the pseudo-inverse.
    """

    def __init__(self, shape: tuple[int, int], anchored: bool, device: Device) -> None:
        self.device, self.anchored = device, anchored
        self.levels = cut_levels(shape)
        self.in_grids = self.nodes = self.levels[-1].end
        self.graph: dict[str, Any] = {name: self.array(name, self.in_grids) for name in ("right", "down")}
        self._split = self.array("split", self.in_grids)
        self._allocate()
        self._lookup = Lookup(self.in_grids)
        self._no_table = self._to_table([])
        self.extra: list[ExtraRows] = []

    def array(self, name: str, size: int) -> Array:
        """Return an array on the device."""
        array = self.device.array(name, (size,), np.float32)
        array.upload()
        return array

    def build(self, links: Links, *, plain: bool = False, strength: float = STRENGTH) -> None:
        """Take a graph of this shape; a plain one joins all that a block of pixels has.

        Else links join that have at least that ``strength``, a share of the geometric mean of their nodes'
        greatest ones.
        """
        self._strength = strength
        self._admit_graph(links)
        self._coarsen(range(1, len(self.levels)))
        self.extra, self.table = [ExtraRows() for _ in self.levels], self._no_table
        extra = ExtraNodes.none()
        if not plain:
            split = self._split.download()
            if split[self.levels[0].end :].any():
                extra = self._split_aggregates(split)
            self._split.upload()
        self._invert()
        self.bottom = self._solve_bottom(extra)

    def follow(self, links: Links, *, deep: bool) -> None:
        """Take a graph that is nearly the one before, a plain one; nothing goes to the host.

        The coarsest level stays as it is; unless ``deep``, so do all but the finest.
        """
        self._admit_graph(links)
        if deep:
            self._coarsen(range(1, len(self.levels)))
            self._invert()
        else:
            self.over_grid("invert", self.levels[0], **self.graph, inverse=self.inverse)

    @contextmanager
    def on_host(self) -> Iterator[tuple[NDArray[np.float32], ...]]:
        """Lend the host all links to the right and down, and anchors, to read."""
        yield tuple(array.download() for array in self.graph.values())
        for array in self.graph.values():
            array.upload()

    def spread_variance(
        self,
        nodes: Ints,
        coarse: NDArray[np.float64],
        local: list[NDArray[np.float32]],
        rooms: tuple[Array, Array, Array, Array],
    ) -> None:
        """Bring the variance of a level's nodes to the finest, with what each level adds.

        ``local`` are the numbers of the local part of each finer level. The first of ``rooms``, of all nodes,
        gets the variance.
        """
        variance, evened, returns, part = rooms
        variance.claim()
        variance.host[...] = 0
        variance.host[nodes] = coarse
        variance.upload()
        links = {name: self.graph[name] for name in ("right", "down")}
        for fine in reversed(range(len(local))):
            level, rows = self.levels[fine], self.extra[fine].graph
            self.over_grid("even", level, **self.graph, evened=evened)
            self.over_rows("invert", rows, anchor=self.anchor, inverse=evened)
            known = {"evened": evened, "returns": returns}
            self.over_grid("returns", level, **links, **known)
            self.over_rows("returns", rows, **known)
            known |= {"c": self.device.given("local", local[fine]), "local_part": part}
            self.over_grid("local", level, **links, **known)
            self.over_rows("local", rows, **known)
            spread = {"keep": 1.0, "inverse": self.inverse, "e": variance, "x": part, "corrected": variance}
            self.over_blocks("prolong", fine, **links, **spread)
            self.over_rows("prolong", self.extra[fine].prolong, **spread)

    def kernel(self, name: str) -> Kernel:
        """Return a pass."""
        width = WIDTH if self.device.layout.tile > 1 else 1
        macros = {"ANCHORED": int(self.anchored), "PART": part_of(self.device), "WIDTH": width}
        return self.device.kernel("multigrid", f"multigrid_{name}", **macros)

    def over_grid(self, name: str, level: Level, **arguments: Any) -> None:
        """Run a pass over the nodes of a level's grid."""
        items = -(-level.nodes // self.device.layout.tile)
        self.kernel(name)(items, **level.place, **arguments, moved=_bytes(level, arguments))

    def over_extra(self, name: str, nodes: Rows, **arguments: Any) -> None:
        """Run a pass over extra nodes, a multiple of `WIDTH`, as if they were rows of a grid."""
        if nodes.count:
            as_grid = Level(nodes.at - WIDTH, nodes.count // WIDTH, WIDTH, WIDTH)
            self.over_grid(name, as_grid, **arguments)

    def over_rows(self, name: str, rows: Rows, **arguments: Any) -> None:
        """Run a pass over rows of the tables."""
        if rows.count:
            kernel = self.kernel(f"{name}_extra")
            at = {"at": rows.at, "count": rows.count}
            kernel(rows.count, **at, **self.table, **arguments, moved=64 * rows.count)

    def over_blocks(self, name: str, number: int, **arguments: Any) -> None:
        """Run a pass between a level and the next, an item a row of that."""
        fine, coarse = self.levels[number : number + 2]
        moved = _bytes(fine, arguments)
        self.kernel(name)(coarse.rows, **fine.with_coarser(coarse), **arguments, moved=moved)

    def over_parts(self, name: str, parts: Array, **arguments: Any) -> None:
        """Run a pass over the finest level that adds up; ``parts`` gets partial sums."""
        level = self.levels[0]
        count = -(-level.nodes // part_of(self.device))
        self.kernel(name)(count, **level.place, **arguments, parts=parts, moved=_bytes(level, arguments))

    def copy_picture(self, name: str, level: Array, map_: Array) -> None:
        """Copy a map of pixels to ("admit") the finest level, or back ("release")."""
        finest = self.levels[0]
        sizes = {"rows": finest.rows, "columns": finest.columns, "stride": finest.stride}
        self.kernel(name)(finest.rows, **sizes, level=level, map=map_, moved=8 * finest.nodes)

    @property
    def anchor(self) -> Array:
        """Weights of known heights."""
        anchor: Array = self.graph["anchor"]
        return anchor

    def _allocate(self) -> None:
        """Make room for whatever each node has, extra ones included."""
        self.graph["anchor"] = self.array("anchor", self.nodes if self.anchored else 1)
        self.inverse = self.array("inverse", self.nodes)

    def _admit_graph(self, links: Links) -> None:
        for name in ("right", "down", "anchor"):
            if (map_ := getattr(links, name)) is not None:
                self.copy_picture("admit", self.graph[name], map_)

    def _coarsen(self, numbers: Iterable[int]) -> None:
        coarse = {f"coarse_{name}": array for name, array in self.graph.items()}
        for number in numbers:
            self.over_blocks(
                "coarsen", number - 1, strength=self._strength, **self.graph, **coarse, split=self._split
            )

    def _invert(self) -> None:
        for level in self.levels:
            self.over_grid("invert", level, **self.graph, inverse=self.inverse)
        for rows in self.extra:
            self.over_rows("invert", rows.graph, anchor=self.anchor, inverse=self.inverse)

    def _split_aggregates(self, split: NDArray[np.float32]) -> ExtraNodes:
        """Go through the levels again, and split aggregates; return the coarsest level's extra nodes."""
        right, down = (self.graph[name].download() for name in ("right", "down"))
        extra, following = ExtraNodes.none(), self.in_grids
        changed = extra.node
        parts: list[tuple[Pairs, Ints]] = []
        at = 0
        for number in range(1, len(self.levels)):
            fine, coarse = (Grid(level, right, down) for level in self.levels[number - 1 : number + 1])
            marked = np.flatnonzero(split[coarse.level.base : coarse.level.end]) + coarse.level.base
            step = Coarsening.of(
                fine, extra, changed, coarse, marked, following, self._lookup, self._strength
            )
            changed, extra = step.blocks, step.extra
            self.extra[number].step = step
            room = -(-len(extra.node) // WIDTH) * WIDTH
            self.extra[number].nodes = Rows(following, room)
            following += room
            self._make_room(following)
            if self.anchored and len(step.blocks):
                self._split_anchors(step)
            for owner, name in ((number - 1, "restrict"), (number - 1, "prolong"), (number, "graph")):
                pairs = getattr(step, name).by_rows()
                first = np.flatnonzero(np.diff(pairs.a, prepend=-1))
                parts.append((pairs, first))
                setattr(self.extra[owner], name, Rows(at, len(first)))
                at += len(first)
        for name in ("right", "down"):
            self.graph[name].upload()
        self.table = self._to_table(parts)
        return extra

    def _make_room(self, nodes: int) -> None:
        if nodes > self.nodes:
            self.nodes = -(-(2 * nodes - self.in_grids) // 16) * 16
            known = self.anchor.download()
            self._allocate()
            self.anchor.claim()
            self.anchor.host[: len(known)] = known
            self.anchor.upload()

    def _split_anchors(self, step: Coarsening) -> None:
        anchor = self.anchor.download()
        nodes, owners = step.members
        anchor[step.blocks] = anchor[step.extra.node] = 0
        np.add.at(anchor, owners, anchor[nodes])
        self.anchor.upload()

    def _to_table(self, parts: list[tuple[Pairs, Ints]]) -> dict[str, Any]:
        """Bring sparse matrices to the device, one behind the other, each with where its rows begin."""
        every = Pairs.join(Pairs.none(), *(pairs for pairs, _ in parts))
        ends = np.cumsum([0, *(len(pairs.a) for pairs, _ in parts)])
        nodes = [pairs.a[first] for pairs, first in parts]
        starts = [first + at for (_, first), at in zip(parts, ends, strict=False)]
        given = self.device.given
        return {
            "node": given("nodes", np.concatenate([np.zeros(0), *nodes]), np.int32),
            "start": given("starts", np.concatenate([*starts, ends[-1:]]), np.int32),
            "column": given("columns", every.b, np.int32),
            "weight": given("weights", every.weight, np.float32),
        }

    def _solve_bottom(self, extra: ExtraNodes) -> tuple[Array, Array]:
        """Return the coarsest level's nodes, and the pseudo-inverse of its matrix."""
        level = self.levels[-1]
        right, down, anchor = (self.graph[name].download() for name in ("right", "down", "anchor"))
        grid, inside = Grid(level, right, down), np.arange(level.first, level.end - level.stride)
        links = Pairs.join(grid.rightward(inside), grid.downward(inside), extra.links)
        links = links.where(links.weight > 0)
        held = np.concatenate([inside, extra.node])
        held = held[anchor[held] > 0] if self.anchored else held[:0]
        node = np.unique(np.concatenate([links.a, links.b, held]))
        a, b = np.searchsorted(node, links.a), np.searchsorted(node, links.b)
        pull = anchor[node] if self.anchored else np.zeros(len(node))
        matrix = np.zeros((len(node), len(node)))
        np.subtract.at(matrix, (a, b), links.weight)
        matrix += matrix.T
        matrix[np.diag_indices_from(matrix)] = -matrix.sum(axis=1) + pull
        inverse = _pseudo_inverse(matrix, pull)
        for array in self.graph.values():
            array.upload()
        given = self.device.given
        return given("bottom", node, np.int32), given("pseudo-inverse", inverse, np.float32)


def part_of(device: Device) -> int:
    """Return how many nodes a partial sum has."""
    return 4096 if device.layout.tile > 1 else 64


def _bytes(level: Level, arguments: dict[str, Any]) -> int:
    """Return the bytes of a level in all arrays."""
    arrays = [one for one in arguments.values() if isinstance(one, Array)]
    return sum(min(one.host.nbytes, 4 * level.nodes) for one in arrays)


def _pseudo_inverse(matrix: NDArray[np.float64], anchor: NDArray[np.floating]) -> NDArray[np.float64]:
    """Invert a matrix whose components' offsets are free, but for those that have an anchor."""
    label = _components(matrix)
    count = int(label.max(initial=-1)) + 1
    members = np.bincount(label, minlength=count)
    free = np.bincount(label, anchor, count) <= _LEAST * np.bincount(label, np.diagonal(matrix), count)
    typical = np.bincount(label, np.diagonal(matrix), count) / members
    same = (label[:, np.newaxis] == label) & free[label]
    mean = same / members[label]  # projects on what is free
    inverse: NDArray[np.float64] = np.linalg.inv(matrix + typical[label] * mean)
    inverse -= mean / typical[label]
    return inverse


def _components(matrix: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return to which component each node of a small matrix belongs; the least node of each tells."""
    nodes = np.arange(len(matrix))
    linked = (matrix != 0) | np.eye(len(matrix), dtype=bool)
    least, lower = nodes[::-1], nodes
    while np.any(least != lower):
        least, lower = lower, np.where(linked, lower, len(nodes)).min(axis=1)
        lower = lower[lower]
    return np.unique(lower, return_inverse=True)[1]
