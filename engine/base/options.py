"""Options that are declared once: the parameters of operations, steps and methods.

Constructors, checks, signatures, docstrings, the command line, settings of a batch, provenance and the tables
of the documentation are derived from the declaration.
"""

from __future__ import annotations

import copy
import dataclasses
import hashlib
import inspect
import math
import os
import pickle
import sys
import textwrap
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from numbers import Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, ClassVar, Literal, Self, Union, cast, dataclass_transform, get_args, get_origin

import numpy as np
from numpy.typing import ArrayLike

from mirrorskin.io import InputError
from mirrorskin.io.base.arguments import as_array, check_flag, nearest, shown, unknown_argument
from mirrorskin.io.base.own_class import importable_name, load_class

Kind = Literal[
    "number", "integer", "numbers", "integers", "flag", "choice", "text", "path", "map", "file", "object"
]

_LAST = ("device", "memory_limit")  # options that come last in signatures and help
_ANY = 2**31 - 1  # an upper limit that messages do not mention
_COLUMNS = 100  # of the lines of a docstring
_MISSPELT = 0.85  # similarity, from 0 to 1, of an attribute to an option for which it is taken
_SHOWN = 8  # values of an array that are shown
_EXAMPLES = {"share": "0.5", "mm": "0.1", "rad": "0.05", "counts": "1.5", "frames": "2", "pixels": "8"}
_UNITS = (
    *("", "share", "counts", "frames", "pixels", "turns", "mm", "rad", "s", "MPa", "N"),
    *("counts/rad", "mm/N", "Hz", "frames/s"),
)
_TYPES = {  # in docstrings
    "number": "float",
    "integer": "int",
    "numbers": "sequence of float",
    "integers": "sequence of int",
    "flag": "bool",
    "text": "str",
    "path": "path",
    "map": "float, ndarray (H, W) or path",
    "file": "path, Result or array",
    "object": "object",
}
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
    help: str
    within: tuple[float | None, float | None]
    above: float | None
    file: str
    shown_default: str
    python_only: bool
    kind: Kind | None = None  # this and what follows are determined by the annotation
    choices: tuple[str, ...] = ()
    words: tuple[str, ...] = ()  # that are allowed in place of a number
    instance_of: type | None = None  # class of an enumeration or an object
    count: int | None = None  # of the numbers of a sequence, if that is fixed
    optional: bool = False  # whether None is a value
    name: str = ""

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

    def settled(self, name: str, annotation: Any) -> Option:
        """Return the declaration as completed by its name and annotation in a class.

        Raises
        ------
        InputError
            The declaration contradicts itself.
        """
        completed = replace(self, name=name)
        if self.kind is None:
            completed = replace(completed, **_meaning(name, annotation, self.file))
            completed = replace(completed, optional=completed.optional or self.default is None)
        low, high = self.within
        if not self.help.strip():
            raise InputError(f"option {name} has no help: say in a sentence what it means")
        if self.unit not in _UNITS:
            raise InputError(f"option {name} has the unit {self.unit!r}. Use one of {', '.join(_UNITS[1:])}")
        if low is not None and high is not None and low > high:
            raise InputError(f"option {name}: no value is within {low:g} and {high:g}")
        only = completed.python_only or completed.kind == "object"
        return replace(completed, default=completed.check(self.default), python_only=only)

    def with_default(self, value: Any) -> Option:
        """Return the declaration with another default, which is checked as a value is."""
        if hasattr(value, "__get__"):  # a method or a property
            raise InputError(f"{self.name} is an option. Assign a value, or choose another name")
        return replace(self, default=self.check(value), shown_default="")

    def described(self) -> str:
        """Return type and unit for a docstring, such as ``float, share, default 0.5``."""
        quoted = [f'"{choice}"' for choice in self.choices]
        kind = "{" + ", ".join(quoted) + "}" if quoted else _TYPES[self.kind or "object"]
        kind = " or ".join([kind, *(f'"{word}"' for word in self.words)])
        unit = f", {self.unit}" if self.unit else ""
        default = "a map" if isinstance(self.default, np.ndarray) else repr(plain(self.default))
        end = ", optional" if self.default is None else f", default {default}"
        return f"{kind}{unit}{end}"

    def check(self, value: Any) -> Any:
        """Return a value in the option's type.

        Raises
        ------
        InputError
            The value has another type, or is outside of the limits.
        """
        if value is None and self.optional:
            return None
        if isinstance(value, str) and value in self.words:
            return value
        if self.kind in ("numbers", "integers"):
            return self._several(value)
        if self.kind in ("number", "integer"):
            return self._number(value)
        if self.kind == "map":
            return self._map(value)
        if self.kind == "flag":
            return check_flag(self.name, value)
        return self._chosen(value) if self.kind == "choice" else self._object(value)

    def _map(self, value: Any) -> Any:
        if isinstance(value, str | Path):
            from mirrorskin.io.files.arrays import read_map

            return read_map(Path(value))
        return self._number(value) if isinstance(value, Real) else as_array(self.name, value, self.unit)

    def _chosen(self, value: Any) -> Any:
        if self.instance_of is not None and isinstance(value, self.instance_of):
            return value
        if not isinstance(value, str) or value not in self.choices:
            raise InputError(f"unknown {self.name} {shown(value)}. Use {' or '.join(self.choices)}")
        if self.instance_of is None:
            return str(value)
        return next(member for member in cast(type[Enum], self.instance_of) if plain(member) == value)

    def _object(self, value: Any) -> Any:
        """Return a text, a path or an object."""
        if self.kind == "path" and isinstance(value, str | os.PathLike):
            return value if isinstance(value, Path) else Path(value)
        needed = {"text": str, "path": Path}.get(str(self.kind), self.instance_of)
        if needed is not None and not isinstance(value, needed):
            noun = {"text": "a text", "path": "a path"}.get(str(self.kind), f"a {needed.__name__}")
            raise InputError(f"{self.name} is {shown(value)}: {noun} is needed")
        return value

    def _several(self, value: Any) -> Any:
        """Return numbers as a tuple."""
        several = isinstance(value, Sequence) and not isinstance(value, str)
        values = value if several else np.atleast_1d(as_array(self.name, value, self.unit))
        if self.count is not None and len(values) != self.count:
            raise InputError(f"{self.name} is {shown(value)}: {self.count} numbers are needed")
        return tuple(self._number(number) for number in values)

    def _number(self, value: Any) -> Any:
        whole = self.kind in ("integer", "integers")
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
        example, low = _EXAMPLES.get(self.unit, ""), self.within[0]
        return f"{low:g}" if low is not None and example and float(example) < low else example

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


def _meaning(name: str, annotation: Any, file: str) -> dict[str, Any]:
    """Return what the annotation of an option says of its values, as fields of the declaration."""
    if annotation is None:
        raise InputError(f"option {name} has no type: annotate it, as in {name}: float = option(...)")
    union = get_origin(annotation) in (Union, UnionType)
    parts = [*get_args(annotation)] if union else [annotation]
    words = tuple(word for part in parts if get_origin(part) is Literal for word in get_args(part))
    types = [part for part in parts if part is not NoneType and get_origin(part) is not Literal]
    if not all(isinstance(word, str) for word in words):
        raise InputError(f"option {name}: the values of Literal must be texts")
    if file:
        meaning: dict[str, Any] = {"kind": "file"}
    elif not types:
        meaning, words = {"kind": "choice", "choices": words}, ()
    elif {*get_args(ArrayLike)} <= {*types} or any(np.ndarray in (part, get_origin(part)) for part in types):
        meaning = {"kind": "map"}
    else:
        is_number = len(types) == 2 and {*types} == {int, float}
        meaning = _meaning_of_type(float if is_number else types[0] if len(types) == 1 else object)
    return {"optional": NoneType in parts, "words": words, **meaning}


def _meaning_of_type(kind: Any) -> dict[str, Any]:
    """Return what a single type says of an option's values; see `_meaning`."""
    kinds: dict[Any, Kind] = {bool: "flag", int: "integer", float: "number", str: "text", Path: "path"}
    if kind in kinds:
        return {"kind": kinds[kind]}
    items, origin = [part for part in get_args(kind) if part is not ...], get_origin(kind)
    if origin in (list, tuple, Sequence) and {*items} <= {int, float}:
        count = len(items) if origin is tuple and ... not in get_args(kind) else None
        return {"kind": "integers" if {*items} == {int} else "numbers", "count": count}
    if not isinstance(kind, type) or getattr(kind, "_is_protocol", False) or kind is object:
        return {"kind": "object"}
    if issubclass(kind, Enum):
        return {"kind": "choice", "choices": tuple(map(plain, kind)), "instance_of": kind}
    return {"kind": "object", "instance_of": kind}


def plain(value: Any) -> Any:
    """Return a value as files and the command line have it: a path or a member of an enumeration as text.

    The text of a member is its value if that is a text, otherwise its name.
    """
    if isinstance(value, Enum):
        return str(value.value) if isinstance(value.value, str) else value.name
    return str(value) if isinstance(value, Path) else value


def option(
    *,
    default: Any,
    unit: str = "",
    help: str,  # noqa: A002  # the name that argparse and click use
    within: tuple[float | None, float | None] = (None, None),
    above: float | None = None,
    file: str = "",
    shown_default: str = "",
    python_only: bool = False,
) -> Any:
    """Declare an option in the body of a class derived from `Configured`.

    The annotation determines its kind: ``float``, ``int``, ``bool``, ``str`` (any text), ``Path``,
    ``Literal["a", "b"]`` or an enumeration (one of several texts), ``Sequence[float]``, ``Sequence[int]``,
    ``ArrayLike`` (a number or a map of the frames' size), and ``float | Literal["estimate"]`` (a number or a
    word); with ``| None`` also None. Values of any other class are for Python only.

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
    mirrorskin.io.base.types.InputError: threshold 2: a share from 0 to 1 is needed, such as 0.5
    """
    return Option(default, unit, help, within, above, file, shown_default, python_only)


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
        for name, declared in _declared(cls):
            setattr(cls, name, declared)
        names = dict.fromkeys(name for name, value in vars(cls).items() if isinstance(value, Option))
        for base in cls.__mro__[1:]:
            names |= dict.fromkeys(base.options if issubclass(base, Configured) else ())
        changed = [name for name in names if _take_default(cls, name)]
        first = [name for name in names if name not in _LAST]
        last = [name for name in _LAST if name in names]
        cls.options = {name: getattr(cls, name) for name in [*first, *last]}
        _refuse_misspelt(cls, cls.options)
        cls.__signature__ = signature_of(cls.options)  # type: ignore[attr-defined]  # for help() and editors
        if cls.__doc__ is not None or changed:
            cls._text = cls.__doc__ or cls._text
            cls.__doc__ = documented(cls._text, cls.options)

    def __init__(self, **options: Any) -> None:
        unknown = options.keys() - self.options
        if unknown:
            raise InputError(unknown_argument(type(self).__name__, min(unknown), [*self.options], "option"))
        for name, declared in self.options.items():
            value = options.get(name, declared.default)
            declared.store(self, declared.check(value))
        self.check_options()

    def __repr__(self) -> str:
        values = ((name, value, self.options[name].default) for name, value in self.option_values().items())
        changed = (f"{name}={_text(value)}" for name, value, default in values if not _equal(value, default))
        return f"{type(self).__name__}({', '.join(changed)})"

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and _equal(self.option_values(), other.option_values())

    def __hash__(self) -> int:
        return hash((type(self), content_of(self.option_values())))

    def __copy__(self) -> Self:
        return type(self)(**self.option_values())

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return type(self)(**copy.deepcopy(self.option_values(), memo))

    def __reduce__(self) -> tuple[Any, ...]:
        return _construct, (importable_name(type(self)), self.written())

    def __dask_tokenize__(self) -> tuple[str, str]:
        kind, content = type(self), repr(content_of(self.option_values()))
        return f"{kind.__module__}:{kind.__qualname__}", hashlib.sha256(content.encode()).hexdigest()

    def check_options(self) -> None:
        """Raise InputError if the options do not fit together; called at the end of construction.

        The message starts with the name of the option to change.
        """

    def option_values(self) -> dict[str, Any]:
        """Return the value of each option by name."""
        return {name: declared.stored(self) for name, declared in self.options.items()}

    def written(self) -> dict[str, Any]:
        """Return the value of each option by name, members of enumerations as text."""
        return {
            name: plain(value) if isinstance(value, Enum) else value
            for name, value in self.option_values().items()
        }

    def with_options(self, **options: Any) -> Self:
        """Return an object of the same class with other values of some options; this one if none differs."""
        values = self.option_values()
        if all(name in values and values[name] is value for name, value in options.items()):
            return self
        return type(self)(**{**values, **options})

    def shared_options(self, kind: type[Configured]) -> dict[str, Any]:
        """Return the values of the options that another class also has."""
        return {
            name: declared.stored(self) for name, declared in self.options.items() if name in kind.options
        }


def _construct(name: str, options: dict[str, Any]) -> Any:
    """Return an unpickled object."""
    return load_class(name)(**options)


def content_of(value: Any) -> Hashable:
    """Return what is equal for equal values, in any process: the content of arrays, where NaN equals NaN."""
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind in "buif":
        numbers = np.asarray(value, np.float64) + 0.0  # for which -0 is 0
        content = np.where(np.isnan(numbers), np.nan, numbers).tobytes()
        return value.shape, hashlib.sha256(content).hexdigest()
    if isinstance(value, Configured):
        return f"{type(value).__module__}:{type(value).__qualname__}", content_of(value.option_values())
    if isinstance(value, Mapping):
        return tuple((str(name), content_of(value[name])) for name in value)
    if isinstance(value, list | tuple):
        return tuple(map(content_of, value))
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return type(value).__qualname__, tuple(
            content_of(getattr(value, field.name)) for field in dataclasses.fields(value)
        )
    value = plain(value)
    if value is None or isinstance(value, str | int | float):
        return value
    try:
        return hashlib.sha256(pickle.dumps(value)).hexdigest()
    except (pickle.PicklingError, TypeError, AttributeError):  # such as a function without a name
        return id(value)


def _equal(value: Any, other: Any) -> bool:
    return value is other or content_of(value) == content_of(other)


def _text(value: Any) -> str:
    """Return a value as an expression; a long array is shortened."""
    if isinstance(value, np.ndarray):
        return repr(value.tolist()) if value.size <= _SHOWN else f"<{value.dtype} {value.shape}>"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_text, value))}]"
    return repr(plain(value.item() if isinstance(value, np.generic) else value))


def _declared(cls: type) -> Iterator[tuple[str, Option]]:
    """Yield the options in the body of a class, completed, if their names can be used."""
    annotations = inspect.get_annotations(cls)
    taken = {name for base in cls.__mro__[1:] for name in (*vars(base), *getattr(base, "on_objects", ()))}
    for name, declared in list(vars(cls).items()):
        if not isinstance(declared, Option):
            continue
        inherited = next((vars(base)[name] for base in cls.__mro__[1:] if name in vars(base)), None)
        if name in RESERVED or (name in taken and not isinstance(inherited, Option)):
            raise InputError(
                f"{cls.__name__}: an option cannot have the name {name}, which has a meaning already"
            )
        try:
            annotation = None if declared.kind else _evaluated(cls, annotations.get(name))
            yield name, declared.settled(name, annotation)
        except InputError as error:
            raise InputError(f"{cls.__name__}: {error}") from None


def _evaluated(cls: type, annotation: Any) -> Any:
    """Return an annotation of a class that is being defined; texts are evaluated where that is."""
    if not isinstance(annotation, str):
        return annotation
    frame = sys._getframe()
    while frame.f_back is not None and frame.f_globals.get("__name__") != cls.__module__:
        frame = frame.f_back
    try:
        return eval(annotation, frame.f_globals, dict(frame.f_locals))
    except Exception as error:
        raise InputError(f"the annotation {annotation} cannot be evaluated: {error}") from error


def _refuse_misspelt(cls: type, options: Mapping[str, Option]) -> None:
    """Raise InputError if a class assigns a value to what looks like an option of its bases."""
    inherited = {name for base in cls.__mro__[1:] for name in vars(base)}
    for name, value in vars(cls).items():
        is_plain = value is None or isinstance(value, str | Real | list | tuple | Enum | Path)
        if is_plain and name[0] != "_" and name not in inherited and nearest(name, options, _MISSPELT):
            raise InputError(unknown_argument(cls.__name__, name, [*options], "option"))


def _take_default(cls: type, name: str) -> bool:
    """Make a plain value that a class, or a base without options, assigns to an option its default."""
    values = [vars(base)[name] for base in cls.__mro__ if name in vars(base)]
    if isinstance(values[0], Option):
        return False
    declared = next(value for value in values if isinstance(value, Option))
    try:
        setattr(cls, name, declared.with_default(values[0]))
    except InputError as error:
        raise InputError(f"{cls.__name__}: {error}") from None
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
    rest = [kinds(name, kinds.KEYWORD_ONLY, default=declared.default) for name, declared in options.items()]
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
    lines += [f"{name} : {declared.described()}\n{_sentence(declared)}" for name, declared in options.items()]
    parameters = "\n".join(["Parameters", "----------", *lines])
    return "\n\n".join([head, *rest[:sections], parameters, *rest[sections:]])


def _sentence(declared: Option) -> str:
    text = declared.help[:1].upper() + declared.help[1:]
    default = f" By default {declared.shown_default}." if declared.shown_default else ""
    sentence = f"{text}{'' if text.endswith('.') else '.'}{default}"
    return textwrap.fill(sentence, _COLUMNS, initial_indent="    ", subsequent_indent="    ")
