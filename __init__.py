"""Reconstruction for active tactile sensors with a mirror-like skin."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import lazy_loader

if TYPE_CHECKING:
    from mirrorskin import cli, engine, hw, io, kernels, view

    __version__: str

_submodule, _names, _ = lazy_loader.attach(__name__, ["cli", "engine", "hw", "io", "kernels", "view"])


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("mirrorskin")
    return _submodule(name)


def __dir__() -> list[str]:
    return [*_names(), "__version__"]


__all__ = ["__version__", "cli", "engine", "hw", "io", "kernels", "view"]
