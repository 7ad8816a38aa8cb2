"""Known heights, from results and simulations."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
from stacks import random_stack, record, sphere

from mirrorskin import io


def heights():
    values = np.linspace(-1, 0, 35, dtype=np.float32).reshape(5, 7)
    values[2, 3] = np.nan
    return values


def nothing(path):
    path.unlink(missing_ok=True)


def stack(path):
    with h5py.File(path, "w") as file:
        file["x"] = random_stack()


@pytest.mark.parametrize(
    ("make", "line"),
    [
        (
            lambda path: io.save_result(io.Result(zenith=heights()), path),
            "contains no heights: give a result of a",
        ),
        (lambda path: record(sphere(), path), "contains no heights: give a result of a press, or a"),
        (
            lambda path: io.save_result(
                io.Result(height=heights(), fitted=io.Fitted(undistorted=True)), path
            ),
            "contains undistorted heights, but frames are not undistorted",
        ),
        (stack, "is not a result: 'mirrorskin reconstruct' computes one from a recording"),
        (nothing, "no such file"),
        (lambda path: path.write_text("-0.1 -0.2"), "is not an HDF5 file"),
    ],
)
def test_a_file_without_heights_is_one_line(tmp_path, make, line):
    path = tmp_path / "bad.h5"
    make(path)
    with pytest.raises(io.InputError, match=line) as caught:
        io.open_heights(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_heights_of_unknown_offset_are_left_out(tmp_path):
    piece = np.zeros((5, 7), np.int32)
    piece[:, 4:] = 1
    result = io.Result(height=heights(), component=piece, offset_unknown=np.array([1, 0], np.uint8))
    io.save_result(result, tmp_path / "r.h5")
    actual = io.open_heights(tmp_path / "r.h5")
    assert np.isnan(actual[:, :4]).all()
    np.testing.assert_array_equal(actual[:, 4:], heights()[:, 4:])


ROWS, COLUMNS = (1, 4), (2, 6)


def simulation(path):
    twin = sphere()
    return record(twin, path, truth=twin.truth), twin.truth.height


def source_region(tmp_path, region, shape=(5, 7)):
    """The heights in a result that tells which part it is of, cut for a region of a recording."""
    rows, columns = shape
    values = np.arange(rows * columns, dtype=np.float32).reshape(shape)
    fitted = io.Fitted(source_region=region)
    io.save_result(io.Result(height=values, fitted=fitted), tmp_path / "h.h5", overwrite=True)
    path, _ = simulation(tmp_path / "r.h5")
    with io.open_recording(path, region=io.Region(ROWS, COLUMNS)) as source:
        return io.open_heights(tmp_path / "h.h5", source), values


def test_the_truth_is_cut_for_a_region(tmp_path):
    path, height = simulation(tmp_path / "r.h5")
    with io.open_recording(path, region=io.Region(ROWS, COLUMNS)) as source:
        np.testing.assert_array_equal(io.open_heights(path, source), height[1:4, 2:6])
    with io.open_recording(path) as source:
        np.testing.assert_array_equal(io.open_heights(path, source), height)


def test_the_heights_of_a_result_are_cut_for_a_region(tmp_path):
    for region in (None, (0, 5, 0, 7)):
        actual, values = source_region(tmp_path, region)
        np.testing.assert_array_equal(actual, values[1:4, 2:6])
    actual, values = source_region(tmp_path, (1, 4, 1, 7), (3, 6))
    np.testing.assert_array_equal(actual, values[:, 1:5])
    actual, values = source_region(tmp_path, (1, 4, 2, 6), (3, 4))
    np.testing.assert_array_equal(actual, values)


@pytest.mark.parametrize(
    ("region", "shape"),
    [((1, 4, 3, 7), (3, 4)), ((1, 3, 2, 6), (2, 4)), (None, (6, 7))],
)
def test_heights_of_other_pixels_are_refused(tmp_path, region, shape):
    with pytest.raises(io.InputError, match=r"h\.h5 contains the heights of rows .* and columns .*, where "):
        source_region(tmp_path, region, shape=shape)
