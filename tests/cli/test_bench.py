"""``mirrorskin bench``: measurements of a device, and their comparison with a table."""

import json

import pytest
from bench_runs import case, row, run, save
from commands import run as mirrorskin

from mirrorskin.cli.commands import bench
from mirrorskin.cli.commands.bench import operations
from mirrorskin.cli.commands.bench.records import open_run

CASES = ["limits", "onset", "correlation", "integration"]


@pytest.fixture
def made_up(monkeypatch):
    """Cases that take no time, instead of the operations."""
    limit = row("read limit", 0.1, moved=10**9, kernel=0.1)
    cases = [case("onset", limit, row("mirrorskin", 0.2, moved=10**9, frames=64, kernel=0.15))]
    monkeypatch.setattr(
        operations, "CASES", {case.name: lambda device, quick, case=case: case for case in cases}
    )


def test_the_operations_and_the_limits_are_measured_and_written(tmp_path):
    ended = mirrorskin("bench", "--quick", "--json", "-o", tmp_path / "run.json")
    assert ended.code == 0, ended.said
    assert json.loads(ended.out) == json.loads((tmp_path / "run.json").read_text(encoding="utf-8"))
    found = open_run(tmp_path / "run.json")
    assert [one.name for one in found.cases] == CASES
    assert found.quick
    limits, *others = found.cases
    assert [one.name for one in limits.rows][-2:] == ["multiply-add limit", "1000 launches"]
    for one in others:
        assert [work.name for work in one.rows if not work.is_limit] == [
            "mirrorskin",
            "mirrorskin, first call",
        ]
        assert all(work.kernel > 0 and work.bytes > 0 for work in one.rows)


def test_a_table_has_the_times_of_the_run_and_of_the_table(made_up, tmp_path):
    other = run(case("onset", row("mirrorskin", 0.5, moved=10**9)))
    ended = mirrorskin("bench", "--against", save(other, tmp_path / "other.json"))
    assert ended.code == 0, ended.said
    assert "table: Some platform: Some GPU" in ended.out
    (line,) = [line for line in ended.out.splitlines() if line.startswith("mirrorskin ")]
    cells = [cell for cell in line.split("  ") if cell]
    assert [cell.strip() for cell in cells] == [
        "mirrorskin",
        "200.0",
        "190.0-210.0",
        "150.0",
        "5.0 GB/s",
        "50 %",
        "500.0",
        "2.50",
    ]
    assert max(map(len, ended.out.splitlines()[2:])) <= 110


def test_the_package_s_table_is_the_default(made_up):
    ended = mirrorskin("bench")
    assert f"table: {open_run(bench.TABLE).title}" in ended.out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["-o", "run.txt"], "run.txt: the name must end in .json"),
        (["-o", "none/run.json"], "there is no folder none"),
        (["-o", "table.json", "--against", "table.json"], "table.json is the input"),
        (["--against", "none.json"], "none.json: no such file"),
        (["--against", "other.json"], "missing required field `date`"),
        (["compare", "table.json"], "No such command 'compare'"),
    ],
)
def test_bad_input_gets_one_line_and_nothing_is_written(tmp_path, made_up, words, said):
    (tmp_path / "other.json").write_text("{}", encoding="utf-8")
    save(run(case("onset", row("mirrorskin", 1.0))), tmp_path / "table.json")
    before = sorted(path.name for path in tmp_path.iterdir())
    code, out, line = mirrorskin("bench", *words)
    assert (code, out) == (2, "")
    assert line.startswith("mirrorskin: ")
    assert said in line.replace("Got u", "u")
    assert line.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == before
