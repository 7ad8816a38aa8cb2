"""Figures of heights are drawn, and errors state which maps are missing."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from mpl_toolkits.mplot3d import Axes3D

from mirrorskin import io, view
from mirrorskin.view import truth as heights

KINDS = pytest.mark.parametrize("surface", [False, True], ids=["brightness", "surface"])


def slope(shape=(20, 30)):
    """Heights that differ at every pixel, and fall to the lower right."""
    return np.fromfunction(lambda row, column: -0.01 * column - 0.0001 * row, shape).astype(np.float32)


def result_of(height, **maps):
    x, y = io.pixel_axes(height.shape, (0.1, 0.2))
    return io.Result(height=height, x=x, y=y, **maps)


def filled_in(shape=(20, 30)):
    """Marks of a block that was filled, across the middle row."""
    filled = np.zeros(shape, np.uint8)
    filled[8:13, 10:15] = 1
    return filled


def truth_of(height):
    return io.Truth(height, *(np.zeros_like(height) for _ in range(2)), np.ones(height.shape, np.uint8))


def figure_of(results, truth, **options):
    """Draw a figure, and return it."""
    kept = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(heights, "save_figure", lambda figure, title, path, resolution: kept.append(figure))
        view.height_figure(results, truth, "title", Path("a.png"), **options)
    return kept[0]


def draw(results, truth, surface=False):
    """Draw a figure; return the axes of the first whole, and those of the section."""
    figure = figure_of(results, truth, surface=surface)
    return figure.axes[0], panel(figure, "section")


def title_of(axes):
    """Return the title of a panel without its letter."""
    return axes.get_title("left").partition("  ")[2]


def note_of(axes):
    """Return the note below the title of a panel."""
    return axes.texts[0].get_text()


def panel(figure, title):
    return next(axes for axes in figure.axes if title_of(axes) == title)


def legend_of(figure):
    (legend,) = figure.legends
    return [text.get_text() for text in legend.get_texts()]


@pytest.fixture
def styles():
    """How these surfaces are drawn."""
    return []


@pytest.fixture
def surfaces(monkeypatch, styles):
    """The x, y and z of all surfaces that are drawn."""
    drawn = []
    plot = Axes3D.plot_surface

    def plot_surface(axes, *options, **style):
        drawn.append(options)
        styles.append(style)
        return plot(axes, *options, **style)

    monkeypatch.setattr(Axes3D, "plot_surface", plot_surface)
    return drawn


@pytest.mark.parametrize(
    ("kinds", "surface"),
    [(("slope", "nothing"), False), (("pixel", "filled"), True)],
)
def test_height_maps_become_a_picture(tmp_path, kinds, surface):
    pixel = np.arange(600).reshape(20, 30) == 44
    masks = {"slope": True, "nothing": False, "pixel": pixel, "filled": filled_in() == 1}
    results = {
        kind: result_of(
            np.where(masks[kind], slope(), np.float32(np.nan)),
            filled=filled_in() if kind == "filled" else None,
        )
        for kind in kinds
    }
    path = tmp_path / "slope.png"
    view.height_figure(results, truth_of(slope()), "title", path, surface=surface)
    picture = cv2.imread(str(path))
    assert picture.shape[0] > 300
    assert len(np.unique(picture @ (1 << 16, 1 << 8, 1))) > 30  # colours


def test_a_figure_needs_heights_and_a_place_to_go(tmp_path):
    height = np.zeros((4, 5), np.float32)
    result, truth = result_of(height), truth_of(height)
    for lacking in (io.Result(height=height), io.Result(x=result.x, y=result.y)):
        for results in ({"a": lacking}, {"a": result, "b": lacking}):
            with pytest.raises(io.InputError, match="heights and the pixel size"):
                view.height_figure(results, truth, "", tmp_path / "a.png")
    assert not list(tmp_path.iterdir())
    with pytest.raises(io.InputError, match="no folder"):
        view.height_figure({"a": result}, truth, "", tmp_path / "missing" / "a.png")


def test_what_cannot_be_drawn_is_refused():
    one_row, larger = result_of(np.zeros((1, 5), np.float32)), result_of(np.zeros((4, 5), np.float32))
    with pytest.raises(io.InputError, match="2 x 2 pixels"):
        draw({"a": one_row}, truth_of(one_row.height))
    with pytest.raises(io.InputError, match="not of one stack"):
        draw({"a": larger}, truth_of(one_row.height))
    with pytest.raises(io.InputError, match="not of one stack"):
        draw({"a": larger, "b": result_of(slope())}, truth_of(larger.height))


def test_the_first_map_is_as_the_picture_does():
    height = slope()
    height[3, 4] = np.nan
    left, _ = draw({"first": result_of(height), "second": result_of(2 * height)}, truth_of(height))
    picture = left.get_images()[0]
    np.testing.assert_array_equal(np.ma.filled(picture.get_array(), np.nan), height)
    assert picture.origin == "upper"
    np.testing.assert_allclose(picture.get_extent(), (-1.5, 1.5, -2.0, 2.0))


@KINDS
@pytest.mark.parametrize("count", [1, 4])
def test_the_first_and_the_last_are_drawn_as_a_whole(surfaces, surface, count):
    results = {f"sensor {k}": result_of(slope() - np.float32(0.1 * k)) for k in range(count)}
    figure = figure_of(results, truth_of(slope()), surface=surface)
    wholes = [axes for axes in figure.axes if title_of(axes).startswith("sensor")]
    expected = ["sensor 0"] if count == 1 else ["sensor 0", f"sensor {count - 1}"]
    assert [title_of(axes) for axes in wholes] == expected
    drawn = surfaces if surface else [axes.get_images()[0].get_array() for axes in wholes]
    for name, shown in zip(expected, drawn, strict=True):
        height = results[name].height
        if surface:
            assert np.nanmax(shown[2]) == pytest.approx(height.max(), abs=1e-3)
        else:
            np.testing.assert_array_equal(shown, height)


def test_higher_is_lighter_and_what_is_not_known_has_a_colour_of_its_own():
    height = slope()
    left, _ = draw({"a": result_of(height)}, truth_of(height))
    picture = left.get_images()[0]
    colours = picture.cmap(picture.norm(height))
    lightness = colours[0, :, :3] @ (0.2126, 0.7152, 0.0722)
    assert np.all(np.diff(lightness) < 0)  # the slope falls to the right
    unknown = to_rgb(left.get_facecolor())
    assert np.linalg.norm(colours[..., :3] - unknown, axis=-1).min() > 0.2
    assert picture.cmap.get_bad()[3] == 0  # and shows through where there is no answer


def test_a_surface_is_drawn_over_the_field(surfaces):
    height = slope()
    height[4:9, 10:15] = np.nan
    axes, _ = draw({"a": result_of(height)}, truth_of(height), surface=True)
    ((across, up, shown),) = surfaces
    x, y = io.pixel_axes(height.shape, (0.1, 0.2))
    np.testing.assert_array_equal(across, np.broadcast_to(x, height.shape))
    np.testing.assert_array_equal(up, np.broadcast_to(y[:, np.newaxis], height.shape))
    np.testing.assert_array_equal(shown, height)
    for (low, high), place in zip((axes.get_xlim(), axes.get_ylim()), (x, y), strict=True):
        assert low <= place.min() < place.max() <= high
    assert axes.get_zlim()[0] <= np.nanmin(shown)


@KINDS
def test_all_results_are_cut_across_the_middle_against_the_truth(surface):
    truth = slope()
    results = {f"sensor {number}": result_of(truth - np.float32(0.1 * number)) for number in range(1, 5)}
    _, right = draw(results, truth_of(truth), surface)
    lines = {line.get_label(): line for line in right.get_lines()}
    assert list(lines) == ["truth", *results]
    x, _ = io.pixel_axes(truth.shape, (0.1, 0.2))
    for name, line in lines.items():
        np.testing.assert_array_equal(line.get_xdata(), x)
        expected = truth if name == "truth" else results[name].height
        np.testing.assert_array_equal(line.get_ydata(), expected[10])
    assert len({to_rgb(line.get_color()) for line in lines.values()}) == len(lines)
    named = {text.partition(":")[0] for text in legend_of(right.figure)}
    assert named == set(lines)
    lowest, highest = right.get_ylim()
    assert lowest < min(result.height.min() for result in results.values())
    assert highest > 0


@pytest.mark.parametrize(
    ("empty", "surface"), [("first", False), ("second", False), ("first", True), ("both", True)]
)
def test_a_result_without_any_answer_is_shown_as_such(empty, surface):
    truth = slope()
    nothing = np.full_like(truth, np.nan)
    results = {name: result_of(nothing if empty in (name, "both") else truth) for name in ("first", "second")}
    left, right = draw(results, truth_of(truth), surface)
    lines = {line.get_label(): line.get_ydata() for line in right.get_lines()}
    assert np.isnan(lines["first"]).all() == (empty != "second")
    np.testing.assert_array_equal(lines["truth"], truth[10])
    assert np.all(np.isfinite([*left.get_xlim(), *left.get_ylim(), *right.get_ylim()]))
    assert right.get_ylim()[0] < truth[10].min()


def test_what_was_filled_is_orange_on_a_map_and_as_bright_as_it_is_high():
    height = slope()
    plain, _ = draw({"a": result_of(height, filled=np.zeros(height.shape, np.uint8))}, truth_of(height))
    assert len(plain.get_images()) == 1
    assert "filled" not in note_of(plain)
    axes, _ = draw({"a": result_of(height, filled=filled_in())}, truth_of(height))
    assert note_of(axes) == "filled: 4 %"  # 25 of 600
    grey, orange = axes.get_images()
    for picture, part in ((grey, filled_in() == 0), (orange, filled_in() == 1)):
        shown = np.ma.filled(picture.get_array(), np.nan)
        np.testing.assert_array_equal(shown, np.where(part, height, np.nan))
        assert picture.get_extent() == grey.get_extent()
        assert picture.norm.vmin == grey.norm.vmin
        assert picture.norm.vmax == grey.norm.vmax
    colours = orange.cmap(orange.norm(np.linspace(height.min(), height.max(), 9)))[:, :3]
    assert np.all(colours[:, 0] - colours[:, 2] > 0.15)  # red above blue at any height
    assert np.all(np.diff(colours.sum(axis=1)) > 0)
    bars = [bar.texts[0].get_text() for bar in axes.child_axes]
    assert bars == ["measured", "filled"]


def test_a_surface_is_shown_as_measured_and_then_filled_in_a_colour_of_its_own(surfaces, styles):
    height = slope()
    result = result_of(height, filled=filled_in())
    measured, closed = figure_of({"a": result}, truth_of(height), surface=True).axes[:2]
    np.testing.assert_array_equal(np.isnan(surfaces[0][2]), filled_in() == 1)
    np.testing.assert_array_equal(surfaces[1][2], height)
    red, green, blue, _ = np.moveaxis(styles[1]["facecolors"], -1, 0)
    np.testing.assert_array_equal((red > green + 0.1) & (green > blue), filled_in() == 1)
    assert [title_of(axes) for axes in (measured, closed)] == ["a", "the same, holes filled"]
    assert "holes: no answer" in note_of(measured)
    assert "holes" not in note_of(closed)


def test_a_surface_has_labels_with_units_and_states_its_scale():
    figure = figure_of({"a": result_of(slope())}, truth_of(slope()), surface=True)
    axes = figure.axes[0]
    assert [axis.get_label_text() for axis in (axes.xaxis, axes.yaxis, axes.zaxis)] == [
        f"{name} (mm)" for name in "xyz"
    ]
    assert note_of(axes) == "heights stretched 5 times"  # 0.3 mm of 4 mm
    low, high = axes.get_zlim()
    _, length, depth = axes._box_aspect
    assert depth / length == pytest.approx(5 * (high - low) / np.ptp(axes.get_ylim()))


def test_surfaces_share_a_vertical_scale_that_holds_all_but_outliers():
    deep = np.asarray(slope() - np.float32(0.2))
    deep[3, 4] = -7
    results = {"a": result_of(slope()), "b": result_of(deep)}
    figure = figure_of(results, truth_of(slope()), surface=True)
    first, last = (axes for axes in figure.axes if isinstance(axes, Axes3D))
    assert first.get_zlim() == last.get_zlim()
    assert first.get_zlim()[0] == pytest.approx(slope().min() - 0.2)
    assert first.get_zlim()[1] >= 0
    assert "1 px below the axis" in note_of(last)
    assert "axis" not in note_of(first)


def test_a_detail_has_a_scale_of_its_own():
    height = slope()
    figure = figure_of({"a": result_of(height)}, truth_of(height), detail=(-0.1, 0.0))
    norm = figure.axes[0].get_images()[0].norm
    assert (norm.vmin, norm.vmax) == (-0.1, 0.0)
    assert panel(figure, "section").get_ylim()[0] < -0.3
    low, high = panel(figure, "section, enlarged").get_ylim()
    assert low == -0.1
    assert 0 < high < 0.02


@KINDS
def test_the_first_frame_of_a_press_is_marked(surface):
    figure = figure_of({"a": result_of(slope())}, truth_of(slope()), surface=surface, first_travel=0.02)
    (line,) = [line for line in panel(figure, "section").get_lines() if line.get_linestyle() == ":"]
    np.testing.assert_array_equal(line.get_ydata(), -0.02)
    assert "first frame, at 0.02 mm: nothing higher is measured" in legend_of(figure)


def test_errors_of_maps_share_a_scale_and_state_their_rms():
    results = {"a": result_of(slope() + np.float32(0.002)), "b": result_of(slope() - np.float32(0.004))}
    figure = figure_of(results, truth_of(slope()))
    first, last = panel(figure, "error of a"), panel(figure, "error of b")
    assert first.get_images()[0].norm.vmax == last.get_images()[0].norm.vmax == pytest.approx(4, rel=1e-3)
    assert (note_of(first), note_of(last)) == ("RMS 2 \N{MICRO SIGN}m", "RMS 4 \N{MICRO SIGN}m")
    assert "b: RMS error 4 \N{MICRO SIGN}m" in legend_of(figure)


def test_a_figure_shows_the_part_of_the_field_with_heights():
    height = np.where(filled_in() == 1, slope(), np.float32(np.nan))
    axes, section = draw({"a": result_of(height)}, truth_of(slope()))
    x, y = io.pixel_axes(height.shape, (0.1, 0.2))
    left, right = axes.get_xlim()
    assert x[8] < left < x[9]
    assert x[15] < right < x[16]
    assert section.get_xlim() == (left, right)
    assert axes.get_ylim()[0] < y[12] < y[8] < axes.get_ylim()[1]


@KINDS
def test_what_was_filled_is_open_on_the_cut(surface):
    height = slope()
    _, right = draw({"a": result_of(height, filled=filled_in())}, truth_of(height), surface)
    _, measured, filled = right.get_lines()[:3]
    inside = filled_in()[10] == 1
    np.testing.assert_array_equal(np.isnan(measured.get_ydata()), inside)
    np.testing.assert_array_equal(np.isnan(filled.get_ydata()), ~inside)
    np.testing.assert_array_equal(filled.get_ydata()[inside], height[10][inside])
    assert filled.get_markerfacecolor() == "none"
    assert filled.get_color() == measured.get_color()
    assert "open: filled" in legend_of(right.figure)


def test_components_that_know_no_height_are_moved_to_the_truth_and_the_others_are_not():
    truth = slope()
    component = np.zeros(truth.shape, np.int32)
    component[:, 10:] = 1
    component[:, 20:] = 2
    component[5] = -1
    height = np.where(component < 0, np.nan, truth + np.select([component == 1, component == 2], [3, -4], 1))
    result = result_of(
        height.astype(np.float32), component=component, offset_unknown=np.array([0, 1, 1], np.uint8)
    )
    kept = result.height.copy()
    axes, _ = draw({"a": result}, truth_of(truth))
    shown = np.ma.filled(axes.get_images()[0].get_array(), np.nan)
    expected = np.where(component < 0, np.nan, truth + (component == 0))
    np.testing.assert_allclose(shown, expected, atol=1e-6)
    np.testing.assert_array_equal(result.height, kept)
    assert "mean height set to the true one" in note_of(axes)
    moved = result_of(kept, component=component, offset_unknown=np.zeros(3, np.uint8))
    axes, _ = draw({"a": moved}, truth_of(truth))
    np.testing.assert_array_equal(np.ma.filled(axes.get_images()[0].get_array(), np.nan), kept)
    assert "mean height" not in note_of(axes)
