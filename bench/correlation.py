"""Correlation with a rotation's phase: the engine, the limits and NumPy and Numba on one stack."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.harness import (
    OURS,
    THREADS,
    Case,
    Cases,
    Row,
    Work,
    agree,
    check_memory,
    missing,
)
from mirrorskin.bench.limits import beside_limits, time_call
from mirrorskin.bench.scenes import STEPS, fill_turns, phases
from mirrorskin.engine import Correlator, correlate
from mirrorskin.engine.rotation.design_matrix import basis, fit_matrix
from mirrorskin.kernels.device import Device

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]
Counts = NDArray[np.uint8]
Sums = NDArray[np.int32]

_WINDOW, _QUICK = (64, 480, 640), (16, 48, 64)
_MAPS = 4 * 4  # bytes of a pixel: mean, cosine, sine and residual
_ROOM = 128  # bytes of a pixel for what all works keep
_UNITS = 2**17  # of a cosine in a peer's sums
_TILE = 1024  # pixels of Numba
_SAMPLES = 65_536  # of a tile of NumPy: more leave the cache, fewer pay for calls


def run_stack(name: str, shape: tuple[int, int, int], device: Device, quick: bool) -> Case:
    """Time the fit of a wave to a stack, the limits and the peers; their maps must be the same first.

    Bytes are those of the frames, each once, and of the four maps.
    """
    count, pixels = shape[0], math.prod(shape[1:])
    check_memory(name, (2 * count + _MAPS + _ROOM) * pixels)
    frames = np.empty(shape, np.uint8)
    fill_turns(frames)
    phase = phases(count)
    call = functools.partial(correlate, frames, phase, device=device)
    absent = missing("numba")
    peers: dict[str, Callable[[Counts, Doubles], Floats]] = {"NumPy": _numpy}
    peers |= {} if "numba" in absent else {"Numba": _numba}
    theirs: dict[str, Work] = {name: functools.partial(fit, frames, phase) for name, fit in peers.items()}

    def check(results: dict[str, Any]) -> None:
        for peer in theirs:
            _check(peer, results[peer], results[OURS])

    title = f"mean, cosine, sine and residual; {' x '.join(map(str, shape))} uint8"
    known: dict[str, Any] = {"frames": count, "peers": theirs, "check": check, "absent": absent}
    return time_call(name, title, call, (count + _MAPS) * pixels, device, quick, first="triad", **known)


def run_sliding(device: Device, quick: bool) -> Case:
    """Time a window of one turn that takes in frames one by one, and answers after each, once it is full.

    Bytes are, of each frame, its own, those of the window's frames, and of the four maps. The limits are
    those of as many bytes as one frame moves.
    """
    shape = _QUICK if quick else _WINDOW
    a_frame = (1 + STEPS + _MAPS) * math.prod(shape[1:])
    frames = np.empty(shape, np.uint8)
    fill_turns(frames)
    phase = phases(len(frames))
    correlator = Correlator(shape[1:], np.uint8, window=STEPS, device=device)

    def push_all() -> object:
        for k in range(len(frames)):
            correlator.push(frames[k : k + 1], phase=phase[k : k + 1])
            result = correlator.result() if k >= STEPS - 1 else None
        return result

    absent = missing("numba")
    works: dict[str, Work] = {OURS: push_all}
    if not absent:
        works["Numba"] = _Window(frames, phase).push_all

    def check(results: dict[str, Any]) -> None:
        if not absent:
            _check("Numba", results["Numba"], results[OURS])

    limits, measured = beside_limits(works, a_frame, device, quick, check, first="triad")
    rows = [Row(name, measured[name], len(frames) * a_frame, len(frames)) for name in works]
    title = f"one new frame into a window of {STEPS}, and its maps; {' x '.join(map(str, shape))} uint8"
    return Case("sliding", title, limits + rows, absent)


def _stack(name: str, shape: tuple[int, int, int]) -> Callable[[Device, bool], Case]:
    return lambda device, quick: run_stack(name, _QUICK if quick else shape, device, quick)


_SHAPES = {
    "correlate-uint8": (64, 1080, 1920),
    "correlate-turn": (STEPS, 1080, 1920),
    "correlate-4k": (STEPS, 2160, 3840),
}
CASES: Cases = {
    **{name: _stack(name, shape) for name, shape in _SHAPES.items()},
    "sliding": run_sliding,
}


def _check(name: str, theirs: Floats, ours: Any) -> None:
    """Compare a peer's fit, (4, H, W), map by map."""
    expected = {word: getattr(ours, word) for word in ("mean", "cosine", "sine", "residual")}
    near = dict.fromkeys(expected, 1e-5 * np.abs(ours.mean))
    agree(name, dict(zip(expected, theirs, strict=True)), expected, near)


class _Window:
    """Numba's window: a ring of frames, and sums of samples, their products with a wave, and squares."""

    def __init__(self, frames: Counts, phase: Doubles) -> None:
        self._frames = frames
        self._ring = np.zeros((STEPS, *frames.shape[1:]), np.uint8)
        self._sums = np.zeros((4, *frames.shape[1:]), np.int32)
        self._phase = phase[-STEPS:]
        rows = np.rint(basis(phase) * [1, _UNITS, _UNITS])
        self._rows = np.hstack([rows, np.roll(rows, STEPS, axis=0)]).astype(np.int32)

    def push_all(self) -> Floats:
        """Push a whole stack; return the last of the fits that the sums give after each frame."""
        slide, answer = _numba_kernels()[1:]
        sums = self._sums.reshape(4, -1)
        model, rounded = basis(self._phase), self._rows[-STEPS:, :3] / [1, _UNITS, _UNITS]
        solve, gram = np.linalg.inv(rounded.T @ model) / [1, _UNITS, _UNITS], model.T @ model
        for number, (frame, row) in enumerate(zip(self._frames, self._rows, strict=True)):
            gone = self._ring[number % STEPS]
            slide(sums, frame.reshape(-1), gone.reshape(-1), row)
            gone[:] = frame
            if number >= STEPS - 1:
                maps = np.empty(self._sums.shape, np.float32)
                answer(sums, solve, gram, 1 / (STEPS - 3), maps.reshape(4, -1))
        return maps


def _numpy(frames: Counts, phase: Doubles) -> Floats:
    """Fit tiles that stay in the cache, in single precision and in place."""
    maps, raw = np.empty((4, frames[0].size), np.float32), frames.reshape(len(frames), -1)
    fit, model = fit_matrix(phase).astype(np.float32), basis(phase)
    gram, size = (model.T @ model).astype(np.float32), _SAMPLES // len(frames)
    room = np.empty((len(frames), size), np.float32)
    for first in range(0, raw.shape[1], size):
        pixels = slice(first, first + size)
        reference = raw[0, pixels].astype(np.float32)
        # Small numbers, of whose squares no digit is lost.
        x = np.subtract(raw[:, pixels], reference, out=room[:, : len(reference)])
        wave = fit @ x
        left = np.einsum("kp,kp->p", x, x) - np.einsum("kp,kp->p", wave, gram @ wave)
        np.add(wave[0], reference, out=maps[0, pixels])
        maps[1:3, pixels] = wave[1:]
        np.sqrt(np.maximum(left, 0) / np.float32(len(frames) - 3), out=maps[3, pixels])
    return maps.reshape(4, *frames.shape[1:])


def _numba(frames: Counts, phase: Doubles) -> Floats:
    maps = np.empty((4, frames[0].size), np.float32)
    model = basis(phase)
    solve = np.linalg.inv(model.T @ model).astype(np.float32)
    _numba_kernels()[0](frames.reshape(len(frames), -1), model.T.astype(np.float32), solve, maps)
    return maps.reshape(4, *frames.shape[1:])


@functools.cache
def _numba_kernels() -> tuple[Any, Any, Any]:  # noqa: C901  # functions to compile
    """Compile all: tiles of pixels on all cores, frame by frame so that the inner loops are vector code.

    What is known of a tile's pixels lies in one array, at distances that are known to the compiler: of many
    arrays it would not know that they do not overlap, and make scalar code.
    """
    import numba

    numba.set_num_threads(min(THREADS, numba.config.NUMBA_NUM_THREADS))
    options: dict[str, Any] = {"fastmath": {"contract"}, "error_model": "numpy"}
    total, along, across, square, first_sample, room = (_TILE * k for k in range(6))

    @numba.njit(**options)
    def add_four(frames, k, first, end, model, work):  # type: ignore[no-untyped-def]
        one, two = frames[k, first:end], frames[k + 1, first:end]
        three, four = frames[k + 2, first:end], frames[k + 3, first:end]
        c1, c2, c3, c4 = model[1, k], model[1, k + 1], model[1, k + 2], model[1, k + 3]
        s1, s2, s3, s4 = model[2, k], model[2, k + 1], model[2, k + 2], model[2, k + 3]
        for p in range(end - first):
            reference = work[first_sample + p]
            a, b = np.float32(one[p]) - reference, np.float32(two[p]) - reference
            c, d = np.float32(three[p]) - reference, np.float32(four[p]) - reference
            work[total + p] += a + b + c + d
            work[along + p] += c1 * a + c2 * b + c3 * c + c4 * d
            work[across + p] += s1 * a + s2 * b + s3 * c + s4 * d
            work[square + p] += a * a + b * b + c * c + d * d

    @numba.njit(**options)
    def add_one(frame, cosine, sine, work):  # type: ignore[no-untyped-def]
        for p in range(len(frame)):
            x = np.float32(frame[p]) - work[first_sample + p]
            work[total + p] += x
            work[along + p] += cosine * x
            work[across + p] += sine * x
            work[square + p] += x * x

    @numba.njit(**options)
    def put(count, first, end, solve, work, maps):  # type: ignore[no-untyped-def]
        share = np.float32(1 / (count - 3))
        mean, cosine, sine, residual = maps[0], maps[1], maps[2], maps[3]
        for p in range(end - first):
            x, y, z = work[total + p], work[along + p], work[across + p]
            a = solve[0, 0] * x + solve[0, 1] * y + solve[0, 2] * z
            b = solve[1, 0] * x + solve[1, 1] * y + solve[1, 2] * z
            c = solve[2, 0] * x + solve[2, 1] * y + solve[2, 2] * z
            left = work[square + p] - a * x - b * y - c * z
            mean[first + p] = work[first_sample + p] + a
            cosine[first + p], sine[first + p] = b, c
            residual[first + p] = math.sqrt(max(left, np.float32(0)) * share)

    def correlate(frames, model, solve, maps):  # type: ignore[no-untyped-def]
        for tile in numba.prange(-(-frames.shape[1] // _TILE)):
            first, end = tile * _TILE, min(frames.shape[1], (tile + 1) * _TILE)
            work = np.zeros(room, np.float32)
            work[first_sample : first_sample + end - first] = frames[0, first:end]
            whole = len(frames) // 4 * 4
            for k in range(0, whole, 4):
                add_four(frames, k, first, end, model, work)
            for k in range(whole, len(frames)):
                add_one(frames[k, first:end], model[1, k], model[2, k], work)
            put(len(frames), first, end, solve, work, maps)

    @numba.njit
    def move(total, cosine, sine, square, now, gone, rows):  # type: ignore[no-untyped-def]
        # Two at a time, whose overlap the compiler still checks.
        for p in range(len(now)):
            come, go = np.int32(now[p]), np.int32(gone[p])
            total[p] += np.int32(rows[0] * come - rows[3] * go)
            square[p] += np.int32(come * come - go * go)
        for p in range(len(now)):
            come, go = np.int32(now[p]), np.int32(gone[p])
            cosine[p] += np.int32(rows[1] * come - rows[4] * go)
            sine[p] += np.int32(rows[2] * come - rows[5] * go)

    def slide(sums, now, gone, rows):  # type: ignore[no-untyped-def]
        for tile in numba.prange(-(-len(now) // _TILE)):
            first, end = tile * _TILE, min(len(now), (tile + 1) * _TILE)
            mine = sums[0, first:end], sums[1, first:end], sums[2, first:end], sums[3, first:end]
            move(*mine, now[first:end], gone[first:end], rows)

    def answer(sums, solve, gram, share, maps):  # type: ignore[no-untyped-def]
        for p in numba.prange(sums.shape[1]):
            x, y, z = sums[0, p], sums[1, p], sums[2, p]
            a = solve[0, 0] * x + solve[0, 1] * y + solve[0, 2] * z
            b = solve[1, 0] * x + solve[1, 1] * y + solve[1, 2] * z
            c = solve[2, 0] * x + solve[2, 1] * y + solve[2, 2] * z
            explained = a * a * gram[0, 0] + b * b * gram[1, 1] + c * c * gram[2, 2]
            explained += 2 * (a * b * gram[0, 1] + a * c * gram[0, 2] + b * c * gram[1, 2])
            maps[0, p], maps[1, p], maps[2, p] = a, b, c
            maps[3, p] = math.sqrt(max(sums[3, p] - explained, 0.0) * share)

    compiled = [numba.njit(parallel=True, **options)(kernel) for kernel in (correlate, answer)]
    return compiled[0], numba.njit(parallel=True)(slide), compiled[1]
