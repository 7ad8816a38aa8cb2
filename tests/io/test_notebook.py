import base64
import re

import cv2
import numpy as np
import pytest

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


def test_printed_it_says_what_it_holds(result):
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
