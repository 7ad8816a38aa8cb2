"""Plain arrays, opened by NumPy."""

from __future__ import annotations

import json

import numpy as np
import pytest

from mirrorskin import io


def test_all_maps_come_back_as_they_were(slope, tmp_path):
    path = tmp_path / "out.npz"
    description = io.export_result(slope, path)
    with np.load(path, allow_pickle=False) as file:
        arrays = dict(file)
    assert description == ", ".join(slope.maps())
    texts = ("units", "legends", "process", "fitted")
    units, legends, process, fitted = (json.loads(str(arrays.pop(name))) for name in texts)
    assert set(arrays) == {*slope.maps(), "x", "y", "offset_unknown"}
    for name, values in arrays.items():
        np.testing.assert_array_equal(values, getattr(slope, name), strict=True)
    assert units == dict.fromkeys(("height", "height_sigma", "x", "y"), "mm")
    assert legends == {"filled": {"0": "measured", "1": "filled"}}
    assert (process, fitted) == (slope.process, slope.fitted.values())


@pytest.mark.parametrize("shape", [(6, 9), (3, 6, 9), (1, 1)])
def test_arrays_need_neither_heights_nor_places(tmp_path, shape):
    zenith = np.full(shape, np.nan, np.float32)
    path = tmp_path / "out.npz"
    io.export_result(io.Result(zenith=zenith, process={"threshold": 0.5, "subframe": True}), path)
    with np.load(path, allow_pickle=False) as file:
        np.testing.assert_array_equal(file["zenith"], zenith, strict=True)
        assert set(file) == {"zenith", "units", "legends", "process", "fitted"}
        assert json.loads(str(file["units"])) == {"zenith": "rad"}
        assert json.loads(str(file["process"])) == {"threshold": 0.5, "subframe": True}
