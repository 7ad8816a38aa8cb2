"""Stored files of each layout are still read correctly, and new files contain all that they do."""

import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from calibrations import a_calibration, assert_same

from mirrorskin import io

sys.path.insert(0, str(Path(__file__).parent / "layouts"))
import make

FILES = [str(path.relative_to(make.FOLDER)) for path in sorted(make.FOLDER.rglob("*.h5"))]
NAMES = [name for name in FILES if "/" not in name]


def of(what):
    return [name for name in FILES if f"-{what}-" in f"-{Path(name).name}"]


@pytest.mark.parametrize("name", of("recording"))
def test_a_recording_of_any_layout_is_read(name):
    source = make.a_rotation() if "gzip" in name or "bitshuffle" in name else make.a_press()
    with io.open_recording(make.FOLDER / name) as recording:
        block = recording.read(np.empty(source.shape, source.dtype))
        assert recording.motion == source.motion
        assert recording.header.pixel_size == make.PIXEL
        if not name.startswith("others"):
            assert recording.header.title == source.header.title
            for map_name in ("dark", "bright", "zenith_gain"):
                np.testing.assert_array_equal(
                    getattr(recording.header, map_name), getattr(source.header, map_name)
                )
        assert (recording.truth is not None) == ("truth" in name)
        if recording.truth is not None:
            for name_of_map in ("height", "zenith", "azimuth", "contact"):
                np.testing.assert_array_equal(
                    getattr(recording.truth, name_of_map), getattr(make.TRUTH, name_of_map)
                )
    np.testing.assert_array_equal(block.frames, source.frames)
    if source.motion == "axial":
        np.testing.assert_array_equal(block.phase, make.PHASE)
    else:
        np.testing.assert_array_equal(block.travel, make.TRAVEL)


@pytest.mark.parametrize("name", of("result"))
def test_a_result_of_any_layout_is_read(name):
    expected = make.DECLARED if "press-" in name else make.ROTATION
    actual = io.open_result(make.FOLDER / name)
    for name_of_map in ("height", "height_sigma", "status", "normals", "zenith", "azimuth"):
        np.testing.assert_array_equal(
            getattr(actual, name_of_map), getattr(expected, name_of_map), err_msg=name_of_map
        )
    assert actual.process == expected.process
    if name.endswith("-2.h5"):
        assert list(actual) == list(expected)
        assert actual.declarations == expected.declarations


@pytest.mark.parametrize("name", of("calibration"))
def test_a_calibration_of_any_layout_is_read(name):
    actual = io.open_calibration(make.FOLDER / name)
    expected = [part for part in actual.parts() if actual.parts()[part] is not None]
    assert name.startswith("early") or "stiffness" in expected  # which came later
    assert_same(actual, a_calibration(only=expected))


def structure(path):
    """Return what readers rely on: names, ranks, kinds of numbers and attributes."""
    actual = {}

    def visit(name, node):
        if isinstance(node, h5py.Dataset):
            number = node.dtype.kind in "iuf"  # the size of a text is that of its words
            actual[name] = node.ndim, node.dtype.kind, node.dtype.itemsize if number else None
        actual.update({f"{name}@{key}": str(value) for key, value in node.attrs.items()})

    with h5py.File(path) as file:
        file.visititems(visit)
    return actual


@pytest.mark.parametrize("name", NAMES)
def test_what_is_written_now_has_all_that_the_layout_had(tmp_path, name):
    make.WRITERS[name](tmp_path / name)
    before, now = structure(make.FOLDER / name), structure(tmp_path / name)
    assert {key: now.get(key) for key in before} == before


def test_there_is_a_file_of_each_layout():
    assert sorted(make.WRITERS) == NAMES
