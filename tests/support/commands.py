"""The command line, run in this process, which is quick, and the paper's experiments at a small size."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import os
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple
from unittest import mock

from mirrorskin.cli.commands import demo
from mirrorskin.cli.main import main
from mirrorskin.io import MirrorskinWarning

# Pixels across and down of what is small; the press and the rotation on the sphere are fused.
_SIZE, _SPHERE = 24, 48


class Ended(NamedTuple):
    """How a command ended: its exit code, and what it wrote to standard output and standard error."""

    code: int
    out: str
    said: str


def run(line: object, *words: object) -> Ended:
    """Run the command line with the words of a line and further words, in the working directory."""
    out, errors = io.StringIO(), io.StringIO()
    arguments = mock.patch.object(sys, "argv", ["mirrorskin", *str(line).split(), *map(str, words)])
    with (
        arguments,
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(errors),
        warnings.catch_warnings(action="always", category=MirrorskinWarning),  # printed, as for a user
    ):
        try:
            main()
        except SystemExit as ended:
            code = ended.code or 0
    return Ended(code, out.getvalue(), errors.getvalue())


def done(line: object, *words: object) -> Ended:
    """Run the command line, which must succeed."""
    ended = run(line, *words)
    assert ended.code == 0, ended.said
    return ended


_LOADED = """
import contextlib, io, json, sys
from mirrorskin.cli.main import main
sys.argv = ["mirrorskin", *sys.argv[1:]]
with contextlib.redirect_stdout(io.TextIOWrapper(io.BytesIO())), contextlib.suppress(SystemExit):
    main()
print(json.dumps(list(sys.modules)))
"""


def loaded(*words: str, **variables: str) -> set[str]:
    """Return which modules a command imports, in a separate process with these environment variables."""
    command, environment = [sys.executable, "-c", _LOADED, *words], {**os.environ, **variables}
    process = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    return set(json.loads(process.stdout))


def refused(message: str, *words: object, run: Callable[..., Ended] = run, code: int = 2) -> str:
    """Run the command line, which must refuse in one line that says so and write nothing; return the line."""
    before = _files()
    ended = run(*words)
    assert (ended.code, ended.out) == (code, ""), ended
    assert message in ended.said
    assert ended.said.startswith("mirrorskin: ")
    assert ended.said.count("\n") == 1
    assert _files() == before
    return ended.said.removeprefix("mirrorskin: ").rstrip("\n")


def _files() -> dict[Path, tuple[int, int]]:
    """Return size and time of each file below the working directory, which must not be the repository.

    Compiled modules, which Python writes when a command imports the user's, are left out.
    """
    assert not Path("pyproject.toml").exists(), "work in a temporary folder"
    paths = (path for path in Path().rglob("*") if "__pycache__" not in path.parts)
    states = {path: path.lstat() for path in paths if not path.is_dir()}
    return {path: (stat.st_size, stat.st_mtime_ns) for path, stat in states.items()}


def small_presses() -> dict[str, demo.Press]:
    """Return the demo's presses over the same fields and travels, with few pixels and frames."""
    fewer = {"fig5": f"--size {_SPHERE}x{_SPHERE} --pixel-size 0.25mm --travel-step 0.375mm"}
    fewer["fig6"] = f"--size {_SIZE}x{_SIZE} --pixel-size {0.041 * 640 / _SIZE}mm --travel-step 0.225mm"
    return {
        name: dataclasses.replace(press, line=f"{press.line} {fewer[name]} --frames 8")
        for name, press in demo.PRESSES.items()
    }


def small_turn() -> str:
    """Return the demo's rotation over the same field, with few pixels."""
    return f"{demo.TURN} --size {_SPHERE}x{_SPHERE} --pixel-size 0.25mm"
