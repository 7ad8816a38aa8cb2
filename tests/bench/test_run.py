"""Runs are read again as they were written, old ones too; anything else is refused in one line."""

import copy
import json
from pathlib import Path

import pytest
from bench_runs import case, row, run, save, target

from mirrorskin.bench.run import open_run
from mirrorskin.io import InputError

COMMITTED = sorted((Path(__file__).parents[2] / "bench" / "results").glob("*.json"))
SOUND = run(
    case(
        "one",
        row("read limit", 0.1, moved=1000, kernel=0.08, share=1.0),
        row("mirrorskin", 0.2, moved=1000, kernel=0.15, share=0.5),
        targets=(target("as fast as can be", True),),
    )
)


def test_a_run_is_read_as_it_was_written(tmp_path):
    assert open_run(save(SOUND, tmp_path / "run.json")) == SOUND


@pytest.mark.parametrize("path", COMMITTED, ids=lambda path: path.stem)
def test_the_committed_runs_are_readable(path):
    found = open_run(path)
    assert found["cases"]
    written = json.loads(path.read_text(encoding="utf-8"))
    for mine, theirs in zip(found["cases"], written["cases"], strict=True):
        assert mine["targets"] == theirs.get("targets", [])
        assert mine["notes"] == theirs.get("notes", [])
        for one, other in zip(mine["rows"], theirs["rows"], strict=True):
            assert one == {"operations": 0, "moved": {}, **other}


def refused(path):
    """Return the one line that a file is refused with."""
    with pytest.raises(InputError) as caught:
        open_run(path)
    said = str(caught.value)
    assert said.startswith(str(path))
    assert "\n" not in said
    return said


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "is no JSON"),
        (b"# a page\n", "is no JSON"),
        (b"\x89PNG\r\n\xff\xfe", "is no JSON"),
        (b'{"date": NaN}', "is no JSON"),
        (b"[" * 100_000, "is no JSON"),
        (b"[]", "it is not an object"),
        (b"3", "it is not an object"),
        (b"{}", "date is missing"),
    ],
)
def test_what_is_no_run_is_refused(tmp_path, content, said):
    path = tmp_path / "other.json"
    path.write_bytes(content)
    assert said in refused(path)


def test_a_file_that_is_not_there_or_is_a_folder_is_refused(tmp_path):
    assert "cannot be read: No such file" in refused(tmp_path / "none.json")
    assert "cannot be read: Is a directory" in refused(tmp_path)


@pytest.mark.parametrize(
    ("place", "value", "said"),
    [
        (("device",), "a GPU", "device is not an object"),
        (("device", "driver"), None, "device.driver is not a text"),
        (("threads",), True, "threads is not a number"),
        (("commit",), 7, "commit is not a text or null"),
        (("quick",), 0, "quick is not true or false"),
        (("versions", "numpy"), 2, "versions.numpy is not a text or null"),
        (("cases",), {}, "cases is not a list"),
        (("cases", 0, "absent"), [], "cases[0].absent is not an object"),
        (("cases", 0, "notes"), [1], "cases[0].notes[0] is not a text"),
        (("cases", 0, "targets", 0, "met"), "yes", "cases[0].targets[0].met is not true or false"),
        (("cases", 0, "rows", 1, "wall", "median"), 0, "rows[1].wall.median is not a positive number"),
        (("cases", 0, "rows", 1, "share"), "half", "rows[1].share is not a number or null"),
        (("cases", 0, "rows", 0, "device", "kernel"), 1.0, "rows[0].device.kernel is not an object"),
        (("cases", 0, "rows", 0, "first"), 10**400, "rows[0].first is not a number"),
    ],
)
def test_what_is_not_of_its_kind_is_named(tmp_path, place, value, said):
    data = copy.deepcopy(SOUND)
    holder = data
    for step in place[:-1]:
        holder = holder[step]
    holder[place[-1]] = value
    assert said in refused(save(data, tmp_path / "run.json"))


def test_what_is_missing_is_named(tmp_path):
    data = copy.deepcopy(SOUND)
    del data["cases"][0]["rows"][1]["wall"]["upper"]
    assert "cases[0].rows[1].wall.upper is missing" in refused(save(data, tmp_path / "run.json"))
