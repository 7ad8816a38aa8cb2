"""``mirrorskin stitch`` on results in files."""

import numpy as np
import pytest
from commands import run
from moved_surfaces import bumpy, sampled

from mirrorskin import io


@pytest.fixture
def names(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    for number, shift in enumerate((0.0, -1.2)):
        io.save_result(sampled(bumpy, shift=(shift, 0.0, 0.0), rng=rng), f"touch-{number}.h5")
    return ["touch-0.h5", "touch-1.h5"]


def test_touches_become_a_result_that_is_wider(names):
    ended = run("stitch", *names, "-o", "whole.h5")
    assert (ended.code, ended.said) == (0, "")
    assert ended.out.startswith("whole.h5: height at ")
    whole = io.open_result("whole.h5")
    assert whole.height.shape[1] == pytest.approx(80 + 1.2 / 0.05, abs=4)
    assert whole.process["touch_1"] == "touch-1.h5"


def test_a_single_touch_is_refused_in_a_line(names):
    ended = run("stitch", names[0], "-o", "whole.h5")
    assert (ended.code, ended.said.count("\n")) == (2, 1)
    assert "two or more" in ended.said


def test_the_output_is_none_of_the_inputs(names):
    ended = run("stitch", *names, "-o", names[1])
    assert (ended.code, ended.said.count("\n")) == (2, 1)
