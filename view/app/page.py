"""The application: one page with a recording, its options, and the result."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import panel as pn

from mirrorskin import io
from mirrorskin.engine.base.summary import summarise
from mirrorskin.io.base.findings import warnings_in
from mirrorskin.view.app.look import text
from mirrorskin.view.app.options import OptionsPane
from mirrorskin.view.app.recording import RecordingPane
from mirrorskin.view.app.result import ResultPane
from mirrorskin.view.app.save import SavePane
from mirrorskin.view.app.session import Opening, Run, Session, T, run_now
from mirrorskin.view.app.surface import SurfacePane

if TYPE_CHECKING:
    from mirrorskin.view.app.rig import RigPane
    from mirrorskin.view.app.rig_control import RigControl

Shown = str | Path | io.Recording | io.Result

_RIG = -1  # the choice of the rig, among numbers of files


class App:
    """A recording or a result to click: in a notebook, or served by `mirrorskin app`.

    Parameters
    ----------
    *sources : path, Recording or Result
        What is shown; of several, one at a time.
    opening : Opening, or one for each source, optional
        How recordings are opened, and the device.
    rig : RigControl, optional
        A rig to drive.

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
    >>> from mirrorskin import engine
    >>> from mirrorskin.twin import Twin, Vertical
    >>> press = Twin(object="sphere", shape=(40, 40), pixel_size=0.26, movement=Vertical([0.1, 0.2, 0.3]))
    >>> app = App(engine.reconstruct(press))
    >>> app.session.now.result.height.shape
    (40, 40)
    """

    def __init__(
        self,
        *sources: Shown,
        opening: Opening | Sequence[Opening] | None = None,
        rig: RigControl | None = None,
    ) -> None:
        if not sources and rig is None:
            raise io.InputError("the application needs a recording, a result or a rig: name a file")
        pn.extension(inline=True)  # in a notebook, no other machine is asked for scripts
        opened = opening or Opening()
        openings = [opened] * len(sources) if isinstance(opened, Opening) else [*opened]
        self._worker = ThreadPoolExecutor(1, "mirrorskin-page") if _is_served() else None
        self._run = run_now if self._worker is None else _in_thread(self._worker, pn.state.curdoc)
        self._sources = [*zip(sources, openings, strict=True)]
        self.session: Session | None = None
        self.rig: RigPane | None = None
        self.recording: RecordingPane | None = None
        self.options: OptionsPane | None = None
        names = {_name_of(source, number): number for number, source in enumerate(sources)}
        stop: list[Any] = []
        if rig is not None:
            from mirrorskin.view.app.rig import REFRESH, RigPane

            self.rig = RigPane(rig, self.add)
            names = {f"rig {rig.settings.name}": _RIG, **names}
            stop = [self.rig.stop]
            if self._worker is not None:
                pn.state.add_periodic_callback(self.rig.refresh, REFRESH)
        self.choice = pn.widgets.Select(
            options=names, width=280, label="", value=next(iter(names.values())), visible=len(names) > 1
        )
        self.choice.param.watch(lambda _: self._open(), "value")
        self._about = text(sizing_mode="stretch_width", margin=(9, 10))
        self._body = pn.Row(sizing_mode="stretch_width")
        self._open()
        head = pn.Row(
            *stop,
            text("<h1>mirrorskin</h1>", width=120),
            self.choice,
            self._about,
            sizing_mode="stretch_width",
            styles={"position": "sticky", "top": "0", "z-index": "10", "background": "white"},
        )
        self.view = pn.Column(head, self._body, sizing_mode="stretch_width")

    def add(self, name: str, source: Shown) -> None:
        """Show another recording or result, which can be chosen from then on."""
        self._sources.append((source, Opening()))
        number = len(self._sources) - 1
        self.choice.options = {**self.choice.options, f"{name} ({number + 1})": number}
        self.choice.visible = True
        self.choice.value = number

    def _open(self) -> None:
        """Show the chosen file, or the rig."""
        if self.session is not None:
            self.session.close()
            self.session = self.recording = self.options = None
        number = self.choice.value
        if number == _RIG:
            assert self.rig is not None
            self._body[:] = [self.rig.view]
            self._describe()
            return
        source, opening = self._sources[number]
        session = Session(source, opening, self._run)
        self.session = session
        session.watch("result", "problem", callback=self._describe)
        tabs: list[tuple[str, Any]] = []
        side: list[Any] = []
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
        if session is None:
            self._about.object = ""
            return
        parts = [] if self.choice.visible else [session.name]
        if session.whole is not None:
            count, rows, columns = session.whole.shape
            parts.append(f"{session.whole.motion} motion, {count} frames of {columns} x {rows}")
        if session.computing:
            parts.append("the result is being computed")
        messages: Sequence[str] = ()
        if session.now is not None:
            messages = warnings_in(session.now.result.process)
            parts.append(str(summarise(session.now.result)))
            if session.now.seconds:
                parts.append(f"computed in {session.now.seconds:.2f} s")
        lines = [f'<p class="about">{escape("; ".join(parts))}</p>']
        lines += [f'<p class="warning">{escape(message)}</p>' for message in messages]
        self._about.object = "".join(lines)

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> Any:
        """Show the application in a notebook."""
        return self.view._repr_mimebundle_(include, exclude)

    def close(self) -> None:
        """Close the files."""
        if self.session is not None:
            self.session.close()
        if self._worker is not None:
            self._worker.shutdown(wait=False)


def _is_served() -> bool:
    """Return whether a page is being made for a browser window, not for a notebook."""
    return pn.state.curdoc is not None and pn.state.curdoc.session_context is not None


def _in_thread(worker: Executor, document: Any) -> Run:
    """Return a way to compute in a thread, so that the server answers meanwhile, and to show the result."""

    def run(work: Callable[[], T], then: Callable[[T], object], /) -> None:
        def compute() -> None:
            result = work()
            document.add_next_tick_callback(lambda: then(result))

        worker.submit(compute).add_done_callback(Future.result)  # an error is logged

    return run


def _name_of(source: Shown, number: int) -> str:
    if isinstance(source, str | Path):
        return str(source)
    return source.name if isinstance(source, io.Recording) else f"result {number + 1}"


def pages(
    sources: Sequence[Path], openings: Sequence[Opening], rig: RigControl | None = None
) -> Callable[[], Any]:
    """Return a function that makes a page; when the last page is closed, the rig is stopped."""
    opened: list[App] = []
    # Pages show them; threads cannot change filters for themselves.
    warnings.simplefilter("ignore", io.MirrorskinWarning)

    def page() -> Any:
        app = App(*sources, opening=openings, rig=rig)
        opened.append(app)

        def close(_: Any) -> None:
            app.close()
            opened.remove(app)
            if rig is not None and not opened:
                rig.close()

        pn.state.on_session_destroyed(close)
        return app.view

    return page
