"""`mirrorskin reconstruct` on a press: holes are filled unless told not to, and that is said."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from commands import run
from stacks import ball, record

from mirrorskin import io

SHAPE = (44, 48)
MIDDLE = SHAPE[0] // 2, SHAPE[1] // 2


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    record(ball(SHAPE, 0.25, 0.1 * np.arange(1, 21)), Path("press.h5"))


def test_the_top_of_a_ball_is_filled_and_counted():
    ended = run("reconstruct", "press.h5")
    assert (ended.code, ended.said) == (0, "")
    result = io.open_result("press-result.h5")
    filled = np.count_nonzero(result.filled)
    assert filled > 20
    assert f" pixels ({filled} filled), " in ended.out
    assert result.filled[MIDDLE] == 1
    assert result.height[MIDDLE] == pytest.approx(0, abs=0.05)
    # What was measured is as it was, and the status tells of what was seen.
    assert run("reconstruct", "press.h5", "--no-fill", "-o", "open.h5").code == 0
    opened = io.open_result("open.h5")
    measured = result.filled == 0
    np.testing.assert_array_equal(result.height[measured], opened.height[measured])
    assert np.isnan(opened.height[~measured]).all()
    np.testing.assert_array_equal(result.status, opened.status)


def test_without_filling_nothing_is_said_of_it():
    ended = run("reconstruct", "press.h5", "--no-fill", "--json")
    assert np.isnan(io.open_result("press-result.h5").height[MIDDLE])
    assert not json.loads(ended.out)["summary"].get("filled")
    assert "filled" not in run("reconstruct", "press.h5", "--no-fill").out
