"""Bags of ROS as their own tools write them, and files whose content is not what their name says."""

import gzip
import io
import shutil

import cv2
import h5py
import numpy as np
import pytest
import tifffile
import zarr
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore

from mirrorskin.io import InputError, Steps, describe, open_recording

FRAMES = np.random.default_rng(0).integers(0, 256, (6, 5, 7), np.uint8)
IMAGE, HEAD, STAMP = "sensor_msgs/msg/Image", "std_msgs/msg/Header", "builtin_interfaces/msg/Time"
ROS2 = get_typestore(Stores.ROS2_HUMBLE)


def image(types, frame, seconds, **head):
    stamp = types.types[STAMP](sec=seconds, nanosec=0)
    header = types.types[HEAD](stamp=stamp, frame_id="camera", **head)
    rows, columns = frame.shape
    fields = {"height": rows, "width": columns, "encoding": "mono8", "is_bigendian": 0, "step": columns}
    return types.types[IMAGE](header=header, **fields, data=frame.reshape(-1))


def write_bag(folder, mode=None, storage=StoragePlugin.MCAP, frames=FRAMES, first=100):
    """Write a bag of ROS 2 with the package rosbags."""
    writer = Ros2Writer(folder, version=8, storage_plugin=storage)
    if mode is not None:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        topic = writer.add_connection("/camera/image", IMAGE, typestore=ROS2)
        for number, frame in enumerate(frames):
            message = ROS2.serialize_cdr(image(ROS2, frame, first + number), IMAGE)
            writer.write(topic, (first + number) * 10**9, message)
    return folder


def write_bag_1(path):
    types = get_typestore(Stores.ROS1_NOETIC)
    with Ros1Writer(path) as writer:
        topic = writer.add_connection("/camera/image", IMAGE, typestore=types)
        for number, frame in enumerate(FRAMES):
            message = types.serialize_ros1(image(types, frame, number, seq=number), IMAGE)
            writer.write(topic, number * 10**9, message)
    return path


def split_bag(folder, *sizes):
    """Write a bag in several files, as `ros2 bag record --max-bag-size` does."""
    folder.mkdir()
    names, first = [], 0
    for number, size in enumerate(sizes):
        part = write_bag(folder / "part", frames=FRAMES[first : first + size], first=100 + first)
        names.append(f"{folder.name}_{number}.mcap")
        shutil.move(part / "part.mcap", folder / names[-1])
        shutil.rmtree(part)
        first += size
    listed = "".join(f"    - {name}\n" for name in names)
    text = f"rosbag2_bagfile_information:\n  version: 5\n  relative_file_paths:\n{listed}  message_count: 6\n"
    (folder / "metadata.yaml").write_text(text)
    return folder


def opened(path, **options):
    return open_recording(path, **{"motion": "vertical", "travel": Steps(0.1)} | options)


def frames_of(path, **options):
    with opened(path, **options) as source:
        return source.read(np.empty(source.shape, source.dtype)).frames, source


def refusal(path):
    with pytest.raises(InputError) as caught:
        opened(path)
    message = str(caught.value)
    assert "\n" not in message
    return message


@pytest.mark.parametrize("mode", [None, CompressionMode.STORAGE])
def test_the_folder_of_a_bag_is_read(tmp_path, mode):
    actual, source = frames_of(write_bag(tmp_path / "bag", mode))
    np.testing.assert_array_equal(actual, FRAMES)
    assert source.findings == ()
    assert source.time.tolist() == list(range(6))
    assert describe(tmp_path / "bag")["frames"] == "6 of 7 x 5, uint8"


@pytest.mark.parametrize("path", ["bag", "bag/bag.mcap"])
def test_messages_that_are_compressed_are_named_with_the_conversion(tmp_path, path):
    write_bag(tmp_path / "bag", CompressionMode.MESSAGE)
    message = refusal(tmp_path / path)
    assert "each message is compressed by Zstandard" in message
    assert f"rosbags-convert --src {tmp_path / 'bag'} --dst NEW --dst-storage mcap" in message
    assert "damaged" not in message


def test_a_bag_in_parts_is_joined(tmp_path):
    folder = split_bag(tmp_path / "bag", 3, 2, 1)
    with opened(folder) as source:
        for _ in range(2):
            actual = source.read(np.empty(source.shape, source.dtype)).frames
            np.testing.assert_array_equal(actual, FRAMES)
            source.rewind()
        assert source.time.tolist() == list(range(6))
        np.testing.assert_array_equal(source.frame(4), FRAMES[4])
        assert source.findings == ()
    np.testing.assert_array_equal(frames_of(folder, frames=(2, 5))[0], FRAMES[2:5])
    assert len(describe(folder)) > 2


def test_one_part_of_a_bag_is_warned_of(tmp_path):
    folder = split_bag(tmp_path / "bag", 3, 3)
    actual, source = frames_of(folder / "bag_1.mcap")
    np.testing.assert_array_equal(actual, FRAMES[3:])
    ((kind, warning, text),) = [(part.kind, part.warning, part.text) for part in source.findings]
    assert (kind, warning) == ("part", True)
    assert text.startswith(
        "bag_1.mcap is one of 2 parts, bag_0.mcap to bag_1.mcap, and only its frames are read"
    )
    (folder / "bag_0.mcap").unlink()
    assert "bag_0.mcap is missing, which the bag's metadata list" in refusal(folder)


def test_parts_of_other_sizes_are_not_joined(tmp_path):
    folder = split_bag(tmp_path / "bag", 3, 3)
    write_bag(tmp_path / "other", frames=FRAMES[:, :4])
    shutil.copy(tmp_path / "other" / "other.mcap", folder / "bag_1.mcap")
    assert "bag_1.mcap has frames of 7 x 4 uint8, but" in refusal(folder)


@pytest.mark.parametrize("inner", [False, True])
@pytest.mark.parametrize(
    ("options", "what", "remedy"),
    [
        ({"storage": StoragePlugin.SQLITE3}, "an SQLite database", "rosbags-convert --src {}/bag --dst NEW"),
        ({"mode": CompressionMode.FILE}, "compressed by Zstandard", "zstd -d {}/bag/bag.mcap.zstd"),
    ],
    ids=["SQLite", "compressed file"],
)
def test_bags_of_another_storage_are_named_with_the_conversion(tmp_path, options, what, remedy, inner):
    folder = write_bag(tmp_path / "bag", **options)
    files = [file for file in folder.iterdir() if file.name != "metadata.yaml"]
    message = refusal(files[0] if inner else folder)
    assert what in message
    assert remedy.format(tmp_path) in message


def test_a_bag_of_ros_1_is_named_with_the_conversion(tmp_path):
    path = write_bag_1(tmp_path / "a.bag")
    assert f"is a bag of ROS 1: convert it with 'rosbags-convert --src {path} --dst NEW" in refusal(path)


def test_messages_of_ros_1_in_mcap_are_named_with_the_conversion(tmp_path):
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        schema = writer.register_schema("sensor_msgs/Image", "ros1msg", b"uint8 x")
        channel = writer.register_channel("/camera", "ros1", schema)
        writer.add_message(channel, 0, b"\1", 0)
        writer.finish()
    assert "messages of the encoding ros1, and none of ROS 2 (cdr): convert a bag" in refusal(
        tmp_path / "a.mcap"
    )


def test_an_index_that_lists_more_messages_than_there_are_is_reported(tmp_path):
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        schema = writer.register_schema(IMAGE, "ros2msg", b"")
        channel = writer.register_channel("/camera", "cdr", schema)
        for number, frame in enumerate(FRAMES):
            writer.add_message(
                channel, number, bytes(ROS2.serialize_cdr(image(ROS2, frame, number), IMAGE)), number
            )
        writer._Writer__statistics.channel_message_counts[channel] += 4
        writer.finish()
    actual, source = frames_of(tmp_path / "a.mcap")
    np.testing.assert_array_equal(actual, FRAMES)
    assert [part.text for part in source.findings if part.warning] == [
        "its index lists 10 messages of /camera, and it contains 6: these are read"
    ]


def write_tiff(path):
    tifffile.imwrite(path, FRAMES, photometric="minisblack")


def write_hdf5(path):
    with h5py.File(path, "w") as file:
        file["x"] = FRAMES


def write_y4m(path):
    frames = b"".join(b"FRAME\n" + frame.tobytes() for frame in FRAMES)
    path.write_bytes(b"YUV4MPEG2 W7 H5 F10:1 Ip A1:1 Cmono\n" + frames)


def write_picture(suffix):
    return lambda path: path.write_bytes(cv2.imencode(suffix, FRAMES[0])[1].tobytes())


def write_numpy(save):
    def write(path):
        stream = io.BytesIO()
        save(stream, FRAMES)
        path.write_bytes(stream.getvalue())

    return write


CONTENT = {
    "a TIFF: name it a.tif": write_tiff,
    "an HDF5 file: name it a.h5": write_hdf5,
    "a YUV4MPEG2 video: name it a.y4m": write_y4m,
    "a PNG: name it a.png": write_picture(".png"),
    "a JPEG: name it a.jpg": write_picture(".jpg"),
    "an array of NumPy: name it a.npy": write_numpy(np.save),
    "a ZIP archive: unpack it; archives": write_numpy(np.savez),
    "a file compressed by gzip: unpack it": lambda path: path.write_bytes(gzip.compress(FRAMES.tobytes())),
}


@pytest.mark.parametrize("suffix", [".dat", ".tif", ".npy", ".mcap"])
@pytest.mark.parametrize("what", CONTENT)
def test_the_content_of_a_file_is_named_whatever_its_name_is(tmp_path, what, suffix):
    path = tmp_path / f"a{suffix}"
    CONTENT[what](path)
    if what.endswith(path.name) or (suffix, what[:7]) == (".dat", "an HDF5"):
        np.testing.assert_array_equal(frames_of(path)[0], FRAMES)
    else:
        assert what in refusal(path)


def test_a_video_is_opened_by_its_content(tmp_path):
    write_y4m(tmp_path / "a.avi")
    np.testing.assert_array_equal(frames_of(tmp_path / "a.avi")[0], FRAMES)
    write_tiff(tmp_path / "b.mp4")
    assert "b.mp4 cannot be opened as a video: it is a TIFF: name it b.tif" in refusal(tmp_path / "b.mp4")


def test_an_unknown_file_lists_the_formats(tmp_path):
    (tmp_path / "a.xyzzy").write_bytes(b"\7" * 1000)
    message = refusal(tmp_path / "a.xyzzy")
    for name in ("HDF5", "Zarr", "NPY", "TIFF", "MCAP", "AVI", "PNG"):
        assert name in message


def test_a_folder_without_pictures_names_the_stacks_in_it(tmp_path):
    write_tiff(tmp_path / "press.tif")
    (tmp_path / "notes.txt").write_text("notes")
    assert "without numbered pictures, but with press.tif: name the file" in refusal(tmp_path)


def test_pictures_next_to_a_metadata_file_are_frames(tmp_path):
    (tmp_path / "metadata.yaml").write_text("camera: a\n")
    for number, frame in enumerate(FRAMES):
        cv2.imwrite(str(tmp_path / f"{number}.png"), frame)
    np.testing.assert_array_equal(frames_of(tmp_path)[0], FRAMES)


def test_pictures_that_are_tiffs_by_their_content_are_read(tmp_path):
    for number, frame in enumerate(FRAMES):
        tifffile.imwrite(tmp_path / f"{number}.png", frame)
    np.testing.assert_array_equal(frames_of(tmp_path)[0], FRAMES)


def test_a_folder_of_zarr_needs_no_suffix(tmp_path):
    for version in (2, 3):
        path = tmp_path / f"press{version}"
        zarr.create_array(path, data=FRAMES, zarr_format=version)
        np.testing.assert_array_equal(frames_of(path)[0], FRAMES)


def test_a_video_of_yuv4mpeg_is_read(tmp_path):
    write_y4m(tmp_path / "a.y4m")
    actual, source = frames_of(tmp_path / "a.y4m")
    np.testing.assert_array_equal(actual, FRAMES)
    assert source.time.tolist() == pytest.approx([0.1 * number for number in range(6)])
