"""Load a user's own class, named in a command or a file."""

from __future__ import annotations

import importlib.util
import sys
import threading
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

from mirrorskin.io.base.arguments import nearest, unknown_argument
from mirrorskin.io.base.types import InputError

OPERATIONS = "mirrorskin.operations"
"""Group of entry points by which packages give names to their operations."""

_OWN = "mirrorskin_own_"  # what names of modules that are run from files begin with
_path_lock = threading.Lock()  # of changes to sys.path


def load_class(name: str | type, group: str = "") -> Callable[..., Any]:
    """Return a class given as MODULE:CLASS or FILE.py:CLASS; modules may be in the current folder.

    A class itself is returned as it is. With a ``group`` of entry points, the name of an installed one is
    accepted, too.

    While MODULE is imported, modules of the current folder can be imported too, and while FILE.py is run,
    those of its folder; installed modules of the same name come first. For mirrorskin, nothing is added.

    Missing modules and classes raise `InputError`. Errors of the module itself are not caught.

    Examples
    --------
    >>> load_class("fractions:Fraction")(6, 8)
    Fraction(3, 4)
    """
    if not isinstance(name, str):
        return name
    place, _, kind = (_class_of(name, group) if group and ":" not in name else name).rpartition(":")
    file = Path(place) if place.endswith(".py") else None
    if not place or not all(part.isidentifier() for part in kind.split(".")):
        raise InputError(f"{name}: name a class as MODULE:CLASS or FILE.py:CLASS")
    folder, module = (Path(), place) if file is None else (file.parent, file.stem)
    if file is not None and not file.is_file():
        raise InputError(f"{name}: there is no {file.name} in {folder.resolve()}")
    try:
        if place.partition(".")[0] == "mirrorskin":
            loaded = importlib.import_module(module)
        else:
            with _importable(str(folder.resolve())):
                loaded = importlib.import_module(module) if file is None else _run(file)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise  # an import of the module itself failed
        raise InputError(f"{name}: there is no {place} in {folder.resolve()}, nor installed") from None
    value: Any = loaded
    for part in kind.split("."):
        value = getattr(value, part, None)
    if not callable(value):
        exported = getattr(loaded, "__all__", ())
        classes = {
            attribute: it
            for attribute in exported or vars(loaded)
            if isinstance(it := getattr(loaded, attribute), type)
        }
        names = [
            attribute for attribute, it in classes.items() if exported or it.__module__ == loaded.__name__
        ]
        raise InputError(f"{name}: {unknown_argument(place, kind, names, 'class')}")
    return value  # type: ignore[no-any-return]


def installed_names(group: str) -> list[str]:
    """Return the names of the entry points in a group, which installed packages declare."""
    return sorted({point.name for point in entry_points(group=group)})


def installed_class(name: str, group: str) -> str | None:
    """Return MODULE:CLASS of the entry point with a name in a group; None if there is no such one."""
    return next((f"{point.module}:{point.attr}" for point in entry_points(group=group, name=name)), None)


def _class_of(name: str, group: str) -> str:
    """Return MODULE:CLASS of an entry point; InputError with the nearest name if there is no such one."""
    installed = installed_class(name, group)
    if installed is None:
        close = nearest(name, installed_names(group))
        remedy = f"did you mean {close}?" if close else "name a class as MODULE:CLASS or FILE.py:CLASS"
        raise InputError(f"{name}: {remedy}")
    return installed


def name_of(kind: type) -> str:
    """Return MODULE:CLASS of a class, or FILE.py:CLASS if it was loaded from a file.

    Examples
    --------
    >>> import fractions
    >>> name_of(fractions.Fraction)
    'fractions:Fraction'
    """
    module = kind.__module__
    is_file = module.startswith(_OWN) and module in sys.modules
    place = str(Path(str(sys.modules[module].__file__)).resolve()) if is_file else module
    return f"{place}:{kind.__qualname__}"


def importable_name(kind: type) -> str:
    """Return the name of a class by which another process can load it.

    Raises
    ------
    mirrorskin.io.InputError
        It is defined in the program itself, or in a function.
    """
    where = kind.__module__
    value: Any = sys.modules.get(where)
    for part in kind.__qualname__.split("."):
        value = getattr(value, part, None)
    if where in ("__main__", "__mp_main__") or value is not kind:
        if value is not kind:
            where = "a function" if "<locals>" in kind.__qualname__ else f"no place of {where}"
        name = kind.__qualname__.rpartition(".")[2]
        raise InputError(
            f"{name} is defined in {where}: another process cannot import it. Move it to a module"
        )
    return name_of(kind)


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
    name = f"{_OWN}{file.stem}_{zlib.crc32(bytes(file.resolve())):08x}"
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
