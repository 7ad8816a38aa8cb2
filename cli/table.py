"""Tables of text: a value of each frame or recording in a column, and its unit, wherever it is stated."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import takewhile
from typing import TYPE_CHECKING

from mirrorskin.cli import quantity
from mirrorskin.io import InputError
from mirrorskin.io.base.system import read_text
from mirrorskin.io.base.text import shortened
from mirrorskin.io.base.units import BASE, NUMBER, PLAIN, Kind, in_base, is_common, units_of

if TYPE_CHECKING:
    from pathlib import Path

_VALUE = re.compile(rf"\s*(?:{NUMBER}|[+-]?(?:nan|inf))", re.IGNORECASE)
_PLAIN = re.compile(rf"\s*{NUMBER}\s*")
# Blanks between a number and its unit.
_SPACED_UNIT = re.compile(r"(?<=[\d.])[ \t]+(?=(?:[^\W\d_]+|[°'\"\u2032\u2033])(?:\s|$))")
_BRACKETS = re.compile(r"[\[({]\s*([^\])}]*?)\s*[\])}]")
_SLASH = re.compile(r"/\s*([^\s/]+)\s*$")
_IN = re.compile(r"\bin\s+([^\s,;:()\[\]{}]+)", re.IGNORECASE)
_STATED = re.compile(
    r"\b(?:in|units?|einheit(?:en)?)\b(?:\s+(?:is|are|of))?[\s:=]*([^\s,;:=()\[\]{}]+)", re.IGNORECASE
)
_CLAUSES = re.compile(r"[,;|]|\.\s|\band\b")
_UNIT_NAMES = {"unit", "units", "einheit", "einheiten"}  # of a column of units
_LONG = 4  # letters from which on the name of a unit is not mistaken for another word
# Words of a remark about all numbers of a table.
_GENERAL = _UNIT_NAMES | {
    *("all", "column", "columns", "data", "numbers", "values", "quantities"),
    *("length", "lengths", "distance", "distances", "positions", "coordinates", "angles", "forces"),
}
_SEPARATOR = re.compile("sep=(.)", re.IGNORECASE)  # a first line that Excel writes and reads


@dataclass(frozen=True, slots=True)
class Row:
    """A line of a table: its place, for messages, and its cells without surrounding blanks."""

    where: str
    cells: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Table:
    """The names of the columns and their units, if lines before the numbers contain them; the other lines.

    Remarks are comments, and lines before the heading.
    """

    heading: tuple[str, ...]
    rows: tuple[Row, ...]
    columns: int
    units: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()


def read_table(path: Path, remedy: str, lists: bool = False) -> Table:
    """Read a text of numbers in columns between semicolons, tabs, commas or blanks.

    The last line before the numbers is the heading, or a line of units below it; so is a comment that
    precedes the first number, if it has as many cells as there are columns. Other text before the numbers or
    after ``#`` is a remark, which may state a unit. A decimal comma is refused. With ``lists``, a single line
    is one column.
    """
    lines = read_text(path, remedy).splitlines()
    separator = _SEPARATOR.fullmatch(lines[0].strip()) if lines else None
    if separator:
        lines[0] = ""
    texts = [(number, *_without_comment(line)) for number, line in enumerate(lines, 1)]
    contents = [(number, text) for number, text, _ in texts if text]
    above = [text for _, text in takewhile(lambda line: not _has_number(line[1]), contents)]
    above = above if len(above) < len(contents) else above[: len(contents) > 1]
    del contents[: len(above)]
    body = "\n".join(text for _, text in contents)
    delimiter = (
        separator[1] if separator else next((character for character in ";\t," if character in body), "")
    )
    rows = tuple(Row(f"{path}, line {number}:", _cells(text, delimiter)) for number, text in contents)
    columns = max((len(row.cells) for row in rows), default=0) if len(rows) > 1 or not lists else 1
    remarks = [comment for _, text, comment in texts if comment and not text]
    units: tuple[str, ...] = ()
    if len(above) > 1:
        units = _heading(above[-1], delimiter, columns)
        units = units if len(units) == columns and all(map(_is_unit, units)) else ()
        above = above[: -1 if units else None]
    names = _heading(above[-1], delimiter, columns) if above else ()
    if not above and rows:
        before = [comment for number, _, comment in texts if number < contents[0][0] and comment]
        names = _heading(before[-1], delimiter, columns) if before else ()
        names = names if len(names) == columns else ()
        if names and before[-1] in remarks:
            remarks.remove(before[-1])
    if delimiter == "," and len(names) < 2:
        _refuse_decimal_commas(path, contents)
    return Table(names, rows, columns, units, (*above[:-1], *remarks))


def _has_number(text: str) -> bool:
    return any(map(_VALUE.match, re.split(r"[;,\t]|\s+", text)))


def _is_unit(cell: str) -> bool:
    """Return whether a cell of a line below the heading can be a unit."""
    unit = _without_brackets(cell)
    return unit in PLAIN | {"-", "#", "none"} or any(unit in units_of(kind) for kind in BASE)


def _without_brackets(cell: str) -> str:
    return cell.strip(" []{}()")


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
    column, index = None, 0
    if len(table.heading) == table.columns:
        index = _column_of(path, table, what, names)
        column = index if table.columns > 1 else None
    elif table.columns > 1 and not _states_all_units(table):
        if not table.heading:
            head = f"name them in a first line, such as frame,{names[0][0]} [{BASE[kind]}]"
            raise InputError(f"{path} has {table.columns} columns without names: {head}")
        raise InputError(
            f"{path} has {table.columns} columns and {len(table.heading)} names in its first line: {remedy}"
        )
    cells = [
        row.cells if column is None else (*row.cells, "")[column : column + 1] or ("",) for row in table.rows
    ]
    plain = any(_PLAIN.fullmatch(cell) for row in cells for cell in row)
    words = {word for name_words in names for word in name_words}
    units = row_units(path, table, index, kind, words, base) if plain else [base] * len(cells)
    return tuple(
        _value(cell, row.where, kind, in_base(unit, kind) if unit else None)
        for row, unit, of_row in zip(table.rows, units, cells, strict=True)
        for cell in of_row
    )


def row_units(path: Path, table: Table, index: int, kind: Kind, words: set[str], base: str) -> list[str]:
    """Return the unit of the number of each row in a column.

    It is stated by the heading, a line of units below it, a column of units, or a remark; otherwise it is
    ``base``. ``words`` name the quantity in remarks.

    Raises
    ------
    InputError
        It is unknown, or measures something else; or statements contradict each other, or may be about
        another quantity.
    """
    named = len(table.heading) == table.columns
    heading = table.heading[index] if named else ""
    found = [(heading, unit_of(heading, kind, f"{path}: the heading {heading!r}"))] if heading else []
    if table.units and (cell := _without_brackets(table.units[index])) not in PLAIN | {"-", "#", "none"}:
        found.append((cell, unit_of(f"[{cell}]", kind, f"{path}: the line below the heading")))
    found = [(text, unit) for text, unit in found if unit]
    _refuse_several(path, found, kind)
    column = _unit_column(table, heading) if named and table.columns > 1 else None
    if column is not None:
        units = []
        for row in table.rows:
            cell = _without_brackets((*row.cells, *[""] * table.columns)[column])
            unit = unit_of(f"[{cell}]", kind, row.where) if cell else ""
            _refuse_several(path, [*found, (cell, unit)] if unit else found, kind)
            units.append(unit or (found[0][1] if found else base))
        return units
    unit = found[0][1] if found else _unit_in_remarks(path, table, heading, kind, words, base)
    return [unit or base] * len(table.rows)


def _unit_column(table: Table, heading: str) -> int | None:
    """Return the column that contains the units of another one; None without one."""
    of_column = _words(heading)
    columns = {}
    for index, name in enumerate(table.heading):
        words = _words(name)
        if words & _UNIT_NAMES:
            columns[index] = words - _UNIT_NAMES
    own = [index for index, words in columns.items() if words & of_column]
    return next(iter(own or [index for index, words in columns.items() if not words]), None)


def _unit_in_remarks(path: Path, table: Table, heading: str, kind: Kind, words: set[str], base: str) -> str:
    """Return the unit that remarks state for a column; "" if none does."""
    words = words | _words(heading)
    own, general, others = list[tuple[str, str]](), list[tuple[str, str]](), list[tuple[str, str]]()
    for remark in table.remarks:
        for clause in _CLAUSES.split(remark):
            if unit := _unit_in(clause, kind):
                said = _words(clause) - _words(unit) - {"in", "is", "are", "of"}
                kept = own if said & words else general if said & _GENERAL or not said else others
                kept.append((remark, unit))
    chosen = own or general
    _refuse_several(path, chosen, kind)
    if chosen:
        return chosen[0][1]
    foreign = [item for item in others if base and in_base(item[1], kind) != in_base(base, kind)]
    if foreign:
        remark, unit = foreign[0]
        name = heading or min(words, default="value")
        raise InputError(
            f"{path}: {shortened(remark)!r} states the unit {unit!r}, but not of which numbers: write"
            f" {shortened(name)} [{unit}] or {shortened(name)} [{base}] above the numbers"
        )
    return ""


def _unit_in(text: str, kind: Kind) -> str:
    """Return the unit of a kind that a text states, unless as that of a number in it; "" if none."""
    known, text = units_of(kind), text.strip(" .!?\t")
    found = [match[1].removeprefix("in ").strip() for match in _BRACKETS.finditer(text)]
    found += _STATED.findall(text)
    tokens = re.split(r"[\s:=()\[\]{}/]+", text)
    for before, token in zip(["", *tokens], tokens, strict=False):
        alone = len(token) >= _LONG or (token == tokens[-1] != "in" and is_common(token, kind))
        if alone and not _PLAIN.fullmatch(before) and (token in known or token.lower() in known):
            found.append(token)
    units = (unit if unit in known else unit.lower() for unit in found)
    return next((unit for unit in units if unit in known and (len(unit) > 1 or len(tokens) < 4)), "")


def _refuse_several(path: Path, stated: Sequence[tuple[str, str]], kind: Kind) -> None:
    """Raise InputError if units that are stated for the same numbers differ."""
    for text, unit in stated[1:]:
        if in_base(unit, kind) != in_base(stated[0][1], kind):
            raise InputError(
                f"{path} states several units, {stated[0][1]!r} ({shortened(stated[0][0])!r}) and {unit!r}"
                f" ({shortened(text)!r}): keep one"
            )


def unit_of(heading: str, kind: Kind, where: str) -> str:
    """Return the unit in the heading of a column; "" if there is none.

    Units are in brackets, after a slash or "in", or the last word: ``travel [um]``, ``position/µm``,
    ``travel in micrometres``, ``z_um``.

    Raises
    ------
    InputError
        It is unknown, or measures something else.
    """
    words = re.split(r"[\s_,.:]+", heading.strip())
    match = _BRACKETS.search(heading) or _SLASH.search(heading)
    known, last = units_of(kind), words[-1]
    named = [word for word in _IN.findall(heading) if any(word in units_of(other) for other in BASE)]
    if match:
        parts = re.split(r"[\s,;]+", match[1].removeprefix("in "))
        unit = next((part for part in parts if part in known), match[1]) if len(parts) > 1 else parts[0]
    elif is_common(last, None if len(words) > 1 else kind):
        unit = last
    elif len(last) >= _LONG and (last in known or last.lower() in known):
        unit = last if last in known else last.lower()
    else:
        unit = named[0] if named else ""
    if unit:
        try:
            in_base(unit, kind)
        except ValueError as error:
            raise InputError(
                f"{where} states the unit {shortened(unit)!r}: {shortened(str(error), 110)}; "
                f"write a unit of {kind}, such as [{BASE[kind]}]"
            ) from None
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
    words = [_words(name) for name in table.heading]
    for name_words in names:
        matches = [
            index
            for index, heading_words in enumerate(words)
            if heading_words & {*name_words} and not heading_words & _UNIT_NAMES
        ]
        if len(matches) == 1:
            return matches[0]
        if matches:
            several = " and ".join(repr(shortened(table.heading[index])) for index in matches)
            raise InputError(f"{path} has several columns of {what}, {several}: remove all but one")
    shown = shortened(", ".join(table.heading), 80)
    raise InputError(f"{path} has the columns {shown}, and none of {what}: name one {names[0][0]}")


def _words(text: str) -> set[str]:
    return {*re.findall(r"[^\W\d_]+", text.lower())}


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
