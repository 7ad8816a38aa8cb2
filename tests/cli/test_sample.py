"""Samples: the same press as a recording and in formats of other programs."""

import h5py
import numpy as np
import pytest
from commands import done, refused, run
from right_scores import check_score

from mirrorskin import io


@pytest.fixture(scope="module")
def sample(tmp_path_factory):
    """Make a sample, once, and return where it is."""
    folder = tmp_path_factory.mktemp("samples")

    def make(name, file):
        if not (folder / file).exists():
            ended = done("sample", name, "-o", folder / file)
            assert ended.out.startswith(f"{folder / file}: ")
        return folder / file

    return make


def frames_of(source):
    return source.read(np.empty(source.shape, source.dtype)).frames


def test_a_press_is_the_same_in_every_form(sample):
    with io.open_recording(sample("press", "press.h5")) as press:
        frames = frames_of(press).copy()
        assert press.truth is not None
        assert press.header.pixel_size == (0.0375, 0.0375)
        np.testing.assert_allclose(press.travel, 0.1 * np.arange(31))  # from 0, as frames are taken to begin
    with h5py.File(sample("stack", "stack.h5")) as file:
        np.testing.assert_array_equal(file["raw/images"][:], frames)
    with io.open_recording(sample("pictures", "frames"), travel=io.Steps(0.1)) as pictures:
        np.testing.assert_array_equal(frames_of(pictures), frames)
    with io.open_recording(sample("video", "press.avi"), travel=io.Steps(0.1)) as video:
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
    refused("cannot be created", "sample pictures -o", tmp_path / "none" / "frames")


def test_a_name_that_is_not_a_video_is_refused_in_one_line(tmp_path, capfd):
    refused("ends in .avi", "sample video -o", tmp_path / "press.txt")
    assert capfd.readouterr().err == ""  # nor does OpenCV print anything


VERTICAL = (
    "--motion",
    "vertical",
    "--travel-step",
    "0.1mm",
    "--pixel-size",
    "0.0375mm",
)  # of a user's frames


def test_heights_of_a_video_are_right_without_more_options(sample):
    """tests/test_blocks.py has the stack and the pictures, by docs/start.md."""
    video = sample("video", "press.avi")
    assert run("import", video, "-o", "press.h5", *VERTICAL).code == 0
    assert run("reconstruct press.h5").code == 0
    check_score(["score", "press-result.h5", "--truth", str(sample("press", "press.h5"))])
