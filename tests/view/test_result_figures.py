"""A result has pictures of all its maps, side by side, without overlap."""

import itertools

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from shown import ball, panel

from mirrorskin import io
from mirrorskin.view.drawing.canvas import draw_image, figure_pixels
from mirrorskin.view.result import figures_of, overview, pixels_of

PRESS = ("height", "height_sigma", "status", "filled", "x", "y")
TURN = ("height", "height_sigma", "normals", "normals_sigma", "azimuth", "modulation", "edges", "contact")


def only(*names, **maps):
    whole = ball(**maps)
    return io.Result(**{name: getattr(whole, name) for name in names}, declarations=whole.declarations)


@pytest.fixture(scope="module")
def drawn():
    """A result that has everything, after it was drawn."""
    return ball()


@pytest.fixture(scope="module")
def alone(drawn):
    """Its figures."""
    return figures_of(drawn, name="ball.h5")


@pytest.fixture(scope="module")
def page(drawn):
    """All on one page."""
    return overview(drawn, name="ball.h5")


FIRST = ["height", "section", "histogram"]


def test_the_overview_leaves_out_maps_that_other_pictures_include(alone):
    assert list(alone) == [*FIRST, "height_sigma", "status", "normals", "normals_sigma", "edges"]


@pytest.mark.parametrize(
    ("result", "names"),
    [
        (only(*PRESS), [*FIRST, "height_sigma", "status"]),
        (only(*TURN), [*FIRST, "height_sigma", "normals", "normals_sigma", "edges"]),
        (only("azimuth", "modulation", "x", "y"), ["azimuth", "modulation"]),
        (only("status"), ["status"]),
        (
            io.Result(light=np.eye(24, 32), count=np.ones((24, 32), np.uint8)),
            ["light", "count"],
        ),
        (only("height", "x", "y", height=np.full((24, 32), np.nan, np.float32)), ["height", "histogram"]),
    ],
    ids=["press", "rotation", "correlation", "status", "own", "no height known"],
)
def test_the_maps_of_a_result_are_drawn_and_nothing_else(result, names):
    figures = figures_of(result, name="it")
    assert list(figures) == names
    assert all(isinstance(figure, Figure) for figure in figures.values())


def test_a_standard_deviation_is_a_figure_with_the_title_of_its_map(alone):
    titles = [alone[name].axes[0].get_title("left") for name in ("height_sigma", "normals_sigma")]
    assert titles == ["Standard deviation of the height", "Standard deviation of the normals"]


def test_the_page_has_all_pictures_under_a_title_with_a_summary(alone, page):
    titles = [axes.get_title("left") for panel in alone.values() for axes in panel.axes]
    assert [axes.get_title("left") for axes in page.axes] == titles
    name, line = (text.get_text() for text in page.texts)
    assert name == "ball.h5"
    assert line.startswith("height at ")


def test_only_what_is_asked_for_is_drawn_in_the_usual_order():
    figure = overview(ball(), name="it", maps=["status", "height"])
    assert [axes.get_title("left") for axes in figure.axes] == ["Height", "Status"]
    assert list(figures_of(ball(), name="it", maps=["modulation"])) == ["modulation"]


def test_a_missing_map_is_named_and_so_are_those_present():
    with pytest.raises(io.InputError, match=r"^it has no picture normals: it has status$"):
        overview(only("status"), name="it", maps=["status", "normals"])
    with pytest.raises(io.InputError, match=r"^it has no map to draw: 'mirrorskin export' writes all"):
        figures_of(io.Result(force=1.0), name="it")


def test_a_section_is_cut_where_it_is_asked_and_that_is_drawn_on_the_heights():
    ends = (-1.0, 0.2), (1.0, -0.4)
    figure = overview(ball(), name="it", section=ends, maps=["height", "section"])
    np.testing.assert_allclose(panel(figure, "Height").lines[1].get_xydata(), ends)
    assert panel(figure, "Section").get_xlim()[1] == pytest.approx(np.hypot(2, 0.6))


def test_a_section_in_millimetres_needs_the_pixel_size():
    with pytest.raises(io.InputError, match="--pixel-size"):
        figures_of(ball(x=None, y=None), name="it", section=((0, 0), (1, 1)))


@pytest.mark.parametrize(
    "result", [only("status", "x", "y"), ball(height=np.full((24, 32), np.nan, np.float32))]
)
def test_a_section_needs_heights(result):
    with pytest.raises(io.InputError, match="it has no heights to cut: leave the section out"):
        overview(result, name="it", section=((0, 0), (1, 1)))


def test_a_result_of_turns_needs_the_choice_of_one():
    turns = io.Result(azimuth=np.zeros((3, 4, 5), np.float32))
    with pytest.raises(io.InputError, match="--turn"):
        overview(turns, name="it")


def test_a_figure_is_as_wide_as_asked_and_the_right_side_up(alone):
    picture = pixels_of(alone["status"], 700)
    assert picture.shape[1] == 700
    title, below = (picture[rows].min(axis=(1, 2)) for rows in (slice(0, 40), slice(-8, None)))
    assert title.min() < 100  # the name stands above
    assert below.min() > 200


@pytest.mark.parametrize(
    "result",
    [ball((24, 32), (0.00041, 0.00037), radius=0.006), ball((60, 9)), ball((1, 40), y=np.array([-0.00557]))],
    ids=["tiny pixels", "upright", "one row"],
)
def test_no_panel_is_on_another_or_beyond_the_page(result):
    figure = overview(result, name="a name that is rather long, of somebody's own " * 5)
    renderer = FigureCanvasAgg(figure).get_renderer()
    boxes = [axes.get_tightbbox(renderer) for axes in figure.axes]
    boxes += [text.get_window_extent(renderer) for text in figure.texts]
    assert len(boxes) == 10
    for box in boxes:
        assert figure.bbox.x0 <= box.x0 < box.x1 <= figure.bbox.x1
        assert figure.bbox.y0 <= box.y0 < box.y1 <= figure.bbox.y1
    for first, other in itertools.combinations(boxes, 2):
        assert not first.overlaps(other)


@pytest.mark.parametrize(("shape", "panels"), [((1, 1), 7), ((9, 1), 7), ((7, 200), 8)])
def test_the_smallest_and_the_longest_pictures_are_drawn(shape, panels):
    figure = overview(ball(shape), name="it")
    titles = [axes.get_title("left") for axes in figure.axes]
    assert len(titles) == panels
    assert ("Section" in titles) == (panels == 8)  # of a single point there is none


@pytest.mark.usefixtures("alone", "page")
def test_drawing_does_not_change_the_result(drawn):
    before = ball().maps()
    for name, values in drawn.maps().items():
        np.testing.assert_array_equal(values, before[name])


def test_warnings_are_below_the_summary():
    doubtful = ball().assign(process={"warnings": "frame 3: lost"})
    texts = [text.get_text() for text in overview(doubtful, name="a.h5").texts]
    assert texts[-1] == "Warning: frame 3: lost"


@pytest.mark.parametrize("kind", ["numbers", "colours"])
def test_a_map_larger_than_its_picture_is_thinned_out_only_to_be_drawn(kind):
    ramp = np.broadcast_to(np.linspace(0, 250, 1000), (800, 1000))
    values = ramp if kind == "numbers" else np.stack([ramp.astype(np.uint8)] * 3, axis=-1)
    style = (
        {"cmap": "gray", "vmin": 0, "vmax": 255} if kind == "numbers" else {"interpolation": "antialiased"}
    )
    figure = Figure(figsize=(2, 2))
    picture = draw_image(figure.add_axes((0, 0, 1, 1)), values, aspect="auto", **style)
    drawn = figure_pixels(figure, 100)
    assert picture.get_array().shape == values.shape
    expected = np.linspace(0, 250, 200)
    np.testing.assert_allclose(drawn[100, 5:-5, 0], expected[5:-5], atol=3)
