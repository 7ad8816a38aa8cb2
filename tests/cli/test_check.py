"""`mirrorskin check`, and warnings of other commands: printed, or errors with `--strict`."""

import json
from pathlib import Path

import numpy as np
import pytest
from commands import done, refused, run

SIZE = "--size 60x60 --pixel-size 0.2mm --frames 20"
WRONG = "simulated.npy: the travel is 1900 mm in all, and 0.005 to 20 mm are usual: is it in mm?"


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done(f"simulate vertical {SIZE} -o press.h5")
    from mirrorskin import io

    with io.open_recording("press.h5") as recording:
        np.save("simulated.npy", recording.read(np.empty(recording.shape, np.uint8)).frames)


def test_facts_and_findings_are_printed():
    lines = done("check press.h5").out.splitlines()
    assert lines[0] == "press.h5"
    assert lines[1].split() == ["frames", "20", "of", "60", "x", "60,", "uint8"]
    assert not any(line.startswith("warning") for line in lines)


def test_a_warning_is_printed_and_no_error():
    ended = done("check simulated.npy --travel-step 100mm")
    assert f"warning: {WRONG.partition(': ')[2]}" in ended.out.splitlines()


def test_a_warning_is_an_error_if_it_is_strict():
    ended = run("check simulated.npy --travel-step 100mm --strict")
    assert (ended.code, ended.said) == (2, f"mirrorskin: {WRONG}\n")


def test_limits_are_options():
    ended = run("check simulated.npy --travel-step 100mm --extent 1mm,5m --strict")
    assert (ended.code, ended.said) == (0, "")


def test_the_report_is_json():
    report = json.loads(done("check simulated.npy --travel-step 100mm --json").out)
    assert [finding["kind"] for finding in report["findings"]] == ["travel"]


@pytest.mark.parametrize(
    "words", ["import simulated.npy --motion vertical", "reconstruct simulated.npy --dark 20 --bright 200"]
)
def test_other_commands_warn(words):
    assert f"warning: {WRONG}" in done(f"{words} --travel-step 100mm -o out.h5").said.splitlines()
    assert Path("out.h5").exists()


@pytest.mark.parametrize(
    "words",
    [
        "import simulated.npy --motion vertical",
        "reconstruct simulated.npy",
        "run mirrorskin.engine:Onset simulated.npy",
    ],
)
def test_other_commands_write_nothing_if_it_is_strict(words):
    refused("the travel is 1900 mm", *words.split(), "--travel-step", "100mm", "--strict", "-o", "out.h5")


def test_a_batch_reports_warnings_of_each_recording():
    done("import simulated.npy --motion vertical --travel-step 100mm -o far.h5")
    ended = done("batch press.h5 far.h5 -o results")
    (line,) = (line for line in ended.out.splitlines() if "far.h5" in line)
    assert "the travel is 1900 mm in all" in line
    assert ended.said == ""


def test_a_strict_batch_makes_no_result_of_what_is_doubtful():
    done("import simulated.npy --motion vertical --travel-step 100mm -o far.h5")
    assert run("batch press.h5 far.h5 -o results --strict").code == 1
    assert [path.name for path in Path("results").iterdir()] == ["press-result.h5"]


def test_warnings_are_in_the_result():
    done("reconstruct simulated.npy --travel-step 100mm -o out.h5")
    assert "the travel is 1900 mm in all" in done("info out.h5").out
