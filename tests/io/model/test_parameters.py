"""A parameter is declared once: files, docstrings, tables and units follow."""

import math
from dataclasses import replace

import h5py
import numpy as np
import pytest
from calibrations import SHAPE, a_calibration, assert_same

from mirrorskin import io
from mirrorskin.io.model import calibration as types
from mirrorskin.io.model.parameters import parameter, parameters, part


@part
class Worn(types.Gel):
    """A gel that wears."""

    wear: tuple[float, float] = parameter(
        "depth of the wear along x and y", "mm", components="xy", shown_unit="um", default=(0.0, 0.0)
    )


@pytest.fixture
def worn(monkeypatch):
    monkeypatch.setitem(types.PARTS, "gel", Worn)
    return Worn(threshold=0.2, compliance=0.1, wear=(0.001, 0.002), sigma={"wear_y": 0.0001})


def test_one_declaration_reaches_files_tables_and_docstrings(worn, tmp_path):
    calibration = replace(a_calibration(only=()), gel=worn)
    io.save_calibration(calibration, tmp_path / "cal.h5")
    assert_same(io.open_calibration(tmp_path / "cal.h5").gel, worn)
    with h5py.File(tmp_path / "cal.h5") as file:
        assert dict(file["entry/elastic/wear"].attrs) == {"units": "mm"}
        assert dict(file["entry/elastic/sigma/wear_y"].attrs) == {"units": "mm"}
    rows = {row.what: row.cells()[2:] for row in calibration.rows() if row.part == "elastic"}
    assert rows["wear x"] == ("1", "", "um")
    assert rows["wear y"] == ("2.00", "0.10", "um")
    assert io.describe(tmp_path / "cal.h5")["elastic.wear y"] == "2.00 ± 0.10 um"
    assert "wear : (float, float), mm\n    Depth of the wear along x and y.\n" in f"{Worn.__doc__}\n"


def test_older_files_lack_the_new_parameter(worn, tmp_path):
    calibration = replace(a_calibration(only=()), gel=worn)
    io.save_calibration(calibration, tmp_path / "cal.h5")
    with h5py.File(tmp_path / "cal.h5", "r+") as file:
        del file["entry/elastic/wear"]
    assert io.open_calibration(tmp_path / "cal.h5").gel.wear == (0.0, 0.0)


@pytest.mark.parametrize("name", types.PARTS)
def test_every_parameter_has_a_text_and_every_number_shown_a_unit_that_converts(name):
    for declared in parameters(types.PARTS[name]).values():
        assert declared.text
        assert not declared.text.endswith(".")
        assert declared.factor > 0 or parameter.convert


def test_standard_errors_are_found_wherever_a_part_keeps_them():
    rows = {(row.part, row.what): row for row in a_calibration().rows()}
    lens, wall = a_calibration().lens, a_calibration().zenith
    assert rows["scale", "pixel size along y"].sigma == pytest.approx(
        1000 * lens.pixel_size[1] * lens.scale_sigma, nan_ok=True
    )
    assert rows["zenith", "radius"].sigma == math.sqrt(wall.covariance[0, 0])
    assert rows["references", "dark"].sigma == pytest.approx(
        np.nanmedian(a_calibration(SHAPE).references.dark_sigma)
    )
    assert rows["force", "modulus"].unit == "kPa"
