"""``mirrorskin calibrate show``: numbers on the screen, pictures in a folder."""

import io as texts
import json
import re
import sys

import pytest
from calibrations import a_calibration
from commands import done, run

from mirrorskin import io
from mirrorskin.cli.commands.calibrate import show
from mirrorskin.cli.groups import make_command


class Terminal(texts.StringIO):
    """Where somebody looks at what is printed."""

    def isatty(self):
        return True


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "cal.h5"
    io.save_calibration(a_calibration(), path)
    return path


def test_a_calibration_is_printed_in_a_table(saved):
    ended = done("calibrate show", saved)
    head, *lines = ended.out.splitlines()
    assert head.split() == ["part", "what", "value", "standard", "error", "unit"]
    assert {line.split()[0] for line in lines} == {
        "camera",
        "references",
        "scale",
        "zenith",
        "tilt",
        "elastic",
        "force",
        "self",
    }
    (angle,) = (line for line in lines if "half-angle" in line)
    assert angle.split() == ["tilt", "half-angle", "2.2918", "0.0057", "deg"]


def test_a_terminal_gets_a_table_without_repeated_words(saved, monkeypatch):
    terminal = Terminal()
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setattr(sys, "stdout", terminal)
    make_command(None, show.command)([str(saved)], standalone_mode=False)
    shown = re.sub("\x1b.*?m", "", terminal.getvalue())
    lines = [line.split() for line in shown.splitlines()]
    assert ["tilt", "half-angle", "2.2918", "0.0057", "deg"] in lines
    assert ["pivot", "z", "12.00", "0.30", "mm"] in lines
    assert sum("tilt" in line for line in lines) == 1


def test_machines_get_numbers_and_how_they_came_about(saved):
    report = json.loads(run("calibrate show", saved, "--json").out)
    by_name = {(row["part"], row["what"]): row for row in report["numbers"]}
    assert by_name["tilt", "pivot z"] == {
        "part": "tilt",
        "what": "pivot z",
        "value": 12.0,
        "sigma": 0.3,
        "unit": "mm",
        "name": "pivot_z",
    }
    assert by_name["scale", "distortion k1"]["sigma"] is None
    assert report["process"]["tilt.frames"] == 8
    assert report["pictures"] == []


def test_pictures_go_into_a_folder(tmp_path):
    path, folder = tmp_path / "cal.h5", tmp_path / "pictures"
    io.save_calibration(a_calibration(only=("precession",)), path)
    ended = done("calibrate show", path, "-o", folder)
    assert ended.out.endswith(f"{folder}: tilt.png\n")
    assert [path.name for path in folder.iterdir()] == ["tilt.png"]
