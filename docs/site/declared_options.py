"""An extension of griffe for the Python reference.

Griffe reads the source without running it, but signatures and docstrings of operations, steps, methods and
functions on arrays are generated when a module is imported (engine/base/options.py,
engine/base/operation.py). They are replaced by those of the imported object.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Iterator
from functools import cached_property
from typing import Any

import griffe

from mirrorskin.engine.base.options import Configured

_KINDS: dict[Any, griffe.ParameterKind] = {
    inspect.Parameter.POSITIONAL_OR_KEYWORD: griffe.ParameterKind.positional_or_keyword,
    inspect.Parameter.KEYWORD_ONLY: griffe.ParameterKind.keyword_only,
}


class DeclaredOptions(griffe.Extension):
    """Shows declared options, and types and units such as "float, share" as they are written."""

    def on_package(self, *, pkg: griffe.Module, loader: griffe.GriffeLoader, **kwargs: Any) -> None:
        """Replace docstrings and signatures, after all modules of a package have been read."""
        if pkg.path == "mirrorskin":
            for module in _modules_of(pkg):
                if module.path.startswith("mirrorskin.engine"):
                    _add_options(module, loader)
                _replace_docstrings(module)


class _Docstring(griffe.Docstring):
    """A docstring in which a type of several parts, such as "array_like, (T,)", is not shown as a tuple."""

    @cached_property
    def parsed(self) -> list[griffe.DocstringSection]:
        sections: list[griffe.DocstringSection] = self.parse()
        for section in sections:
            for field in section.value if isinstance(section.value, list) else ():
                if isinstance(getattr(field, "annotation", None), griffe.ExprTuple):
                    field.annotation = ", ".join(map(str, field.annotation.elements))
        return sections


def _modules_of(module: griffe.Module) -> Iterator[griffe.Module]:
    yield module
    for submodule in module.modules.values():
        if not submodule.is_alias:
            yield from _modules_of(submodule)


def _add_options(module: griffe.Module, loader: griffe.GriffeLoader) -> None:
    """Replace generated docstrings and signatures in a module."""
    for name, member in list(module.members.items()):
        is_class = isinstance(member, griffe.Class) and member.bases
        if name.startswith("_") or not (is_class or isinstance(member, griffe.Attribute)):
            continue
        value = getattr(importlib.import_module(module.path), name, None)
        if isinstance(value, type) and issubclass(value, Configured):
            member.docstring = _docstring(value, member, loader)
            if value.options:
                member.set_member("__init__", griffe.Function("__init__", parameters=_parameters(value)))
        elif inspect.isfunction(value) and "__signature__" in vars(value):
            function = griffe.Function(name, parameters=_parameters(value), lineno=member.lineno)
            function.returns = griffe.ExprName("Result")
            function.docstring = _docstring(value, function, loader)
            module.set_member(name, function)


def _docstring(value: Any, parent: Any, loader: griffe.GriffeLoader) -> griffe.Docstring | None:
    text = inspect.cleandoc(vars(value).get("__doc__") or getattr(value, "__doc__", None) or "")
    if not text:
        return None
    parser, options = loader.docstring_parser, loader.docstring_options
    return griffe.Docstring(text, lineno=parent.lineno, parent=parent, parser=parser, parser_options=options)


def _parameters(value: Any) -> griffe.Parameters:
    """Return the parameters of a generated signature."""
    parameters = inspect.signature(value).parameters.values()
    return griffe.Parameters(*[_parameter(parameter) for parameter in parameters])


def _parameter(parameter: inspect.Parameter) -> griffe.Parameter:
    default = None if parameter.default is parameter.empty else repr(parameter.default)
    return griffe.Parameter(parameter.name, kind=_KINDS[parameter.kind], default=default)


def _replace_docstrings(parent: Any) -> None:
    for member in [parent, *parent.members.values()]:
        old = None if member.is_alias else member.docstring
        if old is not None and not isinstance(old, _Docstring):
            member.docstring = _Docstring(
                old.value,
                lineno=old.lineno,
                endlineno=old.endlineno,
                parent=member,
                parser=old.parser,
                parser_options=old.parser_options,
            )
        if member is not parent and not member.is_alias and member.is_class:
            _replace_docstrings(member)
