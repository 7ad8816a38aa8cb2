"""A part of a recording, from the command line: read, reconstructed, and scored against its own truth."""

import json

from commands import run

SMALL = ["--size", "64x48", "--pixel-size", "0.2mm", "--frames", "12"]


def score_of(result, truth):
    found = run("score", result, "--truth", truth, "--json")
    assert found.code == 0, found.said
    return json.loads(found.out)


def test_a_part_is_scored_against_its_own_truth(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run("simulate", "vertical", *SMALL, "-o", "v.h5").code == 0
    assert run("reconstruct", "v.h5", "-o", "whole.h5").code == 0
    part = run("reconstruct", "v.h5", "--region", "20,10,30x25", "-o", "part.h5")
    assert part.code == 0, part.said
    whole, part = score_of("whole.h5", "v.h5"), score_of("part.h5", "v.h5")
    assert 0 < part["height"]["answered"] < whole["height"]["answered"]
    assert part["height"]["rms"] < 2 * whole["height"]["rms"]


def test_a_result_of_another_stack_is_still_told(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run("simulate", "vertical", *SMALL, "-o", "v.h5").code == 0
    assert run("simulate", "vertical", *SMALL[2:], "--size", "32x24", "-o", "other.h5").code == 0
    assert run("reconstruct", "v.h5", "-o", "whole.h5").code == 0
    found = run("score", "whole.h5", "--truth", "other.h5")
    assert found.code == 2
    assert "not of one stack" in found.said
