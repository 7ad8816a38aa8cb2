"""Where the levels of a multigrid lie in memory."""

from __future__ import annotations

from dataclasses import dataclass

SMALLEST = 2  # rows and columns of the coarsest level, at most
_VECTOR = 16  # nodes that a row is padded to: two of a kernel's vectors


@dataclass(frozen=True, slots=True)
class Level:
    """A picture of nodes among others in one array; see ``kernels/multigrid.cl``.

    Attributes
    ----------
    base : int
        Where it begins.
    rows, columns : int
    stride : int
        Nodes from one row to the next.
    """

    base: int
    rows: int
    columns: int
    stride: int

    @property
    def nodes(self) -> int:
        """Of its rows, margins included."""
        return self.rows * self.stride

    @property
    def first(self) -> int:
        """Its first node."""
        return self.base + self.stride

    @property
    def end(self) -> int:
        """Where it ends."""
        return self.base + (self.rows + 2) * self.stride

    def coarser(self) -> Level:
        """Return the next level, of a node for each block of two by two."""
        return level_at(self.end, -(-self.rows // 2), -(-self.columns // 2))


def level_at(base: int, rows: int, columns: int) -> Level:
    """Return a level that begins there."""
    return Level(base, rows, columns, -(-columns // _VECTOR) * _VECTOR)


def cut_levels(shape: tuple[int, int]) -> list[Level]:
    """Return the levels of a picture, from the finest to the coarsest."""
    levels = [level_at(0, *shape)]
    while max(levels[-1].rows, levels[-1].columns) > SMALLEST:
        levels.append(levels[-1].coarser())
    return levels
