"""Stages and cameras are declared once: those of packages work like built-in ones, and any can be missing."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from commands import refused
from installed_packages import install

from mirrorskin.hw.base import drivers
from mirrorskin.hw.base.rig_file import load_rig
from mirrorskin.hw.rig.rig import open_camera, open_stage

PACKAGE = '''
from mirrorskin.hw.base.drivers import Driver

LAB = Driver(
    name="lab",
    title="Lab",
    loads="Device",
    takes=("clock",),
    motion="steps",
    outputs=False,
    formats="GREY",
    formats_help="GREY",
)


class Device:
    """What it was opened with."""

    def __init__(self, settings, clock):
        raise OSError(f"{settings} {clock}")
'''
RIG = """
[stage]
port = "/dev/ttyUSB0"
firmware = "{firmware}"
press = 2.0
[stage.travel]
letter = "Z"
limits = [-10, 3]
speed = 2
[camera]
source = "{source}"
size = [8, 6]
{camera}
"""


@pytest.fixture
def rig_file(tmp_path):
    """Return a function that writes a rig file, and returns its path."""

    def write(firmware="grbl", source="film.y4m", camera=""):
        text = RIG.format(firmware=firmware, source=source, camera=camera)
        (tmp_path / "rig.toml").write_text(text, encoding="utf-8")
        return tmp_path / "rig.toml"

    return write


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Install a package with a driver for stages and cameras."""
    package = tmp_path / "site"
    install(package, drivers.STAGES, lab="lab_driver:LAB")
    with (package / "package_of_a_test-1.0.dist-info" / "entry_points.txt").open("a") as file:
        file.write(f"[{drivers.CAMERAS}]\nlab = lab_driver:LAB\n")
    (package / "lab_driver.py").write_text(PACKAGE, encoding="utf-8")
    monkeypatch.syspath_prepend(package)
    monkeypatch.chdir(tmp_path)


@pytest.mark.usefixtures("installed")
def test_a_stage_of_a_package_is_opened_with_what_its_class_takes(rig_file):
    settings = load_rig(rig_file("lab")).stage
    with pytest.raises(ValueError, match=r"^lab_driver:Device: cannot be opened: StageSettings.*SystemClock"):
        open_stage(settings)


@pytest.mark.usefixtures("installed")
def test_a_camera_of_a_package_is_opened_by_its_name_and_a_serial_number(rig_file):
    settings = load_rig(rig_file(source="lab:4012")).camera
    assert settings.source == "lab:4012"
    with pytest.raises(
        ValueError, match=r"^lab_driver:Device: cannot be opened: CameraSettings.*SystemClock"
    ):
        open_camera(settings)


@pytest.mark.usefixtures("installed")
def test_pixel_formats_of_a_package_s_camera_are_checked(rig_file):
    load_rig(rig_file(source="lab:", camera='fourcc = "GREY"'))
    with pytest.raises(ValueError, match="this source needs GREY"):
        load_rig(rig_file(source="lab:", camera='fourcc = "YUYV"'))


@pytest.mark.usefixtures("installed")
def test_sweeps_are_refused_before_a_stage_that_moves_in_steps_is_open(rig_file):
    refused(
        "Lab does not report its position while it moves; use steps",
        *("capture", "vertical", "--rig", rig_file("lab"), "--stop", "1mm", "--speed", "1mm/s"),
        *("-o", "press.h5"),
    )


@pytest.mark.usefixtures("installed")
def test_a_trigger_is_refused_before_a_stage_without_outputs_is_open(rig_file):
    refused(
        "camera.trigger needs a GRBL controller",
        *("capture", "vertical", "--rig", rig_file("lab", camera='trigger = "coolant"\ndelay = 0.0')),
        *("--stop", "1mm", "--step", "0.1mm", "-o", "press.h5"),
    )


@pytest.mark.parametrize("group", [drivers.STAGES, drivers.CAMERAS])
def test_every_declaration_names_what_its_module_contains(group):
    declared = drivers.built_in(group)
    assert len({driver.name for driver in declared}) == len(declared) > 1
    assert all(callable(driver.load()) for driver in declared)


@pytest.fixture
def without_drivers(tmp_path, monkeypatch):
    """Remove the files of some built-in drivers."""
    for name in ("stages", "cameras"):
        shutil.copytree(Path(drivers.__file__).parents[1] / name, tmp_path / "hw" / name)
    for name in ("stages/marlin.py", "cameras/genicam.py", "cameras/video.py"):
        (tmp_path / "hw" / name).unlink()
    monkeypatch.setattr(drivers, "_HERE", tmp_path / "hw")
    drivers.built_in.cache_clear()
    yield
    drivers.built_in.cache_clear()


@pytest.mark.usefixtures("without_drivers")
def test_without_the_file_of_a_driver_others_are_found(rig_file):
    assert drivers.driver_names(drivers.STAGES) == ["grbl"]
    assert drivers.stage_driver("grbl").title == "GRBL"
    with pytest.raises(ValueError, match=r"stage\.firmware is marlin, and there are grbl; or name a class"):
        load_rig(rig_file("marlin", "lab.py:Camera"))
    with pytest.raises(ValueError, match=r"camera\.source is 0, and there is no camera for it"):
        drivers.camera_driver(0)
    assert drivers.camera_driver("lab.py:Camera").load
