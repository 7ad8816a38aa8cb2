"""Formats and drivers that are declared once: in modules that are not imported for this, and in packages.

A module declares one as ``NAME = Kind(...)`` with literal arguments, so that help texts and errors list all
without importing any. An installed package names its own by entry points. Nothing heavy is imported here.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

_Declared = TypeVar("_Declared")


def declared(kind: type[_Declared], files: Iterable[Path], package: str) -> tuple[_Declared, ...]:
    """Return the declarations of a kind in files of a package's folders, with the names of their modules."""
    call = rf"{kind.__name__}\([^\n]*\)|{kind.__name__}\(\n.*?^\)"
    pattern = re.compile(rf"^\w+ = ({call})$", re.MULTILINE | re.DOTALL)
    declarations = []
    for file in files:
        for text in pattern.findall(_read(file)):
            expression = ast.parse(text, mode="eval").body
            assert isinstance(expression, ast.Call)
            values: dict[str, Any] = {"module": f"{package}.{file.parent.name}.{file.stem}"}
            values |= {str(word.arg): ast.literal_eval(word.value) for word in expression.keywords}
            declarations.append(kind(**values))
    return tuple(declarations)


def installed(group: str, what: str, name: str = "") -> Iterator[tuple[EntryPoint, Any]]:
    """Yield the entry points of a group and what they load; with a name, only those of this name.

    InputError if one cannot be loaded; ``what`` names it there.
    """
    from importlib.metadata import entry_points

    for point in entry_points(group=group, name=name) if name else entry_points(group=group):
        try:
            value = point.load()
        except (ImportError, AttributeError) as error:
            from mirrorskin.io.base.types import InputError

            raise InputError(
                f"the {what} {point.name} of an installed package cannot be loaded: {error}; repair or"
                " uninstall the package"
            ) from None
        yield point, value


def _read(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8")
    except OSError as error:
        from mirrorskin.io.base.types import InputError

        raise InputError(f"{file} cannot be read ({error}); reinstall mirrorskin") from None
