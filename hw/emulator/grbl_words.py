"""A line of G-code as words: letters and numbers, sorted into modal groups."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from mirrorskin.hw.emulator.grbl_errors import GrblError

NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)")

_GROUPS = {
    "motion": ("G0", "G1", "G2", "G3", "G80"),
    "plane": ("G17", "G18", "G19"),
    "units": ("G20", "G21"),
    "distance": ("G90", "G91"),
    "arc distance": ("G91.1",),
    "feed mode": ("G94",),
    "cutter": ("G40",),
    "tool length": ("G49",),
    "coordinates": ("G54", "G55", "G56", "G57", "G58", "G59"),
    "control": ("G61",),
    "once": ("G4", "G10", "G53", "G92", "G92.1"),
    "flow": ("M0", "M1", "M2", "M30"),
    "spindle": ("M3", "M4", "M5"),
    "coolant": ("M7", "M8", "M9"),
}
_GROUP_OF = {code: group for group, codes in _GROUPS.items() for code in codes}
_VALUES = "FIJKLNPRST"
_NOT_NEGATIVE = "FNPST"
_LINENUMBERS = 9_999_999


@dataclass(slots=True)
class Block:
    """The words of a line.

    Attributes
    ----------
    codes : dict of str to str
        The commands by their modal group, such as {"motion": "G1"}.
    values : dict of str to float
        The other words by their letter, axes included.
    """

    codes: dict[str, str] = field(default_factory=dict)
    values: dict[str, float] = field(default_factory=dict)


def clean(line: str) -> str:
    """Return a line without comments, spaces and block deletes, in capitals."""
    text = re.sub(r"\([^)]*(\)|$)", "", line)
    return re.sub(r"[\x00-\x20/]", "", text.split(";")[0]).upper()


def parse(line: str, axes: str) -> Block:
    """Return the words of a cleaned line.

    Raises
    ------
    GrblError
        1: a letter is missing; 2: a number is; 4: a value is negative; 20: unknown; 21: two of one group;
        25: a word is repeated; 27: the line number is too large.
    """
    block = Block()
    at = 0
    while at < len(line):
        letter = line[at]
        if not ("A" <= letter <= "Z"):
            raise GrblError(1)
        number = NUMBER.match(line, at + 1)
        if number is None:
            raise GrblError(2)
        at = number.end()
        _sort(block, letter, float(number.group()), axes)
    _check(block)
    return block


def _sort(block: Block, letter: str, value: float, axes: str) -> None:
    if letter in "GM":
        code = f"{letter}{value:g}"
        if code not in _GROUP_OF:
            raise GrblError(20)
        group = _GROUP_OF[code]
        if group in block.codes:
            raise GrblError(21)
        block.codes[group] = code
        return
    if letter not in _VALUES and letter not in axes:
        raise GrblError(20)
    if letter in block.values:
        raise GrblError(25)
    block.values[letter] = value


def _check(block: Block) -> None:
    if any(block.values.get(letter, 0.0) < 0 for letter in _NOT_NEGATIVE):
        raise GrblError(4)
    if block.values.get("N", 0.0) > _LINENUMBERS:
        raise GrblError(27)
