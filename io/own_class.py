"""Load a user's own class, named in a command or a file."""

from __future__ import annotations

import importlib.util
import sys
import threading
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType
from typing import Any

from mirrorskin.io.types import InputError

_path_lock = threading.Lock()  # of changes to sys.path


def load_class(name: str) -> Callable[..., Any]:
    """Return a class given as MODULE:CLASS or FILE.py:CLASS; modules may be in the current folder.

    While MODULE is imported, modules of the current folder can be imported too, and while FILE.py is run,
    those of its folder; installed modules of the same name come first. For mirrorskin, nothing is added.

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
    try:
        if place.partition(".")[0] == "mirrorskin":
            found = importlib.import_module(module)
        else:
            with _importable(str(folder.resolve())):
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


@contextmanager
def _importable(folder: str) -> Iterator[None]:
    """Let modules of a folder be imported, after all others."""
    with _path_lock:
        sys.path.append(folder)
    try:
        yield
    finally:
        with _path_lock, suppress(ValueError):  # the module may have removed it
            del sys.path[len(sys.path) - 1 - sys.path[::-1].index(folder)]  # the last, if it was there before


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
