"""Hooks that mkdocs calls while it builds the site from the Markdown files (mkdocs.yml).

They add pages from other folders of the repository, and generated ones: commands, Python, the gallery, the
notebook.
"""

from __future__ import annotations

import functools
import importlib.util
import re
from collections.abc import Callable, Iterable
from types import ModuleType
from typing import Any

import command_pages
import gallery_pages
import mathml
import notebook_page
import repository
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page

_FROM_ELSEWHERE = re.compile(r"<(script|link|img|iframe|source)\b[^>]*\b(src|href)=[\"']?(https?:)?//[^>]*>")
_AS_MEMBER = """\
    options:
      show_root_heading: true
      show_root_full_path: false
      show_root_toc_entry: true
"""
_PACKAGES = {
    "engine": "The estimators: from frames to maps, and from maps to numbers.",
    "engine.live": "The same while the body moves.",
    "io": "Shared types, recordings, results, frames of other programs, exports.",
    "hw": "Stage, camera, rig.",
    "hw.twin": "The digital twin: objects, body, camera, movements.",
    "view": "Figures of results compared with the truth.",
    "view.result": "Figures of one result.",
    "view.report": "A result as one page for a browser.",
    "kernels.device": "The OpenCL devices, and what runs on them.",
}


def on_config(config: MkDocsConfig) -> None:
    """Put pages into the navigation where a folder's name stands."""
    config.nav = _expanded(config.nav)


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Add the pages that do not lie in the folder of the documentation."""
    made: dict[str, str | bytes] = {**command_pages.pages(), **gallery_pages.pages(), **_api_pages()}
    made |= notebook_page.pages()
    made["decisions/index.md"] = _index_of_decisions()
    for uri, content in made.items():
        files.append(File.generated(config, uri, content=content))
    pages = [
        repository.path_of(file.src_uri) for file in files.documentation_pages() if not file.generated_by
    ]
    for path in repository.reachable([*pages, *repository.roots()]):
        uri, text = repository.uri_of(path), repository.text_of(path)
        inclusion = InclusionLevel.UNDEFINED if path in repository.roots() else InclusionLevel.NOT_IN_NAV
        files.append(File.generated(config, uri, content=text, inclusion=inclusion))


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Let links lead to where the pages lie in the site."""
    return repository.relink(markdown, page.file.src_uri)


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Make MathML of formulas."""
    return mathml.with_formulas(html, page.file.src_uri)


def on_post_page(output: str, page: Page, config: MkDocsConfig) -> str:
    """Refuse a page that would ask for something from elsewhere when it is read."""
    asked = _FROM_ELSEWHERE.search(output)
    if asked:
        raise PluginError(f"{page.file.src_uri} asks for something from elsewhere: {asked[0]}")
    return output


@functools.cache
def _api_pages() -> dict[str, str]:
    """Return the pages from which mkdocstrings makes the Python reference."""
    rows = "".join(f"| [`mirrorskin.{name}`]({name}.md) | {what} |\n" for name, what in _PACKAGES.items())
    index = f"# Python\n\nThe contents of each package.\n\n| package | contents |\n|---|---|\n{rows}"
    pages = {f"api/{name}.md": _api_page(f"mirrorskin.{name}") for name in _PACKAGES}
    return {"api/index.md": index, **pages}


def _api_page(package: str) -> str:
    """Return the page of a package; members with the name of their module are requested explicitly."""
    found = importlib.import_module(package)
    named = [getattr(found, name) for name in getattr(found, "__all__", []) if _is_module(package, name)]
    members = [one for one in named if not isinstance(one, ModuleType)]
    asked = "".join(f"\n::: {one.__module__}.{one.__name__}\n{_AS_MEMBER}" for one in members)
    return f"# {package}\n\n::: {package}\n{asked}"


def _is_module(package: str, name: str) -> bool:
    return importlib.util.find_spec(f"{package}.{name}") is not None


def _index_of_decisions() -> str:
    folder = repository.path_of("decisions")
    titles = {
        path: path.read_text(encoding="utf-8").partition("\n")[0] for path in sorted(folder.glob("*.md"))
    }
    told = "".join(f"- [{title.removeprefix('# ')}]({path.name})\n" for path, title in titles.items())
    return f"# Decisions\n\nWhy things are as they are.\n\n{told}"


def _expanded(entry: Any) -> Any:
    if isinstance(entry, list):
        return [_expanded(item) for item in entry]
    if isinstance(entry, dict):
        return {title: _expanded(item) for title, item in entry.items()}
    return _pages_in(entry) if entry.endswith("/") else entry


def _pages_in(folder: str) -> list[str]:
    """Return the pages of a folder of the site, its index first."""
    generated: dict[str, Callable[[], Iterable[str]]] = {
        "commands/": command_pages.uris,
        "gallery/": gallery_pages.uris,
        "api/": _api_pages,
    }
    if folder in generated:
        return list(generated[folder]())
    paths = sorted(repository.path_of(folder).glob("*.md"), key=lambda path: (path.stem != "index", path))
    index = [] if folder != "decisions/" else ["decisions/index.md"]
    return index + [repository.uri_of(path) for path in paths]
