"""``mirrorskin touch`` on the emulated rig, on simulated time, and the repetition of its result."""

import numpy as np
import pytest
from commands import done, run
from simulated import simulated_rig

from mirrorskin import io

LINE = "touch --rig {rig} --sigma 20um --press 1.5mm --from=-0.8mm -o {folder}/ball.h5"


@pytest.fixture(scope="module")
def touched(tmp_path_factory):
    """The folder of a touch of a ball, and what the command printed."""
    folder = tmp_path_factory.mktemp("touch")
    with simulated_rig(folder, (48, 64), 20.0, 0.0, pattern="linear") as (_, file):
        yield folder, done(LINE.format(rig=file, folder=folder)), file


def test_it_says_what_is_expected_and_why_it_ended(touched):
    _, ended, _ = touched
    assert "expected: " in ended.said
    assert "the request is met" in ended.out


def test_the_surface_has_the_requested_standard_deviation(touched):
    folder, *_ = touched
    result = io.open_result(folder / "ball.h5")
    sigma = result.height_sigma[np.isfinite(result.normals[..., 0])]
    assert np.mean(sigma <= 0.02) >= 0.95


def test_fuse_of_its_recording_repeats_the_surface(touched):
    folder, *_ = touched
    done("fuse", folder / "ball-frames.h5", "-o", folder / "again.h5")
    first, again = (io.open_result(folder / name) for name in ("ball.h5", "again.h5"))
    for name, values in first.items():
        np.testing.assert_array_equal(again[name], values, err_msg=name)


def test_a_region_needs_a_press_of_less_depth(touched, tmp_path):
    folder, _, file = touched
    done(LINE.format(rig=file, folder=tmp_path), "--region", "39,21,4x6")
    with io.open_recording(tmp_path / "ball-frames.h5") as press:
        with io.open_recording(folder / "ball-frames.h5") as whole:
            assert press.travel.max() < whole.travel.max()
        assert press.shape[1:] == (48, 64)


def test_the_recording_is_that_of_the_press(touched):
    folder, *_ = touched
    with io.open_recording(folder / "ball-frames.h5") as press:
        assert press.motion == "vertical"
        assert (np.diff(press.travel) > 0).all()


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("--sigma 2", "unit"),
        ("--sigma 2um --press 5mm", "beyond the axis"),
        ("--sigma 2um --from 2.9mm", "no place to search"),
        ("--sigma 2um --share 200%", "share 2 is not possible"),
        ("--sigma 2um --tilt 30deg", "exceeds the maximum"),
        ("--sigma 2um --region 0,0,65x48", "a region of columns 0 to 65"),
        ("--sigma 2um --region 0,0", "the first column and row"),
    ],
)
def test_what_cannot_be_done_is_refused(touched, line, words):
    folder, _, file = touched
    ended = run(f"touch --rig {file} -o {folder}/other.h5 {line}")
    assert ended.code
    assert words in ended.said
    assert not (folder / "other.h5").exists()


def test_fuse_of_one_plain_recording_is_refused(tmp_path):
    done("sample press -o", tmp_path / "press.h5")
    ended = run("fuse", tmp_path / "press.h5")
    assert "is not the recording of a touch" in ended.said


def test_a_fault_keeps_the_frames(tmp_path):
    with simulated_rig(tmp_path, (48, 64), 20.0, 0.0, pattern="linear") as (rig, file):
        rig.clock.later(4.0, lambda: rig.camera.lose())
        ended = run(LINE.format(rig=file, folder=tmp_path))
    assert ended.code == 1
    assert "was lost" in ended.said
    with io.open_recording(tmp_path / "ball-frames.h5") as recording:
        assert recording.shape[0] >= 4
