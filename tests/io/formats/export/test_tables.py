"""Tables, read by the standard library and NumPy."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from mirrorskin import io

COLUMNS = {
    "distance": np.array([0.0, 0.1, 0.1 + 0.2]),
    "height": np.array([-1.25, np.nan, 0.1], np.float32),
    "filled": np.array([False, False, True]),
}
UNITS = {"distance": "mm", "height": "mm", "filled": ""}
NOTES = {"source": "Münze, 五円.h5", "two": "lines\nare one"}


@pytest.fixture
def path(tmp_path):
    return tmp_path / "out.csv"


def test_a_table_is_notes_names_and_rows(path):
    io.save_table(path, COLUMNS, UNITS, NOTES)
    assert path.read_text(encoding="utf-8").split("\n") == [
        "# source: Münze, 五円.h5",
        "# two: lines are one",
        "distance [mm],height [mm],filled",
        "0,-1.25,0",
        "0.1,,0",
        "0.3,0.100000001,1",
        "",
    ]


def test_a_table_comes_back_in_full(path):
    rng = np.random.default_rng(1)
    height = rng.normal(size=200).astype(np.float32)
    height[::7] = np.nan
    distance = rng.normal(size=200)
    io.save_table(path, {"distance": distance, "height": height}, {"distance": "mm"}, NOTES)
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    assert list(rows[0]) == ["distance [mm]", "height"]
    actual = np.array([[float(cell or "nan") for cell in row.values()] for row in rows])
    np.testing.assert_array_equal(actual[:, 1].astype(np.float32), height)
    np.testing.assert_allclose(actual[:, 0], distance, rtol=1e-8)
    again = np.genfromtxt(path, delimiter=",", skip_header=3, encoding="utf-8")
    np.testing.assert_array_equal(again, actual)


def test_a_cross_section_of_a_result_has_its_units_and_origin(slope, path):
    description = io.export_result(slope, path, section=COLUMNS)
    assert description == "3 points of a cross-section"
    lines = path.read_text(encoding="utf-8").splitlines()
    assert lines[0] == "# source: Münze 五円.h5"
    assert "# heights: from the sheet at rest" in lines
    assert lines[-4] == "distance [mm],height [mm],filled"
