"""The figure of forces: what is drawn is the results' own, and what is lacking is told."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from mirrorskin import io, view
from mirrorskin.view import force as figure_of_forces

X, Y = io.pixel_axes((8, 9), (0.1, 0.1))
PRESSURE = np.linspace(0, 0.05, 72, dtype=np.float32).reshape(8, 9)


def result_of(force, sigma=0.01, pressure=PRESSURE):
    return io.Result(pressure=pressure, force=force, force_sigma=sigma, x=X, y=Y)


def test_forces_are_drawn_against_the_truth_with_their_errors(tmp_path, monkeypatch):
    kept = []
    monkeypatch.setattr(figure_of_forces, "save_figure", lambda figure, title, path: kept.append(figure))
    results = {"light": result_of(0.11), "heavy": result_of(0.18)}
    view.force_figure(results, {"light": 0.1, "heavy": 0.2}, 2 * PRESSURE, "title", tmp_path / "a.png")
    pressure, _, cut, forces, errors = (
        next(axes for axes in kept[0].axes if word in (axes.get_title(), axes.get_ylabel()))
        for word in ("heavy", "heavy", "cut across the middle", "estimated force (N)", "error (%)")
    )
    np.testing.assert_allclose(pressure.get_images()[0].get_array(), 1e3 * PRESSURE)
    truth, found = cut.get_lines()
    np.testing.assert_allclose(truth.get_ydata(), 2e3 * PRESSURE[4])
    np.testing.assert_allclose(found.get_ydata(), 1e3 * PRESSURE[4])
    np.testing.assert_allclose(forces.containers[0].lines[0].get_ydata(), [0.11, 0.18])
    np.testing.assert_allclose(errors.containers[0].lines[0].get_ydata(), [10, -10])
    assert "2 presses: RMS error 10 %, chi2 2.50" in forces.get_title()


def test_a_figure_becomes_a_picture(tmp_path):
    view.force_figure({"one": result_of(0.1)}, {"one": 0.1}, PRESSURE, "title", tmp_path / "a.png")
    assert cv2.imread(str(tmp_path / "a.png")).shape[0] > 400


@pytest.mark.parametrize(
    ("result", "said"),
    [
        (io.Result(pressure=PRESSURE, x=X, y=Y), "one has no force"),
        (io.Result(force=1.0, force_sigma=0.1), "one has no pressure"),
        (result_of(0.1, pressure=PRESSURE[1:]), "one has no pressure of the truth's size"),
    ],
)
def test_what_cannot_be_drawn_is_said(tmp_path, result, said):
    with pytest.raises(io.InputError, match=said):
        view.force_figure({"one": result}, {"one": 0.1}, PRESSURE, "title", tmp_path / "a.png")
