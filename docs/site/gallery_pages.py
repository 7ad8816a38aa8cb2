"""The pages of the gallery: scripts that run while the site is built, with their output and figures."""

from __future__ import annotations

import ast
import functools
import os
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from mkdocs.exceptions import PluginError

_FOLDER = Path(__file__).resolve().parents[2] / "examples"
_ORDER = [
    "sphere",
    "coin",
    "fused",
    "touch",
    "own_data",
    "app",
    "live_heights",
    "fringes",
    "focus",
    "lamps",
    "sensors",
    "force",
    "vibration",
    "slip",
    "hold",
    "moving_object",
]
_WITHOUT_FIGURE = {"own_camera", "steepest_rise"}  # described in docs/live.md and docs/operations.md
_LONGEST = 300  # seconds


def uris() -> list[str]:
    """Return the names of the pages, the index first."""
    return ["gallery/index.md", *(f"gallery/{name}.md" for name in _ORDER)]


def pages() -> dict[str, str | bytes]:
    """Run all scripts, and return their pages and pictures by their names in the site.

    Raises
    ------
    mkdocs.exceptions.PluginError
        A script fails, or draws no picture.
    """
    scripts = [_FOLDER / f"{name}.py" for name in _ORDER]
    if {*_ORDER, *_WITHOUT_FIGURE} != {script.stem for script in _FOLDER.glob("*.py")}:
        raise PluginError("examples: the scripts differ from those that docs/site/gallery_pages.py lists")
    texts = [script.read_text(encoding="utf-8") for script in scripts]
    with ThreadPoolExecutor(2) as pool:  # much of the time is starting Python, on one core
        results = list(pool.map(_run, scripts, texts))
    firsts = [next(iter(drawn)) for _, drawn in results]
    contents: dict[str, str | bytes] = {"gallery/index.md": _index(texts, firsts)}
    for name, text, (printed, drawn) in zip(_ORDER, texts, results, strict=True):
        contents[f"gallery/{name}.md"] = _page(name, text, printed, list(drawn))
        contents |= {f"gallery/{picture}": content for picture, content in drawn.items()}
    return contents


@functools.cache
def _run(script: Path, text: str) -> tuple[str, dict[str, bytes]]:
    """Run a script as it is now; return what it prints, and its pictures in the order of drawing."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "MPLBACKEND": "agg"}
        process = subprocess.run(
            [sys.executable, "-P", str(script)],
            cwd=folder,
            env=environment,
            capture_output=True,
            text=True,
            timeout=_LONGEST,
        )
        pictures = sorted(Path(folder).glob("*.png"), key=lambda path: path.stat().st_mtime_ns)
        if process.returncode or not pictures:
            drawn = f"{len(pictures)} pictures"
            raise PluginError(
                f"{script} ended with status {process.returncode} and {drawn}:\n{process.stderr}"
            )
        return process.stdout, {f"{script.stem}-{path.name}": path.read_bytes() for path in pictures}


def _parts(text: str) -> tuple[str, str, str]:
    """Return a script's title, its words, and its code."""
    words = ast.get_docstring(ast.parse(text)) or ""
    title, _, rest = words.partition("\n")
    return title.rstrip("."), rest.strip(), text.partition('"""\n')[2].strip()


def _index(texts: list[str], pictures: list[str]) -> str:
    cards = []
    for name, text, picture in zip(_ORDER, texts, pictures, strict=True):
        title = _parts(text)[0]
        cards.append(f"- [![{title}]({picture})]({name}.md)\n\n    [{title}]({name}.md)")
    about = "The figures of the scripts in `examples/`, which run each time this site is built."
    listed = "\n\n".join(cards)
    return f"# Gallery\n\n{about}\n\n<div class='gallery' markdown>\n\n{listed}\n\n</div>\n"


def _page(name: str, text: str, printed: str, pictures: list[str]) -> str:
    title, words, code = _parts(text)
    drawn = "\n".join(f"![{_what(picture)}]({picture})" for picture in pictures)
    return (
        f"# {title}\n\n{words}\n\n<div class='drawn' markdown>\n\n{drawn}\n\n</div>\n\n"
        f"It prints:\n\n```text\n{printed}```\n\n`python examples/{name}.py`:\n\n```python\n{code}\n```\n"
    )


def _what(picture: str) -> str:
    """Return the subject of a picture in one word."""
    return Path(picture).stem.rpartition("-")[2]
