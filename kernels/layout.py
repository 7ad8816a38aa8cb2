"""The division of a kernel's work: long loops for the cores of a CPU, small items for the lanes of a GPU."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Layout:
    """The size of a work-item; all but the group are macros of the kernels.

    Attributes
    ----------
    words : int
        Vectors per work-item, in kernels that process vectors of pixels.
    tile : int
        Pixels per work-item, in kernels that process single pixels.
    group : int
        Work-items of a work-group.
    """

    words: int
    tile: int
    group: int


CPU_LAYOUT = Layout(words=128, tile=1024, group=1)
GPU_LAYOUT = Layout(words=1, tile=1, group=128)
