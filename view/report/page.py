"""A report: one HTML file that needs no network."""

from __future__ import annotations

import base64
import hashlib
import os
from collections.abc import Mapping
from importlib import resources
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from mirrorskin.io import InputError, Result, select_turn
from mirrorskin.io.base.system import translate_os_errors
from mirrorskin.io.storage.atomic import MAKE_ROOM, new_file
from mirrorskin.view.drawing.canvas import check_drawing
from mirrorskin.view.report.contents import Ends, contents_of, surface_of

_TEMPLATES = ("alone.html", "page.html", "script.html", "surface.html")
_SCRIPTS = ("grid.js", "scene.js", "view.js", "surface.js")


def check_report() -> None:
    """Raise InputError if a report cannot be written, before any work is done."""
    check_drawing()
    if find_spec("jinja2") is None:
        raise InputError("a report needs Jinja2: pip install 'mirrorskin[view]'")


def write_report(
    result: Result,
    path: str | Path,
    *,
    name: str,
    section: Ends | None = None,
    turn: int | None = None,
) -> None:
    """Write a report on a result: one page that only needs a browser.

    The page contains pictures, numbers, scripts and styles; its policy forbids all other content.

    Parameters
    ----------
    result : Result
    path : str or Path
        HTML file to write; it appears complete or not at all.
    name : str
        Name of the result, usually that of its file.
    section : ((float, float), (float, float)), optional
        Ends of the cross-section, x and y in mm; by default it passes through the apex.
    turn : int, optional
        Number of the turn, from 0, for a result with a map for each turn.

    Raises
    ------
    InputError
        Matplotlib or Jinja2 is not installed, there is no such turn, a section is given without a pixel
        size, or the file cannot be written.
    """
    check_report()
    page = _render(contents_of(select_turn(result, turn), name, section, turn))
    path = Path(path)
    with (
        new_file(path) as descriptor,
        translate_os_errors(f"{path} could not be written", MAKE_ROOM),
        os.fdopen(os.dup(descriptor), "w", encoding="utf-8", errors="replace", newline="\n") as file,
    ):
        file.write(page)


def surface_page(result: Result, name: str) -> str:
    """Return a page with nothing but the surface of a result, to be shown inside of another page."""
    return _render(surface_of(select_turn(result, None)) | {"title": name}, "alone.html")


def _render(contents: Mapping[str, Any], template: str = "page.html") -> str:
    import jinja2

    folder = resources.files("mirrorskin.view.report")
    texts = {name: folder.joinpath(name).read_text("utf-8") for name in (*_TEMPLATES, "page.css", *_SCRIPTS)}
    environment = jinja2.Environment(
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        keep_trailing_newline=True,
        loader=jinja2.DictLoader(texts),
    )
    script = "\n".join(texts[name] for name in _SCRIPTS)
    return environment.get_template(template).render(
        **contents,
        policy=_policy(script, texts["page.css"]),
        style=_unescaped(texts["page.css"]),
        script=_unescaped(script),
    )


def _unescaped(text: str) -> Any:
    """Mark a file of this package as safe to be inserted unescaped."""
    import markupsafe

    return markupsafe.Markup(text)


def _policy(script: str, style: str) -> str:
    """Return a policy that allows the page's own script, style and pictures, and nothing else."""
    sources = {"script-src": script, "style-src": style}
    hashes = [f"{kind} 'sha256-{_hash(text)}'" for kind, text in sources.items()]
    return "; ".join(
        ["default-src 'none'", "img-src data:", *hashes, "base-uri 'none'", "form-action 'none'"]
    )


def _hash(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii")
