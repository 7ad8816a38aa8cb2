"""Damaged files, a few thousand of them; ``make fuzz`` goes on for an hour."""

import time

import fuzz
import pytest

SECONDS = 40


@pytest.mark.slow
def test_damaged_files_are_read_or_refused_in_one_line(tmp_path):
    (tmp_path / "samples").mkdir()
    samples, end = fuzz.make_samples(tmp_path / "samples"), time.monotonic() + SECONDS
    outcomes = list(fuzz.attack(samples, 1, lambda number: time.monotonic() < end, tmp_path / "findings"))
    assert len(outcomes) > 100
    assert [one for one in outcomes if one[1] not in ("read", "refused")] == []


@pytest.mark.parametrize(("does", "outcome"), [("os._exit(3)", "crash 3"), ("time.sleep(60)", "hang")])
def test_a_reader_that_dies_or_hangs_is_seen(tmp_path, monkeypatch, does, outcome):
    program = tmp_path / "program.py"
    program.write_text(f"import os, time; input(); {does}")
    monkeypatch.setattr(fuzz, "__file__", str(program))
    monkeypatch.setattr(fuzz, "PATIENCE", 1.0)
    assert fuzz.Reader().read(tmp_path) == outcome
