"""Systems without Linux's features: the packages can be imported, and arrays are computed."""

import subprocess
import sys

import pytest

# What is imported before the system is changed is the business of others: their files for that system differ.
_OTHERS = """
import asyncio, concurrent.futures, logging.handlers, multiprocessing, pathlib, shutil, socket, subprocess
import cv2, h5py, numpy, platformdirs, pyopencl, scipy.ndimage, scipy.optimize, serial.tools.list_ports
import os, sys
"""
_MACOS = f"""{_OTHERS}
sys.platform = "darwin"
for name in ("sched_getaffinity", "posix_fallocate"):
    delattr(os, name)
"""
_WINDOWS = f"""{_OTHERS}
import mmap, signal
sys.platform = "win32"
for name in ("fcntl", "grp", "pty", "pwd", "resource", "termios"):
    sys.modules[name] = None
for name in (
    "sched_getaffinity posix_fallocate getuid geteuid mkfifo killpg"
    " O_CLOEXEC O_NOFOLLOW O_DIRECTORY O_NONBLOCK"
).split():
    delattr(os, name)
for name in ("SIGHUP", "SIGALRM", "setitimer"):
    delattr(signal, name)
"""
_DEVICE = "from mirrorskin.kernels.device import open_device; open_device()\n"  # of this system, as any other
_EXTRAS = "import distributed, matplotlib.pyplot, panel\n"
_IMPORT = """
import importlib, pkgutil
for name in ("io", "kernels", "engine", "hw", "twin", "view", "cli"):
    package = importlib.import_module(f"mirrorskin.{name}")
    for module in pkgutil.walk_packages(package.__path__, f"mirrorskin.{name}."):
        importlib.import_module(module.name)
"""
_PRESS = """
from mirrorskin import engine
travel = numpy.linspace(0, 1, 21)
height = numpy.linspace(0.25, 0.75, 12).reshape(3, 4)
frames = numpy.where(travel[:, None, None] > height, 200, 20).astype(numpy.uint8)
onset = engine.find_onset(frames, travel, dark=20, bright=200)
assert numpy.nanmax(abs(-onset.height - height)) < 0.05, onset.height
"""
_SAVE = """
from mirrorskin import io
result = engine.reconstruct(frames, travel=travel, pixel_size=0.1, dark=20, bright=200)
io.save_result(result, "result.h5")
assert io.open_result("result.h5").height.shape == (3, 4)
"""


def run(code, folder):
    return subprocess.run(
        [sys.executable, "-c", code],
        cwd=folder,
        capture_output=True,
        text=True,
    )


@pytest.mark.parametrize("system", [_MACOS, _WINDOWS], ids=["macOS", "Windows"])
def test_all_modules_can_be_imported(system, tmp_path):
    process = run(f"{_EXTRAS}{system}{_IMPORT}", tmp_path)
    assert process.returncode == 0, process.stderr


def test_macos_reconstructs_arrays_and_saves_results(tmp_path):
    process = run(f"{_DEVICE}{_MACOS}{_PRESS}{_SAVE}", tmp_path)
    assert process.returncode == 0, process.stderr


def test_windows_reconstructs_arrays_and_refuses_to_write_a_file(tmp_path):
    process = run(f"{_DEVICE}{_WINDOWS}{_PRESS}print('reconstructed')\n{_SAVE}", tmp_path)
    assert process.stdout == "reconstructed\n"
    assert "InputError: mirrorskin cannot write files on Windows" in process.stderr
