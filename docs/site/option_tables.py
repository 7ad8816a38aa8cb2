"""The tables of methods, operations and options in docs/operations.md and docs/options.md.

``python docs/site/option_tables.py`` (in the environment) writes them into the pages from the declarations; a
test compares them.
"""

from __future__ import annotations

import importlib
import inspect
import re
import textwrap
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from map_tables import as_table

from mirrorskin.engine.base.method import Method
from mirrorskin.engine.base.operation import Operation
from mirrorskin.engine.base.options import Option, plain

DOCS = Path(__file__).resolve().parents[1]
OPTIONS = "options.md"
OPERATIONS = "operations.md"
MARK = "<!-- The rest is generated: python docs/site/option_tables.py -->\n"

_PACKAGES = ("", ".press", ".rotation", ".correlation", ".vibration", ".slip", ".optical")
_COMMON = ("device", "memory_limit")  # described once, above the tables
_FUNCTIONS = {"MovingNormals": "estimate_normals"}  # which chooses between two operations
_KINDS = {"flag": "`True` or `False`", "file": "path, result or array", "object": "object"}
_KINDS |= {"text": "text", "path": "path"}


def classes(base: type) -> dict[str, Any]:
    """Return the public methods or operations, by the shortest name under which they are imported."""
    names: dict[type, str] = {}
    for package in _PACKAGES:
        module = _module(package)
        for name in _public(module):
            value = getattr(module, name)
            if isinstance(value, type) and issubclass(value, base) and value is not base:
                names.setdefault(value, f"engine{package}.{name}")
    return {name: kind for kind, name in names.items()}


def function_of(name: str) -> str:
    """Return the name of the function on arrays that is made from an operation; empty if there is none."""
    package, _, operation = name.removeprefix("engine").rpartition(".")
    for place in (package, *_PACKAGES):
        module = _module(place)
        kind = getattr(module, operation, None)
        if kind is None:
            continue
        options = [option for option in kind.options if option != "memory_limit"]
        for public in _public(module):
            function = getattr(module, public)
            if public == _FUNCTIONS.get(operation) or (
                "__signature__" in getattr(function, "__dict__", {})
                and not isinstance(function, type)
                and _keywords(function.__signature__) == options
            ):
                return f"engine{place}.{public}"
    return ""


def methods_table() -> str:
    """Return the table of methods."""
    rows = [
        [_linked(name), ", ".join(kind.motions), _summary(kind)] for name, kind in classes(Method).items()
    ]
    return as_table(["method", "motion", "result"], rows)


def operations_table() -> str:
    """Return the table of operations."""
    return as_table(
        ["operation", "motion", "of each frame", "maps", "function on arrays"],
        (_operation(name, kind) for name, kind in classes(Operation).items()),
    )


def _operation(name: str, kind: type[Operation]) -> list[str]:
    needed = " or ".join(f"`{position}`" for position in kind.positions)
    maps = ", ".join(f"`{name}`" for name in kind.maps)
    function = function_of(name)
    return [
        _linked(name),
        ", ".join(kind.motions) or "any",
        needed,
        maps,
        f"`{function}`" if function else "",
    ]


def options_section(name: str, kind: Any) -> str:
    """Return heading, summary and table of the options of a class."""
    options = {name: declared for name, declared in kind.options.items() if name not in _COMMON}
    table = as_table(["option", "value", "default", "meaning"], map(_option, options.values()))
    about = textwrap.fill(f"`{name}`. {_summary(kind)}.", 100, break_on_hyphens=False)
    return f"### `{name.rpartition('.')[2]}`\n\n{about}\n\n{table}"


def _option(option: Option) -> list[str]:
    help_text = f"{option.help[:1].upper()}{option.help[1:]}".rstrip(".")
    only = ". Python only" if option.python_only else ""
    return [f"`{option.name}`", _value(option), _default(option), f"{help_text}{only}"]


def _value(option: Option) -> str:
    """Return type, unit and limits of an option."""
    if option.choices:
        return ", ".join(f'`"{choice}"`' for choice in option.choices)
    if option.kind == "map":
        return f"number or map, {option.unit}" if option.unit else "number or array"
    value = _KINDS.get(str(option.kind)) or option.needed.removeprefix("a ")
    if option.kind == "integer" and value.startswith("number of at"):
        value = f"integer {value.removeprefix('number ')}"
    if option.kind in ("numbers", "integers"):
        value = f"list, each a {value}"
    return " or ".join([value, *(f'`"{word}"`' for word in option.words)])


def _default(option: Option) -> str:
    if option.shown_default or option.default is None:
        return option.shown_default or "none"
    return f"`{plain(option.default)!r}`".replace("'", '"')


def _linked(name: str) -> str:
    anchor = name.rpartition(".")[2].lower()
    return f"[`{name}`]({OPTIONS}#{anchor})"


def _summary(kind: type) -> str:
    return (kind.__doc__ or "").partition("\n")[0].rstrip(".")


def _keywords(signature: inspect.Signature) -> list[str]:
    parameters = signature.parameters.values()
    return [parameter.name for parameter in parameters if parameter.kind is parameter.KEYWORD_ONLY]


def _module(package: str) -> ModuleType:
    return importlib.import_module(f"mirrorskin.engine{package}")


def _public(module: ModuleType) -> Iterable[str]:
    public = [
        name
        for name, value in vars(module).items()
        if not name.startswith("_") and getattr(value, "__module__", None) == module.__name__
    ]
    names: list[str] = getattr(module, "__all__", public)
    return sorted(names, key=str.lower)


def pages() -> Mapping[str, str]:
    """Return the pages with their current tables, by name."""
    options = (DOCS / OPTIONS).read_text(encoding="utf-8")
    assert options.count(MARK) == 1, f"{OPTIONS} needs one line {MARK}"
    sections = ["## Methods\n", *(options_section(*documented) for documented in classes(Method).items())]
    sections += [
        "## Operations\n",
        *(options_section(*documented) for documented in classes(Operation).items()),
    ]
    operations = (DOCS / OPERATIONS).read_text(encoding="utf-8")
    for table in (methods_table(), operations_table()):
        head = re.escape(table.partition("\n")[0])
        old = re.findall(rf"^{head}\n(?:\|.*\n)+", operations, flags=re.MULTILINE)
        assert len(old) == 1, f"{OPERATIONS} needs one table: {head}"
        operations = operations.replace(old[0], table)
    return {OPTIONS: options.partition(MARK)[0] + MARK + "\n" + "\n".join(sections), OPERATIONS: operations}


if __name__ == "__main__":
    for page, text in pages().items():
        (DOCS / page).write_text(text, encoding="utf-8")
