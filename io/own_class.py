"""Load a user's own class, named in a command or a file."""

from __future__ import annotations

import importlib.util
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

from mirrorskin.io.types import InputError


def load_class(name: str) -> Callable[..., Any]:
    """Return a class given as MODULE:CLASS or FILE.py:CLASS; modules may be in the current folder.

    Missing modules and classes raise `InputError`. Errors of the module itself are not caught.

    Examples
    --------
    >>> load_class("fractions:Fraction")(6, 8)
    Fraction(3, 4)
    """
    place, _, kind = name.rpartition(":")
    file = Path(place) if place.endswith(".py") else None
    if not place or not kind.isidentifier():
        raise InputError(f"{name}: name a class as MODULE:CLASS or FILE.py:CLASS")
    folder, module = (Path(), place) if file is None else (file.parent, file.stem)
    if file is not None and not file.is_file():
        raise InputError(f"{name}: there is no {file.name} in {folder.resolve()}")
    if str(folder.resolve()) not in sys.path:
        sys.path.insert(0, str(folder.resolve()))
    try:
        found = importlib.import_module(module) if file is None else _run(file)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise  # an import of the module itself failed
        raise InputError(f"{name}: there is no {place} in {folder.resolve()}, nor installed") from error
    made = getattr(found, kind, None)
    if not callable(made):
        exported = getattr(found, "__all__", ())
        classes = {one: it for one in exported or vars(found) if isinstance(it := getattr(found, one), type)}
        own = [one for one, it in classes.items() if exported or it.__module__ == found.__name__]
        raise InputError(f"{name}: there is no class {kind} in {place}; it has {', '.join(own) or 'none'}")
    return made  # type: ignore[no-any-return]


def _run(file: Path) -> ModuleType:
    """Return the module of a file, under a unique name, since other files may have the same name."""
    name = f"mirrorskin_own_{file.stem}_{zlib.crc32(bytes(file.resolve())):08x}"
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, file)
        assert spec is not None and spec.loader is not None  # noqa: PT018  # true for files that end in .py
        sys.modules[name] = importlib.util.module_from_spec(spec)
        try:
            spec.loader.exec_module(sys.modules[name])
        except BaseException:
            del sys.modules[name]
            raise
    return sys.modules[name]
