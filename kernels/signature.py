"""The arguments of kernels, read from their source, so that a launch can name them."""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

_SCALARS = {
    "char": np.int8, "uchar": np.uint8, "short": np.int16, "ushort": np.uint16, "int": np.int32,
    "uint": np.uint32, "long": np.int64, "ulong": np.uint64, "float": np.float32, "double": np.float64,
}  # fmt: skip
_COMMENT = re.compile(r"/\*.*?\*/|//[^\n]*", re.DOTALL)
_ATTRIBUTE = r"(?:__attribute__\s*\(\(.*?\)\)|\w+)\s+"  # or a macro that stands for some
_KERNEL = re.compile(rf"\b(?:__)?kernel\s+(?:{_ATTRIBUTE})*?void\s+(\w+)\s*\(([^{{]*)\)\s*\{{")
_ARGUMENT = re.compile(r"(?P<type>.*?)(?P<pointer>\*?)\s*(?:\brestrict\b)?\s*\b(?P<name>\w+)", re.DOTALL)
_QUALIFIERS = re.compile(r"\b(__global|global|__constant|constant|const|restrict|volatile)\b")

Convert = Callable[[Any], Any]
Signature = tuple[tuple[str, Convert | None], ...]
"""Names in order; a scalar's with what converts a number to its type, a buffer's with None."""


def read_signatures(source: str, defines: Mapping[str, str]) -> dict[str, Signature]:
    """Return the arguments of each kernel of a source, with macros as given.

    It understands the part of the preprocessor that signatures use: conditions, and macros without arguments.
    """
    text, macros = _preprocess(_COMMENT.sub(" ", source.replace("\\\n", " ")), dict(defines))
    return {
        name: tuple(map(_argument, _expand(arguments, macros).split(",")))
        for name, arguments in _KERNEL.findall(text)
    }


def _argument(declaration: str) -> tuple[str, Convert | None]:
    found = _ARGUMENT.fullmatch(declaration.strip())
    if found is None:
        raise ValueError(f"not an argument of a kernel: {declaration!r}")
    if found["pointer"]:
        return found["name"], None
    scalar = _SCALARS[_QUALIFIERS.sub("", found["type"]).strip()]
    if issubclass(scalar, np.integer):
        return found["name"], lambda value: scalar(operator.index(value))
    return found["name"], scalar


def _preprocess(source: str, macros: dict[str, str]) -> tuple[str, dict[str, str]]:
    kept = []
    open_ifs: list[tuple[bool, bool]] = []  # whether this branch counts, and whether it or one before it did
    for line in source.splitlines():
        directive = re.match(r"\s*#\s*(\w+)\s*(.*)", line)
        if directive is None:
            if all(now for now, _ in open_ifs):
                kept.append(line)
            continue
        word, rest = directive[1], directive[2].strip()
        if word in ("if", "ifdef", "ifndef"):
            outside = all(now for now, _ in open_ifs)
            known = rest in macros
            now = outside and (_holds(rest, macros) if word == "if" else known == (word == "ifdef"))
            open_ifs.append((now, now or not outside))
        elif word in ("elif", "else"):
            _, done = open_ifs.pop()
            now = not done and (word == "else" or _holds(rest, macros))
            open_ifs.append((now, done or now))
        elif word == "endif":
            open_ifs.pop()
        elif word == "define" and all(now for now, _ in open_ifs):
            name, *value = re.split(r"(?<=\w)(?=\W)", rest, maxsplit=1)
            if not value or not value[0].startswith("("):
                macros[name] = "".join(value).strip()
    return "\n".join(kept), macros


def _expand(text: str, macros: Mapping[str, str]) -> str:
    """Replace macros by what they stand for."""

    def replace(word: re.Match[str]) -> str:
        return _expand(macros[word[0]], macros) if word[0] in macros else word[0]

    return re.sub(r"\b[A-Za-z_]\w*", replace, text)


def _holds(condition: str, macros: Mapping[str, str]) -> bool:
    """Evaluate the condition of an ``#if``; what is not defined is 0."""
    plain = re.sub(r"defined\s*\(?\s*(\w+)\s*\)?", lambda name: str(int(name[1] in macros)), condition)
    plain = re.sub(r"\b__has_builtin\s*\(\w+\)", "0", plain)
    numbers = re.sub(r"\b[A-Za-z_]\w*\b", "0", _expand(plain, macros))
    words = re.sub(r"!(?!=)", " not ", numbers).replace("&&", " and ").replace("||", " or ")
    return bool(eval(words, {"__builtins__": {}}))
