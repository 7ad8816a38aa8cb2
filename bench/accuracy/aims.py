"""What a device's answers are held against: known truths, each a number and its bound."""

from __future__ import annotations

from mirrorskin.bench.results import Case, Target


class InaccurateError(Exception):
    """A device's answers are further from the truth than they may be; the message names the number."""

    exit_code = 1


def at_most(what: str, value: float, bound: float) -> Target:
    """Return a target that a number reaches from below; NaN does not reach it."""
    return Target(what, f"at most {bound:.3g}", f"{value:.3g}", value <= bound)


def within(what: str, value: float, low: float, high: float) -> Target:
    """Return a target that a number reaches between two ends; NaN does not reach it."""
    return Target(what, f"{low:.4g} to {high:.4g}", f"{value:.4g}", low <= value <= high)


def tell(name: str, title: str, targets: list[Target]) -> Case:
    """Return a case of targets alone."""
    return Case(name, title, [], {}, (), tuple(targets))
