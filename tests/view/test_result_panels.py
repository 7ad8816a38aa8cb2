"""Each panel shows its map at the right place, with a true description."""

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from shown import ball, colours_at, rendered

from mirrorskin import engine, io
from mirrorskin.engine.metrology import section
from mirrorskin.io.model.maps import (
    IN_PIXELS,
    FocusStatus,
    PoseStatus,
    PressStatus,
    ReleaseStatus,
    SlipStatus,
    status_of,
)
from mirrorskin.view.drawing.colours import MISSING_RGB, normal_colours
from mirrorskin.view.result.maps import draw_declared, draw_height, draw_normals
from mirrorskin.view.result.section import draw_histogram, draw_section
from mirrorskin.view.result.sheet import percent, sheet_of


def panel_of(draw, result, *more):
    axes = Figure(figsize=(5, 4)).add_axes((0.15, 0.15, 0.6, 0.65))
    draw(axes, sheet_of(result), *more)
    return axes


def map_of(name, result):
    return panel_of(draw_declared, result, name)


def note(axes):
    """Return the small letters below the title."""
    return next(text.get_text() for text in axes.texts if text.xyann == (0, 5))


def named(axes):
    return {text.get_text() for text in axes.get_legend().get_texts()}


def along(shape=(20, 60), pixel_size=(0.1, 0.1), span=1.0):
    """A parabola along x, flat along y, with a hole and something that was filled."""
    x, y = io.pixel_axes(shape, pixel_size)
    height = np.broadcast_to(-span * (x / x[-1]) ** 2, shape).astype(np.float32)
    filled = np.zeros(shape, np.uint8)
    height[:, 10:13] = np.nan
    filled[:, 20:40] = 1
    sigma = np.where(filled == 1, np.nan, np.float32(0.01) * span)
    return io.Result(height=height, height_sigma=sigma.astype(np.float32), filled=filled, x=x, y=y)


def cut_of(result, *ends):
    return sheet_of(result), section(result, *ends)


def test_the_height_is_as_the_picture_does():
    result = ball()
    corner = result.height.copy()
    corner[:4, :5] = 5.0  # the upper left
    axes = panel_of(draw_height, ball(height=corner))
    assert axes.get_xlim() == pytest.approx((-1.6, 1.6))
    assert axes.get_ylim() == pytest.approx((-1.44, 1.44))
    yellow, hole = colours_at(axes, [(-1.45, 1.2), (1.45, 1.2)])
    assert yellow[0] > 150 > yellow[2]
    np.testing.assert_allclose(hole, MISSING_RGB, atol=2)


@pytest.mark.parametrize("name", ["height", "normals", "edges", "status", "azimuth", "height_sigma"])
def test_a_millimetre_is_as_long_up_as_it_is_across(name):
    axes = map_of(name, ball())
    axes.apply_aspect()
    (x0, y0), (x1, y1) = axes.transData.transform([(0, 0), (1, 1)])
    assert x1 - x0 == pytest.approx(y1 - y0)
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x (mm)", "y (mm)")


def test_the_scale_bar_is_as_long_as_its_label():
    axes = panel_of(draw_height, ball())
    (bar,) = axes.lines
    label = next(text.get_text() for text in axes.texts if text.get_text().endswith("mm"))
    assert np.ptp(bar.get_xdata()) == pytest.approx(float(label.removesuffix(" mm")))
    assert label == "0.5 mm"  # the longest round length below 0.3 of 3.2 mm


def test_a_single_pixel_of_unknown_size_has_no_scale_bar():
    assert not panel_of(draw_height, ball((1, 1))).lines


def test_what_is_filled_without_a_height_is_not_counted():
    filled = np.ones((24, 32), np.uint8)
    axes = panel_of(draw_height, ball(height=np.full((24, 32), np.nan, np.float32), filled=filled))
    assert note(axes) == "blue: no answer (100.0 %)"


def test_without_pixel_size_heights_are_along_pixels_and_have_no_scale_bar():
    axes = panel_of(draw_height, ball(x=None, y=None))
    assert axes.get_xlabel() == "x (px)"
    assert axes.get_xlim() == (-16, 16)
    assert not axes.lines


def test_heights_in_pixels_are_drawn_in_pixels_and_to_scale():
    result = ball(x=None, y=None, declarations=IN_PIXELS)
    heights, histogram = (panel_of(draw, result) for draw in (draw_height, draw_histogram))
    across = panel_of(draw_section, result, section(result))
    assert across.get_xlabel() == "distance from A (px)"
    assert across.get_ylabel() == "height (px)"
    assert "heights stretched" in note(across)
    assert note(histogram).endswith(" px")
    assert heights.get_ylabel() == "y (px)"


def test_notes_explain_colours_and_the_size_of_a_level():
    assert note(panel_of(draw_height, ball())) == "orange: filled (1.6 %); blue: no answer (10.9 %)"
    whole = ball(filled=None, height=np.zeros((24, 32), np.float32))
    assert note(panel_of(draw_height, whole)) == ""
    alone = panel_of(draw_height, ball(offset_unknown=np.ones(1, np.uint8)))
    assert note(alone).endswith("; mean 0")
    assert alone.get_title("left") == "Relative height"
    some = panel_of(draw_height, ball(offset_unknown=np.array([1, 0, 1], np.uint8)))
    assert note(some).endswith("; 2 of 3 pieces about its mean")
    assert some.get_title("left") == "Height"


def test_the_line_of_a_section_runs_from_a_to_b():
    ends = (-1.0, -0.9), (0.5, 0.7)
    axes = panel_of(draw_height, ball(), section(ball(), *ends))
    _, line = axes.lines
    np.testing.assert_allclose(line.get_xydata(), ends)
    letters = {text.get_text(): text.xy for text in axes.texts if text.get_text() in ("A", "B")}
    assert letters["A"] == pytest.approx(ends[0])
    assert letters["B"] == pytest.approx(ends[1])


@pytest.mark.parametrize(
    ("ends", "sides"),
    [
        (((-0.1, 0), (0.1, 0.1)), ("right", "left")),
        (((0.1, 0), (-0.1, 0.1)), ("left", "right")),
        (((0.1, 0.2), (0.1, 0.1)), ("right", "left")),
        (((-1.55, 0), (1.55, 0)), ("left", "right")),
        (((1.55, 0), (-1.55, 0)), ("right", "left")),
    ],
    ids=["short", "backwards", "upright", "across", "across backwards"],
)
def test_a_and_b_are_beyond_the_ends_but_within_the_picture(ends, sides):
    axes = panel_of(draw_height, ball(), section(ball(), *ends))
    letters = {text.get_text(): text.get_ha() for text in axes.texts}
    assert (letters["A"], letters["B"]) == sides  # the side of a letter that is at the end


def test_a_section_has_gaps_at_holes_and_what_was_filled_is_dashed():
    sheet, profile = cut_of(along())
    axes = panel_of(draw_section, sheet.result, profile)
    lines = {line.get_label(): line for line in axes.lines}
    measured, filled = lines["measured"], lines["filled"]
    expected = along().height[10].astype(float)
    inside = along().filled[10] == 1
    np.testing.assert_allclose(measured.get_ydata(), np.where(inside, np.nan, expected))
    assert np.isnan(measured.get_ydata()[10:13]).all()
    np.testing.assert_allclose(filled.get_ydata()[inside], expected[inside])
    assert np.isnan(filled.get_ydata()[[0, 12, 18, 41, -1]]).all()
    assert filled.is_dashed()
    assert not measured.is_dashed()
    np.testing.assert_allclose(measured.get_xdata(), 0.1 * np.arange(60), atol=1e-9)


def test_a_section_has_a_band_of_two_standard_deviations():
    sheet, profile = cut_of(along())
    axes = panel_of(draw_section, sheet.result, profile)
    corners = np.concatenate([path.vertices for path in axes.collections[0].get_paths()])
    at_start = corners[np.isclose(corners[:, 0], 0), 1]
    np.testing.assert_allclose([at_start.min(), at_start.max()], -1 + 0.01 * np.array([-2, 2]), atol=1e-6)
    assert not np.any((corners[:, 0] > 2.05) & (corners[:, 0] < 3.85))  # filled: nobody knows how well
    assert named(axes) == {"measured", "highest on A-B", "filled", "± 2 sigma: 20 µm"}


def test_the_highest_point_of_the_surface_is_marked_with_its_measured_height():
    result = ball(filled=None)
    sheet, profile = sheet_of(result), section(result)
    axes = panel_of(draw_section, sheet.result, profile)
    highest = engine.measure(result).quantities["highest point"].value
    assert "highest point" in named(axes)
    assert sheet.height_text(highest) in [text.get_text() for text in axes.texts]


def test_the_highest_measured_point_is_marked():
    sheet, profile = cut_of(along())
    axes = panel_of(draw_section, sheet.result, profile)
    mark = next(line for line in axes.lines if line.get_marker() == "v")
    assert mark.get_xydata()[0] == pytest.approx((1.9, profile.height[19]))
    assert f"{profile.height[19]:.3f} mm" in [text.get_text() for text in axes.texts]


@pytest.mark.parametrize(("span", "message"), [(2.5, 1), (1.0, 2), (0.3, 10), (0.001, 2000), (50, 1 / 20)])
def test_a_section_is_stretched_as_its_title_states(span, message):
    sheet, profile = cut_of(along(span=span))
    axes = panel_of(draw_section, sheet.result, profile)
    axes.apply_aspect()
    (x0, y0), (x1, y1) = axes.transData.transform([(0, 0), (1, 1)])
    assert (y1 - y0) / (x1 - x0) == pytest.approx(message)
    words = f"stretched {message} times" if message > 1 else "shrunk 20 times"
    assert note(axes).endswith("true to scale" if message == 1 else words)
    low, high = axes.get_ylim()
    assert low < -span < 0 < high


def test_a_section_without_errors_or_holes_mentions_neither():
    level = io.Result(height=np.zeros((3, 9), np.float32), x=np.arange(9.0), y=np.arange(3.0)[::-1])
    sheet, profile = cut_of(level)
    axes = panel_of(draw_section, sheet.result, profile)
    assert named(axes) == {"measured", "highest point"}
    assert note(axes).startswith("A (0, 1) to B (8, 1) mm")


def test_a_section_across_nothing_but_a_hole_is_empty():
    profile = section(ball(), (1.0, 1.3), (1.5, 1.3))
    assert not np.isfinite(profile.height).any()
    axes = panel_of(draw_section, ball(), profile)
    assert not axes.lines
    assert axes.get_legend() is None


def test_normals_have_the_customary_colours_and_the_key_explains_them():
    result = ball()
    axes = panel_of(draw_normals, result)
    np.testing.assert_array_equal(axes.images[0].get_array(), normal_colours(result.normals, result.edges))
    (key,) = axes.child_axes
    colours = key.images[0].get_array()
    middle = len(colours) // 2
    np.testing.assert_allclose(colours[middle, middle, :3], (127, 127, 255), atol=1)
    np.testing.assert_allclose(colours[middle, -1, :3], (255, 127, 127), atol=1)  # to the right: x
    np.testing.assert_allclose(colours[0, middle, :3], (127, 255, 127), atol=1)  # up: y
    assert colours[0, 0, 3] == 0
    assert note(axes) == "black: edges; blue: no answer"


def test_flags_are_grey_and_black_with_the_share_of_each():
    edges = np.zeros((4, 10), np.uint8)
    edges[1] = 1
    result = io.Result(edges=edges, contact=1 - edges)
    axes = map_of("edges", result)
    shown = axes.images[0].get_array()
    assert shown[1].max() == 0
    assert shown[0].min() > 200
    assert named(axes) == {"no edge\n75.0 %", "edge\n25.0 %"}
    assert named(map_of("contact", result)) == {"no lasting contact\n25.0 %", "in contact\n75.0 %"}


@pytest.mark.parametrize(
    ("codes", "texts"),
    [
        (PressStatus, ["invalid input", "onset", "never light", "light at start"]),
        (ReleaseStatus, ["invalid input", "release", "dark at start", "light to the end"]),
        (PoseStatus, ["invalid input", "normal", "none", "slope only"]),
        (SlipStatus, ["unknown", "slipped", "sticks", "no contact", "no texture"]),
        (FocusStatus, ["invalid input", "in focus", "no peak", "peak at an end"]),
    ],
)
def test_codes_have_the_legend_of_their_declaration(codes, texts):
    counts = range(1, len(codes) + 1)
    status = np.repeat(np.array([*codes], np.uint8), counts)[np.newaxis]
    axes = map_of("status", io.Result(status=status, declarations={"status": status_of(codes)}))
    shares = (percent(count, status.size) for count in counts)
    assert named(axes) == {f"{text}\n{fraction}" for text, fraction in zip(texts, shares, strict=True)}
    colours = [tuple(colour) for colour in axes.images[0].get_array()[0]]
    assert len(set(colours)) == len(codes)
    assert colours[0] == MISSING_RGB
    legend = [np.multiply(255, patch.get_facecolor()[:3]) for patch in axes.get_legend().get_patches()]
    firsts = np.cumsum([0, *counts])[:-1]
    np.testing.assert_allclose(legend, [colours[place] for place in firsts], atol=1)


def test_a_code_that_is_not_in_the_legend_is_shown_as_unknown():
    status = np.array([[1, 1, 4, 255]], np.uint8)
    axes = map_of("status", io.Result(status=status, declarations={"status": status_of(PressStatus)}))
    assert named(axes) == {"onset\n50.0 %", "unknown number\n50.0 %"}
    np.testing.assert_array_equal(axes.images[0].get_array()[0, 2:], 255)


def test_the_legend_leaves_out_codes_that_no_pixel_has():
    status = np.full((3, 4), 2, np.uint8)
    axes = map_of("status", io.Result(status=status, declarations={"status": status_of(PressStatus)}))
    assert named(axes) == {"never light\n100.0 %"}


def test_a_status_without_a_legend_is_shown_as_numbers():
    axes = map_of("status", io.Result(status=np.array([[0, 1, 5]], np.uint8)))
    assert axes.get_legend() is None
    np.testing.assert_array_equal(np.ma.filled(axes.images[0].get_array(), np.nan), [[np.nan, 1, 5]])


def test_a_share_that_is_not_nothing_does_not_look_like_nothing():
    assert percent(0, 10**6) == "0.0 %"
    assert percent(1, 10**6) == "< 0.1 %"


@pytest.mark.parametrize(
    ("unit", "factor", "name"),
    [
        ("µm", 1e3, "height_sigma"),
        ("deg", 180 / np.pi, "normals_sigma"),
        ("counts", 1, "modulation"),
        ("µm", 1e3, "slip_onset"),
    ],
)
def test_numbers_are_shown_in_the_unit_that_the_declaration_displays(unit, factor, name):
    values = np.linspace(0.002, 0.003, 12, dtype=np.float32).reshape(3, 4)
    values[0, 0] = np.nan
    axes = map_of(name, io.Result(**{name: values}))
    shown = np.ma.filled(axes.images[0].get_array(), np.nan)
    np.testing.assert_allclose(shown, factor * values, rtol=1e-6)
    assert axes.child_axes[0].get_ylabel().endswith(f"({unit})")
    assert note(axes) == f"median {factor * np.nanmedian(values):.3g} {unit}; blue: no answer"
    assert not isinstance(axes.images[0].norm, LogNorm)


def test_errors_that_span_decades_are_shown_by_their_logarithm():
    values = np.geomspace(1e-4, 1e-1, 60, dtype=np.float32).reshape(6, 10)
    assert isinstance(map_of("height_sigma", io.Result(height_sigma=values)).images[0].norm, LogNorm)


@pytest.mark.parametrize("value", [0.0, np.inf])
def test_errors_that_are_all_the_same_are_shown(value):
    axes = map_of("height_sigma", io.Result(height_sigma=np.full((3, 4), value, np.float32)))
    rendered(axes.figure)
    assert (note(axes) == "blue: no answer") == (not np.isfinite(value))


def test_azimuths_go_round():
    azimuth = np.radians([[0, 90, 180, 270, 359, -90]]).astype(np.float32)
    picture = map_of("azimuth", io.Result(azimuth=azimuth)).images[0]
    shown = np.asarray(picture.get_array())[0]
    np.testing.assert_allclose(np.abs(shown[2]), 180, atol=1e-4)
    np.testing.assert_allclose(shown[[0, 1, 3, 4, 5]], [0, 90, -90, -1, -90], atol=1e-4)
    ends = picture.cmap(picture.norm([-180.0, 180.0]))
    np.testing.assert_allclose(*ends, atol=0.02)


def test_the_distribution_counts_every_height_once():
    result = ball()
    axes = panel_of(draw_histogram, result)
    areas = {patch.get_label(): patch.get_data() for patch in axes.patches}
    finite = np.isfinite(result.height)
    for name, part in (
        ("measured", finite & (result.filled == 0)),
        ("filled", finite & (result.filled == 1)),
    ):
        counts = areas[name].values - areas[name].baseline
        assert counts.sum() == np.count_nonzero(part)
    assert note(axes).endswith("median expected error 2 µm")


@pytest.mark.parametrize("value", [-1.5, np.nan])
def test_heights_that_are_all_the_same_are_shown(value):
    result = io.Result(height=np.full((3, 4), value, np.float32), x=np.arange(4.0), y=np.arange(3.0)[::-1])
    for draw in (draw_height, draw_histogram):
        rendered(panel_of(draw, result).figure)


@pytest.mark.parametrize("name", ["slope", "hysteresis", "growth"])
def test_a_map_of_either_sign_has_colours_that_are_white_at_zero(name):
    values = np.linspace(-1, 2, 12 * 16).reshape(12, 16).astype(np.float32)
    values[0, 0] = np.nan
    axes = map_of(name, io.Result(**{name: values}))
    low, high = axes.images[0].get_clim()
    assert low == -high < 0


@pytest.mark.parametrize("shape", [(12, 16, 2), (3, 12, 16, 2)], ids=["one", "of each frame"])
def test_vectors_are_shown_by_their_length_and_arrows(shape):
    moved = np.zeros(shape, np.float32)
    moved[..., :, :, 0] = 0.003
    moved[..., :, :, 1] = -0.004
    moved[..., 0, 0, :] = np.nan
    axes = map_of("displacement", io.Result(displacement=moved))
    length = np.ma.filled(axes.images[0].get_array(), np.nan)
    assert np.isnan(length[0, 0])
    np.testing.assert_allclose(length[1:], 5, rtol=1e-6)
    assert axes.child_axes[0].get_ylabel() == "length (µm)"
    (arrows,) = (panel for panel in axes.collections if hasattr(panel, "U"))
    np.testing.assert_allclose([arrows.U[-1], arrows.V[-1]], [3, -4], rtol=1e-6)


def test_a_histogram_leaves_out_a_few_pixels_far_from_all_others():
    height = np.linspace(-1, 0, 2000, dtype=np.float32).reshape(40, 50)
    height[3, 4] = -9.0
    axes = panel_of(draw_histogram, io.Result(height=height))
    assert axes.get_xlim()[0] > -1.3
    assert any("1 pixels beyond" in text.get_text() for text in axes.texts)


def in_micrometres(result):
    """Return a result whose heights are a declared map that is displayed in micrometres."""
    declared = {"rise": io.Map("rise of the sheet", "mm", quantity="height", displayed="µm")}
    maps = {"rise": result.height, "rise_sigma": result.height_sigma, "filled": result.filled}
    return io.Result(maps, x=result.x, y=result.y, declarations=declared)


def test_declared_heights_have_the_displayed_unit_in_the_map():
    bar = map_of("rise", in_micrometres(along())).child_axes[-1]
    assert bar.get_ylabel() == "rise (µm)"
    np.testing.assert_allclose(bar.get_ylim(), [-1000, 0], atol=1)


def test_declared_heights_have_the_displayed_unit_in_the_section():
    sheet, profile = cut_of(in_micrometres(along()))
    axes = panel_of(draw_section, sheet.result, profile)
    assert axes.get_ylabel() == "rise (µm)"
    lines = {line.get_label(): line for line in axes.lines}
    np.testing.assert_allclose(np.nanmin(lines["measured"].get_ydata()), -1000)
    band = np.concatenate([path.vertices for path in axes.collections[0].get_paths()])
    assert -1100 < band[:, 1].min() < -1010
    assert f"{1000 * profile.height[19]:.4g} µm" in [text.get_text() for text in axes.texts]


def test_a_section_in_micrometres_is_stretched_as_its_title_states():
    sheet, profile = cut_of(in_micrometres(along(span=0.3)))
    axes = panel_of(draw_section, sheet.result, profile)
    axes.apply_aspect()
    (x0, y0), (x1, y1) = axes.transData.transform([(0, 0), (1, 1000)])
    assert (y1 - y0) / (x1 - x0) == pytest.approx(10)
    assert note(axes).endswith("stretched 10 times")


def test_declared_heights_have_the_displayed_unit_in_the_histogram():
    axes = panel_of(draw_histogram, in_micrometres(along()))
    assert axes.get_xlabel() == "rise (µm)"
    assert -1100 < axes.get_xlim()[0] < -1000
    median = 1000 * np.nanmedian(along().height)
    assert note(axes) == f"median {median:.4g} µm; median expected error 10 µm"


def rounded(value, shape=(6, 10)):
    """Return a constant map, up to one unit in the last place of float32."""
    values = np.full(shape, value, np.float32)
    values[::2] = np.nextafter(np.float32(value), np.float32(np.inf))
    return values


def assert_plain(axes):
    """Assert that no scale of a panel has an offset, such as 1e-5+2.8867e1."""
    FigureCanvasAgg(axes.figure).draw()
    scales = [axis for panel in (axes, *axes.child_axes) for axis in (panel.xaxis, panel.yaxis)]
    assert [axis.get_offset_text().get_text() for axis in scales] == [""] * len(scales)


def test_a_map_that_is_constant_up_to_rounding_has_one_colour():
    axes = map_of("height_sigma", io.Result(height_sigma=rounded(0.0288675)))
    (picture,) = axes.images
    assert np.ptp(picture.norm(np.asarray(picture.get_array()))) < 1e-3
    assert_plain(axes)


@pytest.mark.parametrize("scaled", [True, False])
@pytest.mark.parametrize("value", [-1.3, 700])
@pytest.mark.parametrize("draw", [draw_height, draw_section, draw_histogram])
def test_heights_that_are_constant_up_to_rounding_have_a_plain_scale(draw, value, scaled):
    places = {"x": np.arange(10.0), "y": np.arange(6.0)[::-1]} if scaled else {}
    result = in_micrometres(io.Result(height=rounded(value), **places))
    profile = (section(result),) if draw is draw_section else ()
    assert_plain(panel_of(draw, result, *profile))


def test_a_section_of_equal_heights_is_not_stretched():
    level = io.Result(height=rounded(-1.3), x=np.arange(10.0), y=np.arange(6.0)[::-1])
    axes = panel_of(draw_section, level, section(level))
    assert note(axes).endswith("true to scale")


def test_vectors_that_are_equal_up_to_rounding_have_one_colour():
    moved = np.dstack([rounded(0.003), np.zeros((6, 10), np.float32)])
    (picture,) = map_of("displacement", io.Result(displacement=moved)).images
    assert np.ptp(picture.norm(np.asarray(picture.get_array()))) < 1e-3
