"""Declarations of maps: values accepted by `Map`, use in results, and permitted contents of files."""

from __future__ import annotations

import copy
import json
import re

import h5py
import numpy as np
import pytest

from mirrorskin import io
from mirrorskin.io.model.maps import (
    LONGEST_DECLARATION,
    TABLE,
    TWIST,
    FocusStatus,
    PoseStatus,
    PressStatus,
    ReleaseStatus,
    SlipStatus,
    status_of,
)

FLAT = np.zeros((3, 4), np.float32)
CODES = np.zeros((3, 4), np.uint8)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"unit": 5}, "unit of a map is invalid: Expected `str`, got `int`"),
        ({"axes": "pixel"}, "axes of a map is 'pixel'. Use one of pixels, frames, pieces, none"),
        ({"colours": "red"}, "colours of a map is 'red'. Use one of sequential, positive, signed, error"),
        ({"codes": ["a"]}, "codes of a map are ['a']: codes are a dictionary of integers and texts"),
        ({"codes": {1: 5}}, "codes of a map are {1: 5}: codes are a dictionary of integers and texts"),
        ({"codes": {256: "a"}}, "256 is not a value of uint8. Declare another dtype"),
        ({"codes": {1: "a"}, "dtype": "float32"}, "a map of float32 has codes. Declare a dtype of integers"),
        ({"codes": dict.fromkeys(range(256), "a")}, "a legend has 256 codes; at most 255"),
        ({"codes": {1: "a\nb"}}, "a legend has a line break"),
        ({"undefined": 0.5, "dtype": "uint8"}, "0.5 is not a value of uint8"),
        ({"caption": "a\x1b[2J"}, "the caption of a map has a line break or another control character"),
        ({"caption": "a" * LONGEST_DECLARATION}, "longer than 60000 bytes. Shorten its texts"),
        ({"dtype": "V99999999999"}, "the dtype of a map is 'V99999999999'. Use one of uint8"),
        ({"unit": "mm", "displayed": "N"}, "'mm' cannot be converted to 'N'"),
        (
            {"caption": "rise", "displayed": "µm"},
            "the map 'rise' has no unit, but is displayed in µm. Declare its unit",
        ),
        (
            {"caption": "rise", "unit": "mm", "displayed": "N"},
            "the map 'rise' cannot be displayed: 'mm' cannot be converted to 'N'",
        ),
        (
            {"unit": "mm", "quantity": "heigth"},
            "the quantity of a map is 'heigth'. Use one of height, status,",
        ),
        (
            {"caption": "rise", "unit": "µm", "quantity": "height"},
            "the map 'rise' of quantity height has the unit µm. Declare mm",
        ),
        ({"quantity": "height"}, "a map of quantity height has the unit none. Declare mm"),
        ({"components": ("x",)}, "the components of a map are not 2 to 16 different names"),
        ({"components": ("x", "y"), "axes": "frames"}, "a map has components, but is not a map of vectors"),
        ({"sampling": "direction"}, "sampled as a direction needs three components"),
        ({"sampling": "angle", "unit": "deg"}, "a map sampled as an angle is in deg. Use radians"),
    ],
)
def test_a_declaration_that_contradicts_itself_is_refused(fields, message):
    with pytest.raises(io.InputError, match=re.escape(message)) as caught:
        io.Map(**fields)
    assert "\n" not in str(caught.value)


def test_figures_have_degrees_or_the_displayed_unit():
    assert (io.Map(unit="rad").figure_unit, io.Map(unit="rad").figure_scale) == ("deg", 180 / np.pi)
    gap = io.Map(unit="mm", displayed="µm")
    assert (gap.figure_unit, gap.figure_scale) == ("µm", 1000)
    assert (io.Map(unit="counts").figure_unit, io.Map(unit="counts").figure_scale) == ("counts", 1)


@pytest.mark.parametrize("name", TABLE)
def test_a_standard_deviation_has_the_unit_of_its_map(name):
    assert io.Result().declaration(f"{name}_sigma").unit == ("rad" if name == "normals" else TABLE[name].unit)


def test_attributes_are_maps():
    result = io.Result(height=FLAT, wear=FLAT)
    assert result.height is result["height"]
    assert result.wear is result["wear"]
    assert result.normals is None
    assert (list(result), len(result), "normals" in result) == (["height", "wear"], 2, False)


def test_an_attribute_that_is_not_a_map_is_an_error_that_lists_the_maps():
    result = io.Result(height=FLAT, wear=FLAT)
    with pytest.raises(AttributeError, match=r"^the result has no map heigth: did you mean height\?$"):
        _ = result.heigth
    with pytest.raises(AttributeError, match="it has none"):
        _ = io.Result().heigth
    with pytest.raises(KeyError, match="normals"):
        result["normals"]


def test_a_result_is_read_only():
    result = io.Result(height=FLAT)
    for name in ("height", "x", "wear"):
        with pytest.raises(
            AttributeError, match=rf"results are read-only: use result\.assign\({name}=\.\.\.\)"
        ):
            setattr(result, name, FLAT)
    with pytest.raises(TypeError, match="item assignment"):
        result["height"] = FLAT


def test_assign_returns_a_changed_copy():
    first = io.Result(height=FLAT, x=np.arange(4.0), process={"source": "a"})
    second = first.assign({"wear": FLAT}, height=None, x=None, declarations={"wear": io.Map("w", "mm")})
    assert (list(second), second.x, second.process) == (["wear"], None, {"source": "a"})
    assert second.declaration("wear").unit == "mm"
    assert (list(first), first.declarations) == (["height"], {})


def test_assign_replaces_the_map_of_a_quantity():
    declared = {"wear": io.Map("w", "mm", quantity="height")}
    worn = io.Result(wear=FLAT, declarations=declared).assign(height=FLAT + 1, height_sigma=FLAT)
    assert list(worn) == ["wear", "wear_sigma"]
    assert worn.height is worn["wear"]
    assert worn.height_sigma is worn["wear_sigma"]
    assert worn.wear.max() == 1


def test_a_copy_has_the_same_maps():
    result = io.Result(height=FLAT, declarations={"height": io.Map("h", "mm")})
    for copied in (copy.copy(result), copy.deepcopy(result)):
        np.testing.assert_array_equal(copied.height, FLAT)
        assert copied.declarations == result.declarations


@pytest.fixture
def path(tmp_path):
    declared = {"wear": io.Map("depth of the wear", "mm")}
    io.save_result(io.Result(wear=FLAT, height=FLAT, declarations=declared), tmp_path / "own.h5")
    return tmp_path / "own.h5"


def declare(path, text, name="wear"):
    with h5py.File(path, "r+") as file:
        file[f"entry/result/{name}"].attrs["declaration"] = text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "JSON is malformed|Input data was truncated"),
        ("[]", "Expected `object`, got `array`"),
        ('{"unit": 5}', "Expected `str`, got `int`"),
        ('{"units": "mm"}', "Object contains unknown field `units`"),
        ('{"dtype": "O"}', "the dtype of a map is 'O'"),
        ('{"axes": "nowhere"}', "Invalid enum value 'nowhere'"),
        ('{"undefined": 1e999}', "out of range"),
        ('{"codes": {"99999999999999999999": "a"}}', "is not a value of uint8"),
        (json.dumps({"caption": "a\x1b[2J"}), "control character"),
        (np.bytes_(b"\xff\xfe"), "the declaration of the map is invalid"),
        (3.5, "the declaration of the map is invalid"),
        ('{"quantity": "height"}', "a map of quantity height has the unit none"),
        ('{"components": ["x", "y"]}', r"wear has shape \(3, 4\) where \(3, 4, 2\) is needed"),
        ('{"axes": "none"}', r"wear has shape \(3, 4\) where \(\) is needed"),
        ("[" * 50_000, "the declaration of the map is invalid"),
    ],
)
def test_a_damaged_declaration_is_one_line(path, text, message):
    declare(path, text)
    for read in (io.open_result, io.describe):
        with pytest.raises(io.InputError, match=message) as caught:
            read(path)
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)
        assert len(str(caught.value)) < 500


def test_a_declaration_that_is_too_long_is_refused(path):
    with h5py.File(path, "w", libver="latest") as file:
        file["entry/result/height"] = FLAT
        file["entry"].attrs["mirrorskin_result"] = 2
        file["entry/result/height"].attrs["declaration"] = json.dumps({"caption": "a" * 200_000})
    with pytest.raises(io.InputError, match=r"declaration of the map is invalid .*it has 200015 characters"):
        io.open_result(path)


@pytest.mark.parametrize(
    "declared",
    [io.Map(unit="µm"), io.Map(unit="mm", axes="none"), io.Map(unit="mm", components=("x", "y", "z"))],
)
def test_a_file_does_not_change_what_a_built_in_map_is(path, declared):
    declare(path, declared.encode(), "height")
    with pytest.raises(io.InputError, match=r"own\.h5: the map height has the .*Declare ") as caught:
        io.open_result(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["series", "pieces"])
def test_series_and_values_of_each_piece_are_read_as_they_were_written(tmp_path, name):
    axes = {"series": "frames", "pieces": "pieces"}[name]
    declared = {name: io.Map("one", "N", axes=axes, dtype="float64")}
    values = np.array([1.5, np.nan])
    component = np.array([[0, 1, -1]], np.int32)
    result = io.Result({name: values}, component=component, declarations=declared)
    io.save_result(result, tmp_path / "own.h5")
    np.testing.assert_array_equal(io.open_result(tmp_path / "own.h5")[name], values)


def of_layout_1(path, result, former):
    """Write a result as earlier versions did: without declarations, with names that changed since."""
    io.save_result(result, path)
    with h5py.File(path, "r+") as file:
        file["entry"].attrs["mirrorskin_result"] = 1
        maps = file["entry/result"]
        for name in list(maps):
            for attribute in ("declaration", "long_name", "flag_values", "flag_meanings"):
                maps[name].attrs.pop(attribute, None)
            if name in former:
                maps.move(name, former[name])


@pytest.mark.parametrize(
    ("maps", "process", "codes"),
    [
        ({"height": FLAT}, {"event": "onset"}, PressStatus),
        ({"height": FLAT}, {"event": "release"}, ReleaseStatus),
        (
            {"height": FLAT, "normals": np.ones((3, 4, 3), "f4")},
            {"vertical_event": "release"},
            ReleaseStatus,
        ),
        ({"zenith": FLAT}, {}, PoseStatus),
        ({"slip_onset": FLAT}, {"motion": "horizontal"}, SlipStatus),
        ({"height": FLAT, "sharpness": FLAT}, {"estimator": "FocusEstimator"}, FocusStatus),
        ({"height": FLAT, "zenith": FLAT}, {"estimator": "Own"}, None),
        ({"zenith": FLAT}, {"estimator": "Own"}, None),
        ({"light": FLAT}, {}, None),
    ],
)
def test_a_file_of_layout_1_has_the_legend_of_its_status(tmp_path, maps, process, codes):
    of_layout_1(tmp_path / "old.h5", io.Result(maps, status=CODES, process=process), {})
    expected = {} if codes is None else status_of(codes).codes
    assert io.open_result(tmp_path / "old.h5").declaration("status").codes == expected


@pytest.mark.parametrize(
    ("motion", "name", "unit"), [("horizontal", "slide_distance", "mm"), ("twist", "twist_angle", "rad")]
)
def test_a_file_of_layout_1_has_the_names_of_today(tmp_path, motion, name, unit):
    distance = np.arange(5.0)
    maps = {"slip_onset": FLAT, "slip_onset_sigma": FLAT, "normals_sigma": FLAT, name: distance}
    declared = TWIST if motion == "twist" else {}
    result = io.Result(maps, process={"motion": motion}, declarations=declared)
    of_layout_1(tmp_path / "old.h5", result, {name: "way", "normals_sigma": "normal_sigma"})
    actual = io.open_result(tmp_path / "old.h5")
    assert set(actual) == set(maps)
    np.testing.assert_array_equal(actual[name], distance)
    assert [actual.declaration(result).unit for result in ("slip_onset", "slip_onset_sigma", name)] == [
        unit
    ] * 3


def test_a_file_of_today_may_have_maps_with_the_names_of_layout_1(tmp_path):
    result = io.Result(height=FLAT, normal_sigma=FLAT, status=CODES, process={"event": "onset"})
    io.save_result(result, tmp_path / "own.h5")
    actual = io.open_result(tmp_path / "own.h5")
    assert list(actual) == ["height", "status", "normal_sigma"]
    assert actual.declaration("status").codes == {}
