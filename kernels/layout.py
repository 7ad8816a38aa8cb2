"""The division of a kernel's work: long loops for the cores of a CPU, small items for the lanes of a GPU."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Layout:
    """The size of a work-item and of a work-group.

    Attributes
    ----------
    tile : int
        Pixels per work-item, a macro of the kernels.
    group : int
        Work-items of a work-group.
    """

    tile: int
    group: int


CPU_LAYOUT = Layout(tile=1024, group=1)
GPU_LAYOUT = Layout(tile=1, group=128)
