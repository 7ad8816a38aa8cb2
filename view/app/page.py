"""The application: one page with a recording, its options, and the result."""

from __future__ import annotations

import asyncio
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from html import escape
from importlib import resources
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any

import panel as pn
from panel.io.resources import LOCAL_DIST

from mirrorskin import io
from mirrorskin.io.base.findings import warnings_in
from mirrorskin.view.app.files import FilesPane
from mirrorskin.view.app.look import hint, problem, text
from mirrorskin.view.app.options import OptionsPane
from mirrorskin.view.app.recording import RecordingPane
from mirrorskin.view.app.result import ResultPane
from mirrorskin.view.app.save import SavePane
from mirrorskin.view.app.session import Computed, Opening, Run, Session, T, keep_recent, run_now
from mirrorskin.view.app.surface import SurfacePane

if TYPE_CHECKING:
    from mirrorskin.view.app.rig import RigPane
    from mirrorskin.view.app.rig_control import RigControl

Shown = str | Path | io.Recording | io.Result

_KEPT = 600_000_000  # bytes of results of the list that are kept to be compared
_TABS = ".bk-tab.bk-active { color: inherit; background: transparent; }"
_LIST = ".bk-input { padding: 4px 8px; }"
_SIDE = 290  # width of the list and the options
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
    folder : Path, optional
        A folder whose files can be opened from the page.
    drops : Path, optional
        Where the server puts files that are dropped on the page.

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
        folder: Path | None = None,
        drops: Path | None = None,
    ) -> None:
        if not sources and rig is None and folder is None:
            raise io.InputError("the application needs a recording, a result or a rig: name a file")
        pn.extension(inline=True)  # in a notebook, no other machine is asked for scripts
        opened = opening or Opening()
        openings = [opened] * len(sources) if isinstance(opened, Opening) else [*opened]
        self._closed = Event()
        self._worker = ThreadPoolExecutor(1, "mirrorskin-page") if _is_served() else None
        self._run = (
            run_now if self._worker is None else _in_thread(self._worker, pn.state.curdoc, self._closed)
        )
        self._measurer = ThreadPoolExecutor(1, "mirrorskin-measures") if self._worker else None
        self._run_aside = (
            run_now if self._measurer is None else _in_thread(self._measurer, pn.state.curdoc, self._closed)
        )
        self._sources = [*zip(sources, openings, strict=True)]
        self._computed: dict[int, Computed] = {}  # results of the list, the least recently used one first
        self._opening = 0  # counts what is opened
        self.session: Session | None = None
        self.rig: RigPane | None = None
        self.recording: RecordingPane | None = None
        self.options: OptionsPane | None = None
        self.result: ResultPane | None = None
        names: dict[str, int] = {}
        for number, source in enumerate(sources):
            name = _name_of(source, number)
            names[f"{name} ({number + 1})" if name in names else name] = number
        stop: list[Any] = []
        if rig is not None:
            from mirrorskin.view.app.rig import REFRESH, RigPane

            self.rig = RigPane(rig, self.add)
            names = {f"rig {rig.settings.name}": _RIG, **names}
            stop = [self.rig.stop]
            if self._worker is not None:
                pn.state.add_periodic_callback(self.rig.refresh_when_drawn, REFRESH)
        self.choice = pn.widgets.Select(
            label="Recordings and results", size=2, width=_SIDE - 20, stylesheets=[_LIST]
        )
        self._offer(names)
        self.choice.value = next(iter(names.values()), None)
        self.choice.param.watch(lambda _: self._open(), "value")
        self.files = FilesPane(folder, drops, self.add, self._run) if folder is not None else None
        files = pn.Card(
            *([self.files.view] if self.files else []), title="Open a file", collapsed=bool(names),
            width=_SIDE - 20, visible=folder is not None, margin=(8, 10),
        )  # fmt: skip
        if self.files is not None:
            look = self.files.look  # only if it is opened: a folder may have many files
            files.param.watch(lambda event: None if event.new else look(), "collapsed")
            if not names:
                look()
        self._about = text(sizing_mode="stretch_width", margin=(9, 10))
        self._part = pn.Column(margin=0)  # the options of what is shown
        self._main = pn.Column(styles={"flex": "1 1 400px", "min-width": "0"})
        self.body = pn.FlexBox(
            pn.Column(self.choice, files, self._part, width=_SIDE),
            self._main,
            align_items="flex-start",
            sizing_mode="stretch_width",
        )
        self._open()
        if self._worker is not None:
            # What is added to the page later is styled by this server, too, not by Panel's in the internet.
            pn.state.curdoc.template_variables["dist_url"] = LOCAL_DIST
        title = text("<h1>mirrorskin</h1>", width=120)
        self.head = pn.Row(title, self._about, sizing_mode="stretch_width")
        self.view = pn.Column(pn.Row(*stop, self.head), self.body, sizing_mode="stretch_width")

    def _offer(self, names: dict[str, int]) -> None:
        """Offer recordings and results by name."""
        self.choice.options, self.choice.visible = names, len(names) > 1
        self.choice.size = min(max(len(names), 3), 8)

    def add(self, name: str, source: Shown) -> None:
        """Show another recording or result, which can be chosen from then on."""
        self._sources.append((source, Opening()))
        number = len(self._sources) - 1
        taken, before = name in self.choice.options, self._opening
        self._offer({**self.choice.options, f"{name} ({number + 1})" if taken else name: number})
        self.choice.value = number
        if self._opening == before:  # it is chosen already
            self._open()

    def _open(self) -> None:
        """Show the chosen file, or the rig."""
        self._opening += 1
        if self.session is not None:
            self.session.close()
            self.session = self.recording = self.options = self.result = None
        opening, number = self._opening, self.choice.value
        self._part[:] = []
        if number is None:
            self._main[:] = [text(hint("Choose a file on the left, or drop one on the page."))]
        elif number == _RIG:
            assert self.rig is not None
            self._main[:] = [self.rig.view]
            self.rig.begin_showing()
        else:
            self._main[:] = [text(f'<p class="hint"><i class="busy"></i>{escape(self._name(number))}</p>')]
            self._run(lambda: self._session_of(number), lambda session: self._show(opening, number, session))
        self._describe()

    def _name(self, number: int) -> str:
        return next((name for name, at in self.choice.options.items() if at == number), "")

    def _session_of(self, number: int) -> Session | io.InputError:
        """Open a file; the work of a thread."""
        source, opening = self._sources[number]
        try:
            return Session(source, opening, self._run, self._run_aside)
        except io.InputError as error:
            return error

    def _show(self, opening: int, number: int, session: Session | io.InputError) -> None:
        """Show what was opened, unless something else has been chosen meanwhile."""
        if isinstance(session, io.InputError):
            if self._worker is None:
                raise session
            if opening == self._opening:
                self._main[:] = [text(problem(str(session)))]
            return
        if opening != self._opening:
            session.close()
            return
        self.session = session
        session.watch("result", "problem", callback=self._describe)
        session.watch("result", callback=lambda: self._keep(number, session.now))
        tabs: list[tuple[str, Any]] = []
        if session.whole is not None:
            self.options = OptionsPane(session)
            self.recording = RecordingPane(session)
            tabs.append(("Recording", self.recording.view))
            self._part[:] = [self.options.view]
        self.result = ResultPane(session, lambda: self._others(number), self._take)
        self.surface, self.save = SurfacePane(session), SavePane(session)
        tabs += [
            ("Result", self.result.view),
            ("Surface", self.surface.view),
            ("Save and copy", self.save.view),
        ]
        places = [pn.Column(sizing_mode="stretch_width") for _ in tabs]
        self.tabs = pn.Tabs(
            *((name, place) for (name, _), place in zip(tabs, places, strict=True)),
            sizing_mode="stretch_width",
            stylesheets=[_TABS],
        )

        def fill() -> None:
            """Fill the chosen tab only: others would take the place that they need."""
            for number, ((_, view), place) in enumerate(zip(tabs, places, strict=True)):
                place[:] = [view] if number == self.tabs.active else []

        self.tabs.param.watch(lambda _: fill(), "active")
        fill()
        self.surface.shown_in(self.tabs, len(tabs) - 2)
        self._main[:] = [self.tabs]
        self._keep(number, session.now)
        self._describe()

    def _others(self, chosen: int) -> dict[str, int]:
        """Return the recordings and results that the chosen one can be compared with."""
        return {name: number for name, number in self.choice.options.items() if number not in (_RIG, chosen)}

    def _keep(self, number: int, computed: Computed | None) -> None:
        """Keep a result to compare others with, and not more than fit into a limited memory."""
        if computed is None:
            self._computed.pop(number, None)
        else:
            keep_recent(self._computed, number, computed, _KEPT)

    def _take(self, number: int, then: Callable[[Computed], object]) -> None:
        """Call a function with a result of the list, which is read or computed if that is necessary."""
        session = self.session

        def read() -> Computed | None:
            if number in self._computed:
                return self._computed[number]
            source, opening = self._sources[number]
            try:
                other = Session(source, opening)
            except io.InputError:
                return None
            other.close()
            return other.now

        def show(computed: Computed | None) -> None:
            if computed is not None and session is self.session:
                self._keep(number, computed)
                then(replace(computed, label=f"{self._name(number)}, {computed.label}"))

        self._run(read, show)

    def _describe(self) -> None:
        """Say in the head what is shown."""
        session = self.session
        if session is None:
            self._about.object = ""
            return
        parts = [session.name]
        if session.whole is not None:
            count, rows, columns = session.whole.shape
            parts.append(f"{session.whole.motion} motion, {count} frames of {columns} x {rows}")
        if session.computing:
            parts.insert(0, "the result is being computed")
        messages: Sequence[str] = ()
        if session.now is not None:
            messages = warnings_in(session.now.result.process)
            parts.append(session.now.summary)
            if session.now.seconds:
                parts.append(f"computed in {session.now.seconds:.2f} s")
        busy = '<i class="busy"></i>' if session.computing else ""
        lines = [f'<p class="about">{busy}{escape("; ".join(parts))}</p>']
        lines += [f'<p class="warning">{escape(message)}</p>' for message in messages]
        self._about.object = "".join(lines)

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> Any:
        """Show the application in a notebook."""
        return self.view._repr_mimebundle_(include, exclude)

    def close(self) -> None:
        """Close the files, and give up what is computed."""
        self._closed.set()
        if self.session is not None:
            self.session.close()
        for worker in (self._worker, self._measurer):
            if worker is not None:
                worker.shutdown(wait=False, cancel_futures=True)

    def page(self) -> Any:
        """Return the page for a window of its own."""
        places = {"head": self.head, "body": self.body}
        if self.rig is not None:
            places["stop"] = self.rig.stop
        page = pn.Template(_file("page.html"))
        page.add_variable("style", _file("window.css"))
        page.add_variable("script", _file("page.js"))
        page.add_variable("stoppable", self.rig is not None)
        for name, place in places.items():
            page.add_panel(name, place)
        return page


def _file(name: str) -> str:
    return resources.files("mirrorskin.view.app").joinpath(name).read_text("utf-8")


def _is_served() -> bool:
    """Return whether a page is being made for a browser window, not for a notebook."""
    return pn.state.curdoc is not None and pn.state.curdoc.session_context is not None


def _in_thread(worker: Executor, document: Any, closed: Event) -> Run:
    """Return a way to compute in a thread, so that the server answers meanwhile, and to show the result.

    Only the server's thread touches the document: Panel may lose what another thread adds to it.
    """
    loop, context = asyncio.get_running_loop(), document.session_context

    def run(work: Callable[[], T], then: Callable[[T], object], /) -> None:
        def show(result: T) -> None:
            if not closed.is_set() and not context.destroyed:
                document.add_next_tick_callback(lambda: then(result))

        def compute() -> None:
            result = work()
            with suppress(RuntimeError):  # the server has ended
                loop.call_soon_threadsafe(show, result)

        def show_error(ended: Future[None]) -> None:
            """Log what failed, unless the page is closed: the work may lack what has been closed with it."""
            if not closed.is_set():
                ended.result()

        try:
            ended = worker.submit(compute)
        except RuntimeError:
            if not closed.is_set():
                raise
        else:
            ended.add_done_callback(show_error)

    return run


def _name_of(source: Shown, number: int) -> str:
    if isinstance(source, str | Path):
        return Path(source).name
    return source.name if isinstance(source, io.Recording) else f"result {number + 1}"


@contextmanager
def pages(
    sources: Sequence[Path],
    openings: Sequence[Opening],
    rig: RigControl | None = None,
    folder: Path | None = None,
    drops: Path | None = None,
) -> Iterator[Callable[[], Any]]:
    """Yield a function that makes a page; at the end, all pages are closed.

    A page opens files of a folder, and of one where the server puts what is dropped on the page. When the
    last one is closed, the rig is stopped.
    """
    opened: list[App] = []
    # Pages show them; threads cannot change filters for themselves.
    warnings.simplefilter("ignore", io.MirrorskinWarning)

    def page() -> Any:
        app = App(*sources, opening=openings, rig=rig, folder=folder, drops=drops)
        opened.append(app)

        def close(_: Any) -> None:
            app.close()
            opened.remove(app)
            if rig is not None and not opened:
                rig.close()

        pn.state.on_session_destroyed(close)
        return app.page()

    try:
        yield page
    finally:
        for app in opened:
            app.close()
