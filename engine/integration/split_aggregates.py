"""The nodes of a coarse level that have no place in its picture, since their block has several parts.

A block of two by two whose nodes do not hang together by strong links, as on either side of a cut, becomes
a coarse node for each of its parts. The largest takes the block's place in the picture, the others are odd:
they and their links are kept in sparse matrices.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.integration.levels import Level

Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]
Floats = NDArray[np.float32]
STRENGTH = 0.25
"""A link is strong from this share of the geometric mean of its nodes' greatest links on."""


@dataclass(frozen=True, slots=True)
class Pairs:
    """Links, or a sparse matrix's entries: from a to b with a weight.

    Attributes
    ----------
    a, b : ndarray, (n,), int64
        Nodes.
    weight : ndarray, (n,), float32
    """

    a: Ints
    b: Ints
    weight: Floats

    def both_ways(self) -> Pairs:
        """Return each twice, from either end."""
        a, b = np.concatenate([self.a, self.b]), np.concatenate([self.b, self.a])
        return Pairs(a, b, np.concatenate([self.weight, self.weight]))

    def where(self, chosen: Mask) -> Pairs:
        """Return some of them."""
        return Pairs(self.a[chosen], self.b[chosen], self.weight[chosen])

    def by_rows(self) -> Pairs:
        """Return them sorted by a."""
        order = np.argsort(self.a)
        return Pairs(self.a[order], self.b[order], self.weight[order])


def join(*parts: Pairs) -> Pairs:
    """Return all of some pairs."""
    return Pairs(
        np.concatenate([part.a for part in parts]),
        np.concatenate([part.b for part in parts]),
        np.concatenate([part.weight for part in parts]),
    )


@dataclass(frozen=True, slots=True)
class Odd:
    """What is odd at one level.

    Attributes
    ----------
    node : ndarray, (n,), int64
        Nodes without a place in the picture, one number after the other.
    block : ndarray, (n, 2), int64
        Row and column of the block that each stands for.
    links : Pairs
        Each link once that has such a node at an end.
    """

    node: Ints
    block: Ints
    links: Pairs


def nothing_odd() -> Odd:
    """Return what is odd at a level where nothing is."""
    none = np.empty(0, np.int64)
    return Odd(none, none.reshape(0, 2), Pairs(none, none, np.empty(0, np.float32)))


@dataclass(frozen=True, slots=True)
class Step:
    """How one level goes over into the next where that is odd.

    Attributes
    ----------
    odd : Odd
        Of the coarse level.
    blocks : ndarray, (n,), int64
        Nodes of the coarse picture whose blocks are odd.
    members : (ndarray, ndarray), (m,), int64
        Fine nodes in odd blocks, and the coarse ones that they belong to.
    restrict : Pairs
        From coarse nodes to the fine ones that they are told of: whole rows.
    prolong : Pairs
        From fine nodes to the coarse ones that tell them: whole rows.
    graph : Pairs
        From coarse nodes that are odd or have odd links to all that they are linked with: whole rows.
    """

    odd: Odd
    blocks: Ints
    members: tuple[Ints, Ints]
    restrict: Pairs
    prolong: Pairs
    graph: Pairs


class Picture:
    """One level's plain links, as the host sees them."""

    def __init__(self, level: Level, right: Floats, down: Floats) -> None:
        self.level, self.right, self.down = level, right, down

    def holds(self, node: Ints) -> Mask:
        """Tell which nodes have a place in the picture, rather than none at all."""
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
        """Return the greatest plain link of nodes in the picture."""
        above = node - self.level.stride
        sides = self.right[node], self.right[node - 1], self.down[node], self.down[above]
        greatest: Floats = np.maximum.reduce(sides)
        return greatest

    def rightward(self, node: Ints) -> Pairs:
        """Return the links to the right of nodes."""
        return Pairs(node, node + 1, self.right[node])

    def downward(self, node: Ints) -> Pairs:
        """Return the links from nodes to those below."""
        return Pairs(node, node + self.level.stride, self.down[node])

    def around(self, node: Ints) -> Pairs:
        """Return all plain links of nodes, seen from them."""
        before, above = node - 1, node - self.level.stride
        backward = Pairs(node, before, self.right[before]), Pairs(node, above, self.down[above])
        found = join(self.rightward(node), self.downward(node), *backward)
        return found.where(found.weight > 0)

    def blocks(self, coarse: Level, nodes: Ints) -> Pairs:
        """Return each plain link once that blocks, given as coarse nodes, have within and to others."""
        row, column = np.divmod(nodes - coarse.first, coarse.stride)
        a = self.node(2 * row, 2 * column)
        b, c, stride = a + 1, a + self.level.stride, self.level.stride
        d = c + 1
        chosen = np.zeros(coarse.end - coarse.base, bool)
        chosen[nodes - coarse.base] = True
        left, above = ~chosen[nodes - coarse.base - 1], ~chosen[nodes - coarse.base - coarse.stride]
        flat = np.concatenate([a, b, c, d, a[left] - 1, c[left] - 1])
        steep = np.concatenate([a, b, c, d, a[above] - stride, b[above] - stride])
        found = join(self.rightward(flat), self.downward(steep))
        return found.where(found.weight > 0)


class Lookup:
    """Numbers of nodes in a list, by node; room for it is kept."""

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


class _Parts:
    """To which coarse nodes the fine ones of odd blocks belong.

    Parameters
    ----------
    fine : Picture
    odd : Odd
        Of the fine level.
    coarse : Level
    blocks : ndarray, (n,), int64
        Nodes of the coarse picture whose blocks are odd.
    following : int
        The first number for parts that have no place in the picture.
    lookup : Lookup
    """

    def __init__(
        self, fine: Picture, odd: Odd, coarse: Level, blocks: Ints, following: int, lookup: Lookup
    ) -> None:
        self._fine, self._odd, self._level, self._lookup = fine, odd, coarse, lookup
        self.links = join(fine.blocks(coarse, blocks), odd.links)
        self.nodes = lookup.distinct(np.concatenate([self.links.a, self.links.b]))
        lookup.take(self.nodes)
        self._a, self._b = lookup.find(self.links.a)[0], lookup.find(self.links.b)[0]
        self._block = self._block_of(self.nodes)
        chosen = np.zeros(coarse.end - coarse.base, bool)
        chosen[blocks - coarse.base] = True
        self.within = chosen[self._block - coarse.base]
        self._greatest = self._greatest_links()
        self._number(self._label(), following)

    def _greatest_links(self) -> Floats:
        greatest = np.zeros(len(self.nodes), np.float32)
        plain = self._fine.holds(self.nodes)
        greatest[plain] = self._fine.greatest(self.nodes[plain])
        for ends in (self._odd.links.a, self._odd.links.b):
            np.maximum.at(greatest, self._lookup.find(ends)[0], self._odd.links.weight)
        return greatest

    def _label(self) -> Ints:
        """Tell the parts of odd blocks apart: what hangs together by strong links within them."""
        bound = STRENGTH * np.sqrt(self._greatest[self._a] * self._greatest[self._b])
        same = self.within[self._a] & (self._block[self._a] == self._block[self._b])
        strong = same & (self.links.weight >= bound)
        return _first_of_each(len(self.nodes), self._a[strong], self._b[strong])

    def _number(self, label: Ints, following: int) -> None:
        """Give the largest part of a block its place, and numbers to the others."""
        members = np.bincount(label, self.within, len(label))
        mine = np.flatnonzero(members > 0)
        order = mine[np.lexsort((-members[mine], self._block[mine]))]
        other = np.zeros(len(order), bool)
        other[1:] = self._block[order[1:]] == self._block[order[:-1]]
        others = order[other]
        number = self._block.copy()  # nodes beyond odd blocks belong to their own block
        number[others] = following + np.arange(len(others))
        self._coarse = number[label]
        self.odd_node, self.odd_block = number[others], self._block[others]

    def _block_of(self, nodes: Ints) -> Ints:
        """Return the coarse picture's node of the blocks that nodes lie in."""
        row, column = self._fine.place(nodes)
        if len(self._odd.node):
            odd = ~self._fine.holds(nodes)
            row[odd], column[odd] = self._odd.block[nodes[odd] - self._odd.node[0]].T
        return self._level.first + (row // 2) * self._level.stride + column // 2

    def coarse_of(self, nodes: Ints) -> Ints:
        """Return the coarse nodes that any fine ones belong to."""
        number, known = self._lookup.find(nodes)
        return np.where(known, self._coarse[number], self._block_of(nodes))

    def members(self) -> tuple[Ints, Ints]:
        """Return the fine nodes in odd blocks, and the coarse ones that they belong to."""
        return self.nodes[self.within], self._coarse[self.within]

    def coarse_links(self) -> Pairs:
        """Return the coarse links that odd blocks have, each once."""
        a, b = self._coarse[self._a], self._coarse[self._b]
        crossing = np.flatnonzero(a != b)
        ends = 0.5 / self._greatest[self._a[crossing]] + 0.5 / self._greatest[self._b[crossing]]
        weight = 1 / (1 / self.links.weight[crossing] + ends)
        low, high = np.minimum(a[crossing], b[crossing]), np.maximum(a[crossing], b[crossing])
        key = low << 32 | high
        order = np.argsort(key)
        key = key[order]
        first = np.flatnonzero(np.diff(key, prepend=-1))
        total = np.add.reduceat(weight[order], first) if len(first) else weight
        return Pairs(key[first] >> 32, key[first] & 0xFFFFFFFF, total.astype(np.float32))

    def restriction(self) -> Pairs:
        """Return what the coarse nodes of odd blocks are told: whole rows."""
        links = self.links
        one, other = self.within[self._a], self.within[self._b]
        return Pairs(
            np.concatenate([self._coarse[self._a[one]], self._coarse[self._b[other]]]),
            np.concatenate([links.b[one], links.a[other]]),
            np.concatenate([links.weight[one], links.weight[other]]),
        )

    def prolongation(self) -> Pairs:
        """Return what tells fine nodes that are in odd blocks, or beside odd parts: whole rows."""
        both = self.links.both_ways()
        a, b = np.concatenate([self._a, self._b]), np.concatenate([self._b, self._a])
        inside = self.within[a]
        told = Pairs(both.a[inside], self._coarse[b[inside]], both.weight[inside])
        beside = self._lookup.distinct(both.a[~inside & (self._coarse[b] >= self._level.end)])
        self._lookup.take(self.nodes)
        around = self._fine.around(beside)
        return join(told, Pairs(around.a, self.coarse_of(around.b), around.weight))


def _first_of_each(count: int, a: Ints, b: Ints) -> Ints:
    """Return of each node the first that it hangs together with; chains of links are short."""
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


def step_over(
    fine: Picture, odd: Odd, changed: Ints, coarse: Picture, split: Ints, following: int, lookup: Lookup
) -> Step:
    """Put the coarse level right where blocks are odd, and tell what cannot be said in its picture.

    Parameters
    ----------
    fine : Picture
    odd : Odd
        Of the fine level.
    changed : ndarray, (n,), int64
        Nodes of the fine picture whose links are others than the plain pass knew.
    coarse : Picture
        As the plain pass left it; its links round odd blocks are put right.
    split : ndarray, (n,), int64
        Nodes of the coarse picture whose blocks' plain links say that they have several parts.
    following : int
        Number of the first odd node of the coarse level.
    lookup : Lookup
    """
    blocks = split
    if len(odd.node) or len(changed):
        ends = np.concatenate([odd.links.a, odd.links.b])
        stride = fine.level.stride
        beside = [changed - 1, changed + 1, changed - stride, changed + stride]
        nodes = np.concatenate([ends[fine.holds(ends)], changed, *beside])
        row, column = np.concatenate([fine.place(nodes), odd.block.T], axis=1) // 2
        inside = (row >= 0) & (row < coarse.level.rows) & (column < coarse.level.columns)
        near = coarse.node(row[inside], column[inside])
        blocks = lookup.distinct(np.concatenate([split, near]))
    if not len(blocks):
        none = nothing_odd()
        return Step(none, none.node, (none.node, none.node), none.links, none.links, none.links)
    parts = _Parts(fine, odd, coarse.level, blocks, following, lookup)
    links = _write_plain(coarse, blocks, parts.coarse_links())
    row, column = coarse.place(parts.odd_block)
    found = Odd(parts.odd_node, np.stack([row, column], axis=1), links)
    members, restrict, prolong = parts.members(), parts.restriction(), parts.prolongation()
    return Step(found, blocks, members, restrict, prolong, _whole_rows(coarse, found, lookup))


def _write_plain(coarse: Picture, blocks: Ints, links: Pairs) -> Pairs:
    """Write the links that have a place in the picture; return the others."""
    stride = coarse.level.stride
    coarse.right[blocks] = coarse.right[blocks - 1] = coarse.down[blocks] = coarse.down[blocks - stride] = 0
    plain = coarse.holds(links.b)  # the greater of the two
    flat, steep = plain & (links.b - links.a == 1), plain & (links.b - links.a == stride)
    coarse.right[links.a[flat]] = links.weight[flat]
    coarse.down[links.a[steep]] = links.weight[steep]
    return links.where(~plain)


def _whole_rows(picture: Picture, odd: Odd, lookup: Lookup) -> Pairs:
    """Return all links of the nodes that have odd ones, seen from them; one of nothing for each odd node."""
    ends = lookup.distinct(np.concatenate([odd.links.a, odd.links.b]))
    alone = Pairs(odd.node, odd.node, np.zeros(len(odd.node), np.float32))
    return join(picture.around(ends[picture.holds(ends)]), odd.links.both_ways(), alone)
