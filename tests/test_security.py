"""Promises of docs/security.md that no other test checks."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from commands import run
from traps import Trap

from mirrorskin import io

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "security.md").read_text(encoding="utf-8")
PROMISES = [line for line in PAGE.splitlines() if line.startswith("| ") and line != "| Promise | Test |"]
NAMED = re.findall(r"`(tests/[^`\s]+)::(\w+)`", PAGE)
PLACES = ("--motion", "vertical", "--travel-step", "0.1mm", "-o", "out.h5")
PRESS = ("simulate", "vertical", "--size", "8x8", "--frames", "2", "-o", "out.h5")
MARKUP = "<script>alert(1)</script>"


def test_every_promise_has_a_test():
    assert all("| `tests/" in line for line in PROMISES)
    assert len(PROMISES) >= 14
    assert all(f"def {test}(" in (ROOT / file).read_text(encoding="utf-8") for file, test in NAMED)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("frames.npy", ("import", "{}", *PLACES)),
        ("frames.npz", ("import", "{}", *PLACES)),
        ("travel.npy", ("reconstruct", "sound.npy", "-o", "out.h5", "--travel", "{}")),
        ("heights.npy", (*PRESS, "--object", "{}")),
    ],
)
def test_no_pickle_of_an_array_is_decoded(name, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.save("sound.npy", np.zeros((4, 8, 8), np.uint8))
    trap = np.array([Trap(tmp_path / "run")], dtype=object)
    np.savez(name, frames=trap) if name.endswith("z") else np.save(name, trap)
    ended = run(*(name if word == "{}" else word for word in words))
    assert (ended.code, ended.said.count("\n"), Path("run").exists()) == (2, 1, False)


def test_texts_are_not_markup_in_a_notebook():
    units = io.Map(MARKUP, MARKUP, "float32", "pixels")
    result = io.Result(
        height=np.zeros((8, 8), np.float32),
        own=np.zeros((8, 8), np.float32),
        process={"source": MARKUP},
        declarations={"own": units},
    )
    assert "<script" not in result._repr_html_()
