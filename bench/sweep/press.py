"""What a press goes through: ``onset.cl`` and ``changepoint.cl``."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.stacks import LEVELS, fill, noise_of, references
from mirrorskin.bench.sweep.sweep import FRAME_TYPES, Family, Job, Shape, agree, run_kernel
from mirrorskin.engine import ChangePointSearch, Onset, OnsetSearch
from mirrorskin.engine.frames import reference_maps, reference_pair
from mirrorskin.engine.streaming import push_block
from mirrorskin.io import Block
from mirrorskin.kernels import changepoint, onset
from mirrorskin.kernels.changepoint import DECIDED, SLOTS, UNIT
from mirrorskin.kernels.device import Device

_THRESHOLD, _HOLD = 0.5, 2
_EVIDENCE = 12.0  # log of how much likelier a change must be
_FEW_PIXELS = 400_000  # up to which heights are told: arithmetic of a microsecond each, whatever the size
_SCAN, _CUSUM, _SPLIT = 2, 10, 9  # operations of a sample: see `counted` below
_HYPOTHESES, _HYPOTHESIS = 351, 30  # about a change, and operations of each
_SURELY, _PLATEAU = 6.0, 3.0  # sigmas from the level that are surely dark, and on a plateau

Maps = tuple[NDArray[Any], NDArray[Any], NDArray[Any]]


def _make_onset(device: Device, shape: Shape, kind: str, count: int) -> dict[str, Job]:
    """Return the scan of a press with references of each pixel, and the scan and its answers."""
    dtype, low, high = np.dtype(kind), *references(shape, np.dtype(kind))
    search = OnsetSearch(
        shape,
        dtype,
        dark=low,
        bright=high,
        noise=noise_of(dtype),
        device=device,
        memory_limit=_twice(shape, dtype, count),
    )
    frames, block = _fill(search, count)

    def scan() -> None:
        search.reset()
        push_block(search, block)

    def check() -> None:
        scan()
        expected = _refer_onset(frames, low, high)
        _compare("onset_scan", search.result(), expected, 0.0, 1e-5)

    return {"onset_scan": Job(run_kernel(device, scan), frames.nbytes, check, count, _SCAN * frames.size)}


def _refer_onset(frames: NDArray[Any], dark: NDArray[Any], bright: NDArray[Any]) -> Maps:
    """Return height, sigma and status of a stack by the reference, (H, W) each."""
    shape, dtype = frames.shape[1:], frames.dtype
    noise = noise_of(dtype)
    low, high = (one.ravel() for one in reference_maps(dark, bright, (shape[0], shape[1]), dtype))
    level, plateau, light = onset.onset_levels(high, low, _THRESHOLD - 1e-12, dtype)
    sure = onset.onset_sure(level, light, _SURELY * noise)
    begin = np.where(np.isnan(level), onset.INVALID, onset.DARK).astype(np.int32)
    below, samples = np.zeros_like(begin), np.zeros((4, begin.size), dtype)
    flat = frames.reshape(len(frames), -1)
    onset.onset_scan(flat, 0, _HOLD, light, sure, begin, below, *samples)
    known = begin, below, samples[1], samples[2], samples[3], level, plateau, _travel(len(frames))
    maps = onset.onset_heights(*known, noise, _PLATEAU * noise, _PLATEAU * np.sqrt(2) * noise, True)
    return _as_maps(maps, frames)


def _make_known(device: Device, shape: Shape, kind: str, count: int) -> dict[str, Job]:
    """Return the cumulative sum between known levels, and with it the answers."""
    dtype, (low, high) = np.dtype(kind), LEVELS[kind]
    noise = noise_of(dtype)
    search = ChangePointSearch(
        shape,
        dtype,
        dark=low,
        bright=high,
        noise=noise,
        device=device,
        memory_limit=_twice(shape, dtype, count),
    )
    frames, block = _fill(search, count)

    def scan() -> None:
        search.reset()
        push_block(search, block)

    def check() -> None:
        scan()
        expected = _refer_known(frames)
        _compare("changepoint_scan", search.result(), expected, 0.01, 0.02)

    work, operations = run_kernel(device, scan), _CUSUM * frames.size
    jobs = {"changepoint_scan": Job(work, frames.nbytes, check, count, operations)}
    if shape[0] * shape[1] <= _FEW_PIXELS:
        operations = shape[0] * shape[1] * _HYPOTHESES * _HYPOTHESIS
        moved = _answer_bytes(shape, dtype)
        jobs["changepoint_heights"] = Job(search.result, moved, lambda: None, 0, operations)
    return jobs


def _make_unknown(device: Device, shape: Shape, kind: str, count: int) -> dict[str, Job]:
    """Return the two passes over a press between unknown levels."""
    dtype = np.dtype(kind)
    search = ChangePointSearch(
        shape, dtype, noise=noise_of(dtype), device=device, memory_limit=_twice(shape, dtype, count)
    )
    frames, block = _fill(search, count)
    np.nan_to_num(frames, copy=False)

    def passes() -> None:
        search.reset()
        push_block(search, block)
        search.start_second_pass()
        push_block(search, block)

    def check() -> None:
        passes()
        expected = _refer_unknown(frames)
        _compare("changepoint_split", search.result(), expected, 0.01, 0.02)

    work = run_kernel(device, passes)
    return {"changepoint_sum and _split": Job(work, 2 * frames.nbytes, check, count, _SPLIT * frames.size)}


def _refer_known(frames: NDArray[Any]) -> Maps:
    """Return height, sigma and status of a stack between known levels by the reference, (H, W) each."""
    dtype, noise, flat = frames.dtype, noise_of(frames.dtype), frames.reshape(len(frames), -1)
    shape = frames.shape[1], frames.shape[2]
    low, high = (one.ravel().astype(np.float32) for one in reference_pair(*LEVELS[dtype.name], shape, dtype))
    gain, quiet = (1 / (high - low)).astype(np.float32), np.float32(_EVIDENCE * noise**2)
    start, excess, below, since = np.zeros((4, low.size), np.int32)
    ring, level = np.zeros((SLOTS, low.size), dtype), round(_THRESHOLD * UNIT)
    least = _HOLD * (UNIT - level)
    changepoint.changepoint_scan(flat, 0, level, least, quiet, low, gain, start, excess, below, ring)
    known = start, excess, below, since, low, gain, ring
    return _as_maps(
        changepoint.changepoint_heights(*known, _travel(len(frames)), noise, quiet, _THRESHOLD, False), frames
    )


def _refer_unknown(frames: NDArray[Any]) -> Maps:
    """Return height, sigma and status of a stack between unknown levels by the reference, (H, W) each."""
    noise, count, flat = noise_of(frames.dtype), len(frames), frames.reshape(len(frames), -1)
    total = np.zeros(flat.shape[1])
    changepoint.changepoint_sum(flat, total)
    mean, split, weight = total / count, np.arange(1.0, count), np.zeros(count + 1, np.float32)
    weight[1:-1] = 1 / np.sqrt(split * (count - split))
    start, since = np.zeros((2, mean.size), np.int32)
    score, ring = np.zeros(mean.size, np.float32), np.zeros((SLOTS, mean.size), frames.dtype)
    changepoint.changepoint_split(flat, 0, mean, weight, np.zeros_like(mean), start, since, score, ring)
    changed = score.astype(float) ** 2 * count / 2 > (_EVIDENCE + np.log(count)) * noise**2
    before = np.where(changed, start, 1)
    rest = np.sqrt((count - before) / before)
    dark = np.where(changed, mean - score * rest, 0).astype(np.float32)
    gain = (1 / np.where(changed, score * (rest + 1 / rest), 1)).astype(np.float32)
    excess, quiet = np.where(changed, DECIDED, 0).astype(np.int32), np.float32(_EVIDENCE * noise**2)
    known = start, excess, start, since, dark, gain, ring
    return _as_maps(
        changepoint.changepoint_heights(*known, _travel(len(frames)), noise, quiet, _THRESHOLD, True), frames
    )


def _compare(what: str, found: Onset, expected: Maps, near: float, sure: float) -> None:
    """Compare status, heights within so many sigmas and rounding, and sigmas within a share of themselves."""
    height, sigma, status = expected
    agree(f"{what}, status", found.status, status)
    agree(f"{what}, height", found.height, height, near * sigma + 1e-6)
    agree(f"{what}, sigma", found.sigma, sigma, sure * np.abs(sigma) + 1e-7)


def _fill(search: OnsetSearch | ChangePointSearch, count: int) -> tuple[NDArray[Any], Block]:
    """Make a press in a search's room; return its frames, and them with their travel."""
    frames = search.room[:count]
    fill(frames, "press")
    return frames, Block(frames, 0, travel=_travel(count))


def _travel(count: int) -> NDArray[np.float64]:
    return np.arange(count, dtype=np.float64) * 0.05


def _twice(shape: Shape, dtype: np.dtype[Any], count: int) -> int:
    """Return the limit of memory with which a stack fits into a search's room."""
    return 2 * count * shape[0] * shape[1] * dtype.itemsize


def _answer_bytes(shape: Shape, dtype: np.dtype[Any]) -> int:
    """Return the bytes of the samples about the changes, of their maps, and of the answers."""
    return shape[0] * shape[1] * (SLOTS * dtype.itemsize + 6 * 4 + 2 * 4 + 1)


def _as_maps(parts: tuple[NDArray[Any], ...], frames: NDArray[Any]) -> Maps:
    height, sigma, status = (one.reshape(frames.shape[1:]) for one in parts)
    return height, sigma, status


ONSET = Family(
    "sweep-onset",
    "onset.cl: a press with references of each pixel, sub-frame",
    _make_onset,
    FRAME_TYPES,
    "read",
    80,
    f"bytes are those of the frames, each once; operations: {_SCAN} a sample, a comparison and the bit that "
    "it leaves, of which a lane does four at once with uint8 and two with uint16",
)
KNOWN = Family(
    "sweep-changepoint",
    "changepoint.cl: a press between known levels, and the heights of its changes",
    _make_known,
    FRAME_TYPES,
    "read",
    140,
    "bytes are those of the frames, each once; of heights those of the 25 samples about a change, its maps "
    "and the answers, which are copied to the host as well, and are told in the smallest size only; "
    f"operations: {_CUSUM} a sample, and {_HYPOTHESES} hypotheses of {_HYPOTHESIS} about each change",
)
UNKNOWN = Family(
    "sweep-changepoint-unknown",
    "changepoint.cl: a press between unknown levels, in two passes",
    _make_unknown,
    FRAME_TYPES,
    "read",
    140,
    f"bytes are those of the frames, each twice; operations: {_SPLIT} a sample, pairs of floats included",
)
