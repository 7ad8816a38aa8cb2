"""The demo: the paper's figures, here with few pixels and frames."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from commands import done, refused, run, small_presses, small_turn

from mirrorskin import io, view
from mirrorskin.cli.commands import demo
from mirrorskin.view.drawing import canvas

FIGURES = "fig5", "fig6", "fig10a", "fig10b", "fused", "touch"
PRESSED = "sub-frame", "eq. 4"
TURNED = "paper", "exact", "exact, registered"
HEIGHTS = [
    *(["fig5", method] for method in PRESSED),
    *(["fig6", method] for method in PRESSED),
    ["fig10b", "rotation, registered"],
    ["fig10b", "rotation"],
    ["fused", "press"],
    ["fused", "press and rotation"],
    ["touch", "press"],
    ["touch", "touch"],
]


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(demo, "PRESSES", small_presses())
    monkeypatch.setattr(demo, "TURN", small_turn())
    monkeypatch.setattr(canvas, "_DPI", 40)  # nobody reads them here


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """The lines that a small demo printed, and the folder that it wrote."""
    folder = tmp_path_factory.mktemp("demo") / "made"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demo, "PRESSES", small_presses())
        patch.setattr(demo, "TURN", small_turn())
        patch.setattr(canvas, "_DPI", 40)
        ended = run("demo -o", folder)
    assert ended.code == 0, ended.said
    steps = ended.said.splitlines()
    assert [step.split(":")[0] for step in steps if step[0] != " "] == [f"{n} of 5" for n in range(1, 6)]
    assert [step for step in steps if "simulating" in step] == [
        f"  simulating the sensor: {name}.h5" for name in ("fig5", "fig6", "fig10a")
    ]
    assert len([step for step in steps if "reconstructing" in step]) == 2 * len(PRESSED) + len(TURNED)
    assert steps[-len(FIGURES) :] == [f"  drawing {name}.png" for name in FIGURES]
    return ended.out.splitlines(), folder


def test_recordings_results_and_figures_are_kept(shown):
    _, folder = shown
    files = {f"{name}{end}" for name in ("fig5", "fig6") for end in (".h5", "-result.h5")}
    files |= {"fig10a.h5", "fused-result.h5", "touch.h5", "touch-result.h5"} | {
        f"{name}.png" for name in FIGURES
    }
    files |= {f"fig10a-{method.replace(', ', '-')}-result.h5" for method in TURNED}
    assert {path.name for path in folder.iterdir()} == files
    for name in FIGURES:
        assert cv2.imread(str(folder / f"{name}.png")).shape[0] > 100


def test_the_table_of_heights_has_each_figure_and_method(shown):
    lines, folder = shown
    head, *rows = (cells(line) for line in lines[: 1 + len(HEIGHTS)])
    assert head == ["figure", "method", "answered", "RMS", "mean", "99 %", "filled", "RMS of filled"]
    assert [row[:2] for row in rows] == HEIGHTS
    by_figure = {
        tuple(row[:2]): dict(zip(head[2:7], (float(cell.split()[0]) for cell in row[2:7]), strict=True))
        for row in rows
    }
    for values in by_figure.values():
        assert values["answered"] > 50
        assert abs(values["mean"]) <= values["RMS"] < 1000
        assert values["99 %"] > 0
    for figure, step in (("fig5", 0.375), ("fig6", 0.225)):
        assert by_figure[figure, "sub-frame"]["answered"] == by_figure[figure, "eq. 4"]["answered"]
        assert by_figure[figure, "sub-frame"]["RMS"] < by_figure[figure, "eq. 4"]["RMS"]
        assert by_figure[figure, "eq. 4"]["mean"] < -0.3e3 * step
    assert by_figure["fig10b", "rotation, registered"]["filled"] == 0
    both = by_figure["fused", "press and rotation"]
    result = io.open_result(folder / "fused-result.h5")
    assert both["filled"] == np.count_nonzero(result.filled) > 0
    assert both["RMS"] < by_figure["fused", "press"]["RMS"]
    legend = " ".join(lines[1 + len(HEIGHTS) : lines.index("")])
    for word in ("answered", "filled", "registered"):
        assert f"{word}: " in legend


def test_the_table_of_normals_has_both_methods_and_registration(shown):
    lines, _ = shown
    start = next(number for number, line in enumerate(lines) if "lost and flagged" in line)
    head, rows = cells(lines[start]), [cells(line) for line in lines[start + 1 : start + 4]]
    assert [row[:2] for row in rows] == [["fig10a", method] for method in TURNED]
    by_method = {
        row[1]: dict(zip(head[2:7], (float(cell.split()[0]) for cell in row[2:7]), strict=True))
        for row in rows
    }
    assert [row[7:] == ["-", "-"] for row in rows] == ["registered" in method for method in TURNED]
    for values in by_method.values():
        assert 20 < values["answered"] <= 100
        assert 0 < values["median"] <= values["RMS"] <= values["99 %"] < 120
    assert by_method["exact, registered"]["median"] < by_method["exact"]["median"]
    legend = " ".join(lines[start + 4 : -1])
    for word in ("answered", "chi2"):
        assert f"{word}: " in legend
    assert lines[-1].endswith("fig5.png")
    assert max(map(len, lines[:-1])) <= 110


def cells(row):
    return [cell.strip() for cell in row.split("  ") if cell.strip()]


@pytest.mark.slow
def test_json_has_the_scores_of_each_figure_and_method(small, tmp_path, monkeypatch):
    for figure in ("height", "normal", "surface"):
        monkeypatch.setattr(view, f"{figure}_figure", lambda *arguments, **style: None)
    scores = json.loads(run("demo -o", tmp_path, "--json").out)
    assert list(scores) == list(FIGURES)
    assert list(scores["fig6"]) == list(PRESSED)
    assert 0 < scores["fig6"]["sub-frame"]["height"]["rms"] < scores["fig6"]["eq. 4"]["height"]["rms"]
    assert list(scores["fig10a"]) == list(TURNED)
    assert scores["fig10a"]["exact"]["normal"]["rms"] > 0
    rms = {name: score["height"]["rms"] for name, score in scores["fused"].items()}
    assert 0 < rms["press and rotation"] < rms["press"]


def test_a_folder_that_cannot_be_made_is_one_line(tmp_path):
    (tmp_path / "file").touch()
    message = refused("the folder cannot be created", "demo -o", tmp_path / "file" / "demo")
    assert "Choose another with -o" in message


def test_without_matplotlib_nothing_is_computed(tmp_path, monkeypatch):
    monkeypatch.setattr("mirrorskin.view.drawing.canvas.find_spec", lambda name: None)
    refused("pip install 'mirrorskin", "demo -o", tmp_path / "demo")
    assert not (tmp_path / "demo").exists()


@pytest.mark.slow
def test_the_page_of_the_twin_shows_what_the_demo_prints(tmp_path):
    page = (Path(__file__).parents[2] / "docs" / "twin.md").read_text(encoding="utf-8")
    tables = re.findall(r"^```\n(figure .*?)^```", page, re.DOTALL | re.MULTILINE)
    printed = done("demo -o", tmp_path / "demo").out
    shown = "".join(tables).split()
    for word, expected in zip(printed.replace("\n\n", "\n").split()[: len(shown)], shown, strict=True):
        number = re.fullmatch(r"[+-]?\d+(\.\d+)?", expected)
        if number is None:
            assert word == expected
        else:  # other processors round differently
            last_digit = 10.0 ** -len((number[1] or ".")[1:])
            assert float(word) == pytest.approx(float(expected), rel=0.01, abs=1.01 * last_digit)


@pytest.mark.slow
def test_the_pictures_of_the_documentation_are_those_that_the_demo_draws(tmp_path):
    pictures = Path(__file__).parents[2] / "docs" / "images"
    done("demo -o", tmp_path / "demo")
    for name in FIGURES:
        drawn, shown = (cv2.imread(str(folder / f"{name}.png")) for folder in (tmp_path / "demo", pictures))
        assert drawn.shape == shown.shape, name
        assert np.abs(drawn.astype(int) - shown).mean() < 0.3, f"{name}: copy that of 'make demo'"
