import struct
import subprocess
import sys
import zlib

import cv2
import numpy as np
import pytest
import tifffile

from mirrorskin.io import Header, InputError, Source, Steps, open_frames
from mirrorskin.io.frames import Pictures

HEADER = Header("vertical", pixel_size=(0.03, 0.03))
SHAPE = (6, 9)


def frame(number, dtype=np.uint8):
    """Return a frame that its number tells apart from all others."""
    steps = np.arange(SHAPE[0] * SHAPE[1]).reshape(SHAPE)
    if dtype == np.float32:
        return (steps / 7 - number).astype(np.float32)
    return ((steps * 11 + number * 17) * (251 if dtype == np.uint16 else 1) % np.iinfo(dtype).max).astype(
        dtype
    )


def save(folder, names, dtype=np.uint8):
    """Save a frame under each name, numbered in the order given."""
    for number, name in enumerate(names):
        assert cv2.imwrite(str(folder / name), frame(number, dtype))


def drain(source, size=None):
    """Read to the end, ``size`` frames at a time; return copies of the frames, and the blocks."""
    room = None if size is None else np.empty((size, *source.shape[1:]), source.dtype)
    frames, blocks = [], []
    while (block := source.read(room)) is not None:
        frames.append(block.frames.copy())
        blocks.append(block)
    return np.concatenate(frames), blocks


def tiff(path, pages, **options):
    """Save pages as a TIFF, uncompressed unless options of tifffile say so."""
    tifffile.imwrite(path, np.stack(pages), photometric="minisblack", metadata=None, **options)
    return path


@pytest.mark.parametrize(
    ("suffix", "dtype"),
    [("png", np.uint8), ("png", np.uint16), ("tif", np.uint8), ("TIFF", np.uint16), ("tiff", np.float32)],
)
def test_frames_come_back_exactly(tmp_path, suffix, dtype):
    save(tmp_path, [f"image{k}.{suffix}" for k in range(4)], dtype)
    source: Source = Pictures(tmp_path, HEADER)
    frames, _ = drain(source)
    assert (source.shape, source.dtype, source.motion) == ((4, *SHAPE), dtype, "vertical")
    assert (source.name, source.header, source.rewindable) == (str(tmp_path), HEADER, True)
    np.testing.assert_array_equal(frames, [frame(k, dtype) for k in range(4)])


@pytest.mark.parametrize(
    "names",
    [
        ["image0.png", "image2.png", "image10.png"],
        ["run7_frame08_cam2.png", "run7_frame09_cam2.png", "run7_frame10_cam2.png"],
        ["s0.8.PNG", "s0.9.png", "s0.10.png"],
        ["a1.png", "a2.tif", "a3.tiff"],
    ],
)
def test_frames_are_in_the_order_of_their_numbers(tmp_path, names):
    save(tmp_path, names)
    frames, _ = drain(Pictures(tmp_path, HEADER))
    np.testing.assert_array_equal(frames, [frame(k) for k in range(3)])


def test_what_does_not_fit_the_pattern_is_left_out_and_named(tmp_path):
    save(tmp_path, ["image0.png", "image1.png", "image_ambient.png", "._image0.png", "dark7.png"])
    (tmp_path / "image3.txt").write_text("not a picture")
    (tmp_path / "image4.png").mkdir()
    source = Pictures(tmp_path, HEADER)
    assert source.shape[0] == 2
    assert source.left_out == ("._image0.png", "dark7.png", "image3.txt", "image_ambient.png")


@pytest.mark.parametrize("size", [None, 3, 8])
def test_blocks_of_any_size_give_the_same_frames(tmp_path, size):
    save(tmp_path, [f"image{k}.png" for k in range(5)])
    travel = 0.1 * np.arange(1, 6)
    source = Pictures(tmp_path, HEADER, travel=travel, phase=-travel)
    frames, blocks = drain(source, size)
    np.testing.assert_array_equal(frames, [frame(k) for k in range(5)])
    np.testing.assert_array_equal(np.concatenate([b.travel for b in blocks]), travel)
    np.testing.assert_array_equal(np.concatenate([b.phase for b in blocks]), -travel)
    assert [b.index for b in blocks] == list(range(0, 5, size or 1))
    assert {b.time for b in blocks} == {None}
    assert {b.dropped for b in blocks} == {0}


def test_no_block_spans_a_gap_and_the_next_says_how_many_were_lost(tmp_path):
    save(tmp_path, ["image5.png", "image6.png", "image9.png", "image10.png", "image12.png"])
    source = Pictures(tmp_path, HEADER, travel=Steps(0.5, 1.0))
    for _ in range(2):
        frames, blocks = drain(source, 8)
        np.testing.assert_array_equal(frames, [frame(k) for k in range(5)])
        assert [(b.index, len(b.frames), b.dropped) for b in blocks] == [(0, 2, 0), (2, 2, 2), (4, 1, 1)]
        # Steps count the lost frames: the body moved on while they were lost.
        assert np.concatenate([b.travel for b in blocks]).tolist() == [1.0, 1.5, 3.0, 3.5, 4.5]
        source.rewind()


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ([], "no numbered PNG or TIFF"),
        (["ambient.png"], "no numbered PNG or TIFF"),
        (["img1.png", "img01.png"], "img01.png and img1.png have the same number"),
        (["img1.png", "img1.tif", "img2.png"], "img1.png and img1.tif have the same number"),
        (["a1.png", "a2.png", "b1.png", "b2.png", "b3.png"], "2 sequences, a#, b#"),
        (["a1.png", "b1.png"], "2 sequences, a#, b#"),
        (["f1_cam1.png", "f1_cam2.png", "f2_cam1.png", "f2_cam2.png"], "2 sequences, f1_cam#, f2_cam#"),
    ],
)
def test_a_folder_without_one_clear_sequence_is_refused(tmp_path, names, message):
    save(tmp_path, names)
    with pytest.raises(InputError, match=message) as caught:
        Pictures(tmp_path, HEADER)
    assert str(tmp_path) in str(caught.value)


@pytest.mark.parametrize(
    ("odd", "kind"),
    [(np.zeros((9, 6), np.uint8), "6 x 9 uint8"), (np.zeros(SHAPE, np.uint16), "9 x 6 uint16")],
)
def test_a_frame_unlike_the_first_is_named(tmp_path, odd, kind):
    save(tmp_path, ["image0.png", "image1.png"])
    cv2.imwrite(str(tmp_path / "image2.png"), odd)
    source = Pictures(tmp_path, HEADER)
    with pytest.raises(InputError, match=rf"image2\.png is {kind}, but .*image0\.png is 9 x 6 uint8"):
        drain(source, 3)


def halved(data):
    return data[: len(data) // 2]


def flipped(data):
    middle = len(data) * 2 // 3
    return data[:middle] + bytes([data[middle] ^ 0x55]) + data[middle + 1 :]


@pytest.mark.parametrize(
    ("suffix", "damage"),
    [
        ("png", halved),
        ("png", flipped),
        ("tif", halved),
        ("png", lambda data: b""),
        ("png", lambda data: b"hello"),
        ("tif", lambda data: b"\xff\xd8\xff\xe0 a JPEG"),
    ],
)
@pytest.mark.parametrize("number", [0, 1])
def test_a_damaged_picture_is_named(tmp_path, suffix, damage, number):
    save(tmp_path, [f"image{k}.{suffix}" for k in range(3)], np.uint16)
    file = tmp_path / f"image{number}.{suffix}"
    file.write_bytes(damage(file.read_bytes()))
    with pytest.raises(InputError, match=str(file)):
        drain(Pictures(tmp_path, HEADER))


@pytest.mark.parametrize("path", [".", "image0.tif"])
@pytest.mark.parametrize("dtype", [np.int8, np.int16, np.int32, np.float64])
def test_other_types_of_sample_are_refused(tmp_path, dtype, path):
    cv2.imwrite(str(tmp_path / "image0.tif"), np.zeros(SHAPE, dtype))
    with pytest.raises(InputError, match=rf"image0\.tif \(page 1\) has 1 {np.dtype(dtype)} a pixel"):
        Pictures(tmp_path / path, HEADER)


@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize(("suffix", "dtype"), [("png", np.uint8), ("png", np.uint16), ("tif", np.float32)])
def test_colour_with_equal_channels_is_taken_exactly(tmp_path, suffix, dtype, channels):
    picture = np.repeat(frame(1, dtype)[..., np.newaxis], channels, axis=2)
    picture[..., 3:] = 7
    cv2.imwrite(str(tmp_path / f"image0.{suffix}"), picture, [cv2.IMWRITE_TIFF_COMPRESSION, 1])
    np.testing.assert_array_equal(Pictures(tmp_path, HEADER).read().frames[0], frame(1, dtype))


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.uint8, 0.51), (np.uint16, 1.5)])
def test_true_colour_becomes_luma(tmp_path, dtype, tolerance):
    blue, green, red = (frame(k, dtype) for k in (1, 5, 9))
    cv2.imwrite(str(tmp_path / "image0.png"), np.dstack([blue, green, red]))
    luma = 0.299 * red.astype(float) + 0.587 * green + 0.114 * blue
    np.testing.assert_allclose(Pictures(tmp_path, HEADER).read().frames[0], luma, atol=tolerance)


@pytest.mark.parametrize(
    "options", [{}, {"byteorder": ">"}, {"bigtiff": True}, {"rowsperstrip": 2}, {"compression": "zlib"}]
)
def test_the_pages_of_a_tiff_are_frames(tmp_path, options):
    pages = [frame(k, np.uint16) for k in range(5)]
    source = Pictures(tiff(tmp_path / "stack.tif", pages, **options), HEADER, travel=Steps(0.1))
    assert (source.shape, source.left_out) == ((5, *SHAPE), ())
    np.testing.assert_array_equal(drain(source, 2)[0], pages)


@pytest.mark.parametrize("kept", [0.1, 0.4, 0.9])
def test_a_stack_of_pages_that_is_cut_off_is_refused(tmp_path, kept):
    cv2.imwritemulti(str(tmp_path / "stack.tif"), [frame(k, np.uint16) for k in range(5)])
    data = (tmp_path / "stack.tif").read_bytes()
    (tmp_path / "stack.tif").write_bytes(data[: int(len(data) * kept)])
    with pytest.raises(InputError, match="cut off"):
        Pictures(tmp_path / "stack.tif", HEADER)


def test_a_page_unlike_the_first_is_named(tmp_path):
    tiff(tmp_path / "stack.tif", [frame(0, np.uint16)])
    tiff(tmp_path / "stack.tif", [np.zeros((5, 4), np.uint16)], append=True)
    with pytest.raises(InputError, match=r"\(page 2\) is 4 x 5 uint16, but .* \(page 1\) is 9 x 6 uint16"):
        drain(Pictures(tmp_path / "stack.tif", HEADER), 3)


def test_open_frames_takes_folders_and_tiffs_as_pictures(tmp_path):
    save(tmp_path, ["image0.tif", "image1.tif"])
    for path in (tmp_path, str(tmp_path / "image0.tif")):
        source = open_frames(path, HEADER, travel=Steps(0.1))
        assert isinstance(source, Pictures)
        assert source.read().travel.tolist() == [0.0]


def test_decoders_print_nothing(tmp_path):
    save(tmp_path, [f"image{k}.png" for k in range(2)])
    data = (tmp_path / "image0.png").read_bytes()
    body = b"iCCPx\0\0" + zlib.compress(bytes(132))
    profile = struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
    (tmp_path / "image0.png").write_bytes(data[:33] + profile + data[33:])
    (tmp_path / "image1.png").write_bytes(flipped(data))
    stack = tiff(tmp_path / "stack.tif", [frame(0, np.uint16)])
    stack.write_bytes(stack.read_bytes()[:-50])
    program = """
import sys
from mirrorskin.io import Header, InputError, Steps, open_frames
assert "cv2" not in sys.modules
for path in sys.argv[1:]:
    try:
        source = open_frames(path, Header("vertical"), travel=Steps(0.1))
        while source.read() is not None:
            print("read")
    except InputError:
        print("refused")
"""
    arguments = [sys.executable, "-c", program, tmp_path, tmp_path / "stack.tif"]
    done = subprocess.run(arguments, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["read", "refused", "refused"]
    assert done.stderr == ""
