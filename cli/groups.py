"""Groups of commands that are imported when they are named."""

from __future__ import annotations

import keyword
from collections.abc import Iterator, Mapping
from importlib import import_module
from typing import Any

import typer
from typer.core import TyperGroup


class Group(TyperGroup):
    """A group whose help says in full what its commands are for."""

    def get_help_option(self, ctx: Any) -> Any:
        """Give it a default: for None, typer imports pydantic."""
        option = super().get_help_option(ctx)
        if option is not None:
            option.default = False
        return option

    def purposes(self) -> Mapping[str, str]:
        """Return what each command is for."""
        return {name: (command.help or "").split("\n\n")[0] for name, command in self.commands.items()}

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """List the commands."""
        with formatter.section("Commands"):
            formatter.write_dl(list(self.purposes().items()))


def lazy_group(package: str, purposes: Mapping[str, str]) -> type[TyperGroup]:
    """Return the class of a group whose commands are modules with a function ``command``, or an ``app``."""

    class LazyGroup(Group):
        def __init__(self, **given: Any) -> None:
            super().__init__(**given)
            self.commands: Any = _Commands(package, tuple(purposes))

        def purposes(self) -> Mapping[str, str]:
            """Return what was given: no command is needed for it."""
            return purposes

    return LazyGroup


class _Commands(Mapping[str, Any]):
    """Commands by name, each made when it is asked for."""

    def __init__(self, package: str, names: tuple[str, ...]) -> None:
        self._package, self._names = package, names
        self._made: dict[str, Any] = {}

    def __getitem__(self, name: str) -> Any:
        if name not in self._names:
            raise KeyError(name)
        if name not in self._made:
            place = f"{name}_" if keyword.iskeyword(name) else name
            self._made[name] = _make(name, import_module(f"{self._package}.{place}"))
        return self._made[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def _make(name: str, module: Any) -> Any:
    """Make a module's command as typer makes it in a group of all."""
    alone = typer.Typer(add_completion=False, rich_markup_mode=None)
    if hasattr(module, "app"):
        alone.add_typer(module.app, name=name)
        group: Any = typer.main.get_command(alone)
        return group.commands[name]
    alone.command(name)(module.command)
    return typer.main.get_command(alone)
