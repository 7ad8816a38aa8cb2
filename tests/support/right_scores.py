"""Required scores of the documentation's first commands: errors consistent with standard deviations."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from commands import run

from mirrorskin import io

STEP = 0.1  # mm from frame to frame
FUSED = 0.0012  # mm, as the README has it


def check_score(words: list[str], comment: str = "") -> None:
    """Run ``score RES.h5 --truth REC.h5`` as JSON, and compare its numbers with what they must be.

    A comment such as ``RMS error 0.025 mm, mean error -0.001 mm`` must state them to its last digit.
    """
    name = words[1]
    heights = json.loads(run(*words, "--json").out)["height"]
    for kind, stated, digits in re.findall(r"(RMS|mean) error (-?\d+\.(\d+)) mm", comment):
        measured = heights[kind.lower()]
        assert measured == pytest.approx(float(stated), abs=0.6 * 10.0 ** -len(digits)), (name, kind)
    result = io.open_result(name)
    assert np.nanmax(result.height) < 0.01, f"{name}: heights above the rest plane"  # a fill is a guess
    assert heights["coverage"] > 0.5
    if result.normals is not None:  # heights and normals, fused
        assert heights["rms"] < FUSED
        assert abs(heights["mean"]) < FUSED / 2
        return
    assert heights["rms"] < STEP / np.sqrt(12)
    assert abs(heights["mean"]) < STEP / 20
    assert 0.5 < heights["chi_square"] < 1.5
