"""Tables of results, their places in pages, and bounds of results."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mirrorskin.cli.commands.bench.records import Target


@dataclass(frozen=True, slots=True)
class Table:
    """A title, the names of the columns, and the rows below them; a column's name may hold its unit."""

    title: str
    head: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]

    def __str__(self) -> str:
        return f"{self.title}\n\n{self.as_markdown('---:')}"

    def as_markdown(self, alignment: str = "---") -> str:
        """Return the table alone, with the alignment of its columns."""
        lines = [self.head, (alignment,) * len(self.head), *self.rows]
        return "".join("| " + " | ".join(line) + " |\n" for line in lines)

    def write_into(self, page: Path, name: str) -> None:
        """Write the table between the marks of a name in a page; see `replace_part`."""
        text = page.read_text(encoding="utf-8")
        page.write_text(replace_part(text, name, self.as_markdown("---:")), encoding="utf-8")

    def column(self, name: str) -> list[float]:
        """Return a column's numbers; NaN where there is none."""
        number = self.head.index(name)
        return [float(row[number]) if _is_number(row[number]) else math.nan for row in self.rows]


def _is_number(text: str) -> bool:
    return text.lstrip("+-").replace(".", "", 1).isdigit()


def replace_part(page: str, name: str, text: str) -> str:
    """Return a page with a text between the marks ``<!-- NAME -->`` and ``<!-- end NAME -->``."""
    start, end = f"<!-- {name} -->\n", f"<!-- end {name} -->"
    head, rest = page.split(start)
    return f"{head}{start}\n{text}\n{end}{rest.split(end, 1)[1]}"


def at_most(what: str, value: float, bound: float) -> Target:
    """Return a target with an upper bound; NaN does not meet it."""
    return Target(what, f"at most {bound:.3g}", f"{value:.3g}", bool(value <= bound))


def within(what: str, value: float, low: float, high: float) -> Target:
    """Return a target with two bounds; NaN does not meet it."""
    return Target(what, f"{low:.4g} to {high:.4g}", f"{value:.4g}", bool(low <= value <= high))
