"""Small recordings of each kind, good and bad, for batches."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
from stacks import MadeUp, random_stack, record

from mirrorskin import io

PHASE = np.arange(8) * np.pi / 4
PIXEL = (0.05, 0.06)


def press(path: Path, seed: int = 0, frames: int = 8) -> Path:
    """Write a press of 5 x 7 pixels that turn light at random, one after the other."""
    onset = np.random.default_rng(seed).integers(1, frames - 1, (5, 7))
    stack = np.where(np.arange(frames)[:, None, None] >= onset, 210, 15).astype(np.uint8)
    header = io.Header("vertical", pixel_size=PIXEL)
    return record(MadeUp(stack, header, travel=0.1 * np.arange(frames)), path)


def rotation(path: Path, seed: int = 0) -> Path:
    """Write a turn of 5 x 7 pixels that all lean a little to one side or another."""
    azimuth = np.random.default_rng(seed).uniform(-np.pi, np.pi, (5, 7))
    wave = 120 + 9 * np.cos(PHASE[:, None, None] - azimuth)
    header = io.Header("axial", pixel_size=PIXEL, tilt=0.045, zenith_gain=np.float64(200.0))
    return record(MadeUp(np.rint(wave).astype(np.uint8), header, phase=PHASE), path)


def horizontal(path: Path) -> Path:
    """Write a recording of a motion that nobody reconstructs."""
    moved = np.zeros((8, 2))
    return record(MadeUp(random_stack(), io.Header("horizontal"), displacement=moved), path)


def damaged(path: Path) -> Path:
    """Write a recording, and then other bytes over what it says."""
    content = bytearray(press(path).read_bytes())
    content[200:2000] = bytes(range(200)) * 9
    path.write_bytes(content)
    return path


def truncated(path: Path) -> Path:
    """Write a recording, and cut off its end."""
    path.write_bytes(press(path).read_bytes()[:-300])
    return path


def of_wrong_type(path: Path) -> Path:
    """Write a stack of samples that no camera gives."""
    with h5py.File(path, "w") as file:
        file["frames"] = np.zeros((8, 5, 7), np.complex64)
    return path


def a_folder(path: Path) -> Path:
    """Make a folder where a recording should be."""
    path.mkdir()
    return path


def missing(path: Path) -> Path:
    """Write nothing."""
    return path


BAD = {
    missing: "no such file",
    damaged: "damaged",
    truncated: "truncated",
    horizontal: "the pixel size is missing, which slip needs: give ",
    of_wrong_type: "of type complex64",
    a_folder: "is a folder",
}
"""Ways to be bad, and what is said of them."""


def half_written(folder: Path) -> list[Path]:
    """Return the files that someone began to write."""
    return [path for path in folder.rglob("*") if path.suffix == ".part"]
