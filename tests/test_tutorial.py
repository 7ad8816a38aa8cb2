"""The commands of the tutorial run in its order, on photographs like those described."""

import re
import shlex
from pathlib import Path

import cv2
import numpy as np
import pytest
from commands import done

from mirrorskin import io

PAGE = (Path(__file__).parents[1] / "docs" / "tutorial.md").read_text(encoding="utf-8")
BLOCK = re.compile(r"^```(sh|python)\n(.*?)^```", re.DOTALL | re.MULTILINE)
BLOCKS = BLOCK.findall(PAGE)
AZIMUTHS = [178.1, 220.8, 280.5, 316.5, 7.6, 48.0, 96.3, 136.4]  # degrees


@pytest.fixture
def photographs(tmp_path, monkeypatch):
    """A flat body with a bump before a dark background, under eight lamps of different brightness."""
    monkeypatch.chdir(tmp_path)
    rows, columns = np.indices((90, 120))
    x, y = (columns - 60) / 20, (45 - rows) / 20
    height = 1.2 * np.exp(-(x**2 + y**2))
    normals = np.dstack([2 * x * height, 2 * y * height, np.ones_like(x)])
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    body = (np.abs(x) < 2.2) & (np.abs(y) < 1.8)
    rng, zenith, brightness = np.random.default_rng(0), np.radians(30), 1 + 0.1 * np.sin(np.arange(8) * 2.4)
    for number, (azimuth, bright) in enumerate(zip(np.radians(AZIMUTHS), brightness, strict=True)):
        lamp = [np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)]
        light = 15 + 150 * bright * body * np.maximum(normals @ lamp, 0)
        picture = np.rint(light + rng.normal(0, 1, light.shape)).clip(0, 255).astype(np.uint8)
        assert cv2.imwrite(f"image{number}.png", picture)
    assert cv2.imwrite("image_ambient.png", np.full(rows.shape, 15, np.uint8))


def shell(line):
    """Run a line of the page's shell blocks."""
    words = shlex.split(line)
    if words[0] == "echo":
        *text, arrow, name = words[1:]
        assert arrow == ">"
        Path(name).write_text(" ".join(text) + "\n")
    else:
        assert words[0] == "mirrorskin"
        done(shlex.join(words[1:]))


def test_the_tutorial_leads_to_a_surface(photographs, capsys):
    names = {}
    for kind, text in BLOCKS:
        if kind == "python":
            exec(text, names)
        elif "git clone" not in text:
            for line in text.splitlines():
                shell(line)
    printed = capsys.readouterr().out
    (section,) = re.findall(r"^## 2\..*?(?=^## )", PAGE, re.DOTALL | re.MULTILINE)
    maps = re.findall(r"`([a-z_]+)`", BLOCK.sub("", section))
    assert maps
    assert set(maps) <= set(io.open_result("facing.h5"))
    angles = re.findall(r"they differ by (\S+) degrees, expected (\S+)", printed)
    (before, expected_before), (after, expected_after) = (map(float, pair) for pair in angles)
    assert before > 1.5 * expected_before
    assert after == pytest.approx(expected_after, rel=0.2)
    assert Path("butterfly.stl").stat().st_size > 1000
