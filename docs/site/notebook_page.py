"""The page of the notebook, which runs while the site is built."""

from __future__ import annotations

import functools
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from mkdocs.exceptions import PluginError

_NOTEBOOK = Path(__file__).resolve().parents[1] / "notebook.ipynb"
_LONGEST = 300  # seconds


@functools.cache
def pages() -> dict[str, str | bytes]:
    """Run the notebook in an empty folder, and return its page and pictures by their names in the site.

    Raises
    ------
    mkdocs.exceptions.PluginError
        A cell fails.
    """
    # Commands are taken from this environment.
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / _NOTEBOOK.name).write_bytes(_NOTEBOOK.read_bytes())
        process = subprocess.run(
            [sys.executable, "-m", "nbconvert", "--execute", "--to", "markdown", _NOTEBOOK.name],
            cwd=folder,
            env={**os.environ, "PATH": path},
            capture_output=True,
            text=True,
            timeout=_LONGEST,
        )
        if process.returncode:
            raise PluginError(f"{_NOTEBOOK.name} ended with status {process.returncode}:\n{process.stderr}")
        text = (Path(folder) / "notebook.md").read_text(encoding="utf-8")
        pictures = sorted(Path(folder).glob("notebook_files/*"))
        images = {f"notebook_files/{picture.name}": picture.read_bytes() for picture in pictures}
    return {"notebook.md": text.replace("![png]", "![what the cell draws]"), **images}
