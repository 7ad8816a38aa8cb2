"""A result of a form that was written before is the file that HDF5 would write, to the last byte."""

import errno
import os
from dataclasses import replace

import numpy as np
import pytest
from stacks import assert_same

from mirrorskin import io
from mirrorskin.io import mould as moulds
from mirrorskin.io import result as results

PROCESS = {"program": "mirrorskin", "frames": 7, "noise": 1.5, "subframe": True, "empty": "", "text": "é°µ"}


@pytest.fixture(autouse=True)
def forget():
    """Begin without moulds."""
    results._moulds.clear()


def press(seed, shape=(5, 7)):
    generator = np.random.default_rng(seed)
    height = generator.normal(size=shape).astype(np.float32)
    x, y = io.pixel_axes(shape, (0.1, 0.2))
    status = generator.integers(0, 4, shape).astype(np.uint8)
    return io.Result(height=height, status=status, x=x, y=y, process=PROCESS | {"noise": float(seed)})


def rotation(seed):
    generator = np.random.default_rng(seed)
    normals = generator.normal(size=(2, 5, 7, 3)).astype(np.float32)
    component = generator.integers(-1, 2, (2, 5, 7)).astype(np.int32)
    component[0, 0, 0] = 1
    unknown = generator.integers(0, 2, 2).astype(np.uint8)
    return io.Result(normals=normals, component=component, offset_unknown=unknown, process=PROCESS)


def no_pieces(seed):
    height = np.full((1, 1), np.nan, np.float32)
    component = np.full((1, 1), -1, np.int32)
    return io.Result(
        height=height, component=component, offset_unknown=np.zeros(0, np.uint8), process=PROCESS
    )


def large(seed):
    return press(seed, (301, 403))


@pytest.mark.parametrize("make", [press, rotation, no_pieces, large])
def test_a_poured_file_is_the_one_that_hdf5_writes(tmp_path, make):
    io.save_result(make(0), tmp_path / "first.h5")
    (form,) = results._moulds
    io.save_result(make(1), tmp_path / "poured.h5")
    assert list(results._moulds) == [form]
    results._moulds.clear()
    io.save_result(make(1), tmp_path / "written.h5")
    assert (tmp_path / "poured.h5").read_bytes() == (tmp_path / "written.h5").read_bytes()
    assert_same(io.open_result(tmp_path / "poured.h5"), make(1))


@pytest.mark.parametrize(
    "other",
    [
        replace(press(1), process=PROCESS | {"text": "longer than before"}),
        replace(press(1), process=PROCESS | {"frames": 7.0}),
        replace(press(1), process=PROCESS | {"frames": True}),
        replace(press(1), process=PROCESS | {"more": 1}),
        replace(press(1), process={**PROCESS, "renamed": 1.0} | {"noise": "7 as text"}),
        replace(press(1), x=None, y=None),
        replace(press(1), status=None),
        press(1, (7, 5)),
        press(1, (1, 1)),
    ],
)
def test_a_result_of_another_form_gets_its_own_mould(tmp_path, other):
    io.save_result(press(0), tmp_path / "first.h5")
    io.save_result(other, tmp_path / "other.h5")
    assert len(results._moulds) == 2
    assert_same(io.open_result(tmp_path / "other.h5"), other)
    io.save_result(press(2), tmp_path / "again.h5")
    assert_same(io.open_result(tmp_path / "again.h5"), press(2))


def test_maps_that_do_not_lie_in_a_piece_are_poured_all_the_same(tmp_path):
    io.save_result(press(0), tmp_path / "first.h5")
    whole = press(1)
    strided = replace(whole, height=np.asfortranarray(whole.height), x=np.repeat(whole.x, 2)[::2])
    io.save_result(strided, tmp_path / "a.h5")
    assert_same(io.open_result(tmp_path / "a.h5"), whole)


def test_only_so_many_moulds_are_kept(tmp_path):
    for rows in range(1, 30):
        io.save_result(press(0, (rows, 3)), tmp_path / "a.h5")
        assert 1 <= len(results._moulds) <= 8


def test_a_disk_without_room_is_told_and_leaves_what_was_there(tmp_path, monkeypatch):
    io.save_result(press(0), tmp_path / "a.h5")
    before = (tmp_path / "a.h5").read_bytes()

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(moulds.Mould, "pour", full)
    with pytest.raises(
        io.InputError, match=r"a\.h5 could not be written: No space left on device; make room"
    ):
        io.save_result(press(1), tmp_path / "a.h5")
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("a.h5", before)]
