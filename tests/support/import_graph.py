"""Which module of the product imports which, imports in functions included, and those for types left out."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

ROOT = Path(__file__).resolve().parents[2]
FILES = {
    ".".join(("mirrorskin", *file.relative_to(ROOT).with_suffix("").parts)).removesuffix(".__init__"): file
    for package in ROOT.glob("*/__init__.py")
    for file in package.parent.rglob("*.py")
}
"""The file of each module and package."""


def _public_names() -> dict[tuple[str, str], tuple[str, str]]:
    """Return where a name of a package, listed in its ``__init__.pyi``, comes from."""
    names: dict[tuple[str, str], tuple[str, str]] = {}
    for package, file in FILES.items():
        stub = file.with_suffix(".pyi")
        if file.stem == "__init__" and stub.exists():
            for node in ast.parse(stub.read_text(encoding="utf-8")).body:
                if isinstance(node, ast.ImportFrom):
                    module = f"{package}.{node.module}" if node.module else package
                    names |= {(package, name.name): (module, name.name) for name in node.names}
    return names


_PUBLIC = _public_names()


def _defining(module: str, name: str) -> str:
    """Return the module that defines a name, or the module that it is imported from."""
    if f"{module}.{name}" in FILES:
        return f"{module}.{name}"
    if (module, name) in _PUBLIC and _PUBLIC[module, name] != (module, name):
        return _defining(*_PUBLIC[module, name])
    return module


def _executed(module: ast.AST) -> Iterator[ast.AST]:
    """Yield the nodes of a module, without those that only type checkers read."""
    nodes = [module]
    while nodes:
        node = nodes.pop()
        if not (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"):
            yield node
            nodes.extend(ast.iter_child_nodes(node))


def _imported(file: Path) -> Iterator[str]:
    """Yield the modules that a file imports, and those whose names it gets from a package."""
    packages, nodes = {}, list(_executed(ast.parse(file.read_text(encoding="utf-8"))))
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            for name in node.names:
                module = _defining(str(node.module), name.name)
                packages[name.asname or name.name] = module
                yield module
    for node in nodes:
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            package = packages.get(node.value.id, "")
            if (package, node.attr) in _PUBLIC:
                yield _defining(package, node.attr)


@cache
def imports() -> set[tuple[str, str]]:
    """Return the pairs of a module and another one that it imports."""
    pairs = {(module, other) for module, file in FILES.items() for other in _imported(file)}
    return {(module, other) for module, other in pairs if other in FILES and other != module}


def folder_of(module: str) -> str:
    """Return the folder of a module."""
    return FILES[module].relative_to(ROOT).parent.as_posix()


def knots(pairs: Iterable[tuple[str, str]]) -> list[set[str]]:
    """Return the groups of names that lead to each other."""
    pairs = sorted(pairs)
    names = sorted({name for pair in pairs for name in pair})
    number = {name: place for place, name in enumerate(names)}
    rows, columns = ([number[pair[side]] for pair in pairs] for side in (0, 1))
    graph = coo_matrix((np.ones(len(pairs)), (rows, columns)), (len(names), len(names)))
    _, group = connected_components(graph, connection="strong")
    groups = [{name for name, of in zip(names, group, strict=True) if of == number} for number in set(group)]
    return [group for group in groups if len(group) > 1]
