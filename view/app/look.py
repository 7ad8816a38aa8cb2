"""The look of the application: styles, texts, and tables."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from importlib import resources
from typing import Any

import panel as pn

STYLE = resources.files("mirrorskin.view.app").joinpath("page.css").read_text("utf-8")
"""The style of texts."""


def text(content: str = "", **settings: Any) -> Any:
    """Return a pane with HTML in the style of the application."""
    return pn.pane.HTML(content, stylesheets=[STYLE], **settings)


def heading(content: str) -> Any:
    """Return the heading of a part of a pane."""
    return text(f"<h3>{escape(content)}</h3>", margin=(10, 10, 0, 10))


def hint(content: str) -> str:
    """Return a text that explains how something is used, or why it is missing."""
    return f'<p class="hint">{escape(content)}</p>'


def problem(content: str) -> str:
    """Return a text about what is wrong; empty if nothing is."""
    return f'<p class="problem">{escape(content)}</p>' if content else ""


def table(rows: Mapping[str, str]) -> str:
    """Return names and values as a table."""
    cells = "".join(
        f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in rows.items()
    )
    return f"<table>{cells}</table>"


def plain_axes(figure: Any) -> None:
    """Set the letters of a figure of Bokeh as those of the page."""
    figure.toolbar.logo = None
    figure.border_fill_color = None  # the page's, light or dark
    if figure.background_fill_color == "#ffffff":
        figure.background_fill_color = None
    figure.title.text_font_size = "14px"
    for axis in (figure.xaxis, figure.yaxis):
        axis.axis_label_text_font_style = "normal"
        axis.axis_label_text_font_size = "13px"
        axis.major_label_text_font_size = "12px"
