"""The pane of the surface in space, which the script of the report draws."""

from __future__ import annotations

from html import escape
from typing import Any

import panel as pn

from mirrorskin.view.app.session import Computed, Session

_HEIGHT = 740


class SurfacePane:
    """The heights of the result as a surface that can be turned; it is drawn when it is looked at."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._drawn: Computed | None = None
        self._looked_at = False
        self.page = pn.pane.HTML("", sizing_mode="stretch_width", height=_HEIGHT)
        self.view = pn.Column(self.page, sizing_mode="stretch_width")
        session.watch("result", callback=self._draw)

    def shown_in(self, tabs: Any, number: int) -> None:
        """Draw when this tab is chosen."""

        def look(event: Any) -> None:
            self._looked_at = event.new == number
            self._draw()

        tabs.param.watch(look, "active")

    def _draw(self) -> None:
        from mirrorskin.view.report import surface_page

        now = self._session.now
        if not self._looked_at or now is self._drawn:
            return
        self._drawn = now
        sheet = self._session.sheet(now)
        if sheet is None:
            self.page.object = ""
            return
        self._session.run(
            lambda: surface_page(sheet.result, self._session.name),
            lambda page: self._show(page, now),
        )

    def _show(self, page: str, of: Computed | None) -> None:
        """Show a page with the surface of a result, unless another one is drawn."""
        if of is not self._drawn:
            return
        style = f"border:0;width:100%;height:{_HEIGHT}px"
        srcdoc = escape(page, quote=True)
        self.page.object = f'<iframe title="Surface" srcdoc="{srcdoc}" style="{style}"></iframe>'
