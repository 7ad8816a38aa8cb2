"""Stacks in TIFF: frames are those described by the metadata, value by value."""

import struct

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

from mirrorskin.io import InputError, Region, Steps, describe, open_recording

SHAPE = (7, 9)
BITS8, BITS16 = np.dtype(np.uint8), np.dtype(np.uint16)


def stack(count, dtype=BITS16, channels=0):
    """Return frames (T, H, W), or (T, C, H, W), whose samples all differ from each other."""
    shape = (count, channels, *SHAPE) if channels else (count, *SHAPE)
    return (np.arange(np.prod(shape)).reshape(shape) * 11 % np.iinfo(dtype).max).astype(dtype)


def opened(path, **options):
    return open_recording(path, **({"motion": "vertical", "travel": Steps(0.1)} | options))


def frames_of(path, **options):
    with opened(path, **options) as source:
        return source.read(np.empty(source.shape, source.dtype)).frames, source


def write(path, frames, **options):
    tifffile.imwrite(path, frames, **({"photometric": "minisblack"} | options))
    return path


PLAIN = {"metadata": None}

SAMPLES = {"stack.tif": lambda path: write(path, stack(6), **PLAIN)}


@pytest.mark.parametrize(
    "options",
    [
        PLAIN,
        {"byteorder": ">", **PLAIN},
        {"bigtiff": True, **PLAIN},
        {"rowsperstrip": 2, **PLAIN},
        {"compression": "zlib", **PLAIN},
        {"compression": "zlib", "byteorder": ">", **PLAIN},
        {"tile": (16, 16), **PLAIN},
        {"tile": (16, 16), "compression": "zlib", **PLAIN},
        {},  # tifffile's own description of the shape
        {"metadata": {"axes": "TYX"}},
        {"metadata": {"axes": "ZYX"}},
        {"imagej": True},
        {"imagej": True, "truncate": True},
        {"imagej": True, "metadata": {"axes": "TYX"}},
        {"ome": True, "metadata": {"axes": "ZYX"}},
        {"ome": True, "compression": "zlib", "metadata": {"axes": "TYX"}},
    ],
    ids=str,
)
@pytest.mark.parametrize("dtype", [BITS8, BITS16])
def test_the_frames_of_a_stack_come_back_exactly(tmp_path, dtype, options):
    frames = stack(5, dtype)
    np.testing.assert_array_equal(frames_of(write(tmp_path / "a.tif", frames, **options))[0], frames)


def test_float32_comes_back_exactly(tmp_path):
    frames = (stack(5) / 7).astype(np.float32)
    path = write(tmp_path / "a.tif", frames)
    with opened(path) as source:
        np.testing.assert_array_equal(source.read(np.empty(source.shape, source.dtype)).frames, frames)


@pytest.mark.parametrize("options", [PLAIN, {"compression": "zlib"}, {"byteorder": ">"}], ids=str)
def test_float16_is_read_as_float32(tmp_path, options):
    frames = (stack(5) / 7).astype(np.float16)
    actual, _ = frames_of(write(tmp_path / "a.tif", frames, **options))
    assert actual.dtype == np.float32
    np.testing.assert_array_equal(actual, frames)
    for number, frame in enumerate(frames):
        write(tmp_path / f"frame{number}.tif", frame, **options)
    (tmp_path / "a.tif").unlink()
    np.testing.assert_array_equal(frames_of(tmp_path)[0], frames)


@pytest.mark.parametrize("dtype", ["int8", "int16", "uint32", "int32", "float64"])
def test_other_types_are_converted_where_that_is_exact(tmp_path, dtype):
    frames = stack(5, BITS8) // 2
    actual, source = frames_of(write(tmp_path / "a.tif", frames.astype(dtype)))
    np.testing.assert_array_equal(actual, frames)
    assert [(finding.kind, finding.warning) for finding in source.findings] == [("converted samples", False)]


def test_a_sample_that_cannot_be_converted_is_named(tmp_path):
    frames = stack(5).astype(np.int32)
    frames[3] -= 5000
    with (
        opened(write(tmp_path / "a.tif", frames)) as source,
        pytest.raises(InputError, match=r"a\.tif: frame 3 has a sample of .*; int32 is read as uint16"),
    ):
        source.read(np.empty(source.shape, source.dtype))


@pytest.mark.parametrize("suffix", [".tif", ".tiff", ".TIF"])
def test_lzw_with_a_predictor_comes_back_exactly(tmp_path, suffix):
    frames = stack(4)
    assert cv2.imwritemulti(str(tmp_path / f"a{suffix}"), [*frames])  # OpenCV compresses by LZW
    np.testing.assert_array_equal(frames_of(tmp_path / f"a{suffix}")[0], frames)


@pytest.mark.parametrize(
    "options", [PLAIN, {"compression": "zlib"}, {"imagej": True, "truncate": True}], ids=str
)
def test_a_part_is_read_as_a_part_of_the_whole(tmp_path, options):
    frames = stack(6)
    part = {"frames": (2, 5), "region": Region((1, 5), (3, 8))}
    actual, source = frames_of(write(tmp_path / "a.tif", frames, **options), **part)
    np.testing.assert_array_equal(actual, frames[2:5, 1:5, 3:8])
    assert source.travel.tolist() == pytest.approx([0.2, 0.3, 0.4])


@pytest.mark.parametrize(
    "options",
    [
        {"imagej": True, "metadata": {"axes": "TCYX"}},
        {"ome": True, "metadata": {"axes": "TCYX"}},
        {"metadata": {"axes": "TCYX"}},
        {"metadata": {"axes": "ZCYX"}, "compression": "zlib"},
    ],
    ids=str,
)
def test_channels_are_refused_unless_one_is_chosen(tmp_path, options):
    frames = stack(5, channels=3)
    path = write(tmp_path / "a.tif", frames, **options)
    with pytest.raises(InputError, match=r"a\.tif has 3 channels: --channel 0 to 2 takes one of them"):
        opened(path)
    np.testing.assert_array_equal(frames_of(path, channel=1)[0], frames[:, 1])


def test_a_channel_that_is_not_there_is_refused(tmp_path):
    path = write(tmp_path / "a.tif", stack(5, channels=3), metadata={"axes": "TCYX"})
    with pytest.raises(InputError, match="3 channels, and none is number 3: --channel 0 to 2"):
        opened(path, channel=3)


def test_a_channel_of_a_stack_with_one_is_refused(tmp_path):
    with pytest.raises(InputError, match="has one channel: leave --channel out"):
        opened(write(tmp_path / "a.tif", stack(5)), channel=0)


def test_channels_that_may_be_the_colours_of_one_picture_are_not_frames(tmp_path):
    path = write(tmp_path / "a.tif", stack(4), metadata={"axes": "CYX"})
    with pytest.raises(InputError, match=r"4 channels: .*; if they are frames, save them with the axes TYX"):
        opened(path)


def test_more_channels_without_time_or_depth_are_frames(tmp_path):
    """What tifffile writes for ImageJ where no axes are given."""
    actual, source = frames_of(write(tmp_path / "a.tif", stack(5), imagej=True))
    np.testing.assert_array_equal(actual, stack(5))
    assert [(finding.kind, finding.warning) for finding in source.findings] == [("channels", False)]


@pytest.mark.parametrize("options", [{"imagej": True}, {"ome": True}, {}], ids=str)
def test_frames_with_two_orders_are_refused(tmp_path, options):
    path = write(tmp_path / "a.tif", stack(4, channels=3), metadata={"axes": "TZYX"}, **options)
    with pytest.raises(InputError, match=r"has the axes TZYX \(4 T x 3 Z\), but frames have one order"):
        opened(path)


@pytest.mark.parametrize("options", [{}, {"compression": "zlib"}], ids=str)
@pytest.mark.parametrize("length", [1, 2])
def test_frames_that_were_appended_are_one_stack(tmp_path, options, length):
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        for part in np.split(stack(6), 6 // length):
            file.write(part if length > 1 else part[0], photometric="minisblack", **options)
    np.testing.assert_array_equal(frames_of(tmp_path / "a.tif")[0], stack(6))


def test_frames_that_no_metadata_describe_are_not_left_out(tmp_path):
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        for _ in range(2):
            file.write(stack(3), photometric="minisblack", truncate=True)
    with pytest.raises(InputError, match="pages that its metadata do not describe"):
        opened(tmp_path / "a.tif")


@pytest.mark.parametrize("compression", ["tiff_lzw", "packbits", "raw"])
def test_opacity_does_not_change_colours(tmp_path, compression):
    frames = stack(3, BITS8)
    pages = [Image.fromarray(np.dstack([frame, frame, frame, 255 - frame])) for frame in frames]
    path = tmp_path / "a.tif"
    pages[0].save(path, save_all=True, append_images=pages[1:], compression=compression)
    np.testing.assert_array_equal(frames_of(path)[0], frames)


@pytest.mark.parametrize("compression", ["zstd", "lzma"])
def test_a_compression_that_is_not_read_is_named(tmp_path, compression):
    pages = [Image.fromarray(frame) for frame in stack(3, BITS8)]
    path = tmp_path / "a.tif"
    pages[0].save(path, save_all=True, append_images=pages[1:], compression=compression)
    with pytest.raises(InputError, match=rf"a\.tif is compressed by {compression.upper()}: save it with LZW"):
        opened(path)


def test_of_several_series_one_is_chosen(tmp_path):
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        file.write(stack(3), photometric="minisblack", metadata=None)
        file.write(stack(4)[:, :5], photometric="minisblack", metadata=None)
    with pytest.raises(InputError, match=r"2 series of pictures, 0: 3 x 7 x 9 uint16.*, 1: 4 x 5 x 9"):
        opened(tmp_path / "a.tif")
    np.testing.assert_array_equal(frames_of(tmp_path / "a.tif", dataset="1")[0], stack(4)[:, :5])


@pytest.mark.parametrize("dtype", [BITS8, BITS16])
@pytest.mark.parametrize("options", [PLAIN, {"compression": "zlib"}], ids=str)
def test_where_white_is_zero_samples_are_inverted(tmp_path, dtype, options):
    frames = stack(3, dtype)
    actual, source = frames_of(write(tmp_path / "a.tif", frames, photometric="miniswhite", **options))
    np.testing.assert_array_equal(actual, np.iinfo(dtype).max - frames)
    assert [(finding.kind, finding.warning) for finding in source.findings] == [("white is zero", False)]


def test_floats_whose_white_is_zero_are_refused(tmp_path):
    path = write(tmp_path / "a.tif", stack(3).astype(np.float32), photometric="miniswhite")
    with pytest.raises(InputError, match="white is zero, but samples are float32"):
        opened(path)


@pytest.mark.parametrize(
    ("orientation", "upright"),
    [
        (1, lambda frames: frames),
        (2, lambda frames: frames[:, :, ::-1]),
        (3, lambda frames: np.rot90(frames, 2, (1, 2))),
        (4, lambda frames: frames[:, ::-1]),
        (5, lambda frames: frames.transpose(0, 2, 1)),
        (6, lambda frames: np.rot90(frames, -1, (1, 2))),
        (7, lambda frames: np.rot90(frames, 2, (1, 2)).transpose(0, 2, 1)),
        (8, lambda frames: np.rot90(frames, 1, (1, 2))),
    ],
)
@pytest.mark.parametrize("options", [PLAIN, {"compression": "zlib"}], ids=str)
def test_frames_are_turned_as_they_are_displayed(tmp_path, options, orientation, upright):
    tag = (274, "H", 1, orientation, False)
    path = write(tmp_path / "a.tif", stack(3), extratags=[tag], **options)
    np.testing.assert_array_equal(frames_of(path)[0], upright(stack(3)))


@pytest.mark.parametrize("options", [PLAIN, {"compression": "zlib"}], ids=str)
def test_a_microscope_s_table_of_colours_gives_indices(tmp_path, options):
    frames, green = stack(3, BITS8), np.zeros((3, 256), np.uint16)
    green[1] = np.arange(256) * 257
    actual, source = frames_of(
        write(tmp_path / "a.tif", frames, photometric="palette", colormap=green, **options)
    )
    np.testing.assert_array_equal(actual, frames)
    assert [(finding.kind, finding.warning) for finding in source.findings] == [("colour table", False)]


@pytest.mark.filterwarnings("ignore:.*writing.*photometric:DeprecationWarning")
def test_three_frames_in_one_planar_picture_get_a_hint(tmp_path):
    tifffile.imwrite(
        tmp_path / "a.tif", stack(3, BITS8), photometric="rgb", planarconfig="separate", metadata=None
    )
    with pytest.raises(InputError, match=r"1 frame: .* planes of a picture .* photometric='minisblack'"):
        opened(tmp_path / "a.tif")


@pytest.mark.parametrize("planar", ["contig", "separate"])
@pytest.mark.parametrize("options", [PLAIN, {"compression": "zlib"}], ids=str)
def test_colours_become_luma_and_are_reported(tmp_path, planar, options):
    frames = stack(4, BITS8, channels=3)
    pages = frames if planar == "separate" else np.moveaxis(frames, 1, -1)
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, pages, photometric="rgb", planarconfig=planar, **options)
    luma = np.tensordot([0.299, 0.587, 0.114], frames.astype(float), axes=(0, 1))
    actual, source = frames_of(path)
    np.testing.assert_allclose(actual, luma, atol=0.51)
    assert "colour" in [finding.kind for finding in source.findings]
    np.testing.assert_array_equal(frames_of(path, channel=2)[0], frames[:, 2])


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (
            {"imagej": True, "resolution": (2.0, 2.0), "metadata": {"unit": "um", "axes": "TYX"}},
            "pixels of 0.5 x 0.5 µm",
        ),
        (
            {
                "ome": True,
                "metadata": {"axes": "TYX", "PhysicalSizeX": 0.65, "PhysicalSizeY": 0.7},
            },
            "pixels of 0.65 x 0.7 µm",
        ),
    ],
    ids=["ImageJ", "OME"],
)
def test_a_pixel_size_in_the_metadata_is_reported(tmp_path, options, text):
    _, source = frames_of(write(tmp_path / "a.tif", stack(3), **options))
    (actual,) = source.findings
    assert (actual.kind, actual.warning) == ("pixel size", False)
    assert text in actual.text
    assert "--pixel-size" in actual.text
    assert source.header.pixel_size is None


@pytest.mark.parametrize(
    ("options", "kept"),
    [(options, kept) for options in (PLAIN, {"imagej": True, "truncate": True}) for kept in (0.1, 0.4, 0.9)]
    + [({"ome": True}, 0.1), ({"ome": True}, 0.4)],  # the text of OME is at the end
    ids=str,
)
def test_a_stack_that_is_cut_off_is_refused(tmp_path, options, kept):
    path = write(tmp_path / "a.tif", stack(20), **options)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * kept)])
    with pytest.raises(InputError, match="cut off"):
        opened(path)


def test_a_stack_without_the_last_byte_of_its_last_frame_is_refused(tmp_path):
    path = write(tmp_path / "a.tif", stack(5), truncate=True)
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(InputError, match=r"a\.tif is damaged or cut off"):
        opened(path)


@pytest.mark.parametrize("strip", [0, 1, 3])
def test_a_strip_beyond_the_end_of_the_file_is_refused(tmp_path, strip):
    path = write(tmp_path / "a.tif", stack(2), rowsperstrip=2, compression="zlib", metadata=None)
    with tifffile.TiffFile(path, mode="r+") as file:
        sizes = file.pages[1].tags["StripByteCounts"]
        sizes.overwrite([60_000 if number == strip else size for number, size in enumerate(sizes.value)])
    with pytest.raises(InputError, match=r"a\.tif is damaged or cut off"):
        opened(path)


def test_a_page_whose_strips_disagree_is_refused(tmp_path):
    path = write(tmp_path / "a.tif", stack(2), rowsperstrip=2, compression="zlib", metadata=None)
    with tifffile.TiffFile(path) as file:
        tag = file.pages[1].tags[279]  # the sizes of the strips
    data = bytearray(path.read_bytes())
    struct.pack_into("<I", data, tag.offset + 4, tag.count - 1)
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"a\.tif is damaged or cut off"):
        opened(path)


def test_no_other_file_is_opened(tmp_path):
    """The metadata of OME may name further files."""
    write(tmp_path / "other.tif", stack(3))
    write(tmp_path / "a.ome.tif", stack(3), ome=True, metadata={"axes": "TYX"})
    data = (tmp_path / "a.ome.tif").read_bytes()
    at = data.index(b"<TiffData")
    end = data.index(b"/>", at) + 2
    tag = b'<TiffData><UUID FileName="other.tif">urn:uuid:1</UUID></TiffData>'
    (tmp_path / "a.ome.tif").write_bytes(data[:at] + tag[: end - at].ljust(end - at) + data[end:])
    (tmp_path / "other.tif").chmod(0)
    np.testing.assert_array_equal(frames_of(tmp_path / "a.ome.tif")[0], stack(3))


def test_a_stack_is_described_without_positions(tmp_path):
    facts = describe(write(tmp_path / "a.tif", stack(5), imagej=True, truncate=True))
    assert facts["frames"] == "5 of 9 x 7, uint16"


def ome(planes="<TiffData/>", **sizes):
    """Return a description as OME has it, of pages of `SHAPE`."""
    stated = {"SizeX": SHAPE[1], "SizeY": SHAPE[0], "SizeC": 1, "SizeZ": 1, "SizeT": 1} | sizes
    text = " ".join(f'{name}="{value}"' for name, value in stated.items())
    return (
        '<?xml version="1.0" encoding="UTF-8"?>'
        '<OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06"><Image ID="Image:0">'
        f'<Pixels ID="Pixels:0" DimensionOrder="XYCZT" Type="uint16" {text}>'
        f'<Channel ID="Channel:0:0" SamplesPerPixel="1"/>{planes}</Pixels></Image></OME>'
    )


def imagej(images, **axes):
    return "\n".join(["ImageJ=1.53k", f"images={images}", *(f"{name}={n}" for name, n in axes.items()), ""])


def stated(count):
    """Return descriptions of other programs that state a number of pages."""
    shape = ", ".join(map(str, (count, *SHAPE)))
    return {
        "ImageJ": imagej(count, frames=count),
        "ImageJ, slices": imagej(count, slices=count),
        "OME": ome(SizeT=count),
        "OME, planes": ome(f'<TiffData IFD="0" PlaneCount="{count}"/>', SizeZ=count),
        "tifffile": f'{{"shape": [{shape}]}}',
    }


@pytest.mark.parametrize("options", [{}, {"compression": "zlib"}, {"contiguous": False}], ids=str)
@pytest.mark.parametrize("program", stated(1))
def test_more_pages_than_the_metadata_state_are_read_with_a_warning(tmp_path, program, options):
    path = tmp_path / "a.ome.tif"
    write(path, stack(8), description=stated(5)[program], **PLAIN, **options)
    actual, source = frames_of(path)
    np.testing.assert_array_equal(actual, stack(8))
    if program != "tifffile":  # whose reader ignores such a description
        ((kind, text, warning),) = [(part.kind, part.text, part.warning) for part in source.findings]
        assert (kind, warning) == ("number of frames", True)
        assert "state 5 pictures, and it contains 8: all are read" in text


@pytest.mark.parametrize("options", [{}, {"compression": "zlib"}], ids=str)
@pytest.mark.parametrize("program", stated(1))
def test_fewer_pages_than_the_metadata_state_are_read_with_a_warning(tmp_path, program, options):
    path = write(tmp_path / "a.ome.tif", stack(8), description=stated(12)[program], **PLAIN, **options)
    actual, source = frames_of(path)
    np.testing.assert_array_equal(actual, stack(8))
    ((text, warning),) = [(part.text, part.warning) for part in source.findings]
    assert warning
    assert "state 12 pictures, and it contains 8: these are read" in text
    assert source.travel.tolist() == pytest.approx([0.1 * number for number in range(8)])


@pytest.mark.parametrize("count", [5, 12])
def test_sizes_that_disagree_among_themselves_do_not_hide_pages(tmp_path, count):
    path = write(tmp_path / "a.tif", stack(8), description=imagej(8, frames=count), **PLAIN)
    np.testing.assert_array_equal(frames_of(path)[0], stack(8))


@pytest.mark.parametrize(
    "description", [imagej(12, frames=6, channels=2), ome(SizeT=6, SizeC=2)], ids=["ImageJ", "OME"]
)
def test_pages_of_several_channels_that_are_not_all_there_are_refused(tmp_path, description):
    path = write(tmp_path / "a.ome.tif", stack(8), description=description, **PLAIN)
    with pytest.raises(
        InputError, match=r"state 12 pictures, and it contains 8: their order along the axes T, C"
    ):
        opened(path)


def test_pictures_in_one_piece_that_is_too_short_are_counted(tmp_path):
    path = write(tmp_path / "a.tif", stack(20), imagej=True, truncate=True, metadata={"axes": "TYX"})
    path.write_bytes(path.read_bytes()[: -5 * stack(1).nbytes])
    with pytest.raises(
        InputError, match=r"cut off \(20 pictures are stated, and 1[45] are present\): copy it again"
    ):
        opened(path)


def test_planes_that_were_never_written_are_lost_frames(tmp_path):
    planes = [number for number in range(8) if number not in (3, 4)]
    listed = "".join(f'<TiffData IFD="{k}" FirstT="{n}" PlaneCount="1"/>' for k, n in enumerate(planes))
    path = write(tmp_path / "a.ome.tif", stack(8)[planes], description=ome(listed, SizeT=9), **PLAIN)
    with opened(path) as source:
        actual = [source.frame(number) for number in range(6)]
    np.testing.assert_array_equal(actual, stack(8)[planes])
    assert source.travel.tolist() == pytest.approx([0.1 * number for number in planes])
    assert {part.kind for part in source.findings} == {"number of frames", "lost frames"}


def test_one_file_of_several_is_reported_as_a_part(tmp_path):
    listed = "".join(
        f'<TiffData IFD="{n % 4}" FirstT="{n}" PlaneCount="1">'
        f'<UUID FileName="{name}.ome.tif">urn:uuid:{name}</UUID></TiffData>'
        for n in range(8)
        for name in ["ab"[n // 4]]
    )
    for part, name in zip((stack(8)[:4], stack(8)[4:]), "ab", strict=True):
        write(tmp_path / f"{name}.ome.tif", part, description=ome(listed, SizeT=8), **PLAIN)
    actual, source = frames_of(tmp_path / "a.ome.tif")
    np.testing.assert_array_equal(actual, stack(8)[:4])
    ((text, warning),) = [(part.text, part.warning) for part in source.findings]
    assert warning
    assert "state 8 pictures, and it contains 4; others are in b.ome.tif" in text


@pytest.mark.parametrize(
    ("sizes", "axis"), [({"SizeT": 4}, "C"), ({"SizeT": 8}, "C"), ({"SizeC": 2, "SizeT": 3}, "T")], ids=str
)
def test_planes_beyond_the_stated_size_are_refused(tmp_path, sizes, axis):
    planes = "".join(
        f'<TiffData IFD="{n}" FirstC="{n % 2}" FirstT="{n // 2}" PlaneCount="1"/>' for n in range(8)
    )
    path = write(tmp_path / "a.ome.tif", stack(8), description=ome(planes, **sizes), **PLAIN)
    with pytest.raises(
        InputError, match=rf"of the 8 planes .* have a {axis} beyond the size, such as First{axis}="
    ):
        opened(path)


def test_a_stack_with_a_thumbnail_is_read_without_it(tmp_path):
    with tifffile.TiffWriter(tmp_path / "a.ome.tif") as file:
        file.write(stack(5), photometric="minisblack", description=ome(SizeT=5), **PLAIN)
        file.write(stack(1)[0, :3, :4], photometric="minisblack", **PLAIN)
    actual, source = frames_of(tmp_path / "a.ome.tif")
    np.testing.assert_array_equal(actual, stack(5))
    assert source.findings == ()
