"""Scaling: rows for each size, processes of their own for cores and cold starts."""

import json
import sys
from dataclasses import asdict, replace

import numpy as np
import pytest

from mirrorskin.bench.harness import Measured, Timing
from mirrorskin.bench.results import Row
from mirrorskin.bench.same import DisagreementError
from mirrorskin.bench.scaling import CASES, cold, cores, sizes
from mirrorskin.bench.scaling.process import run_process
from mirrorskin.kernels.device import open_device
from mirrorskin.kernels.errors import DeviceError

SECOND = Timing(1.0, 1.0, 1.0, 1)
NOTHING = Measured(SECOND, {}, {}, 1.0, 0.0)


def names(case):
    return [row.name for row in case.rows if "limit" not in row.name]


def test_each_number_of_frames_has_its_rows():
    case = CASES["scaling-frames"](open_device(), True)
    assert names(case) == [
        f"{work}, {count} frames" for work in ("press", "correlation", "turns") for count in (8, 16)
    ]
    assert [row.frames for row in case.rows[3:]] == [8, 16] * 3
    assert len(case.notes) == 3


def test_each_size_has_its_rows():
    case = CASES["scaling-pixels"](open_device(), True)
    assert names(case) == [
        f"{work}, {size}" for size in ("12 x 16", "24 x 32") for work in ("press", "turns", "surface")
    ]
    assert len(case.notes) == 3


def row_of(seconds, frames=0):
    return Row("press", replace(NOTHING, wall=Timing(seconds, seconds, seconds, 1)), 1, frames)


def test_a_straight_line_and_a_power_are_told():
    rows = [row_of(0.002 + 50e-6 * count, count) for count in (8, 32, 128)]
    assert sizes._by_frame("press", rows) == "press: 2.00 ms and 50.0 us a frame, within 0 %"
    told = sizes._by_pixel("press", [1e4, 1e5, 1e6], [row_of(one) for one in (0.01, 0.02, 0.2)])
    assert told.startswith("press: 1.0 Mpixel/s of the smallest, 5.0 of the largest")
    assert told.endswith("power of 1.00")


@pytest.mark.parametrize(("most", "expected"), [(1, [1]), (2, [1, 2]), (6, [1, 2, 4, 6]), (8, [1, 2, 4, 8])])
def test_cores_are_doubled_up_to_all(most, expected):
    assert cores._counts(most) == expected


def test_processes_with_fewer_cores_answer(monkeypatch):
    device = open_device()
    if not cores._can_choose(device.info):
        pytest.skip("this device cannot be told its cores")
    monkeypatch.setattr(cores, "THREADS", 1)
    case = CASES["scaling-cores"](device, True)
    assert names(case) == [f"{work}, 1 thread" for work in ("press", "correlation", "turns", "surface")]
    assert case.rows[0].name == "read limit, 1 thread"
    assert all(case.share(row) > 0 for row in case.rows)
    assert "press, times as fast as on one core: there is one only" in case.notes


def test_of_several_processes_the_one_in_the_middle_counts():
    assert cores._middle([row_of(3.0), row_of(1.0), row_of(2.0)]).measured.wall.median == 2.0


def test_a_device_that_cannot_be_told_its_cores_has_a_note():
    device = open_device()
    other = type("Other", (), {"info": replace(device.info, platform="Another")})()
    case = cores.run_cores(other, True)
    assert not case.rows
    assert "only PoCL's CPU devices" in case.notes[0]


def test_what_was_measured_comes_back_from_json():
    told = Measured(SECOND, {"kernel": Timing(0.5, 0.4, 0.6, 3)}, {"scan": 0.5}, 2.0, 0.1)
    assert cores.as_measured(json.loads(json.dumps(asdict(told)))) == told


def test_a_process_answers_with_its_last_line_or_fails_with_it():
    told = "import json, os; print('so far'); print(json.dumps({'threads': os.environ['THREADS']}))"
    assert run_process([sys.executable, "-c", told], {"THREADS": "3"}) == {"threads": "3"}
    with pytest.raises(DeviceError, match=r"ended with 1: no such device$"):
        run_process([sys.executable, "-c", "raise SystemExit('first\\nno such device')"], {})


def test_a_process_has_caches_of_its_own_and_tells_its_steps(tmp_path, monkeypatch):
    folders = {}

    def run(command, environment):
        folders.update(environment)
        return run_process(command, {})  # with the caches of all tests: empty ones take their time

    monkeypatch.setattr(cold, "run_process", run)
    told = cold._start(open_device(), (8, 24, 32), ("turn",), str(tmp_path))
    assert list(told["seconds"]) == [
        "import",
        "open device",
        "first turn",
        "second turn",
        "from start to end",
    ]
    assert told["seconds"]["from start to end"] > told["seconds"]["import"] > 0
    assert len(told["answers"]) == 64
    assert sorted(folders) == ["CUDA_CACHE_PATH", "POCL_CACHE_DIR", "XDG_CACHE_HOME"]
    assert {path.name for path in tmp_path.iterdir()} == {name.lower() for name in folders}


def process(answers="a", first=2.0):
    seconds = {"import": 0.5, "open device": 0.1, "first turn": first, "second turn": 0.01}
    compiling = {"first turn": first / 2, "second turn": 0.0}
    return {"seconds": {**seconds, "from start to end": 3.0}, "compile": compiling, "answers": answers}


def test_a_cold_start_tells_each_step_apart(monkeypatch):
    given = iter([process(), process(first=0.2)])
    monkeypatch.setattr(cold, "_start", lambda *asked: next(given))
    case = CASES["cold-start"](open_device(), True)
    steps = ["import", "open device", "first turn", "second turn", "from start to end"]
    assert names(case) == [f"{which}, {step}" for which in ("cold", "warm") for step in steps]
    told = {row.name: row for row in case.rows}
    assert told["cold, first turn"].measured.compile == 1.0
    assert (told["warm, second turn"].frames, told["warm, second turn"].bytes) == (8, 8 * 24 * 32)
    assert np.isfinite([case.share(row) for row in case.rows]).all()
    assert case.notes[0].startswith("cold: 1.00 s of 2.00 s")


def test_processes_that_find_something_else_are_refused(monkeypatch):
    given = iter([process(), process(answers="b")])
    monkeypatch.setattr(cold, "_start", lambda *asked: next(given))
    with pytest.raises(DisagreementError, match="cold and with warm caches"):
        CASES["cold-start"](open_device(), True)
