"""Runs, old ones included, are read as they were written; anything else is refused in one line."""

import json
from pathlib import Path

import pytest
from bench_runs import case, row, run, save, target

from mirrorskin.cli.commands.bench import TABLE
from mirrorskin.cli.commands.bench.records import open_run
from mirrorskin.io import InputError

COMMITTED = sorted((Path(__file__).parents[2] / "bench" / "results").glob("*.json"))
SOUND = run(
    case(
        "one",
        row("read limit", 0.1, moved=1000, kernel=0.08),
        row("mirrorskin", 0.2, moved=1000, kernel=0.15),
        targets=(target("as fast as can be", True),),
    )
)


def test_a_run_is_read_as_it_was_written(tmp_path):
    assert open_run(save(SOUND, tmp_path / "run.json")) == SOUND


@pytest.mark.parametrize("path", COMMITTED, ids=lambda path: path.stem)
def test_the_committed_runs_are_readable(path):
    run_read = open_run(path)
    assert run_read.cases
    written = json.loads(path.read_text(encoding="utf-8"))
    for mine, theirs in zip(run_read.cases, written["cases"], strict=True):
        assert [row_read.what for row_read in mine.targets] == [
            row_read["what"] for row_read in theirs.get("targets", [])
        ]
        assert list(mine.notes) == theirs.get("notes", [])
        for row_read, other in zip(mine.rows, theirs["rows"], strict=True):
            assert (row_read.name, row_read.bytes, row_read.wall.median) == (
                other["name"],
                other["bytes"],
                other["wall"]["median"],
            )
            if row_read.bytes and other.get("share") is not None:  # as older runs state it
                assert mine.share(row_read) == pytest.approx(other["share"])


def test_the_table_of_the_package_has_the_cases_that_the_command_measures():
    table = open_run(TABLE)
    assert [case.name for case in table.cases] == ["limits", "onset", "correlation", "integration"]
    assert not table.quick


def refused(path):
    """Return the one line that a file is refused with."""
    with pytest.raises(InputError) as caught:
        open_run(path)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert "\n" not in message
    return message


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "input data was truncated"),
        (b"# a page\n", "the JSON is malformed"),
        (b"\x89PNG\r\n\xff\xfe", "is not text"),
        (b'{"date": NaN}', "JSON is malformed"),
        (b"[" * 100_000, "expected `object`, got `array`"),
        (b'{"cases": ' + b"[" * 100_000, "expected `object`, got `array`"),
        (b"[]", "expected `object`, got `array`"),
        (b"3", "expected `object`, got `int`"),
        (b"{}", "missing required field `date`"),
    ],
)
def test_what_is_not_a_run_is_refused(tmp_path, content, message):
    path = tmp_path / "other.json"
    path.write_bytes(content)
    assert message in refused(path)


def test_a_file_that_is_not_there_or_is_a_folder_is_refused(tmp_path):
    assert "cannot be read: No such file" in refused(tmp_path / "none.json")
    assert "cannot be read: Is a directory" in refused(tmp_path)


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (("device",), "a GPU", "expected `object`, got `str` - at `$.device`"),
        (("device", "driver"), None, "expected `str`, got `null` - at `$.device.driver`"),
        (("threads",), True, "expected `int`, got `bool` - at `$.threads`"),
        (("commit",), 7, "expected `str | null`, got `int` - at `$.commit`"),
        (("quick",), 0, "expected `bool`, got `int` - at `$.quick`"),
        (("versions", "numpy"), 2, "at `$.versions[...]`"),
        (("cases",), {}, "expected `array`, got `object` - at `$.cases`"),
        (("cases", 0, "absent"), [], "at `$.cases[0].absent`"),
        (("cases", 0, "notes"), [1], "at `$.cases[0].notes[0]`"),
        (("cases", 0, "targets", 0, "met"), "yes", "at `$.cases[0].targets[0].met`"),
        (("cases", 0, "rows", 1, "wall", "median"), 0, "is not positive - at `$.cases[0].rows[1]`"),
        (("cases", 0, "rows", 0, "device", "kernel"), 1.0, "at `$.cases[0].rows[0].device[...]`"),
        (("cases", 0, "rows", 0, "first"), 10**400, "rows[0].first"),
    ],
)
def test_what_is_not_of_its_type_is_named(tmp_path, place, value, message):
    data = json.loads(SOUND.as_json())
    holder = data
    for step in place[:-1]:
        holder = holder[step]
    holder[place[-1]] = value
    path = tmp_path / "run.json"
    path.write_text(json.dumps(data), encoding="utf-8")
    assert message in refused(path)


def test_what_is_missing_is_named(tmp_path):
    data = json.loads(SOUND.as_json())
    del data["cases"][0]["rows"][1]["wall"]["upper"]
    path = tmp_path / "run.json"
    path.write_text(json.dumps(data), encoding="utf-8")
    assert "missing required field `upper` - at `$.cases[0].rows[1].wall`" in refused(path)
