"""`mirrorskin doctor`: a complete description for reports of faults, also if something is missing."""

import json
from importlib.metadata import PackageNotFoundError, version

import pytest
from commands import done

from mirrorskin.cli.commands import doctor
from mirrorskin.kernels import device
from mirrorskin.kernels.errors import DeviceError


@pytest.fixture
def facts():
    return lambda: json.loads(done("doctor --json").out)


def test_it_is_printed_in_two_columns():
    lines = done("doctor").out.splitlines()
    assert lines[0].split() == ["mirrorskin", version("mirrorskin")]


def test_versions_are_those_that_are_installed(facts):
    assert facts()["package numpy"] == version("numpy")


def test_the_device_is_the_default_one(facts):
    assert facts()["device"].startswith(device.open_device().info.title)


def test_without_a_device_it_states_the_reason(facts, monkeypatch):
    def refuse(choice=None):
        raise DeviceError("no OpenCL device found")

    monkeypatch.setattr(device, "open_device", refuse)
    assert facts()["device"] == "none: no OpenCL device found"


def test_a_missing_package_of_an_extra_is_named(facts, monkeypatch):
    def installed(name):
        if name == "trimesh":
            raise PackageNotFoundError(name)
        return "1.0"

    monkeypatch.setattr(doctor.metadata, "version", installed)
    state = facts()
    assert (state["extra mesh"], state["extra view"]) == ("missing: trimesh", "installed")


def test_environment_variables_of_opencl_are_shown(facts, monkeypatch):
    monkeypatch.setenv("PYOPENCL_NO_CACHE", "1")
    assert facts()["PYOPENCL_NO_CACHE"] == "1"
