"""ROS 2 messages in MCAP files, read by the reader of their own packages and by mirrorskin."""

import struct
import tracemalloc
from contextlib import suppress
from dataclasses import replace

import cv2
import lz4.frame
import numpy as np
import pytest
import zstandard
from commands import run
from growing import Feed
from growing import frames_of as feed_of
from mcap.data_stream import RecordBuilder
from mcap.reader import make_reader
from mcap.records import Chunk, Footer
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer
from stacks import record, sphere

from mirrorskin import io
from mirrorskin.io.files.arrays import ArrayRecording

HEIGHT = np.array([[1.0, np.nan, 0.5], [0.25, 0.0, -1.0]], np.float32)
AXIS = {"x": np.array([-1.0, 0.0, 1.0]), "y": np.array([0.5, -0.5])}
FIELDS = {
    "sensor_msgs/msg/Image": "uint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\n"
    "uint32 step\nuint8[] data",
    "sensor_msgs/msg/CompressedImage": "string format\nuint8[] data",
}
HEAD = "=" * 80 + "\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id"
TIME = {"header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": "camera"}}


def messages(path):
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return [
            (decoded[1].topic, decoded[2].log_time, decoded[3]) for decoded in reader.iter_decoded_messages()
        ]


def write_sample(path):
    frames = np.arange(240, dtype=np.uint8).reshape(6, 5, 8)
    io.save_messages(ArrayRecording(frames, {"travel": np.arange(6.0)}, {}), path)


SAMPLES = {"a.mcap": write_sample}


def test_a_result_becomes_points_in_metres_with_their_sigma(tmp_path):
    normals = np.zeros((2, 3, 3), np.float32)
    normals[..., 2] = 1.0
    result = io.Result(
        height=HEIGHT,
        height_sigma=np.full_like(HEIGHT, 0.01),
        normals=normals,
        force=2.5,
        process={"date": "2026-11-23T12:00:00+00:00", "program": "mirrorskin"},
        **AXIS,
    )
    assert io.export_result(result, tmp_path / "a.mcap") == "5 points"
    actual = {topic: (time, message) for topic, time, message in messages(tmp_path / "a.mcap")}
    assert set(actual) == {"/surface", "/height", "/force"}
    time, cloud = actual["/surface"]
    assert time == 1795435200_000000000
    names = [field.name for field in cloud.fields]
    assert names == ["x", "y", "z", "sigma", "normal_x", "normal_y", "normal_z"]
    points = np.frombuffer(cloud.data, "<f4").reshape(-1, len(names))
    properties = [(x, y, HEIGHT[i, j]) for i, y in enumerate(AXIS["y"]) for j, x in enumerate(AXIS["x"])]
    expected = [point for point in properties if np.isfinite(point[2])]
    np.testing.assert_allclose(points[:, :3], np.array(expected) * 1e-3, rtol=1e-6)
    np.testing.assert_allclose(points[:, 3:], [[1e-5, 0, 0, 1]] * 5, rtol=1e-6)
    picture = actual["/height"][1]
    assert (picture.encoding, picture.height, picture.width) == ("32FC1", 2, 3)
    np.testing.assert_allclose(np.frombuffer(picture.data, "<f4").reshape(2, 3), HEIGHT * 1e-3, rtol=1e-6)
    assert actual["/force"][1].wrench.force.z == 2.5


def test_a_result_without_millimetres_is_refused(tmp_path):
    with pytest.raises(io.InputError, match="--pixel-size"):
        io.export_result(io.Result(height=HEIGHT), tmp_path / "a.mcap")
    assert not list(tmp_path.iterdir())


def test_a_recording_comes_back_through_the_command_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    record(sphere(), "rec.h5")
    assert run("export", "rec.h5", "-o", "rec.mcap").code == 0
    ended = run("import", "rec.mcap", "-o", "back.h5", "--motion", "vertical", "--pixel-size", "0.1mm")
    assert ended.code == 0, ended.said
    with io.open_recording("rec.h5") as before, io.open_recording("back.h5") as after:
        buffer = np.empty(before.shape, before.dtype)
        frames = before.read(buffer).frames.copy()
        np.testing.assert_array_equal(after.read(buffer).frames, frames)
        np.testing.assert_allclose(after.travel, before.travel, rtol=1e-12)


def test_an_exported_recording_needs_no_options(tmp_path):
    path = record(sphere(), tmp_path / "rec.h5")
    with io.open_recording(path) as before:
        io.save_messages(before, tmp_path / "rec.mcap")
        with io.open_recording(tmp_path / "rec.mcap") as after:
            assert after.motion == before.motion
            for name in ("title", "pixel_size", "camera"):
                assert getattr(after.header, name) == getattr(before.header, name)
            np.testing.assert_array_equal(after.header.dark, before.header.dark)
            np.testing.assert_array_equal(after.header.bright, before.header.bright)
            np.testing.assert_allclose(after.travel, before.travel, rtol=1e-12)


def test_numbers_of_an_exported_recording_come_back(tmp_path):
    options = {"travel_sigma": 0.002, "line_time": -1.5e-05, "pixel_size": (0.1, 0.2)}
    frames = np.zeros((3, 4, 5), np.uint8)
    source = ArrayRecording(frames, {"travel": np.arange(3.0)}, options)
    io.save_messages(source, tmp_path / "rec.mcap")
    with io.open_recording(tmp_path / "rec.mcap") as after:
        assert {name: getattr(after.header, name) for name in options} == options


def test_a_motion_that_contradicts_the_file_is_refused(tmp_path):
    with io.open_recording(record(sphere(), tmp_path / "rec.h5")) as recording:
        io.save_messages(recording, tmp_path / "rec.mcap")
    with pytest.raises(io.InputError, match=r"rec\.mcap states the motion vertical, but --motion is axial"):
        io.open_recording(tmp_path / "rec.mcap", motion="axial", phase=io.Steps(0.1))


@pytest.fixture
def film(tmp_path):
    """Write pictures as images of an encoding on topics, by the packages' own writer."""

    def write(*topics, encoding="mono8", kind="sensor_msgs/msg/Image"):
        path = tmp_path / "film.mcap"
        with path.open("wb") as file:
            writer = Writer(file)
            schema = writer.register_msgdef(kind, f"std_msgs/Header header\n{FIELDS[kind]}\n{HEAD}")
            for number in range(3):
                for topic, picture in topics:
                    picture = picture + picture.dtype.type(number)
                    data = {"format": "png", "data": cv2.imencode(".png", picture)[1].tobytes()}
                    if kind.endswith("/Image"):
                        size = {"height": len(picture), "width": picture.shape[1], "is_bigendian": 0}
                        data = size | {
                            "encoding": encoding,
                            "step": picture[0].nbytes,
                            "data": picture.tobytes(),
                        }
                    writer.write_message(topic, schema, TIME | data, number * 10_000_000)
            writer.finish()
        return path

    return write


def opened(path, **options):
    return io.open_recording(path, motion="vertical", travel=io.Steps(0.1), **options)


def frames_of(path, **options):
    with opened(path, **options) as source:
        assert source.shape[0] == 3
        return source.read(np.empty(source.shape, source.dtype))


def test_grey_colours_and_compressed_images_are_read(film):
    grey = np.arange(12, dtype=np.uint8).reshape(3, 4)
    block = frames_of(film(("/a", grey)))
    np.testing.assert_array_equal(block.frames[2], grey + 2)
    np.testing.assert_allclose(block.time, [0, 0.01, 0.02])
    deep = grey.astype(np.uint16) * 1000
    np.testing.assert_array_equal(frames_of(film(("/a", deep), encoding="mono16")).frames[0], deep)
    equal = np.repeat(grey[:, :, None], 3, axis=2)
    np.testing.assert_array_equal(frames_of(film(("/a", equal), encoding="rgb8")).frames[1], grey + 1)
    packed = film(("/a", deep), kind="sensor_msgs/msg/CompressedImage")
    np.testing.assert_array_equal(frames_of(packed).frames[0], deep)


def test_of_several_topics_one_is_named(film):
    left, other = np.zeros((2, 3), np.uint8), np.full((2, 3), 9, np.uint8)
    path = film(("/left", left), ("/right", other))
    with pytest.raises(io.InputError, match=r"topics of images are /left, /right: name one with --dataset"):
        frames_of(path)
    assert frames_of(path, dataset="/right").frames[0, 0, 0] == 9


def test_images_that_are_not_grey_values_are_refused(film):
    with pytest.raises(io.InputError, match="encoding 'bayer_rggb8'"):
        frames_of(film(("/a", np.zeros((2, 4), np.uint8)), encoding="bayer_rggb8"))


def test_frames_and_maps_are_written_while_they_come(tmp_path):
    height = np.full((5, 7), 2.0, np.float32)
    with io.StreamRecorder(Feed(6, (2,)), tmp_path / "a.mcap") as recorder:
        while recorder.read() is not None:
            recorder.add_maps(float(recorder.count - 1), height, 3.0)
    actual = messages(tmp_path / "a.mcap")
    begun = actual[0][1]
    pictures = [
        np.frombuffer(message.data, np.uint8) for topic, _, message in actual if topic == "/camera/image"
    ]
    np.testing.assert_array_equal(np.reshape(pictures, (6, 5, 7)), feed_of(np.arange(6)))
    travel = [message.data for topic, _, message in actual if topic == "/travel"]
    np.testing.assert_allclose(travel, (0.01 * np.arange(6) + 0.001) * 1e-3)  # those of the end
    heights = [(time - begun, message) for topic, time, message in actual if topic == "/height"]
    assert [time for time, _ in heights] == [1_000_000_000, 3_000_000_000, 5_000_000_000]
    np.testing.assert_array_equal(np.frombuffer(heights[0][1].data, "<f4"), np.float32(2e-3))
    assert [message.data for topic, _, message in actual if topic == "/contact_area"] == [3e-6] * 3


def test_frames_that_came_before_a_fault_are_kept(tmp_path):
    feed = Feed(6, fails=(4, OSError("unplugged")))
    with suppress(OSError), io.StreamRecorder(feed, tmp_path / "a.mcap") as recorder:
        while recorder.read() is not None:
            pass
    assert sum(topic == "/camera/image" for topic, _, _ in messages(tmp_path / "a.mcap")) == 4
    with (tmp_path / "a.mcap").open("rb") as file:
        notes = [note.metadata for note in make_reader(file).iter_metadata()]
    assert notes[-1] == {"state": "cut short: unplugged"}


def test_a_calibration_has_no_place_in_it(tmp_path):
    with pytest.raises(io.InputError, match="an MCAP file cannot contain a calibration"):
        io.StreamRecorder(
            Feed(),
            tmp_path / "a.mcap",
            calibration=io.Calibration(io.CameraId("c", (5, 7), np.dtype(np.uint8))),
        )


def write_messages(path, topic, kind, values, **options):
    """Write messages with headers; each value is that of the fields without header."""
    with path.open("wb") as file:
        writer = Writer(file, **options)
        schema = writer.register_msgdef(kind, f"std_msgs/Header header\n{FIELDS[kind]}\n{HEAD}")
        for stamp, fields in values:
            writer.write_message(topic, schema, TIME | fields, stamp)
        writer.finish()
    return path


def grey(value, **changed):
    size = {"height": 2, "width": 3, "is_bigendian": 0, "step": 3, "encoding": "mono8"}
    return size | {"data": bytes([value]) * 6} | changed


IMAGE = "sensor_msgs/msg/Image"


def test_a_topic_without_messages_is_refused(tmp_path):
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        schema = writer.register_schema(IMAGE, "ros2msg", b"uint8 x")
        writer.register_channel("/camera", "cdr", schema)
        writer.finish()
    with pytest.raises(io.InputError, match=r"a\.mcap: /camera has no messages: name another topic"):
        frames_of(tmp_path / "a.mcap")


@pytest.mark.parametrize(
    "changed",
    [
        {"step": 0, "data": b"abcdefg"},
        {"step": 2, "data": b"abcdefg"},
        {"step": 1 << 31},
        {"height": 7},
        {"width": 1 << 31},
        {"height": 0, "width": 0, "step": 0, "data": b""},
        {"data": b"ab"},
        {"encoding": "rgb8"},
        {"encoding": ""},
    ],
)
def test_an_image_whose_fields_disagree_is_refused(tmp_path, changed):
    values = [(number, grey(number, **changed)) for number in range(3)]
    with pytest.raises(io.InputError) as refusal:
        frames_of(write_messages(tmp_path / "a.mcap", "/a", IMAGE, values))
    assert "\n" not in str(refusal.value)
    assert "a.mcap: /a, message 0" in str(refusal.value)


@pytest.mark.parametrize("step", [0, 2])
def test_a_step_that_is_too_small_follows_from_the_number_of_bytes(tmp_path, step):
    values = [(number, grey(0, step=step, data=bytes(range(number, number + 6)))) for number in range(3)]
    block = frames_of(write_messages(tmp_path / "a.mcap", "/a", IMAGE, values))
    assert block.frames[1].tolist() == [[1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize("data", [b"abc_def_", b"abc_def"])
def test_a_step_may_be_longer_than_a_row(tmp_path, data):
    values = [(number, grey(0, step=4, data=data)) for number in range(3)]
    block = frames_of(write_messages(tmp_path / "a.mcap", "/a", IMAGE, values))
    assert block.frames[0].tolist() == [[97, 98, 99], [100, 101, 102]]


def write_packed(path, images):
    """Write compressed images: the format of each, and its bytes."""
    values = [
        (number * 10_000_000, {"format": kind, "data": data}) for number, (kind, data) in enumerate(images)
    ]
    return write_messages(path, "/a", "sensor_msgs/msg/CompressedImage", values)


PICTURE = np.add.outer(2 * np.arange(24, dtype=np.uint8), np.arange(32, dtype=np.uint8))
PNG = cv2.imencode(".png", PICTURE)[1].tobytes()
JPEG = cv2.imencode(".jpg", PICTURE)[1].tobytes()


def test_a_compressed_image_without_bytes_is_named(tmp_path):
    path = write_packed(tmp_path / "a.mcap", [("png", PNG), ("png", b""), ("png", PNG)])
    with pytest.raises(io.InputError, match=r"a\.mcap: /a, message 1: the image has no pixels: remove it"):
        frames_of(path)


@pytest.mark.parametrize("kind", ["bayer_rggb8; png compressed", "bayer_rggb8; jpeg compressed bgr8"])
def test_a_compressed_mosaic_is_refused_like_one_that_is_not(tmp_path, kind):
    path = write_packed(tmp_path / "a.mcap", [(kind, PNG)] * 3)
    with pytest.raises(io.InputError, match="message 0: encoding 'bayer_rggb8' is not supported"):
        opened(path)


def test_a_loss_is_reported(tmp_path):
    with opened(write_packed(tmp_path / "a.mcap", [("mono8; jpeg compressed ", JPEG)] * 3)) as source:
        (actual,) = source.findings
    assert (actual.kind, actual.warning) == ("lossy compression", True)


def test_colours_are_reported_once_and_a_channel_is_one_of_them(film):
    colours = np.arange(18, dtype=np.uint8).reshape(2, 3, 3)
    path = film(("/a", colours), encoding="rgb8")
    with opened(path) as source:
        assert [(finding.kind, finding.warning) for finding in source.findings] == [("colour", False)]
    for channel in range(3):
        np.testing.assert_array_equal(frames_of(path, channel=channel).frames[1], colours[..., channel] + 1)


def write_numbered(path, numbers):
    """Write images whose messages are numbered."""
    with path.open("wb") as file:
        writer = Writer(file)
        definition = f"std_msgs/Header header\n{FIELDS[IMAGE]}\n{HEAD}"
        schema = writer.register_msgdef(IMAGE, definition)
        for stamp, number in enumerate(numbers):
            writer.write_message("/a", schema, TIME | grey(stamp), stamp * 10_000_000, sequence=number)
        writer.finish()
    return path


def test_a_jump_of_the_sequence_numbers_is_lost_frames(tmp_path):
    with opened(write_numbered(tmp_path / "a.mcap", [3, 4, 7])) as source:
        assert source.dropped.tolist() == [0, 0, 2]
        assert source.travel.tolist() == pytest.approx([0.0, 0.1, 0.4])
        assert [finding.kind for finding in source.findings] == ["lost frames"]


@pytest.mark.parametrize("numbers", [[0, 0, 0], [9, 3, 4], [0, 100, 200]])
def test_sequence_numbers_that_do_not_count_images_are_ignored(tmp_path, numbers):
    with opened(write_numbered(tmp_path / "a.mcap", numbers)) as source:
        assert not source.dropped.any()
        assert source.findings == ()


def test_times_are_those_at_which_the_images_were_taken(tmp_path):
    values = []
    for number, logged in enumerate((5, 9, 10)):
        head = {"header": {"stamp": {"sec": 100 + number, "nanosec": 250}, "frame_id": "camera"}}
        values.append((logged * 10**7, grey(number) | head))
    with opened(write_messages(tmp_path / "a.mcap", "/a", IMAGE, values)) as source:
        np.testing.assert_allclose(source.time, [0, 1, 2])


def test_images_can_be_read_in_any_order(film):
    grey = np.arange(12, dtype=np.uint8).reshape(3, 4)
    with opened(film(("/a", grey)), frames=(0, 3), region=io.Region((1, 3), (1, 4))) as source:
        for number in (2, 0, 1, 1):
            np.testing.assert_array_equal(source.frame(number), (grey + number)[1:3, 1:4])


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("chunk_size", [50, 1 << 20])
def test_images_come_in_the_order_of_their_times(tmp_path, compression, chunk_size):
    values = [(stamp * 10**7, grey(stamp)) for stamp in (2, 0, 1)]
    options = {"compression": compression, "chunk_size": chunk_size}
    block = frames_of(write_messages(tmp_path / "a.mcap", "/a", IMAGE, values, **options))
    assert block.frames[:, 0, 0].tolist() == [0, 1, 2]
    np.testing.assert_allclose(block.time, [0, 0.01, 0.02])


def test_messages_are_decoded_as_ros_defines_them_and_not_as_the_file_does(tmp_path):
    path = write_messages(tmp_path / "a.mcap", "/a", IMAGE, [(number, grey(number)) for number in range(3)])
    with path.open("rb") as file:
        messages = list(make_reader(file).iter_messages())
    with path.open("wb") as file:
        writer = McapWriter(file, use_chunking=False)
        writer.start()
        schema = writer.register_schema(IMAGE, "ros2msg", b"uint8[<=1000000000] \x1b not a definition")
        channel = writer.register_channel("/a", "cdr", schema)
        for _, _, decoded in messages:
            writer.add_message(channel, decoded.log_time, decoded.data, decoded.publish_time)
        writer.finish()
    assert frames_of(path).frames[:, 0, 0].tolist() == [0, 1, 2]


def damaged_messages(path):
    """Write images of 1000 in one chunk, and change one sample of the second."""
    values = [(stamp * 10**7, grey(100 + stamp)) for stamp in range(3)]
    write_messages(path, "/a", IMAGE, values, compression=CompressionType.NONE)
    data = bytearray(path.read_bytes())
    data[data.index(bytes([101, 101, 101]))] = 7
    path.write_bytes(data)
    return path


def test_images_that_differ_from_what_was_recorded_are_refused(tmp_path):
    path = damaged_messages(tmp_path / "a.mcap")
    message = "the chunk that begins with message 0 of /a differs from what was recorded: .*--no-verify"
    with pytest.raises(io.InputError, match=message):
        frames_of(path)


def test_images_that_differ_are_used_without_verification(tmp_path):
    path = damaged_messages(tmp_path / "a.mcap")
    with opened(path, verify=False) as recording:
        assert [recording.frame(number)[0, 0] for number in range(3)] == [100, 7, 102]


def replace_chunk(path, compression, packed, size):
    """Replace the chunk of a file by another one, which states a size."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
        file.seek(0)
        whole = file.read()
    index = summary.chunk_indexes[0]
    record = RecordBuilder()
    Chunk(compression, packed, 9, 0, 0, size).write(record)
    body = record.end()
    moved = replace(index, chunk_start_offset=len(whole), chunk_length=len(body), compression=compression)
    tail = RecordBuilder()
    start = len(whole) + len(body)
    for item in (*summary.schemas.values(), *summary.channels.values(), moved):
        item.write(tail)
    Footer(summary_crc=0, summary_offset_start=0, summary_start=start).write(tail)
    path.write_bytes(whole + body + tail.end() + whole[:8])
    return path


def write_three(path):
    """Write three images to one chunk."""
    return write_messages(path, "/a", IMAGE, [(number, grey(number)) for number in range(3)])


def chunk_bomb(path, compression):
    """Write a chunk of 8 MB of zeros, which states a size of 100 bytes."""
    data = bytes(8 << 20)
    packed = lz4.frame.compress(data) if compression == "lz4" else zstandard.compress(data)
    return replace_chunk(write_three(path), compression, packed, 100)


def records_of(path):
    """Return the records of the messages of a file, which begin with a code and a size."""
    with path.open("rb") as file:
        actual = [(channel.id, result) for _, channel, result in make_reader(file).iter_messages()]
    return [
        struct.pack("<BQHIQQ", 5, 22 + len(result.data), channel, 0, result.log_time, 0) + result.data
        for channel, result in actual
    ]


def test_a_record_that_ends_beyond_its_chunk_is_refused(tmp_path):
    path = write_three(tmp_path / "a.mcap")
    records = b"".join(records_of(path))
    replace_chunk(path, "", records[:-1], len(records) - 1)
    with pytest.raises(io.InputError, match="a record is longer than its chunk"):
        frames_of(path)


def test_a_message_that_is_shorter_than_its_head_is_left_out(tmp_path):
    path = write_three(tmp_path / "a.mcap")
    first, *others = records_of(path)
    short = first[:1] + struct.pack("<Q", 2) + first[9:11]
    records = b"".join([first, short, *others])
    replace_chunk(path, "", records, len(records))
    assert frames_of(path).frames[:, 0, 0].tolist() == [0, 1, 2]


@pytest.mark.parametrize("compression", ["lz4", "zstd"])
def test_a_chunk_that_unpacks_to_more_than_it_states_is_refused(tmp_path, compression):
    path = chunk_bomb(tmp_path / "a.mcap", compression)
    tracemalloc.start()
    with pytest.raises(io.InputError, match="a chunk states 100 bytes and has another number"):
        frames_of(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 << 20


def test_a_chunk_that_states_gigabytes_is_refused(film, monkeypatch):
    monkeypatch.setattr("mirrorskin.io.base.system.check_unpacked.__defaults__", (100,))
    with pytest.raises(io.InputError, match=r"a chunk takes \d+ bytes of memory"):
        frames_of(film(("/a", np.zeros((20, 30), np.uint8))))
