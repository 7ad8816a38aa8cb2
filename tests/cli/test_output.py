"""Output of commands besides their results."""

import io
import subprocess
import sys
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
from commands import run

from mirrorskin.cli.output import print_fields, printable, report_missing_maps


@pytest.mark.parametrize(
    ("process", "message"),
    [
        (
            {"height": "none: the recording has no pixel size"},
            "a.h5: no height: the recording has no pixel size; give it",
        ),
        ({"height": "made"}, ""),
        ({"gel": "none: the calibration has no gel"}, ""),
        (
            {"gel": "none: nothing turned light"},
            "a.h5: heights not corrected for the gel: nothing turned light",
        ),
        (
            {"gel": "corrected for the gel; 3 pixels more"},
            "a.h5: heights corrected for the gel; 3 pixels more",
        ),
    ],
)
def test_what_is_missing_and_what_a_gel_did_is_printed_in_a_line(process, message, capsys):
    report_missing_maps("a.h5", process, {"height": "it"})
    assert capsys.readouterr() == ("", f"{message}\n" if message else "")


def test_no_text_of_a_file_steers_the_terminal_or_forges_a_line(capsys):
    print_fields({"title": "a\x1b[2J\x07b\nkind  result\u202e"})
    assert capsys.readouterr().out == "title  a?[2J?b?kind  result?\n"


ESCAPE = "\x1b]0;owned\x07\x1b[2J\x9b31m\u202e"


def odd_texts(path):
    """Write a recording in whose texts and names codes stand that control terminals."""
    assert run("simulate vertical --size 8x8 --frames 4 -o", path).code == 0
    with h5py.File(path, "r+") as file:
        del file["entry/title"]
        file["entry/title"] = f"a{ESCAPE}\nkind  result"
        file[f"entry/{ESCAPE}"] = 1.0
    return path


@pytest.mark.parametrize(
    "words",
    [
        ["info", "{}"],
        ["info", "{}", "--json"],
        ["reconstruct", "{}", "-o", f"a{ESCAPE}.h5"],
        ["reconstruct", "{}", "-o", "a.h5", "--dataset", f"/{ESCAPE}"],
        ["reconstruct", "{}", "-o", "a.h5", "--object", ESCAPE],
        ["export", "{}", "-o", f"a{ESCAPE}.mcap"],
        ["info", f"gone{ESCAPE}.h5"],
        ["import", "pictures", "--motion", "vertical", "--travel-step", "0.1mm", "-o", "a.h5"],
        ["batch", "{}", "-o", "results"],
        ["calibrate", "show", "{}"],
    ],
    ids=lambda words: " ".join(words[:2]).encode("ascii", "replace").decode().replace("\x1b", ""),
)
def test_no_message_controls_the_terminal(tmp_path, words):
    odd = odd_texts(tmp_path / f"odd{ESCAPE}.h5")
    Path("pictures").mkdir()
    for name in ("frame1.png", "frame2.png", f"other{ESCAPE}.png"):
        cv2.imwrite(str(Path("pictures", name)), np.zeros((8, 8), np.uint8))
    ended = run(*(odd if word == "{}" else word for word in words))
    assert ended.out + ended.said
    for line in (ended.out + ended.said).splitlines():
        assert line.isprintable(), line


def test_what_is_logged_does_not_control_the_terminal():
    program = (
        "import logging, sys; from mirrorskin.cli import main; sys.argv = ['mirrorskin', 'info', 'no.h5'];"
        "import atexit; atexit.register(lambda: logging.getLogger('x').warning('a\\x1b[2Jb')); main.program()"
    )
    process = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert process.stderr.splitlines()[-1] == "a?[2Jb"


def test_what_the_encoding_of_a_terminal_lacks_is_written_in_ascii(monkeypatch):
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(io.BytesIO(), encoding="ascii"))
    assert printable("5.00 ± 0.01 µm²") == "5.00 +- 0.01 um^2"
    assert printable("五円") == "??"
