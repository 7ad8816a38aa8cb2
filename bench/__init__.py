"""Measurements: what memory can give, what we reach, what others reach, in one run."""

from mirrorskin.bench.page import write_page, write_text
from mirrorskin.bench.report import (
    HEAD,
    LEGEND,
    TARGET_HEAD,
    as_data,
    as_markdown,
    as_notes,
    as_rows,
    as_targets,
    as_title,
)
from mirrorskin.bench.runs import open_run
from mirrorskin.bench.suite import NAMES, check_accuracy, choose, run_suite

__all__ = [
    "HEAD",
    "LEGEND",
    "NAMES",
    "TARGET_HEAD",
    "as_data",
    "as_markdown",
    "as_notes",
    "as_rows",
    "as_targets",
    "as_title",
    "check_accuracy",
    "choose",
    "open_run",
    "run_suite",
    "write_page",
    "write_text",
]
