"""Files of NumPy's arrays: what they contain is read, or its absence reported."""

import h5py
import numpy as np
import pytest
import tifffile
import zarr

from mirrorskin.io import InputError, Region, Steps, open_recording

FRAMES = np.random.default_rng(0).integers(1, 256, (8, 5, 7), np.uint8)


def opened(path, **options):
    return open_recording(path, **{"motion": "vertical", "travel": Steps(0.1)} | options)


def write_hdf5(path, array, **options):
    with h5py.File(path, "w") as file:
        file.create_dataset("data", data=array, **options)


WRITERS = {
    "a.h5": write_hdf5,
    "gzip.h5": lambda path, array: write_hdf5(path, array, compression="gzip"),
    "a.npy": np.save,
    "fortran.npy": lambda path, array: np.save(path, np.asfortranarray(array)),
    "a.npz": lambda path, array: np.savez(path, frames=array),
    "a.zarr": lambda path, array: zarr.create_array(path, data=array),
    "a.tif": lambda path, array: tifffile.imwrite(path, array, photometric="minisblack"),
}
SHAPES = [(8, 1, 5, 7), (1, 8, 5, 7), (8, 5, 7, 1), (1, 1, 8, 5, 7), (8, 1, 5, 1, 7)]


@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("name", WRITERS)
def test_axes_of_length_one_are_left_out(tmp_path, name, shape):
    WRITERS[name](tmp_path / name, FRAMES.reshape(shape))
    with opened(tmp_path / name) as source:
        buffer = np.empty(source.shape, source.dtype)
        np.testing.assert_array_equal(source.read(buffer).frames, FRAMES)
        np.testing.assert_array_equal(source.frame(3), FRAMES[3])
        assert not any(finding.warning for finding in source.findings)
    part = {"frames": (2, 6), "region": Region((1, 4), (2, 6))}
    with opened(tmp_path / name, **part) as source:
        buffer = np.empty(source.shape, source.dtype)
        np.testing.assert_array_equal(source.read(buffer).frames, FRAMES[2:6, 1:4, 2:6])


@pytest.mark.parametrize("name", WRITERS)
def test_two_axes_that_may_be_frames_are_refused(tmp_path, name):
    WRITERS[name](tmp_path / name, np.stack([FRAMES, FRAMES], 1))
    with pytest.raises(InputError, match=r"stack of frames|but frames have one order"):
        opened(tmp_path / name)


def test_channels_of_named_axes_are_chosen_in_hdf5(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["data"] = np.stack([FRAMES, 255 - FRAMES], 1)
        for axis, label in enumerate(("time", "channel", "y", "x")):
            file["data"].dims[axis].label = label
    with opened(tmp_path / "a.h5", dataset="data", channel=1) as source:
        np.testing.assert_array_equal(source.frame(2), 255 - FRAMES[2])
    with pytest.raises(InputError, match="has 2 channels: --channel 0 to 1"):
        opened(tmp_path / "a.h5", dataset="data")


@pytest.mark.parametrize("order", ["C", "F"])
def test_an_array_that_follows_another_one_in_a_file_is_reported(tmp_path, order):
    with (tmp_path / "a.npy").open("wb") as file:
        for part in np.split(FRAMES, 2):
            np.save(file, np.asarray(part, order=order))
    with opened(tmp_path / "a.npy") as source:
        assert source.shape == (4, 5, 7)
        ((kind, warning, text),) = [(part.kind, part.warning, part.text) for part in source.findings]
    assert (kind, warning) == ("number of frames", True)
    assert "states 4 x 5 x 7, uint8, and another array follows" in text


def test_bytes_after_an_array_are_reported(tmp_path):
    np.save(tmp_path / "a.npy", FRAMES[:5])
    with (tmp_path / "a.npy").open("ab") as file:
        file.write(FRAMES[5:].tobytes())
    with opened(tmp_path / "a.npy") as source:
        assert [part.text.partition(": ")[0] for part in source.findings] == [
            "its header states 5 x 5 x 7, uint8, and 105 bytes follow"
        ]
