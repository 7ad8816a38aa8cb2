"""Where the levels of a multigrid lie in memory."""

from __future__ import annotations

from dataclasses import dataclass

COARSEST = 2  # rows and columns of the coarsest level, at most
_VECTOR = 16  # nodes that a row is padded to: two of a kernel's vectors


@dataclass(frozen=True, slots=True)
class Level:
    """A grid of nodes among others in one array; see ``kernels/multigrid.cl``."""

    base: int  # where it begins
    rows: int
    columns: int
    stride: int  # nodes from one row to the next

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

    @property
    def place(self) -> dict[str, int]:
        """Arguments of the passes over it."""
        return {"base": self.base, "rows": self.rows, "stride": self.stride}

    def with_coarser(self, coarse: Level) -> dict[str, int]:
        """Return arguments of the passes between it and the next level."""
        place = {f"coarse_{name}": number for name, number in coarse.place.items()}
        return {"base": self.base, "stride": self.stride, **place}


def level_at(base: int, rows: int, columns: int) -> Level:
    """Return a level that begins there."""
    return Level(base, rows, columns, -(-columns // _VECTOR) * _VECTOR)


def cut_levels(shape: tuple[int, int]) -> list[Level]:
    """Return a picture's levels, the finest first; each node of the next stands for a block of two by two."""
    levels = [level_at(0, *shape)]
    while max(levels[-1].rows, levels[-1].columns) > COARSEST:
        fine = levels[-1]
        levels.append(level_at(fine.end, -(-fine.rows // 2), -(-fine.columns // 2)))
    return levels
