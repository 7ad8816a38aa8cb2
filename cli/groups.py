"""Commands from functions with annotated parameters, and groups that import them on first use."""

from __future__ import annotations

import inspect
import keyword
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from enum import StrEnum
from importlib import import_module
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Any, get_args, get_origin, get_type_hints

import click
from click.shell_completion import CompletionItem

if TYPE_CHECKING:
    from mirrorskin.io import Motion

_WRITTEN = {"--output", "--record", "--chart"}  # options of files to write; other paths are read
MOTIONS: tuple[Motion, ...] = ("vertical", "axial", "horizontal", "twist")
_COMMON = ("calibration", "memory", "device", "as_json")  # options that follow the declared ones in help
_NOUNS = {"vertical": "press", "axial": "rotation", "horizontal": "slide", "rock": "rocking motion"}


class Option:
    """Settings of click for an option: ``Annotated[float, Option("--rate", help=...)]``.

    With ``or_file``, a text with an ending is a file that must exist. ``motions`` are the only ones that the
    option applies to; see `refuse_foreign`.
    """

    def __init__(self, *names: str, **settings: Any) -> None:
        self.names, self.settings = names, settings


class Argument(Option):
    """Settings of click for an argument."""


class MotionOption(click.Option):
    """An option that may apply to some motions only; see `refuse_foreign`."""

    def __init__(self, names: Sequence[str], *, motions: Sequence[str] = (), **settings: Any) -> None:
        self.motions = tuple(motions)
        super().__init__(names, **{"show_default": True, **settings})

    def get_help_extra(self, ctx: click.Context) -> Any:
        """Return the additions to an option's help, without click's parentheses around a default."""
        shown = {"default": self.show_default} if isinstance(self.show_default, str) else {}
        return {**super().get_help_extra(ctx), **shown}


def for_motions(motions: Sequence[str], text: str) -> str:
    """Return a text after the motions to which it applies, unless these are all."""
    nouns = ", ".join(_NOUNS.get(motion, motion) for motion in motions)
    return text if not motions or {*MOTIONS} <= {*motions} else f"{nouns}: {text}"


def refuse_foreign(context: click.Context, motion: str, name: str = "this") -> None:
    """Raise InputError if an option on the command line does not apply to the motion of ``name``."""
    from mirrorskin.io import InputError

    for parameter in context.command.get_params(context):
        source = context.get_parameter_source(parameter.name or "")
        if not isinstance(parameter, MotionOption) or not parameter.motions or motion in parameter.motions:
            continue
        if source is not None and source.name == "COMMANDLINE":
            nouns = [_NOUNS.get(other, other) for other in parameter.motions]
            *others, last = [f"{noun}es" if noun.endswith("s") else f"{noun}s" for noun in nouns]
            plurals = f"{', '.join(others)} and {last}" if others else last
            noun = _NOUNS.get(motion, motion)
            raise InputError(f"{parameter.opts[0]} applies to {plurals} only; {name} is a {noun}. Remove it")


class Group(click.Group):
    """A group whose help lists the purposes of its commands in full and in the given order."""

    def add(self, function: Callable[..., Any], name: str | None = None) -> Callable[..., Any]:
        """Add a command that calls a function; also as a decorator."""
        self.add_command(make_command(name or function.__name__, function))
        return function

    def purposes(self) -> Mapping[str, str]:
        """Return the purposes of the commands by name."""
        return {name: (command.help or "").split("\n\n")[0] for name, command in self.commands.items()}

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names, in the order of the help."""
        return list(self.commands)

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Return matching commands and options; unlike click's method, it imports no command."""
        commands = [
            CompletionItem(name, help=purpose)
            for name, purpose in self.purposes().items()
            if name.startswith(incomplete)
        ]
        return [*commands, *click.Command.shell_complete(self, ctx, incomplete)]

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List options and commands."""
        _list_parameters(self, ctx, formatter)
        with formatter.section("Commands"):
            formatter.write_dl(list(self.purposes().items()))


class LazyGroup(Group):
    """A group whose commands are modules of a package, with a function ``command`` or a group ``app``."""

    def __init__(self, package: str, purposes: Mapping[str, str], **settings: Any) -> None:
        super().__init__(**settings)
        self.commands: Any = _Commands(package, tuple(purposes))
        self._purposes = purposes

    def purposes(self) -> Mapping[str, str]:
        """Return the given purposes, without importing a command."""
        return self._purposes


def make_command(
    name: str | None, function: Callable[..., Any], kind: Callable[..., Any] | None = None, **settings: Any
) -> Any:
    """Return a command, or a group of this kind, that calls a function.

    A parameter of the type ``click.Context`` gets the context. The docstring is the help. Keywords,
    ``**chosen: Annotated[Any, declared(...)]``, are the given ones of other options.
    """
    hints = get_type_hints(function, include_extras=True)
    named = dict(inspect.signature(function).parameters)
    context = next((name for name in named if hints[name] is click.Context), None)
    if context is not None:
        del named[context]
    parameters: list[click.Parameter] = []
    for parameter in [*named.values()]:
        if parameter.kind is parameter.VAR_KEYWORD:
            for declared in get_args(hints[parameter.name])[1:]:
                parameters += declared.parameters()
            del named[parameter.name]
        else:
            parameters.append(_parameter(parameter, hints[parameter.name]))
    if len(named) < len(parameters):
        parameters.sort(key=lambda parameter: parameter.name in _COMMON)

    def call(**values: Any) -> Any:
        for name, parameter in named.items():
            if isinstance(values[name], tuple):
                values[name] = list(values[name]) or parameter.default
        arguments = {name: value for name, value in values.items() if name in named or value is not None}
        return function(**arguments, **({context: click.get_current_context()} if context else {}))

    command_class = Command if kind is None else kind
    return command_class(
        name=name, params=parameters, callback=call, help=inspect.getdoc(function) or "", **settings
    )


class Command(click.Command):
    """A command whose help also lists arguments, and which uses the user's defaults."""

    def make_context(
        self, info_name: str | None, args: list[str], parent: click.Context | None = None, **extra: Any
    ) -> click.Context:
        """Return the context of the command, with the user's defaults."""
        if not extra.get("resilient_parsing"):  # a shell completes it
            from mirrorskin.cli.defaults import option_defaults

            extra["default_map"] = option_defaults()
        return super().make_context(info_name, args, parent, **extra)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List arguments and options."""
        _list_parameters(self, ctx, formatter)


class CommandGroup(LazyGroup, Command):
    """A command that also has commands of its own, which take none of its options."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(invoke_without_command=True, **settings)


class _Argument(click.Argument):
    """An argument that help lists."""

    def __init__(self, name: str, settings: dict[str, Any]) -> None:
        self._help = settings.pop("help")
        super().__init__([name], **settings)

    def get_help_record(self, ctx: click.Context) -> tuple[str, str]:
        return self.make_metavar(ctx), f"{self._help}{'  [required]' if self.required else ''}"


class _Missing(click.ClickException):
    exit_code = 2


class AnyPath(click.Path):
    """A path, or an address."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the path of a text."""
        from mirrorskin.io.base.url import path_of

        return path_of(os.fsdecode(super().convert(value, param, ctx)))


class ExistingPath(AnyPath):
    """The path of a file to read; a missing one is reported before anything heavy is imported."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the path of a file that exists, or an address."""
        from mirrorskin.io.base.url import Url, path_of

        path = path_of(value)
        try:
            if not isinstance(path, Url):  # the command checks addresses
                path.stat()
        except (FileNotFoundError, NotADirectoryError):
            raise _Missing(f"{value}: no such file") from None
        except OSError:  # the command reports it
            pass
        return super().convert(value, param, ctx)


def matches(word: str, what: str) -> list[Any] | None:
    """Return the files and Zarr stores that a pattern, such as ``lot/*.h5``, matches; None for a path.

    InputError without any; ``what`` names them.
    """
    import glob

    from mirrorskin.io.base.url import Url, is_zarr, path_of

    path = path_of(word)
    if os.path.lexists(path) or not glob.has_magic(word):
        return None
    from mirrorskin.io import InputError
    from mirrorskin.io.storage.zarr import find_stores

    if isinstance(path, Url):
        return find_stores(path)
    every = map(Path, sorted(glob.glob(word, recursive=True)))  # noqa: PTH207  # paths may be absolute
    found = [
        path for path in every if (path.is_file() or is_zarr(path)) and not any(map(is_zarr, path.parents))
    ]
    if not found:
        raise InputError(f"{word}: no file matches. Name {what}")
    return found


class NameOrFile(click.ParamType[str]):
    """A name, or a file if it has an ending."""

    name = "text"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the text; a file must exist."""
        if Path(value).suffix:
            ExistingPath().convert(value, param, ctx)
        return value

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        """Let the shell complete the name of a file."""
        return [CompletionItem(incomplete, type="file")]


class _Words(click.Choice[Any]):
    """The values of an enumeration."""

    def __init__(self, kind: type[StrEnum]) -> None:
        super().__init__([word.value for word in kind])
        self._kind = kind

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        return self._kind(super().convert(str(value), param, ctx))


class _Commands(Mapping[str, Any]):
    """Commands by name, each imported on first use."""

    def __init__(self, package: str, names: tuple[str, ...]) -> None:
        self._package, self._names = package, names
        self._made: dict[str, Any] = {}

    def __getitem__(self, name: str) -> Any:
        if name not in self._names:
            raise KeyError(name)
        if name not in self._made:
            place = f"{name}_" if keyword.iskeyword(name) else name
            module = import_module(f"{self._package}.{place}")
            self._made[name] = getattr(module, "app", None) or make_command(name, module.command)
            self._made[name].name = name
        return self._made[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def _parameter(parameter: inspect.Parameter, hint: Any) -> click.Parameter:
    """Return the parameter of click for a parameter of a function."""
    kind, declaration = get_args(hint)[:2]
    kind = next(
        (member for member in get_args(kind) if NoneType in get_args(kind) and member is not NoneType), kind
    )
    many = get_origin(kind) is list
    kind = get_args(kind)[0] if many else kind
    settings = dict(declaration.settings)
    bounds = {name: settings.pop(name) for name in ("min", "max") if name in settings}
    or_file, written = settings.pop("or_file", False), not _WRITTEN.isdisjoint(declaration.names)
    settings["type"] = NameOrFile() if or_file else _type(kind, bounds, written)
    settings["required"] = parameter.default is parameter.empty
    if parameter.default is not parameter.empty and not many:
        default = parameter.default
        settings["default"] = default.value if isinstance(default, StrEnum) else default
    if isinstance(declaration, Argument):
        return _Argument(parameter.name, {**settings, "nargs": -1 if many else 1})
    names = declaration.names
    if kind is bool:
        settings = {**settings, "is_flag": True, "type": None}
    if not names:
        plain = parameter.name.replace("_", "-")
        names = (f"--{plain}/--no-{plain}" if kind is bool else f"--{plain}",)
    if "motions" in settings:
        settings["help"] = for_motions(settings["motions"], settings["help"])
        settings["help"] = settings["help"][:1].upper() + settings["help"][1:]
    return MotionOption([*names, parameter.name], multiple=many, **settings)


def _type(kind: Any, bounds: dict[str, Any], written: bool) -> Any:
    if bounds:
        return (click.IntRange if kind is int else click.FloatRange)(**bounds)
    if kind is Path:
        return (AnyPath if written else ExistingPath)()
    return _Words(kind) if issubclass(kind, StrEnum) else kind


def _list_parameters(command: click.Command, ctx: click.Context, formatter: click.HelpFormatter) -> None:
    for title, kind in (("Arguments", click.Argument), ("Options", click.Option)):
        records = [
            parameter.get_help_record(ctx)
            for parameter in command.get_params(ctx)
            if isinstance(parameter, kind)
        ]
        if any(records):
            with formatter.section(title):
                formatter.write_dl([record for record in records if record is not None])
