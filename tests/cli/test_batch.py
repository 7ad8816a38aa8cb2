"""``mirrorskin batch``: the files it finds, its messages, and the files it leaves."""

import io as streams
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
from batches import BAD, half_written, missing, press, rotation
from commands import refused, run

from mirrorskin import io
from mirrorskin.cli.main import main
from mirrorskin.engine.batch import cluster, local
from mirrorskin.engine.batch.jobs import make_jobs
from mirrorskin.engine.batch.work import Outcome

SOUND = {"press.h5": press, "turn.h5": rotation}


def results(place="out"):
    return sorted(str(path.relative_to(place)) for path in Path(place).rglob("*") if path.is_file())


def presses(*names):
    for name in names:
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        press(Path(name))


def test_bad_recordings_of_every_kind_are_reported_and_the_rest_is_done():
    for name, make in SOUND.items():
        make(Path(name))
    bad = [make(Path(f"{make.__name__}.h5")).name for make in BAD]
    code, out, errors = run("batch", *bad, *SOUND, "-o", "out")
    lines = out.splitlines()
    assert (code, errors) == (1, "")
    assert results() == ["press-result.h5", "turn-result.h5"]
    for name, words in zip(bad, BAD.values(), strict=True):
        assert sum(line.startswith("failed: ") and name in line and words in line for line in lines) == 2
    assert sum(line.startswith("done: press.h5 in ") and "height at 35 of 35" in line for line in lines) == 1
    assert sum(line.startswith("done: turn.h5 in ") for line in lines) == 1
    assert len(lines) == 2 * len(bad) + 2 + 1
    assert lines[-1].startswith(f"out: {len(bad) + 2} recordings: 2 done, 0 kept, {len(bad)} failed; ")
    assert "GB in" in lines[-1]


def test_what_is_finished_is_kept_until_the_settings_change():
    presses("a.h5", "b.h5")
    assert run("batch a.h5 -o out").code == 0
    first = Path("out/a-result.h5").read_bytes()
    code, out, _ = run("batch a.h5 b.h5 -o out")
    assert (code, out.splitlines()[0]) == (0, "kept: a.h5")
    assert "1 done, 1 kept, 0 failed" in out
    assert Path("out/a-result.h5").read_bytes() == first
    Path("batch.toml").write_text("[press]\nthreshold = 0.3\n")
    assert "2 done, 0 kept" in run("batch a.h5 b.h5 -o out --settings batch.toml").out
    assert io.open_result("out/a-result.h5").process["threshold"] == 0.3


@pytest.mark.parametrize("place", ["--workers 2", "--scheduler tcp://127.0.0.1:1", ""])
def test_where_nothing_is_to_do_no_worker_and_no_device_is_asked_for(monkeypatch, place):
    presses("a.h5")
    run("batch a.h5 -o out")
    monkeypatch.setattr(cluster, "run_cluster", None)
    monkeypatch.setattr(local, "default_devices", None)
    ended = run(f"batch a.h5 no.h5 -o out {place}")
    assert "0 done, 1 kept, 1 failed" in ended.out


def test_the_shards_of_a_batch_are_the_whole_of_it_and_name_results_alike():
    names = ["mon/x.h5", "tue/x.h5", "a.h5", "b.h5", "c.h5"]
    presses(*names)
    run("batch", *names, "-o", "whole")
    counts = [run("batch", *names[::-1], "-o", "out", "--shard", f"{part}/2").out for part in (1, 2)]
    assert ["3 done, 0 kept" in counts[0], "2 done, 0 kept" in counts[1]] == [True, True]
    assert results("out") == results("whole")


def test_patterns_are_understood_when_quoted():
    presses("a.h5", "b.h5", "deep/er/c.h5", "deep/d.nxs")
    Path("e.h5").mkdir()
    assert "2 done" in run("batch *.h5 -o one").out
    assert "3 done" in run("batch **/*.h5 -o two").out
    assert "2 done" in run("batch deep/** -o three").out
    assert "2 done" in run("batch", str(Path("[ab].h5").absolute()), "b.h5", "-o", "four").out
    assert results("three") == ["c-result.h5", "d-result.h5"]


def test_remedies_are_those_of_a_batch():
    foreign = {"x": np.zeros((8, 5, 7), np.uint8), "y": np.zeros((8, 5, 7), np.uint8)}
    with h5py.File("a.h5", "w") as file:
        file.update(foreign)
    assert "choose with dataset in [stack] of --settings" in run("batch a.h5 -o out").out
    Path("batch.toml").write_text('[stack]\ndataset = "x"\n')
    text = run("batch a.h5 -o out --settings batch.toml").out
    assert "give motion in [stack] of --settings, one of vertical" in text


def test_a_motion_that_contradicts_a_file_fails_it():
    presses("a.h5")
    Path("batch.toml").write_text('[stack]\nmotion = "axial"\n')
    text = run("batch a.h5 -o out --settings batch.toml").out
    assert "a.h5 states the motion vertical, but motion in [stack] of --settings is axial" in text


@pytest.mark.parametrize("encoding", ["utf-8", "ascii"])
def test_a_name_that_is_not_text_is_shown_as_well_as_can_be(monkeypatch, encoding):
    for name in (b"a\xff.h5", b"a\nb.h5", "é.h5".encode()):
        press(Path(os.fsdecode(name)))
    out = streams.TextIOWrapper(streams.BytesIO(), encoding, errors="strict")
    monkeypatch.setattr(sys, "argv", ["mirrorskin", "batch", "*.h5", os.fsdecode(b"no\xff"), "-o", "out"])
    monkeypatch.setattr(sys, "stdout", out)
    with pytest.raises(SystemExit, match="1"):
        main()
    out.flush()
    lines = out.buffer.getvalue().decode(encoding).splitlines()
    assert [line.split(" in ")[0] for line in lines[1:4]] == [
        "done: a?b.h5",
        "done: a?.h5",
        "done: ?.h5" if encoding == "ascii" else "done: é.h5",
    ]
    assert lines[0] == lines[4] == "failed: no?: no such file"
    assert "3 done, 0 kept, 1 failed" in lines[5]


def test_json_lists_every_file():
    presses("a.h5")
    missing(Path("b.h5"))
    code, out, errors = run("batch a.h5 b.h5 -o out --json")
    report = json.loads(out)
    assert (code, errors) == (1, "")
    assert {name: report[name] for name in ("output", "done", "kept", "failed", "bytes")} == {
        "output": "out",
        "done": 1,
        "kept": 0,
        "failed": 1,
        "bytes": 8 * 5 * 7,
    }
    second, first = report["files"]
    assert (first["source"], first["result"], first["state"]) == ("a.h5", "out/a-result.h5", "done")
    assert (first["motion"], first["bytes"]) == ("vertical", 8 * 5 * 7)
    assert (second["state"], second["message"]) == ("failed", "b.h5: no such file")


def test_half_written_files_of_the_killed_are_removed(tmp_path):
    presses("mon/x.h5", "tue/x.h5")
    for place in ("out", "out/mon"):
        Path(place).mkdir()
        Path(place, ".mirrorskin-abc.part").write_bytes(b"half")
    run("batch **/*.h5 -o out")
    assert not half_written(tmp_path)


class Terminal(streams.StringIO):
    """What is no pipe."""

    def isatty(self):
        return True


def test_a_terminal_shows_a_table(monkeypatch):
    presses("a.h5", "b.h5")
    screen, out = Terminal(), Terminal()
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setattr(sys, "argv", ["mirrorskin", "batch", "a.h5", "b.h5", "nothing.h5", "-o", "out"])
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setattr(sys, "stdout", out)
    with pytest.raises(SystemExit, match="1"):
        main()
    shown = screen.getvalue()
    for words in ("MB/s", "a.h5", "vertical", "nothing.h5: no such file", "3/3", "2 done, 1 failed"):
        assert words in shown
    assert out.getvalue().startswith("failed: nothing.h5: no such file\nout: 3 recordings: 2 done")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("x*.h5 -o out", "x*.h5: no file matches"),
        ("a.h5 -o no/out", "there is no folder no: make it first"),
        ("a.h5 -o a.h5", "a.h5 is not a folder"),
        ("a.h5 -o /proc/out", "/proc/out cannot be created"),
        ("a.h5", "-o"),
        ("-o out", "FILE..."),
        ("a.h5 -o out --memory 5", "a unit is needed"),
        ("a.h5 -o out --workers 0", "--workers"),
        ("a.h5 -o out --shard 3/2", "--shard 3/2: a part and the number of parts is needed"),
        ("no.h5 -o out", "no.h5: no such file"),
        ("a.h5 -o out --workers 2 --device 0", "--device and --workers"),
        ("a.h5 -o out --workers 2 --scheduler tcp://x:1", "--workers and --scheduler"),
        ("a.h5 -o out --settings no.toml", "no.toml: no such file"),
        ("a.h5 out-result.h5 out-result.nxs out-result.h5.h5 -o out", "would be the result of two"),
    ],
)
def test_a_wrong_call_is_one_line_and_makes_nothing(tmp_path, words, message):
    presses("a.h5")
    refused(message, f"batch {words}")
    assert [path.name for path in tmp_path.iterdir()] == ["a.h5"]


def test_ctrl_c_leaves_whole_results_and_prints_how_to_resume(tmp_path):
    presses("a.h5")
    for number in range(300):
        Path(f"{number:03}.h5").symlink_to("a.h5")
    words = [sys.executable, "-m", "mirrorskin.cli.main", "batch", "[0-9]*.h5", "-o", "out"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as child:
        first = child.stdout.readline()
        for _ in range(3):  # who is in a hurry
            child.send_signal(signal.SIGINT)
            time.sleep(0.01)
        rest, errors = child.communicate(timeout=60)
    assert child.returncode in (130, -signal.SIGINT)  # the last may come when the program has ended already
    assert first.split(" in ")[0] == "done: 000.h5"
    assert not half_written(tmp_path)
    written = results()
    assert 1 <= len(written) < 300
    assert all(io.open_result(f"out/{name}").height is not None for name in written)
    errors = errors.replace("mirrorskin: it is being stopped; two more Ctrl-C end it at once\n", "")
    count = int(errors.split()[2])
    assert errors == f"ended after {count} of 300: the same command resumes it\n"
    # It may end between the count and the line, and a line whose writing is interrupted may come twice.
    lines = {line for line in [first.rstrip(), *rest.splitlines()] if line.startswith("done: ")}
    assert count - len(lines) in (0, 1)
    assert len(written) - count in (0, 1)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("--workers 3", {"address": None, "workers": 3}),
        ("--scheduler tcp://node1:8786", {"address": "tcp://node1:8786", "workers": None}),
    ],
)
def test_a_cluster_is_given_the_same_jobs(monkeypatch, words, expected):
    submitted = []

    def run_cluster(jobs, plan, **where):
        submitted.append((jobs, plan.memory_limit, where))
        for job in jobs:
            yield Outcome(job, "done", "well", 0.5, 1000, "a device", "axial")

    monkeypatch.setattr(cluster, "run_cluster", run_cluster)
    presses("a.h5", "b.h5")
    code, out, _ = run(f"batch a.h5 b.h5 -o out --memory 1MB {words}")
    assert (code, out.splitlines()[0]) == (0, "done: a.h5 in 0.5 s, 0 MB/s: well")
    assert submitted == [(make_jobs([Path("a.h5"), Path("b.h5")], Path("out")), 10**6, expected)]


WEAR = """
import numpy as np
from mirrorskin import engine, io

class Wear(engine.Operation):
    travel_offset: float = engine.option(default=0.0, unit="mm", help="added to each travel")
    wear = io.Map("depth of the wear", "mm", quantity="height")

    def start(self, shape, dtype):
        self.deepest = np.zeros(shape)
    def push(self, frames, *, travel):
        self.deepest -= self.travel_offset + travel[-1]
    def result(self):
        return {"wear": self.deepest}
"""
SETTINGS = '[operation]\nclass = "mine_of_a_batch.py:Wear"\ntravel-offset = "100um"\n'


@pytest.mark.parametrize("workers", [[], pytest.param(["--workers", "1"], marks=pytest.mark.slow)])
def test_a_user_s_operation_runs_in_a_batch_and_is_resumed(workers):
    presses("press.h5")
    rotation(Path("turn.h5"))
    Path("mine_of_a_batch.py").write_text(WEAR)
    Path("batch.toml").write_text(SETTINGS)
    words = [
        "batch",
        "press.h5",
        "turn.h5",
        "-o",
        "out",
        "--settings",
        "batch.toml",
        "--memory",
        "10kB",
        *workers,
    ]
    first, again = run(*words, "--json"), run(*words, "--json")
    states = [
        {Path(file["source"]).name: file["state"] for file in json.loads(ended.out)["files"]}
        for ended in (first, again)
    ]
    assert states == [{"press.h5": "done", "turn.h5": "failed"}, {"press.h5": "kept", "turn.h5": "failed"}]
    message = next(file["message"] for file in json.loads(first.out)["files"] if file["state"] == "failed")
    assert "travel is missing: Wear needs it of each frame" in message
    result = io.open_result("out/press-result.h5")
    assert result.declaration("wear").quantity == "height"
    assert (result.process["operation"], result.process["travel_offset"]) == ("Wear", pytest.approx(0.1))
    Path("batch.toml").write_text(SETTINGS.replace("100um", "0.2mm"))
    changed = json.loads(run(*words, "--json").out)["files"]
    assert [file["state"] for file in changed if "press" in file["source"]] == ["done"]
