"""What is left out of measures, what is subtracted, and tables of measures."""

import csv

import numpy as np
import pytest
from height_maps import cap, places, result_of

from mirrorskin import engine, io
from mirrorskin.engine.metrology import (
    Defects,
    Levels,
    Limit,
    Picture,
    Polygon,
    Verdict,
    subtract,
    table,
)
from mirrorskin.engine.metrology.quantity import Quantity

SHAPE, SIZE = (40, 50), (0.1, 0.1)
NAN = np.nan


def wavy(dust=True, seed=1):
    """Return a wavy plane with noise, and dust of 3 x 3 pixels."""
    x, y = places(SHAPE, SIZE)
    height = 0.002 * np.sin(5 * x + 3 * y) + 0.01 * x
    height += 1e-5 * np.random.default_rng(seed).standard_normal(SHAPE)
    height[10:13, 30:33] += 0.3 * dust
    return result_of(height, SIZE, sigma=1e-5)


def area(**options):
    return engine.measure(wavy(), form="plane", **options).quantities["measured area"].value


def test_a_polygon_leaves_out_the_pixels_whose_centres_are_inside():
    corners = [(-1.0, -1.0), (1.0, -1.0), (1.0, 0.5)]
    x, y = places(SHAPE, SIZE)
    inside = (x < 1) & (y > -1) & (y < -1 + 0.75 * (x + 1))
    assert area(mask=Polygon(corners)) == pytest.approx(0.01 * (inside.size - inside.sum()))
    assert area(mask=Polygon(corners, only=True)) == pytest.approx(0.01 * inside.sum())
    both = [Polygon(corners), Levels(above=0.1)]
    assert area(mask=both) == pytest.approx(0.01 * (inside.size - inside.sum() - 9))


def test_arrays_and_pictures_are_true_where_to_measure(tmp_path):
    keep = np.zeros(SHAPE, np.uint8)
    keep[:20, :30] = 255
    np.save(tmp_path / "keep.npy", keep)
    for mask in (keep, keep != 0, Picture(tmp_path / "keep.npy")):
        assert area(mask=mask) == pytest.approx(6)
    with pytest.raises(io.InputError, match="a mask of 40 x 50 pixels is needed"):
        area(mask=np.ones((3, 4), bool))


def test_defects_are_outliers_of_the_form_and_their_neighbours():
    clean, dusty = (engine.measure(wavy(dust), form="plane") for dust in (False, True))
    masked = engine.measure(wavy(), form="plane", mask=Defects())
    assert masked.quantities["measured area"].value == pytest.approx(20 - 0.25)
    assert any(note == "pixels left out by a mask: 25" for note in masked.notes)
    for name in ("Sz", "Sq", "plane tilt"):
        true, found = (measured.quantities[name].value for measured in (clean, masked))
        assert found == pytest.approx(true, rel=0.02), name
    assert dusty.quantities["Sz"].value > 250
    half = np.where(places(SHAPE, SIZE)[0] > 0, 0.0, 0.3)  # too many to be defects
    notes = engine.measure(result_of(half, SIZE), form="plane", mask=Defects()).notes
    assert "pixels left out by a mask: 0" in notes


def test_a_difference_has_the_sigma_of_both_and_the_pixel_size():
    rng = np.random.default_rng(2)
    ball, flat = cap(SHAPE, SIZE, 5.0, 1.8), 0.01 * places(SHAPE, SIZE)[0]
    first = result_of(ball + flat + 0.003 * rng.standard_normal(SHAPE), SIZE, sigma=0.003)
    second = result_of(flat + 0.004 * rng.standard_normal(SHAPE), SIZE, sigma=0.004)
    found = subtract(first, second)
    known = np.isfinite(ball)
    assert found.height_sigma[known] == pytest.approx(0.005)
    assert np.isnan(found.height[~known]).all()
    assert np.mean(((found.height - ball)[known] / found.height_sigma[known]) ** 2) == pytest.approx(
        1, abs=0.15
    )
    np.testing.assert_array_equal(found.x, first.x)
    measured = engine.measure(first, reference=second, form="sphere")
    radius = measured.quantities["sphere radius"]
    assert abs(radius.value - 5) < 3 * radius.sigma < 0.1
    assert "heights are differences from those of the reference" in measured.notes


def test_what_was_filled_or_is_relative_in_either_is_so_in_the_difference():
    height = np.zeros((2, 4), np.float32)
    filled = np.array([[0, 1, 0, 0]] * 2, np.uint8)
    component = np.array([[0, 0, 1, 1]] * 2, np.int32)
    first = result_of(height, SIZE, filled=filled)
    second = result_of(height, SIZE, component=component, offset_unknown=np.array([0, 1], np.uint8))
    found = subtract(first, second)
    np.testing.assert_array_equal(found.filled, filled)
    assert found.offset_unknown[found.component[0, 0]] == 0
    assert found.offset_unknown[found.component[0, 3]] == 1
    assert subtract(first, first).component is None


def test_references_of_another_place_are_refused():
    with pytest.raises(io.InputError, match="take one of the same picture"):
        subtract(np.zeros((2, 3)), np.zeros((3, 3)))
    with pytest.raises(io.InputError, match=r"pixel size of the result is 0\.1 x 0\.1 mm"):
        subtract(wavy(), result_of(np.zeros(SHAPE), (0.2, 0.1)))


@pytest.mark.parametrize(
    ("value", "sigma", "verdict"),
    [
        (1.0, 0.1, "inside"),
        (1.9, 0.1, "undecided"),
        (2.1, 0.1, "undecided"),
        (2.3, 0.1, "outside"),
        (2.0, NAN, "inside"),
        (2.01, NAN, "outside"),
        (NAN, 1.0, "missing"),
        (0.1, 0.01, "outside"),
    ],
)
def test_a_limit_has_a_guard_band_of_the_expanded_uncertainty(value, sigma, verdict):
    assert Limit(0.5, 2.0).judge("Sq", Quantity(value, sigma, "µm")) == Verdict(verdict)


@pytest.mark.parametrize(
    ("text", "unit"), [("0.5um:2um", "µm"), ("0.0005mm:0.002mm", "µm"), ("500nm:2000nm", "µm")]
)
def test_limits_are_in_any_unit_of_their_kind(text, unit):
    assert Limit.read(text).within("Sq", unit) == pytest.approx((0.5, 2.0))
    assert Limit.read("3:").within("Sku", "") == (3, np.inf)
    assert Limit.read(":2 mm²").within("measured area", "mm2") == (-np.inf, 2)


@pytest.mark.parametrize("text", ["1um", "2um:1um", "1um:2deg", ":", "a:b", "1:2:3"])
def test_what_is_no_limit_is_refused(text):
    with pytest.raises(io.InputError, match="limits"):
        Limit.read(text)


def test_a_table_has_a_row_for_each_result(tmp_path):
    lot = {"=a": wavy(False, 1), "b": wavy(False, 2), "c": np.zeros(SHAPE)}
    found = table(lot, limits={"Sq": ":1mm", "plane tilt": "0.5deg:0.65deg"}, form="plane")
    assert [row.name for row in found.rows] == list(lot)
    assert "no pixel size" in found.rows[2].problem
    assert [found.verdict(row) for row in found.rows[:2]] == ["inside", "inside"]
    values, sigmas = found.values("Sq")
    assert np.isnan(values[2])
    assert values[0] == engine.measure(lot["b"], form="plane").quantities["Sq"].value or sigmas[0] > 0
    found.save(tmp_path / "lot.csv")
    lines = (tmp_path / "lot.csv").read_text().splitlines()
    rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    assert "# limits of Sq: at most 1000 µm" in lines
    assert rows[0]["result"] == "'=a"  # no formula
    assert float(rows[1]["Sq [µm]"]) == pytest.approx(values[1])
    assert float(rows[1]["u(Sq) [µm]"]) == pytest.approx(sigmas[1])
    assert rows[2]["Sq [µm]"] == ""
    assert "<table>" in found._repr_html_()


def test_measures_are_a_table_in_a_notebook():
    measured = engine.measure(wavy(), form="plane")
    html = measured._repr_html_()
    assert html.count("<tr>") > len(measured.quantities)
    assert "root mean square height" in html
    assert len(measured.main()) == 10
