"""``mirrorskin bench``: runs, comparisons and pages, as a user asks for them."""

import json
import os
import tempfile

import pytest
from bench_runs import case, row, run, save
from commands import run as mirrorskin

from mirrorskin.bench import suite
from mirrorskin.bench.harness import Case, Measured, Row, Target, Timing
from mirrorskin.bench.suite import NAMES
from mirrorskin.io import InputError

SECOND = Timing(1.0, 0.9, 1.1, 3)


def ran(command, *words):
    """Return what a command that ends well prints."""
    ended = mirrorskin("bench", *command, *words)
    assert ended.code == 0, ended.said
    return ended.out


def made_up(name, *targets):
    """Return what runs a case that takes no time."""
    rows = [Row(work, Measured(SECOND, {}, {}, {}, 1.0, 0.0), 100) for work in ("read limit", "mirrorskin")]
    return lambda device, quick: Case(name, f"quick: {quick}", rows, {}, (), targets)


def refuse(device, quick):
    raise InputError("case bad needs more than there is")


def interrupt(device, quick):
    raise KeyboardInterrupt


@pytest.fixture
def cases(monkeypatch):
    """Cases that take no time in place of the suite's: one, two, three, accuracy, bad and stopped."""
    missed = Target("height", "at most 0.1 um", "0.3 um", False), Target("sigma", "at most 2", "9", False)
    runs = {name: made_up(name) for name in ("one", "two", "three")}
    runs |= {"accuracy": made_up("accuracy", *missed), "bad": refuse, "stopped": interrupt}
    monkeypatch.setattr(suite, "_RUNS", runs)
    monkeypatch.setattr(suite, "NAMES", tuple(runs))
    monkeypatch.setattr(suite, "_ACCURACY", {"accuracy"})


def names_of(told):
    return [one["name"] for one in json.loads(told)["cases"]]


def test_a_run_agrees_with_its_peers_and_writes_json_and_a_page(tmp_path):
    words = ["--case", "equation4-uint8", "--case", "full-uint8", "-o", tmp_path / "run.json"]
    told = json.loads(ran(["--quick", "--json"], *words))
    assert told == json.loads((tmp_path / "run.json").read_text(encoding="utf-8"))
    assert {"date", "commit", "device", "processor", "threads", "versions"} <= set(told)
    assert len(told["cases"]) == 2
    for one in told["cases"]:
        assert all(work["wall"]["median"] > 0 for work in one["rows"])
        assert one["rows"][0]["share"] == 1
        assert f"## {one['name']}: " in (tmp_path / "run.md").read_text(encoding="utf-8")


def test_the_table_fits_a_hundred_columns():
    names = ["--case", "full-uint8", "--case", "correlate-uint8"]
    table = ran(["--quick"], *names).splitlines()
    assert max(map(len, table)) <= 100
    works = [line.split("  ")[0] for line in table]
    assert works.count("read limit") == 2
    assert {"mirrorskin", "NumPy", "OpenCV", "mirrorskin, first call"} <= set(works)


def test_the_names_of_all_cases_are_told():
    assert ran(["--list"]).splitlines() == list(NAMES)
    assert json.loads(ran(["--list", "--json"])) == list(NAMES)
    assert ran(["--list", "--case", "live-v*"]).splitlines() == [
        "live-vertical-vga",
        "live-vertical-1920x1200",
    ]


def test_cases_are_chosen_by_name_and_by_pattern(cases):
    assert names_of(ran(["--json", "--case", "t*"])) == ["two", "three"]
    assert names_of(ran(["--json", "--case", "t*", "--case", "one", "--case", "two"])) == [
        "one",
        "two",
        "three",
    ]


@pytest.mark.parametrize("name", ["thre", "t?"])
def test_a_case_that_there_is_not_is_refused_with_the_nearest(cases, name):
    code, out, said = mirrorskin("bench", "--case", "one", "--case", name)
    assert (code, out) == (2, "")
    assert f"case {name!r}: no such case; the nearest are t" in said
    assert said.count("\n") == 1


def test_a_missed_bound_of_accuracy_fails_the_run_after_its_report(cases, tmp_path):
    words = ["--case", "accuracy", "--case", "one", "-o", tmp_path / "run.json"]
    code, out, said = mirrorskin("bench", *words)
    assert code == 1
    assert said.splitlines()[-1] == (
        "mirrorskin: the device is not accurate: "
        "accuracy, height: 0.3 um, must be at most 0.1 um (and 1 more)"
    )
    assert "0.3 um" in out
    assert names_of((tmp_path / "run.json").read_text(encoding="utf-8")) == ["one", "accuracy"]
    assert "| height | at most 0.1 um | 0.3 um | no |" in (tmp_path / "run.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("name", "code", "last"), [("bad", 2, "mirrorskin: case bad needs"), ("stopped", 130, "written to")]
)
def test_what_was_measured_before_an_error_or_ctrl_c_is_written(cases, tmp_path, name, code, last):
    words = ["--case", name, "--case", "one", "-o", tmp_path / "run.json"]
    ended = mirrorskin("bench", *words)
    assert ended.code == code
    assert ended.said.splitlines()[-1].startswith(last)
    assert names_of((tmp_path / "run.json").read_text(encoding="utf-8")) == ["one"]


def test_nothing_is_written_where_nothing_was_measured(cases, tmp_path):
    code, out, _ = mirrorskin("bench", "--case", "bad", "-o", tmp_path / "run.json")
    assert (code, out, list(tmp_path.iterdir())) == (2, "", [])


def test_files_go_to_the_folder_that_is_named(cases, tmp_path, monkeypatch):
    seen = []

    def look(device, quick):
        seen.extend([tempfile.gettempdir(), os.environ["TMPDIR"]])
        return made_up("one")(device, quick)

    before = tempfile.tempdir, os.environ.get("TMPDIR")
    monkeypatch.setitem(suite._RUNS, "one", look)
    ran(["--case", "one", "--folder", tmp_path])
    assert seen == [str(tmp_path)] * 2
    assert (tempfile.tempdir, os.environ.get("TMPDIR")) == before
    code, _, said = mirrorskin("bench", "--case", "one", "--folder", tmp_path / "none")
    assert code == 2
    assert "none: no such file" in said


@pytest.fixture
def runs(tmp_path):
    """Two runs of the same case, of which the second took twice as long."""

    def of(seconds):
        limit = row("read limit", 0.1, moved=10**9, kernel=0.1, share=1.0)
        scan = row("scan [VGA]", seconds, moved=10**9, operations=10**9, kernel=seconds, share=0.1 / seconds)
        return run(case("press", limit, scan))

    return save(of(0.2), tmp_path / "A.json"), save(of(0.4), tmp_path / "B.json")


def test_two_runs_are_compared(runs):
    told = ran(["compare"], *runs)
    assert "scan [VGA]  200.0  400.0   2.00  1.81-2.21   slower         50 %         25 %" in told
    assert max(map(len, told.splitlines())) <= 100
    found = json.loads(ran(["compare"], *runs, "--json"))
    assert [one["verdict"] for one in found["cases"][0]["rows"]] == ["as before", "slower"]


def test_a_page_is_made_of_runs_without_a_device(runs, tmp_path, monkeypatch):
    monkeypatch.setattr("mirrorskin.kernels.device.open_device", None)
    assert ran(["report"], *runs, "-o", tmp_path / "page.md") == ""
    assert "Some GPU" in (tmp_path / "page.md").read_text(encoding="utf-8")
    assert (tmp_path / "images" / "roofline.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["compare", "A.json"], "Missing argument 'B.json'"),
        (["compare", "A.json", "none.json"], "none.json: no such file"),
        (["compare", "A.json", "text.md"], "text.md is no JSON"),
        (["compare", "A.json", "other.json"], "other.json: date is missing"),
        (["compare", "A.json", "C.json"], "no work in common"),
        (["report", "-o", "page.md"], "Missing argument 'RUN.json'"),
        (["report", "A.json"], "Missing option '--output'"),
        (["report", "A.json", "-o", "page.txt"], "page.txt: name a page that ends in .md"),
        (["report", "A.json", "-o", "none/page.md"], "there is no folder none"),
        (["report", "text.md", "-o", "text.md"], "text.md is the input"),
        (["report", "other.json", "-o", "page.md"], "other.json: date is missing"),
        (["--quick", "compare", "A.json", "B.json"], "--quick is of a run"),
        (["--case", "live", "report", "A.json", "-o", "page.md"], "--case is of a run"),
        (["contrast", "A.json", "B.json"], "No such command 'contrast'"),
        (["--list", "--case", "nothing"], "case 'nothing': no such case"),
        (["-o", "run.txt"], "run.txt: name a file that ends in .json"),
        (["-o", "none/run.json"], "there is no folder none"),
    ],
)
def test_bad_input_gets_one_line_and_nothing_is_written(runs, tmp_path, monkeypatch, words, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "text.md").write_text("# no run\n", encoding="utf-8")
    (tmp_path / "other.json").write_text("{}", encoding="utf-8")
    save(run(case("other", row("mirrorskin", 1.0))), tmp_path / "C.json")
    before = sorted(path.name for path in tmp_path.iterdir())
    code, out, line = mirrorskin("bench", *words)
    assert (code, out) == (2, "")
    assert line.startswith("mirrorskin: ")
    assert said in line
    assert line.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == before
