"""Figures and numbers of artificial calibrations: the drawings show their values."""

import math

import cv2
import numpy as np
import pytest
from calibrations import a_calibration, a_lens, a_precession, a_response

from mirrorskin import io
from mirrorskin.io.model.parameters import Row
from mirrorskin.view.calibration import calibration_figures, draw_lens, draw_precession, draw_references
from mirrorskin.view.calibration_wall import draw_gel, draw_response


def titled(axes, start):
    matching = [panel for panel in axes if panel.get_title().startswith(start)]
    assert len(matching) == 1, [panel.get_title() for panel in axes]
    return matching[0]


def references(shape=(9, 11)):
    generator = np.random.default_rng(1)
    defects = np.zeros(shape, np.uint8)
    defects[0, 0], defects[2, 3], defects[4, 5], defects[6, 7] = 1, 2, 4, 3
    dark, bright = (generator.normal(level, 3, shape).astype(np.float32) for level in (16, 200))
    dark[defects > 0] = bright[defects > 0] = np.nan
    sigma = np.full(shape, 0.2, np.float32)
    return io.References(dark, bright, sigma, 2 * sigma, defects)


def test_a_part_becomes_a_picture(tmp_path):
    calibration = a_calibration(only=("lens",))
    written = calibration_figures(calibration, tmp_path / "new" / "folder")
    assert [path.name for path in written] == ["scale.png"]
    for path in written:
        picture = cv2.imread(str(path))
        assert min(picture.shape[:2]) > 400
        assert np.std(picture) > 10


def test_nothing_is_drawn_of_a_calibration_without_parts(tmp_path):
    assert calibration_figures(a_calibration(only=()), tmp_path) == []


def test_an_impossible_folder_is_reported(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(io.InputError, match="-o"):
        calibration_figures(a_calibration(only=()), tmp_path / "file")


def test_all_maps_of_references_are_drawn_with_their_units():
    maps = references()
    axes = draw_references(maps).axes
    for start, values in (
        ("dark", maps.dark),
        ("bright", maps.bright),
        ("light", maps.bright - maps.dark),
        ("standard error of dark", maps.dark_sigma),
        ("standard error of bright", maps.bright_sigma),
    ):
        panel = titled(axes, start)
        np.testing.assert_allclose(np.ma.filled(panel.images[0].get_array(), np.nan), values, rtol=1e-6)
        assert f"{np.nanmedian(values):.4g} counts" in panel.get_title()
    legend = [text.get_text() for text in titled(axes, "defects").get_legend().get_texts()]
    assert legend == ["sound: 95", "hot: 1", "dead: 1", "saturated: 1", "several: 1"]


def test_lines_of_whole_millimetres_are_where_opencv_has_them():
    lens = a_lens((50, 70))
    axes = draw_lens(lens).axes
    lines = titled(axes, "the sheet").lines
    middle = [line for line in lines if line.get_color() == "tab:red"]
    assert len(middle) == 2
    x0 = middle[0].get_xydata()
    on_sheet = np.stack([np.zeros(5), np.linspace(-4, 1, 5), np.ones(5)])
    pixels = np.linalg.inv(lens.camera) @ on_sheet
    rays = (np.linalg.inv(lens.matrix) @ (pixels / pixels[2])).T
    projected, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), lens.matrix, lens.distortion)
    for place in projected.reshape(-1, 2):
        along = np.interp(place[1], x0[::-1, 1], x0[::-1, 0])
        assert along == pytest.approx(place[0], abs=0.02)


def test_the_curve_of_a_graded_wall_is_drawn_over_the_zenith_it_is_known_at():
    response = a_response()
    axes = draw_response(response).axes
    curve = titled(axes, "response")
    assert curve.get_title() == "response, known from 14.0° to 43.9°"
    zenith, light = curve.lines[0].get_data()
    q = np.tan(math.pi / 4 - np.radians(zenith))
    np.testing.assert_allclose(light, 0.9 - 0.5 * q - 0.1 * q**2, rtol=1e-9)
    for name in ("zenith", "azimuth"):
        shown = titled(axes, f"standard error of {name}").images[0].get_array()
        np.testing.assert_allclose(shown, np.degrees(getattr(response, f"{name}_sigma")), rtol=1e-6)


def test_the_threshold_of_a_uniform_wall_is_drawn_by_azimuth():
    values = {name: getattr(a_response(), name) for name in io.WallResponse.__slots__}
    uniform = {"pattern": "uniform", "curve": np.ones(1), "lamps": (0.0, 0.0), "covariance": np.zeros((2, 2))}
    response = io.WallResponse(**values | uniform)
    axes = draw_response(response).axes
    assert titled(axes, "wall: radius 17.50 mm")
    lines = titled(axes, "zenith of half brightness").lines
    middle, right = np.degrees(lines[0].get_ydata()), np.degrees(lines[1].get_ydata())
    assert np.all(np.isfinite(lines[0].get_ydata()))
    assert np.ptp(middle) < 0.2 * np.ptp(right)


def test_a_precession_is_drawn_through_its_phases():
    precession = a_precession()
    path = titled(draw_precession(precession).axes, "lean of the body")
    marks = next(line for line in path.lines if line.get_marker() == "o").get_xydata()
    np.testing.assert_allclose(marks, np.degrees(precession.lean(np.arange(8) * math.pi / 4)))
    assert {text.get_text() for text in path.texts} >= {f"{45 * k}°" for k in range(8)}


@pytest.mark.parametrize("curvature", [0.0, 1 / 17.5])
def test_a_gel_is_drawn_with_its_threshold(curvature):
    gel = io.Gel(threshold=0.2, compliance=0.0, curvature=curvature, sigma={"threshold": 0.01})
    axes = draw_gel(gel).axes
    assert "11.46 ± 0.57°" in titled(axes, "a ball of 4 mm").get_title()
    lit = titled(axes, "a ball of 4 mm").lines[0].get_xydata()
    nearest = np.nanmin(np.abs(lit[np.isfinite(lit[:, 1]), 0]))
    assert nearest == pytest.approx(2 * math.sin(0.2), abs=0.02)
    spread = np.ptp(titled(axes, "zenith at which").lines[1].get_ydata())
    assert (spread > 1) == (curvature > 0)


def test_numbers_are_in_the_units_people_speak_of():
    rows = {(row.part, row.what): row for row in a_calibration().rows()}
    assert rows["camera", "name"].value == "left"
    assert rows["camera", "columns of a frame"].value == 7
    assert rows["references", "dead"].value == 1
    assert rows["tilt", "half-angle"].cells()[2:] == ("2.2918", "0.0057", "deg")
    assert rows["tilt", "pivot z"].cells()[2:] == ("12.00", "0.30", "mm")
    assert rows["tilt", "direction"].value == "against the phase"
    assert rows["scale", "pixel size along x"].value == pytest.approx(500)
    assert rows["zenith", "known on the axis to"].value == pytest.approx(45 - math.degrees(math.atan(0.02)))
    assert rows["zenith", "radius"].sigma == 1.0
    assert rows["elastic", "threshold zenith"].unit == "deg"


@pytest.mark.parametrize(
    ("value", "sigma", "message"),
    [
        (1.23456, 0.012, ("1.235", "0.012")),
        (123.456, 40.0, ("123", "40")),
        (7, math.nan, ("7", "")),
        (math.nan, math.nan, ("unknown", "")),
    ],
)
def test_no_more_digits_are_written_than_are_known(value, sigma, message):
    assert Row("tilt", "angle", value, sigma, "deg").cells()[2:4] == message
