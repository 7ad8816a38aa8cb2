"""A page of runs: made from JSON alone, with everything that the runs tell."""

from pathlib import Path

import cv2
import pytest
from bench_runs import case, row, run, save, target

from mirrorskin.bench.page import PICTURE, as_page, gather, write_page
from mirrorskin.bench.runs import open_run
from mirrorskin.bench.summary import as_summary, as_sweep
from mirrorskin.io import InputError

LIMIT = row("read limit", 0.1, moved=10**9, kernel=0.08, share=1.0)
OURS = row("mirrorskin", 0.2, moved=10**9, kernel=0.2, share=0.5)


def page_of(*runs):
    return as_page({Path(f"run{n}.json"): one for n, one in enumerate(runs)}, gather(runs), pictured=False)


def test_a_page_has_the_runs_the_aims_and_every_case():
    aims = target("whole path", True), target("memory | peak", False, "12 MB")
    told = page_of(run(case("press", LIMIT, OURS, targets=aims, notes=("said",)), case("turn", LIMIT, OURS)))
    assert told.startswith("# Benchmarks\n\n")
    assert (
        "- run0.json: Some platform: Some GPU (driver 1.0), 2 threads; Some processor; mirrorskin 0123"
        in told
    )
    assert "| press | whole path | at most 1.25 times | 1.3 times | yes |" in told
    assert r"| press | memory \| peak | at most 1.25 times | 12 MB | no |" in told
    assert "### press: all about press\n" in told
    assert "\nsaid\n" in told
    assert "### turn: all about turn\n" in told
    assert "| mirrorskin | 200.0 | 190.0-210.0 | 200.0 |  | 5.00 |  | 50 % |  |" in told
    assert "![" not in told


def test_accuracy_is_told_by_case_with_what_was_missed():
    bounds = target("height", True), target("sigma", False, "9"), target("edges", False, "7")
    told = page_of(
        run(
            case("accuracy-all", targets=bounds[:1]),
            case("accuracy-some", targets=bounds),
            case("press", LIMIT),
        )
    )
    assert "| accuracy-all | all about accuracy-all | 1 of 1 | none |" in told
    assert "| accuracy-some | all about accuracy-some | 1 of 3 | sigma: 9; edges: 7 |" in told
    assert "## Aims" not in told


def test_a_quick_run_is_said_to_mean_nothing():
    sound, quick = run(case("press", LIMIT)), run(case("press", LIMIT), quick=True)
    assert page_of(sound, quick).count("the times mean nothing") == 1
    assert page_of(sound).count("the times mean nothing") == 0


def test_without_aims_or_sweeps_a_page_has_no_such_part():
    told = page_of(run(case("press", LIMIT, OURS)))
    headings = [line for line in told.splitlines() if line.startswith("## ")]
    assert headings == ["## Summary", "## All cases"]


def test_of_a_case_that_two_runs_of_a_machine_have_the_last_counts():
    older, newer = (
        run(case("press", LIMIT, row("mirrorskin", seconds, moved=10**9))) for seconds in (0.3, 0.2)
    )
    other = run(case("turn", LIMIT))
    (machine,) = gather([older, newer, other])
    assert list(machine.cases) == ["press", "turn"]
    assert machine.cases["press"]["rows"][1]["wall"]["median"] == 0.2


def test_machines_are_told_apart():
    here, there = run(case("press", LIMIT, OURS)), run(case("press", LIMIT, OURS), processor="Another")
    told = page_of(here, there)
    assert told.count("### press") == 2
    for name in ("Some processor", "Another"):
        assert told.count(f"**Some platform: Some GPU (driver 1.0), 2 threads; {name}**") == 2


def test_a_summary_holds_a_work_against_the_quickest_that_does_the_same():
    rows = [
        row("mirrorskin, whole", 0.2, moved=10**9, share=0.5),
        row("mirrorskin, part", 0.1, moved=10**9, share=0.9),
        row("NumPy, whole", 3.0),
        row("Numba, whole", 0.3),
        row("Numba, other", 0.001),
    ]
    assert as_summary(case("press", LIMIT, *rows)) == [
        ["mirrorskin, whole", "200.0", "5.00", "50 %", "Numba", "300.0", "1.5"]
    ]


def test_a_summary_also_holds_what_an_aim_is_about():
    rows = [row("mirrorskin, whole", 0.2), row("mirrorskin, part", 0.1), row("h5py, part", 0.1)]
    aims = (target("mirrorskin, whole", True),)
    found = as_summary(case("file", LIMIT, *rows, row("mirrorskin, rest", 0.1), targets=aims))
    assert [cells[0] for cells in found] == ["mirrorskin, whole", "mirrorskin, part"]


def test_steps_that_are_taken_cold_and_warm_stand_beside_each_other():
    rows = [row("cold, import", 0.4), row("cold, first turn", 0.3), row("warm, import", 0.2)]
    told = page_of(run(case("cold-start", LIMIT, *rows)))
    assert "| import | 400.0 | 200.0 |" in told
    assert "| first turn | 300.0 |  |" in told
    assert "## Cold and warm" in told


def test_a_summary_of_a_case_without_others_holds_all_works_of_ours():
    rows = [row("mirrorskin, one", 0.2), row("mirrorskin, two", 0.1), row("kernel_alone", 0.1, kernel=0.1)]
    found = as_summary(case("live", LIMIT, *rows))
    assert [cells[0] for cells in found] == ["mirrorskin, one", "mirrorskin, two", "kernel_alone"]
    assert found[0][1:] == ["200.0", "", "", "", "", ""]


def test_a_sweep_is_a_table_of_sizes_and_not_in_the_summary():
    swept = case(
        "sweep-press",
        row("read limit, VGA", 0.1, moved=10**9, kernel=0.1),
        row("scan, VGA", 0.2, moved=10**9, kernel=0.2, share=0.5),
        row("answer, VGA", 0.5, moved=10**9, kernel=0.5),
        row("scan, 20 Mpx", 0.4, moved=10**9, kernel=0.4, share=0.25),
    )
    labels, rows = as_sweep(swept)
    assert labels == ("VGA", "20 Mpx")
    assert rows == [
        ["sweep-press", "scan", "5.0 (50 %)", "2.5 (25 %)"],
        ["sweep-press", "answer", "2.0", ""],
    ]
    assert as_summary(swept) == []
    assert as_sweep(case("press", LIMIT, OURS)) == ((), [])
    assert "| case | work | VGA | 20 Mpx |" in page_of(run(swept))


def test_a_page_and_its_picture_are_written(tmp_path):
    kernel = row("scan", 0.2, moved=10**9, operations=10**9, kernel=0.2)
    path = save(run(case("press", LIMIT, kernel)), tmp_path / "run.json")
    write_page({path: open_run(path)}, tmp_path / "page.md")
    told = (tmp_path / "page.md").read_text(encoding="utf-8")
    assert f"![Roofline]({PICTURE.as_posix()})" in told
    assert cv2.imread(str(tmp_path / PICTURE)) is not None


def test_a_folder_of_pictures_that_cannot_be_made_is_named(tmp_path):
    kernel = row("scan", 0.2, moved=10**9, operations=10**9, kernel=0.2)
    (tmp_path / "images").write_text("a file", encoding="utf-8")
    with pytest.raises(InputError, match="images cannot be made: File exists"):
        write_page({tmp_path / "run.json": run(case("press", LIMIT, kernel))}, tmp_path / "page.md")
    assert not (tmp_path / "page.md").exists()
