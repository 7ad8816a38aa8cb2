"""The two ways in which devices like their work cut: a core's loop over a tile, or items side by side."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Shape:
    """How much one work-item takes on; macros of the kernels, but for the group.

    Attributes
    ----------
    lanes : int
        32-bit lanes of a word, the piece that a kernel loads at once.
    words : int
        Words of one work-item.
    tile : int
        Pixels of one work-item, in kernels that take them one by one.
    group : int
        Work-items of a work-group.
    """

    lanes: int
    words: int
    tile: int
    group: int


CORE = Shape(lanes=16, words=128, tile=1024, group=1)
BESIDE = Shape(lanes=4, words=1, tile=1, group=128)
SHAPES = (CORE, BESIDE)
