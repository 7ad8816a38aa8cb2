"""Parts of ``runtimes.py`` that need no other runtime."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import runtimes

from mirrorskin.kernels import embedded


@pytest.fixture
def columns():
    same = {"processor": "a processor", "threads": 2, "layout": "cores", "driver": "1.0"}
    return [
        {"runtime": "PoCL", "target": runtimes.THIS, "ms": {"integrate": 1.2345, "fuse": 100.0}, **same},
        {"runtime": "PoCL", "target": "znver3", "ms": {"integrate": 2.0, "fuse": 90.0}, **same},
    ]


def test_a_page_has_a_row_for_each_call_and_a_column_for_each_runtime(columns):
    page = runtimes.page(columns)
    assert "on a processor with 2 threads" in page.replace("\n", " ")
    assert "| call | PoCL 1.0; this processor; cores | PoCL 1.0; znver3; cores |" in page
    assert "| integrate | 1.23 | 2 |" in page


def test_numbers_and_page_are_written(monkeypatch, tmp_path, capsys, columns):
    monkeypatch.setattr(runtimes, "measure", lambda *_: iter(columns))
    assert runtimes.main(["--output", str(tmp_path / "table.json")]) == 0
    assert json.loads((tmp_path / "table.json").read_text()) == columns
    assert (tmp_path / "table.md").read_text() == runtimes.page(columns)
    assert capsys.readouterr().out.startswith(runtimes.page(columns))


COMPILED = """
import runtimes
runtimes.compile_for("nehalem")
from mirrorskin.kernels.device import open_device
print(open_device("Portable").info.note)
"""


def test_the_wheels_pocl_compiles_for_the_processor_that_is_named():
    if embedded.find_library() is None:
        pytest.skip("there is no wheel of PoCL")
    paths = os.pathsep.join([str(Path(runtimes.__file__).parent), *sys.path])
    ran = subprocess.run(
        [sys.executable, "-c", COMPILED],
        env=os.environ | {"PYTHONPATH": paths},
        capture_output=True,
        text=True,
    )
    assert "compiles for nehalem" in ran.stdout, ran.stderr
