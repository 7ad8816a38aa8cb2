"""Small files of each layout, which all later versions must read.

``python tests/io/layouts/make.py`` (in the environment) writes those that are missing: for a new layout, give
it a new number. A file that is there is never written again. Those in ``early`` are the same, written by
earlier programs (commits 5e60a58, d929ed6 and, of results, 780b64e), whose layouts are only read.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2] / "support"))
from calibrations import a_calibration
from stacks import MadeUp, record

from mirrorskin import io
from mirrorskin.io.model.maps import PressStatus, status_of

FOLDER = Path(__file__).parent
SHAPE = (6, 5, 7)
FRAMES = (np.arange(np.prod(SHAPE)) * 7 % 251).reshape(SHAPE).astype(np.uint8)
TRAVEL = 0.25 * np.arange(6)
PHASE = np.pi / 3 * np.arange(6)
PIXEL = (0.05, 0.06)
MAP = np.arange(35, dtype=np.float32).reshape(5, 7) / 8
HOLED = np.where(np.arange(35).reshape(5, 7) == 9, np.float32(np.nan), MAP)
TRUTH = io.Truth(MAP, MAP / 8, -MAP / 8, (MAP > 2).astype(np.uint8))
PROCESS: dict[str, str | int | float | bool] = {"program": "mirrorskin", "source": "Münze.h5", "hold": 2}
PRESS = io.Result(height=HOLED, height_sigma=MAP, status=np.ones((5, 7), np.uint8), process=PROCESS)
ROTATION = io.Result(
    normals=np.stack([MAP, -MAP, 1 + MAP], axis=-1), zenith=HOLED, azimuth=MAP, process=PROCESS
)
DECLARED = PRESS.assign(
    wear=MAP,
    wear_sigma=MAP,
    normals_sigma=MAP,
    declarations={
        "status": status_of(PressStatus),
        "wear": io.Map("depth of the wear", "mm", displayed="µm"),
    },
)


def a_press() -> MadeUp:
    """Return a press with references and times."""
    header = io.Header("vertical", pixel_size=PIXEL, dark=MAP, bright=200 + MAP, title="Münze")
    return MadeUp(FRAMES, header, travel=TRAVEL, time=TRAVEL / 10)


def a_rotation() -> MadeUp:
    """Return a rotation with a zenith's gain."""
    header = io.Header("axial", pixel_size=PIXEL, tilt=0.04, zenith_gain=np.float64(200.0))
    return MadeUp(FRAMES.astype(np.uint16) * 200, header, phase=PHASE)


def by_others(path: Path) -> None:
    """Write a recording as docs/formats.md tells others to: texts of variable length, no checksums."""
    with h5py.File(path, "w") as file:
        file["/entry/instrument/detector/data"] = FRAMES
        file["/entry/instrument/stage/motion"] = "vertical"
        file["/entry/instrument/stage/travel"] = TRAVEL
        for axis, size in zip("xy", PIXEL, strict=True):
            file[f"/entry/instrument/detector/{axis}_pixel_size"] = size
        file["/entry"].attrs["mirrorskin_recording"] = 1


def live(path: Path) -> None:
    """Write a press as it is written while it is under way."""
    source = a_press()
    source.positions = lambda: {"travel": TRAVEL}
    with io.StreamRecorder(source, path) as recorder:
        buffer = np.empty((2, *SHAPE[1:]), np.uint8)
        while recorder.read(buffer) is not None:
            pass


WRITERS: dict[str, Callable[[Path], object]] = {
    "others-recording-1.h5": by_others,
    "press-recording-1.h5": lambda path: record(a_press(), path),
    "truth-recording-1.h5": lambda path: record(a_press(), path, truth=TRUTH),
    "live-recording-1.h5": live,
    "gzip-recording-1.h5": lambda path: record(a_rotation(), path, "gzip"),
    "bitshuffle-recording-1.h5": lambda path: record(a_rotation(), path, "bitshuffle"),
    "press-result-2.h5": lambda path: io.save_result(DECLARED, path),
    "rotation-result-2.h5": lambda path: io.save_result(ROTATION, path),
    "calibration-1.h5": lambda path: io.save_calibration(a_calibration(), path),
}

if __name__ == "__main__":
    for name, write in WRITERS.items():
        if not (FOLDER / name).exists():
            write(FOLDER / name)
