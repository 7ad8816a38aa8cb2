"""Stacks of other programs, read by their metadata about values and axes."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
import xarray
from stacks import read_all

from mirrorskin import engine, io
from mirrorskin.io.base.samples import order_of

SHAPE = 9, 6, 5
GIVEN = {"motion": "vertical", "travel": io.Steps(0.3)}
TRAVEL = 0.05 * np.arange(SHAPE[0])


def stack(dtype="u2", top=1000):
    return np.random.default_rng(2).integers(0, top, SHAPE).astype(dtype)


def opened(path, **options):
    return io.open_recording(path, **{**GIVEN, **options})


def read(path, **options):
    with opened(path, **options) as recording:
        return read_all(recording, 4).frames


def written(path, frames, encoding=None, dims=("t", "y", "x"), attributes=None, **coordinates):
    """Write a stack as xarray does: netCDF-4, or Zarr of version 2 or 3."""
    data = xarray.Dataset({"frames": (dims, frames, attributes)}, coordinates)
    options = {"encoding": {"frames": encoding or {}}}
    if path.suffix == ".nc":
        data.to_netcdf(path, engine="h5netcdf", **options)
    else:
        data.to_zarr(path, zarr_format=2 if "2" in path.name else 3, consolidated=False, **options)
    return path


@pytest.fixture(params=["stack.nc", "stack2.zarr", "stack3.zarr"])
def path(request, tmp_path):
    return tmp_path / request.param


@pytest.mark.parametrize("name", ["_FillValue", "missing_value"])
def test_fill_values_are_unknown(path, name):
    frames = stack()
    frames[3:, 2, 1] = 65535
    actual = read(written(path, frames, {name: np.uint16(65535)}))
    assert actual.dtype == np.float32
    np.testing.assert_array_equal(actual, np.where(frames == 65535, np.nan, frames.astype("f4")))


@pytest.mark.parametrize("chunks", [None, (4, 3, 5), (1, 6, 5)])
def test_packed_samples_are_unpacked(path, chunks):
    values = stack() * 0.5 - 3
    values[4, 1, 1] = np.nan
    encoding = {"dtype": "i2", "scale_factor": 0.5, "add_offset": -3.0, "_FillValue": -1}
    if chunks:
        encoding["chunksizes" if path.suffix == ".nc" else "chunks"] = chunks
    actual = read(written(path, values, encoding))
    np.testing.assert_array_equal(actual, values.astype("f4"))


def test_unsigned_integers_are_read_as_such(path):
    frames = stack("i2")
    frames[2, 2, 2] = -1  # 65535
    actual = read(written(path, frames, attributes={"_Unsigned": "true"}))
    assert actual.dtype == np.uint16
    np.testing.assert_array_equal(actual, frames.view("u2"))


@pytest.mark.parametrize(
    "attributes",
    [{"valid_range": np.array([10, 900], "u2")}, {"valid_min": np.uint16(10), "valid_max": np.uint16(900)}],
)
def test_samples_outside_of_the_valid_range_are_unknown(path, attributes):
    frames = stack()
    actual = read(written(path, frames, attributes=attributes))
    np.testing.assert_array_equal(
        actual, np.where((frames < 10) | (frames > 900), np.nan, frames.astype("f4"))
    )


def test_the_fill_value_of_floats_that_xarray_always_writes_changes_nothing(path):
    frames = stack("f4")
    with opened(written(path, frames)) as recording:
        assert recording.findings == ()
        np.testing.assert_array_equal(read_all(recording, 4).frames, frames)


def test_a_fill_value_of_floats_is_unknown(path):
    frames = stack("f4")
    frames[1, 1, 1] = np.nan
    np.testing.assert_array_equal(read(written(path, frames, {"_FillValue": -1.0})), frames)


@pytest.mark.parametrize(
    "dims",
    [("y", "x", "t"), ("x", "y", "frame"), ("row", "time", "column"), ("y", "x", "pose"), ("a", "b", "t")],
)
@pytest.mark.parametrize("chunks", [None, (3, 4, 2)])
def test_axes_are_in_the_order_of_their_names(path, dims, chunks):
    frames = stack()
    kinds = {"y": 1, "row": 1, "a": 1, "x": 2, "column": 2, "b": 2}
    encoding = {"chunksizes" if path.suffix == ".nc" else "chunks": chunks} if chunks else {}
    written(path, frames.transpose([kinds.get(name, 0) for name in dims]), encoding, dims)
    with opened(path) as recording:
        assert recording.shape == SHAPE
        assert [(finding.kind, finding.warning) for finding in recording.findings] == [
            ("order of axes", False)
        ]
        np.testing.assert_array_equal(recording.frame(5), frames[5])
        np.testing.assert_array_equal(read_all(recording, 4).frames, frames)


def test_a_region_of_transposed_frames_is_that_part(path):
    frames = stack()
    written(path, frames.transpose(1, 2, 0), dims=("y", "x", "t"))
    actual = read(path, region=io.Region((1, 5), (2, 4)), frames=(2, 8))
    np.testing.assert_array_equal(actual, frames[2:8, 1:5, 2:4])


@pytest.mark.parametrize(
    ("dims", "message"),
    [
        (("t", "y", "channel"), "give one channel, as a stack"),
        (("y", "row", "t"), "name frames, rows and columns differently"),
        (("x", "a", "b"), "the others are not known: name them t, y and x"),
    ],
)
def test_names_that_contradict_a_stack_are_refused(path, dims, message):
    written(path, stack(), dims=dims)
    with pytest.raises(io.InputError, match=message):
        opened(path)


@pytest.mark.parametrize(
    "names", [("t", "y", "x"), ("a", "b", "c"), ("z", "y", "x"), ("t", "a", "b"), ("a", "y", "b")]
)
def test_names_that_agree_or_contain_no_information_change_nothing(names):
    assert order_of([name if name != "c" else "d" for name in names], "here") == (0, 1, 2)


def test_labels_and_nexus_axes_name_the_dimensions(tmp_path):
    frames = stack()
    with h5py.File(tmp_path / "labels.h5", "w") as file:
        file["x"] = frames.transpose(1, 2, 0)
        for axis, name in enumerate(("y", "x", "t")):
            file["x"].dims[axis].label = name
    with h5py.File(tmp_path / "nexus.h5", "w") as file:
        group = file.create_group("entry/data")
        group["frames"] = frames.transpose(1, 2, 0)
        group.attrs["signal"], group.attrs["axes"] = "frames", ["y", "x", "t"]
    for name in ("labels.h5", "nexus.h5"):
        np.testing.assert_array_equal(read(tmp_path / name), frames)


def matlab(path, frames):
    """Write what MATLAB 7.3 does of an array (H, W, T): a block before the file, and the opposite order."""
    with h5py.File(path, "w", userblock_size=512) as file:
        file["frames"] = frames.transpose(0, 2, 1)
        file["frames"].attrs["MATLAB_class"] = np.bytes_(frames.dtype.name)
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512))


def test_a_stack_of_matlab_is_not_mirrored(tmp_path):
    frames = stack()
    matlab(tmp_path / "stack.mat", frames)
    with opened(tmp_path / "stack.mat") as recording:
        assert "frames, rows, columns are third, first, second" in recording.findings[0].text
        np.testing.assert_array_equal(read_all(recording, 4).frames, frames)


@pytest.mark.parametrize(
    ("start", "message"),
    [
        (b"MATLAB 5.0 MAT-file, Platform: GLNXA64", "MATLAB before version 7.3: write it with save"),
        (b"CDF\x01\0\0\0\0", "netCDF file of version 3, .*: convert it with 'nccopy -k nc4'"),
    ],
)
def test_older_files_of_other_programs_have_a_remedy(tmp_path, start, message):
    path = tmp_path / "stack.mat"
    path.write_bytes(start.ljust(512, b" "))
    with pytest.raises(io.InputError, match=message):
        opened(path)


EXACT = [("?", "u1", 2), ("i1", "u1", 128), ("i2", "u2", 30000), ("i4", "u2", 65536), ("u4", "u2", 65536)]
EXACT += [
    ("i8", "u2", 65536),
    ("u8", "u2", 65536),
    ("f2", "f4", 2048),
    ("f8", "f4", 1 << 24),
    (">u2", "u2", 65536),
]


def files_of(folder, frames):
    np.save(folder / "stack.npy", frames)
    np.savez(folder / "stack.npz", frames=frames)
    with h5py.File(folder / "stack.h5", "w") as file:
        file["x"] = frames
    return [folder / f"stack.{ending}" for ending in ("npy", "npz", "h5")]


@pytest.mark.parametrize(("stored", "dtype", "top"), EXACT)
def test_samples_that_have_an_exact_equivalent_are_converted(tmp_path, stored, dtype, top):
    frames = stack(stored, top)
    for path in files_of(tmp_path, frames):
        with opened(path) as recording:
            assert recording.dtype == np.dtype(dtype)
            kinds = [finding.kind for finding in recording.findings]
            assert kinds == ([] if stored[0] == ">" else ["converted samples"])
            np.testing.assert_array_equal(read_all(recording, 4).frames, frames)


@pytest.mark.parametrize(
    ("stored", "wrong", "message"),
    [
        ("i1", -1, "a sample of -1; int8 is read as uint8, 0 to 127: divide them, or write them as float32"),
        ("i2", -5, "a sample of -5; int16 is read as uint16, 0 to 65535"),
        ("i4", 70000, "a sample of 70000; int32 is read as uint16"),
        ("f8", 1e9, "a sample of 1e\\+09; float64 is read as float32, -16777216 to 16777216: divide them"),
    ],
)
def test_samples_without_an_equivalent_are_refused_with_their_frame(tmp_path, stored, wrong, message):
    frames = stack(stored, 100)
    frames[6, 2, 2] = wrong
    for path in files_of(tmp_path, frames):
        with pytest.raises(io.InputError, match=f"frame 6 has {message}".replace("0 to 127", "0 to 255")):
            read(path)


def test_a_sample_that_is_not_read_is_not_refused(tmp_path):
    frames = stack("i2")
    frames[7] = -1
    for path in files_of(tmp_path, frames)[::2]:
        np.testing.assert_array_equal(read(path, frames=(0, 7)), frames[:7])


def test_doubles_that_are_not_finite_stay_so(tmp_path):
    frames = stack("f8")
    frames[0, 0, :2] = np.nan, np.inf
    for path in files_of(tmp_path, frames):
        np.testing.assert_array_equal(read(path), frames)


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        ({"scale_factor": "two"}, "its attribute scale_factor is not a number"),
        ({"scale_factor": 0.0}, "scale_factor 0"),
    ],
)
def test_attributes_that_make_no_sense_are_refused(tmp_path, attributes, message):
    with h5py.File(tmp_path / "stack.h5", "w") as file:
        file["x"] = stack()
        file["x"].attrs.update(attributes)
    with pytest.raises(io.InputError, match=message):
        opened(tmp_path / "stack.h5")


def test_references_and_positions_of_a_recording_are_unpacked(tmp_path):
    path = tmp_path / "press.h5"
    with h5py.File(path, "w") as file:
        file["/entry/instrument/detector/data"] = stack()
        file["/entry/instrument/stage/motion"] = "vertical"
        file["/entry/instrument/stage/travel"] = np.arange(SHAPE[0], dtype="i2")
        file["/entry/instrument/stage/travel"].attrs.update(scale_factor=50.0, units="um")
        file["/entry/instrument/detector/dark"] = np.full(SHAPE[1:], 7, "i2")
        file["/entry/instrument/detector/dark"][0, 0] = -1
        file["/entry/instrument/detector/dark"].attrs["_FillValue"] = np.int16(-1)
        file["/entry"].attrs["mirrorskin_recording"] = 1
    with io.open_recording(path) as recording:
        assert recording.travel == pytest.approx(TRAVEL)
        assert np.isnan(recording.header.dark[0, 0])
        assert (recording.header.dark.reshape(-1)[1:] == 7).all()


def along_axes(travel=None, units="um", name="travel"):
    return {
        name: (name, 1000 * TRAVEL if travel is None else travel, {"units": units}),
        "y": ("y", -30.0 * np.arange(SHAPE[1]), {"units": "um"}),
        "x": ("x", 0.04 * np.arange(SHAPE[2]), {"units": "mm"}),
    }


def test_coordinates_with_units_are_positions_and_the_pixel_size(path):
    written(path, stack(), dims=("travel", "y", "x"), **along_axes())
    with io.open_recording(path) as recording:
        assert recording.motion == "vertical"
        assert recording.travel == pytest.approx(TRAVEL)
        assert recording.header.pixel_size == pytest.approx((0.04, 0.03))
        assert not any(finding.warning for finding in recording.findings)


def test_times_are_in_seconds_from_milliseconds_or_dates(path):
    written(path, stack(), dims=("t", "y", "x"), **along_axes(20.0 * np.arange(SHAPE[0]), "ms", "t"))
    with opened(path) as recording:
        assert recording.time == pytest.approx(0.02 * np.arange(SHAPE[0]))


def test_dates_are_seconds_from_the_first(path):
    dates = np.datetime64("2026-01-02T03:04:05", "ns") + np.arange(SHAPE[0]) * np.timedelta64(20, "ms")
    written(path, stack(), time=("time", dates), dims=("time", "y", "x"))
    with opened(path) as recording:
        assert recording.time == pytest.approx(0.02 * np.arange(SHAPE[0]))


def test_options_take_precedence_over_coordinates(path):
    written(path, stack(), dims=("travel", "y", "x"), **along_axes())
    with opened(path, pixel_size=(0.1, 0.1)) as recording:
        assert recording.travel[1] == pytest.approx(0.3)
        assert recording.header.pixel_size == (0.1, 0.1)


def test_coordinates_without_units_are_not_used(path):
    written(path, stack(), dims=("t", "y", "x"), y=("y", np.arange(SHAPE[1])), x=("x", np.arange(SHAPE[2])))
    with opened(path) as recording:
        assert recording.header.pixel_size is None
        assert recording.findings == ()


def test_rows_that_rise_are_reported(path):
    axes = along_axes() | {"y": ("y", 0.03 * np.arange(SHAPE[1]), {"units": "mm"})}
    written(path, stack(), dims=("travel", "y", "x"), **axes)
    with io.open_recording(path) as recording:
        warned = [finding.text for finding in recording.findings if finding.warning]
        assert len(warned) == 1
        assert "its coordinate y rises with the row, and the first one is taken as the top" in warned[0]


def test_uneven_pixels_are_reported(path):
    axes = along_axes() | {"x": ("x", np.arange(SHAPE[2]) ** 2.0, {"units": "mm"})}
    written(path, stack(), dims=("travel", "y", "x"), **axes)
    with io.open_recording(path) as recording:
        assert recording.header.pixel_size is None
        assert [finding.kind for finding in recording.findings if finding.warning] == ["uneven pixels"]


def test_the_voxel_size_of_fiji_is_the_pixel_size(tmp_path):
    with h5py.File(tmp_path / "stack.h5", "w") as file:
        file["x"] = stack()
        file["x"].attrs["element_size_um"] = [1.0, 30.0, 40.0]
    with opened(tmp_path / "stack.h5") as recording:
        assert recording.header.pixel_size == pytest.approx((0.04, 0.03))


def test_frames_of_xarray_are_in_the_order_of_their_names():
    frames = np.zeros((5, 2, 3), np.uint8)
    frames[3:, 1] = 255
    transposed = xarray.DataArray(frames.transpose(1, 2, 0), dims=("y", "x", "t"))
    actual = engine.find_onset(transposed, [0.0, 0.1, 0.2, 0.3, 0.4])
    np.testing.assert_array_equal(np.isfinite(actual.height), [[False] * 3, [True] * 3])


def ball_stack():
    """Return frames of 12 bits of a slope that turns light column by column, the travel, and the heights."""
    travel = 0.05 * np.arange(24)
    heights = -0.1 - 0.04 * np.arange(20)
    light = travel[:, np.newaxis, np.newaxis] > -heights[np.newaxis, np.newaxis, :]
    noise = np.random.default_rng(5).normal(0, 4, (24, 20, 20))
    return np.rint(200 + 3000 * light + noise).astype("u2"), travel, np.broadcast_to(heights, (20, 20))


def test_unknown_pixels_have_no_height_and_the_others_the_right_one(path):
    frames, travel, heights = ball_stack()
    frames[:, 3, 4] = 65535
    frames[10:, 7, :] = 65535
    written(path, frames, {"_FillValue": np.uint16(65535)}, dims=("t", "y", "x"))
    with opened(path, travel=travel, pixel_size=(0.1, 0.1)) as recording:
        actual = engine.reconstruct(recording, fill=False)
    assert np.isnan(actual.height[3, 4])
    unknown = np.zeros(heights.shape, bool)
    unknown[3, 4] = unknown[7] = True
    np.testing.assert_allclose(actual.height[~unknown], heights[~unknown], atol=0.03)


@pytest.mark.parametrize("order", [(1, 2, 0), (2, 1, 0)])
def test_the_surface_of_transposed_frames_is_neither_mirrored_nor_turned(path, order):
    frames, travel, heights = ball_stack()
    frames, heights = frames[:, :12], heights[:12]
    written(path, frames.transpose(order), dims=tuple("tyx"[axis] for axis in order))
    with opened(path, travel=travel) as recording:
        actual = engine.reconstruct(recording)
    np.testing.assert_allclose(actual.height, heights, atol=0.03)


@pytest.mark.parametrize("value", [np.arange(3), np.float32(2), "three", np.empty(0)])
def test_a_list_of_scales_of_another_type_is_not_a_list(tmp_path, value):
    with h5py.File(tmp_path / "stack.h5", "w") as file:
        file["x"] = stack()
        file["x"].attrs["DIMENSION_LIST"] = value
    np.testing.assert_array_equal(read(tmp_path / "stack.h5"), stack())


def test_a_unit_of_many_letters_is_not_looked_up(path):
    axes = along_axes() | {"y": ("y", np.arange(SHAPE[1]), {"units": "x" * 100_000})}
    written(path, stack(), dims=("travel", "y", "x"), **axes)
    with io.open_recording(path) as recording:
        assert recording.header.pixel_size is None
