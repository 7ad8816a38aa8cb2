"""Faults of a line: each reply and each byte fails once, or repeatedly."""

from __future__ import annotations


def flipped(what):
    """Change a bit of the byte in the middle."""
    middle = len(what) // 2
    return what[:middle] + bytes([what[middle] ^ 0x04]) + what[middle + 1 :]


CHANGES = {"lost": lambda what: b"", "changed": flipped, "twice": lambda what: what + what}


def outcomes(go, stream, change, required):
    """Let `go` speak through a line whose replies ("said") or bytes ("heard") fail, one after the other.

    It gets what each of them becomes, and returns what went wrong; without faults nothing does.
    """
    numbers = []

    def count(number, what):
        numbers.append(number)
        return what

    assert go(**{stream: count}) is None
    assert len(numbers) >= required
    return [
        go(**{stream: lambda number, what, n=n: CHANGES[change](what) if number == n else what})
        for n in numbers
    ]
