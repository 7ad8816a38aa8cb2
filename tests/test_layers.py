"""The import rules of the layers (pyproject.toml, importlinter) hold."""

import importlib.metadata
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


def test_imports_follow_the_layers():
    # In a process of its own: within this one it would disable the loggers of all tests that follow.
    command = Path(sys.executable).with_name("lint-imports"), "--no-cache"
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Contracts: 2 kept, 0 broken" in done.stdout


def test_every_folder_is_under_the_rule():
    packages = {path.parent.name for path in ROOT.glob("*/__init__.py")}
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    layers = settings["tool"]["importlinter"]["contracts"][0]["layers"]
    assert packages == {name.removeprefix("mirrorskin.") for layer in layers for name in layer.split(" | ")}


def test_the_package_imports_no_development_tool():
    packages = [path.parent for path in ROOT.glob("*/__init__.py")]
    tools = re.compile(r"^\s*(from|import) (bench|suite|examples|tests)\b", re.MULTILINE)
    files = [file for package in packages for file in package.rglob("*.py")]
    assert [file for file in files if tools.search(file.read_text(encoding="utf-8"))] == []


def test_the_package_has_its_parts_and_its_version():
    import mirrorskin

    assert mirrorskin.__version__ == importlib.metadata.version("mirrorskin")
    assert callable(mirrorskin.engine.reconstruct)
    assert {"engine", "hw", "io", "twin", "view"} <= set(dir(mirrorskin))
    with pytest.raises(AttributeError, match="nothing"):
        _ = mirrorskin.nothing
