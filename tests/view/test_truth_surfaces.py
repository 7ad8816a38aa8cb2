"""The figure of one surface: its errors, and those of the sections, equal the result's."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from mirrorskin import io, view
from mirrorskin.view import truth as surfaces

SHAPE = (21, 31)
TRUE = np.fromfunction(lambda row, column: -0.01 * column - 0.001 * row, SHAPE).astype(np.float32)


def result_of(error=0.0, **maps):
    """Heights that are wrong by so many micrometres."""
    x, y = io.pixel_axes(SHAPE, (0.1, 0.1))
    height = np.asarray(TRUE + np.float32(1e-3) * np.asarray(error, np.float32), np.float32)
    return io.Result(height=height, x=x, y=y, **maps)


def truth():
    return io.Truth(TRUE, np.zeros_like(TRUE), np.zeros_like(TRUE), np.ones(SHAPE, np.uint8))


def figure_of(results):
    """Draw a figure, and return it."""
    kept = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(surfaces, "save_figure", lambda figure, title, path, resolution: kept.append(figure))
        view.surface_figure(results, truth(), "title", Path("a.png"))
    return kept[0]


def drawn(results):
    """Draw; return the axes of the surface, the map, the errors, the sections and their errors."""
    return [axes for axes in figure_of(results).axes if axes.get_label() != "<colorbar>"]


def note_of(axes):
    """Return the note below the title of a panel."""
    return axes.texts[0].get_text()


def shown(axes):
    return np.ma.filled(axes.get_images()[0].get_array(), np.nan)


def test_a_surface_becomes_a_picture(tmp_path):
    view.surface_figure({"one": result_of(1), "two": result_of(2)}, truth(), "title", tmp_path / "a.png")
    assert cv2.imread(str(tmp_path / "a.png")).shape[0] > 900


def test_the_last_is_drawn_as_a_whole_and_all_are_cut():
    whole, last_whole, errors, cuts, below = drawn({"first": result_of(5), "last": result_of(2)})
    assert whole.get_title("left") == "a  last"
    assert last_whole.get_title("left") == "b  height"
    np.testing.assert_array_equal(shown(last_whole), result_of(2).height)
    np.testing.assert_allclose(shown(errors), 2, atol=1e-3)
    assert [line.get_label() for line in cuts.get_lines()] == ["truth", "first", "last"]
    first, last = below.get_lines()[1:]
    np.testing.assert_allclose(first.get_ydata(), 5, atol=1e-3)
    np.testing.assert_allclose(last.get_ydata(), 2, atol=1e-3)
    assert [line.get_color() for line in (first, last)] == [line.get_color() for line in cuts.get_lines()[1:]]
    low, high = below.get_ylim()
    assert low < 2 < high


def test_red_is_too_high_and_the_title_contains_the_rms():
    error = np.where(np.arange(SHAPE[1]) < 15, 3.0, -3.0) * np.ones(SHAPE)
    _, _, errors, _, _ = drawn({"a": result_of(error)})
    picture = errors.get_images()[0]
    red, blue = (picture.cmap(picture.norm(value)) for value in (3.0, -3.0))
    assert red[0] > red[2]
    assert blue[2] > blue[0]
    assert picture.norm.vmin == -picture.norm.vmax
    assert "RMS 3 \N{MICRO SIGN}m" in note_of(errors)


def test_errors_of_what_was_filled_are_framed_and_open():
    filled = np.zeros(SHAPE, np.uint8)
    filled[8:13, 10:15] = 1
    _, _, errors, cuts, below = drawn({"a": result_of(1, filled=filled)})
    (frame,) = errors.collections
    corners = np.concatenate([path.vertices for path in frame.get_paths()])
    x, y = io.pixel_axes(SHAPE, (0.1, 0.1))
    np.testing.assert_allclose(corners[:, 0].min(), x[10], atol=0.06)
    np.testing.assert_allclose(corners[:, 1].max(), y[8], atol=0.06)
    assert "filled 1 \N{MICRO SIGN}m (outlined)" in note_of(errors)
    for axes in (cuts, below):
        inside = axes.get_lines()[2].get_ydata()
        np.testing.assert_array_equal(np.isfinite(inside), filled[10] == 1)


def test_errors_are_relative_to_the_level_of_the_truth():
    maps = {"component": np.zeros(SHAPE, np.int32), "offset_unknown": np.ones(1, np.uint8)}
    error = 4 * np.sin(np.arange(SHAPE[1])) * np.ones(SHAPE)
    _, _, errors, _, _ = drawn({"a": result_of(700 + error, **maps)})
    np.testing.assert_allclose(shown(errors), error - error.mean(), atol=1e-2)


def test_a_surface_without_any_answer_is_shown_as_such(tmp_path):
    nothing = result_of(np.nan)
    view.surface_figure({"a": nothing}, truth(), "title", tmp_path / "a.png")
    _, _, errors, _, _ = drawn({"a": nothing})
    assert "no pixel answered" in note_of(errors)


def test_what_cannot_be_drawn_is_refused(tmp_path):
    for lacking in (io.Result(height=TRUE), io.Result(height=TRUE[:1], x=np.arange(31.0), y=np.zeros(1))):
        with pytest.raises(io.InputError, match="heights and the pixel size"):
            view.surface_figure({"a": result_of(), "b": lacking}, truth(), "", tmp_path / "a.png")
    each = result_of()
    turns = io.Result(height=np.stack([TRUE, TRUE]), x=each.x, y=each.y)
    with pytest.raises(io.InputError, match="heights and the pixel size"):
        view.surface_figure({"a": turns}, truth(), "", tmp_path / "a.png")
    assert not list(tmp_path.iterdir())
