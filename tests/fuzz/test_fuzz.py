"""Some hundred damaged files; ``make fuzz`` continues for an hour."""

from pathlib import Path

import fuzz
import pytest

COUNT = 150  # files; some tenths of a second each
LAYOUTS = Path(__file__).parents[1] / "io" / "layouts"
STRUCTURES = (b"OHDR", b"OCHK", b"GCOL", b"TREE", b"HEAP", b"SNOD", b"FRHP", b"FADB", b"FAHD", b"EAHD")
"""What HDF5 begins its structures with."""


@pytest.fixture(autouse=True)
def patience(monkeypatch):
    monkeypatch.setattr(fuzz, "PATIENCE", 120.0)  # for a busy machine, on which the reader begins late


def test_a_file_that_is_cut_short_is_refused(tmp_path):
    reader, mutant = fuzz.Reader(), tmp_path / "mutant.h5"
    outcomes = {}
    for path in sorted(LAYOUTS.glob("*.h5")):
        whole = path.read_bytes()
        for length in (0, 7, 100, len(whole) // 2, len(whole) - 1):
            mutant.write_bytes(whole[:length])
            outcomes[path.name, length] = reader.read(mutant)
    reader.close()
    assert len(outcomes) >= 40
    assert set(outcomes.values()) == {"refused"}, outcomes


def test_a_structure_that_lies_is_read_or_refused_in_one_line(tmp_path):
    reader, mutant = fuzz.Reader(), tmp_path / "mutant.h5"
    outcomes = {}
    for path in sorted(LAYOUTS.glob("*.h5")):
        whole = path.read_bytes()
        for mark in STRUCTURES:
            at = whole.find(mark)
            for wrong in (b"\x00", b"\xff") if at >= 0 else ():
                mutant.write_bytes(whole[: at + 8] + 8 * wrong + whole[at + 16 :])
                outcomes[path.name, mark, wrong] = reader.read(mutant)
    reader.close()
    assert len(outcomes) >= 30
    assert set(outcomes.values()) <= {"read", "refused"}, outcomes


@pytest.mark.slow
def test_damaged_files_are_read_or_refused_in_one_line(tmp_path):
    (tmp_path / "samples").mkdir()
    samples = fuzz.make_samples(tmp_path / "samples")
    outcomes = list(fuzz.attack(samples, 1, lambda number: number < COUNT, tmp_path / "findings"))
    assert len(outcomes) == COUNT
    assert [outcome for outcome in outcomes if outcome[1] not in ("read", "refused")] == []


@pytest.mark.parametrize(
    ("does", "outcome", "patience"), [("os._exit(3)", "crash 3", 60.0), ("time.sleep(60)", "hang", 1.0)]
)
def test_a_reader_that_dies_or_hangs_is_seen(tmp_path, monkeypatch, does, outcome, patience):
    program = tmp_path / "program.py"
    program.write_text(f"import os, time; input(); {does}")
    monkeypatch.setattr(fuzz, "__file__", str(program))
    monkeypatch.setattr(fuzz, "PATIENCE", patience)
    assert fuzz.Reader().read(tmp_path) == outcome
