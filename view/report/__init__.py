"""Report on a result: one HTML page that needs no network."""

from mirrorskin.view.report.page import check_report, surface_page, write_report

__all__ = ["check_report", "surface_page", "write_report"]
