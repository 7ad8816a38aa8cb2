"""Figures are drawn, and say what they need."""

import cv2
import numpy as np
import pytest

from mirrorskin import io, view


def result_and_truth(height):
    x, y = io.pixel_axes(height.shape, (0.1, 0.2))
    truth = io.Truth(height, *(np.zeros_like(height) for _ in range(2)), np.ones(height.shape, np.uint8))
    return io.Result(height=height, x=x, y=y), truth


@pytest.mark.parametrize("kind", ["slope", "empty"])
def test_a_height_map_becomes_a_picture(tmp_path, kind):
    height = np.fromfunction(lambda row, column: -0.01 * column, (20, 30)).astype(np.float32)
    if kind == "empty":
        height[:] = np.nan
    view.height_figure(*result_and_truth(height), "a slope", tmp_path / "slope.png")
    picture = cv2.imread(str(tmp_path / "slope.png"))
    assert picture.shape[0] > 300
    colours = len(np.unique(picture.reshape(-1, 3), axis=0))
    assert colours > 30


def test_a_figure_needs_heights_and_a_place_to_go(tmp_path):
    height = np.zeros((4, 5), np.float32)
    result, truth = result_and_truth(height)
    with pytest.raises(io.InputError, match="heights and the pixel size"):
        view.height_figure(io.Result(height=height), truth, "", tmp_path / "a.png")
    with pytest.raises(io.InputError, match="cannot be written"):
        view.height_figure(result, truth, "", tmp_path / "missing" / "a.png")


def test_without_matplotlib_the_remedy_is_named(monkeypatch):
    monkeypatch.setattr(view.figures, "find_spec", lambda name: None)
    with pytest.raises(io.InputError, match="pip install 'mirrorskin"):
        view.check_drawing()


def test_the_map_lies_as_the_picture_does_and_the_cut_tells_truth_from_result():
    height = np.fromfunction(lambda row, column: -0.01 * column - row, (20, 30)).astype(np.float32)
    result, truth = result_and_truth(height)
    left, right, *_ = view.figures._draw(
        result, truth.__class__(height - 5, *(height,) * 2, truth.contact)
    ).axes
    picture = left.get_images()[0]
    np.testing.assert_array_equal(picture.get_array(), height)
    assert picture.origin == "upper"
    np.testing.assert_allclose(picture.get_extent(), (-1.5, 1.5, -2.0, 2.0))
    lines = {line.get_label(): line.get_ydata() for line in right.get_lines()}
    np.testing.assert_array_equal(lines["reconstructed"], height[10])
    np.testing.assert_array_equal(lines["truth"], height[10] - 5)


def test_what_cannot_be_drawn_is_refused():
    result, truth = result_and_truth(np.zeros((1, 5), np.float32))
    with pytest.raises(io.InputError, match="2 x 2 pixels"):
        view.figures._draw(result, truth)
    result, _ = result_and_truth(np.zeros((4, 5), np.float32))
    with pytest.raises(io.InputError, match="not of one stack"):
        view.figures._draw(result, truth)
