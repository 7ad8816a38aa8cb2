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
    "Reconstruct recordings, run operations": {
        "engine": "`reconstruct`, `run`, `fuse`, `measure`; base classes and the most used operations",
        "engine.live": "the same operations while the body moves",
    },
    "Single computations": {
        "engine.press": "heights from a press or a release",
        "engine.rotation": "normals, contact and edges from a rotation",
        "engine.slip": "displacement and slip of the skin",
        "engine.integration": "heights from slopes or normals",
        "engine.pose": "motion of an object between results; stitching of results",
        "engine.force": "pressure, traction and forces from heights or displacements",
        "engine.metrology": "planes, spheres, sections, steps, texture and profiles, with uncertainties",
        "engine.correlation": "correlation with the movement",
        "engine.vibration": "frequency of a vibration, and growth of the contact",
        "engine.optical": "heights from focus, phases of fringes, normals from several lamps",
    },
    "Calibration": {"engine.calibration": "references, lens, zenith, tilt, gel and modulus of a sensor"},
    "Files, pictures, hardware": {
        "io": "shared types; recordings, results, calibrations, frames of other programs, exports",
        "view": "figures of results compared with the truth",
        "view.result": "figures of one result",
        "view.report": "a result as one page for a browser",
        "hw": "stage, camera, and both as a rig",
        "twin": "the digital twin: objects, body, camera, movements",
        "kernels.device": "OpenCL devices, their arrays and kernels",
    },
}
"""Documented packages by task, each with its contents."""


def on_config(config: MkDocsConfig) -> None:
    """Replace names of folders in the navigation by their pages."""
    config.nav = _expanded(config.nav)


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Add generated pages, and those outside the folder of the documentation."""
    generated: dict[str, str | bytes] = {**command_pages.pages(), **gallery_pages.pages(), **_api_pages()}
    generated |= notebook_page.pages()
    generated["decisions/index.md"] = _index_of_decisions()
    for uri, content in generated.items():
        files.append(File.generated(config, uri, content=content))
    pages = [
        repository.path_of(file.src_uri) for file in files.documentation_pages() if not file.generated_by
    ]
    for path in repository.reachable([*pages, *repository.roots()]):
        uri, text = repository.uri_of(path), repository.text_of(path)
        inclusion = InclusionLevel.UNDEFINED if path in repository.roots() else InclusionLevel.NOT_IN_NAV
        files.append(File.generated(config, uri, content=text, inclusion=inclusion))


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Replace links between files of the repository by links between pages."""
    return repository.relink(markdown, page.file.src_uri)


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Convert formulas to MathML."""
    return mathml.with_formulas(html, page.file.src_uri)


def on_post_page(output: str, page: Page, config: MkDocsConfig) -> str:
    """Raise PluginError if a page loads anything from another address."""
    external = _FROM_ELSEWHERE.search(output)
    if external:
        raise PluginError(f"{page.file.src_uri} loads a file from another address: {external[0]}")
    return output


@functools.cache
def _api_pages() -> dict[str, str]:
    """Return the pages from which mkdocstrings makes the Python reference."""
    index = "# Python\n\nMost programs need `engine` and `io` only.\n"
    pages: dict[str, str] = {}
    for task, packages in _PACKAGES.items():
        rows = "".join(f"| [`mirrorskin.{name}`]({name}.md) | {what} |\n" for name, what in packages.items())
        index += f"\n## {task}\n\n| package | contents |\n|---|---|\n{rows}"
        pages |= {f"api/{name}.md": _api_page(f"mirrorskin.{name}") for name in packages}
    return {"api/index.md": index, **pages}


def _api_page(package: str) -> str:
    """Return the page of a package; members with the name of their module are requested explicitly."""
    module = importlib.import_module(package)
    named = [getattr(module, name) for name in getattr(module, "__all__", []) if _is_module(package, name)]
    members = [member for member in named if not isinstance(member, ModuleType)]
    sections = "".join(f"\n::: {member.__module__}.{member.__name__}\n{_AS_MEMBER}" for member in members)
    return f"# {package}\n\n::: {package}\n{sections}"


def _is_module(package: str, name: str) -> bool:
    return importlib.util.find_spec(f"{package}.{name}") is not None


def _index_of_decisions() -> str:
    folder = repository.path_of("decisions")
    titles = {
        path: path.read_text(encoding="utf-8").partition("\n")[0] for path in sorted(folder.glob("*.md"))
    }
    entries = "".join(f"- [{title.removeprefix('# ')}]({path.name})\n" for path, title in titles.items())
    return f"# Decisions\n\nReasons for the design, one decision per page.\n\n{entries}"


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
