"""A camera class in a rig file is opened, checked, and used by commands like a built-in one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from installed_packages import install

from mirrorskin import io
from mirrorskin.hw.base.drivers import CAMERAS, built_in, camera_driver
from mirrorskin.hw.base.rig_file import load_rig
from mirrorskin.hw.rig.rig import open_camera

CAMERA = '''
import threading
import time

import numpy as np

from mirrorskin.hw.cameras.camera_thread import ThreadedCamera


class Steady(ThreadedCamera):
    """A camera whose frames are all the same."""

    def __init__(self, settings):
        super().__init__(settings.name, settings.shape, settings.dtype, rate=100.0)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._drain)
        self._thread.start()

    def close(self):
        self._stop.set()
        self._thread.join()

    def _drain(self):
        while not self._stop.wait(0.005):
            self._slot()[:] = 7
            self._put(time.monotonic())


class Wide(Steady):
    """A camera with other frames than the rig file states."""

    def __init__(self, settings):
        super().__init__(settings)
        self.shape = 6, 80


class Absent:
    """A camera that is not there."""

    def __init__(self, settings):
        raise OSError("no such device")


class Half:
    """A class without most of what a camera needs."""

    def __init__(self, settings):
        self.name = settings.name


class Other:
    """A class with other arguments."""

    def __init__(self, serial, port):
        self.name = serial
'''
RIG = """
[stage]
port = "/dev/ttyUSB0"
press = 2.0
[stage.travel]
letter = "Z"
limits = [-10, 3]
speed = 2
[camera]
source = "{source}"
size = [8, 6]
"""


@pytest.fixture
def opened(tmp_path):
    """Return a function that opens the camera of a rig file with a source."""
    (tmp_path / "my_camera.py").write_text(CAMERA, encoding="utf-8")

    def opened(source):
        (tmp_path / "rig.toml").write_text(RIG.format(source=source), encoding="utf-8")
        return open_camera(load_rig(tmp_path / "rig.toml").camera)

    return opened


@pytest.mark.parametrize("source", ["my_camera.py:Steady", "my_camera:Steady"])
def test_a_class_next_to_the_rig_file_is_opened(opened, source):
    camera = opened(source)
    try:
        np.testing.assert_array_equal(camera.take(1, 20.0).pixels[0], np.full((6, 8), 7))
    finally:
        camera.close()


def test_an_entry_point_names_a_camera(opened, tmp_path, monkeypatch):
    install(tmp_path / "site", CAMERAS, steady="steady_camera:Steady")
    (tmp_path / "site" / "steady_camera.py").write_text(CAMERA, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path / "site")
    camera = opened("steady")
    try:
        assert camera.take(1, 20.0).pixels.shape == (1, 6, 8)
    finally:
        camera.close()


@pytest.mark.parametrize(
    ("kind", "line"),
    [
        ("Wide", "frames are 80 x 6, uint8, but camera.size and dtype in the rig file are 8 x 6, uint8"),
        ("Absent", "cannot be opened: no such device; check camera.source"),
        (
            "Half",
            "has no shape, no dtype, no counts, no latest, no error, no take, no flush, no close:",
        ),
        ("Other", "a camera class takes one argument, the CameraSettings"),
        ("Stead", "did you mean Steady?"),
    ],
)
def test_a_class_that_is_no_camera_is_refused_in_a_line(opened, kind, line):
    with pytest.raises(io.InputError) as refused:
        opened(f"my_camera.py:{kind}")
    assert line in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("source", ["rtsp://camera/stream", "film.y4m", "genicam:4012"])
def test_other_sources_are_no_classes(tmp_path, source):
    (tmp_path / "rig.toml").write_text(RIG.format(source=source), encoding="utf-8")
    camera = load_rig(Path(tmp_path, "rig.toml")).camera
    assert camera.source == source
    assert camera_driver(source) in built_in(CAMERAS)
