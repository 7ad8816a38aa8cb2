"""A user's own class, named in a command or a file."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mirrorskin.io.types import InputError


def load_class(name: str) -> Callable[..., Any]:
    """Return the class that is named MODULE:CLASS or FILE.py:CLASS; modules may lie in the current folder.

    An `InputError` says what is not there. What the module itself raises is passed on.

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
    sys.path.insert(0, str(folder.resolve()))
    try:
        found = importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise  # what the module itself imports
        raise InputError(f"{name}: there is no {place} in {folder.resolve()}, nor installed") from error
    made = getattr(found, kind, None)
    if not callable(made):
        own = [one for one, it in vars(found).items() if isinstance(it, type) and it.__module__ == module]
        raise InputError(f"{name}: there is no class {kind} in {place}; it has {', '.join(own) or 'none'}")
    return made  # type: ignore[no-any-return]
