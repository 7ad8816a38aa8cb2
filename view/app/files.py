"""The pane that opens files: those of a folder, and those that are dropped on the page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path

import panel as pn

from mirrorskin.io.base.url import is_zarr
from mirrorskin.io.formats.pictures import PICTURE_SUFFIXES
from mirrorskin.io.formats.registry import format_of_frames, format_of_surface, has_frames
from mirrorskin.view.app.look import hint, text
from mirrorskin.view.app.session import Run, run_now

_LOOKED_AT = 20  # names in a folder, before it is taken for one without pictures
_WIDTH = 262


class FilesPane:
    """A list of the files in a folder, and a place where files that were dropped are announced.

    Parameters
    ----------
    folder : Path
    drops : Path, optional
        Where the server puts files that are dropped on the page.
    open_file : callable
        Called with the name and the path of a file.
    run : Run
        How the files are listed.
    """

    def __init__(
        self,
        folder: Path,
        drops: Path | None,
        open_file: Callable[[str, Path], object],
        run: Run = run_now,
    ) -> None:
        self._folder, self._drops, self._open_file, self._run = folder, drops, open_file, run
        self.names = pn.widgets.Select(label="Files of this folder", size=6, width=_WIDTH, options=[])
        self.open = pn.widgets.Button(label="Open", width=120)
        self.again = pn.widgets.Button(label="Look again", width=120)
        self.dropped = pn.widgets.TextInput(label="Dropped", visible=False, tags=["dropped"])
        self.open.on_click(lambda _: self._open())
        self.again.on_click(lambda _: self.look())
        self.dropped.param.watch(lambda event: self._drop(event.new), "value")
        about = hint("A file can also be dropped on the page.") if drops else ""
        self.view = pn.Column(
            self.names, pn.Row(self.open, self.again), text(about, width=_WIDTH), self.dropped, margin=0
        )

    def look(self) -> None:
        """List the files that can be opened."""
        self._run(lambda: candidates(self._folder), self._offer)

    def _offer(self, paths: Sequence[Path]) -> None:
        names = [path.name for path in paths]
        self.names.options = names
        self.open.disabled = not names

    def _open(self) -> None:
        if self.names.value:
            self._open_file(self.names.value, self._folder / self.names.value)

    def _drop(self, place: str) -> None:
        """Open a file that the server has put into a folder of its own."""
        parts = Path(place).parts
        if self._drops is not None and len(parts) == 2 and ".." not in parts:
            path = self._drops.joinpath(*parts)
            if path.is_file():
                self._open_file(path.name, path)


def candidates(folder: Path) -> Sequence[Path]:
    """Return the files and folders in a folder that look like recordings or results, by name."""
    found: list[Path] = []
    with suppress(OSError):  # what cannot be read is not offered
        found = [path for path in folder.iterdir() if not path.name.startswith(".") and _is_offered(path)]
    return sorted(found)


def _is_offered(path: Path) -> bool:
    with suppress(OSError):
        if path.is_dir() and not is_zarr(path):
            form = format_of_frames(path)
            if form is not None and form.folder_mark[0]:  # such as a bag of messages
                return True
            inside = islice(path.iterdir(), _LOOKED_AT)
            return any(inner.suffix.lower() in PICTURE_SUFFIXES for inner in inside)
        return has_frames(path) or format_of_surface(path) is not None
    return False
