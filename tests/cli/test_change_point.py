"""``mirrorskin reconstruct --method change-point``, as a user runs it."""

import json

import h5py
import numpy as np
import pytest
from commands import done, refused

from mirrorskin import io

FRAMES = np.full((20, 5, 7), 20, np.uint8)
FRAMES[8:, :, 1:] = 200


@pytest.fixture
def folder(tmp_path):
    with h5py.File(tmp_path / "press.h5", "w") as file:
        file["frames"] = FRAMES
    return tmp_path


GIVEN = [
    "reconstruct",
    "press.h5",
    "--motion",
    "vertical",
    "--travel-step",
    "0.1mm",
    "--method",
    "change-point",
]


@pytest.mark.parametrize("levels", [["--dark", 20, "--bright", 200], ["--dark", 20], []])
def test_the_method_reaches_the_engine(folder, levels):
    report = json.loads(done(*GIVEN, *levels, "--json").out)
    assert report["process"]["method"] == "change-point"
    kernels = {record["name"] for record in report["profile"]}
    passes = {"changepoint_scan"} if len(levels) == 4 else {"changepoint_sum", "changepoint_split"}
    assert kernels >= passes | {"changepoint_heights"}
    height = io.open_result(folder / "press-result.h5").height
    np.testing.assert_allclose(height[:, 1:], -0.75, atol=1e-3)
    assert np.all(np.isnan(height[:, 0]))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--no-subframe"], "needs method 'threshold'"),
        (["--hold", "13"], "hold 13"),
        (["--threshold", "1"], "threshold 1.0: a change-point needs a share between 0 and 1"),
        (["--method", "guess"], "guess"),
    ],
)
def test_impossible_input_is_refused_in_one_line(folder, words, message):
    refused(message, *GIVEN, *words)
    assert not (folder / "press-result.h5").exists()
