import struct
import subprocess
import sys
import zlib
from fractions import Fraction

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

from mirrorskin.io import InputError, Source, Steps, open_recording
from mirrorskin.io.formats.pictures import decode_picture, read_picture

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


def write_sample(folder):
    folder.mkdir()
    save(folder, [f"frame{number}.png" for number in range(4)])


SAMPLES = {"pictures": write_sample}


def drain(source, size=None):
    """Read to the end, ``size`` frames at a time; return copies of the frames, and the blocks."""
    buffer = None if size is None else np.empty((size, *source.shape[1:]), source.dtype)
    frames, blocks = [], []
    while (block := source.read(buffer)) is not None:
        frames.append(block.frames.copy())
        blocks.append(block)
    return np.concatenate(frames), blocks


def opened(path, **options):
    """Open frames as a press."""
    return open_recording(path, **({"motion": "vertical", "travel": Steps(0.1)} | options))


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
    source: Source = opened(tmp_path, pixel_size=(0.03, 0.03))
    frames, _ = drain(source)
    assert (source.shape, source.dtype, source.motion) == ((4, *SHAPE), dtype, "vertical")
    assert (source.name, source.header.pixel_size, source.rewindable) == (str(tmp_path), (0.03, 0.03), True)
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
    frames, _ = drain(opened(tmp_path))
    np.testing.assert_array_equal(frames, [frame(k) for k in range(3)])


def test_what_does_not_fit_the_pattern_is_left_out_and_named(tmp_path):
    save(tmp_path, ["image0.png", "image1.png", "image_ambient.png", "._image0.png", "dark7.png"])
    (tmp_path / "image3.txt").write_text("not a picture")
    (tmp_path / "image4.png").mkdir()
    source = opened(tmp_path)
    assert source.shape[0] == 2
    assert source.left_out == ("._image0.png", "dark7.png", "image3.txt", "image_ambient.png")


@pytest.mark.parametrize("size", [None, 3, 8])
def test_blocks_of_any_size_give_the_same_frames(tmp_path, size):
    save(tmp_path, [f"image{k}.png" for k in range(5)])
    travel = 0.1 * np.arange(1, 6)
    source = opened(tmp_path, travel=travel)
    frames, blocks = drain(source, size)
    np.testing.assert_array_equal(frames, [frame(k) for k in range(5)])
    np.testing.assert_array_equal(np.concatenate([b.travel for b in blocks]), travel)
    assert [b.index for b in blocks] == list(range(0, 5, size or 1))
    assert {b.time for b in blocks} == {None}
    assert {b.dropped for b in blocks} == {0}


def test_a_block_ends_at_a_gap_and_the_next_counts_lost_frames(tmp_path):
    save(tmp_path, ["image5.png", "image6.png", "image9.png", "image10.png", "image12.png"])
    source = opened(tmp_path, travel=Steps(0.5, 1.0))
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
        ([], "without numbered pictures"),
        (["ambient.png"], "without numbered pictures"),
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
        opened(tmp_path)
    assert str(tmp_path) in str(caught.value)


@pytest.mark.parametrize(
    ("odd", "kind"),
    [(np.zeros((9, 6), np.uint8), "6 x 9 uint8"), (np.zeros(SHAPE, np.uint16), "9 x 6 uint16")],
)
def test_a_frame_unlike_the_first_is_named(tmp_path, odd, kind):
    save(tmp_path, ["image0.png", "image1.png"])
    cv2.imwrite(str(tmp_path / "image2.png"), odd)
    source = opened(tmp_path)
    with pytest.raises(InputError, match=rf"image2\.png is {kind}, but the first frame is 9 x 6 uint8"):
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
        drain(opened(tmp_path))


@pytest.mark.parametrize("dtype", [np.int8, np.int16, np.int32, np.float64])
def test_other_types_of_sample_are_refused(tmp_path, dtype):
    cv2.imwrite(str(tmp_path / "image0.tif"), np.zeros(SHAPE, dtype))
    with pytest.raises(InputError, match=rf"image0\.tif \(page 1\) has 1 {np.dtype(dtype)} a pixel"):
        opened(tmp_path)


@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize(("suffix", "dtype"), [("png", np.uint8), ("png", np.uint16), ("tif", np.float32)])
def test_colour_with_equal_channels_is_taken_exactly(tmp_path, suffix, dtype, channels):
    picture = np.repeat(frame(1, dtype)[..., np.newaxis], channels, axis=2)
    picture[..., 3:] = 7
    cv2.imwrite(str(tmp_path / f"image0.{suffix}"), picture, [cv2.IMWRITE_TIFF_COMPRESSION, 1])
    np.testing.assert_array_equal(read_picture(tmp_path / f"image0.{suffix}"), frame(1, dtype))


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.uint8, 0.51), (np.uint16, 1.5)])
def test_true_colour_becomes_luma(tmp_path, dtype, tolerance):
    blue, green, red = (frame(k, dtype) for k in (1, 5, 9))
    cv2.imwrite(str(tmp_path / "image0.png"), np.dstack([blue, green, red]))
    luma = 0.299 * red.astype(float) + 0.587 * green + 0.114 * blue
    np.testing.assert_allclose(read_picture(tmp_path / "image0.png"), luma, atol=tolerance)


@pytest.mark.parametrize(
    "numbers",
    [
        range(0, 1320, 33),  # milliseconds at 30 Hz
        range(100, 140),
        [f"z{position / 100:.2f}" for position in range(0, 200, 5)],
    ],
    ids=["times", "numbers", "positions"],
)
def test_numbers_with_a_common_step_are_consecutive_frames(tmp_path, numbers):
    save(tmp_path, [f"frame_{number}.png" for number in numbers])
    with opened(tmp_path, travel=Steps(0.05)) as source:
        frames, blocks = drain(source, 64)
    np.testing.assert_array_equal(frames, [frame(k) for k in range(40)])
    np.testing.assert_allclose(np.concatenate([b.travel for b in blocks]), 0.05 * np.arange(40))
    assert not source.dropped.any()
    assert [finding for finding in source.findings if finding.warning] == []


def test_a_common_step_is_reported(tmp_path):
    save(tmp_path, [f"frame_{33 * k:06d}.png" for k in range(5)])
    with opened(tmp_path) as source:
        (actual,) = source.findings
    assert (actual.kind, actual.warning) == ("numbering", False)
    assert "the names step by 33" in actual.text


def test_a_gap_in_numbers_with_a_common_step_counts_in_steps(tmp_path):
    save(tmp_path, [f"frame_{number}.png" for number in (0, 10, 20, 40, 50)])
    with opened(tmp_path) as source:
        assert source.dropped.tolist() == [0, 0, 0, 1, 0]


def test_numbers_that_are_mostly_missing_give_the_order_and_a_warning(tmp_path):
    save(tmp_path, [f"frame_{number}.png" for number in (7, 40, 73, 107, 140)])
    with opened(tmp_path) as source:
        (actual,) = source.findings
        assert source.travel.tolist() == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])
    assert (actual.kind, actual.warning) == ("numbering", True)


def test_missing_numbers_are_reported_as_lost_frames(tmp_path):
    save(tmp_path, [f"frame_{number}.png" for number in (1, 2, 3, 5, 8)])
    with opened(tmp_path) as source:
        (actual,) = source.findings
    assert (actual.kind, actual.warning) == ("lost frames", True)
    assert "3 frames are missing, before frames 3, 4" in actual.text


def pgm(path, picture):
    depth = np.iinfo(picture.dtype).max
    head = b"P5\n# a camera\n%d %d\n%d\n" % (*picture.shape[::-1], depth)
    path.write_bytes(head + picture.astype(picture.dtype.newbyteorder(">")).tobytes())


def test_bmp_and_pgm_are_read_exactly(tmp_path):
    cv2.imwrite(str(tmp_path / "frame1.bmp"), frame(1))
    pgm(tmp_path / "frame2.pgm", frame(2))
    with opened(tmp_path) as source:
        np.testing.assert_array_equal(drain(source)[0], [frame(1), frame(2)])


def test_a_deep_pgm_is_read_exactly(tmp_path):
    pgm(tmp_path / "a.pgm", frame(3, np.uint16))
    np.testing.assert_array_equal(read_picture(tmp_path / "a.pgm"), frame(3, np.uint16))


def smooth(number):
    return (np.add.outer(2 * np.arange(32), 3 * np.arange(40)) + number).astype(np.uint8)


def test_jpeg_is_read_with_a_warning(tmp_path):
    for number in range(10):
        cv2.imwrite(str(tmp_path / f"frame{number}.jpg"), smooth(number), [cv2.IMWRITE_JPEG_QUALITY, 95])
    with opened(tmp_path) as source:
        frames, _ = drain(source)
        (actual,) = source.findings
    assert np.abs(frames - np.stack([smooth(k) for k in range(10)]).astype(int)).max() <= 6
    assert (actual.kind, actual.warning) == ("lossy compression", True)


def test_a_loss_is_reported_wherever_it_is(tmp_path):
    cv2.imwrite(str(tmp_path / "frame1.png"), smooth(0))
    cv2.imwrite(str(tmp_path / "frame2.jpg"), smooth(0))
    with opened(tmp_path) as source:
        assert [finding.kind for finding in source.findings] == ["lossy compression"]


def test_a_jpeg_is_turned_as_it_states(tmp_path):
    _, data = cv2.imencode(".jpg", smooth(0), [cv2.IMWRITE_JPEG_QUALITY, 100])
    tag = struct.pack(">HHIHH", 0x0112, 3, 1, 6, 0)  # orientation: turned clockwise
    exif = b"Exif\0\0MM\0*" + struct.pack(">IH", 8, 1) + tag + bytes(4)
    body = data.tobytes()
    segment = b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif
    (tmp_path / "a.jpg").write_bytes(body[:2] + segment + body[2:])
    np.testing.assert_allclose(read_picture(tmp_path / "a.jpg"), np.rot90(smooth(0), -1), atol=4)


@pytest.mark.parametrize("suffix", ["jpg", "bmp", "pgm"])
def test_a_picture_that_is_cut_off_is_named(tmp_path, suffix):
    for number in range(2):
        if suffix == "pgm":
            pgm(tmp_path / f"frame{number}.pgm", frame(number))
        else:
            cv2.imwrite(str(tmp_path / f"frame{number}.{suffix}"), frame(number))
    file = tmp_path / f"frame1.{suffix}"
    file.write_bytes(file.read_bytes()[:-9])
    with opened(tmp_path) as source, pytest.raises(InputError, match=rf"frame1\.{suffix} is .*cut off"):
        drain(source)


def test_colour_is_reported_once(tmp_path):
    for number in range(3):
        picture = np.dstack([frame(number), frame(number + 1), frame(number + 2)])
        cv2.imwrite(str(tmp_path / f"frame{number}.png"), picture)
    with opened(tmp_path) as source:
        (actual,) = source.findings
    assert (actual.kind, actual.warning) == ("colour", False)


@pytest.mark.parametrize(("channel", "number"), [(0, 9), (1, 5), (2, 1)])
def test_a_channel_is_one_of_the_colours(tmp_path, channel, number):
    for name in ("frame1.png", "frame2.png"):
        cv2.imwrite(str(tmp_path / name), np.dstack([frame(1), frame(5), frame(9)]))
    with opened(tmp_path, channel=channel) as source:
        np.testing.assert_array_equal(drain(source)[0], [frame(number)] * 2)
        assert source.findings == ()


def test_a_channel_of_grey_pictures_is_refused(tmp_path):
    save(tmp_path, ["frame1.png", "frame2.png"])
    with pytest.raises(InputError, match="no channel 1: it is grey: leave --channel out"):
        opened(tmp_path, channel=1)


INDICES = np.arange(54, dtype=np.uint8).reshape(SHAPE) % 16


def with_table(path, table):
    """Save indices with a table of 16 colours."""
    picture = Image.fromarray(INDICES)
    picture.putpalette(np.asarray(table, np.uint8).tobytes())
    picture.save(path)
    return path


@pytest.mark.parametrize("suffix", ["png", "bmp", "tif"])
@pytest.mark.parametrize(
    ("table", "expected"),
    [
        ([(0, 12 * k, 0) for k in range(16)], INDICES),
        ([(240 - 7 * k,) * 3 for k in range(16)], 240 - 7 * INDICES),
    ],
    ids=["green", "grey"],
)
def test_a_table_of_colours_gives_indices_or_its_greys(tmp_path, suffix, table, expected):
    picture = decode_picture(with_table(tmp_path / f"a.{suffix}", table))
    np.testing.assert_array_equal(picture.samples, expected)
    assert [finding.kind for finding in picture.findings] == (["colour table"] if expected is INDICES else [])


@pytest.mark.parametrize("suffix", ["png", "bmp", "tif"])
def test_a_table_that_is_not_a_scale_of_brightness_is_refused(tmp_path, suffix):
    table = [((97 * k) % 256, 0, (31 * k) % 256) for k in range(16)]
    with pytest.raises(InputError, match="not a scale of brightness: save it in grey"):
        read_picture(with_table(tmp_path / f"a.{suffix}", table))


@pytest.mark.parametrize("bits", [1, 4])
def test_a_bmp_of_few_bits_gives_its_greys(tmp_path, bits):
    count, head = 1 << bits, 54 + 4 * (1 << bits)
    greys = (255 // (count - 1) * np.arange(count)).astype(np.uint8)
    indices = INDICES[:, :8] % count
    rows = np.packbits(
        np.unpackbits(indices[..., None], axis=2)[..., 8 - bits :].reshape(len(indices), -1), axis=1
    )
    data = np.pad(rows, ((0, 0), (0, -rows.shape[1] % 4)))[::-1].tobytes()
    start = struct.pack(
        "<2sIIIIiiHHIIIIII", b"BM", head + len(data), 0, head, 40, 8, 6, 1, bits, 0, 0, 0, 0, 0, 0
    )
    table = np.column_stack([greys, greys, greys, 0 * greys]).tobytes()
    (tmp_path / "a.bmp").write_bytes(start + table + data)
    np.testing.assert_array_equal(read_picture(tmp_path / "a.bmp"), greys[indices])


def test_a_picture_of_one_bit_is_black_and_white(tmp_path):
    Image.fromarray(INDICES > 7).save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_picture(tmp_path / "a.png"), np.where(INDICES > 7, 255, 0))


def test_twelve_bits_in_sixteen_stay_as_they_are(tmp_path):
    counts = (frame(1, np.uint16) % 4096).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "a.png"), counts)
    np.testing.assert_array_equal(read_picture(tmp_path / "a.png"), counts)


def test_opacity_is_ignored(tmp_path):
    Image.merge("LA", [Image.fromarray(frame(1)), Image.fromarray(frame(7))]).save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_picture(tmp_path / "a.png"), frame(1))


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
from mirrorskin.io import InputError, Steps, open_recording
assert "cv2" not in sys.modules
for path in sys.argv[1:]:
    try:
        source = open_recording(path, motion="vertical", travel=Steps(0.1))
        while source.read() is not None:
            print("read")
    except InputError:
        print("refused")
"""
    arguments = [sys.executable, "-c", program, tmp_path, tmp_path / "stack.tif"]
    ended = subprocess.run(arguments, capture_output=True, text=True, check=True)
    assert ended.stdout.split() == ["read", "refused", "refused"]
    assert ended.stderr == ""


def test_a_jpeg_without_loss_has_no_finding(tmp_path):
    """A JPEG with a predictor, from FFmpeg's encoder."""
    av = pytest.importorskip("av")
    frames = np.random.default_rng(0).integers(0, 256, (3, 8, 12), np.uint8)
    encoder = av.CodecContext.create("ljpeg", "w")
    encoder.width, encoder.height, encoder.pix_fmt, encoder.time_base = 12, 8, "yuvj444p", Fraction(1, 10)
    for number, frame in enumerate(frames):
        grey = av.VideoFrame.from_ndarray(frame, format="gray").reformat(format="yuvj444p")
        (tmp_path / f"{number}.jpg").write_bytes(bytes(encoder.encode(grey)[0]))
    with open_recording(tmp_path, motion="vertical", travel=Steps(0.1)) as source:
        assert not any(finding.kind == "lossy compression" for finding in source.findings)
