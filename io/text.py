"""Texts that come from files, for terminals and for files that are text."""

from __future__ import annotations


def printable(text: str) -> str:
    r"""Return a text with "?" for each character that does not print, such as control codes.

    Examples
    --------
    >>> printable("a\x1b[2Jb")
    'a?[2Jb'
    """
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def one_line(value: object) -> str:
    r"""Return a value as one line of text that prints.

    Examples
    --------
    >>> one_line("two\nlines\x07")
    'two lines?'
    """
    return printable(" ".join(str(value).split()))


def shortened(text: str, most: int = 40) -> str:
    """Return a text, or its start where it is longer than a message should quote.

    Examples
    --------
    >>> shortened("a line without end", 6)
    'a line...'
    """
    return text if len(text) <= most else f"{text[:most]}..."
