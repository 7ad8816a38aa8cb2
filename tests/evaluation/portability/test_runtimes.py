"""Parts of ``runtimes.py`` that need no other runtime."""

import json

import pytest

from mirrorskin.evaluation.portability import runtimes


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
