"""OME-Zarr: axes, channels, units and scales are those that its metadata state."""

import json

import numpy as np
import pytest

from mirrorskin import io

zarr = pytest.importorskip("zarr")

FRAMES = np.random.default_rng(0).integers(1, 256, (6, 5, 7), np.uint8)
UNITS = {"t": "second", "z": "micrometer", "y": "micrometer", "x": "millimeter"}
TYPES = {"t": "time", "c": "channel"}
SCALES = {"t": 0.1, "c": 1.0, "z": 50.0, "y": 30.0, "x": 0.02}


def described(axes, levels, units=UNITS, common=None):
    """Return the metadata of a picture: the axes, and the scale of each level; see ngff.org."""

    def axis(name):
        unit = {"unit": units[name]} if name in units else {}
        return {"name": name, "type": TYPES.get(name, "space"), **unit}

    def scale(level):
        factors = [SCALES[name] * (2**level if name in "yx" else 1) for name in axes]
        return [{"type": "scale", "scale": factors}]

    datasets = [{"path": f"s{n}", "coordinateTransformations": scale(n)} for n in range(levels)]
    picture = {"axes": [axis(name) for name in axes], "datasets": datasets, "version": "0.4"}
    return picture | ({} if common is None else {"coordinateTransformations": common})


def write(path, arrays, picture, version=2, group=""):
    """Write a picture as OME-Zarr 0.4, in Zarr 2, or 0.5, in Zarr 3."""
    root = zarr.create_group(path, zarr_format=version, overwrite=True)
    image = root.create_group(group) if group else root
    for number, array in enumerate(arrays):
        image.create_array(f"s{number}", data=array)
    multiscales = {"multiscales": [picture]}
    image.attrs.update(multiscales if version == 2 else {"ome": {"version": "0.5", **multiscales}})
    return path


def opened(path, **options):
    return io.open_recording(path, **{"motion": "vertical", "travel": io.Steps(0.1)} | options)


def frames_of(path, **options):
    with opened(path, **options) as source:
        return source.read(np.empty(source.shape, source.dtype)).frames, source


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("axes", ["tczyx", "tcyx", "tzyx", "zcyx", "tyx", "zyx"])
def test_axes_of_length_one_are_left_out_and_scales_are_used(tmp_path, axes, version):
    shape = [{axes[0]: 6, "y": 5, "x": 7}.get(axis, 1) for axis in axes]
    path = write(tmp_path / "a.zarr", [FRAMES.reshape(shape)], described(axes, 1), version)
    actual, source = frames_of(path)
    np.testing.assert_array_equal(actual, FRAMES)
    assert source.header.pixel_size == pytest.approx((0.02, 0.03))
    if axes[0] == "t":
        np.testing.assert_allclose(source.time, 0.1 * np.arange(6))
    assert not any(finding.warning for finding in source.findings)


@pytest.mark.parametrize("version", [2, 3])
def test_each_level_has_its_own_scale(tmp_path, version):
    levels = [FRAMES.repeat(2, 1).repeat(2, 2), FRAMES]
    path = write(tmp_path / "a.zarr", levels, described("tyx", 2), version)
    for options, expected, size in (({}, levels[0], (0.02, 0.03)), ({"dataset": "s1"}, FRAMES, (0.04, 0.06))):
        actual, source = frames_of(path, **options)
        np.testing.assert_array_equal(actual, expected)
        assert source.header.pixel_size == pytest.approx(size)


def test_the_travel_of_a_stack_along_z_is_read(tmp_path):
    path = write(tmp_path / "a.zarr", [FRAMES], described("zyx", 1))
    with io.open_recording(path, motion="vertical") as source:
        np.testing.assert_allclose(source.travel, 0.05 * np.arange(6))


def test_a_channel_is_chosen(tmp_path):
    both = np.stack([FRAMES, 255 - FRAMES], axis=1)[:, :, None]
    path = write(tmp_path / "a.zarr", [both], described("tczyx", 1))
    with pytest.raises(io.InputError, match="/s0 has 2 channels: --channel 0 to 1 takes one of them"):
        opened(path)
    with pytest.raises(io.InputError, match="/s0 has 2 channels, and none is number 2"):
        opened(path, channel=2)
    for channel in range(2):
        actual, source = frames_of(path, channel=channel, frames=(1, 5), region=io.Region((1, 4), (2, 7)))
        np.testing.assert_array_equal(actual, both[1:5, channel, 0, 1:4, 2:7])
        assert source.header.pixel_size == pytest.approx((0.02, 0.03))


def test_a_scale_of_all_levels_multiplies_that_of_each(tmp_path):
    common = [
        {"type": "scale", "scale": [2.0, 3.0, 3.0]},
        {"type": "translation", "translation": [1.0, 5.0, 5.0]},
    ]
    path = write(tmp_path / "a.zarr", [FRAMES], described("tyx", 1, common=common))
    source = frames_of(path)[1]
    assert source.header.pixel_size == pytest.approx((0.06, 0.09))
    np.testing.assert_allclose(source.time, 1 + 0.2 * np.arange(6))


@pytest.mark.parametrize(
    ("units", "shown"), [({}, "no unit"), ({"y": "furlongs", "x": "px"}, "the unit 'px'")]
)
def test_a_scale_without_a_length_is_noted_and_not_used(tmp_path, units, shown):
    path = write(tmp_path / "a.zarr", [FRAMES], described("tyx", 1, units=units))
    source = frames_of(path)[1]
    assert source.header.pixel_size is None
    texts = [finding.text for finding in source.findings if finding.kind == "pixel size"]
    assert any(f"the spacing of x, 0.02 with {shown}, is not used" in text for text in texts)


def test_options_take_precedence(tmp_path):
    path = write(tmp_path / "a.zarr", [FRAMES], described("tyx", 1))
    assert frames_of(path, pixel_size=(0.5, 0.5))[1].header.pixel_size == (0.5, 0.5)


def test_a_picture_in_a_group_is_found(tmp_path):
    path = write(tmp_path / "a.zarr", [FRAMES, FRAMES[:, ::2]], described("tyx", 2), group="0")
    actual, source = frames_of(path)
    np.testing.assert_array_equal(actual, FRAMES)
    assert source.header.pixel_size == pytest.approx((0.02, 0.03))
    assert io.describe(path)["/0/s0"] == "6 x 5 x 7 uint8"


@pytest.mark.parametrize(
    "change",
    [
        {"axes": None},
        {"axes": [1, {}, "x"]},
        {"axes": [{"name": "t"}]},
        {"datasets": [{"path": 3}, {"path": "s0", "coordinateTransformations": [{"scale": ["a", 1, 1]}]}]},
        {"datasets": [{"path": "s0", "coordinateTransformations": [{"scale": [1, 1]}, 5]}]},
        {"datasets": "s0"},
        {"coordinateTransformations": {"scale": 1}},
    ],
    ids=str,
)
def test_damaged_metadata_are_ignored_or_refused_in_one_line(tmp_path, change):
    path = write(tmp_path / "a.zarr", [FRAMES], described("tyx", 1))
    (path / ".zattrs").write_text(json.dumps({"multiscales": [described("tyx", 1) | change]}))
    try:
        np.testing.assert_array_equal(frames_of(path)[0], FRAMES)
    except io.InputError as error:
        assert "\n" not in str(error)  # noqa: PT017
