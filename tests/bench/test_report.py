"""Runs as tables and as a page; the page in the documentation is that of the committed runs."""

from pathlib import Path

from bench_runs import case, row, run, target

from mirrorskin.bench.suite import glance
from mirrorskin.bench.suite.report import as_chart, as_markdown, as_page, as_rows, as_targets
from mirrorskin.cli.commands.bench.records import Case, Row, Target, Timing, describe_run, open_run
from mirrorskin.kernels.device import open_device

ROOT = Path(__file__).parents[2]
COMMITTED = sorted((ROOT / "bench" / "results").glob("*.json"))
LIMIT = row("read limit", 0.1, moved=10**9, kernel=0.08)
OURS = row("mirrorskin", 0.2, moved=10**9, kernel=0.2)
FIRST = row("mirrorskin, first call", 0.25, kernel=0.2)


def page_of(*runs):
    return as_page({Path(f"run{n}.json"): shown for n, shown in enumerate(runs)}, "chart.svg")


def test_the_page_in_the_docs_is_that_of_the_committed_runs():
    page = as_page({path: open_run(path) for path in COMMITTED}, "images/benchmarks.svg")
    command = (
        "make it with: python bench/run.py report bench/results/*.json -o docs/benchmarks.md"
        " --chart docs/images/benchmarks.svg"
    )
    assert (ROOT / "docs" / "benchmarks.md").read_text(encoding="utf-8") == page, command


def test_each_run_has_its_tables_next_to_it():
    for path in COMMITTED:
        assert path.with_suffix(".md").read_text(encoding="utf-8").count("\n## ") == 1 + len(
            open_run(path).cases
        )


def test_cases_become_json_and_tables(tmp_path):
    aims = (
        Target("height", "at most 0.1 um", "0.05 um", True),
        Target("sigma", "0.9 to 1.1", "nan", False),
    )
    options = {
        "wall": Timing(1.0, 0.9, 1.1, 3),
        "device": {"kernel": Timing(0.0, 0.0, 0.1, 3)},
        "kernels": {"scan": 1.0},
        "moved": {"scan": 8.0},
        "first": 2.0,
        "compile": 0.5,
    }
    rows = [Row(name="mirrorskin", **options), Row(name="other", bytes=100, **options)]
    cases = [Case("accuracy", "near", [], {}, ("a note",), aims), Case("plain", "no limit", rows)]
    described = describe_run(open_device(), cases, quick=False)
    path = tmp_path / "run.json"
    path.write_bytes(described.as_json())
    assert open_run(path) == described
    near, plain = described.cases
    assert as_targets(near)[1] == ["sigma", "0.9 to 1.1", "nan", "no"]
    assert [cells[-2:] for cells in as_rows(plain)] == [["", ""], ["", ""]]
    page = as_markdown(described)
    assert "| height | at most 0.1 um | 0.05 um | yes |" in page
    assert "first call: mirrorskin 2.00 s, other 2.00 s; 1.00 s in total for building" in page


def test_a_page_has_runs_targets_calls_and_the_fastest_peer():
    slow, quick = row("NumPy, slow", 0.9), row("Numba, quick", 0.1)
    works = row("mirrorskin, quick", 0.2, moved=10**9, kernel=0.1), slow, quick
    aims = target("whole path", True), target("memory | peak", False, "12 MB")
    page = page_of(
        run(
            case("press", LIMIT, OURS, targets=aims),
            case("call-edges", LIMIT, OURS, FIRST, row("Numba", 0.3)),
        ),
        run(case("turn", LIMIT, *works), quick=True),
    )
    quick_run = "made with `--quick`: its times are not representative"
    assert f"run1.json: 2026-11-21, mirrorskin 0123456789ab; {quick_run}" in page
    assert "| press | whole path | at most 1.25 times | 1.3 times | yes |" in page
    assert r"| press | memory \| peak | at most 1.25 times | 12 MB | no |" in page
    assert "| all about call-edges | 100.0 | 200.0 | 200.0 | 250.0 | Numba 300.0 |" in page
    assert "| turn | mirrorskin, quick | 200.0 | 5.00 | 50 % | Numba | 100.0 | 0.5 |" in page


def test_a_page_without_targets_has_no_such_part():
    page = page_of(run(case("press", LIMIT, OURS)))
    assert "## Works" in page
    assert not any(f"## {title}" in page for title in ("Targets", "Calls"))


def test_the_chart_in_the_docs_shows_the_committed_runs():
    chart = (ROOT / "docs" / "images" / "benchmarks.svg").read_text(encoding="utf-8")
    shown = glance.entries({case.name: case for path in COMMITTED for case in open_run(path).cases})
    assert len(shown) == 10
    assert all(entry.title in chart for entry in shown)


def test_a_page_without_the_works_of_the_chart_has_none():
    assert as_chart({Path("run.json"): run(case("other", LIMIT, OURS, FIRST))}) is None
    assert "![" not in page_of(run(case("other", LIMIT, OURS, FIRST)))
