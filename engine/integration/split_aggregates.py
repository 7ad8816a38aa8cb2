"""Blocks of two by two whose nodes are not connected, as on either side of a cut, and their parts.

Such an aggregate becomes a coarse node for each of its parts that strong links connect. The largest part
takes the block's place in the coarse grid; the others are extra nodes: they and their links are kept in
sparse matrices.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.integration.levels import Level

Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]
Floats = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Pairs:
    """Links, or a sparse matrix's entries: from node a to node b with a weight, (n,) each."""

    a: Ints
    b: Ints
    weight: Floats

    @classmethod
    def none(cls) -> Pairs:
        """Return no pair."""
        return cls(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.float32))

    @classmethod
    def join(cls, *parts: Pairs) -> Pairs:
        """Return all of some pairs."""
        return cls(
            np.concatenate([part.a for part in parts]),
            np.concatenate([part.b for part in parts]),
            np.concatenate([part.weight for part in parts]),
        )

    def both_ways(self) -> Pairs:
        """Return each twice, from either end."""
        return Pairs.join(self, Pairs(self.b, self.a, self.weight))

    def where(self, chosen: Mask | Ints) -> Pairs:
        """Return some of them."""
        return Pairs(self.a[chosen], self.b[chosen], self.weight[chosen])

    def by_rows(self) -> Pairs:
        """Return them sorted by a."""
        return self.where(np.argsort(self.a))


@dataclass(frozen=True, slots=True)
class ExtraNodes:
    """Nodes of one level without a place in its grid."""

    node: Ints  # (n,), int64: consecutive numbers
    block: Ints  # (n, 2), int64: row and column of the block that each belongs to
    links: Pairs  # each link once that has such a node at an end

    @classmethod
    def none(cls) -> ExtraNodes:
        """Return no node."""
        none = np.empty(0, np.int64)
        return cls(none, none.reshape(0, 2), Pairs.none())


class Grid:
    """One level's nodes that have a place, and their links, on the host."""

    def __init__(self, level: Level, right: Floats, down: Floats) -> None:
        self.level, self.right, self.down = level, right, down

    def holds(self, node: Ints) -> Mask:
        """Tell which nodes have a place in the grid."""
        inside: Mask = node < self.level.end
        return inside

    def node(self, row: Ints, column: Ints) -> Ints:
        """Return the nodes at places."""
        return self.level.first + row * self.level.stride + column

    def place(self, node: Ints) -> tuple[Ints, Ints]:
        """Return the rows and columns of nodes."""
        row, column = np.divmod(node - self.level.first, self.level.stride)
        return row, column

    def greatest(self, node: Ints) -> Floats:
        """Return the greatest link of nodes in the grid."""
        sides = self.right[node], self.right[node - 1], self.down[node], self.down[node - self.level.stride]
        greatest: Floats = np.maximum.reduce(sides)
        return greatest

    def rightward(self, node: Ints) -> Pairs:
        """Return the links to the right of nodes."""
        return Pairs(node, node + 1, self.right[node])

    def downward(self, node: Ints) -> Pairs:
        """Return the links from nodes to those below."""
        return Pairs(node, node + self.level.stride, self.down[node])

    def around(self, node: Ints) -> Pairs:
        """Return all links of nodes in the grid, seen from them."""
        before, above = node - 1, node - self.level.stride
        backward = Pairs(node, before, self.right[before]), Pairs(node, above, self.down[above])
        found = Pairs.join(self.rightward(node), self.downward(node), *backward)
        return found.where(found.weight > 0)

    def blocks(self, coarse: Level, nodes: Ints) -> Pairs:
        """Return each link once that blocks, given as coarse nodes, have within and to others."""
        row, column = np.divmod(nodes - coarse.first, coarse.stride)
        a = self.node(2 * row, 2 * column)
        b, c, stride = a + 1, a + self.level.stride, self.level.stride
        d = c + 1
        chosen = _marks(coarse, nodes)
        left, above = ~chosen[nodes - coarse.base - 1], ~chosen[nodes - coarse.base - coarse.stride]
        flat = np.concatenate([a, b, c, d, a[left] - 1, c[left] - 1])
        steep = np.concatenate([a, b, c, d, a[above] - stride, b[above] - stride])
        found = Pairs.join(self.rightward(flat), self.downward(steep))
        return found.where(found.weight > 0)


class Lookup:
    """Numbers of nodes in a list, by node; its memory is kept."""

    def __init__(self, nodes: int) -> None:
        self._number = np.zeros(nodes, np.int32)

    def distinct(self, nodes: Ints) -> Ints:
        """Return each node once."""
        self._make_room(nodes)
        order = np.arange(len(nodes), dtype=np.int32)
        self._number[nodes] = order
        first: Mask = self._number[nodes] == order
        return nodes[first]

    def take(self, nodes: Ints) -> None:
        """Give distinct nodes their numbers."""
        self._make_room(nodes)
        self.nodes = nodes
        self._number[nodes] = np.arange(len(nodes), dtype=np.int32)

    def find(self, nodes: Ints) -> tuple[Ints, Mask]:
        """Return the numbers of nodes, and which of them have one."""
        self._make_room(nodes)
        number = np.minimum(self._number[nodes], len(self.nodes) - 1)
        return number, self.nodes[number] == nodes

    def _make_room(self, nodes: Ints) -> None:
        if len(nodes) and (most := int(nodes.max())) >= len(self._number):
            self._number = np.concatenate([self._number, np.zeros(most, np.int32)])


@dataclass(frozen=True, slots=True)
class Coarsening:
    """How one level goes over into the next where aggregates are split."""

    extra: ExtraNodes  # of the coarse level
    blocks: Ints  # (n,), int64: nodes of the coarse grid whose blocks are split
    # (ndarray), (m,), int64: fine nodes in split blocks, and the coarse ones that they belong to.
    members: tuple[Ints, Ints]
    # Complete rows of sparse matrices: from coarse nodes to the fine ones that restriction takes, from fine
    # nodes to the coarse ones that prolongation takes, and from coarse nodes that are extra or linked with
    # one to all that they are linked with.
    restrict: Pairs
    prolong: Pairs
    graph: Pairs

    @classmethod
    def of(
        cls,
        fine: Grid,
        extra: ExtraNodes,
        changed: Ints,
        coarse: Grid,
        split: Ints,
        following: int,
        lookup: Lookup,
        strength: float,
    ) -> Coarsening:
        """Split aggregates, and correct the coarse grid's links around them in place.

        ``extra`` are the fine level's, ``changed`` the nodes of the fine grid whose links are others than the
        device's pass knew, ``split`` the nodes of the coarse grid whose blocks have several parts by their
        links in the grid, ``following`` the number of the first extra node of the coarse level, and
        ``strength`` what a link has of the geometric mean of its nodes' greatest ones if it is strong.
        """
        blocks = split
        if len(extra.node) or len(changed):
            blocks = lookup.distinct(np.concatenate([split, _blocks_near(fine, extra, changed, coarse)]))
        if not len(blocks):
            none = ExtraNodes.none()
            return cls(none, none.node, (none.node, none.node), none.links, none.links, none.links)
        parts = _Parts(fine, extra, coarse.level, blocks, following, lookup, strength)
        links = _write_grid(coarse, blocks, parts.coarse_links())
        row, column = coarse.place(parts.extra_block)
        found = ExtraNodes(parts.extra_node, np.stack([row, column], axis=1), links)
        members, restrict, prolong = parts.members(), parts.restriction(), parts.prolongation()
        return cls(found, blocks, members, restrict, prolong, _complete_rows(coarse, found, lookup))


def _blocks_near(fine: Grid, extra: ExtraNodes, changed: Ints, coarse: Grid) -> Ints:
    """Return the coarse nodes of blocks with extra or changed nodes, and of those beside."""
    ends = np.concatenate([extra.links.a, extra.links.b])
    stride = fine.level.stride
    beside = [changed - 1, changed + 1, changed - stride, changed + stride]
    nodes = np.concatenate([ends[fine.holds(ends)], changed, *beside])
    row, column = np.concatenate([fine.place(nodes), extra.block.T], axis=1) // 2
    inside = (row >= 0) & (row < coarse.level.rows) & (column < coarse.level.columns)
    return coarse.node(row[inside], column[inside])


def _write_grid(coarse: Grid, blocks: Ints, links: Pairs) -> Pairs:
    """Write the links that have a place in the grid; return the others."""
    stride = coarse.level.stride
    coarse.right[blocks] = coarse.right[blocks - 1] = coarse.down[blocks] = coarse.down[blocks - stride] = 0
    placed = coarse.holds(links.b)  # the greater of the two
    flat, steep = placed & (links.b - links.a == 1), placed & (links.b - links.a == stride)
    coarse.right[links.a[flat]] = links.weight[flat]
    coarse.down[links.a[steep]] = links.weight[steep]
    return links.where(~placed)


def _complete_rows(grid: Grid, extra: ExtraNodes, lookup: Lookup) -> Pairs:
    """Return all links of nodes linked with extra ones, seen from them; for each extra node one of 0."""
    ends = lookup.distinct(np.concatenate([extra.links.a, extra.links.b]))
    alone = Pairs(extra.node, extra.node, np.zeros(len(extra.node), np.float32))
    return Pairs.join(grid.around(ends[grid.holds(ends)]), extra.links.both_ways(), alone)


def _marks(level: Level, nodes: Ints) -> Mask:
    """Mark nodes of a level's grid, counted from where it begins."""
    marks = np.zeros(level.end - level.base, bool)
    marks[nodes - level.base] = True
    return marks


class _Parts:
    """To which coarse nodes the fine ones of split blocks belong; arguments as for `Coarsening.of`."""

    def __init__(
        self,
        fine: Grid,
        extra: ExtraNodes,
        coarse: Level,
        blocks: Ints,
        following: int,
        lookup: Lookup,
        strength: float,
    ) -> None:
        self._fine, self._extra, self._level, self._lookup = fine, extra, coarse, lookup
        self._blocks = blocks
        self.links = Pairs.join(fine.blocks(coarse, blocks), extra.links)
        self.nodes = lookup.distinct(np.concatenate([self.links.a, self.links.b]))
        lookup.take(self.nodes)
        self._a, self._b = lookup.find(self.links.a)[0], lookup.find(self.links.b)[0]
        self._block = self._block_of(self.nodes)
        self.within = _marks(coarse, blocks)[self._block - coarse.base]
        self._greatest = self._greatest_links()
        self._number(self._label(strength), following)

    def _greatest_links(self) -> Floats:
        greatest = np.zeros(len(self.nodes), np.float32)
        placed = self._fine.holds(self.nodes)
        greatest[placed] = self._fine.greatest(self.nodes[placed])
        for ends in (self._extra.links.a, self._extra.links.b):
            np.maximum.at(greatest, self._lookup.find(ends)[0], self._extra.links.weight)
        return greatest

    def _label(self, strength: float) -> Ints:
        """Label the parts of split blocks: what strong links within them connect."""
        bound = strength * np.sqrt(self._greatest[self._a] * self._greatest[self._b])
        same = self.within[self._a] & (self._block[self._a] == self._block[self._b])
        strong = same & (self.links.weight >= bound)
        return first_connected(len(self.nodes), self._a[strong], self._b[strong])

    def _number(self, label: Ints, following: int) -> None:
        """Give the largest part of a block its place, and numbers to the others."""
        members = np.bincount(label, self.within, len(label))
        mine = np.flatnonzero(members > 0)
        order = mine[np.lexsort((-members[mine], self._block[mine]))]
        other = np.zeros(len(order), bool)
        other[1:] = self._block[order[1:]] == self._block[order[:-1]]
        others = order[other]
        number = self._block.copy()  # nodes beyond split blocks belong to their own block
        number[others] = following + np.arange(len(others))
        self._coarse = number[label]
        self.extra_node, self.extra_block = number[others], self._block[others]

    def _place(self, nodes: Ints) -> tuple[Ints, Ints]:
        """Return the rows and columns of nodes; extra ones are where their blocks are."""
        row, column = self._fine.place(nodes)
        if len(self._extra.node):
            extra = ~self._fine.holds(nodes)
            row[extra], column[extra] = self._extra.block[nodes[extra] - self._extra.node[0]].T
        return row, column

    def _block_of(self, nodes: Ints) -> Ints:
        """Return the coarse grid's node of the blocks that nodes lie in."""
        row, column = self._place(nodes)
        return self._level.first + (row // 2) * self._level.stride + column // 2

    def members(self) -> tuple[Ints, Ints]:
        """Return the fine nodes in split blocks, and the coarse ones that they belong to."""
        return self.nodes[self.within], self._coarse[self.within]

    def coarse_links(self) -> Pairs:
        """Return the coarse links that split blocks have, each once."""
        a, b = self._coarse[self._a], self._coarse[self._b]
        crossing = np.flatnonzero(a != b)
        weight = self._in_series(self.links.where(crossing), self._inner_links(a == b))
        low, high = np.minimum(a[crossing], b[crossing]), np.maximum(a[crossing], b[crossing])
        key = low << 32 | high
        order = np.argsort(key)
        key = key[order]
        first = np.flatnonzero(np.diff(key, prepend=-1))
        total = np.add.reduceat(weight[order], first) if len(first) else weight
        return Pairs(key[first] >> 32, key[first] & 0xFFFFFFFF, total.astype(np.float32))

    def _inner_links(self, same: Mask) -> Pairs:
        """Return the links within parts of split blocks, and within the blocks beside these."""
        beside = self._fine.blocks(self._level, self._lookup.distinct(self._block[~self.within]))
        inner = self._block_of(beside.a) == self._block_of(beside.b)
        return Pairs.join(self.links.where(same), beside.where(inner))

    def _in_series(self, links: Pairs, inner: Pairs) -> Floats:
        """Return the weights of links with the ways to the middles of their nodes' parts; see coarsen."""
        self._lookup.take(self._lookup.distinct(np.concatenate([inner.a, inner.b, links.a, links.b])))
        count = len(self._lookup.nodes)

        def find(pairs: Pairs) -> tuple[Ints, Ints, Ints]:
            """Return the numbers of both ends, and where those of the pairs' axis begin."""
            steep = self._place(pairs.a)[0] != self._place(pairs.b)[0]
            return self._lookup.find(pairs.a)[0], self._lookup.find(pairs.b)[0], count * steep

        def sums(at: Ints, values: Floats) -> Floats:
            return np.asarray(np.bincount(at, values, 2 * count), np.float32)

        a, b, axis = find(inner)
        behind = sums(axis + a, inner.weight) + sums(axis + b, inner.weight)
        other = count - axis
        beside = sums(other + a, behind[other + b]) + sums(other + b, behind[other + a])
        a, b, axis = find(links)
        whole = ~_marks(self._level, self._blocks)[self._block_of(self._lookup.nodes) - self._level.base]
        with np.errstate(divide="ignore"):
            resistance = 1 / links.weight
            for node in (a, b):
                on, aside = behind[axis + node], beside[axis + node]
                ends = np.where(
                    whole[node], 0.5 / links.weight, 0
                )  # a part of a split block ends with the link
                resistance += np.where(on > 0, 1 / (links.weight + on), np.where(aside > 0, 1 / aside, ends))
        self._lookup.take(self.nodes)
        return np.asarray(1 / resistance, np.float32)

    def restriction(self) -> Pairs:
        """Return what the coarse nodes of split blocks take from fine ones: complete rows."""
        links, forth, back = self.links, self.within[self._a], self.within[self._b]
        return Pairs.join(
            Pairs(self._coarse[self._a[forth]], links.b[forth], links.weight[forth]),
            Pairs(self._coarse[self._b[back]], links.a[back], links.weight[back]),
        )

    def prolongation(self) -> Pairs:
        """Return what fine nodes in split blocks, or beside their parts, take: complete rows."""
        both = self.links.both_ways()
        a, b = np.concatenate([self._a, self._b]), np.concatenate([self._b, self._a])
        inside = self.within[a]
        taken = Pairs(both.a[inside], self._coarse[b[inside]], both.weight[inside])
        beside = self._lookup.distinct(both.a[~inside & (self._coarse[b] >= self._level.end)])
        self._lookup.take(self.nodes)
        around = self._fine.around(beside)
        number, known = self._lookup.find(around.b)
        coarse = np.where(known, self._coarse[number], self._block_of(around.b))
        return Pairs.join(taken, Pairs(around.a, coarse, around.weight))


def first_connected(count: int, a: Ints, b: Ints) -> Ints:
    """Return of each node the first that it is connected with; quickly where chains of links are short."""
    label = np.arange(count)
    while True:
        lower = np.minimum(label[a], label[b])
        found = label.copy()
        np.minimum.at(found, a, lower)
        np.minimum.at(found, b, lower)
        found = found[found]
        if np.array_equal(found, label):
            return label
        label = found
