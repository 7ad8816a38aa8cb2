"""The application: one page with a recording, its options, and the result."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

import panel as pn

from mirrorskin import io
from mirrorskin.engine.summary import summarise
from mirrorskin.view.app.look import text
from mirrorskin.view.app.options import OptionsPane
from mirrorskin.view.app.recording import RecordingPane
from mirrorskin.view.app.result import ResultPane
from mirrorskin.view.app.save import SavePane
from mirrorskin.view.app.session import Opening, Session
from mirrorskin.view.app.surface import SurfacePane

Shown = str | Path | io.Recording | io.Result


class App:
    """A recording or a result to click: in a notebook, or served by `mirrorskin app`.

    Parameters
    ----------
    *sources : path, Recording or Result
        What is shown; of several, one at a time.
    opening : Opening, or one for each source, optional
        How recordings are opened, and the device.

    Attributes
    ----------
    session : Session
        What is shown: ``session.now.result`` is the current result, and ``session.choose`` sets an option.

    Raises
    ------
    mirrorskin.io.InputError
        A file cannot be read.

    Examples
    --------
    >>> from mirrorskin import engine, hw
    >>> from mirrorskin.hw.twin import Vertical
    >>> press = hw.Twin(object="sphere", shape=(40, 40), pixel_size=0.26, movement=Vertical([0.1, 0.2, 0.3]))
    >>> app = App(engine.reconstruct(press))
    >>> app.session.now.result.height.shape
    (40, 40)
    """

    def __init__(self, *sources: Shown, opening: Opening | Sequence[Opening] | None = None) -> None:
        if not sources:
            raise io.InputError("the application needs a recording or a result: name a file")
        pn.extension()
        one = opening or Opening()
        self._sources = sources
        self._openings = [one] * len(sources) if isinstance(one, Opening) else [*one]
        names = [_name_of(one, number) for number, one in enumerate(sources)]
        self.choice = pn.widgets.Select(
            options=dict(zip(names, range(len(names)), strict=True)), width=280, label="", value=0
        )
        self.choice.param.watch(lambda _: self._open(), "value")
        self._about = text(sizing_mode="stretch_width", margin=(9, 10))
        self._body = pn.Row(sizing_mode="stretch_width", css_classes=["body"])
        self.session: Session | None = None
        self._open()
        head = pn.Row(
            text("<h1>mirrorskin</h1>", width=120),
            *([self.choice] if len(sources) > 1 else []),
            self._about,
            css_classes=["head"],
            sizing_mode="stretch_width",
        )
        self.view = pn.Column(head, self._body, sizing_mode="stretch_width")

    def _open(self) -> None:
        """Show the chosen file."""
        if self.session is not None:
            self.session.close()
        number = self.choice.value
        session = Session(self._sources[number], self._openings[number])
        self.session = session
        session.watch("result", "problem", callback=self._describe)
        tabs: list[tuple[str, Any]] = []
        side: list[Any] = []
        self.recording = self.options = None
        if session.whole is not None:
            self.options = OptionsPane(session)
            self.recording = RecordingPane(session)
            tabs.append(("Recording", self.recording.view))
            side = [self.options.view]
        self.result, self.surface, self.save = ResultPane(session), SurfacePane(session), SavePane(session)
        tabs += [
            ("Result", self.result.view),
            ("Surface", self.surface.view),
            ("Save and copy", self.save.view),
        ]
        self.tabs = pn.Tabs(*tabs, sizing_mode="stretch_width", dynamic=True)
        self.surface.shown_in(self.tabs, len(tabs) - 2)
        self._body[:] = [*side, self.tabs]
        self._describe()

    def _describe(self) -> None:
        """Say in the head what is shown."""
        session = self.session
        assert session is not None
        parts = [session.name] if len(self._sources) == 1 else []
        if session.whole is not None:
            count, rows, columns = session.whole.shape
            parts.append(f"{session.whole.motion} motion, {count} frames of {columns} x {rows}")
        if session.now is not None:
            parts.append(str(summarise(session.now.result)))
            if session.now.seconds:
                parts.append(f"computed in {session.now.seconds:.2f} s")
        told = (
            ""
            if session.now is None
            else "".join(f'<p class="warning">{escape(one)}</p>' for one in session.now.warnings)
        )
        self._about.object = f'<p class="about">{"; ".join(map(escape, parts))}</p>{told}'

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> Any:
        """Show the application in a notebook."""
        return self.view._repr_mimebundle_(include, exclude)

    def close(self) -> None:
        """Close the files."""
        if self.session is not None:
            self.session.close()


def _name_of(source: Shown, number: int) -> str:
    if isinstance(source, str | Path):
        return str(source)
    return source.name if isinstance(source, io.Recording) else f"result {number + 1}"


def pages(sources: Sequence[Path], openings: Sequence[Opening]) -> Any:
    """Return a function that makes the page of one browser window."""

    def page() -> Any:
        app = App(*sources, opening=openings)
        pn.state.on_session_destroyed(lambda _: app.close())
        return app.view

    return page
