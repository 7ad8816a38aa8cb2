"""``mirrorskin bench live``: what it compares, measures and writes."""

import json

import numpy as np
import pytest
from commands import done, refused, run

from mirrorskin.cli.commands.bench import live_runs
from mirrorskin.cli.commands.bench.records import PERCENTILES, open_run
from mirrorskin.engine.pose import PoseTracker
from mirrorskin.io import InputError
from mirrorskin.kernels.device import open_device

TINY = "--size", "64x48", "--rate", "50", "--seconds", "0.2"


def test_runs_of_all_kinds_are_measured_and_written(tmp_path):
    ended = done("bench", "live", *TINY, "--json", "-o", tmp_path / "run.json")
    assert json.loads(ended.out) == json.loads((tmp_path / "run.json").read_text(encoding="utf-8"))
    cases = open_run(tmp_path / "run.json").cases
    assert [case.name for case in cases] == [f"live-{name}" for name in live_runs.NAMES]
    rows = [row for case in cases for row in case.live]
    assert all((row.size, row.frames, row.rate) == ("64x48", 10, 50) for row in rows)
    assert all(row.as_offline and row.processor > 0 for row in rows)
    assert all(tuple(row.latency) == PERCENTILES for row in rows if row.updates)


def test_a_table_has_a_row_of_each_run_and_size():
    ended = done("bench", "live", "--of", "force", "--size", "64x48,80x60", *TINY[2:])
    rows = [line.split()[:3] for line in ended.out.splitlines() if line.startswith("force")]
    assert rows == [["force", "64x48", "50"], ["force", "80x60", "50"]]
    assert max(map(len, ended.out.splitlines()[1:])) <= 110


def test_trackers_that_run_together_have_one_result():
    row, ran = live_runs.measure_live("pose+slip", (48, 64), 1000.0, 0.01, open_device())
    assert row.as_offline
    assert set(ran.result) == {"pose", "slip"}


def test_a_result_that_differs_from_the_offline_one_ends_with_an_error(monkeypatch):
    submit, calls = PoseTracker.submit, []

    def drift(self, maps):
        calls.append(maps)
        return submit(self, calls[0] if len(calls) > 300 else maps)  # the offline run is over

    monkeypatch.setattr(PoseTracker, "submit", drift)
    ended = run("bench", "live", "--of", "pose", *TINY)
    assert ended.code == 1
    assert "not that of the same frames offline: pose 64x48" in ended.said


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--of", "posse"], "--of 'posse' does not run live: name press, turn, pose, slip, force"),
        (["--of", "press+pose"], "--of press+pose: press and turn run alone; join pose, slip, force only"),
        (["--size", "320"], "--size 320: pixels across and down are needed"),
        (["--rate", "0"], "'--rate'"),
        (["-o", "run.txt"], "run.txt: the name must end in .json"),
    ],
)
def test_bad_input_is_refused(words, said):
    refused(said, "bench", "live", *words)


def test_options_of_the_other_command_are_refused():
    refused("--quick is not of 'bench live': write options after 'live'", "bench", "--quick", "live")


def test_results_are_compared_number_by_number():
    maps = {"height": np.array([1.0, np.nan], np.float32), "status": np.array([1, 2])}
    assert live_runs._is_same({**maps, "more": 1}, maps)
    assert not live_runs._is_same({**maps, "status": np.array([1, 3])}, maps)
    assert not live_runs._is_same({"height": maps["height"]}, maps)
    assert not live_runs._is_same({**maps, "height": np.array([np.nan, 1.0])}, maps)


def test_a_name_that_is_unknown_is_refused():
    with pytest.raises(InputError, match="'glance' does not run live"):
        live_runs.check_name("glance")
