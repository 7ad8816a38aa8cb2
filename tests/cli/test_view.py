"""``mirrorskin view``: pictures of a result, in a window, in a file or in a folder."""

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from commands import run
from shown import ball

from mirrorskin import io
from mirrorskin.cli.commands import view as command
from mirrorskin.cli.groups import make_command
from mirrorskin.view.drawing import canvas

app = make_command(None, command.command)


@pytest.fixture
def result(tmp_path, monkeypatch):
    """The path of a result, and no screen."""
    monkeypatch.setattr(canvas, "has_screen", lambda: False)
    path = tmp_path / "ball.h5"
    io.save_result(ball(), path)
    return path


def view(*words):
    return CliRunner().invoke(app, [str(word) for word in words])


def made(result):
    """Return what lies beside a result now."""
    return sorted(str(path.relative_to(result.parent)) for path in result.parent.rglob("*.png"))


def test_without_a_screen_a_picture_is_next_to_the_result(result):
    ended = view(result, "--map", "status")
    assert ended.exit_code == 0, ended.output
    assert "no screen" in ended.stderr
    assert ended.stdout == f"written to {result.with_name('ball-view.png')}\n"
    assert made(result) == ["ball-view.png"]
    assert cv2.imread(str(result.with_name("ball-view.png"))).shape[0] > 300


def test_with_a_screen_all_is_in_one_window_and_nothing_is_written(result, monkeypatch):
    shown = []
    monkeypatch.setattr(canvas, "has_screen", lambda: True)
    monkeypatch.setattr(canvas, "show_figure", lambda figure, title: shown.append((figure, title)))
    assert view(result).exit_code == 0
    ((figure, title),) = shown
    assert title == "ball.h5"
    assert len(figure.axes) == 8
    assert made(result) == []


@pytest.mark.parametrize(("suffix", "head"), [("pdf", b"%PDF"), ("SVG", b"<?xml")])
def test_a_picture_of_lines_is_the_same_each_time(result, suffix, head):
    path = result.with_name(f"a.{suffix}")
    drawn = []
    for _ in range(2):
        assert view(result, "--map", "height", "-o", path).exit_code == 0
        drawn.append(path.read_bytes())
    assert drawn[0].startswith(head)
    assert drawn[0] == drawn[1]
    if suffix == "SVG":  # texts can be searched
        assert b">height</text>" in drawn[0].lower()


def test_a_folder_gets_a_picture_of_each_map(result):
    folder = result.parent / "new" / "pictures"
    ended = view(
        result, "-o", folder, "--map", "section", "--map", "status", "--section", "-1mm,0mm:1mm,0.1mm"
    )
    assert ended.exit_code == 0, ended.output
    assert made(result) == ["new/pictures/section.png", "new/pictures/status.png"]
    assert ended.stdout.count("written to") == 2


def test_of_turns_one_is_chosen_and_a_picture_s_ending_may_be_in_capitals(result):
    azimuth = np.zeros((2, 5, 6), np.float32)
    io.save_result(io.Result(azimuth=azimuth), result, overwrite=True)
    assert "--turn 0 to 1" in str(view(result).exception)
    path = result.with_name("TURN.PNG")
    ended = view(result, "--turn", 1, "-o", path)
    assert ended.exit_code == 0, ended.output
    assert cv2.imread(str(path)).shape[0] > 300
    assert sorted(result.parent.iterdir()) == [path, result]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--map", "heigt"], "ball.h5 has no picture heigt: did you mean height?"),
        (["-o", "{}"], "name a picture that ends in .png or .pdf or .svg, or a folder"),
        (["-o", "a.jpg"], "name a picture that ends in .png or .pdf or .svg, or a folder"),
        (["-o", "nowhere/a.png"], "no folder"),
        (["-o", "{}/folder"], "ball.h5 is not a folder. Use another -o"),
        (
            ["-o", "a.png/folder", "--map", "nothing"],
            "has no picture nothing: it has height, section",
        ),
        (["--section", "1mm,0mm"], "two points are needed"),
        (["--section", "0.9mm,0.9mm:1mm,1mm"], "no height is known along the section"),
        (["--turn", "0"], "leave --turn out"),
    ],
)
def test_impossible_input_is_one_clear_line(result, monkeypatch, words, message):
    monkeypatch.chdir(result.parent)
    before = result.read_bytes()
    ended = view(result, *(word.format(result) for word in words))
    assert isinstance(ended.exception, io.InputError), ended.output
    assert message in str(ended.exception)
    assert "\n" not in str(ended.exception)
    assert result.read_bytes() == before
    assert made(result) == []


def test_a_picture_is_not_written_over_a_result_that_is_called_like_one(result):
    sly = result.rename(result.with_suffix(".png"))
    assert "is the input" in str(view(sly, "-o", sly).exception)
    assert io.open_result(sly).height is not None


def test_without_matplotlib_the_remedy_is_named(result, monkeypatch):
    monkeypatch.setattr("mirrorskin.view.drawing.canvas.find_spec", lambda name: None)
    assert "pip install 'mirrorskin[view]'" in str(view(result).exception)


def test_the_help_names_the_lists_of_maps():
    help_text = " ".join(view("--help").output.split())
    assert all(text in help_text for text in ("mirrorskin info", "section", "histogram"))


@pytest.mark.parametrize("name", [r"$\frac{$", "$x$ $", "\x1b[2J\x07", "\u5de5\u5177"])
def test_a_name_that_is_a_formula_or_a_control_code_is_a_title_like_any_other(tmp_path, name):
    result = tmp_path / f"{name}.h5"
    io.save_result(ball(), result)
    ended = run("view", result, "--map", "status", "-o", tmp_path / "a.png")
    assert (ended.code, ended.said) == (0, "")
