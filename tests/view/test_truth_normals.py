"""The figure of normals: colours, needles and errors are those of the result."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from matplotlib.quiver import Quiver, QuiverKey

from mirrorskin import io, view
from mirrorskin.view import truth_normals as normals
from mirrorskin.view.drawing.colours import MISSING_RGB

SHAPE = (20, 30)
ZENITH = np.radians(30)


def result_of(azimuth=0.5, zenith=ZENITH, **maps):
    """A slope that faces one way."""
    x, y = io.pixel_axes(SHAPE, (0.1, 0.1))
    facing = [np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)]
    normals = np.broadcast_to(np.array(facing, np.float32), (*SHAPE, 3)).copy()
    return io.Result(normals=normals, x=x, y=y, **{"contact": np.ones(SHAPE, np.uint8), **maps})


def truth_of(azimuth=0.5, contact=None):
    flat = np.ones(SHAPE, np.float32)
    touched = np.ones(SHAPE, np.uint8) if contact is None else contact
    return io.Truth(flat, flat * np.float32(ZENITH), flat * np.float32(azimuth), touched)


def drawn(results, truth, tmp_path, monkeypatch):
    """Draw; return the axes, result by result."""
    kept = []
    monkeypatch.setattr(normals, "save_figure", lambda figure, title, path, resolution: kept.append(figure))
    view.normal_figure(results, truth, "title", tmp_path / "x.png")
    axes = [panel for panel in kept[0].axes if panel.get_label() != "<colorbar>"]
    return np.array(axes).reshape(3, -1).T


def note_of(axes):
    """Return the note below the title of a panel."""
    return axes.texts[0].get_text()


def test_normals_become_a_picture_and_nothing_in_contact_does(tmp_path):
    path = tmp_path / "normals.png"
    none = result_of(contact=np.zeros(SHAPE, np.uint8))
    view.normal_figure({"one": result_of(), "none": none}, truth_of(), "title", path)
    assert cv2.imread(str(path)).shape[0] > 600


def test_colours_are_the_customary_ones_and_edges_are_black(tmp_path, monkeypatch):
    edges = np.zeros(SHAPE, np.uint8)
    edges[3] = 1
    result = result_of(edges=edges)
    result.normals[7, 8] = np.nan
    (axes,) = drawn({"one": result}, truth_of(), tmp_path, monkeypatch)
    picture = axes[0].images[0].get_array()
    x, y, z = result.normals[0, 0]
    np.testing.assert_allclose(picture[0, 0], 127.5 * (np.array([x, y, z]) + 1), atol=1)
    np.testing.assert_array_equal(picture[3, 5], [0, 0, 0])
    np.testing.assert_array_equal(picture[7, 8], MISSING_RGB)
    assert note_of(axes[0]) == "black: edges; light blue: no answer"


def test_needles_point_where_the_surface_faces_and_only_in_contact(tmp_path, monkeypatch):
    contact = np.ones(SHAPE, np.uint8)
    contact[:, :15] = 0
    (axes,) = drawn({"one": result_of(np.pi / 2, contact=contact)}, truth_of(), tmp_path, monkeypatch)
    (needles,) = (drawn for drawn in axes[1].collections if isinstance(drawn, Quiver))
    assert len(needles.U) == SHAPE[0] * 15
    np.testing.assert_allclose(needles.U, 0, atol=1e-6)
    assert np.all(needles.V > 0)  # y is up
    low, high = axes[1].get_ylim()
    assert low < 0 < high
    assert needles.X.min() > 0


def test_errors_are_angles_where_contact_is_found_and_true(tmp_path, monkeypatch):
    touched, true = np.ones((2, *SHAPE), np.uint8)
    touched[0], true[1] = 0, 0
    results = {"right": result_of(contact=true), "turned": result_of(0.5, ZENITH + np.radians(2))}
    rows = drawn(results, truth_of(contact=touched), tmp_path, monkeypatch)
    right, turned = (row[2].images[0].get_array() for row in rows)
    np.testing.assert_allclose(right[2:], 0, atol=1e-4)
    assert np.isnan(np.ma.filled(right, np.nan)[:2]).all()
    np.testing.assert_allclose(turned[1:], 2, rtol=1e-4)
    assert "median 2.00\N{DEGREE SIGN}" in note_of(rows[1][2])


def test_methods_are_compared_on_the_pixels_that_all_answer(tmp_path, monkeypatch):
    half = np.ones(SHAPE, np.uint8)
    half[:, :20] = 0
    result = result_of()
    result.normals[:, 20:] = result_of(0.5, ZENITH + np.radians(3)).normals[:, 20:]
    rows = drawn({"all": result, "part": result_of(contact=half)}, truth_of(), tmp_path, monkeypatch)
    assert note_of(rows[0][2]) == "median 0.00\N{DEGREE SIGN} (3.00\N{DEGREE SIGN} where all answer)"
    assert note_of(rows[1][2]) == "median 0.00\N{DEGREE SIGN} (0.00\N{DEGREE SIGN} where all answer)"


def test_arrows_have_a_legend_on_the_scale_of_the_arrows(tmp_path, monkeypatch):
    (axes,) = drawn({"one": result_of()}, truth_of(), tmp_path, monkeypatch)
    keys = [key for key in axes[1].artists if isinstance(key, QuiverKey)]
    lengths = {key.label: key.U for key in keys}
    assert lengths["30\N{DEGREE SIGN}"] == pytest.approx(
        0.5
    )  # as long as the arrow of a zenith of 30 degrees
    (needles,) = (drawn for drawn in axes[1].collections if isinstance(drawn, Quiver))
    np.testing.assert_allclose(np.hypot(needles.U, needles.V), 0.5, atol=1e-6)
    assert all(key.Q is needles for key in keys)


def test_the_key_of_the_colours_is_a_half_sphere(tmp_path, monkeypatch):
    kept = []
    monkeypatch.setattr(normals, "save_figure", lambda figure, title, path, resolution: kept.append(figure))
    view.normal_figure({"one": result_of()}, truth_of(), "title", tmp_path / "x.png")
    (key,) = kept[0].axes[0].child_axes
    colours = key.images[0].get_array()
    middle = len(colours) // 2
    np.testing.assert_allclose(colours[middle, middle], [127, 127, 255, 255], atol=1)
    place = round(middle * 1.8)
    np.testing.assert_allclose(colours[middle, place], [0.9 * 255, 127, 0.8 * 255, 255], atol=4)
    assert colours[0, 0, 3] == 0
    radii = [circle.get_radius() for circle in key.patches]
    np.testing.assert_allclose(radii, np.sin(np.radians([30, 60])))
    assert [text.get_text() for text in key.texts][:2] == ["30\N{DEGREE SIGN}", "60\N{DEGREE SIGN}"]


@pytest.mark.parametrize("kind", ["heights", "turns", "no axes", "truth"])
def test_what_cannot_be_drawn_is_reported(tmp_path, kind):
    results = {
        "heights": io.Result(height=np.zeros(SHAPE, np.float32)),
        "turns": io.Result(normals=np.zeros((2, *SHAPE, 3), np.float32), x=np.arange(30), y=np.arange(20)),
        "no axes": io.Result(normals=np.zeros((*SHAPE, 3), np.float32)),
        "truth": io.Result(normals=np.zeros((4, 5, 3), np.float32), x=np.arange(5.0), y=np.arange(4.0)),
    }
    with pytest.raises(io.InputError, match=r"normals of one turn|not of one stack"):
        view.normal_figure({"one": results[kind]}, truth_of(), "title", tmp_path / "x.png")


def test_nothing_in_contact_at_all_is_reported(tmp_path, monkeypatch):
    none = result_of(contact=np.zeros(SHAPE, np.uint8))
    (axes,) = drawn({"one": none}, truth_of(), tmp_path, monkeypatch)
    assert note_of(axes[2]) == "no pixel in contact"
