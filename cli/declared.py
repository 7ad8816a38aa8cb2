"""Options that the engine declares, as options of commands.

``declared.json`` is a copy of the declarations, since help and completion must not wait for the engine. After
a change of a declaration, ``python -m mirrorskin.cli.declared`` writes it anew; a test compares the two.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mirrorskin.cli.groups import (
    MOTIONS,
    AnyPath,
    Command,
    ExistingPath,
    MotionOption,
    NameOrFile,
    for_motions,
)

if TYPE_CHECKING:
    from mirrorskin.engine.base.options import Option

_FILE = re.compile(r"\.[A-Za-z]\w*$")
_NAME = re.compile(r"[A-Za-z_][\w-]*")  # of an operation of an installed package
_CLASS = re.compile(r"(?:--operation=)?([^-].*:[A-Za-z_]\w*)")
_LOADED = "mirrorskin.cli.declared"  # key of a context's class and its options
_SHARED = ("tilt",)  # options of a stage that classes have, too, with the same meaning
_COPY = Path(__file__).with_suffix(".json")
_UNITS = {  # placeholder in help, function of `mirrorskin.cli.quantity`, example
    "mm": ("LENGTH", "length", "0.1mm"),
    "rad": ("ANGLE", "angle", "2.5deg"),
    "MPa": ("PRESSURE", "pressure", "0.1MPa"),
    "N": ("FORCE", "force", "1.5N"),
    "s": ("TIME", "duration", "10ms"),
    "counts/rad": ("COUNTS/ANGLE", "per_angle", "5.7/deg"),
    "mm/N": ("LENGTH/N", "compliance", "0.01mm/N"),
    "mm,mm": ("LENGTH[,LENGTH]", "lengths", "0.03mm"),
    "region": ("X,Y,WxH", "region", "100,50,640x480"),
    "range": ("A:B", "frame_range", "10:200"),
    "WxH": ("WxH", "frame_size", "640x480"),
}


@dataclass(frozen=True)
class Term:
    """An option as a command shows and reads it."""

    name: str
    kind: str
    help: str
    unit: str = ""
    shown_default: str = ""
    choices: Sequence[str] = ()
    words: Sequence[str] = ()
    file: str = ""
    motions: Sequence[str] = ()
    default: str = ""  # as on the command line
    least: int | None = None
    most: int | None = None

    @property
    def example(self) -> str:
        """A value with a unit; empty if values have none."""
        return _UNITS.get(self.unit, ("", "", ""))[2]

    @property
    def metavar(self) -> str:
        """Placeholder for a value in help."""
        shown = self.unit if self.kind == "text" else self.unit.upper()
        plain = shown or ("N" if self.kind in ("integer", "integers") else "NUMBER")
        several = {"numbers": "[,...]", "integers": "[,...]", "map": "|FILE"}.get(self.kind, "")
        return "|".join([_UNITS.get(self.unit, (plain,))[0] + several, *self.words])

    def read(self, text: str, where: str) -> Any:
        """Return the value of a text on the command line, in the option's unit."""
        if self.kind in ("numbers", "integers"):
            if self.unit in _UNITS:
                from mirrorskin.cli.quantity import refuse_decimal_comma

                refuse_decimal_comma(text, where, several=True)
            return [self.read_one(part, where) for part in text.split(",")]
        return self.read_one(text, where)

    def read_one(self, text: str, where: str) -> Any:
        """Return the value of a text; ``where`` begins messages."""
        from mirrorskin.cli import quantity
        from mirrorskin.io import InputError

        if text in self.words or self.kind in ("choice", "text", "path", "file", "name"):
            return text
        if self.kind == "map" and _FILE.search(text):
            return ExistingPath().convert(text, None, None)
        plain = "integer" if self.kind in ("integer", "integers") else "number"
        try:
            value = getattr(quantity, _UNITS.get(self.unit, ("", plain))[1])(text, where)
        except InputError as error:
            message = str(error)
            if self.unit and self.unit not in _UNITS and re.fullmatch(r"[-+.\de]+\s*[A-Za-zµ/]+", text):
                message = f"{where} {text}: a number of {self.unit} is needed, without a unit"
            raise InputError(", or ".join([message, *self.words])) from error
        if self.least is not None and value < self.least:
            raise InputError(f"{where} {text}: a number of at least {self.least} is needed")
        if self.most is not None and value > self.most:
            raise InputError(f"{where} {text}: a number of at most {self.most} is needed")
        return value

    @property
    def flag(self) -> str:
        """Name of the option on the command line."""
        return f"--{self.name.replace('_', '-')}"


class DeclaredOption(MotionOption):
    """The option of click for a term; its value is in the term's unit. ``of_engine``: see `ClassCommand`."""

    def __init__(self, declaration: Term, of_engine: bool = True) -> None:
        self._term, self.of_engine, self.unit = declaration, of_engine, declaration.unit
        names = [
            f"{declaration.flag}/--no-{declaration.flag[2:]}"
            if declaration.kind == "flag"
            else declaration.flag,
            declaration.name,
        ]
        settings: dict[str, Any] = {}
        if declaration.kind == "choice":
            settings = {"type": click.Choice([*declaration.choices])}
        elif declaration.kind == "file":
            settings = {"type": ExistingPath(), "metavar": declaration.file or declaration.unit}
        elif declaration.kind == "path":
            settings = {"type": AnyPath(), "metavar": declaration.unit}
        elif declaration.kind == "name":
            settings = {"type": NameOrFile(), "metavar": declaration.unit}
        elif declaration.kind == "switch":
            settings = {"is_flag": True}
        elif declaration.kind != "flag":
            settings = {
                "metavar": declaration.metavar,
                "multiple": declaration.kind in ("numbers", "integers"),
            }
        super().__init__(
            names,
            help=f"{declaration.help[:1].upper()}{declaration.help[1:].rstrip('.')}.",
            default=None,
            show_default=declaration.shown_default or declaration.default or False,
            motions=declaration.motions,
            **settings,
        )

    def process_value(self, ctx: click.Context, value: Any) -> Any:
        """Read the text, or the texts of an option that is repeated."""
        text = super().process_value(ctx, value)
        if self.multiple:
            text = ",".join(text or ()) or None
        return self._term.read(text, self._term.flag) if isinstance(text, str) else text


@dataclass(frozen=True)
class Terms:
    """Options of a command: ``**chosen: Annotated[Any, Terms(...)]`` receives those that are given."""

    terms: Sequence[Term]
    of_engine: bool = False

    def parameters(self) -> list[DeclaredOption]:
        """Return the options of click."""
        return [DeclaredOption(term, self.of_engine) for term in self.terms]

    def only(self, *names: str) -> Terms:
        """Return some of the options."""
        return replace(self, terms=[term for term in self.terms if term.name in names])

    def without(self, *names: str) -> Terms:
        """Return all options but some."""
        return replace(self, terms=[term for term in self.terms if term.name not in names])

    def filled(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return the values of all options: given ones, defaults, or None."""
        return {
            term.name: values[term.name] if term.name in values else term.read(term.default, term.flag)
            if term.default else None
            for term in self.terms
        }  # fmt: skip


def declared(command: str) -> Terms:
    """Return the engine's options of a command: an entry of ``declared.json``."""
    stored = json.loads(_COPY.read_text(encoding="utf-8"))[command]
    return Terms([Term(**fields) for fields in stored], of_engine=True)


def term(
    name: str,
    text: str,
    unit: str = "",
    default: str = "",
    *,
    motions: Sequence[str] = (),
    kind: str = "number",
    choices: Sequence[str] = (),
    least: int | None = None,
    most: int | None = None,
    shown: str = "",
) -> Term:
    """Return an option of a command that the engine does not declare.

    ``kind`` is "number", "integer", "switch", "flag" (a switch that can also be off, with "no-"), "text",
    "file" or "name" (a file if it has an ending); of the last three, ``unit`` is the placeholder in help.
    ``default`` is a text as on the command line; ``shown`` is what help says instead.
    """
    kind = "choice" if choices else kind
    return Term(
        name, kind, for_motions(motions, text), unit, shown, choices, (), "", motions, default, least, most
    )


class ClassCommand(Command):
    """A command with a word that may be MODULE:CLASS, which adds the options of that class.

    They replace other options of the engine. The tilt of a live rotation is for the stage and the class.
    """

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Load the class, and parse the arguments with its options."""
        name = next((match[1] for word in args if (match := _CLASS.fullmatch(word))), None)
        name = name or _installed(args, any(parameter.name == "class_name" for parameter in self.params))
        if name is None:
            return super().parse_args(ctx, args)
        ctx.meta[_LOADED] = self._load(name)
        from mirrorskin.io.base.arguments import unknown_argument

        try:
            return super().parse_args(ctx, args)
        except click.NoSuchOption as error:
            flags = [option.opts[0] for option in ctx.meta[_LOADED][1]]
            message = unknown_argument(name, error.option_name, flags, "option")
            raise click.UsageError(message, ctx) from None

    def _load(self, name: str) -> tuple[type[Any], list[DeclaredOption]]:
        """Return the class with this name, and its options."""
        from mirrorskin.engine.base.reconstruction import load_operation
        from mirrorskin.io import InputError

        kind = load_operation(name)
        taken: dict[str, click.Parameter | None] = dict.fromkeys(
            self.get_help_option_names(click.Context(self))
        )
        for parameter in self.params:
            if not getattr(parameter, "of_engine", False):
                taken |= dict.fromkeys((*parameter.opts, *parameter.secondary_opts), parameter)
        terms = []
        for term in terms_of({"": kind}):
            if term.flag not in taken:
                terms.append(term)
            elif term.name not in _SHARED or getattr(taken[term.flag], "unit", None) != term.unit:
                raise InputError(
                    f"{name} has an option {term.name}, and so has 'mirrorskin {self.name}' for something"
                    " else. Rename that of the class"
                )
        return kind, [DeclaredOption(term) for term in terms]

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """Return the command's parameters, with the class's options if there is a class."""
        parameters = super().get_params(ctx)
        if _LOADED not in ctx.meta:
            return parameters
        rest = [parameter for parameter in parameters if not getattr(parameter, "of_engine", False)]
        count = sum(isinstance(parameter, click.Argument) for parameter in rest)
        return [*rest[:count], *ctx.meta[_LOADED][1], *rest[count:]]

    def format_help_text(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the help of the command, and that of the class."""
        super().format_help_text(ctx, formatter)
        if _LOADED in ctx.meta:
            kind = ctx.meta[_LOADED][0]
            purpose = (kind.__doc__ or "").strip().split("\n\n")[0]
            with formatter.indentation():
                formatter.write_paragraph()
                formatter.write_text(f"{kind.__name__}: {purpose}")


def _installed(args: Sequence[str], first: bool) -> str | None:
    """Return the name of an operation of an installed package: an option, or the ``first`` word."""
    words = [word for flag, word in pairwise(args) if flag == "--operation"]
    words += [word.removeprefix("--operation=") for word in args if word.startswith("--operation=")]
    words += [word for word in args if _NAME.fullmatch(word)][:first]
    if not words:
        return None
    from mirrorskin.io.base.own_class import OPERATIONS, installed_names

    names = installed_names(OPERATIONS)
    return next((word for word in words if word in names), None)


def terms_of(kinds: Mapping[str, type[Any]]) -> list[Term]:
    """Return the options of classes by motion; options of one name become one.

    A class with the motion ``""`` is for any motion.
    """
    by_name: dict[str, list[Term]] = {}
    for motion, kind in kinds.items():
        for option in kind.options.values():
            if not option.python_only:
                term = replace(term_of(option), motions=(motion,) if motion else ())
                by_name.setdefault(option.name, []).append(term)
    return [_merged(variants) for variants in by_name.values()]


def term_of(option: Option) -> Term:
    """Return the term of a declaration."""
    from mirrorskin.engine.base.options import plain

    shown, default = option.shown_default, plain(option.default)
    if not shown and default is not None:
        several = default if isinstance(default, tuple) else (default,)
        shown = ",".join(f"{value:g}" if isinstance(value, float) else str(value) for value in several)
        if option.kind == "flag":
            shown = option.name.replace("_", "-") if option.default else f"no-{option.name.replace('_', '-')}"
        elif option.unit == "rad":
            shown = ",".join(f"{math.degrees(value):g}deg" for value in several)
        elif option.unit in ("mm", "MPa", "N", "s"):
            shown += option.unit
    unit = option.unit or {"text": "TEXT", "path": "FILE"}.get(str(option.kind), "")
    return Term(
        option.name, str(option.kind), option.help, unit, shown, option.choices, option.words, option.file
    )


def _merged(variants: list[Term]) -> Term:
    """Join options of one name; where they differ, help and default mention the motions."""
    first = variants[0]
    if any((variant.kind, variant.unit) != (first.kind, first.unit) for variant in variants):
        raise TypeError(f"{first.name} is declared with different kinds or units")
    motions = tuple(motion for variant in variants for motion in variant.motions)
    helps, defaults = (_by_motion(variants, name) for name in ("help", "shown_default"))
    return replace(
        first,
        help=helps if len({variant.help for variant in variants}) > 1 else for_motions(motions, helps),
        shown_default=defaults,
        choices=tuple(dict.fromkeys(choice for variant in variants for choice in variant.choices)),
        words=tuple(dict.fromkeys(word for variant in variants for word in variant.words)),
        motions=motions,
    )


def _by_motion(variants: list[Term], name: str) -> str:
    """Return the text of all variants, or each with its motions."""
    motions: dict[str, list[str]] = {}
    for variant in variants:
        motions.setdefault(getattr(variant, name), []).extend(variant.motions)
    if len(motions) == 1:
        return next(iter(motions))
    return "; ".join(for_motions(their, text) for text, their in motions.items() if text)


def declarations() -> dict[str, list[dict[str, Any]]]:
    """Return what ``declared.json`` contains: the options of each command."""
    from mirrorskin.engine.base.reconstruction import method_for
    from mirrorskin.engine.vibration.lock_in import LockIn

    methods: dict[str, type[Any]] = {motion: method_for(motion) for motion in MOTIONS}
    fused = ("tilt", "zenith_gain", "zenith_offset", "robust")
    terms = {
        "reconstruct": terms_of(methods),
        "correlate": terms_of({"": LockIn}),
        "fuse": [term for term in terms_of({"": methods["axial"]}) if term.name in fused],
    }
    return {
        command: [{name: value for name, value in asdict(term).items() if value} for term in options]
        for command, options in terms.items()
    }


if __name__ == "__main__":
    _COPY.write_text(json.dumps(declarations(), indent=1) + "\n", encoding="utf-8")
