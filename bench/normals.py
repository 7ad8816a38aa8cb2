"""Normals of one turn of an axial rotation: the engine, the limits, and Numba with the same arithmetic.

Arithmetic binds: the limit beside memory is the same kernel on a stack that stays in the cache.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.harness import (
    FIRST,
    OURS,
    ROUNDS,
    THREADS,
    Case,
    Cases,
    Row,
    Work,
    agree,
    call_targets,
    check_memory,
    missing,
    pusher,
    take_turns,
)
from mirrorskin.bench.limits import Arithmetic, Limits
from mirrorskin.bench.scenes import SCALES, STEPS, TILT, fill_turns, phases, turn_noise
from mirrorskin.engine import NormalEstimator, estimate_normals, free_memory
from mirrorskin.engine.rotation.design_matrix import fit_matrix
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.normals import Answer, Variance, contact_limits, normals_exact
from mirrorskin.kernels.normals import Limits as ContactLimits

Maps = dict[str, NDArray[Any]]

CACHED = f"{OURS}, in the cache"
NORMAL = 3 * 4 + 4 + 1 + 4  # bytes of a pixel: normal, sigma, contact and mean

_QUICK = (48, 64)
_ROOM = 160  # bytes of a pixel for what all works keep
_SMALL = (256, 1024)  # rows and columns of a stack that stays in the cache, and is no trifle to launch
_TILE = 256  # pixels of Numba
_LOOKS = 2  # Gauss-Newton steps
_ODD = np.uint8(2)  # in Numba's contact map for now: a sample is clipped or missing
_REACH = 0.25  # longest step, radians
_LEAST, _LEVEL = np.float32(1e-12), np.float32(1e-20)  # squares of sines: divided by, and without an azimuth
_ARCSINE = tuple(np.float32(term) for term in (15 / 336, 3 / 40, 1 / 6))  # of the powers 7, 5 and 3


@dataclass(frozen=True, slots=True)
class Turn:
    """One turn of frames of some shape and type."""

    shape: tuple[int, int]
    dtype: np.dtype[Any]

    @property
    def bytes(self) -> int:
        """Of the frames, each once, and of the maps that are wanted."""
        return math.prod(self.shape) * (STEPS * self.dtype.itemsize + NORMAL)

    @property
    def options(self) -> dict[str, Any]:
        """What is known before the frames are looked at, as the engine takes it."""
        offset, gain, _ = SCALES[self.dtype.name]
        return {"tilt": TILT, "gain": gain, "offset": offset, "noise": turn_noise(self.dtype)}

    @property
    def ends(self) -> tuple[float, float]:
        """Counts up to which and from which on samples are clipped."""
        return (0.0, float(np.iinfo(self.dtype).max)) if self.dtype.kind == "u" else (-np.inf, np.inf)

    def estimator(self, device: Device) -> NormalEstimator:
        """Return the engine's estimator of such turns, with room for one turn and a frame."""
        return NormalEstimator(
            self.shape, self.dtype, longest=STEPS, device=device, memory_limit=0, **self.options
        )


def run_normals(name: str, turn: Turn, device: Device, rounds: int) -> Case:
    """Time normals, the limits and Numba on one stack; their maps must be the same first."""
    pixels = math.prod(turn.shape)
    check_memory(name, 2 * turn.bytes + _ROOM * pixels)
    frames = np.empty((STEPS, *turn.shape), turn.dtype)
    fill_turns(frames)
    call = functools.partial(estimate_normals, frames, phases(STEPS), device=device, **turn.options)
    small = Turn(_SMALL if pixels > math.prod(_SMALL) else turn.shape, turn.dtype)
    repeats = -(-pixels // math.prod(small.shape))
    push = kernel_alone(small, device)

    def cached() -> None:
        for _ in range(repeats):
            push()

    absent = missing("numba")
    theirs: dict[str, Work] = {} if absent else {"Numba": functools.partial(_numba, frames, turn)}

    def check(results: dict[str, Any]) -> None:
        for peer in theirs:
            _check(peer, results[OURS], results[peer], frames, turn)

    limits, arithmetic = Limits(device, turn.bytes), Arithmetic(device, pixels)
    works: dict[str, Work] = {**limits.works(), **arithmetic.works(), CACHED: cached}
    works |= {OURS: call, FIRST: call, **theirs}
    measured = take_turns(works, rounds, device.profile, check, {FIRST: free_memory})
    # Of short runs, the host's clock measures what calls cost: the device's account of kernels stands for it.
    inside = replace(measured[CACHED], wall=measured[CACHED].device["kernel"])
    rows = [*limits.rows(measured, first="triad"), arithmetic.row(measured)]
    rows.append(Row(CACHED, inside, repeats * small.bytes, repeats * STEPS))
    rows += [Row(one, measured[one], turn.bytes, STEPS) for one in (OURS, FIRST, *theirs)]
    shape = " x ".join(map(str, (STEPS, *turn.shape)))
    title = f"exact method to normals, sigma, contact and mean; {shape} {turn.dtype.name}"
    notes = _notes(turn, {row.name: row for row in rows})
    return Case(name, title, rows, absent, notes, call_targets(rows) if rounds > 1 else ())


def kernel_alone(turn: Turn, device: Device) -> Work:
    """Return a work whose maps stay where they are: a turn that is over, because the next one begins."""
    estimator = turn.estimator(device)
    frames = estimator.room[: STEPS + 1]
    fill_turns(frames[:STEPS])
    frames[STEPS] = frames[0]
    return pusher(estimator, frames, phase=phases(STEPS + 1))


def _notes(turn: Turn, rows: dict[str, Row]) -> tuple[str, ...]:
    """Say which limit binds."""
    a_pixel = turn.bytes / math.prod(turn.shape)
    memory, arithmetic, ours = (
        rows[name].kernel_bandwidth / a_pixel for name in ("triad limit", CACHED, OURS)
    )
    least, binds = min((memory, "memory"), (arithmetic, "arithmetic"))
    rate = rows["multiply-add limit"].operations / rows["multiply-add limit"].measured.kernel
    return (
        f"{a_pixel:.0f} bytes a pixel: memory (triad) would do {memory / 1e6:.0f} Mpixel/s, "
        f"arithmetic (the same kernel on a stack in the cache) {arithmetic / 1e6:.0f}",
        f"{binds} binds: the kernel reaches {100 * ours / least:.0f} % of that limit",
        f"at most {rate / 1e9:.0f} G multiply-adds/s: {rate / arithmetic:.0f} in a pixel's time in the cache",
    )


def _check(name: str, ours: Any, theirs: Maps, frames: NDArray[Any], turn: Turn) -> None:
    """Compare maps of one turn.

    Normals must agree within a hundredth of their standard error, out of contact within 1e-3; standard errors
    within 1e-3 of themselves, means within 1e-5. Contact may differ where limits that are one per cent wider
    or narrower would change it. One pixel in 100 000 is spared: where a normal meets the axis, rounding
    decides which way a sample pulls.
    """
    contact, spared = ours.contact.copy(), ours.contact.size // 100_000
    doubtful = np.flatnonzero(contact != theirs["contact"])
    if len(doubtful):
        wide, narrow = (reference(frames, turn, doubtful, slack).contact for slack in (1.01, 0.99))
        doubtful = doubtful[wide != narrow]
        contact.flat[doubtful] = theirs["contact"].flat[doubtful]
    near = np.where(ours.contact == 1, 0.01 * ours.sigma, 1e-3)
    limits = {"vectors": near[..., np.newaxis], "sigma": 1e-3 * ours.sigma, "mean": 1e-5 * np.abs(ours.mean)}
    expected = {"vectors": ours.vectors, "sigma": ours.sigma, "contact": contact, "mean": ours.mean}
    agree(name, theirs, expected, limits, spared)


def reference(frames: NDArray[Any], turn: Turn, pixels: NDArray[np.intp], slack: float = 1.0) -> Answer:
    """Answer some pixels by the kernel's NumPy reference; limits of contact are wider by a factor."""
    phase = phases(STEPS)
    table = np.stack([np.cos(phase), np.sin(phase), np.ones_like(phase), *fit_matrix(phase)])
    known = turn.options
    scale = np.array([known["offset"], 1 / known["gain"], -np.inf, np.inf])
    noise, model, still, wild, rest = contact_limits(STEPS - 3, TILT)
    limits = ContactLimits(slack * noise, slack * model, still / slack, slack * wild, rest / slack)
    samples = frames.reshape(len(frames), -1)[:, pixels]
    return normals_exact(samples, table, scale, TILT, Variance(known["noise"] ** 2, 0.0, 0.0), limits)


def _numba(frames: NDArray[Any], turn: Turn) -> Maps:
    """Compute the maps with Numba; the few clipped or missing samples by the reference."""
    pixels, known, phase = math.prod(turn.shape), turn.options, phases(STEPS)
    flat = {"vectors": np.empty((pixels, 3), np.float32), "sigma": np.empty(pixels, np.float32)}
    flat |= {"contact": np.empty(pixels, np.uint8), "mean": np.empty(pixels, np.float32)}
    numbers = known["offset"], 1 / known["gain"], np.cos(TILT), np.sin(TILT), *turn.ends
    limits, error = contact_limits(STEPS - 3, TILT), known["noise"] / known["gain"]
    ends = TILT, error, limits.noise * error**2 + limits.model, limits.still, limits.most, limits.rest
    _numba_normals()(
        frames.reshape(len(frames), -1),
        fit_matrix(phase).astype(np.float32),
        np.stack([np.cos(phase), np.sin(phase)]).astype(np.float32),
        tuple(np.float32(number) for number in numbers),
        tuple(np.float32(number) for number in ends),
        *flat.values(),
    )
    if len(odd := np.flatnonzero(flat["contact"] == _ODD)):
        found = reference(frames, turn, odd)
        for word, values in flat.items():
            values[odd] = getattr(found, word)
    return {word: values.reshape(*turn.shape, *values.shape[1:]) for word, values in flat.items()}


@functools.cache
def _numba_normals() -> Any:  # noqa: C901  # functions to compile
    """Compile tiles of pixels on all cores, each frame by frame so that the inner loops are vector code.

    All that is known of a tile's pixels lies in one array, at distances that are known to the compiler: of
    many arrays it would not know that they do not overlap, and make scalar code.
    """
    import numba

    numba.set_num_threads(min(THREADS, numba.config.NUMBA_NUM_THREADS))
    options: dict[str, Any] = {"fastmath": {"contract"}, "error_model": "numpy"}
    jit = numba.njit(**options)
    c1, c2, c3, c4, c5, c6 = (np.float32((-1) ** k / math.factorial(2 * k)) for k in range(1, 7))
    s1, s2, s3, s4, s5, s6 = (np.float32((-1) ** k / math.factorial(2 * k + 1)) for k in range(1, 7))
    a7, a5, a3 = _ARCSINE
    zero, one, three, nan, far = (np.float32(number) for number in (0, 1, 3, np.nan, _REACH**2))
    # Where in the array what is: the mean; the direction; its normal equations.
    mean_, odd_, sigma_, contact_, x_, y_, z_, ct_, st_, cp_, sp_ = (_TILE * k for k in range(11))
    m11_, m12_, b1_, b2_, m13_, m23_, m33_, b3_, square_, room = (_TILE * k for k in range(11, 21))

    @jit
    def take_in(frames, first, end, fit, known, trig, work):  # type: ignore[no-untyped-def]
        """Find cosine and sine of the zenith of each sample, their wave, and the mean of the samples."""
        offset, per_count, upright, lean, low, high = known
        slope = -upright / lean
        for k in range(len(frames)):
            # Cut from a whole row: of a part of all rows, Numba does not know that samples lie side by side.
            raw, level, along, across = frames[k, first:end], fit[0, k], slope * fit[1, k], slope * fit[2, k]
            cosines, sines = trig[0, k], trig[1, k]
            for p in range(end - first):
                count = np.float32(raw[p])
                t = (count - offset) * per_count
                y = t * t
                cosine = one + y * (c1 + y * (c2 + y * (c3 + y * (c4 + y * (c5 + y * c6)))))
                sine = one + y * (s1 + y * (s2 + y * (s3 + y * (s4 + y * (s5 + y * s6)))))
                cosines[p], sines[p] = cosine, t * sine
                work[mean_ + p] += level * count
                work[x_ + p] += along * cosine
                work[y_ + p] += across * cosine
                work[z_ + p] += level * cosine
                work[odd_ + p] += zero if (count > low) & (count < high) else one

    @jit
    def aim(pixels, work):  # type: ignore[no-untyped-def]
        """Find cosines and sines of zenith and azimuth of a vector, and forget the sums."""
        for p in range(pixels):
            x, y, z = work[x_ + p], work[y_ + p], work[z_ + p]
            flat = x * x + y * y
            level = flat < _LEVEL
            across, scale = one / math.sqrt(one if level else flat), one / math.sqrt(flat + z * z)
            work[ct_ + p], work[st_ + p] = z * scale, flat * across * scale
            work[cp_ + p], work[sp_ + p] = one if level else x * across, zero if level else y * across
        for p in range(m11_, room):
            work[p] = zero

    def make_look(last: bool) -> Any:
        def look(pixels, phase, known, trig, work):  # type: ignore[no-untyped-def]
            """Compare the samples with a direction; at last with the tilt left free as well."""
            upright, lean = known[2], known[3]
            for k in range(phase.shape[1]):
                ca, sa = phase[0, k], phase[1, k]
                cosines, sines = trig[0, k], trig[1, k]
                for p in range(pixels):
                    ct, st, cp, sp = work[ct_ + p], work[st_ + p], work[cp_ + p], work[sp_ + p]
                    near, beside = cp * ca + sp * sa, cp * sa - sp * ca
                    by_along, by_across = st * upright + ct * lean * near, lean * beside
                    cosine = ct * upright - st * lean * near
                    square = by_along * by_along + by_across * by_across
                    square = square if square > _LEAST else _LEAST
                    inverse = one / math.sqrt(square)
                    # The sine of by how much the sample's angle is larger than expected.
                    x = sines[p] * cosine - cosines[p] * square * inverse
                    y = x * x
                    error = x + x * y * (a3 + y * (a5 + y * a7))
                    u1, u2 = by_along * inverse, by_across * inverse
                    work[m11_ + p] += u1 * u1
                    work[m12_ + p] += u1 * u2
                    work[b1_ + p] += u1 * error
                    work[b2_ + p] += u2 * error
                    if last:
                        u3 = (ct * lean + st * upright * near) * inverse
                        work[m13_ + p] += u1 * u3
                        work[m23_ + p] += u2 * u3
                        work[m33_ + p] += u3 * u3
                        work[b3_ + p] += u3 * error
                        work[square_ + p] += error * error

        return jit(look)

    @jit
    def step(pixels, count, work):  # type: ignore[no-untyped-def]
        """Move to where the normal equations lead, but not too far."""
        all_ = np.float32(count)
        for p in range(pixels):
            m11, m12, b1, b2 = work[m11_ + p], work[m12_ + p], work[b1_ + p], work[b2_ + p]
            m22 = all_ - m11
            scale = one / (m11 * m22 - m12 * m12)
            along, across = (m22 * b1 - m12 * b2) * scale, (m11 * b2 - m12 * b1) * scale
            length = along * along + across * across
            shorter = far / (length if length > far else far)
            along, across = along * shorter, across * shorter
            ct, st, cp, sp = work[ct_ + p], work[st_ + p], work[cp_ + p], work[sp_ + p]
            out = st + along * ct
            work[x_ + p], work[y_ + p] = out * cp - across * sp, out * sp + across * cp
            work[z_ + p] = ct - along * st

    @jit
    def judge(pixels, count, known, limits, work):  # type: ignore[no-untyped-def]
        """Find sigma, and whether noise is what is left once direction and tilt are free."""
        offset, per_count = known[0], known[1]
        tilt, error, most, still, wild, rest = limits
        all_ = np.float32(count)
        for p in range(pixels):
            m11, m12, b1, b2 = work[m11_ + p], work[m12_ + p], work[b1_ + p], work[b2_ + p]
            m13, m23, m22 = work[m13_ + p], work[m23_ + p], all_ - m11
            scale = one / (m11 * m22 - m12 * m12)
            d1, d2 = (m22 * b1 - m12 * b2) * scale, (m11 * b2 - m12 * b1) * scale
            w1, w2 = (m22 * m13 - m12 * m23) * scale, (m11 * m23 - m12 * m13) * scale
            left_free = work[m33_ + p] - m13 * w1 - m23 * w2
            left_free = left_free if left_free > _LEAST else _LEAST
            pull = work[b3_ + p] - m13 * d1 - m23 * d2
            more = pull / left_free
            left = work[square_ + p] - b1 * d1 - b2 * d2 - pull * more
            doubt = three * error / math.sqrt(left_free)
            follows = (tilt + more + doubt >= still) & (tilt + more - doubt <= wild)
            raised = (work[mean_ + p] - offset) * per_count >= rest
            work[contact_ + p] = one if (left <= most) & follows & raised else zero
            work[sigma_ + p] = error * math.sqrt(all_ * scale)

    @jit
    def put(first, end, work, vectors, sigma, contact, mean):  # type: ignore[no-untyped-def]
        for p in range(end - first):
            x, y, z = work[x_ + p], work[y_ + p], work[z_ + p]
            known = work[sigma_ + p] < one  # a standard error of a radian or more: nothing is known
            scale = one / math.sqrt(x * x + y * y + z * z) if known else nan
            vectors[first + p, 0], vectors[first + p, 1], vectors[first + p, 2] = (
                x * scale,
                y * scale,
                z * scale,
            )
            sigma[first + p] = work[sigma_ + p] if known else nan
            touching = np.uint8(work[contact_ + p]) if known else np.uint8(0)
            contact[first + p] = _ODD if work[odd_ + p] > zero else touching
            mean[first + p] = work[mean_ + p]

    look, look_last = make_look(False), make_look(True)

    def run(frames, fit, phase, known, limits, vectors, sigma, contact, mean):  # type: ignore[no-untyped-def]
        for tile in numba.prange(-(-len(sigma) // _TILE)):
            first, end = tile * _TILE, min(len(sigma), (tile + 1) * _TILE)
            work, trig = np.zeros(room, np.float32), np.empty((2, len(frames), _TILE), np.float32)
            count, pixels = len(frames), end - first
            take_in(frames, first, end, fit, known, trig, work)
            aim(pixels, work)
            for _ in range(_LOOKS - 1):
                look(pixels, phase, known, trig, work)
                step(pixels, count, work)
                aim(pixels, work)
            look_last(pixels, phase, known, trig, work)
            judge(pixels, count, known, limits, work)
            step(pixels, count, work)
            put(first, end, work, vectors, sigma, contact, mean)

    return numba.njit(parallel=True, **options)(run)


def _case(name: str, kind: str, shape: tuple[int, int] = (1080, 1920)) -> Callable[[Device, bool], Case]:
    return lambda device, quick: run_normals(
        name, Turn(_QUICK if quick else shape, np.dtype(kind)), device, 1 if quick else ROUNDS
    )


CASES: Cases = {
    **{f"normals-{kind}": _case(f"normals-{kind}", kind) for kind in ("uint8", "uint16", "float32")},
    "normals-4k": _case("normals-4k", "uint8", (2160, 3840)),
}
