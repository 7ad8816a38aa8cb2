"""A result as one page that any browser shows without a network."""

from mirrorskin.view.report.page import check_report, write_report

__all__ = ["check_report", "write_report"]
