import struct
import subprocess
import sys
from fractions import Fraction
from functools import partial

import av
import cv2
import numpy as np
import pytest

from mirrorskin.io import InputError, Region, Source, Steps, open_recording
from mirrorskin.io.formats.loss import loss_of
from mirrorskin.io.formats.video import times

SHAPE = (48, 64)
COUNT = 7
RATE = 25.0

# Named by file and codec: the largest error that the codec may make in a smooth picture.
CODECS = {"stack.avi": ("MJPG", 6), "stack.mp4": ("mp4v", 8), "exact.avi": ("FFV1", 0)}


def frame(number):
    """Return a smooth frame of all 256 counts that its number tells apart from all others."""
    ramp = np.add.outer(2 * np.arange(SHAPE[0]), 2.6 * np.arange(SHAPE[1]))
    return np.clip(ramp + 4 * number - 10, 0, 255).astype(np.uint8)


def encode(path, codec, count=COUNT, parameters=(), pictures=None):
    """Write a video; return its path."""
    code = cv2.VideoWriter_fourcc(*codec)
    settings = list(parameters) or [cv2.VIDEOWRITER_PROP_IS_COLOR, 0]
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, code, RATE, SHAPE[::-1], settings)
    assert writer.isOpened()
    for picture in pictures or map(frame, range(count)):
        writer.write(picture)
    writer.release()
    return path


SAMPLES = {name: partial(encode, codec=codec) for name, (codec, _) in CODECS.items()}


@pytest.fixture(params=CODECS)
def video(request, tmp_path):
    return encode(tmp_path / request.param, CODECS[request.param][0])


@pytest.fixture
def exact(tmp_path):
    return encode(tmp_path / "exact.avi", "FFV1")


def opened(path, **options):
    """Open frames as a rotation."""
    properties = {"motion": "axial", "phase": np.linspace(0, 6, COUNT), "tilt": 0.04}
    return open_recording(path, **(properties | options))


def film(path, codec, pixels, frames, stamps=None, kind="gray", **options):
    """Write frames (T, H, W) or (T, H, W, 3) of a kind as a video with a pixel format, by PyAV."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=int(RATE), options=options)
        stream.height, stream.width, stream.pix_fmt = *frames.shape[1:3], pixels
        for number, picture in enumerate(frames):
            picture_of_video = av.VideoFrame.from_ndarray(picture, kind)
            picture_of_video = (
                picture_of_video if kind == pixels else picture_of_video.reformat(format=pixels)
            )
            picture_of_video.pts, picture_of_video.time_base = (
                (stamps or range(len(frames)))[number],
                Fraction(1, int(RATE)),
            )
            container.mux(stream.encode(picture_of_video))
        container.mux(stream.encode(None))
    return path


GREY = np.stack([frame(number) for number in range(COUNT)])
DEEP = (GREY.astype(np.uint16) * 7 + 2019).astype(np.uint16)


def frames_of(path, **options):
    with opened(path, **options) as source:
        return source.read(np.empty(source.shape, source.dtype)).frames, source


def drain(source, size=None):
    """Read to the end, ``size`` frames at a time; return copies of the frames, and the blocks."""
    buffer = None if size is None else np.empty((size, *source.shape[1:]), source.dtype)
    frames, blocks = [], []
    while (block := source.read(buffer)) is not None:
        frames.append(block.frames.copy())
        blocks.append(block)
    return np.concatenate(frames), blocks


def patch(path, mark, offset, layout, *values):
    """Overwrite numbers that stand ``offset`` bytes behind the end of a mark in a container."""
    data = bytearray(path.read_bytes())
    struct.pack_into(layout, data, data.index(mark) + len(mark) + offset, *values)
    path.write_bytes(data)


def declare(avi, count):
    """Let the header of an AVI's stream say another number of frames."""
    patch(avi, b"strh", 36, "<I", count)


def test_frames_are_the_luma_of_the_video(video):
    source: Source = opened(video)
    frames, _ = drain(source)
    assert (source.shape, source.dtype, source.motion) == ((COUNT, *SHAPE), np.uint8, "axial")
    truth = np.stack([frame(k) for k in range(COUNT)]).astype(int)
    assert np.abs(frames - truth).max() <= CODECS[video.name][1]


def test_colour_becomes_luma(tmp_path):
    blue, green, red = frame(0), frame(20), frame(40)
    video = encode(
        tmp_path / "colour.avi",
        "FFV1",
        parameters=[cv2.VIDEOWRITER_PROP_IS_COLOR, 1],
        pictures=[np.dstack([blue, green, red])] * COUNT,
    )
    luma = 0.299 * red.astype(float) + 0.587 * green + 0.114 * blue
    np.testing.assert_allclose(opened(video).read().frames[0], luma, atol=0.51)


@pytest.mark.parametrize("size", [None, 3, COUNT + 2])
def test_blocks_of_any_size_give_the_same_frames(video, size):
    whole, _ = drain(opened(video), COUNT)
    phase = np.linspace(0, 6, COUNT)
    source = opened(video, phase=phase)
    frames, blocks = drain(source, size)
    np.testing.assert_array_equal(frames, whole)
    np.testing.assert_array_equal(np.concatenate([b.phase for b in blocks]), phase)
    np.testing.assert_allclose(np.concatenate([b.time for b in blocks]), np.arange(COUNT) / RATE, atol=1e-9)
    assert [b.index for b in blocks] == list(range(0, COUNT, size or 1))
    assert {b.dropped for b in blocks} == {0}


def test_a_video_can_be_rewound_anywhere(video):
    with opened(video) as source:
        source.read(np.empty((3, *SHAPE), np.uint8))
        source.rewind()
        first, blocks = drain(source, 2)
        assert source.read() is None
        source.rewind()
        again, _ = drain(source, 4)
    assert blocks[0].index == 0
    assert len(first) == COUNT
    np.testing.assert_array_equal(again, first)


@pytest.mark.parametrize("declared", [0, 3])
def test_frames_beyond_the_declared_number_count(exact, declared):
    declare(exact, declared)
    source = opened(exact)
    assert source.shape[0] == COUNT
    assert len(drain(source)[0]) == COUNT


def test_frames_that_are_declared_but_missing_are_damage(exact):
    declare(exact, COUNT + 3)
    with pytest.raises(InputError, match=rf"{exact} should have {COUNT + 3} frames, but {COUNT}"):
        opened(exact)


def test_a_rotation_that_the_file_asks_for_is_applied(tmp_path):
    video = encode(tmp_path / "stack.mp4", "mp4v")
    upright, _ = drain(opened(video))
    unit = 1 << 16
    quarter_turn = (0, unit, 0, -unit, 0, 0, SHAPE[0] * unit, 0, 1 << 30)
    patch(video, b"tkhd", 40, ">9i", *quarter_turn)
    source = opened(video)
    assert source.shape == (COUNT, *SHAPE[::-1])
    np.testing.assert_array_equal(drain(source)[0], np.rot90(upright, -1, axes=(1, 2)))


@pytest.mark.parametrize(
    ("stamps", "rate", "expected"),
    [
        ([0.0, 0.1, 0.4], 25.0, [0.0, 0.1, 0.4]),
        ([2.0, 2.1, 2.5], 25.0, [0.0, 0.1, 0.5]),
        ([0.0, 0.2, 0.1], 50.0, [0.0, 0.02, 0.04]),
        ([0.0, np.nan, 0.1], 50.0, [0.0, 0.02, 0.04]),
    ],
)
def test_times_are_the_files_where_they_increase_else_the_rates(stamps, rate, expected):
    np.testing.assert_allclose(times(np.array(stamps), rate), expected, atol=1e-12)


def test_uneven_time_stamps_are_the_times_of_the_frames(tmp_path):
    stamps = [0, 1, 2, 5, 6, 8, 9]
    actual, source = frames_of(film(tmp_path / "a.mkv", "ffv1", "gray", GREY, stamps))
    np.testing.assert_array_equal(actual, GREY)
    np.testing.assert_allclose(source.time, np.array(stamps) / RATE, atol=1e-9)


def test_a_jump_of_an_avi_s_time_stamps_is_lost_frames(tmp_path):
    stamps = [0, 1, 2, 7, 8, 9, 10]
    path = film(tmp_path / "a.avi", "mjpeg", "yuvj420p", GREY, stamps)
    with opened(path, phase=Steps(0.5)) as source:
        frames, blocks = drain(source, 5)
        assert len(frames) == COUNT
        assert source.dropped.tolist() == [0, 0, 0, 4, 0, 0, 0]
        assert [(block.index, block.dropped) for block in blocks] == [(0, 0), (3, 4)]
        np.testing.assert_allclose(source.phase, 0.5 * np.array(stamps))
        assert "lost frames" in [finding.kind for finding in source.findings]


def test_a_closed_video_is_not_opened_again(tmp_path):
    source = opened(film(tmp_path / "a.mkv", "ffv1", "gray", GREY))
    source.close()
    with pytest.raises(InputError, match="it is closed"):
        source.read()


@pytest.mark.parametrize(("ticks", "hidden"), [(10, 1), (2048, 4)])
@pytest.mark.parametrize("suffix", [".mp4", ".mov"])
def test_all_frames_are_read_whatever_an_edit_list_leaves_out(tmp_path, suffix, ticks, hidden):
    film(tmp_path / "a.mp4", "mpeg4", "yuv420p", GREY)
    with av.open(str(tmp_path / "a.mp4")) as read, av.open(str(tmp_path / f"b{suffix}"), "w") as written:
        stream = written.add_stream_from_template(read.streams.video[0])
        for packet in read.demux(video=0):
            if packet.dts is not None:
                packet.pts, packet.dts, packet.stream = packet.pts - ticks, packet.dts - ticks, stream
                written.mux(packet)
    actual, source = frames_of(tmp_path / f"b{suffix}")
    np.testing.assert_array_equal(actual, frames_of(tmp_path / "a.mp4")[0])
    np.testing.assert_allclose(source.time, np.arange(COUNT) / RATE, atol=1e-9)
    (finding,) = [finding for finding in source.findings if finding.kind == "edit list"]
    assert f"leaves out {hidden} of the 7 frames, which are read as well" in finding.text


def test_a_video_without_edit_list_has_none_reported(tmp_path):
    _, source = frames_of(film(tmp_path / "a.mp4", "mpeg4", "yuv420p", GREY))
    assert [finding.kind for finding in source.findings if finding.warning] == ["lossy compression"]


@pytest.mark.parametrize(
    ("codec", "pixels", "suffix"),
    [
        ("png", "gray16be", ".mov"),
        ("ffv1", "gray16le", ".mkv"),
        ("rawvideo", "gray16le", ".nut"),
        ("rawvideo", "gray16be", ".nut"),
    ],
)
def test_sixteen_bits_come_back_exactly(tmp_path, codec, pixels, suffix):
    path = film(tmp_path / f"a{suffix}", codec, pixels, DEEP, kind="gray16le")
    actual, source = frames_of(path)
    assert source.dtype == np.uint16
    np.testing.assert_array_equal(actual, DEEP)


@pytest.mark.parametrize("bits", [10, 12])
@pytest.mark.parametrize("pixels", ["gray{}le", "yuv420p{}le", "yuv444p{}le"])
def test_samples_of_more_than_eight_bits_are_those_stored(tmp_path, pixels, bits):
    counts = (GREY.astype(np.uint16) * (3 if bits == 10 else 13) + 64).astype(np.uint16)
    name = pixels.format(bits)
    stored = [av.VideoFrame.from_ndarray(count, f"gray{bits}le") for count in counts]
    if not name.startswith("gray"):  # its luma is stored in limited range
        stored = [item.reformat(format=name) for item in stored]
    expected = [np.frombuffer(item.planes[0], "<u2").reshape(SHAPE[0], -1)[:, : SHAPE[1]] for item in stored]
    actual, source = frames_of(film(tmp_path / "a.mkv", "ffv1", name, counts, kind=f"gray{bits}le"))
    assert source.dtype == np.uint16
    np.testing.assert_array_equal(actual, expected)


def test_deep_colours_become_deep_luma(tmp_path):
    colours = np.stack([DEEP, DEEP + 300, DEEP + 700], axis=-1).astype(np.uint16)
    path = film(tmp_path / "a.mov", "png", "rgb48be", colours, kind="rgb48le")
    actual, source = frames_of(path)
    np.testing.assert_allclose(actual, colours @ np.array([0.299, 0.587, 0.114]), atol=1.5)
    assert [(finding.kind, finding.warning) for finding in source.findings] == [("colour", False)]
    np.testing.assert_array_equal(frames_of(path, channel=1)[0], colours[..., 1])


def test_planar_rgb_of_ten_bits_keeps_its_bits(tmp_path):
    counts = (GREY.astype(np.uint16) * 4).astype(np.uint16)
    actual, _ = frames_of(
        film(tmp_path / "a.mkv", "ffv1", "gbrp10le", np.repeat(counts[..., None], 3, 3), kind="gbrp10le")
    )
    np.testing.assert_array_equal(actual, counts)


@pytest.mark.parametrize(
    ("codec", "pixels", "suffix"),
    [
        ("rawvideo", "gray", ".avi"),
        ("rawvideo", "bgr24", ".avi"),  # stored from the bottom up
        ("rawvideo", "yuyv422", ".mkv"),
        ("rawvideo", "nv12", ".mkv"),
        ("huffyuv", "rgb24", ".avi"),
        ("ffv1", "yuv444p", ".mkv"),
        ("png", "gray", ".mov"),
        ("png", "rgb24", ".mov"),
    ],
)
def test_formats_without_loss_give_the_grey_of_the_frames(tmp_path, codec, pixels, suffix):
    actual, source = frames_of(film(tmp_path / f"a{suffix}", codec, pixels, GREY))
    # Limited range has 220 of 256 levels.
    assert np.abs(actual.astype(int) - GREY).max() <= (1 if pixels[0] in "yn" else 0)
    assert source.dtype == np.uint8
    assert [finding for finding in source.findings if finding.warning] == []


@pytest.mark.parametrize(
    ("codec", "pixels", "options"),
    [("libx264", "gray", {"qp": "0"}), ("libx264", "yuv444p", {"qp": "0"}), ("ffv1", "gray", {})],
)
def test_no_loss_is_reported_where_there_is_none(tmp_path, codec, pixels, options):
    _, source = frames_of(film(tmp_path / "a.mkv", codec, pixels, GREY, **options))
    assert [finding for finding in source.findings if finding.warning] == []


PRESSED = np.clip(GREY, 20, 206)
PRESSED[:, 0, :2] = 13  # of noise
FULL, LIMITED = 2, 1  # AVCOL_RANGE_JPEG and AVCOL_RANGE_MPEG
STRETCHED = np.clip(np.rint((PRESSED - 16.0) * 255 / 219), 0, 255).astype(int)


def in_range(path, codec, pixels, frames, stated=None, **options):
    """Write luma as it is, in a format of luma, whatever range is stated."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=int(RATE), options=options)
        stream.height, stream.width, stream.pix_fmt = *frames.shape[1:], pixels
        if stated is not None:
            stream.codec_context.color_range = stated
        for number, luma in enumerate(frames):
            picture = av.VideoFrame(stream.width, stream.height, pixels)
            for plane, value in zip(picture.planes, (None, 128, 128), strict=False):
                samples = np.full((plane.height, plane.line_size), value or 0, np.uint8)
                if value is None:
                    samples[:, : plane.width] = luma
                plane.update(samples.tobytes())
            picture.pts, picture.time_base = number, Fraction(1, int(RATE))
            if stated is not None:
                picture.color_range = stated
            container.mux(stream.encode(picture))
        container.mux(stream.encode(None))
    return path


GREY_CODECS = {
    "x264": ("libx264", "gray", {"qp": "0"}),
    "x265": ("libx265", "gray", {"x265-params": "lossless=1:log-level=none"}),
    "ffv1": ("ffv1", "gray", {}),
    "x264 of colours": ("libx264", "yuv420p", {"qp": "0"}),
    "ffv1 of colours": ("ffv1", "yuv420p", {}),
}


@pytest.mark.parametrize("suffix", [".mkv", ".avi", ".mp4"])
@pytest.mark.parametrize(
    ("name", "stated", "expected", "noted"),
    [
        ("x264", None, PRESSED, True),
        ("x264", FULL, PRESSED, False),
        ("x264", LIMITED, STRETCHED, False),
        ("x265", LIMITED, STRETCHED, False),
        ("x265", FULL, PRESSED, False),
        ("ffv1", None, PRESSED, True),
        ("x264 of colours", None, STRETCHED, True),
        ("x264 of colours", LIMITED, STRETCHED, False),
        ("x264 of colours", FULL, PRESSED, False),
        ("ffv1 of colours", None, STRETCHED, True),
    ],
)
def test_the_range_of_luma_is_the_one_that_is_stated(tmp_path, name, stated, expected, noted, suffix):
    codec, pixels, options = GREY_CODECS[name]
    if suffix == ".avi" and codec == "libx265":
        pytest.skip("an AVI contains no HEVC")
    if suffix != ".mkv" and codec == "libx264" and stated == LIMITED:
        pytest.skip("x264 states the full range only, and other containers state none")
    options = dict(options)
    if codec == "libx265":
        options["x265-params"] += f":range={'full' if stated == FULL else 'limited'}"
    path = in_range(tmp_path / f"a{suffix}", codec, pixels, PRESSED, stated, **options)
    actual, source = frames_of(path)
    np.testing.assert_allclose(actual.astype(int), expected, atol=0.51)
    notes = [finding for finding in source.findings if finding.kind == "range of brightness"]
    assert [finding.warning for finding in notes] == [False] * noted


@pytest.mark.parametrize("stated", [None, LIMITED])
@pytest.mark.parametrize("end", [5, 250])
def test_samples_beyond_the_limited_range_contradict_it(tmp_path, stated, end):
    frames = PRESSED.copy()
    frames[:, 20:] = end
    path = in_range(tmp_path / "a.mkv", "libx264", "yuv420p", frames, stated, qp="0")
    actual, source = frames_of(path, memory_limit=1)
    np.testing.assert_array_equal(actual, frames)
    (note,) = [finding for finding in source.findings if finding.kind == "range of brightness"]
    assert "but samples are beyond 16 to 235: they are read as stored" in note.text
    assert note.warning is False


def test_frames_that_are_decoded_again_have_the_same_range(tmp_path):
    path = in_range(tmp_path / "a.mkv", "libx264", "yuv420p", PRESSED, LIMITED, qp="0")
    np.testing.assert_array_equal(frames_of(path, memory_limit=1)[0], frames_of(path)[0])


@pytest.mark.parametrize(
    ("codec", "pixels", "suffix"),
    [("mjpeg", "yuvj420p", ".avi"), ("mpeg4", "yuv420p", ".mp4"), ("libx264", "yuv420p", ".mp4")],
)
def test_a_loss_is_reported(tmp_path, codec, pixels, suffix):
    _, source = frames_of(film(tmp_path / f"a{suffix}", codec, pixels, GREY))
    kinds = [(finding.kind, finding.warning) for finding in source.findings if finding.warning]
    assert kinds == [("lossy compression", True)]


NO_LOSS = {"x265-params": "lossless=1:log-level=none"}
LOSS = {"x265-params": "log-level=none"}


@pytest.mark.parametrize(
    ("codec", "pixels", "options", "suffix", "reported"),
    [
        ("libx265", "gray", NO_LOSS, ".mkv", [False]),
        ("libx265", "gray", NO_LOSS, ".mp4", [False]),
        ("libx265", "gray", NO_LOSS, ".ts", [False]),
        ("libx265", "gray", LOSS, ".mkv", [True]),
        ("libx265", "gray", LOSS, ".ts", [True]),
        ("libx264", "gray", {"qp": "0"}, ".avi", []),
        ("libx264", "yuv444p", {"qp": "0"}, ".ts", []),
        ("libx264", "yuv444p", {}, ".mkv", [True]),  # of a profile that may be lossless
        ("jpeg2000", "gray", {"pred": "dwt53"}, ".mov", [False]),
        ("jpeg2000", "gray", {"pred": "dwt53"}, ".avi", [False]),
        ("jpeg2000", "gray", {"pred": "dwt97int"}, ".mov", [True]),
        ("ljpeg", "yuvj420p", {}, ".avi", []),
        ("jpegls", "gray", {}, ".avi", []),
        ("libvpx-vp9", "yuv420p", {"lossless": "1"}, ".webm", [False]),
        ("libvpx-vp9", "yuv444p", {"lossless": "1"}, ".mkv", [False]),
        ("libvpx-vp9", "yuv420p", {}, ".webm", [True]),
    ],
)
def test_a_loss_is_that_of_the_stream_and_not_of_its_codec(
    tmp_path, codec, pixels, options, suffix, reported
):
    path = film(tmp_path / f"a{suffix}", codec, pixels, GREY, **options)
    _, source = frames_of(path)
    findings = [finding for finding in source.findings if finding.kind == "lossy compression"]
    assert [finding.warning for finding in findings] == reported
    assert all(finding.warning or "may be compressed with a loss" in finding.text for finding in findings)


HEADS = (
    *(b"", b"\1", b"\0\0\1\x67\x64", b"\0\0\1\x44"),
    *(b"\xff\xd8\xff\xc3", b"\xff\x4f\xff\x51\xff\x52"),
)


@pytest.mark.parametrize("codec", ["h264", "hevc", "vp9", "jpeg2000", "mjpeg", "jpegls"])
def test_streams_that_cannot_be_understood_have_a_loss(codec):
    rng = np.random.default_rng(0)
    for length in (0, 1, 5, 40, 200):
        data = rng.integers(0, 256, length, np.uint8).tobytes()
        for head in HEADS:
            assert loss_of(codec, head + data, head + data) in (True, False, None)
    assert loss_of(codec, b"", b"") is True


def test_few_bits_are_reported(tmp_path):
    """FFmpeg writes 16 bits of grey into an AVI as if they were colours of 5 bits."""
    _, source = frames_of(film(tmp_path / "a.avi", "rawvideo", "gray16le", DEEP, kind="gray16le"))
    assert [finding.kind for finding in source.findings] == ["few bits", "colour"]


def test_pixels_that_are_not_square_are_reported(tmp_path):
    with av.open(str(tmp_path / "a.mp4"), "w") as container:
        stream = container.add_stream("mpeg4", rate=int(RATE))
        stream.height, stream.width, stream.pix_fmt = *SHAPE, "yuv420p"
        stream.codec_context.sample_aspect_ratio = Fraction(16, 15)
        for picture in GREY:
            picture_of_video = av.VideoFrame.from_ndarray(picture, "gray").reformat(format="yuv420p")
            container.mux(stream.encode(picture_of_video))
        container.mux(stream.encode(None))
    _, source = frames_of(tmp_path / "a.mp4")
    (actual,) = [finding for finding in source.findings if finding.kind == "pixel aspect"]
    assert "1.067 times as wide as high" in actual.text


def test_interlaced_frames_are_reported(tmp_path):
    path = film(tmp_path / "a.mkv", "mpeg2video", "yuv420p", GREY, flags="+ildct+ilme", field_order="tt")
    _, source = frames_of(path)
    assert "interlaced" in [finding.kind for finding in source.findings]


def test_a_palette_gives_its_greys(tmp_path):
    table = np.zeros((256, 4), np.uint8)
    table[:, 0], table[:, 1:] = 255, (255 - np.arange(256))[:, None]
    with av.open(str(tmp_path / "a.mov"), "w") as container:
        stream = container.add_stream("png", rate=int(RATE))
        stream.height, stream.width, stream.pix_fmt = *SHAPE, "pal8"
        for picture in GREY:
            container.mux(stream.encode(av.VideoFrame.from_ndarray((picture, table), "pal8")))
        container.mux(stream.encode(None))
    np.testing.assert_array_equal(frames_of(tmp_path / "a.mov")[0], 255 - GREY)


def test_a_format_that_is_not_brightness_is_refused(tmp_path):
    path = tmp_path / "a.nut"
    film(path, "rawvideo", "bayer_rggb8", GREY, kind="bayer_rggb8")
    with pytest.raises(InputError, match=r"pixel format bayer_rggb8, which is not supported: convert it"):
        opened(path)


def test_a_frame_that_cannot_be_decoded_is_named(tmp_path):
    path = film(tmp_path / "a.mov", "png", "gray", GREY)
    data = path.read_bytes()
    starts = [at for at in range(len(data)) if data[at : at + 4] == b"\x89PNG"]
    path.write_bytes(data[: starts[4]] + b"\0" * 8 + data[starts[4] + 8 :])
    with pytest.raises(InputError, match=r"a\.mov: frame 4 cannot be decoded .*copy it again"):
        opened(path)


def test_a_picture_that_changes_its_size_is_refused(tmp_path):
    path = tmp_path / "a.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mjpeg", rate=int(RATE))
        stream.height, stream.width, stream.pix_fmt = *SHAPE, "yuvj420p"
        for number, picture in enumerate([GREY[0], GREY[1], GREY[2, ::2, ::2]]):
            packet = av.Packet(cv2.imencode(".jpg", picture)[1].tobytes())
            packet.stream, packet.time_base, packet.is_keyframe = stream, Fraction(1, int(RATE)), True
            packet.pts = packet.dts = number
            container.mux(packet)
    with pytest.raises(InputError, match="the size of the picture changes at frame 2: cut it there"):
        opened(path)


def test_of_several_streams_one_is_chosen(tmp_path):
    path = tmp_path / "a.mkv"
    with av.open(str(path), "w") as container:
        streams = [container.add_stream("ffv1", rate=int(RATE)) for _ in range(2)]
        for stream in streams:
            stream.height, stream.width, stream.pix_fmt = *SHAPE, "gray"
        for number, picture in enumerate(GREY):
            for stream, shown in zip(streams, (picture, 255 - picture), strict=True):
                picture_of_video = av.VideoFrame.from_ndarray(shown, "gray")
                picture_of_video.pts = number
                container.mux(stream.encode(picture_of_video))
        for stream in streams:
            container.mux(stream.encode(None))
    with pytest.raises(InputError, match="2 streams of frames, numbered from 0: choose one with --dataset"):
        opened(path)
    np.testing.assert_array_equal(frames_of(path, dataset="1")[0], 255 - GREY)


@pytest.mark.parametrize("limit", [1, None])
def test_frames_are_the_same_whether_kept_or_decoded_again(tmp_path, limit):
    path = film(tmp_path / "a.mkv", "ffv1", "gray", GREY)
    part = {"region": Region((5, 20), (7, 40)), "frames": (2, 6)}
    with opened(path, memory_limit=limit, **part) as source:
        frames, _ = drain(source, 3)
        np.testing.assert_array_equal(source.frame(1), GREY[3, 5:20, 7:40])
    np.testing.assert_array_equal(frames, GREY[2:6, 5:20, 7:40])


def test_a_mirrored_video_is_shown_as_it_states(tmp_path):
    video = film(tmp_path / "a.mp4", "mpeg4", "yuv420p", GREY)
    upright, _ = frames_of(video)
    unit = 1 << 16
    patch(video, b"tkhd", 40, ">9i", -unit, 0, 0, 0, unit, 0, SHAPE[1] * unit, 0, 1 << 30)
    np.testing.assert_array_equal(frames_of(video)[0], upright[:, :, ::-1])


def test_without_its_package_the_extra_is_named(tmp_path, monkeypatch):
    path = film(tmp_path / "a.mkv", "ffv1", "gray", GREY)
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(InputError, match=r"a\.mkv: videos need mirrorskin\[video\]"):
        opened(path)


def test_decoders_print_nothing(video):
    truncated = video.with_stem("cut")
    data = video.read_bytes()
    truncated.write_bytes(data[: len(data) * 2 // 3])
    program = """
import sys
from mirrorskin.io import InputError, Steps, open_recording
for path in sys.argv[1:]:
    try:
        with open_recording(path, motion="axial", phase=Steps(1.0)) as source:
            while source.read() is not None:
                pass
        print("read")
    except InputError:
        print("refused")
"""
    text = video.with_name("text.avi")
    text.write_text("no video")
    arguments = [sys.executable, "-c", program, video, truncated, text]
    ended = subprocess.run(arguments, capture_output=True, text=True, check=True)
    assert ended.stdout.split() == ["read", "refused", "refused"]
    assert ended.stderr == ""


@pytest.mark.parametrize(
    "text",
    [
        "ffconcat version 1.0\nfile other.avi\n",
        "#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:1,\nother.avi\n#EXT-X-ENDLIST\n",
        "v=0\no=- 0 0 IN IP4 127.0.0.1\ns=a\nc=IN IP4 127.0.0.1\nt=0 0\nm=video 9 RTP/AVP 26\n",
    ],
    ids=["concatenation", "playlist", "session"],
)
@pytest.mark.parametrize("name", ["list.avi", "list.mp4", "list.mkv"])
def test_a_list_that_names_other_files_or_addresses_is_not_followed(tmp_path, name, text):
    encode(tmp_path / "other.avi", "MJPG")
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match="cannot be opened as a video"):
        opened(tmp_path / name)


def test_frames_that_take_gigabytes_are_refused(tmp_path, monkeypatch):
    encode(tmp_path / "a.avi", "MJPG")
    monkeypatch.setattr(
        "mirrorskin.io.base.system.check_unpacked.__defaults__", (3 * SHAPE[0] * SHAPE[1] - 1,)
    )
    with pytest.raises(InputError, match=r"a frame takes \d+ bytes of memory"):
        opened(tmp_path / "a.avi")
