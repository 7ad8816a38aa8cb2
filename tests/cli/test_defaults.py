"""The user's own defaults."""

import numpy as np
import pytest
from commands import done, run
from stacks import ball

from mirrorskin import io
from mirrorskin.cli import defaults

TRAVEL = np.round(np.arange(0.0, 1.3, 0.1), 10)


@pytest.fixture
def config(tmp_path, monkeypatch):
    """Write the user's configuration; the working directory is empty otherwise."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "config.toml"
    monkeypatch.setenv("MIRRORSKIN_CONFIG", str(path))

    def write(text):
        path.write_text(text)
        return path

    return write


def save_press(size=None):
    source = ball((20, 24), 0.3, TRAVEL)
    frames = source.read(np.empty(source.shape, source.dtype)).frames
    np.save("press.npy", frames)
    words = () if size is None else ("--pixel-size", size)
    done("import press.npy -o press.h5 --motion vertical --travel-step 0.1mm", *words)


def test_recordings_without_a_pixel_size_have_the_users(config):
    path = config('pixel-size = "0.3mm"')
    np.save("press.npy", np.zeros((13, 4, 4), np.uint8) + np.arange(13, dtype=np.uint8)[:, None, None] * 20)
    ended = done("import press.npy -o press.h5 --motion vertical --travel-step 0.1mm")
    with io.open_recording("press.h5") as recording:
        assert recording.header.pixel_size == (0.3, 0.3)
    assert f"pixel size 0.3mm of {path}" in ended.said


def test_the_note_of_a_default_is_kept_in_the_result(config):
    config("")
    save_press()
    path = config('pixel-size = "0.2mm"')
    defaults._read.cache_clear()
    done("reconstruct press.h5")
    assert f"pixel size 0.2mm of {path}" in io.open_result("press-result.h5").process["notes"]


def test_a_recordings_own_pixel_size_comes_first(config):
    config('pixel-size = "0.2mm"')
    save_press("0.3mm")
    done("reconstruct press.h5")
    assert "0.2mm" not in io.open_result("press-result.h5").process.get("notes", "")


def test_a_calibration_of_the_user_is_used(config):
    config('calibration = "none.h5"')
    save_press("0.3mm")
    ended = run("reconstruct press.h5")
    assert (ended.code, "none.h5" in ended.said) == (2, True)


def test_a_device_of_the_user_is_used(config):
    config('device = "no such device"')
    save_press("0.3mm")
    ended = run("reconstruct press.h5")
    assert (ended.code, "'no such device'" in ended.said) == (2, True)


def test_an_option_comes_before_the_users_default(config):
    config('device = "no such device"')
    save_press("0.3mm")
    done("reconstruct press.h5 --device 0")


def test_a_rig_of_the_user_is_used(config):
    config('rig = "none.toml"')
    ended = run("capture vertical --stop 1mm --step 0.1mm -o press.h5")
    assert (ended.code, "none.toml" in ended.said) == (2, True)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('pixelsize = "0.3mm"', "pixelsize is not known: did you mean pixel-size?"),
        ("device = 3", 'device is 3: a text in quotes is needed; write e.g. device = "gpu"'),
        ('device = "gpu', "is not TOML"),
    ],
)
def test_a_wrong_file_is_refused_in_one_line(config, text, message):
    path = config(text)
    ended = run("devices")
    assert ended.code == 2
    assert str(path) in ended.said
    assert message in ended.said
    assert ended.said.count("\n") == 1


def test_a_wrong_pixel_size_names_the_file(config):
    config("")
    save_press()
    path = config('pixel-size = "0.3"')
    defaults._read.cache_clear()
    ended = run("reconstruct press.h5")
    assert ended.said.startswith(f"mirrorskin: {path}: pixel-size")


def test_a_file_that_the_environment_names_must_exist(config):
    ended = run("devices")
    assert (ended.code, "config.toml" in ended.said) == (2, True)
