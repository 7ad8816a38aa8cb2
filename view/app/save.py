"""The pane that saves a result: files for other programs, the command, and the Python script."""

from __future__ import annotations

import asyncio
import tempfile
from io import BytesIO
from pathlib import Path
from typing import Any

import panel as pn

from mirrorskin import io
from mirrorskin.engine.metrology import section_columns
from mirrorskin.io import InputError
from mirrorskin.io.formats.export import check_export
from mirrorskin.io.formats.registry import exports
from mirrorskin.view.app.look import heading, problem, text
from mirrorskin.view.app.session import Session
from mirrorskin.view.app.wording import as_command, as_python

_RESULT, _REPORT = ".h5", ".html"
_OWN = {
    "result of mirrorskin: all maps, options and origin (.h5)": (_RESULT, False),
    "report: a page with pictures, numbers and the surface (.html)": (_REPORT, False),
    "the section as a table (.csv)": (".csv", True),
}
_TITLED = "label { font-size: 1rem; font-weight: 620; }"  # as a heading
_SAME = (".tiff", ".zarr")  # another name of .tif, and a folder, which a browser does not save


def files() -> dict[str, tuple[str, bool]]:
    """Return the suffix of each kind of file by its description, and whether it contains the section only."""
    others = {f"{form.content} ({suffix})": (suffix, False) for suffix, form in exports().items()}
    return {**_OWN, **{text: kind for text, kind in others.items() if kind[0] not in _SAME}}


class SavePane:
    """Buttons that save a result, and texts that compute it again."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self.format = pn.widgets.Select(label="File", options=files(), value=(_RESULT, False), width=460)
        self.download = pn.widgets.FileDownload(
            callback=self._file,
            filename="result.h5",
            color="primary",
            width=220,
            label="Save result.h5",
        )
        self.problem = text(sizing_mode="stretch_width")
        self.command = _text("The same result on the command line", 90)
        self.python = _text("The same result in Python", 190)
        self.format.param.watch(lambda _: self._name_file(), "value")
        session.watch("result", "problem", "part", "ends", callback=self._show)
        self._show()
        texts = []
        if session.whole is not None:
            for area, what in ((self.command, "command"), (self.python, "script")):
                copy = pn.widgets.Button(label=f"Copy the {what}", width=140)
                copy.js_on_click(args={"source": area}, code="navigator.clipboard.writeText(source.value)")
                texts += [area, copy]
        self.view = pn.Column(
            heading("Save a file"),
            self.format,
            self.download,
            self.problem,
            *texts,
        )

    def _name_file(self) -> None:
        stem = Path(self._session.name).stem
        self.download.filename = f"{stem}-result{self.format.value[0]}"
        self.download.label = f"Save {self.download.filename}"

    def _show(self) -> None:
        self._name_file()
        self.problem.object = ""
        if self._session.whole is not None:
            self.command.value = as_command(self._session)
            self.python.value = as_python(self._session)

    async def _file(self) -> BytesIO | None:
        """Return the file, written by the exporter that the command line uses."""
        try:
            return BytesIO(await asyncio.to_thread(self.write))
        except InputError as error:
            self.problem.object = problem(str(error))
            return None

    def write(self) -> bytes:
        """Return the bytes of the file."""
        session, (suffix, with_section) = self._session, self.format.value
        if session.computing:
            raise InputError("the result is being computed. Save it when it is shown")
        if session.now is None or session.failed:
            raise InputError(f"no result has been computed with these options: {session.problem}")
        result = session.now.result
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
            path = Path(folder, str(self.download.filename))
            if suffix == _RESULT:
                io.save_result(result, path)
                return path.read_bytes()
            sheet = session.sheet(session.now)
            assert sheet is not None
            ends = session.ends if sheet.unit == "mm" else None  # of a report and a table
            if suffix == _REPORT:
                from mirrorskin.view.report import write_report

                write_report(sheet.result, path, name=session.name, section=ends)
                return path.read_bytes()
            check_export(sheet.result, path)
            columns = section_columns(sheet.result, ends) if with_section else None
            io.export_result(sheet.result, path, section=columns)
            return path.read_bytes()


def _text(title: str, height: int) -> Any:
    return pn.widgets.TextAreaInput(
        label=title,
        stylesheets=[_TITLED],
        height=height,
        sizing_mode="stretch_width",
        max_width=900,
        disabled=False,
        css_classes=["code"],
        resizable=False,
        max_length=100_000,
    )
