"""Reconstruction for active tactile sensors with a mirror-like skin."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mirrorskin import cli, engine, hw, io, kernels, twin, view

    __version__: str

__all__ = ["__version__", "cli", "engine", "hw", "io", "kernels", "twin", "view"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name == "__version__":
        return importlib.import_module("importlib.metadata").version("mirrorskin")
    return importlib.import_module(f"{__name__}.{name}")


def __dir__() -> list[str]:
    return [*__all__]
