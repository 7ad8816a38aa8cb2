"""Texts from files, made safe for terminals and text files."""

from __future__ import annotations

from collections.abc import Sequence

_BEYOND = 0.01  # of the range, beyond the ends: less is noise


def printable(text: str) -> str:
    r"""Return a text in which unprintable characters, such as control codes, are replaced by "?".

    Examples
    --------
    >>> printable("a\x1b[2Jb")
    'a?[2Jb'
    """
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def legible(text: str) -> str:
    """Return a text without invalid characters: the name of a file may contain any bytes."""
    return text.encode(errors="surrogateescape").decode(errors="replace")


def one_line(value: object) -> str:
    r"""Return a value as one line of printable text.

    Examples
    --------
    >>> one_line("two\nlines\x07")
    'two lines?'
    """
    return printable(" ".join(str(value).split()))


def shortened(text: str, length: int = 40) -> str:
    """Return a text, shortened for quoting in a message.

    Examples
    --------
    >>> shortened("a line without end", 6)
    'a line...'
    """
    return text if len(text) <= length else f"{text[:length]}..."


def course(values: Sequence[float]) -> list[float]:
    """Return the first of some positions, the lowest and highest if they are beyond the ends, and the last.

    Examples
    --------
    >>> course([0.0, 0.5, 1.0]), course([0.0, 1.0, 2.0, 0.5])
    ([0.0, 1.0], [0.0, 2.0, 0.5])
    """
    if not values:
        return []
    ends = sorted((values[0], values[-1]))
    lowest, highest = min(values), max(values)
    beyond = _BEYOND * (highest - lowest)
    turns = [lowest] * (lowest < ends[0] - beyond) + [highest] * (highest > ends[1] + beyond)
    return [values[0], *sorted(turns, key=values.index), values[-1]]
