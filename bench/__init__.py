"""Measurements: what memory can give, what we reach, what others reach, in one run."""

from mirrorskin.bench.report import HEAD, LEGEND, as_data, as_markdown, as_notes, as_rows, as_title
from mirrorskin.bench.suite import NAMES, run_suite

__all__ = [
    "HEAD",
    "LEGEND",
    "NAMES",
    "as_data",
    "as_markdown",
    "as_notes",
    "as_rows",
    "as_title",
    "run_suite",
]
