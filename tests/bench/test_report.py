"""What a case tells as data and tables, whatever it has: no works, no limit, aims alone."""

import json

import numpy as np
import pytest

from mirrorskin.bench.harness import Measured, Timing
from mirrorskin.bench.report import TARGET_HEAD, as_data, as_markdown, as_notes, as_rows, as_targets
from mirrorskin.bench.results import Case, Row, Target
from mirrorskin.kernels.device import open_device

SECOND = Timing(1.0, 0.9, 1.1, 3)
AIMS = (Target("height", "at most 0.1 um", "0.05 um", True), Target("sigma", "0.9 to 1.1", "nan", np.False_))


def measured(**device):
    return Measured(SECOND, device, dict.fromkeys(device, 1.0), 2.0, 0.5)


def told(*cases):
    return as_data(open_device(), cases, quick=False)


def test_a_case_of_aims_alone_is_told():
    data = told(Case("accuracy", "near the truth", [], {}, ("a note",), AIMS))
    (case,) = data["cases"]
    assert json.loads(json.dumps(case, allow_nan=False)) == case
    assert as_rows(case) == []
    assert as_notes(case) == ["a note"]
    assert as_targets(case) == [
        ["height", "at most 0.1 um", "0.05 um", "yes"],
        ["sigma", "0.9 to 1.1", "nan", "no"],
    ]
    page = as_markdown(data)
    assert f"| {' | '.join(TARGET_HEAD)} |" in page
    assert "| height | at most 0.1 um | 0.05 um | yes |" in page
    assert "| work |" not in page


def test_a_case_without_a_limit_has_no_shares():
    rows = [Row("mirrorskin", measured(kernel=SECOND), 0), Row("other", measured(), 100)]
    case = Case("plain", "no limit", rows, {})
    assert np.isnan(case.share(rows[1]))
    (data,) = told(case)["cases"]
    assert [row["share"] for row in data["rows"]] == [None, None]
    assert [cells[-2:] for cells in as_rows(data)] == [["", ""], ["", ""]]


def test_a_kernel_that_took_no_time_in_most_turns_has_no_bandwidth():
    row = Row("mirrorskin", measured(kernel=Timing(0.0, 0.0, 0.1, 3)), 100)
    assert np.isnan(row.kernel_bandwidth)
    (data,) = told(Case("plain", "title", [row], {}))["cases"]
    assert data["rows"][0]["kernel_share"] is None


def test_rows_and_aims_of_a_case_are_told_together():
    rows = [Row("read limit", measured(kernel=SECOND), 100), Row("mirrorskin", measured(kernel=SECOND), 50)]
    (data,) = told(Case("both", "title", rows, {"torch": "not installed"}, (), AIMS))["cases"]
    assert data["rows"][1]["share"] == pytest.approx(0.5)
    assert data["targets"][1] == {"what": "sigma", "bound": "0.9 to 1.1", "measured": "nan", "met": False}
    assert as_notes(data) == [
        "first call: mirrorskin 2.00 s; 1.00 s in all went into building OpenCL kernels",
        "torch: not installed",
    ]
