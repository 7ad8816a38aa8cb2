"""Correlation with the phase of a rotation: the engine, the limits, NumPy and Numba on one stack."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.suite.harness import Cases, agree, check_memory, missing, time_call
from mirrorskin.cli.commands.bench.records import THREADS, Case
from mirrorskin.cli.commands.bench.timing import OURS
from mirrorskin.engine import correlate
from mirrorskin.engine.correlation.design_matrix import basis, fit_matrix
from mirrorskin.evaluation.scenes.inputs import STEPS, fill_turns, phases
from mirrorskin.kernels.device import Device

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]
Counts = NDArray[np.uint8]

_QUICK = (16, 48, 64)
_MAPS = 4 * 4  # bytes per pixel: mean, cosine, sine and residual
_WORKING = 128  # bytes per pixel of working memory of all works
_TILE = 1024  # pixels per tile for Numba
_SAMPLES = 65_536  # samples per tile for NumPy: more exceed the cache, fewer increase the overhead of calls


def run_stack(name: str, shape: tuple[int, int, int], device: Device, quick: bool) -> Case:
    """Time the fit of a wave to a stack, the limits and the peers, after checking that their maps agree.

    The bytes of frames and maps are counted once.
    """
    shape = _QUICK if quick else shape
    count, pixels = shape[0], math.prod(shape[1:])
    check_memory(name, (2 * count + _MAPS + _WORKING) * pixels)
    frames = np.empty(shape, np.uint8)
    fill_turns(frames)
    phase = phases(count)
    call = functools.partial(correlate, frames, phase, device=device)
    absent = missing("numba")
    fits: dict[str, Callable[[Counts, Doubles], Floats]] = {"NumPy": _numpy}
    fits |= {} if "numba" in absent else {"Numba": fit_with_numba}
    peers = {peer: functools.partial(fit, frames, phase) for peer, fit in fits.items()}

    def check(results: dict[str, Any]) -> None:
        ours = results[OURS]
        expected = {word: getattr(ours, word) for word in ("mean", "cosine", "sine", "residual")}
        near = dict.fromkeys(expected, 1e-5 * np.abs(ours.mean))
        for peer in peers:
            agree(peer, dict(zip(expected, results[peer], strict=True)), expected, near)

    title = f"mean, cosine, sine and residual; {' x '.join(map(str, shape))} uint8"
    moved = (count + _MAPS) * pixels
    return time_call(
        name,
        title,
        call,
        moved,
        device,
        quick,
        frames=count,
        peers=peers,
        check=check,
        absent=absent,
        first="triad",
    )


CASES: Cases = {
    name: functools.partial(run_stack, name, shape)
    for name, shape in {
        "correlate-uint8": (64, 1080, 1920),
        "correlate-turn": (STEPS, 1080, 1920),
        "correlate-4k": (STEPS, 2160, 3840),
    }.items()
}


def _numpy(frames: Counts, phase: Doubles) -> Floats:
    """Fit tiles that fit into the cache, in single precision and in place."""
    maps, raw = np.empty((4, frames[0].size), np.float32), frames.reshape(len(frames), -1)
    fit, model = fit_matrix(phase).astype(np.float32), basis(phase)
    gram, size = (model.T @ model).astype(np.float32), _SAMPLES // len(frames)
    scratch = np.empty((len(frames), size), np.float32)
    for first in range(0, raw.shape[1], size):
        pixels = slice(first, first + size)
        reference = raw[0, pixels].astype(np.float32)
        # Differences are small, so that their squares are exact.
        x = np.subtract(raw[:, pixels], reference, out=scratch[:, : len(reference)])
        wave = fit @ x
        squares = np.einsum("kp,kp->p", x, x) - np.einsum("kp,kp->p", wave, gram @ wave)
        np.add(wave[0], reference, out=maps[0, pixels])
        maps[1:3, pixels] = wave[1:]
        np.sqrt(np.maximum(squares, 0) / np.float32(len(frames) - 3), out=maps[3, pixels])
    return maps.reshape(4, *frames.shape[1:])


def fit_with_numba(frames: Counts, phase: Doubles) -> Floats:
    """Return mean, cosine, sine and residual, (4, H, W), on all cores."""
    maps = np.empty((4, frames[0].size), np.float32)
    model = basis(phase)
    solve = np.linalg.inv(model.T @ model).astype(np.float32)
    _numba_kernel()(frames.reshape(len(frames), -1), model.T.astype(np.float32), solve, maps)
    return maps.reshape(4, *frames.shape[1:])


@functools.cache
def _numba_kernel() -> Any:  # noqa: C901  # functions to compile
    """Compile the fit: tiles of pixels on all cores, frame by frame so that inner loops are vectorised.

    The sums of a tile are in one array, at constant offsets. With several arrays the compiler would have to
    assume that they overlap, and emit scalar code.
    """
    import numba

    numba.set_num_threads(min(THREADS, numba.config.NUMBA_NUM_THREADS))
    options: dict[str, Any] = {"fastmath": {"contract"}, "error_model": "numpy"}
    total, along, across, square, first_sample, size = (_TILE * k for k in range(6))

    @numba.njit(**options)
    def add_four(frames, k, first, end, model, work):  # type: ignore[no-untyped-def]
        first_row, two = frames[k, first:end], frames[k + 1, first:end]
        three, four = frames[k + 2, first:end], frames[k + 3, first:end]
        c1, c2, c3, c4 = model[1, k], model[1, k + 1], model[1, k + 2], model[1, k + 3]
        s1, s2, s3, s4 = model[2, k], model[2, k + 1], model[2, k + 2], model[2, k + 3]
        for p in range(end - first):
            reference = work[first_sample + p]
            a, b = np.float32(first_row[p]) - reference, np.float32(two[p]) - reference
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
        scale = np.float32(1 / (count - 3))
        mean, cosine, sine, residual = maps[0], maps[1], maps[2], maps[3]
        for p in range(end - first):
            x, y, z = work[total + p], work[along + p], work[across + p]
            a = solve[0, 0] * x + solve[0, 1] * y + solve[0, 2] * z
            b = solve[1, 0] * x + solve[1, 1] * y + solve[1, 2] * z
            c = solve[2, 0] * x + solve[2, 1] * y + solve[2, 2] * z
            squares = work[square + p] - a * x - b * y - c * z
            mean[first + p] = work[first_sample + p] + a
            cosine[first + p], sine[first + p] = b, c
            residual[first + p] = math.sqrt(max(squares, np.float32(0)) * scale)

    def correlate(frames, model, solve, maps):  # type: ignore[no-untyped-def]
        for tile in numba.prange(-(-frames.shape[1] // _TILE)):
            first, end = tile * _TILE, min(frames.shape[1], (tile + 1) * _TILE)
            work = np.zeros(size, np.float32)
            work[first_sample : first_sample + end - first] = frames[0, first:end]
            whole = len(frames) // 4 * 4
            for k in range(0, whole, 4):
                add_four(frames, k, first, end, model, work)
            for k in range(whole, len(frames)):
                add_one(frames[k, first:end], model[1, k], model[2, k], work)
            put(len(frames), first, end, solve, work, maps)

    return numba.njit(parallel=True, **options)(correlate)
