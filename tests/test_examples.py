"""The examples in docstrings run, and print what they say; those of the folder of examples run."""

import doctest
import importlib
import inspect
import runpy
from pathlib import Path

import pytest

from mirrorskin import engine, io

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = "kernels", "io", "engine", "hw", "view"
FILES = [
    file for name in FOLDERS for file in sorted((ROOT / name).rglob("*.py")) if ">>> " in file.read_text()
]
MODULES = [".".join(("mirrorskin", *file.relative_to(ROOT).with_suffix("").parts)) for file in FILES]


@pytest.mark.parametrize("name", [name.removesuffix(".__init__") for name in MODULES])
def test_examples_run(name, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    told = []
    runner = doctest.DocTestRunner(verbose=False)
    for example in doctest.DocTestFinder(exclude_empty=True).find(importlib.import_module(name)):
        runner.run(example, out=told.append)
    assert runner.summarize(verbose=False).failed == 0, "".join(told)


@pytest.mark.parametrize("package", [engine, io], ids=["engine", "io"])
def test_every_public_function_has_an_example(package):
    functions = {name: getattr(package, name) for name in package.__all__}
    lacking = [name for name, it in functions.items() if inspect.isfunction(it) and ">>> " not in it.__doc__]
    assert lacking == []


@pytest.mark.parametrize("file", sorted((ROOT / "examples").glob("*.py")), ids=lambda file: file.stem)
def test_a_script_of_the_examples_runs_and_says_what_it_found(file, monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(file), run_name="__main__")
    assert "median error 0.0" in capsys.readouterr().out
