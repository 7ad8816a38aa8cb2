"""Files outside of the documentation folder, and the links to and from them.

Links in Markdown are relative to the repository, so that it can be read without this site. A file that a page
links to becomes a page as well: Markdown unchanged, code with syntax colouring.
"""

from __future__ import annotations

import functools
import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path, PurePosixPath

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"

_LINK = re.compile(r"\[((?:[^\[\]]|\[[^\[\]]*\])*)\]\(([^)\s#]+)(#[^)\s]*)?\)")
_LANGUAGES = {".py": "python", ".cl": "c", ".toml": "toml"}
_README = ROOT / "README.md", "readme.md"  # under its own name it would be the first page


@functools.cache
def roots() -> list[Path]:
    """Return the files of the repository that the navigation contains."""
    return [ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted(ROOT.glob("bench/results/**/*.md"))]


def uri_of(path: Path) -> str:
    """Return the address of a file of the repository in the site."""
    if path.is_relative_to(DOCS):
        return path.relative_to(DOCS).as_posix()
    if path == _README[0]:
        return _README[1]
    name = path.relative_to(ROOT).as_posix()
    return f"{name}.md" if path.suffix in _LANGUAGES else name


def path_of(uri: str) -> Path:
    """Return the file or folder of the repository that a page of the site stands for."""
    if uri == _README[1]:
        return _README[0]
    places = [DOCS / uri, ROOT / uri, ROOT / uri.removesuffix(".md")]
    return next((place for place in places if place.exists()), places[0])


def text_of(path: Path) -> str:
    """Return a file as Markdown."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".md":
        return text
    head = f"---\nsearch:\n  exclude: true\n---\n\n# {path.relative_to(ROOT).as_posix()}\n\n"
    return f"{head}~~~~~~~~ {_LANGUAGES[path.suffix]}\n{text}~~~~~~~~\n"


def reachable(pages: Iterable[Path]) -> list[Path]:
    """Return the files outside the documentation that pages link to, and those that these link to.

    Parameters
    ----------
    pages : iterable of Path
        Those outside the documentation are among what is returned.
    """
    reached: dict[Path, None] = {}
    waiting = list(pages)
    while waiting:
        page = waiting.pop()
        if page in reached or not page.is_file():
            continue
        reached[page] = None
        if page.suffix == ".md":
            waiting += [target for target in _targets(page) if _is_page(target)]
    return [page for page in reached if not page.is_relative_to(DOCS)]


def relink(markdown: str, uri: str) -> str:
    """Return a page with its links as they are in the site; what is no page there stays as text alone."""
    source = path_of(uri)

    def changed(match: re.Match[str]) -> str:
        words, target = match[1], _target(source, match[2])
        if target is None:
            return match[0]
        if not (_is_page(target) or target.is_relative_to(DOCS)):
            return words
        link = os.path.relpath(uri_of(target), PurePosixPath(uri).parent)
        return f"[{words}]({link}{match[3] or ''})"

    return _LINK.sub(changed, markdown)


def _targets(page: Path) -> Iterator[Path]:
    for _, link, _ in _LINK.findall(page.read_text(encoding="utf-8")):
        target = _target(page, link)
        if target is not None:
            yield target


def _target(page: Path, link: str) -> Path | None:
    """Return the file or folder that a link leads to; None where it is not of the repository."""
    target = Path(os.path.normpath(page.parent / link))
    if ":" in link or not target.exists() or not target.is_relative_to(ROOT):
        return None
    return target / "index.md" if target.is_dir() and target.is_relative_to(DOCS) else target


def _is_page(path: Path) -> bool:
    return path.suffix in {".md", *_LANGUAGES} and path.is_file()
