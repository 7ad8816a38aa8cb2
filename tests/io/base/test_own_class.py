"""Classes that are named in commands and files: what can be imported meanwhile, and afterwards."""

import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from mirrorskin.io import InputError
from mirrorskin.io.base.own_class import load_class

CLASS = """
import {helper}

class Named:
    helper = {helper}
"""


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """The working folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def write(name, helper):
    """Write a module with a class, and a second module that it imports."""
    Path(name).parent.mkdir(exist_ok=True)
    Path(name).write_text(CLASS.format(helper=helper))
    Path(name).with_name(f"{helper}.py").write_text("")


@pytest.mark.parametrize("name", ["first_named:Named", "first_named.py:Named", "sub/first_named.py:Named"])
def test_what_can_be_imported_is_as_before(name):
    write(f"{name.partition(':')[0].removesuffix('.py')}.py", "first_helper")
    before = [*sys.path]
    assert load_class(name).__name__ == "Named"
    assert sys.path == before


def test_a_module_that_fails_leaves_what_can_be_imported_as_before():
    Path("failing.py").write_text("raise RuntimeError('at work')")
    before = [*sys.path]
    with pytest.raises(RuntimeError, match="at work"):
        load_class("failing:Named")
    assert sys.path == before


@pytest.mark.parametrize("name", ["second_named:Named", "second_named.py:Named"])
def test_installed_modules_come_before_those_of_the_folder(name, folder):
    write("second_named.py", "colorsys")
    assert Path(load_class(name).helper.__file__).parent != folder


def test_a_folder_that_could_be_imported_from_keeps_its_place(folder, monkeypatch):
    write("third_named.py", "third_helper")
    monkeypatch.syspath_prepend(folder)
    before = [*sys.path]
    load_class("third_named:Named")
    assert sys.path == before


def test_a_module_of_mirrorskin_adds_nothing(folder):
    with pytest.raises(InputError, match=r"there is no mirrorskin\.none"):
        load_class("mirrorskin.none:Named")
    assert str(folder) not in sys.path


WAITING = """
import sys

sys.modules["threads_of_a_test"].wait(60)
import {helper}

class Named:
    helper = {helper}
"""


def test_two_threads_import_from_two_folders(monkeypatch):
    """The first one to end leaves the folder of the other one in place."""
    both = threading.Barrier(2)
    monkeypatch.setitem(sys.modules, "threads_of_a_test", both)
    for name in ("left", "right"):
        Path(name).mkdir()
        write(f"{name}/{name}_named.py", f"{name}_helper")
        Path(name, f"{name}_named.py").write_text(WAITING.format(helper=f"{name}_helper"))
    before = [*sys.path]
    with ThreadPoolExecutor(2) as pool:
        names = [f"{name}/{name}_named.py:Named" for name in ("left", "right")]
        helpers = [kind.helper.__name__ for kind in pool.map(load_class, names)]
    assert helpers == ["left_helper", "right_helper"]
    assert sys.path == before
