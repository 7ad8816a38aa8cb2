"""Each case runs at a tiny size, its works agree, and it returns the data of reports."""

import numpy as np
import pytest
from bench_runs import row
from click.testing import CliRunner

from mirrorskin.bench import run as program
from mirrorskin.bench.suite import integration
from mirrorskin.bench.suite.harness import DisagreementError, agree, call_targets
from mirrorskin.cli.commands.bench.records import Case, describe_run, open_run
from mirrorskin.cli.commands.bench.timing import FIRST, OURS
from mirrorskin.evaluation.scenes.inputs import blob_mask, noisy_slopes, random_cuts
from mirrorskin.io import InputError
from mirrorskin.kernels.device import open_device

QUICK = (
    "equation4-uint8",
    "full-uint8",
    "correlate-uint8",
    "normals-uint8",
    "peers-edges",
    "integrate-mask",
    "integrate-live",
    "integrate-many",
    "integrate-robust",
    "twin",
    "file-press",
    "file-turns",
    "file-lab",
    "file-zarr",
    "file-s3",
    "batch-small",
    "live-vertical-vga",
    "live-pose-and-slip",
    "live-force",
)


def check_case(name, path):
    device = open_device()
    case = program.CASES[name](device, True)
    assert case.name == name
    run = describe_run(device, [case], quick=True)
    path.write_bytes(run.as_json())
    assert open_run(path) == run
    assert not case.targets
    if case.rows and case.rows[0].is_limit and name != "limits":
        assert all(row.bytes for row in case.rows)


@pytest.mark.parametrize("name", QUICK)
def test_a_case_runs_at_a_tiny_size(name, tmp_path):
    check_case(name, tmp_path / "run.json")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::mirrorskin.io.MirrorskinWarning")  # the press fused is not of the turn
@pytest.mark.parametrize("name", [name for name in program.CASES if name not in QUICK])
def test_every_other_case_runs_at_a_tiny_size(name, tmp_path):
    check_case(name, tmp_path / "run.json")


def test_a_call_has_its_kernels_and_the_first_call():
    case = program.CASES["normals-uint8"](open_device(), True)
    again, first = [row for row in case.rows if not row.is_limit]
    assert set(again.kernels) == set(again.moved) != set()
    assert (again.name, first.name) == (OURS, FIRST)


def test_the_targets_of_a_call_are_its_kernels_and_its_peers():
    def of(name, ms, kernel=None):
        return row(name, 1e-3 * ms, moved=100, kernel=kernel and 1e-3 * kernel)

    ours = of(OURS, 16.1, 10), of(FIRST, 18.9, 10), of(f"{OURS}, solve", 5, 5)
    peers = of("NumPy", 150), of("Numba", 16.2), of("OpenCV, solve", 4)
    rows = {work.name: work for work in (of("read limit", 1), *ours, *peers)}
    targets = [(target.what, target.met) for target in call_targets(rows)]
    assert targets == [(OURS, False), (FIRST, True), (OURS, False), (OURS, True), (f"{OURS}, solve", False)]


def test_patterns_choose_cases_in_their_order():
    assert program.choose(["full-*", "equation4-uint8"])[:2] == ["equation4-uint8", "full-uint8"]
    with pytest.raises(InputError, match=r"case 'onsets': there is no such case.*; --list prints all"):
        program.choose(["onsets"])


def test_maps_that_differ_are_named_with_a_pixel():
    ours = {"height": np.array([[1.0, np.nan], [2.0, 3.0]])}
    agree("peer", {"height": ours["height"] + 0.1}, ours, {"height": 0.2})
    agree("peer", {"height": ours["height"].copy()}, ours)
    other = {"height": np.array([[1.0, np.nan], [2.0, 4.0]])}
    with pytest.raises(
        DisagreementError, match=r"peer differs from mirrorskin in the height of 1 of 4 .*\(1, 1\)"
    ):
        agree("peer", other, ours)
    with pytest.raises(DisagreementError, match="there is no height"):
        agree("peer", {}, ours)


def test_shares_are_of_the_first_row_if_it_is_a_limit():
    limit, work = row("read limit", 1.0, moved=100, kernel=0.5), row("scan", 4.0, moved=100, kernel=1.0)
    case = Case("press", "", [limit, work])
    assert (case.share(work), case.kernel_share(work)) == (0.25, 0.5)
    assert np.isnan(Case("press", "", [work]).share(work))


def test_a_direct_solution_solves_its_own_equations():
    shape = (40, 50)
    slopes, mask, edges = noisy_slopes(shape), blob_mask(shape), random_cuts(shape, 5)
    truth = integration.find_truth(slopes, mask, edges)
    residual = truth.system.matrix @ truth.values - truth.system.source
    assert np.abs(residual).max() < 1e-12
    assert truth.error(truth.values) < 1e-15
    assert truth.error(truth.map) < 1e-6


@pytest.fixture
def cases(monkeypatch):
    """Cases that take no time instead of those of the suite: one, bad and stopped."""

    def measured(device, quick):
        return Case("one", f"quick: {quick}", [row("read limit", 1.0, moved=10), row(OURS, 1.0, moved=10)])

    def refuse(device, quick):
        raise InputError("case bad needs more than there is")

    def interrupt(device, quick):
        raise KeyboardInterrupt

    runs = {"one": measured, "bad": refuse, "stopped": interrupt}
    monkeypatch.setattr(program, "CASES", runs)


def call(*words):
    return CliRunner().invoke(program.main, [str(word) for word in words])


def test_what_was_measured_before_an_error_is_written(cases, tmp_path):
    ended = call("run", "one", "bad", "-o", tmp_path / "run.json")
    assert isinstance(ended.exception, InputError)
    assert [case.name for case in open_run(tmp_path / "run.json").cases] == ["one"]
    assert "## one: quick: False" in (tmp_path / "run.md").read_text(encoding="utf-8")


def test_what_was_measured_before_ctrl_c_is_written(cases, tmp_path):
    call("run", "one", "stopped", "-o", tmp_path / "run.json")
    assert [case.name for case in open_run(tmp_path / "run.json").cases] == ["one"]


def test_runs_are_compared_and_become_a_page(cases, tmp_path):
    for name in ("a.json", "b.json"):
        assert call("run", "one", "-o", tmp_path / name).exit_code == 0
    compared = call("compare", tmp_path / "a.json", tmp_path / "b.json")
    assert "works: 1 as before" in compared.output
    report = call("report", tmp_path / "a.json", "-o", tmp_path / "page.md")
    assert report.exit_code == 0
    assert "a.json: " in (tmp_path / "page.md").read_text(encoding="utf-8")
    assert call("run", "--list").output.split() == ["one", "bad", "stopped"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["run", "nothing"], "case 'nothing': there is no such case"),
        (["run", "one", "-o", "run.txt"], "must end in .json"),
        (["run", "one", "--folder", "none"], "none is not a writable folder"),
        (["report", "run.json", "-o", "page.txt"], "must end in .md"),
        (["compare", "none.json", "none.json"], "none.json"),
    ],
)
def test_bad_input_is_refused(cases, tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    ended = call(*words)
    assert isinstance(ended.exception, InputError)
    assert message in str(ended.exception)
    assert not list(tmp_path.iterdir())
