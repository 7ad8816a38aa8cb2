"""The page of accuracy has the stored results, and the bounds of a device are compared with its results."""

import numpy as np
import pytest

from mirrorskin.cli.commands.bench.records import Case, Target, describe_run
from mirrorskin.evaluation import accuracy, bounds
from mirrorskin.kernels.device import open_device


def test_page_has_the_stored_results():
    page = accuracy.PAGE.read_text(encoding="utf-8")
    assert accuracy.with_tables(page) == page, "write it: make accuracy"


@pytest.mark.parametrize(
    "name", ["accuracy-surfaces", *(pytest.param(n, marks=pytest.mark.slow) for n in bounds.CASES)]
)
def test_device_meets_all_bounds(name):
    device = open_device()
    assert bounds.missed(describe_run(device, [bounds.CASES[name](device, True)], quick=True)) == []


def test_missed_bounds_are_named():
    targets = Target("height", "at most 1", "3", False), Target("sigma", "at most 2", "1", True)
    run = describe_run(open_device(), [Case("press", "", targets=targets)], quick=True)
    assert bounds.missed(run) == ["press, height: 3, must be at most 1"]


def test_stored_errors_of_normals_are_those_of_this_version():
    table, measured = accuracy.stored("normals"), accuracy.measure_normals()
    assert (table.head, [row[0] for row in table.rows]) == (measured.head, [row[0] for row in measured.rows])
    for row, other in zip(table.rows, measured.rows, strict=True):
        np.testing.assert_allclose(np.array(row[1:], float), np.array(other[1:], float), rtol=0.01)
