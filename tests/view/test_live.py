import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from mirrorskin.engine.live import SHOWN, Latency, Status, Update
from mirrorskin.io import InputError, Map, Result
from mirrorskin.view import live, viewer

SHAPE = (5, 8)
DECLARED = {
    "wear": Map("depth of the wear", "mm", title="Worn", displayed="µm"),
    "contact_area": Map(unit="mm²", axes="none"),
}


def update(frames=1, **maps):
    picture = np.arange(40, dtype=np.uint16).reshape(SHAPE)
    return Update(frames, frames / 30, "vertical", 0.1, picture, Result(maps, declarations=DECLARED))


def known():
    height = np.full(SHAPE, -1.0, np.float32)
    height[:, 3] = np.nan
    normals = np.zeros((*SHAPE, 3), np.float32)
    normals[..., 2] = 1
    wear = np.full(SHAPE, 0.002, np.float32)
    return update(2, height=height, normals=normals, wear=wear, contact_area=3.5)


STATUS = Status(2, 2, 0, 0, 2, 0.1, 30.0, {SHOWN: Latency(0.01, 0.02)})


def test_a_section_has_a_line_for_each_piece_and_runs_up():
    height = np.full((3, 7), np.nan, np.float32)
    height[1] = [np.nan, 1, 2, np.nan, 5, np.nan, 7]  # a single pixel is no line
    (piece,) = live.section(height, np.arange(7.0))
    assert piece.tolist() == [[1, -1], [2, -2]]


def test_a_section_of_nothing_is_empty():
    assert live.section(np.full((3, 7), np.nan, np.float32), np.arange(7.0)) == []


def test_colours_of_a_height_do_not_change_when_others_come():
    colours = live._Range()
    first = colours.colour(np.array([[0.0, 1.0]], np.float32))
    again = colours.colour(np.array([[0.0, 0.5, np.nan]], np.float32))
    assert (again[0, 0] == first[0, 0]).all()
    assert again[0, 2].tolist() == [176, 196, 222]
    assert (colours.colour(np.full((2, 2), 0.5, np.float32)) == again[0, 1]).all()


@pytest.mark.parametrize("value", [0.0, 7.0, np.nan])
def test_a_picture_that_is_all_equal_has_a_colour(value):
    assert live._Range().colour(np.full((2, 3), value, np.float32)).shape == (2, 3, 3)


def test_a_file_keeps_all_that_was_shown(tmp_path):
    path = tmp_path / "run.rrd"
    view = live.LiveView(path, SHAPE, (0.03, 0.03))
    view.show(update(), Status())
    view.show(known(), STATUS)
    view.close()
    command = [sys.executable, "-m", "rerun_cli", "rrd", "print", str(path)]
    text = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    for name in ("/camera", "/maps/height", "/maps/normals", "/maps/wear", "/section/surface", "/status"):
        assert name in text


def test_the_display_is_described_in_words(tmp_path):
    view = live.LiveView(tmp_path / "run.rrd", SHAPE)
    view.show(known(), STATUS)
    text = view._status_text(known(), STATUS)
    view.close()
    assert "30.0 frames/s" in text
    assert "10.0 ms, 99 % below 20.0 ms" in text
    assert "Height from -1.000 (violet) to -1.000 mm (yellow)" in text
    assert "Worn from 2.000 (violet) to 2.000 µm (yellow)" in text
    assert "Contact area 3.5 mm²" in text


def test_a_viewer_in_the_browser_listens_on_this_machine_only(monkeypatch):
    started = []
    popen = subprocess.Popen

    def start(words, **options):
        words = ["--serve-web" if word == "--web-viewer" else word for word in words]  # no browser in a test
        started.append((words, popen(words, **options)))
        return started[-1][1]

    monkeypatch.setattr(viewer.subprocess, "Popen", start)
    view = live.LiveView(viewer.BROWSER, SHAPE)
    (words, process), begun = started[0], time.monotonic()
    try:
        view.show(known(), STATUS)
        view.close()
        assert time.monotonic() - begun < 60
        assert words[words.index("--bind") + 1] == "127.0.0.1"
        assert process.poll() is None  # it stays open for its user
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def test_a_viewer_that_does_not_start_has_a_remedy(monkeypatch):
    monkeypatch.setattr(viewer.sys, "executable", "false")
    with pytest.raises(InputError, match=r"does not start here: take --view browser, or --view FILE.rrd"):
        live.LiveView(viewer.WINDOW, SHAPE)


def test_an_impossible_file_is_refused(tmp_path):
    with pytest.raises(InputError, match="no folder"):
        live.LiveView(tmp_path / "there" / "run.rrd", SHAPE)


def test_without_rerun_a_remedy_is_reported(monkeypatch, tmp_path):
    monkeypatch.setattr(viewer, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install 'mirrorskin\[live\]'"):
        live.LiveView(tmp_path / "run.rrd", SHAPE)
