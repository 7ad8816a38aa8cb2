"""`mirrorskin report`: place of its page, and refusals."""

from __future__ import annotations

import numpy as np
import pytest
from commands import refused, run

from mirrorskin import io
from mirrorskin.view.report import contents


@pytest.fixture
def folder(tmp_path):
    """A folder with a result that slopes to the right, worked in."""
    x, y = io.pixel_axes((9, 12), (0.1, 0.1))
    height = np.broadcast_to(np.float32(0.2) * x.astype(np.float32), (9, 12)).copy()
    io.save_result(io.Result(height=height, x=x, y=y, process={"source": "press.h5"}), tmp_path / "res.h5")
    io.save_result(io.Result(height=height), tmp_path / "no-size.h5")
    return tmp_path


def test_a_page_is_next_to_its_result_unless_a_place_is_given(folder, monkeypatch):
    monkeypatch.setattr(contents, "pictures_of", lambda *_: [])  # which take longest
    ended = run("report res.h5 --section=-0.3mm,0mm:0.3mm,0mm")
    assert (ended.code, ended.said) == (0, "")
    assert ended.out.startswith("res-report.html: ")
    assert ended.out.count("\n") == 1
    page = (folder / "res-report.html").read_text(encoding="utf-8")
    assert "<title>res.h5</title>" in page
    assert "section length" in page
    assert run("report res.h5 -o other.html").code == 0
    assert "section length" not in (folder / "other.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("res.h5 -o res.h5", "is the input"),
        ("nothing.h5", "nothing.h5"),
        ("res.h5 -o nowhere/page.html", "no folder nowhere"),
        ("res.h5 --turn 0", "leave --turn out"),
        ("res.h5 --section 1,2", "--section"),
        ("no-size.h5 --section 0mm,0mm:1mm,0mm", "--pixel-size"),
    ],
)
def test_what_cannot_be_done_is_one_line_and_leaves_nothing(folder, words, message):
    refused(message, f"report {words}")
    assert {path.name for path in folder.iterdir()} == {"res.h5", "no-size.h5"}
