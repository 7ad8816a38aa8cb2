"""Frames of every format: commands give the same result as with the same frames in an array."""

from __future__ import annotations

from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import tifffile
from commands import done, refused, run
from stacks import ball, read_all, record

from mirrorskin import io

TRAVEL = np.arange(1, 13) * 0.1
STEPS = ("--travel-step", "0.1mm", "--travel-start", "0.1mm")
SIZE = ("--pixel-size", "0.4mm")
LEVELS = ("--dark", 0, "--bright", 255)


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    path = record(ball((12, 16), (0.4, 0.4), TRAVEL), tmp_path_factory.mktemp("ball") / "ball.h5")
    with io.open_recording(path) as recording:
        return read_all(recording, 12).frames


def write_video(path, frames, stamps=None):
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=25)
        stream.height, stream.width, stream.pix_fmt = *frames.shape[1:], "gray"
        for number, picture in enumerate(frames):
            video_frame = av.VideoFrame.from_ndarray(picture, "gray")
            video_frame.pts = number if stamps is None else int(stamps[number])
            container.mux(stream.encode(video_frame))
        container.mux(stream.encode(None))


@pytest.fixture(params=["stack.tif", "film.mkv", "film.avi", "folder", "bag.mcap"])
def path(request, tmp_path, monkeypatch, frames):
    """Write the frames in a format, and as an array."""
    monkeypatch.chdir(tmp_path)
    np.save("ball.npy", frames)
    name = Path(request.param)
    if name.suffix == ".tif":
        tifffile.imwrite(name, frames, photometric="minisblack")
    elif name.suffix in (".mkv", ".avi"):
        write_video(name, frames)
    elif name.suffix == ".mcap":
        with io.open_recording("ball.npy", travel=TRAVEL) as recording:
            io.save_messages(recording, name)
    else:
        name.mkdir()
        for number, picture in enumerate(frames):
            cv2.imwrite(f"folder/frame{number}.png", picture)
    return name


def heights(path, *words):
    done("reconstruct", path, *STEPS, *SIZE, *LEVELS, *words, "-o", "out.h5", "--overwrite")
    return io.open_result("out.h5").height


def test_heights_are_those_of_the_array(path):
    np.testing.assert_array_equal(heights(path), heights("ball.npy"))


def test_a_part_is_a_part_of_the_whole(path):
    part = ("--region", "3,2,8x6", "--frames", "1:11", "--no-fill")
    np.testing.assert_array_equal(heights(path, *part), heights("ball.npy", *part))


def test_an_import_has_the_frames(path, frames):
    done("import", path, "--motion", "vertical", *STEPS, *SIZE, "-o", "rec.h5")
    with io.open_recording("rec.h5") as recording:
        np.testing.assert_array_equal(read_all(recording, 12).frames, frames)
        np.testing.assert_allclose(recording.travel, TRAVEL)


def test_a_batch_takes_it(path):
    Path("batch.toml").write_text(
        '[stack]\ntravel-step = "0.1mm"\ntravel-start = "0.1mm"\npixel-size = "0.4mm"\n'
        "[press]\ndark = 0\nbright = 255\n"
    )
    done("batch", path, "-o", "results", "--settings", "batch.toml")
    height = io.open_result(Path("results", f"{path.stem}-result.h5")).height
    np.testing.assert_array_equal(height, heights("ball.npy"))


def test_a_correlation_is_that_of_the_array(path):
    means = []
    for name in (path, "ball.npy"):
        done("correlate", name, "--phase-step", "30deg", "-o", "out.h5", "--overwrite")
        means.append(io.open_result("out.h5").mean)
    np.testing.assert_array_equal(*means)


def test_it_is_described(path):
    text = done("info", path).out
    assert "12 of 16 x 12, uint8" in text


def test_the_name_of_the_result_follows_from_its_own(path):
    done("reconstruct", path, *STEPS, *SIZE, *LEVELS)
    assert Path(f"{path.stem}-result.h5").is_file()


def test_the_frames_are_checked(path):
    assert "12 of 16 x 12, uint8" in done("check", path, *STEPS, *SIZE).out


def test_a_fingerprint_changes_with_the_file(path):
    def fingerprint():
        with io.open_recording(path, travel=TRAVEL) as recording:
            return recording.fingerprint()

    before = fingerprint()
    assert fingerprint() == before
    file = path / "frame3.png" if path.is_dir() else path
    data = file.read_bytes()
    file.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    with io.open_recording("ball.npy", travel=TRAVEL) as other:
        assert other.fingerprint() != before


@pytest.mark.parametrize("command", ["reconstruct", "info", "check", "correlate", "import"])
def test_help_lists_the_formats(command):
    text = " ".join(run(command, "--help").out.split())
    assert "MCAP, TIFF, a video (AVI, MP4, MOV, MKV)" in text


def test_a_channel_is_chosen_on_the_command_line(tmp_path, monkeypatch, frames):
    monkeypatch.chdir(tmp_path)
    both = np.stack([frames, 255 - frames], axis=1)
    tifffile.imwrite("a.tif", both, photometric="minisblack", imagej=True, metadata={"axes": "TCYX"})
    np.save("ball.npy", frames)
    refused("a.tif has 2 channels: --channel 0 to 1 takes one of them", "info", "a.tif")
    assert "12 of 16 x 12, uint8" in done("info", "a.tif", "--channel", 0).out
    np.testing.assert_array_equal(heights("a.tif", "--channel", 0), heights("ball.npy"))


@pytest.mark.parametrize("name", ["ball.npy", "ball.h5"])
def test_arrays_have_no_channels(tmp_path, monkeypatch, frames, name):
    monkeypatch.chdir(tmp_path)
    np.save("ball.npy", frames)
    record(ball((12, 16), (0.4, 0.4), TRAVEL), "ball.h5")
    refused("has no channels: leave --channel out", "reconstruct", name, *STEPS, "--channel", 1)


def test_time_stamps_of_an_import_stay_in_the_recording(tmp_path, monkeypatch, frames):
    monkeypatch.chdir(tmp_path)
    stamps = np.cumsum([0, 1, 1, 1, 2, 1, 1, 1, 1, 1, 3, 1])
    write_video("film.mkv", frames, stamps)
    assert run("import", "film.mkv", "--motion", "vertical", *STEPS, *SIZE, "-o", "rec.h5").code == 0
    with io.open_recording("rec.h5") as recording:
        np.testing.assert_allclose(recording.time, stamps / 25, atol=1e-9)


def test_lost_frames_of_an_import_stay_in_the_recording(tmp_path, monkeypatch, frames):
    monkeypatch.chdir(tmp_path)
    Path("folder").mkdir()
    for number in (0, 1, 2, 4, 5):
        cv2.imwrite(f"folder/frame{number}.png", frames[number])
    ended = run("import", "folder", "--motion", "vertical", *STEPS, *SIZE, "-o", "rec.h5")
    assert ended.code == 0
    assert "1 frame is missing, before frame 3" in ended.said
    with io.open_recording("rec.h5") as recording:
        assert recording.dropped.tolist() == [0, 0, 0, 1, 0]
        np.testing.assert_allclose(recording.travel, [0.1, 0.2, 0.3, 0.5, 0.6])
