"""The application's panes, without a browser: effects of a click, an option or a region."""

from types import SimpleNamespace

import numpy as np
import panel as pn
import param
import pytest
from commands import refused
from shown import ball
from stacks import record

from mirrorskin import engine, io
from mirrorskin.io.model.maps import IN_PIXELS, TABLE
from mirrorskin.twin import Axial, Twin, Vertical
from mirrorskin.view.app import App, Opening
from mirrorskin.view.app.options import read, widget_of
from mirrorskin.view.app.picture import Picture, Shown, show_map
from mirrorskin.view.app.result import ResultPane, as_text
from mirrorskin.view.app.save import SavePane
from mirrorskin.view.app.session import Session
from mirrorskin.view.app.trace import trace_of
from mirrorskin.view.result.sheet import sheet_of

SHAPE = (40, 50)
PIXEL = 0.2  # mm
TRAVEL = 0.1 * np.arange(15)
TOUCHED = 20, 32  # a pixel that turns light, away from the top, which is filled


@pytest.fixture(scope="module")
def press(tmp_path_factory):
    """A recording of a press on a ball."""
    path = tmp_path_factory.mktemp("app") / "press.h5"
    twin = Twin(object="sphere", shape=SHAPE, pixel_size=PIXEL, movement=Vertical(TRAVEL))
    record(twin, path)
    return path


@pytest.fixture(scope="module")
def turn(tmp_path_factory):
    """A recording of a rotation on a ball."""
    path = tmp_path_factory.mktemp("app") / "turn.h5"
    movement = Axial(np.arange(8) * np.pi / 4, tilt=0.04, press=1.0)
    record(Twin(object="sphere", shape=SHAPE, pixel_size=PIXEL, movement=movement, pattern="linear"), path)
    return path


@pytest.fixture
def app(press):
    opened = App(press)
    yield opened
    opened.close()


@pytest.fixture
def session(press):
    opened = Session(press)
    yield opened
    opened.close()


def test_a_recording_is_reconstructed_as_on_the_command_line(session, press):
    with io.open_recording(press) as recording:
        expected = engine.reconstruct(recording)
    np.testing.assert_array_equal(session.now.result.height, expected.height)


def test_every_option_of_the_operation_has_a_widget(app):
    declared = [name for name, option in engine.Press.options.items() if not option.python_only]
    assert list(app.options.widgets) == declared


def test_an_option_that_changes_computes_the_result_again(app, press):
    app.options.widgets["threshold"].value = 0.3
    with io.open_recording(press) as recording:
        expected = engine.reconstruct(recording, threshold=0.3)
    np.testing.assert_array_equal(app.session.now.result.height, expected.height)


def test_the_previous_result_is_kept_next_to_the_new_one(app):
    first = app.session.now
    app.options.widgets["hold"].value = 3
    assert app.session.before is first
    assert len(app.result._pair) == 2


def test_the_change_since_the_previous_result_is_shown(app):
    app.options.widgets["threshold"].value = 0.3
    app.result.compared.value = "change"
    now, before = app.session.now.result.height, app.session.before.result.height
    shown = app.result._pictures["before"].source.data["image"][0]
    np.testing.assert_allclose(shown, now - before, atol=1e-6)


def test_a_refused_option_shows_the_reason_and_keeps_the_result(app):
    first = app.session.now
    app.options.widgets["noise"].value = "-1"
    assert app.session.now is first
    assert "a number in counts of at least 0 is needed" in app.options.notes["noise"].object


def test_a_text_that_is_not_a_number_is_refused(app):
    app.options.widgets["noise"].value = "much"
    assert "noise much" in app.options.notes["noise"].object


def test_another_operation_has_its_own_options(app):
    app.options.operation.value = "mirrorskin.engine:ChangePoint"
    assert "subframe" not in app.options.widgets
    assert app.session.now.result.process["operation"] == "ChangePoint"


def test_angles_are_written_in_degrees():
    tilt = engine.Rotation.options["tilt"]
    field, _ = widget_of(tilt, 0.1)
    assert field.label == "Tilt (deg)"
    assert read(tilt, field.value) == pytest.approx(0.1, rel=1e-9)
    assert read(tilt, "estimate") == "estimate"
    assert read(tilt, "") is None


def test_a_click_shows_the_brightness_with_levels_and_the_onset(app):
    left, right, bottom, top = app.recording.picture.place
    row, column = TOUCHED
    x = left + (column + 0.5) * (right - left) / SHAPE[1]
    y = top - (row + 0.5) * (top - bottom) / SHAPE[0]
    app.recording._tapped(SimpleNamespace(x=x, y=y))
    assert app.session.pixel == TOUCHED
    trace = trace_of(app.session)
    np.testing.assert_allclose(trace.position, TRAVEL)
    assert trace.event == -app.session.now.result.height[TOUCHED]
    assert trace.event_sigma == app.session.now.result.height_sigma[TOUCHED]
    assert trace.levels["Dark"] < trace.levels["Threshold"] < trace.levels["Bright"]
    assert "Travel at the onset" in app.recording.facts.object
    assert app.recording.graph.event.location == trace.event


def test_the_threshold_of_a_pixel_follows_the_option(session):
    session.point_at(*TOUCHED)
    session.choose("threshold", 0.25)
    low, level, high = trace_of(session).levels.values()
    assert level == pytest.approx(low + 0.25 * (high - low))


def test_a_filled_pixel_has_no_onset(session):
    row, column = np.argwhere(session.now.result.filled > 0)[0]
    session.point_at(int(row), int(column))
    assert np.isnan(trace_of(session).event)


def test_a_rotation_shows_the_cosine_that_fits(turn):
    session = Session(turn)
    session.point_at(20, 32)
    trace = trace_of(session)
    with io.open_recording(turn) as recording:
        frames = np.stack([recording.frame(number) for number in range(8)])
    fit = engine.correlate(frames, np.arange(8) * np.pi / 4)
    assert trace.facts["Amplitude"] == f"{fit.modulation[20, 32]:.2f} counts"
    x, y = trace.curve
    assert y[0] == pytest.approx(fit.mean[20, 32] + fit["cosine"][20, 32], abs=1e-3)
    assert x[0] == 0
    session.close()


def test_a_region_that_is_drawn_is_used(app, press):
    left, _, bottom, top = app.recording.picture.place
    app.recording._drawn("region", (left, top), (0.0, bottom))
    assert app.session.region == io.Region((0, 40), (0, 25))
    assert app.session.now.result.height.shape == (40, 25)
    assert app.recording.dragging.box.visible
    app.recording.whole.param.trigger("clicks")
    assert app.session.region is None


def test_frames_that_are_chosen_are_used(app, press):
    slider = app.recording.frames
    slider.value = (0, 9)
    with param.edit_constant(slider):  # as the browser does when the pointer lets go
        slider.value_throttled = (0, 9)
    with io.open_recording(press, frames=(0, 9)) as recording:
        expected = engine.reconstruct(recording)
    np.testing.assert_array_equal(app.session.now.result.height, expected.height)


def test_a_pixel_outside_of_the_region_has_no_brightness(session):
    session.point_at(*TOUCHED)
    session.choose_part(io.Region((0, 10), (0, 10)), None)
    assert trace_of(session) is None


def test_a_section_is_where_it_was_drawn(app):
    app.result._drawn("section", (-2.0, 0.5), (2.0, 0.5))
    x = app.result.section.sources["now"].data["x"]
    assert x[-1] == pytest.approx(4.0)
    assert [y.tolist() for y in app.result._lines.data["y"]] == [[0.5, 0.5]]


def test_several_sections_are_drawn_and_removed(app):
    app.result._drawn("section", (-2.0, 0.5), (2.0, 0.5))
    app.result._drawn("section", (0.0, -2.0), (0.0, 2.0))
    assert app.session.ends == ((-2.0, 0.5), (2.0, 0.5))
    assert app.result.section.sources["section 2"].data["x"][-1] == pytest.approx(4.0, abs=0.2)
    app.result.uncut.param.trigger("clicks")
    assert app.session.sections == [((-2.0, 0.5), (2.0, 0.5))]
    assert len(app.result.section.sources["section 2"].data["x"]) == 0


def test_dust_is_left_out_of_the_measures(app):
    square = ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))
    app.result._drawn("mask", *square)
    result = app.session.now.result
    x, y = np.meshgrid(result.x, result.y)
    clean = result.assign(height=np.where((abs(x) < 1) & (abs(y) < 1), np.nan, result.height))
    expected = engine.measure(clean).quantities["highest point"]
    assert str(expected) in app.result.measures.object
    assert "without one area of dust" in app.result.measures.object
    app.result.unmask.param.trigger("clicks")
    assert app.session.masks == []


def test_an_option_beyond_its_limits_is_refused_with_the_message_of_the_command_line(
    app, press, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    first = app.session.now
    app.options.widgets["threshold"].value = 1.7
    assert app.session.now is first
    message = app.options.notes["threshold"].object
    assert refused("threshold 1.7", "reconstruct", press, "--threshold", "1.7", "-o", "x.h5")
    assert "threshold 1.7: a share from 0 to 1 is needed, such as 0.5" in message
    app.options.widgets["threshold"].value = 0.5
    assert not app.options.notes["threshold"].visible


def test_changes_are_undone_and_repeated_without_computing_again(app):
    first = app.session.now
    app.options.widgets["threshold"].value = 0.3
    second = app.session.now
    app.options.undo.param.trigger("clicks")
    assert app.session.now is first
    assert app.options.widgets["threshold"].value == 0.5
    assert app.session.before is second
    app.options.redo.param.trigger("clicks")
    assert app.session.now is second
    assert app.options.redo.disabled


def test_what_does_not_belong_to_the_options_is_grey(press):
    waiting, aside = [], []
    session = Session(
        press,
        run=lambda work, then: waiting.append((work, then)),
        run_aside=lambda work, then: aside.append((work, then)),
    )
    _compute(waiting)
    pane = ResultPane(session)
    _compute(waiting)
    _compute(aside)
    assert pane._body.styles["opacity"] == pane.measures.styles["opacity"] == "1"
    session.choose("threshold", 0.3)
    assert pane._body.styles["opacity"] != "1"
    work, then = waiting.pop(0)
    then(work())  # the result is there, its map is not drawn
    assert pane._body.styles["opacity"] != "1"
    _compute(waiting)
    assert pane._body.styles["opacity"] == "1"
    assert pane.measures.styles["opacity"] != "1"
    _compute(aside)
    assert pane.measures.styles["opacity"] == "1"
    session.close()


def test_nothing_is_measured_for_a_result_that_is_not_shown_any_more(press):
    aside = []
    session = Session(press, run_aside=lambda work, then: aside.append((work, then)))
    pane = ResultPane(session)
    session.choose("threshold", 0.3)
    (outdated, _), (last, _) = aside
    assert outdated() is None
    assert last() is session.measures()[0]
    assert pane._measured is None
    session.close()
    assert outdated() is None


def test_colours_are_chosen_for_each_map(app):
    app.result.palette.value, app.result.low.value, app.result.high.value = "gray", -1.0, -0.5
    picture = app.result._pictures["now"]
    assert (picture.mapper.low, picture.mapper.high) == (-1.0, -0.5)
    assert picture.mapper.palette[0] == "#000000"
    app.result.map.value = "height_sigma"
    assert app.result.palette.value == ""
    app.result.map.value = "height"
    assert app.result.low.value == -1.0


def test_measures_are_a_table_for_other_programs(app):
    quantity, value, sigma, unit = as_text(app.result._measured, ",").splitlines()[1].split(",")
    expected = app.result._measured.quantities["highest point"]
    assert (quantity, unit) == ("highest point", "mm")
    assert (float(value), float(sigma)) == (expected.value, expected.sigma)


def test_another_file_is_compared(press, tmp_path):
    with io.open_recording(press) as recording:
        io.save_result(engine.reconstruct(recording, threshold=0.3), tmp_path / "other.h5")
    app = App(press, tmp_path / "other.h5")
    app.result.other.value = 1
    assert app.session.compared.label == "other.h5, stored result"
    shown = app.result._pictures["before"].source.data["image"][0]
    np.testing.assert_array_equal(shown, io.open_result(tmp_path / "other.h5").height)
    app.close()


def test_a_pixel_is_chosen_with_the_keyboard(app):
    app.recording.row.value = TOUCHED[0]
    app.recording.column.value = TOUCHED[1]
    assert app.session.pixel == TOUCHED
    assert "Travel at the onset" in app.recording.facts.object


def test_files_of_a_folder_are_opened_from_the_page(press, tmp_path):
    io.save_result(ball(), tmp_path / "ball.h5")
    (tmp_path / "notes.txt").write_text("no surface")
    app = App(folder=tmp_path)
    assert app.session is None
    assert app.files.names.options == ["ball.h5"]
    app.files.names.value = "ball.h5"
    app.files.open.param.trigger("clicks")
    assert app.session.name == "ball.h5"


def test_folders_of_pictures_and_zarr_are_offered(tmp_path):
    for name, inside in (
        ("a", "1.bmp"),
        ("b", "1.JPG"),
        ("c", "1.pgm"),
        ("d", "zarr.json"),
        ("e", "notes.md"),
    ):
        (tmp_path / name).mkdir()
        (tmp_path / name / inside).touch()
    assert App(folder=tmp_path).files.names.options == ["a", "b", "c", "d"]


def test_a_folder_is_looked_at_when_its_list_is_opened(press):
    app = App(press, folder=press.parent)
    assert app.files.names.options == []
    next(iter(app.view.select(pn.Card))).collapsed = False
    assert app.files.names.options == ["press.h5"]


def test_a_reset_is_one_step_to_undo_and_none_without_changes(app):
    app.options.reset.param.trigger("clicks")
    assert not app.session.can_undo
    app.options.widgets["threshold"].value = 0.3
    app.options.widgets["hold"].value = 3
    app.options.reset.param.trigger("clicks")
    assert app.session.changed == {}
    app.options.undo.param.trigger("clicks")
    assert app.session.changed == {"threshold": 0.3, "hold": 3}
    app.options.undo.param.trigger("clicks")
    app.options.undo.param.trigger("clicks")
    assert not app.session.can_undo


def test_a_reset_empties_a_field_that_was_refused(app):
    app.options.widgets["threshold"].value = 1.7
    app.options.reset.param.trigger("clicks")
    assert app.options.widgets["threshold"].value == 0.5
    assert not app.options.notes["threshold"].visible


@pytest.mark.parametrize("place", ["../ball.h5", "/etc/passwd", "a/../ball.h5", "none/ball.h5"])
def test_only_what_was_dropped_is_opened_as_such(tmp_path, place):
    io.save_result(ball(), tmp_path / "ball.h5")
    (tmp_path / "drops").mkdir()
    app = App(folder=tmp_path, drops=tmp_path / "drops")
    app.files.dropped.value = place
    assert app.session is None


def test_a_large_picture_is_sent_as_a_screen_has_pixels():
    picture = Picture((0.0, 4.0, 0.0, 3.0), "mm")
    values = np.arange(3000 * 4000, dtype=np.float32).reshape(3000, 4000)
    picture.show(Shown(values, "", "", palette=["#000000"]))
    data = picture.source.data
    assert data["image"][0].shape == (750, 1000)
    assert (data["x"], data["dw"], data["dh"]) == ([0.0], [4.0], [3.0])
    picture.figure.x_range.update(start=1.0, end=1.4)
    picture.figure.y_range.update(start=1.0, end=1.3)
    picture._look_again(None)
    data = picture.source.data
    row, column = round((3.0 - data["y"][0] - data["dh"][0]) * 1000), round(data["x"][0] * 1000)
    shape = data["image"][0].shape
    np.testing.assert_array_equal(data["image"][0], values[row:, column:][: shape[0], : shape[1]])
    assert data["x"][0] <= 1.0 < 1.4 <= data["x"][0] + data["dw"][0]


def test_measures_are_those_of_the_region_that_was_drawn(app):
    app.result._drawn("region", (-4.0, 2.0), (0.0, -2.0))
    region = app.session.measured
    assert region == io.Region((10, 30), (5, 25))
    expected = engine.measure(app.session.now.result, region=region)
    assert str(expected.quantities["highest point"]) in app.result.measures.object
    app.result.restart.param.trigger("clicks")
    assert app.session.measured is None


@pytest.mark.parametrize("name", [*ball().maps()])
def test_every_map_has_colours_a_caption_and_what_the_pointer_reads(name):
    shown = show_map(sheet_of(ball()), name)
    assert shown.title == ball().declaration(name).title_of(name)
    assert shown.readings.columns
    assert shown.label or shown.legend or shown.key
    assert TABLE[name].caption[1:] in shown.caption if name in TABLE else True


def test_the_pointer_reads_a_height_with_its_standard_deviation_in_the_units_of_figures():
    result = ball()
    shown = show_map(sheet_of(result), "height")
    assert [text for text, _ in shown.readings.tooltips] == [
        "x, y",
        "Height",
        "Standard deviation",
        "Status",
        "Origin",
    ]
    finite = np.isfinite(result.height)
    whole = slice(None), slice(None)
    np.testing.assert_allclose(shown.readings.columns["value0"](whole)[finite], result.height[finite])
    finite = np.isfinite(result.height_sigma)
    np.testing.assert_allclose(
        shown.readings.columns["sigma"](whole)[finite], 1e3 * result.height_sigma[finite], 1e-6
    )


def test_in_a_notebook_scripts_come_with_the_page(app):
    assert pn.config.inline


def test_warnings_of_a_result_are_shown_at_the_head():
    app = App(ball().assign(process={"warnings": "frame 3: <lost>"}))
    assert "frame 3: &lt;lost&gt;" in app._about.object


def test_text_of_a_file_is_never_markup():
    codes = {0: "none", 1: "<img src=x onerror=alert(1)>"}
    declared = {"rust": io.Map("<b>rust</b>", codes=codes)}
    maps = {**ball(), "rust": np.ones((24, 32), np.uint8)}
    result = io.Result(maps, declarations=declared, x=ball().x, y=ball().y)
    app = App(result)
    app.result.map.value = "rust"
    assert "<img" not in app.result.caption.object
    assert "<b>" not in app.result.caption.object


def test_a_result_alone_has_no_recording_to_click(tmp_path):
    path = tmp_path / "ball.h5"
    io.save_result(ball(), path)
    app = App(path)
    assert app.recording is None
    assert app.options is None
    assert "Height" in app.result.map.options


def test_an_open_recording_and_a_result_can_be_shown_in_a_notebook(press):
    with io.open_recording(press) as recording:
        app = App(recording, ball())
        assert app.session.now.result.height.shape == SHAPE
        app.choice.value = 1
        assert app.session.now.result.height.shape == (24, 32)


def test_a_recording_is_opened_with_the_options_of_the_command_line(press):
    session = Session(press, Opening(keywords={"pixel_size": (0.4, 0.4)}))
    assert session.now.result.x[1] - session.now.result.x[0] == pytest.approx(0.4)
    session.close()


@pytest.fixture
def postponed(press):
    """A session whose computations wait, and these computations."""
    waiting = []
    session = Session(press, run=lambda work, then: waiting.append((work, then)))
    yield session, waiting
    session.close()
    _compute(waiting)


def _compute(waiting):
    while waiting:
        work, then = waiting.pop(0)
        then(work())


def test_only_the_last_of_several_changes_is_computed(postponed):
    session, waiting = postponed
    session.choose("threshold", 0.3)
    session.choose("threshold", 0.4)
    assert session.computing
    _compute(waiting)
    assert (session.now.label, session.before, session.computing) == ("threshold 0.4", None, False)


def test_a_session_that_is_closed_keeps_no_result(postponed):
    session, waiting = postponed
    session.close()
    _compute(waiting)
    assert session.now is None


@pytest.mark.filterwarnings("ignore::mirrorskin.io.MirrorskinWarning")  # the part is small
def test_a_part_is_chosen_while_another_is_computed(postponed):
    session, waiting = postponed
    session.choose_part(io.Region((0, 10), (0, 10)), (0, 9))
    _compute(waiting)
    assert session.now.result.height.shape == (10, 10)


def test_nothing_is_saved_while_a_result_is_computed(postponed):
    session, waiting = postponed
    _compute(waiting)
    session.choose("threshold", 0.3)
    with pytest.raises(io.InputError, match="is being computed"):
        SavePane(session).write()


def test_nothing_to_show_is_refused():
    with pytest.raises(io.InputError, match="name a file"):
        App()


def test_a_result_in_pixels_is_cut_masked_and_measured_in_pixels():
    session = Session(ball(x=None, y=None, declarations=IN_PIXELS))
    pane = ResultPane(session)
    session.cut(((-10.0, 0.0), (10.0, 0.0)))
    assert "from (-10, 0) to (10, 0) px" in pane.where.object
    session.mask([((-3.0, -3.0), (3.0, -3.0), (0.0, 3.0))])
    found, _ = session.measures()
    assert found.quantities["highest point"].unit == "px"
    assert any(note.startswith("pixels left out by a mask") for note in found.notes)
    assert " px\n" in as_text(found, " ")
