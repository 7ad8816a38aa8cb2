import os
import struct
import subprocess
import sys

import cv2
import numpy as np
import pytest

from mirrorskin.io import Header, InputError, Source
from mirrorskin.io.frames import Video, _times, open_frames

HEADER = Header("axial", tilt=0.04)
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


@pytest.fixture(params=CODECS)
def video(request, tmp_path):
    return encode(tmp_path / request.param, CODECS[request.param][0])


@pytest.fixture
def exact(tmp_path):
    return encode(tmp_path / "exact.avi", "FFV1")


def test_frames_are_counted_aloud(exact):
    counted = []
    open_frames(exact, HEADER, phase=np.arange(COUNT), progress=counted.append)
    assert counted == list(range(1, COUNT + 1))


def drain(source, size=None):
    """Read to the end, ``size`` frames at a time; return copies of the frames, and the blocks."""
    room = None if size is None else np.empty((size, *source.shape[1:]), source.dtype)
    frames, blocks = [], []
    while (block := source.read(room)) is not None:
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
    source: Source = Video(video, HEADER)
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
        pictures=[np.dstack([blue, green, red])],
    )
    luma = 0.299 * red.astype(float) + 0.587 * green + 0.114 * blue
    np.testing.assert_allclose(Video(video, HEADER).read().frames[0], luma, atol=0.51)


@pytest.mark.parametrize("size", [None, 3, COUNT + 2])
def test_blocks_of_any_size_give_the_same_frames(video, size):
    whole, _ = drain(Video(video, HEADER), COUNT)
    phase = np.linspace(0, 6, COUNT)
    source = Video(video, HEADER, phase=phase, travel=phase + 1)
    frames, blocks = drain(source, size)
    np.testing.assert_array_equal(frames, whole)
    np.testing.assert_array_equal(np.concatenate([b.phase for b in blocks]), phase)
    np.testing.assert_array_equal(np.concatenate([b.travel for b in blocks]), phase + 1)
    np.testing.assert_allclose(np.concatenate([b.time for b in blocks]), np.arange(COUNT) / RATE, atol=1e-9)
    assert [b.index for b in blocks] == list(range(0, COUNT, size or 1))
    assert {b.dropped for b in blocks} == {0}


def test_a_video_can_be_rewound_anywhere(video):
    with Video(video, HEADER) as source:
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
    source = Video(exact, HEADER)
    assert source.shape[0] == COUNT
    assert len(drain(source)[0]) == COUNT


def test_frames_that_are_declared_but_missing_are_damage(exact):
    declare(exact, COUNT + 3)
    with pytest.raises(InputError, match=rf"{exact} should have {COUNT + 3} frames, but {COUNT}"):
        Video(exact, HEADER)


@pytest.mark.parametrize("kept", [0.02, 0.6])
def test_a_video_that_is_cut_off_is_refused(video, kept):
    data = video.read_bytes()
    video.write_bytes(data[: int(len(data) * kept)])
    with pytest.raises(InputError, match=str(video)):
        Video(video, HEADER)


@pytest.mark.parametrize("content", [b"", b"hello", bytes(4096)])
def test_what_is_no_video_is_refused(tmp_path, content):
    file = tmp_path / "notes.avi"
    file.write_bytes(content)
    with pytest.raises(InputError, match=rf"{file} cannot be opened as a video"):
        Video(file, HEADER)


def test_a_rotation_that_the_file_asks_for_is_applied(tmp_path):
    video = encode(tmp_path / "stack.mp4", "mp4v")
    upright, _ = drain(Video(video, HEADER))
    one = 1 << 16
    quarter_turn = (0, one, 0, -one, 0, 0, SHAPE[0] * one, 0, 1 << 30)
    patch(video, b"tkhd", 40, ">9i", *quarter_turn)
    source = Video(video, HEADER)
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
    np.testing.assert_allclose(_times(np.array(stamps), rate), expected, atol=1e-12)


def test_decoders_print_nothing_and_the_environment_stays(video):
    cut = video.with_stem("cut")
    data = video.read_bytes()
    cut.write_bytes(data[: len(data) * 2 // 3])
    program = """
import os, sys
from mirrorskin.io import Header, InputError
from mirrorskin.io.frames import Video
for path in sys.argv[1:]:
    try:
        with Video(path, Header("axial")) as source:
            while source.read() is not None:
                pass
        print("read")
    except InputError:
        print("refused")
assert not [name for name in os.environ if name.startswith("OPENCV_FFMPEG")]
"""
    arguments = [sys.executable, "-c", program, video, cut, __file__]
    # The camera's part sets some for the process that it runs in, which may be this one.
    clean = {name: value for name, value in os.environ.items() if not name.startswith("OPENCV_FFMPEG")}
    done = subprocess.run(arguments, capture_output=True, text=True, check=True, env=clean)
    assert done.stdout.split() == ["read", "refused", "refused"]
    assert done.stderr == ""


@pytest.mark.parametrize(
    "text",
    [
        "ffconcat version 1.0\nfile other.avi\n",
        "#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:1,\nother.avi\n#EXT-X-ENDLIST\n",
        "v=0\no=- 0 0 IN IP4 127.0.0.1\ns=a\nc=IN IP4 127.0.0.1\nt=0 0\nm=video 9 RTP/AVP 26\n",
    ],
    ids=["concatenation", "playlist", "session"],
)
@pytest.mark.parametrize("name", ["list.avi", "list.mp4", "list.m3u8"])
def test_a_list_that_names_other_files_or_addresses_is_not_followed(tmp_path, name, text):
    encode(tmp_path / "other.avi", "MJPG")
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match="cannot be opened as a video"):
        open_frames(tmp_path / name, HEADER, phase=np.arange(COUNT))


def test_frames_that_take_gigabytes_are_refused(tmp_path, monkeypatch):
    encode(tmp_path / "a.avi", "MJPG")
    monkeypatch.setattr("mirrorskin.io.os_errors.check_unpacked.__defaults__", (3 * SHAPE[0] * SHAPE[1] - 1,))
    with pytest.raises(InputError, match="a frame takes 9216 bytes of memory"):
        open_frames(tmp_path / "a.avi", HEADER, phase=np.arange(COUNT))
