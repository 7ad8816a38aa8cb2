"""Runs as tables and as a page; the page of the committed runs is the one in the docs."""

import json
from pathlib import Path

import numpy as np
import pytest
from bench_runs import case, row, run, target

from mirrorskin.bench.harness import Case, Measured, Row, Target, Timing
from mirrorskin.bench.report import as_markdown, as_page, as_rows, as_sweep, as_targets, write_page
from mirrorskin.bench.run import as_data, open_run
from mirrorskin.io import InputError
from mirrorskin.kernels.device import open_device

ROOT = Path(__file__).parents[2]
COMMITTED = sorted((ROOT / "bench" / "results").glob("*.json"))
LIMIT = row("read limit", 0.1, moved=10**9, kernel=0.08, share=1.0)
OURS = row("mirrorskin", 0.2, moved=10**9, kernel=0.2, share=0.5)
FIRST = row("mirrorskin, first call", 0.25, kernel=0.2)
SECOND = Timing(1.0, 0.9, 1.1, 3)


def page_of(*runs):
    return as_page({Path(f"run{n}.json"): one for n, one in enumerate(runs)}, pictured=False)


def test_the_page_in_the_docs_is_that_of_the_committed_runs():
    page = as_page({path: open_run(path) for path in COMMITTED}, pictured=True)
    made = "make it with: mirrorskin bench report bench/results/*.json -o docs/benchmarks.md"
    assert (ROOT / "docs" / "benchmarks.md").read_text(encoding="utf-8") == page, made


def test_each_run_has_its_tables_beside_it():
    for path in COMMITTED:
        assert path.with_suffix(".md").read_text(encoding="utf-8").count("\n## ") == 1 + len(
            open_run(path)["cases"]
        )


def test_cases_become_json_and_tables_whatever_they_have():
    aims = (
        Target("height", "at most 0.1 um", "0.05 um", True),
        Target("sigma", "0.9 to 1.1", "nan", np.False_),
    )
    measured = Measured(SECOND, {"kernel": Timing(0.0, 0.0, 0.1, 3)}, {"scan": 1.0}, {"scan": 8.0}, 2.0, 0.5)
    rows = [Row("mirrorskin", measured, 0), Row("other", measured, 100)]
    cases = [Case("accuracy", "near", [], {}, ("a note",), aims), Case("plain", "no limit", rows, {})]
    data = as_data(open_device(), cases, quick=False)
    assert json.loads(json.dumps(data, allow_nan=False)) == data
    near, plain = data["cases"]
    assert as_targets(near)[1] == ["sigma", "0.9 to 1.1", "nan", "no"]
    assert [one["kernel_share"] for one in plain["rows"]] == [None, None]
    assert [cells[-2:] for cells in as_rows(plain)] == [["", ""], ["", ""]]
    page = as_markdown(data)
    assert "| height | at most 0.1 um | 0.05 um | yes |" in page
    assert "first call: mirrorskin 2.00 s, other 2.00 s; 1.00 s in all went into building" in page


def test_a_page_has_runs_aims_calls_and_the_quickest_peer():
    slow, quick = row("NumPy, slow", 0.9), row("Numba, quick", 0.1)
    works = row("mirrorskin, quick", 0.2, moved=10**9, kernel=0.1, share=0.5), slow, quick
    aims = target("whole path", True), target("memory | peak", False, "12 MB")
    found = page_of(
        run(
            case("press", LIMIT, OURS, targets=aims),
            case("call-edges", LIMIT, OURS, FIRST, row("Numba", 0.3)),
        ),
        run(case("turn", LIMIT, *works), case("accuracy-all", targets=aims), quick=True),
    )
    assert (
        "run1.json: 2026-11-21, mirrorskin 0123456789ab; made with `--quick`: the times mean nothing" in found
    )
    assert "| press | whole path | at most 1.25 times | 1.3 times | yes |" in found
    assert r"| press | memory \| peak | at most 1.25 times | 12 MB | no |" in found
    assert "| all about call-edges | 100.0 | 200.0 | 200.0 | 250.0 | Numba 300.0 |" in found
    assert "| turn | mirrorskin, quick | 200.0 | 5.00 | 50 % | Numba | 100.0 | 0.5 |" in found
    assert "| accuracy-all | all about accuracy-all | 1 of 2 | memory \\| peak: 12 MB |" in found
    assert "![" not in found


def test_without_aims_or_sweeps_a_page_has_no_such_part():
    found = page_of(run(case("press", LIMIT, OURS)))
    assert "## Kernels" in found
    assert not any(f"## {title}" in found for title in ("Aims", "Sizes", "Accuracy", "Calls"))


def test_a_sweep_is_a_table_of_sizes():
    works = [row(f"scan, {size}", 0.5, moved=10**9, share=0.25) for size in ("VGA", "1080p")]
    labels, lines = as_sweep(case("sweep-onset", LIMIT, *works, row("other, VGA", 1.0, moved=10**7)))
    assert labels == ("VGA", "1080p")
    assert lines == [
        ["sweep-onset", "scan", "2.0 (25 %)", "2.0 (25 %)"],
        ["sweep-onset", "other", "0.01", ""],
    ]
    assert as_sweep(case("press", *works)) == ((), [])


def test_a_page_that_cannot_be_written_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"page\.md: there is no folder"):
        write_page({Path("a.json"): run(case("press", LIMIT, OURS))}, tmp_path / "none" / "page.md")
