"""Launches of kernels with their arguments in the order of their references."""

from typing import Any

from mirrorskin.kernels.device import Kernel


def launch(kernel: Kernel, items: int, *values: Any) -> None:
    """Run a kernel; see ``Kernel.arguments``."""
    kernel(items, moved=0, **dict(zip(kernel.arguments, values, strict=True)))
