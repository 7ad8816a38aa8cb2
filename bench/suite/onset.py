"""The onset of the light state: the engine, the limits, NumPy, OpenCV, PyTorch and Numba on one stack."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.suite.harness import Cases, agree, check_memory, missing, time_call
from mirrorskin.cli.commands.bench.records import THREADS, Case
from mirrorskin.cli.commands.bench.timing import OURS
from mirrorskin.engine import Onset, Run, find_onset
from mirrorskin.engine.base.frames import estimate_noise, reference_maps, thinned
from mirrorskin.engine.base.operation import Plan
from mirrorskin.evaluation.scenes.inputs import (
    LEVELS,
    StackName,
    fill_press,
    press_noise,
    references,
    travel_of,
)
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.press.onset import (
    BENT,
    DARK,
    NEAR_PLATEAU,
    onset_heights,
    onset_levels,
    onset_near,
    onset_sure,
)

Maps = dict[str, NDArray[Any]]
Flags = NDArray[np.uint8]
Levels = NDArray[Any]  # smallest light sample in the frames' type: one for all, (), or one a pixel, (H, W)
Shape = tuple[int, int, int]

_HD, _MEMORY, _QUICK = (64, 1080, 1920), (240, 2160, 3840), (12, 48, 64)
_BYTE = np.dtype(np.uint8)
_THRESHOLD = 0.5
_MAPS = 64  # bytes per pixel for all maps
_PLATEAU, _CONFIDENT = (
    3.0,
    6.0,
)  # standard deviations from the plateau, and below the level: docs/method/press.md
# Threads of the pool, and pixels per tile: more exceed the cache, fewer increase the overhead of calls. NumPy
# uses one core, as usual; PyTorch has its own threads.
_TILES = {"NumPy": (1, 262_144), "OpenCV": (THREADS, 400_000), "PyTorch": (1, 1_200_000)}
_NUMBA_TILE = 16_384
_COUNTABLE = 255  # maximum number of frames counted in a byte


def run_onset(name: str, shape: Shape, stack: StackName, full: bool, device: Device, quick: bool) -> Case:
    """Time the onset, the limits and the peers on one stack, after checking that their maps agree.

    `full` is the full default: reference levels of each pixel, hold 2, sub-frame interpolation; heights,
    sigma and status are compared. Otherwise there is one threshold for all pixels, and the numbers of frames
    are compared (equation 4).
    """
    shape = _QUICK if quick else shape
    check_memory(name, 2 * math.prod(shape) + _MAPS * math.prod(shape[1:]))
    frames = np.empty(shape, _BYTE)
    fill_press(frames, stack)
    travel = travel_of(len(frames))
    dark, bright = references(shape[1:], _BYTE) if full else LEVELS[_BYTE.name]
    options: dict[str, Any] = {"dark": dark, "bright": bright}
    if not full:
        options |= {"hold": 1, "subframe": False, "noise": press_noise(_BYTE)}
    maps = reference_maps(dark, bright, shape[1:] if full else (), _BYTE)  # type: ignore[arg-type]
    level, plateau, light = onset_levels(maps[1], maps[0], _THRESHOLD, _BYTE)
    levels = References(np.asarray(level), np.asarray(light), plateau)
    absent = missing("torch", "numba")
    peers = _peers(full, frames, travel, levels, absent)

    def check(results: dict[str, Any]) -> None:
        words = ("height", "height_sigma", "status") if full else ("frame",)
        expected = {word: getattr(results[OURS], word) for word in words}
        if full:  # checks add what is uncertain about camera and lens
            run = Run(Plan(Onset(device=device, **options), checked=False))
            run.push(frames, travel=travel)
            expected["height_sigma"] = run.result().height_sigma
        for peer in peers:
            if full:
                sigma = 1e-5 * np.abs(expected["height_sigma"])
                near = {"height": np.spacing(np.abs(expected["height"])), "height_sigma": sigma}
                agree(peer, results[peer], expected, near)
            else:  # a pixel with invalid input has no onset either
                agree(peer, {"frame": np.maximum(results[peer], -1)}, expected)

    what = "full default" if full else "frame of the onset, one threshold, hold 1"
    title = f"{what}; {' x '.join(map(str, shape))} uint8, {stack}"
    call = functools.partial(find_onset, frames, travel, device=device, **options)
    return time_call(
        name,
        title,
        call,
        frames.nbytes,
        device,
        quick,
        frames=len(frames),
        peers=peers,
        check=check,
        absent=absent,
    )


_OPTIONS: dict[str, tuple[Shape, StackName, bool]] = {
    "equation4-uint8": (_HD, "random", False),
    "equation4-memory": (_MEMORY, "random", False),
    "full-uint8": (_HD, "press", True),
    "full-small": ((64, 48, 64), "press", True),
    "full-vga": ((64, 480, 640), "press", True),
    "full-memory": (_MEMORY, "press", True),
    "full-random": (_HD, "random", True),
}
CASES: Cases = {name: functools.partial(run_onset, name, *options) for name, options in _OPTIONS.items()}


class References(NamedTuple):
    """Reference levels of each pixel, or of all: (H, W) or ().

    `level` is the float32 at which it turns light, NaN for a dead pixel, `light` the smallest sample that is
    light, `dark` its dark plateau.
    """

    level: NDArray[np.float32]
    light: Levels
    dark: NDArray[np.float32]

    def of(self, rows: slice) -> References:
        """Return the levels of some rows; common levels are returned unchanged."""
        return References(*(values[rows] if values.ndim else values for values in self))


def _peers(
    full: bool, frames: NDArray[Any], travel: NDArray[np.float64], levels: References, absent: dict[str, str]
) -> dict[str, Callable[[], object]]:
    libraries: dict[str, Library] = {"NumPy": _numpy, "OpenCV": _opencv}
    if "torch" not in absent and not full:  # heights would be computed by NumPy, as for OpenCV
        libraries["PyTorch"] = _torch
    first, second = thinned(frames[:2])[0].astype(np.float64)
    noise = estimate_noise(first, second, True)
    run = _heights if full else _onsets
    works: dict[str, Callable[[], object]] = {
        name: functools.partial(run, _TILES[name], library, frames, travel, levels, noise)
        for name, library in libraries.items()
    }
    if "numba" not in absent:
        works["Numba"] = (
            functools.partial(_numba_heights, frames, travel, levels, noise)
            if full
            else functools.partial(_numba_onsets, frames, levels.light)
        )
    return works


def _in_tiles(tiles: tuple[int, int], frames: NDArray[Any], fill: Callable[[slice], None]) -> None:
    """Fill all rows in tiles; ``tiles`` is (cores, pixels of a tile)."""
    threads, pixels = tiles
    count = max(1, min(pixels // frames.shape[2], -(-frames.shape[1] // threads)))
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(fill, (slice(row, row + count) for row in range(0, frames.shape[1], count))))


def _onsets(
    tiles: tuple[int, int], library: Library, frames: NDArray[Any], _: object, levels: References, __: float
) -> NDArray[np.int32]:
    onset = np.empty(frames.shape[1:], np.int32)

    def fill(rows: slice) -> None:
        onset[rows] = _first_light(library, frames[:, rows], levels.of(rows).light, 1)

    _in_tiles(tiles, frames, fill)
    return onset


def _heights(
    tiles: tuple[int, int],
    library: Library,
    frames: NDArray[Any],
    travel: NDArray[np.float64],
    levels: References,
    noise: float,
) -> Maps:
    height, sigma = (np.full(frames.shape[1:], np.nan, np.float32) for _ in range(2))
    status = np.empty(height.shape, np.uint8)

    def fill(rows: slice) -> None:
        part, mine = frames[:, rows], levels.of(rows)
        onset = _first_light(library, part, mine.light, 2)
        height[rows], sigma[rows], status[rows] = _answer(part, onset, travel, mine, noise)

    _in_tiles(tiles, frames, fill)
    return {"height": height, "height_sigma": sigma, "status": status}


def _first_light(library: Library, frames: NDArray[Any], light: Levels, hold: int) -> NDArray[np.int32]:
    """Return the first frame of the first run of `hold` (1 or 2) light frames, or of a run at the end.

    It is -1 without a run. The library counts the frames in which a pixel is undecided.
    """
    shape = frames.shape[1:]
    less, count = library(light)
    undecided, few = np.full(shape, 255, np.uint8), np.zeros(shape, np.uint8)
    onset = np.zeros(shape, np.int32)
    for number, dark in enumerate(_dark_frames(frames, hold, less), 1):
        count(undecided, dark, few)
        if number % _COUNTABLE == 0 or number == len(frames):
            onset += few
            few[:] = 0
    onset[undecided != 0] = DARK
    return onset


def _dark_frames(frames: NDArray[Any], hold: int, less: Less) -> Iterator[Flags]:
    """Yield for each frame the mask of pixels where no run of `hold` light frames starts; it is reused."""
    dark, after = np.empty((2, *frames.shape[1:]), np.uint8)
    less(frames[0], dark)
    for frame in frames[1:]:
        less(frame, after)
        if hold == 2:
            np.bitwise_or(dark, after, out=dark)
        yield dark
        dark, after = after, dark
    yield dark


Less = Callable[[NDArray[Any], Flags], object]
Count = Callable[[Flags, Flags, Flags], None]
Library = Callable[[Levels], tuple[Less, Count]]
"""Returns two in-place functions for levels. `less` computes the mask (1 or 255) of samples below the levels.
`count` removes pixels outside a mask from the undecided pixels, and adds 1 to the counts of the others."""


def _numpy(light: Levels) -> tuple[Less, Count]:
    def count(undecided: Flags, dark: Flags, few: Flags) -> None:
        np.bitwise_and(undecided, dark, out=undecided)
        np.add(few, undecided, out=few)

    return lambda frame, out: np.less(frame, light, out=out.view(bool)), count


def _opencv(light: Levels) -> tuple[Less, Count]:
    import cv2

    level: Any = light if light.ndim else float(light)

    def count(undecided: Flags, dark: Flags, few: Flags) -> None:
        cv2.bitwise_and(undecided, dark, dst=undecided)
        cv2.add(few, cv2.min(undecided, 1.0), dst=few)  # type: ignore[call-overload]

    return lambda frame, out: cv2.compare(frame, level, cv2.CMP_LT, dst=out), count


def _torch(light: Levels) -> tuple[Less, Count]:
    import torch

    torch.set_num_threads(THREADS)
    tensor = torch.from_numpy
    level: Any = tensor(light) if light.ndim else light.item()

    def count(undecided: Flags, dark: Flags, few: Flags) -> None:
        tensor(undecided).bitwise_and_(tensor(dark))
        tensor(few).add_(tensor(undecided))

    return lambda frame, out: torch.lt(tensor(frame), level, out=tensor(out)), count


def _answer(
    frames: NDArray[Any],
    onset: NDArray[np.int32],
    travel: NDArray[np.float64],
    levels: References,
    noise: float,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]]:
    """Return height, sigma and status of onsets in NumPy: the full default, decision 2."""
    status = np.select([np.isnan(levels.level), onset == DARK, onset == 0], [0, 2, 3], 1).astype(np.uint8)
    height, sigma = (np.full(onset.shape, np.nan, np.float32) for _ in range(2))
    row, column = pixels = np.nonzero(status == 1)
    start, level, light = onset[pixels].astype(np.intp), levels.level[pixels], levels.light[pixels]
    sure = onset_sure(level, light, _CONFIDENT * noise)

    def last_below(bounds: NDArray[Any]) -> NDArray[np.intp]:
        """Return the last frames before the onsets with samples below some bounds, or the first frame."""
        frame, todo = start - 1, np.arange(len(start))
        while len(todo := todo[frame[todo] > 0]):
            todo = todo[frames[frame[todo], row[todo], column[todo]] >= bounds[todo]]
            frame[todo] -= 1
        return frame

    below, last_dark = last_below(sure), last_below(onset_near(level, levels.dark[pixels], sure))
    last, slack = len(frames) - 1, _PLATEAU * noise
    before, at, *later = (frames[np.minimum(start + k, last), row, column] for k in (-1, 0, 1, 2))
    height[pixels], sigma[pixels], _ = onset_heights(
        start, below, last_dark, frames[last_dark + 1, row, column], before, at, np.fmin(*later), level,
        levels.dark[pixels], _THRESHOLD, travel, noise, slack, slack * np.sqrt(2), True,
    )  # fmt: skip
    return height, sigma, status


def _numba_onsets(frames: NDArray[Any], light: Levels) -> NDArray[np.int32]:
    """Find onsets with Numba: tiles on all cores, frame by frame so that the inner loop is vectorised."""
    onset = np.empty(frames.shape[1:], np.int32)
    _numba_scan(1, whole=False)(frames.reshape(len(frames), -1), light[()], onset.reshape(-1))
    return onset


def _numba_heights(
    frames: NDArray[Any], travel: NDArray[np.float64], levels: References, noise: float
) -> Maps:
    shape = frames.shape[1:]
    maps = {"height": np.empty(shape, np.float32), "height_sigma": np.empty(shape, np.float32)}
    maps |= {"status": np.empty(shape, np.uint8)}
    run = _numba_scan(2, whole=True)
    flat = (values.reshape(-1) for values in (*levels, *maps.values()))
    run(frames.reshape(len(frames), -1), travel, *flat, noise)
    return maps


@functools.cache
def _numba_scan(hold: int, *, whole: bool) -> Any:  # noqa: C901  # to compile
    """Compile the search for onsets, with levels per pixel or one for all, and heights if `whole`."""
    import numba

    numba.set_num_threads(min(THREADS, numba.config.NUMBA_NUM_THREADS))

    @numba.njit
    def search(frames, first, end, light, onset):  # type: ignore[no-untyped-def]
        count, pixels = len(frames), end - first
        undecided, few = np.ones(pixels, np.uint8), np.zeros(pixels, np.uint8)
        onset[:] = 0
        for t in range(count):
            # Numba recognises slices of one row as contiguous, but not slices of all rows.
            now, then = frames[t, first:end], frames[min(t + hold, count) - 1, first:end]
            for p in range(pixels):
                sample = now[p] if hold == 1 else min(now[p], then[p])
                open_ = undecided[p] & np.uint8(sample < (light[p] if whole else light))
                undecided[p] = open_
                few[p] += open_
            if (t + 1) % _COUNTABLE == 0 or t + 1 == count:
                for p in range(pixels):
                    onset[p] += few[p]
                    few[p] = 0
        for p in range(pixels):
            if undecided[p]:
                onset[p] = -1

    @numba.njit(error_model="numpy")
    def answer(frames, pixel, start, travel, level, light, dark, noise):  # type: ignore[no-untyped-def]
        confident = level - np.float32(_CONFIDENT * noise)
        rise = level - dark
        span = rise / _THRESHOLD
        near = level - max(np.float32(0.25) * rise, np.float32(0))
        last_dark = start - 1
        while last_dark > 0 and (
            frames[last_dark, pixel] >= light
            or frames[last_dark, pixel] > confident
            or frames[last_dark, pixel] >= near
        ):
            last_dark -= 1
        below = start - 1
        while below > 0 and (frames[below, pixel] >= light or frames[below, pixel] > confident):
            below -= 1
        low, high = np.float64(frames[start - 1, pixel]), np.float64(frames[start, pixel])
        last = len(frames) - 1
        after = np.fmin(frames[min(start + 1, last), pixel], frames[min(start + 2, last), pixel])
        sudden_step = _PLATEAU * noise * math.sqrt(2)
        step = high - low
        from_dark = 2 - (low - dark) / max(_PLATEAU * noise, NEAR_PLATEAU * step)
        to_light = 2 - (after - high) / max(sudden_step, NEAR_PLATEAU * step)
        from_dark, to_light = min(max(from_dark, 0.0), 1.0), min(max(to_light, 0.0), 1.0)
        jumped = (
            last_dark + 1 < start and frames[last_dark + 1, pixel] >= after - rise / 8 and rise >= 34 * noise
        )
        end = last_dark + 1 if jumped else start
        fraction = (min(np.float64(level), high) - low) / step
        width = travel[end] - travel[end - 1]
        first, second, middle = (low - dark) / span - 0.5, (high - dark) / span - 0.5, _THRESHOLD - 0.5
        both = first * first + first * second + second * second
        off = fraction * BENT * (middle - second) * (middle + first + second) / (1 + BENT * both)
        rest = 1 - fraction
        line = (noise / step) ** 2 * (fraction * fraction + rest * rest) + off * off
        edge = from_dark * (1 - to_light) * rest * rest + to_light * (1 - from_dark) * fraction * fraction
        sudden = from_dark * to_light
        if jumped:
            sudden, edge = 1.0, 0.0
        spread = width * math.sqrt((1 - sudden) * line + edge / 6 + sudden / 12)
        hovers = not jumped and (step <= sudden_step or (start - 2 - below) * step > 2.5 * sudden_step)
        height = -(travel[end - 1] + width * (fraction + sudden * (0.5 - fraction)))
        return height, (travel[start] - travel[below]) / math.sqrt(12) if hovers else spread

    def onsets(frames, light, onset):  # type: ignore[no-untyped-def]
        for tile in numba.prange(-(-len(onset) // _NUMBA_TILE)):
            first, end = tile * _NUMBA_TILE, min(len(onset), (tile + 1) * _NUMBA_TILE)
            search(frames, first, end, light, onset[first:end])

    def heights(frames, travel, level, light, dark, height, sigma, status, noise):  # type: ignore[no-untyped-def]
        for tile in numba.prange(-(-len(status) // _NUMBA_TILE)):
            first, end = tile * _NUMBA_TILE, min(len(status), (tile + 1) * _NUMBA_TILE)
            onset = np.empty(end - first, np.int32)
            search(frames, first, end, light[first:end], onset)
            for p in range(first, end):
                start = onset[p - first]
                dead = np.isnan(level[p])
                status[p] = 0 if dead else 2 if start == -1 else 3 if start == 0 else 1
                if status[p] == 1:
                    height[p], sigma[p] = answer(frames, p, start, travel, level[p], light[p], dark[p], noise)
                else:
                    height[p], sigma[p] = np.nan, np.nan

    return numba.njit(parallel=True, error_model="numpy")(heights if whole else onsets)
