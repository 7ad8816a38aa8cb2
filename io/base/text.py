"""Texts from files, made safe for terminals and text files."""

from __future__ import annotations


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
