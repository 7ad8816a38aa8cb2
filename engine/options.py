"""Options that are declared once: the parameters of operations, steps and methods.

Constructors, checks, signatures, docstrings, the command line, settings of a batch, provenance and the tables
of the documentation are derived from the declaration.
"""

from __future__ import annotations

import inspect
import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from numbers import Real
from pathlib import Path
from typing import Any, ClassVar, Literal, dataclass_transform

import numpy as np

from mirrorskin.io import InputError
from mirrorskin.io.arguments import as_array, check_flag, shown, unknown_argument

Kind = Literal["number", "integer", "flag", "choice", "numbers", "map", "file", "object"]

_LAST = ("device", "memory_limit")  # options that come last in signatures and help
_ANY = 2**31 - 1  # an upper limit that messages do not mention
_COLUMNS = 100  # of the lines of a docstring
_INTEGERS = ("frames", "pixels", "turns")  # units of counts
_EXAMPLES = {"share": "0.5", "mm": "0.1", "rad": "0.05", "counts": "1.5", "frames": "2", "pixels": "8"}
_UNITS = (
    *("", "share", "counts", *_INTEGERS, "mm", "rad", "s", "MPa", "N"),
    *("counts/rad", "mm/N", "Hz", "frames/s"),
)
RESERVED = ("operation", "program", "version", "date", "source", "driver", "calibration", "live")
"""Names of the process that mirrorskin writes: no option has one of them."""

_NOUNS = {"share": "a share", "frames": "a number of frames", "pixels": "a number of pixels"}


@dataclass(frozen=True)
class Option:
    """The declaration of an option; see `option`.

    As a class attribute it is the declaration; on an object, the attribute is the value, which is read-only.
    """

    default: Any
    unit: str
    kind: Kind
    help: str
    within: tuple[float | None, float | None]
    above: float | None
    choices: tuple[str, ...]
    words: tuple[str, ...]
    file: str
    shown_default: str
    python_only: bool
    name: str = ""
    optional: bool = False  # whether None is a value: the default of the first declaration

    def __set_name__(self, owner: type, name: str) -> None:
        object.__setattr__(self, "name", name)

    def __get__(self, holder: object | None, owner: type) -> Any:
        return self if holder is None else self.stored(holder)

    def __set__(self, holder: object, value: Any) -> None:
        raise AttributeError(
            f"{self.name} is an option of {type(holder).__name__}, which is read-only: construct another"
            " object, or choose another name for what you keep"
        )

    def store(self, holder: object, value: Any) -> None:
        """Store a checked value in an object."""
        vars(holder)[self.name] = value

    def stored(self, holder: object) -> Any:
        """Return the value in an object."""
        return vars(holder)[self.name]

    def settled(self, annotation: Any) -> Option:
        """Return the declaration as completed by its class; for ``float``, an integer becomes a number.

        Raises
        ------
        InputError
            The declaration contradicts itself.
        """
        made = self
        if self.kind == "integer" and self.unit not in _INTEGERS and annotation in (float, "float"):
            made = replace(self, kind="number")
        if made.kind == "number" and isinstance(made.default, int):
            made = replace(made, default=float(made.default))
        low, high = self.within
        if not self.help.strip():
            raise InputError(f"option {self.name} has no help: say in a sentence what it means")
        if self.unit not in _UNITS:
            raise InputError(
                f"option {self.name} has the unit {self.unit!r}. Use one of {', '.join(_UNITS[1:])}"
            )
        if low is not None and high is not None and low > high:
            raise InputError(f"option {self.name}: no value is within {low:g} and {high:g}")
        if self.default is not None:
            made.check(self.default)
        return replace(made, optional=made.optional or self.default is None)

    def with_default(self, value: Any) -> Option:
        """Return the declaration with another default, which is checked as a value is."""
        if hasattr(value, "__get__"):  # a method or a property
            raise InputError(f"{self.name} is an option. Assign a value, or choose another name")
        return replace(self, default=self.check(value), shown_default="")

    def described(self) -> str:
        """Return type and unit for a docstring, such as ``float, share, default 0.5``."""
        kinds = {"number": "float", "integer": "int", "flag": "bool", "numbers": "sequence of float"}
        kinds |= {"map": "float, ndarray (H, W) or path", "file": "path, Result or array", "object": "object"}
        kind = "{" + ", ".join(f'"{one}"' for one in self.choices) + "}" if self.choices else kinds[self.kind]
        kind = " or ".join([kind, *(f'"{word}"' for word in self.words)])
        unit = f", {self.unit}" if self.unit else ""
        default = "a map" if isinstance(self.default, np.ndarray) else repr(self.default)
        end = ", optional" if self.default is None else f", default {default}"
        return f"{kind}{unit}{end}"

    def check(self, value: Any) -> Any:
        """Return a value in the option's type.

        Raises
        ------
        InputError
            The value has another type, or is outside of the limits.
        """
        if value is None and (self.optional or self.default is None):
            return None
        if isinstance(value, str) and value in self.words:
            return value
        if self.kind in ("object", "file"):
            return value
        if self.kind == "choice":
            if not isinstance(value, str) or value not in self.choices:
                raise InputError(f"unknown {self.name} {shown(value)}. Use {' or '.join(self.choices)}")
            return str(value)
        if self.kind == "flag":
            return check_flag(self.name, value)
        if self.kind == "numbers":
            several = isinstance(value, Sequence) and not isinstance(value, str)
            values = value if several else np.atleast_1d(as_array(self.name, value, self.unit))
            return [self._number(one) for one in values]
        if self.kind == "map" and isinstance(value, str | Path):
            from mirrorskin.io.arrays import read_map

            return read_map(Path(value))
        if self.kind == "map" and not isinstance(value, Real):
            return as_array(self.name, value, self.unit)
        return self._number(value)

    def _number(self, value: Any) -> Any:
        whole = self.kind == "integer"
        if not isinstance(value, Real) and getattr(value, "ndim", None) == 0:
            value = as_array(self.name, value, self.unit)[()]
        is_number = isinstance(value, Real | np.bool_)
        if not is_number or (whole and not hasattr(value, "__index__")):
            what = "a whole number" if whole else "a number"
            raise InputError(f"{self.name} is {shown(value)}: {what} is needed")
        number = int(value) if whole else float(value)
        low, high = self.within
        if not (
            math.isfinite(number)
            and (low is None or number >= low)
            and (high is None or number <= high)
            and (self.above is None or number > self.above)
        ):
            example = f", such as {self.example}" if self.example else ""
            raise InputError(f"{self.name} {value}: {self.needed} is needed{example}")
        return number

    @property
    def example(self) -> str:
        """A value in the option's unit."""
        return _EXAMPLES.get(self.unit, "")

    @property
    def needed(self) -> str:
        """Requirement for a number, such as ``a share from 0 to 1``."""
        noun = _NOUNS.get(self.unit, "a number" + (f" in {self.unit}" if self.unit else ""))
        low, high = self.within
        if low is not None and high is not None and high < _ANY:
            limits = f" from {low:g} to {high:g}"
        elif low is not None:
            limits = f" of at least {low:g}"
        elif high is not None:
            limits = f" of at most {high:g}"
        else:
            limits = "" if self.above is None else f" above {self.above:g}"
        return f"{noun}{limits}"


def option(
    *,
    default: Any,
    unit: str = "",
    help: str,  # noqa: A002  # the name that argparse and click use
    within: tuple[float | None, float | None] = (None, None),
    above: float | None = None,
    choices: Sequence[str] = (),
    words: Sequence[str] = (),
    several: bool = False,
    map: bool = False,  # noqa: A002
    file: str = "",
    shown_default: str = "",
    python_only: bool = False,
) -> Any:
    """Declare an option in the body of a class derived from `Configured`.

    Parameters
    ----------
    default : object
        Value if nothing is given. None means that the operation chooses; ``shown_default`` says how.
    unit : str
        Unit of the value in Python: ``"share"``, ``"frames"``, ``"pixels"``, ``"turns"``, ``"counts"``,
        ``"mm"``, ``"rad"``, ``"s"``, ``"MPa"``, ``"N"``, ``"counts/rad"``, ``"mm/N"``, ``"Hz"`` or
        ``"frames/s"``. On the command line, lengths, angles, times, pressures and forces are written with a
        unit, other values without.
    help : str
        What the option means: one sentence.
    within : (float or None, float or None)
        Least and greatest allowed value.
    above : float, optional
        The value must be greater than this.
    choices : sequence of str
        The allowed texts.
    words : sequence of str
        Texts that are allowed in place of a number, such as ``"estimate"``.
    several : bool
        Whether the value is a list of numbers.
    map : bool
        Whether an array of the frames' size may be given in place of a number.
    file : str
        What file the value is read from on the command line, such as ``"RES.h5"``; in Python anything that
        the operation accepts.
    shown_default : str
        What help says the default is.
    python_only : bool
        Whether the option is left out on the command line.

    Examples
    --------
    >>> class Crossing(Configured):
    ...     threshold: float = option(default=0.5, unit="share", within=(0, 1), help="level of light")
    >>> Crossing(threshold=0.25).threshold, Crossing().threshold
    (0.25, 0.5)
    >>> Crossing(threshold=2)
    Traceback (most recent call last):
    ...
    mirrorskin.io.types.InputError: threshold 2: a share from 0 to 1 is needed, such as 0.5
    """
    kind: Kind = "number"
    if choices:
        kind = "choice"
    elif isinstance(default, bool):
        kind = "flag"
    elif file:
        kind = "file"
    elif several:
        kind = "numbers"
    elif map:
        kind = "map"
    elif unit in _INTEGERS or (isinstance(default, int) and not unit):
        kind = "integer"
    elif python_only and not unit and not isinstance(default, float):
        kind = "object"
    return Option(
        default=default,
        unit=unit,
        kind=kind,
        help=help,
        within=within,
        above=above,
        choices=tuple(choices),
        words=tuple(words),
        file=file,
        shown_default=shown_default,
        python_only=python_only,
    )


@dataclass_transform(kw_only_default=True, field_specifiers=(option,))
class Configured:
    """Base of classes whose keyword arguments are declared options.

    A class has the options that it declares, and those of its bases. ``threshold: float = Onset.threshold``
    declares the option of another class once more, and ``threshold = 0.3`` changes the default of a base's.

    Raises
    ------
    InputError
        An option does not exist, has another type, or is outside of its limits.
    """

    options: ClassVar[Mapping[str, Option]] = {}
    """All options by name."""

    _text: ClassVar[str | None] = None
    """Docstring without options."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        for name, declared, annotation in _declared(cls):
            setattr(cls, name, declared.settled(annotation))
        names = dict.fromkeys(name for name, value in vars(cls).items() if isinstance(value, Option))
        for base in cls.__mro__[1:]:
            names |= dict.fromkeys(base.options if issubclass(base, Configured) else ())
        changed = [name for name in names if _take_default(cls, name)]
        first = [name for name in names if name not in _LAST]
        last = [name for name in _LAST if name in names]
        cls.options = {name: getattr(cls, name) for name in [*first, *last]}
        cls.__signature__ = signature_of(cls.options)  # type: ignore[attr-defined]  # for help() and editors
        if cls.__doc__ is not None or changed:
            cls._text = cls.__doc__ or cls._text
            cls.__doc__ = documented(cls._text, cls.options)

    def __init__(self, **options: Any) -> None:
        unknown = options.keys() - self.options
        if unknown:
            raise InputError(unknown_argument(type(self).__name__, min(unknown), [*self.options], "option"))
        for name, one in self.options.items():
            value = options.get(name, one.default)
            one.store(self, one.check(list(value) if isinstance(value, list) else value))
        self.check_options()

    def __repr__(self) -> str:
        chosen = {name: value for name, value in self.chosen().items() if name not in _LAST}
        given = (f"{name}={value!r}" for name, value in chosen.items() if not self._is_default(name, value))
        return f"{type(self).__name__}({', '.join(given)})"

    def _is_default(self, name: str, value: Any) -> bool:
        default = self.options[name].default
        return value is default or (not isinstance(value, np.ndarray) and bool(value == default))

    def check_options(self) -> None:
        """Raise InputError if the options do not fit together; called at the end of construction.

        The message starts with the name of the option to change.
        """

    def chosen(self) -> dict[str, Any]:
        """Return the value of each option by name."""
        return {name: one.stored(self) for name, one in self.options.items()}

    def part(self, kind: type[Configured]) -> dict[str, Any]:
        """Return the values of the options that another class also has."""
        return {name: one.stored(self) for name, one in self.options.items() if name in kind.options}


def _declared(cls: type) -> Iterator[tuple[str, Option, Any]]:
    """Yield the options in the body of a class with their annotations, if their names can be used."""
    annotations = inspect.get_annotations(cls)
    taken = {name for base in cls.__mro__[1:] for name in (*vars(base), *getattr(base, "on_objects", ()))}
    for name, one in list(vars(cls).items()):
        if not isinstance(one, Option):
            continue
        inherited = next((vars(base)[name] for base in cls.__mro__[1:] if name in vars(base)), None)
        if name in RESERVED or (name in taken and not isinstance(inherited, Option)):
            raise InputError(
                f"{cls.__name__}: an option cannot have the name {name}, which has a meaning already"
            )
        yield name, one, annotations.get(name)


def _take_default(cls: type, name: str) -> bool:
    """Make a plain value that a class, or a base without options, assigns to an option its default."""
    values = [vars(base)[name] for base in cls.__mro__ if name in vars(base)]
    if isinstance(values[0], Option):
        return False
    declared = next(value for value in values if isinstance(value, Option))
    try:
        setattr(cls, name, declared.with_default(values[0]))
    except InputError as error:
        raise InputError(f"{cls.__name__}: {error}") from error
    return True


def signature_of(
    options: Mapping[str, Option], positional: Sequence[str] = (), optional: Sequence[str] = ()
) -> inspect.Signature:
    """Return the signature of a callable that takes options as keywords, after positional parameters.

    Those in ``optional`` are None by default.
    """
    kinds = inspect.Parameter
    first = [kinds(name, kinds.POSITIONAL_OR_KEYWORD) for name in positional]
    first += [kinds(name, kinds.POSITIONAL_OR_KEYWORD, default=None) for name in optional]
    rest = [kinds(name, kinds.KEYWORD_ONLY, default=one.default) for name, one in options.items()]
    return inspect.Signature([*first, *rest])


def documented(text: str | None, options: Mapping[str, Option], before: str = "") -> str | None:
    """Return a docstring whose section "Parameters" is generated from the declarations.

    ``before``: lines about positional parameters. Existing sections of the docstring follow the parameters.
    """
    if text is None or (not options and not before) or "\n    Parameters\n" in f"\n{text}":
        return text
    head, *rest = inspect.cleandoc(text).split("\n\n")
    sections = next((k for k, part in enumerate(rest) if "\n---" in part), len(rest))
    lines = [before.rstrip()] if before else []
    lines += [f"{name} : {one.described()}\n{_sentence(one)}" for name, one in options.items()]
    parameters = "\n".join(["Parameters", "----------", *lines])
    return "\n\n".join([head, *rest[:sections], parameters, *rest[sections:]])


def _sentence(one: Option) -> str:
    text = one.help[:1].upper() + one.help[1:]
    default = f" By default {one.shown_default}." if one.shown_default else ""
    sentence = f"{text}{'' if text.endswith('.') else '.'}{default}"
    return textwrap.fill(sentence, _COLUMNS, initial_indent="    ", subsequent_indent="    ")
