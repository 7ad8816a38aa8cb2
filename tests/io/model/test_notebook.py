import base64
import re

import cv2
import numpy as np
import pytest
from stacks import record, sphere

from mirrorskin import engine, io
from mirrorskin.io import Result, pixel_axes

HEIGHT = np.array([[0.0, -0.5, np.nan], [-1.0, -1.5, -2.0]], np.float32)


@pytest.fixture
def result():
    x, y = pixel_axes(HEIGHT.shape, (0.5, 0.25))
    return Result(
        height=HEIGHT,
        height_sigma=np.full_like(HEIGHT, 0.01),
        status=np.ones(HEIGHT.shape, np.uint8),
        x=x,
        y=y,
        process={"source": "press.h5"},
    )


def test_a_printed_result_lists_its_maps(result):
    assert repr(result).splitlines() == [
        "Result of press.h5",
        "  height        2 x 3           -2 to 0 mm, 83% known",
        "  height_sigma  2 x 3           0.01 to 0.01 mm",
        "  status        2 x 3           1 to 1",
    ]


def test_in_a_notebook_it_draws_its_heights(result):
    (data,) = re.findall(r"base64,([^']+)'", result._repr_html_())
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(picture[..., 3] == 0, np.isnan(HEIGHT))
    assert picture[0, 0, :3].sum() > picture[1, 2, :3].sum()  # high is light


def test_as_xarray_it_has_places_units_and_sigmas(result):
    dataset = result.to_xarray()
    assert float(dataset.height.sel(x=-0.5, y=-0.125)) == -1.0
    assert (
        dataset.x.attrs["units"]
        == dataset.height.attrs["units"]
        == dataset.height_sigma.attrs["units"]
        == "mm"
    )
    assert dataset.attrs["source"] == "press.h5"


def test_turns_and_vectors_have_dimensions_of_their_own():
    normals = np.zeros((4, 2, 3, 3), np.float32)
    dataset = Result(normals=normals, zenith=normals[..., 0]).to_xarray()
    assert dataset.normals.dims == ("turn", "y", "x", "vector")
    assert dataset.zenith.dims == ("turn", "y", "x")


def test_a_dataset_becomes_the_result_again(result):
    back = io.Result.from_xarray(result.to_xarray())
    for name, values in result.maps().items():
        np.testing.assert_array_equal(back.maps()[name], values)
        assert back.maps()[name].dtype == values.dtype
    np.testing.assert_array_equal(back.x, result.x)
    assert dict(back.process) == dict(result.process)
    assert back.numbers() == result.numbers()


def test_what_is_known_of_maps_is_an_attribute_of_the_dataset(result):
    expected = io.Fitted(
        tilt=0.05, registered=True, event="onset", height_correlation=np.inf, source_region=(1, 4, 2, 6)
    )
    dataset = result.assign(fitted=expected).to_xarray()
    assert io.Result.from_xarray(dataset).fitted == expected
    dataset.attrs["fitted"] = '{"tilt": "steep", "source_region": [4, 1, 2, 6], "turns": 3}'
    assert io.Result.from_xarray(dataset).fitted == io.Fitted(turns=3)
    dataset.attrs["fitted"] = "tilt=3"
    with pytest.raises(io.InputError, match="attribute fitted is no JSON text"):
        io.Result.from_xarray(dataset)
    del dataset.attrs["fitted"]
    dataset.attrs["travel"] = 0.5  # of another program
    assert io.Result.from_xarray(dataset).fitted == io.Fitted(travel=0.5)


def test_a_map_is_drawn_where_its_pixels_are(result):
    axes = result.plot("height")
    (image,) = axes.images
    np.testing.assert_array_equal(image.get_array(), result.height)
    first, right, bottom, top = image.get_extent()
    half = (result.x[1] - result.x[0]) / 2
    assert (first, right) == pytest.approx((result.x[0] - half, result.x[-1] + half))
    assert bottom < top
    assert axes.figure.axes[1].get_ylabel() == "height mm"


def test_what_is_not_a_picture_is_not_drawn(result):
    with pytest.raises(io.InputError, match=r"the result has no picture depth: it has height"):
        result.plot("depth")


def test_what_functions_return_shows_itself_in_a_few_lines():
    frames = np.zeros((5, 30, 40), np.uint8)
    frames[3:] = 250
    onset = engine.find_onset(frames, [0.0, 0.1, 0.2, 0.3, 0.4], dark=0, bright=250)
    assert repr(onset).splitlines()[:2] == [
        "Result of find_onset",
        "  height        30 x 40         -0.25 to -0.25 mm",
    ]
    assert "<img" in onset._repr_html_()
    assert onset.plot().get_xlabel() == "column"
    surface = engine.integrate(np.zeros((8, 9)), np.zeros((8, 9)), 0.1)
    assert repr(surface).startswith("Result\n  height        8 x 9")


def test_a_recording_shows_itself_in_a_line_and_a_picture(tmp_path):
    record(sphere(), tmp_path / "rec.h5")
    with io.open_recording(tmp_path / "rec.h5") as recording:
        count, rows, columns = recording.shape
        assert f"rec.h5: {count} frames of {columns} x {rows} uint8, vertical motion" in repr(recording)
        assert "<img alt='last frame" in recording._repr_html_()


@pytest.fixture
def filled(result):
    return result.assign(filled=np.array([[0, 1, 0], [0, 0, 1]], np.uint8))


def picture_in(html):
    (data,) = re.findall(r"base64,([^']+)'", html)
    return cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_UNCHANGED)


def test_filled_heights_are_orange_in_a_notebook(filled, result):
    html = filled._repr_html_()
    assert "orange: filled, not measured (0.33 of the pixels)" in html
    marked, plain = picture_in(html), picture_in(result._repr_html_())
    np.testing.assert_array_equal((marked != plain).any(axis=-1), filled.filled > 0)
    blue, _, red, _ = marked[0, 1]
    assert red > blue


def test_filled_heights_are_orange_in_a_plot(filled):
    axes = filled.plot()
    heights, marks = axes.images
    np.testing.assert_array_equal(marks.get_array().mask, filled.filled == 0)
    assert marks.get_clim() == heights.get_clim()
    assert axes.get_title() == "orange: filled, not measured (0.33 of the pixels)"
    assert len(filled.plot("height_sigma").images) == 1


def test_the_text_of_a_result_states_what_is_filled_and_measured_leaves_it_out(filled):
    assert repr(filled).splitlines()[1].endswith("-2 to 0 mm, 83% known, 0.33 filled")
    np.testing.assert_array_equal(filled.measured(), [[0.0, np.nan, np.nan], [-1.0, -1.5, np.nan]])


def test_warnings_are_shown_with_the_maps(result):
    doubtful = result.assign(process={"source": "press.h5", "vertical_warnings": "frame 3 < 4: lost"})
    assert repr(doubtful).splitlines()[-1] == "  warning: frame 3 < 4: lost"
    assert "<b>Warning:</b> frame 3 &lt; 4: lost" in doubtful._repr_html_()
