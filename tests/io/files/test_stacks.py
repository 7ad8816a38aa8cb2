"""Stacks of other programs that are in parts, or of which only a part was written."""

import h5py
import numpy as np
import pytest
import tifffile
import zarr

from mirrorskin.io import InputError, Region, Steps, describe, open_recording

FRAMES = np.random.default_rng(0).integers(1, 256, (8, 5, 7), np.uint8)


def opened(path, **options):
    return open_recording(path, **{"motion": "vertical", "travel": Steps(0.1)} | options)


def read(path, **options):
    with opened(path, **options) as source:
        buffer = np.empty(source.shape, source.dtype)
        frames = []
        while (block := source.read(buffer)) is not None:
            frames.append(block.frames.copy())
        return np.concatenate(frames), source


def warnings_of(source):
    return [(finding.kind, finding.text) for finding in source.findings if finding.warning]


def master(folder, sizes=(3, 3, 2), name="data_{:06d}", **options):
    """Write a stack as the filewriter of a detector does: parts in files, and a file of links to them."""
    first = 0
    with h5py.File(folder / "x_master.h5", "w") as file:
        group = file.create_group("entry/data")
        for number, size in enumerate(sizes, 1):
            part = f"x_data_{number:06d}.h5"
            with h5py.File(folder / part, "w") as data:
                data.create_dataset("entry/data/data", data=FRAMES[first : first + size], **options)
            group[name.format(number)] = h5py.ExternalLink(part, "/entry/data/data")
            first += size
    return folder / "x_master.h5"


@pytest.mark.parametrize("name", ["data_{:06d}", "part{}"])
@pytest.mark.parametrize(
    "options", [{}, {"chunks": (1, 5, 7), "compression": "gzip"}, {"chunks": (2, 5, 4)}], ids=str
)
def test_linked_parts_are_one_stack(tmp_path, options, name):
    path = master(tmp_path, name=name, **options)
    actual, source = read(path)
    np.testing.assert_array_equal(actual, FRAMES)
    assert source.travel.tolist() == pytest.approx([0.1 * number for number in range(8)])
    assert warnings_of(source) == []
    assert [finding.kind for finding in source.findings] == ["parts"]
    part = {"frames": (2, 7), "region": Region((1, 4), (2, 6))}
    np.testing.assert_array_equal(read(path, **part)[0], FRAMES[2:7, 1:4, 2:6])
    assert describe(path)["stacks"] == "3"
    for file in tmp_path.iterdir():  # all are closed again
        h5py.File(file, "r+").close()


def test_a_last_part_of_one_frame_is_joined(tmp_path):
    np.testing.assert_array_equal(read(master(tmp_path, (4, 3, 1)))[0], FRAMES)


def test_one_part_is_warned_of(tmp_path):
    path = master(tmp_path)
    actual, source = read(path, dataset="/entry/data/data_000002")
    np.testing.assert_array_equal(actual, FRAMES[3:6])
    ((kind, text),) = warnings_of(source)
    assert kind == "part"
    assert "data_000002 is one of 3 parts, data_000001 to data_000003, and only its frames are read" in text
    actual, source = read(tmp_path / "x_data_000002.h5")
    np.testing.assert_array_equal(actual, FRAMES[3:6])
    ((kind, text),) = warnings_of(source)
    assert "x_data_000002.h5 is one of 3 parts, x_data_000001.h5 to x_data_000003.h5" in text


def test_a_part_that_is_missing_is_named(tmp_path):
    path = master(tmp_path)
    (tmp_path / "x_data_000002.h5").unlink()
    with pytest.raises(InputError, match=r"leads to x_data_000002\.h5, which does not exist: copy it there"):
        opened(path)
    with h5py.File(path, "r+") as file:
        del file["entry/data/data_000002"]
    with pytest.raises(
        InputError, match=r"data_000001 to .*data_000003 are parts of a stack, and number 2 is missing"
    ):
        opened(path)


def test_parts_of_other_sizes_are_refused(tmp_path):
    path = master(tmp_path)
    with h5py.File(tmp_path / "x_data_000003.h5", "w") as file:
        file["entry/data/data"] = FRAMES[6:, :3]
    with pytest.raises(
        InputError, match=r"data_000003 has frames of 7 x 3 uint8, but .*data_000001 of 7 x 5 uint8"
    ):
        opened(path)


def test_numbered_parts_in_one_file_are_joined(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for number in range(4):
            file[f"entry/data/data_{number:06d}"] = FRAMES[2 * number : 2 * number + 2]
    np.testing.assert_array_equal(read(tmp_path / "a.h5")[0], FRAMES)
    group = zarr.create_group(tmp_path / "a.zarr")
    for number in range(4):
        group.create_array(f"data_{number:06d}", data=FRAMES[2 * number : 2 * number + 2])
    np.testing.assert_array_equal(read(tmp_path / "a.zarr")[0], FRAMES)


def test_several_presses_in_one_file_are_not_joined(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["press1"], file["press2"] = FRAMES, FRAMES
    with pytest.raises(InputError, match="contains 2 stacks, /press1, /press2: choose with --dataset"):
        opened(tmp_path / "a.h5")
    assert warnings_of(read(tmp_path / "a.h5", dataset="press2")[1]) == []


def test_one_link_is_followed(tmp_path):
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["x"] = FRAMES
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["there"] = h5py.ExternalLink("b.h5", "x")
    np.testing.assert_array_equal(read(tmp_path / "a.h5")[0], FRAMES)


def unwritten_hdf5(path, **options):
    with h5py.File(path, "w") as file:
        stack = file.create_dataset("x", shape=(12, 5, 7), maxshape=(None, 5, 7), dtype="u1", **options)
        stack[:8] = FRAMES


def unwritten_zarr(path, **options):
    zarr.create_array(path, shape=(12, 5, 7), dtype="u1", **options)[:8] = FRAMES


UNWRITTEN = [
    ("a.h5", unwritten_hdf5, {"chunks": (1, 5, 7), "compression": "gzip"}),
    ("a.h5", unwritten_hdf5, {"chunks": (3, 3, 4), "fillvalue": 0}),
    ("a.h5", unwritten_hdf5, {"chunks": (5, 5, 7), "compression": "lzf"}),
    ("a.zarr", unwritten_zarr, {"chunks": (1, 5, 7)}),
    ("a.zarr", unwritten_zarr, {"chunks": (3, 3, 4), "zarr_format": 2}),
    ("a.zarr", unwritten_zarr, {"chunks": (1, 5, 7), "shards": (5, 5, 7)}),
]


@pytest.mark.parametrize(("name", "write", "options"), UNWRITTEN, ids=range(len(UNWRITTEN)))
def test_chunks_that_were_never_written_are_left_out(tmp_path, name, write, options):
    write(tmp_path / name, **options)
    actual, source = read(tmp_path / name)
    np.testing.assert_array_equal(actual, FRAMES)
    ((kind, text),) = warnings_of(source)
    assert kind == "number of frames"
    assert "has 12 frames by its shape, and only the first 8 were written: these are read" in text
    actual, source = read(tmp_path / name, frames=(0, 8))
    np.testing.assert_array_equal(actual, FRAMES)
    assert warnings_of(source) == []


def test_frames_between_that_were_never_written_are_refused_or_left_out(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        stack = file.create_dataset("x", shape=(12, 5, 7), dtype="u1", chunks=(2, 5, 7))
        stack[:4], stack[6:10] = FRAMES[:4], FRAMES[4:]
    for frames in (None, (2, 8), (4, 10)):
        with pytest.raises(
            InputError, match="frames 4 to 5 of 12 were never written, or are missing in this copy"
        ):
            opened(tmp_path / "a.h5", frames=frames)
    np.testing.assert_array_equal(read(tmp_path / "a.h5", frames=(6, 10))[0], FRAMES[4:])
    np.testing.assert_array_equal(read(tmp_path / "a.h5", frames=(0, 4))[0], FRAMES[:4])


@pytest.mark.parametrize("options", [{}, {"chunks": (1, 5, 7)}], ids=str)
def test_a_stack_that_was_never_written_is_not_called_damaged(tmp_path, options):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("x", shape=(12, 5, 7), dtype="u1", **options)
    with pytest.raises(InputError, match=r"it was never written|none of them was written") as caught:
        opened(tmp_path / "a.h5")
    assert "copy" not in str(caught.value)


def test_the_writer_of_an_axis_in_front_may_stop_early(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("x", shape=(1, 12, 5, 7), dtype="u1", chunks=(1, 1, 5, 7))[0, :8] = FRAMES
    np.testing.assert_array_equal(read(tmp_path / "a.h5")[0], FRAMES)


def reserved_npy(path):
    np.lib.format.open_memmap(path, "w+", dtype="u1", shape=(12, 5, 7))[:8] = FRAMES


def reserved_tiff(path):
    tifffile.memmap(path, shape=(12, 5, 7), dtype="u1", photometric="minisblack")[:8] = FRAMES


def reserved_hdf5(path):
    with h5py.File(path, "w") as file:
        file.create_dataset("x", shape=(12, 5, 7), dtype="u1")[:8] = FRAMES


@pytest.mark.parametrize(
    ("name", "write"), [("a.npy", reserved_npy), ("a.tif", reserved_tiff), ("a.h5", reserved_hdf5)]
)
def test_space_that_was_reserved_and_never_written_is_reported(tmp_path, name, write):
    write(tmp_path / name)
    actual, source = read(tmp_path / name)
    assert actual.shape == (12, 5, 7)
    ((_, text),) = warnings_of(source)
    assert text.startswith(
        "the last 4 frames contain only zeros, as if they had never been written: --frames 0:8"
    )
    assert warnings_of(read(tmp_path / name, frames=(0, 8))[1]) == []
