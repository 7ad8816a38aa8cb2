"""Tables of text: a value of each frame or recording, in a column with an optional unit in the first line."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from mirrorskin.cli import quantity
from mirrorskin.io import InputError
from mirrorskin.io.base.system import read_text
from mirrorskin.io.base.text import shortened
from mirrorskin.io.base.units import BASE, Kind, in_base, is_common

if TYPE_CHECKING:
    from pathlib import Path

_VALUE = re.compile(rf"\s*(?:{quantity.NUMBER}|[+-]?(?:nan|inf))", re.IGNORECASE)
_PLAIN = re.compile(rf"\s*{quantity.NUMBER}\s*")
# Blanks between a number and its unit.
_SPACED_UNIT = re.compile(r"(?<=[\d.])[ \t]+(?=(?:[^\W\d_]+|[°'\"\u2032\u2033])(?:\s|$))")
_BRACKETS = re.compile(r"[\[({]\s*([^\])}]*?)\s*[\])}]")
_SLASH = re.compile(r"/\s*([^\s/]+)\s*$")
_SEPARATOR = re.compile("sep=(.)", re.IGNORECASE)  # a first line that Excel writes and reads


@dataclass(frozen=True, slots=True)
class Row:
    """A line of a table: its place, for messages, and its cells without surrounding blanks."""

    where: str
    cells: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Table:
    """The names of the columns, if the first line contains names, and the other lines."""

    heading: tuple[str, ...]
    rows: tuple[Row, ...]
    columns: int


def read_table(path: Path, remedy: str, lists: bool = False) -> Table:
    """Read a text of numbers in columns between semicolons, tabs, commas or blanks.

    A first line without numbers is the heading; so is a comment that precedes the first number, if it has as
    many cells as there are columns. Other text after ``#`` is ignored. A decimal comma is refused. With
    ``lists``, a single line is one column.
    """
    lines = read_text(path, remedy).splitlines()
    separator = _SEPARATOR.fullmatch(lines[0].strip()) if lines else None
    if separator:
        lines[0] = ""
    texts = [(number, *_without_comment(line)) for number, line in enumerate(lines, 1)]
    contents = [(number, text) for number, text, _ in texts if text]
    heading = ""
    if len(contents) > 1 and not any(map(_VALUE.match, re.split(r"[;,\t]|\s+", contents[0][1]))):
        heading = contents.pop(0)[1]
    body = "\n".join(text for _, text in contents)
    delimiter = (
        separator[1] if separator else next((character for character in ";\t," if character in body), "")
    )
    rows = tuple(Row(f"{path}, line {number}:", _cells(text, delimiter)) for number, text in contents)
    columns = max((len(row.cells) for row in rows), default=0) if len(rows) > 1 or not lists else 1
    names = _heading(heading, delimiter, columns)
    if not heading and rows:
        before = [comment for number, _, comment in texts if number < contents[0][0] and comment]
        names = _heading(before[-1], delimiter, columns) if before else ()
        names = names if len(names) == columns else ()
    if delimiter == "," and len(names) < 2:
        _refuse_decimal_commas(path, contents)
    return Table(names, rows, columns)


def read_column(
    path: Path, kind: Kind, what: str, remedy: str, names: Sequence[Sequence[str]], base: str = ""
) -> tuple[float, ...]:
    """Return the values of one column, or of a list in one line, in the base unit of their kind.

    Parameters
    ----------
    path : Path
    kind : str
        Kind of quantity; "length".
    what, remedy : str
        The values, for messages, and the end of messages.
    names : sequence of sequences of str
        Words that name the column in the heading of a table with several; earlier ones take precedence.
    base : str
        The unit of numbers where neither they nor the heading state one; "" refuses such numbers.
    """
    table = read_table(path, remedy, lists=True)
    if not table.rows:
        raise InputError(f"{path} lists no {what}: {remedy}")
    column, unit = None, base
    if len(table.heading) == table.columns:
        index = _column_of(path, table, what, names)
        unit = unit_of(table.heading[index], kind, f"{path}: the heading {table.heading[index]!r}") or base
        column = index if table.columns > 1 else None
    elif table.columns > 1 and not _states_all_units(table):
        if not table.heading:
            head = f"name them in a first line, such as frame,{names[0][0]} [{BASE[kind]}]"
            raise InputError(f"{path} has {table.columns} columns without names: {head}")
        raise InputError(
            f"{path} has {table.columns} columns and {len(table.heading)} names in its first line: {remedy}"
        )
    factor = in_base(unit, kind) if unit else None
    return tuple(
        _value(cell, row.where, kind, factor)
        for row in table.rows
        for cell in (row.cells if column is None else (*row.cells, "")[column : column + 1] or ("",))
    )


def unit_of(heading: str, kind: Kind, where: str) -> str:
    """Return the unit in the heading of a column; "" if there is none.

    Units are in brackets, after a slash, or the last word: ``travel [um]``, ``position/µm``, ``z_um``.

    Raises
    ------
    InputError
        It is unknown, or measures something else.
    """
    words = re.split(r"[\s_,.:]+", heading.strip())
    match = _BRACKETS.search(heading) or _SLASH.search(heading)
    last = words[-1] if is_common(words[-1], None if len(words) > 1 else kind) else ""
    unit = match[1] if match else last
    if unit:
        try:
            in_base(unit, kind)
        except ValueError as error:
            raise InputError(
                f"{where} states the unit {shortened(unit)!r}: {shortened(str(error), 110)}; "
                f"write a unit of {kind}, such as [{BASE[kind]}]"
            ) from error
    return unit


def _without_comment(line: str) -> tuple[str, str]:
    text, _, comment = line.partition("#")
    return text.strip(), comment.strip(" #\t")


def _cells(line: str, delimiter: str) -> tuple[str, ...]:
    """Return the cells of a line, without empty ones at its end."""
    if not delimiter:
        return tuple(_SPACED_UNIT.sub("", line).split())
    try:
        cells = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])
    except csv.Error:  # a cell of more than 131 072 characters
        cells = line.split(delimiter)
    while cells and not cells[-1].strip():
        cells.pop()
    return tuple(cell.strip() for cell in cells)


def _heading(line: str, delimiter: str, columns: int) -> tuple[str, ...]:
    """Return the names of columns; the whole line if there is only one column."""
    if columns == 1:
        return (line.strip(' \t,;"'),) if line else ()
    if delimiter:
        return _cells(line, delimiter)
    return tuple(re.split(r"\s+(?![\[({])", line)) if line else ()


def _column_of(path: Path, table: Table, what: str, names: Sequence[Sequence[str]]) -> int:
    """Return the index of the column that the heading names."""
    if table.columns == 1:
        return 0
    words = [re.findall(r"[^\W\d_]+", name.lower()) for name in table.heading]
    for name_words in names:
        matches = [index for index, heading_words in enumerate(words) if {*heading_words} & {*name_words}]
        if len(matches) == 1:
            return matches[0]
        if matches:
            several = " and ".join(repr(shortened(table.heading[index])) for index in matches)
            raise InputError(f"{path} has several columns of {what}, {several}: remove all but one")
    shown = shortened(", ".join(table.heading), 80)
    raise InputError(f"{path} has the columns {shown}, and none of {what}: name one {names[0][0]}")


def _states_all_units(table: Table) -> bool:
    """Return whether each value has its own unit: then the values are a list over several lines."""
    return all(_VALUE.match(cell) and not _PLAIN.fullmatch(cell) for row in table.rows for cell in row.cells)


def _value(cell: str, where: str, kind: Kind, factor: float | None) -> float:
    if factor is not None and _PLAIN.fullmatch(cell):
        return float(cell) * factor
    return quantity.read_quantity(cell, where, kind)


def _refuse_decimal_commas(path: Path, contents: Sequence[tuple[int, str]]) -> None:
    """Raise InputError if commas separate the digits of numbers instead of the numbers.

    They do if each line, or each word of the only line, is two whole numbers with a comma between them; or if
    a unit follows.
    """
    words = contents
    if len(contents) == 1:
        words = [(number, word) for number, text in contents for word in text.split()]
    corrected = [quantity.decimal_comma(word) for _, word in words]
    several = len(corrected) > 1 and all(corrected)
    with_unit = next((n for n, number in enumerate(corrected) if number and number[-1].isalpha()), None)
    if several or with_unit is not None:
        number, word = words[with_unit or 0]
        quantity.refuse_decimal_comma(word, f"{path}, line {number}:")
