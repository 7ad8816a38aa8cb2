"""Samples: the same press as a recording and as other programs have it."""

import h5py
import numpy as np
import pytest
from commands import run

from mirrorskin import io


@pytest.fixture
def sample(tmp_path):
    """Make a sample, and return where it is."""

    def make(name, file):
        ended = run("sample", name, "-o", tmp_path / file)
        assert ended.code == 0, ended.said
        assert ended.out.startswith(f"{tmp_path / file}: ")
        return tmp_path / file

    return make


def frames_of(source):
    return source.read(np.empty(source.shape, source.dtype)).frames


def test_a_press_is_the_same_in_every_form(sample):
    with io.open_recording(sample("press", "press.h5")) as press:
        frames, header = frames_of(press).copy(), io.Header("vertical")
        assert press.truth is not None
        assert press.header.pixel_size == (0.0375, 0.0375)
    with h5py.File(sample("stack", "stack.h5")) as file:
        np.testing.assert_array_equal(file["raw/images"][:], frames)
    with io.open_frames(sample("pictures", "frames"), header, travel=io.Steps(0.1)) as pictures:
        np.testing.assert_array_equal(frames_of(pictures), frames)
    with io.open_frames(sample("video", "press.avi"), header, travel=io.Steps(0.1)) as video:
        assert np.abs(frames_of(video).astype(int) - frames).mean() < 2  # which JPEG costs


def test_a_turn_and_a_slide_are_recordings_of_their_motions(sample):
    for name, motion in (("turn", "axial"), ("slide", "horizontal")):
        with io.open_recording(sample(name, f"{name}.h5")) as recording:
            assert recording.motion == motion


@pytest.mark.slow
def test_what_a_sensor_is_calibrated_with_is_all_there(sample):
    folder = sample("calibration", "lab")
    names = {"dark", "flat", "press-ball", "other", *(f"ball-{number}" for number in range(1, 6))}
    assert {path.stem for path in folder.glob("*.h5")} == names
    with io.open_recording(folder / "flat.h5") as flat, io.open_recording(folder / "dark.h5") as dark:
        assert frames_of(flat).mean() == pytest.approx(224, abs=1)
        assert frames_of(dark).mean() == pytest.approx(16, abs=1)
    assert (folder / "photo.png").is_file()


def test_a_folder_that_cannot_be_made_is_refused(tmp_path):
    ended = run("sample", "pictures", "-o", tmp_path / "none" / "frames")
    assert ended.code == 2
    assert "cannot be made" in ended.said


def test_a_name_that_is_no_video_is_refused(tmp_path):
    ended = run("sample", "video", "-o", tmp_path / "press.txt")
    assert ended.code == 2
    assert "name a file that ends with .avi" in ended.said
