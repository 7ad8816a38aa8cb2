"""Files of a later layout are refused, not misread."""

import h5py
import numpy as np
import pytest
from stacks import record, sphere

from mirrorskin import io


def later(path, mark, layout):
    with h5py.File(path, "r+") as file:
        assert file["entry"].attrs[mark] == layout
        file["entry"].attrs[mark] = layout + 1
    return path


@pytest.fixture
def recording(tmp_path):
    record(sphere(), tmp_path / "rec.h5")
    return later(tmp_path / "rec.h5", "mirrorskin_recording", 1)


@pytest.fixture
def result(tmp_path):
    io.save_result(io.Result(height=np.zeros((3, 4), np.float32)), tmp_path / "res.h5")
    return later(tmp_path / "res.h5", "mirrorskin_result", 2)


@pytest.mark.parametrize("read", [io.open_recording, io.describe, io.open_heights])
def test_a_later_recording_is_refused(recording, read):
    with pytest.raises(io.InputError, match="layout 2, where 1 is read: update the program"):
        read(recording)


@pytest.mark.parametrize("read", [io.open_result, io.describe, io.open_heights])
def test_a_later_result_is_refused(result, read):
    with pytest.raises(io.InputError, match="layout 3, where 2 is read: update the program"):
        read(result)
