"""Whole paths of a press, from a file to a result in a file: contiguous frames, and packed ones."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mirrorskin import io
from mirrorskin.bench.harness import Work, take_turns
from mirrorskin.bench.limits import Limits
from mirrorskin.bench.memory import check_memory
from mirrorskin.bench.ours import OURS, our_works
from mirrorskin.bench.paths import files
from mirrorskin.bench.paths.cold import measure_cold
from mirrorskin.bench.paths.equal import check_equal
from mirrorskin.bench.paths.reading import H5PY, READ, fetch, read_with_h5py, room_of
from mirrorskin.bench.paths.targets import at_most
from mirrorskin.bench.paths.whole import PATH, ROUNDS, to_new_results, to_result
from mirrorskin.bench.results import Case, Row, Target
from mirrorskin.bench.stacks import fill, references
from mirrorskin.engine import Onset, OnsetSearch
from mirrorskin.engine.tiling import MEMORY_LIMIT
from mirrorskin.kernels.device import Device

KERNEL, IN_MEMORY = f"{OURS}, onset kernel in memory", f"{OURS}, onset kernel and maps in memory"
UNSAVED, FILLED = f"{PATH}, not saved", f"{PATH}, holes filled"
OPEN, FINGERPRINT, SAVE = f"{OURS}, open and close", f"{OURS}, open, fingerprint, close", f"{OURS}, save"

_LEANS = 7.0  # mm from the picture's centre to where the ball leans by 45 degrees
_SPAN = 2.1  # of that, from one side of the picture to the other; see `mirrorskin.bench.stacks.fill`
_MAPS = 64  # bytes a pixel for all maps


@dataclass(frozen=True, slots=True)
class PressCase(files.FileCase):
    """A press in a file.

    Attributes
    ----------
    compression : {"raw", "bitshuffle"}
        Raw frames lie in one piece, others in one chunk a frame.
    """

    compression: Literal["raw", "bitshuffle"] = "raw"

    @property
    def title(self) -> str:
        """What is measured, in one line."""
        stored = "contiguous" if self.compression == "raw" else "bitshuffle-LZ4, one chunk a frame"
        return (
            f"full default, references of each pixel, no pixel size and so no holes filled; "
            f"{' x '.join(map(str, self.shape))} uint8, {stored}"
        )


def make_press(shape: tuple[int, int, int]) -> files.Frames:
    """Return a press of a ball, with references of each pixel and without a pixel size."""
    frames = files.in_memory(shape, np.dtype(np.uint8))
    fill(frames, "press")
    dark, bright = references(shape[1:], frames.dtype)
    step = _LEANS * (math.sqrt(2) - 1) / (0.9 * shape[0])
    header = io.Header("vertical", dark=dark, bright=bright)
    return files.Frames(frames, header, np.arange(shape[0], dtype=np.float64) * step)


def pixel_size(shape: tuple[int, int, int]) -> tuple[float, float]:
    """Return how large the pixels must be, mm, for the press to be one of a ball."""
    return _SPAN * _LEANS / shape[2], _SPAN * _LEANS / shape[1]


def search_of(source: files.Frames, device: Device) -> OnsetSearch:
    """Return the search that `reconstruct` makes for a press, by default."""
    header = source.header
    return OnsetSearch(source.shape[1:], source.dtype, dark=header.dark, bright=header.bright, device=device)


def maps_of(onset: Onset) -> dict[str, NDArray[Any]]:
    """Return the maps of a search under their names in a result."""
    return {"height": onset.height, "height_sigma": onset.sigma, "status": onset.status}


def run_press(case: PressCase, device: Device, quick: bool) -> Case:
    """Time the path from file to result and its parts, warm and cold, beside the kernel in memory.

    Raises
    ------
    mirrorskin.io.InputError
        There is not enough memory, or room for files.
    DisagreementError
        A path gave other maps than the same frames in memory.
    """
    pixels, rounds = math.prod(case.shape[1:]), 1 if quick else ROUNDS
    check_memory(case.name, 3 * case.bytes + MEMORY_LIMIT + _MAPS * pixels)
    with files.new_folder(case.name, case.bytes + rounds * _MAPS * pixels) as folder:
        press, path = make_press(case.shape), folder / "press.h5"
        files.record(press, path, case.compression)
        rows, how = _measure_warm(case, press, path, device, rounds)
        work = partial(to_result, path, folder / "cold.h5", device)
        cold, absent = measure_cold(path, work, device, rounds, case.shape[0], case.bytes)
    named = {row.name: row for row in rows}
    targets = () if quick else (_judge(case, named),)
    return Case(
        case.name, case.title, rows + cold, absent, (f"frames: {how}", _tell_parts(case, named)), targets
    )


def _measure_warm(
    case: PressCase, press: files.Frames, source: Path, device: Device, rounds: int
) -> tuple[list[Row], str]:
    """Return the rows of all works that find the file in the page cache, and how frames are fetched."""
    search, target = search_of(press, device), source.with_name("result.h5")
    limits = Limits(device, press.block.frames)
    push, whole = our_works(search, press.block).values()
    known = to_result(source, None, device)
    known_size = {"pixel_size": pixel_size(case.shape)}
    with io.open_recording(source) as recording:
        moving: dict[str, Work] = {
            KERNEL: push,
            IN_MEMORY: whole,
            PATH: to_new_results(source, target, device),
            UNSAVED: partial(to_result, source, None, device),
            FILLED: to_new_results(source, source.with_name("filled.h5"), device, opening=known_size),
            READ: partial(fetch, recording, room_of(recording)),
            H5PY: partial(read_with_h5py, source, recording.dataset),
        }
        still: dict[str, Work] = {
            OPEN: partial(_open, source),
            FINGERPRINT: partial(_take_fingerprint, source),
            SAVE: partial(io.save_result, known, source.with_name("again.h5")),
        }
        check = partial(_check, target)
        measured = take_turns({**limits.works(), **moving, **still}, rounds, device.profile, check)
        how = f"{recording.storage}; {recording.how}"
    rows = [Row(name, measured[name], case.bytes, case.shape[0]) for name in moving]
    rows += [Row(name, measured[name], 0) for name in still]
    return limits.rows(measured) + rows, how


def _open(source: Path) -> None:
    io.open_recording(source).close()


def _take_fingerprint(source: Path) -> None:
    with io.open_recording(source) as recording:
        recording.fingerprint()


def _check(saved: Path, results: dict[str, Any]) -> None:
    """Compare what came of the file, in memory and in a file, with what came of the frames in memory."""
    expected = maps_of(results[IN_MEMORY])
    found = {name: results[name].maps() for name in (PATH, UNSAVED, FILLED)}
    found[f"{PATH}, saved"] = io.open_result(saved).maps()
    measured = found[FILLED].pop("filled") == 0
    found[FILLED]["height"] = np.where(measured, found[FILLED]["height"], np.nan)
    for name, maps in found.items():
        check_equal(name, expected, maps, IN_MEMORY)


def _judge(case: PressCase, rows: dict[str, Row]) -> Target:
    """Judge the path: of contiguous frames beside the kernel, of packed ones beside decoding."""
    if case.compression == "raw":
        return at_most(PATH, 1.25, rows[PATH], rows[KERNEL], "the onset kernel on the same frames in memory")
    return at_most(PATH, 1.15, rows[PATH], rows[READ], "decoding alone with the same threads")


def _tell_parts(case: PressCase, rows: dict[str, Row]) -> str:
    """Say what the time from file to result went into; kernels read contiguous frames where they lie."""
    wall = {name: row.measured.wall.median for name, row in rows.items()}
    parts = {
        "kernels": rows[PATH].measured.kernel,
        "opening": wall[OPEN],
        "fingerprint": wall[FINGERPRINT] - wall[OPEN],
        "maps": wall[IN_MEMORY] - wall[KERNEL],
        "saving": wall[SAVE],
    }
    if case.compression != "raw":
        parts["reading and decoding"] = wall[READ]
    parts["all else"] = wall[PATH] - sum(parts.values())
    told = ", ".join(f"{name} {1e3 * seconds:.1f}" for name, seconds in parts.items())
    return f"of the {1e3 * wall[PATH]:.1f} ms from file to result: {told}"
