"""Calibration files: all is read back, parts are replaced, and errors are one line."""

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from calibrations import SHAPE, a_calibration, a_precession, assert_same, some_references
from stacks import record, sphere

from mirrorskin import io

PARTS = ("references", "lens", "zenith", "precession", "gel", "stiffness", "response")
CAMERA = io.CameraId("left", SHAPE, np.dtype("uint8"))


@pytest.fixture
def path(tmp_path):
    return tmp_path / "cal.h5"


@pytest.fixture
def saved(path):
    io.save_calibration(a_calibration(), path)
    return path


@pytest.mark.parametrize(("shape", "dtype"), [(SHAPE, "uint8"), ((1, 9), "uint16"), ((13, 1), "float32")])
def test_a_calibration_comes_back_as_it_was(path, shape, dtype):
    calibration = a_calibration(shape, dtype, "münze 五")
    io.save_calibration(calibration, path)
    actual = io.open_calibration(path)
    assert_same(actual, calibration)
    assert actual.name == str(path)


@pytest.mark.parametrize("part", [*PARTS, None])
def test_parts_may_be_missing(path, part):
    calibration = a_calibration(only=[part])
    io.save_calibration(calibration, path)
    actual = io.open_calibration(path)
    assert_same(actual, calibration)
    assert list(actual.parts()) == ([] if part is None else [part])


def test_it_has_the_layout_that_is_documented(saved):
    actual = {}
    with h5py.File(saved) as file:
        assert dict(file.attrs) == {"NX_class": "NXroot", "default": "entry"}
        file["entry"].visititems(lambda name, node: actual.update({name: dict(node.attrs)}))
        assert dict(file["entry"].attrs) == {
            "NX_class": "NXentry",
            "default": "references",
            "mirrorskin_calibration": 1,
        }
        nodes = {name: file["entry"][name] for name in actual}
        shapes = {name: node.shape for name, node in nodes.items() if isinstance(node, h5py.Dataset)}
        assert file["entry/camera/dtype"].asstr()[()] == "uint8"
        assert file["entry/zenith/parameters"].asstr()[()].tolist() == ["radius", "k0"]
    groups = {name: attrs["NX_class"] for name, attrs in actual.items() if "NX_class" in attrs}
    assert groups == {
        "camera": "NXcollection",
        "references": "NXdata",
        "scale": "NXcollection",
        "zenith": "NXdata",
        "tilt": "NXcollection",
        "elastic": "NXcollection",
        "force": "NXcollection",
        "self": "NXdata",
        "process": "NXprocess",
    }
    assert (actual["references"]["signal"], actual["zenith"]["signal"]) == ("bright", "zenith_sigma")
    assert actual["references/dark"] == {"interpretation": "image", "units": "counts"}
    assert (
        actual["scale/pixel_size"] == actual["tilt/pivot"] == actual["tilt/sigma/pivot_z"] == {"units": "mm"}
    )
    assert actual["tilt/tilt"] == actual["tilt/sigma/tilt"] == {"units": "rad"}
    assert actual["force/modulus"] == {"units": "MPa"}
    assert shapes["force/covariance"] == (4, 4)
    assert shapes["references/defects"] == shapes["zenith/azimuth_sigma"] == SHAPE
    assert (shapes["camera/name"], shapes["camera/shape"], shapes["zenith/curve"]) == ((), (2,), (3,))
    assert shapes["process/tilt.frames"] == ()


def test_units_are_obeyed(saved):
    with h5py.File(saved, "r+") as file:
        file["entry/tilt/tilt"][()] = 2.5
        file["entry/tilt/tilt"].attrs["units"] = "deg"
    assert io.open_calibration(saved).precession.tilt == pytest.approx(np.radians(2.5))


def test_a_field_that_came_later_may_be_missing(saved):
    with h5py.File(saved, "r+") as file:
        del file["entry/elastic/travel_zero"], file["entry/elastic/sigma"]
    gel = io.open_calibration(saved).gel
    assert (gel.travel_zero, gel.sigma) == (0.0, {})


# One part at a time.


def test_parts_are_added_one_by_one(path):
    process = {"program": "mirrorskin", "frames": 8}
    io.update_calibration(path, some_references(), CAMERA, process)
    actual = io.update_calibration(path, a_precession(), CAMERA, {"tilt.frames": 9})
    assert_same(actual, io.open_calibration(path))
    assert list(actual.parts()) == ["references", "precession"]
    assert actual.process == {"references.program": "mirrorskin", "references.frames": 8, "tilt.frames": 9}


def test_a_part_is_replaced_with_its_notes_and_others_stay(saved):
    before = io.open_calibration(saved)
    io.update_calibration(saved, a_precession(tilt=0.05), CAMERA, {"turns": 2})
    after = io.open_calibration(saved)
    assert after.precession.tilt == 0.05
    assert_same(after.zenith, before.zenith)
    assert "tilt.frames" not in after.process
    assert after.process["tilt.turns"] == 2
    assert after.process["zenith.weight"] == 0.5


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": "right"}, "'left', this of 'right'"),
        ({"shape": (7, 5)}, "7 x 5 pixels, this of 5 x 7"),
        ({"dtype": np.dtype("uint16")}, "uint8 samples, this of uint16"),
    ],
)
def test_a_part_of_another_camera_is_refused(saved, changes, message):
    before = saved.read_bytes()
    with pytest.raises(io.InputError, match=f"cal.h5 is of .*{message}: name another file with -o"):
        io.update_calibration(saved, a_precession(), replace(CAMERA, **changes))
    assert saved.read_bytes() == before


@pytest.mark.parametrize(("first", "second"), [("zenith", "response"), ("response", "zenith")])
def test_two_responses_of_a_turn_are_refused(path, first, second):
    calibration = a_calibration(only=[first])
    io.save_calibration(calibration, path)
    part = getattr(a_calibration(only=[second]), second)
    with pytest.raises(io.InputError, match=r"cannot contain both zenith .* and self"):
        io.update_calibration(path, part, calibration.camera)
    assert_same(getattr(io.open_calibration(path), first), getattr(calibration, first))


def test_a_part_that_does_not_fit_leaves_the_file_as_it_was(saved):
    before = saved.read_bytes()
    with pytest.raises(ValueError, match=r"references/dark is of shape \(3, 3\)"):
        io.update_calibration(saved, some_references((3, 3)), CAMERA)
    assert saved.read_bytes() == before
    assert list(saved.parent.iterdir()) == [saved]


def test_a_calibration_that_cannot_be_written_is_reported(tmp_path):
    with pytest.raises(io.InputError, match="make it first"):
        io.save_calibration(a_calibration(), tmp_path / "none" / "cal.h5")


# What cannot be used.


def a_version(number):
    def change(file):
        file["entry"].attrs["mirrorskin_calibration"] = number

    return change


def a_value(name, value):
    def change(file):
        del file[f"entry/{name}"]
        file[f"entry/{name}"] = value

    return change


def without(name):
    def change(file):
        del file[f"entry/{name}"]

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (a_version(0), "older layout, 0, where 1 is read: calibrate again"),
        (a_version(2), "newer layout, 2, where 1 is read: update the program, or calibrate again"),
        (without("camera"), "there is no /entry/camera/name: calibrate again"),
        (a_value("camera/shape", [5, 0]), "which is not a picture size: calibrate again"),
        (a_value("camera/shape", [5, 8]), r"\(5, 7\) where \(5, 8\) is needed: calibrate again"),
        (a_value("camera/dtype", "int64"), "'int64', which is not a supported data type: calibrate again"),
        (without("references/dark"), "references has no dark: calibrate again"),
        (a_value("references/dark", "grey"), "contains no numbers: calibrate again"),
        (a_value("scale/pixel_size", [0.1, 0.0]), r"\(0.1, 0.0\), which is invalid: calibrate again"),
        (a_value("scale/shape", [5.0, np.inf]), "whole numbers are needed: calibrate again"),
        (a_value("zenith/pattern", "striped"), "striped, which is invalid: calibrate again"),
        (a_value("zenith/pattern", [1, 2]), "does not hold one value"),
        (a_value("zenith/curve", [0.9, np.nan]), "curve has numbers that are not finite: calibrate again"),
        (a_value("zenith/parameters", [1.0, 2.0]), "is not a list of texts: calibrate again"),
        (a_value("zenith/parameters", ["radius"]), r"\(2, 2\) where \(1, 1\) is needed: calibrate again"),
        (a_value("tilt/direction", 2), "is 2, which is invalid: calibrate again"),
        (a_value("tilt/sigma/tilt", "much"), "contains no numbers: calibrate again"),
    ],
)
def test_a_file_that_is_damaged_or_of_another_version_is_printed_in_a_line(saved, change, message):
    with h5py.File(saved, "r+") as file:
        change(file)
    with pytest.raises(io.InputError, match=message) as caught:
        io.open_calibration(saved)
    assert str(caught.value).startswith(str(saved))
    assert "\n" not in str(caught.value)


def test_what_is_not_a_calibration_is_reported(path, tmp_path):
    with pytest.raises(io.InputError, match="no such file"):
        io.open_calibration(path)
    record(sphere(), path)
    with pytest.raises(io.InputError, match="is not a calibration: 'mirrorskin calibrate' creates one"):
        io.open_calibration(path)
    path.write_text("dark = 12")
    with pytest.raises(io.InputError, match="not an HDF5 file"):
        io.open_calibration(path)


# In words.


def test_a_calibration_is_described(saved):
    facts = io.describe(saved)
    assert facts["kind"] == "calibration"
    assert facts["camera"] == "'left', 7 x 5, uint8"
    assert facts["references.dark"].endswith(" counts")
    assert [facts[f"references.{name}"] for name in ("hot", "dead", "saturated")] == [
        f"{count} pixels" for count in (0, 1, 0)
    ]
    assert facts["scale.pixel size along y"].startswith("600")
    assert facts["tilt.half-angle"] == "2.2918 ± 0.0057 deg"
    assert facts["tilt.pivot z"] == "12.00 ± 0.30 mm"
    assert facts["tilt.phase offset"] == "17.1887 deg"
    assert facts["tilt.frames"] == "8"


def test_every_dataset_is_documented(saved):
    page = (Path(__file__).parents[3] / "docs" / "calibration.md").read_text(encoding="utf-8")
    names = []
    with h5py.File(saved) as file:
        file["entry"].visititems(
            lambda name, node: names.append(name) if isinstance(node, h5py.Dataset) else None
        )
    expected = {
        "process/PART.NAME"
        if name.startswith("process/")
        else f"{name.partition('/sigma/')[0]}/sigma/NAME"
        if "/sigma/" in name
        else name
        for name in names
    }
    assert len(expected) > 30
    assert [name for name in sorted(expected) if f"`{name}`" not in page] == []
