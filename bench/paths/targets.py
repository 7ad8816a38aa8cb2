"""What was aimed at, judged by what was measured in the same rounds."""

from __future__ import annotations

from mirrorskin.bench.results import Row, Target


def at_most(what: str, bound: float, ours: Row, theirs: Row, than: str) -> Target:
    """Judge whether a work takes at most so many times what another takes.

    Parameters
    ----------
    what : str
        That is judged.
    bound : float
    ours, theirs : Row
    than : str
        The other work, in words.
    """
    ratio = ours.measured.wall.median / theirs.measured.wall.median
    told = f"{ratio:.2f} times ({_ms(ours)} against {_ms(theirs)} ms)"
    return Target(what, f"at most {bound:g} times {than}", told, ratio <= bound)


def as_fast_as(what: str, bound: float, ours: Row, theirs: Row) -> Target:
    """Judge whether a work is at least so many times as fast as another."""
    ratio = theirs.measured.wall.median / ours.measured.wall.median
    told = f"{ratio:.1f} times ({_ms(ours)} against {_ms(theirs)} ms)"
    return Target(what, f"at least {bound:g} times as fast as {theirs.name}", told, ratio >= bound)


def _ms(row: Row) -> str:
    milliseconds = 1e3 * row.measured.wall.median
    return f"{milliseconds:.{1 if milliseconds < 100 else 0}f}"
