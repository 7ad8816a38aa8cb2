"""Functions of maps accept results, mappings, datasets, files and arrays."""

import re

import numpy as np
import pytest
import xarray
from height_maps import cap, places
from moved_surfaces import bumpy, sampled

from mirrorskin import engine, io
from mirrorskin.engine.base.inputs import as_result
from mirrorskin.engine.metrology import section

SHAPE, PIXEL = (60, 80), (0.05, 0.05)
X, Y = io.pixel_axes(SHAPE, PIXEL)
KINDS = ["declared", "mapping", "lists", "dataset", "converted", "upwards", "file"]


def as_kind(result, kind, folder):
    """A result's heights and normals as a user has them."""
    maps = {name: result[name] for name in result}
    if kind == "declared":
        renamed = {name.replace("height", "depth"): values for name, values in maps.items()}
        depth = io.Map("depth of the wear", "mm", quantity="height")
        return io.Result(renamed, x=result.x, y=result.y, declarations={"depth": depth})
    if kind in ("mapping", "lists"):
        maps |= {"x": result.x, "y": result.y}
        return maps if kind == "mapping" else {name: values.tolist() for name, values in maps.items()}
    if kind == "file":
        io.save_result(result, folder / "worn.h5", overwrite=True)
        return folder / "worn.h5"
    dataset = result.to_xarray()
    if kind == "upwards":  # as datasets of geography have it: y rises with the row, and x comes first
        return dataset.isel(y=slice(None, None, -1)).transpose("x", "y", ...)
    if kind == "converted":
        for name in ("height", "height_sigma", "x", "y"):
            dataset = dataset.assign({name: (dataset[name] * 1000.0).assign_attrs(units="um")})
    return dataset


def surface(vector=(0, 0, 0), shift=(0, 0, 0), seed=0):
    return sampled(bumpy, vector, shift, rng=np.random.default_rng(seed))


@pytest.mark.parametrize("kind", KINDS)
def test_everything_is_measured_alike(kind, tmp_path):
    noise = np.random.default_rng(0).normal(0, 0.001, SHAPE)
    result = io.Result(
        height=(cap(SHAPE, PIXEL, 5.0, 1.2) + noise).astype(np.float32),
        height_sigma=np.full(SHAPE, 0.001, np.float32),
        x=X,
        y=Y,
    )
    ends = (-1.0, 0.3), (1.0, -0.2)
    expected, actual = (
        engine.measure(source, section=ends) for source in (result, as_kind(result, kind, tmp_path))
    )
    assert actual.notes == expected.notes
    for name, quantity in expected.quantities.items():
        same = actual.quantities[name]
        # Without the noise, differences of two larger numbers are left.
        close = 1e-3 if name.endswith("without noise") else 1e-5
        assert same.value == pytest.approx(quantity.value, rel=close, abs=1e-9, nan_ok=True), name
        assert same.sigma == pytest.approx(quantity.sigma, rel=close, abs=1e-9, nan_ok=True), name
    np.testing.assert_allclose(
        section(as_kind(result, kind, tmp_path), *ends).height, section(result, *ends).height, rtol=1e-6
    )


@pytest.mark.parametrize("kind", KINDS)
def test_motions_are_estimated_and_touches_stitched_alike(kind, tmp_path):
    first, second = surface(), surface((0.02, -0.01, 0.05), (-0.4, 0.1, 0.02), 1)
    other = as_kind(second, kind, tmp_path)
    expected, actual = (engine.pose.estimate_pose(first, touch) for touch in (second, other))
    np.testing.assert_allclose(actual.translation, expected.translation, atol=1e-7)
    np.testing.assert_allclose(actual.sigma, expected.sigma, rtol=1e-4)
    trackers = [engine.pose.PoseTracker() for _ in range(2)]
    for tracker in trackers:
        tracker.push(first)
    expected, actual = (tracker.push(touch) for tracker, touch in zip(trackers, (second, other), strict=True))
    np.testing.assert_allclose(actual.translation, expected.translation, atol=1e-7)
    whole, together = (engine.pose.stitch([first, touch]).result for touch in (second, other))
    np.testing.assert_allclose(together.height, whole.height, atol=1e-6)
    assert together.process["touch_1"] == (str(other) if kind == "file" else "result 1")


@pytest.mark.parametrize("kind", KINDS)
def test_errors_are_scored_alike(kind, tmp_path):
    result, flat = surface(), np.zeros(SHAPE, np.float32)
    truth = io.Truth(bumpy(*places(SHAPE, PIXEL))[0], flat, flat, np.ones(SHAPE, np.uint8))
    expected, actual = (engine.score(heights, truth) for heights in (result, as_kind(result, kind, tmp_path)))
    assert actual.height.rms == pytest.approx(expected.height.rms, rel=1e-5)
    assert actual.height.chi_square == pytest.approx(expected.height.chi_square, rel=1e-5)
    assert actual.normal.rms == pytest.approx(expected.normal.rms, rel=1e-5)


def test_an_array_is_the_height():
    height = cap(SHAPE, PIXEL, 5.0, 1.2)
    expected = engine.measure(io.Result(height=height, x=X, y=Y))
    array = xarray.DataArray(height, dims=("y", "x"), coords={"x": X, "y": Y})
    for measured in (engine.measure(height, pixel_size=PIXEL), engine.measure(array)):
        assert measured.quantities["sphere radius"].value == pytest.approx(
            expected.quantities["sphere radius"].value
        )
    masked = engine.measure(np.ma.masked_invalid(height), pixel_size=0.05)
    assert masked.quantities["measured area"] == expected.quantities["measured area"]


def test_numbers_and_texts_of_a_mapping_go_to_the_process_and_declared_ones_to_fitted():
    result = as_result(
        {"height": [[0.0, 1.0]], "travel": 0.5, "source": "scanner", "force": 2.0, "normals": None}
    )
    assert result.process == {"travel": 0.5, "source": "scanner"}
    assert result.fitted == io.Fitted(travel=0.5)
    assert (result.force, result.normals, list(result)) == (2.0, None, ["height", "force"])


FLAT = np.zeros((2, 3))


@pytest.mark.parametrize(
    ("maps", "line"),
    [
        (None, "result is None: a Result, a mapping, a dataset, a path or an array is needed"),
        ({}, "the result has no heights"),
        ({"height": "high"}, "the result has no heights"),
        ({"height": [[0, 1], [2]]}, "result['height'] is "),
        (
            {"height": FLAT, "height_sigma": FLAT[:1]},
            "map height_sigma of result has size (1, 3), others have",
        ),
        ({"height": FLAT, "x": [1.0]}, "x of result has shape (1,): (3,) is needed"),
        ({"slope": FLAT, "x": FLAT[0], "y": FLAT[:, 0]}, "the result has no heights"),
        ([0.0, 1.0], "result has shape (2,): a map (H, W) is needed"),
        (np.array([["a"]]), "result is a ndarray of <U1: numbers are needed"),
        ("missing.h5", "missing.h5"),
        (
            xarray.Dataset({"height": (("y", "x"), FLAT, {"units": "s"})}),
            "variable height of the dataset: 's' cannot be converted to 'mm'",
        ),
    ],
)
def test_what_has_no_maps_is_refused_in_a_line(maps, line):
    with pytest.raises(io.InputError, match=re.escape(line)):
        engine.measure(maps)
