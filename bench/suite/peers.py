"""Functions beside what a user would write instead, with Numba, OpenCV or pyamg: processor and wall time."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft

from mirrorskin import engine
from mirrorskin.bench.suite.correlation import fit_with_numba
from mirrorskin.bench.suite.harness import Cases, agree, check_memory, missing
from mirrorskin.cli.commands.bench.records import Case, Row, Target
from mirrorskin.cli.commands.bench.scenes import wavy_dome
from mirrorskin.cli.commands.bench.timing import OURS, ROUNDS, Work, take_turns
from mirrorskin.evaluation.scenes.inputs import (
    PIXEL,
    SCALES,
    STEPS,
    TILT,
    fill_turns,
    phases,
    roof,
    turn_noise,
)
from mirrorskin.kernels.device import Device

Maps = dict[str, NDArray[Any]]

LESS_WORK = "less work"
"""Part of the name of a peer that computes less than the function."""

_LARGE, _QUICK = (1024, 1024), (64, 96)
_NOISE = 1.5  # counts
_PER_UNIT = 8000  # counts of a vector of length 1, for OpenCV
_GAP = 1e-4  # largest gap in contact, as a share of the travel
_COMPILED: dict[str, Any] = {"fastmath": True, "error_model": "numpy"}  # options of Numba: 1 / 0 is no error


@dataclass(frozen=True)
class _Compared:
    """A function on its input, and its peers by name.

    Attributes
    ----------
    call : callable
        The function; ``maps`` names the maps of its result that the peers compute, too.
    peers : mapping of callable
        They return these maps.
    bounds : mapping of float
        Largest aim of the ratio of processor times, ours to the peer's.
    near : mapping of float
        Largest difference of a map from the peer's.
    """

    title: str
    call: Callable[[], Any]
    peers: Mapping[str, Callable[[], Maps]]
    bounds: Mapping[str, float]
    absent: dict[str, str] = field(default_factory=dict)
    near: Mapping[str, float] = field(default_factory=dict)


def run_peers(
    name: str, make: Callable[[tuple[int, int], Device], _Compared], device: Device, quick: bool
) -> Case:
    """Time a function and its peers in turns, after checking that their maps agree."""
    shape = _QUICK if quick else _LARGE
    check_memory(name, 600 * math.prod(shape))
    compared = make(shape, device)

    def check(results: dict[str, Any]) -> None:
        for peer in compared.peers:
            maps = {key: np.asarray(getattr(results[OURS], key)) for key in compared.near}
            theirs = {key: results[peer][key] for key in compared.near if key in results[peer]}
            agree(peer, maps, theirs, compared.near)

    works = {OURS: Work(compared.call), **{peer: Work(work) for peer, work in compared.peers.items()}}
    rows = take_turns(works, 1 if quick else ROUNDS, device.profile, check)
    targets = () if quick else tuple(_targets(rows, compared.bounds))
    return Case(name, compared.title, list(rows.values()), dict(compared.absent), targets=targets)


def ratios(case: Case) -> dict[str, float]:
    """Return the ratio of processor times, ours to each peer's."""
    rows = {row.name: row for row in case.rows}
    return {
        name: rows[OURS].processor / row.processor
        for name, row in rows.items()
        if name != OURS and row.processor > 0
    }


def regressions(before: Mapping[str, Case], after: Mapping[str, Case], factor: float) -> list[str]:
    """Return a line for each ratio that is more than ``factor`` times what it was."""
    return [
        f"{name}: {ratio:.2f} times the processor time of {peer}, {factor:g} times {was:.2f} are allowed"
        for name, case in after.items()
        if name in before
        for peer, ratio in ratios(case).items()
        if ratio > factor * (was := ratios(before[name]).get(peer, math.inf))
    ]


def _targets(rows: Mapping[str, Row], bounds: Mapping[str, float]) -> list[Target]:
    mine = rows[OURS]
    targets = []
    for peer, bound in bounds.items():
        if peer in rows:
            theirs = rows[peer]
            ratio, wall = mine.processor / theirs.processor, mine.wall.median / theirs.wall.median
            value = (
                f"{ratio:.2f} times ({1e3 * mine.processor:.0f} against {1e3 * theirs.processor:.0f} ms),"
                f" by the clock {wall:.2f}"
            )
            limit = f"at most {bound:g} times the processor time of {peer}"
            targets.append(Target(OURS, limit, value, ratio <= bound))
    return targets


def _waves(shape: tuple[int, int], size: float) -> NDArray[np.float64]:
    y, x = np.mgrid[: shape[0], : shape[1]]
    return np.asarray(size * np.sin(x / 60) * np.cos(y / 75))


def _counts(values: NDArray[np.float64], generator: np.random.Generator) -> NDArray[np.uint8]:
    noisy = values + generator.normal(0, _NOISE, values.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def _photometric(shape: tuple[int, int], device: Device) -> _Compared:
    generator, azimuth, zenith = np.random.default_rng(0), np.arange(16) * np.pi / 8, 0.6
    height = _waves(shape, 8.0)
    down, right = np.gradient(height)
    normals = np.stack([-right, down, np.ones(shape)], -1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    across = np.sin(zenith)
    lamps = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), np.full(16, np.cos(zenith))], 1)
    frames = np.stack([_counts(20 + 180 * np.maximum(normals @ lamp, 0), generator) for lamp in lamps])
    options: dict[str, Any] = {"dark": 20, "shadow": 4 * _NOISE, "noise": _NOISE, "device": device}
    call = functools.partial(engine.optical.photometric_stereo, frames, azimuth, zenith=zenith, **options)
    absent = missing("numba")

    def numba() -> Maps:
        maps = [np.empty((*shape, 3), np.float32), *(np.empty(shape, np.float32) for _ in range(4))]
        _numba_photometric()(
            frames, lamps.astype(np.float32), np.float32(20), np.float32(4 * _NOISE), np.float32(255), *maps
        )
        normals, albedo, residual, normals_sigma, albedo_sigma = maps
        return {"normals": normals, "albedo": albedo, "residual": residual} | {
            "normals_sigma": np.float32(_NOISE) * normals_sigma,
            "albedo_sigma": np.float32(_NOISE) * albedo_sigma,
        }

    return _Compared(
        f"normals and albedo by 16 lamps, {shape[0]} x {shape[1]} uint8",
        call,
        {} if absent else {"Numba": numba},
        {"Numba": 1.3},
        absent,
        {"normals": 1e-4, "albedo": 0.02},
    )


def _fringes(shape: tuple[int, int], device: Device) -> _Compared:
    generator, shift = np.random.default_rng(0), np.arange(16) * np.pi / 8
    phase = _waves(shape, 3.0)
    frames = np.stack([_counts(120 + 80 * np.cos(phase - step), generator) for step in shift])
    call = functools.partial(engine.optical.fit_fringes, frames, shift, device=device)
    absent = missing("numba")

    def numba() -> Maps:
        mean, cosine, sine, residual = fit_with_numba(frames, shift)
        deviation = np.median(residual.ravel()[::16]) * math.sqrt(2 / len(shift))
        names = "phase", "modulation", "phase_sigma"
        maps = [np.empty(shape, np.float32) for _ in names]
        _numba_phase()(cosine, sine, np.float32(deviation), *maps)
        return {"mean": mean, "residual": residual, **dict(zip(names, maps, strict=True))}

    return _Compared(
        f"phase of fringes of 16 shifts, {shape[0]} x {shape[1]} uint8",
        call,
        {} if absent else {"Numba": numba},
        {"Numba": 1.2},
        absent,
        {"mean": 0.01, "modulation": 0.01},
    )


def _focus(shape: tuple[int, int], device: Device) -> _Compared:
    import cv2

    generator, travel, radius = np.random.default_rng(0), 0.05 * np.arange(64), 4
    height, texture = _waves(shape, 0.3), generator.normal(0, 1, shape)
    contrast = [1 / (1 + ((at - 1.6 - height) / 0.3) ** 2) for at in travel]
    frames = np.stack([_counts(127 + 38 * texture * part, generator) for part in contrast])
    call = functools.partial(
        engine.optical.find_focus, frames, travel, noise=_NOISE, radius=radius, device=device
    )

    def opencv() -> Maps:
        size, volume = (2 * radius + 1,) * 2, np.empty(frames.shape, np.float32)
        for frame, variance in zip(frames, volume, strict=True):
            samples = frame.astype(np.float32)
            mean = cv2.boxFilter(samples, -1, size)
            variance[:] = cv2.sqrBoxFilter(samples, -1, size) - mean * mean
        best = np.clip(volume.argmax(0), 1, len(frames) - 2)
        row, column = np.ogrid[: shape[0], : shape[1]]
        before, peak, after = (np.log(volume[best + step, row, column]) for step in (-1, 0, 1))
        shift = (before - after) / (2 * (before - 2 * peak + after))
        return {"height": -(travel[best] + shift * (travel[1] - travel[0]))}

    return _Compared(
        f"height by focus of 64 frames, {shape[0]} x {shape[1]} uint8",
        call,
        {f"OpenCV and NumPy, {LESS_WORK} (no sigma)": opencv},
        {f"OpenCV and NumPy, {LESS_WORK} (no sigma)": 0.5},
    )


def _displacement(shape: tuple[int, int], device: Device) -> _Compared:
    import cv2

    generator, border = np.random.default_rng(0), 8
    size = (shape[0] + 2 * border, shape[1] + 2 * border)
    texture = np.asarray(cv2.GaussianBlur(generator.normal(0, 1, size), (0, 0), 2.0), np.float64)
    texture /= texture.std()
    columns = slice(border, border + shape[1])
    frames = np.stack(
        [
            _counts(120 + 30 * texture[border + step : border + step + shape[0], columns], generator)
            for step in range(3)
        ]
    )
    call = functools.partial(engine.slip.find_displacement, frames[0], frames[1:], 0.05, device=device)

    def opencv() -> Maps:
        flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        start = np.zeros((*shape, 2), np.float32)
        return {"flow": np.stack([flow.calc(frames[0], frame, start.copy()) for frame in frames[1:]])}

    return _Compared(
        f"displacement of two frames from a third, {shape[0]} x {shape[1]} uint8",
        call,
        {f"OpenCV DIS, {LESS_WORK} (no sigma)": opencv},
        {f"OpenCV DIS, {LESS_WORK} (no sigma)": 1.0},
    )


def _change_point(shape: tuple[int, int], device: Device) -> _Compared:
    generator, travel = np.random.default_rng(0), 0.05 * np.arange(64)
    height = _waves(shape, 0.5)
    edges = [1 / (1 + np.exp((height + 1.6 - at) / 0.03)) for at in travel]
    frames = np.stack([_counts(20 + 180 * edge, generator) for edge in edges])
    call = functools.partial(
        engine.find_change_point, frames, travel, dark=20, bright=200, noise=_NOISE, device=device
    )
    absent = missing("numba")

    def numba() -> Maps:
        frame = np.empty(shape, np.int32)
        _numba_step()(frames, np.float32(20), np.float32(1 / 180), frame)
        return {"frame": frame}

    peer = f"Numba, {LESS_WORK} (steps only, no sigma)"
    return _Compared(
        f"change-points of 64 frames, {shape[0]} x {shape[1]} uint8",
        call,
        {} if absent else {peer: numba},
        {},
        absent,
    )


def _normals(shape: tuple[int, int], device: Device) -> _Compared:
    frames, phase, (offset, gain, _) = np.empty((STEPS, *shape), np.uint8), phases(STEPS), SCALES["uint8"]
    fill_turns(frames)
    noise = turn_noise(frames.dtype)
    options: dict[str, Any] = {"tilt": TILT, "zenith_gain": gain, "zenith_offset": offset, "noise": noise}
    call = functools.partial(engine.estimate_normals, frames, phase, device=device, **options)
    absent = missing("numba")

    def numba() -> Maps:
        mean, cosine, sine, _ = fit_with_numba(frames, phase)
        maps = np.empty((*shape, 3), np.float32), np.empty(shape, np.float32)
        numbers = map(np.float32, (offset, gain, noise * math.sqrt(2 / len(phase))))
        _numba_directions()(mean, cosine, sine, *numbers, *maps)
        return dict(zip(("normals", "normals_sigma"), maps, strict=True))

    peer = f"Numba, {LESS_WORK} (linear, sigma without the zenith's error)"
    title = f"normals of a turn of {STEPS} frames, {shape[0]} x {shape[1]} uint8"
    return _Compared(title, call, {} if absent else {peer: numba}, {}, absent)


def _fuse(shape: tuple[int, int], device: Device) -> _Compared:
    shape = min(shape[0], 512), min(shape[1], 512)
    generator, height, phase = np.random.default_rng(0), _waves(shape, 0.2), phases(STEPS)
    travel, (offset, gain, _) = 0.05 * np.arange(16), SCALES["uint8"]
    rise = [1 / (1 + np.exp((height + 0.4 - at) / 0.02)) for at in travel]
    press = np.stack([_counts(20 + 180 * part, generator) for part in rise])
    down, right = (part / PIXEL for part in np.gradient(-height))  # depth, as travel is
    up = 1 / np.sqrt(1 + down**2 + right**2)
    leaning = np.cos(TILT) - np.sin(TILT) * (
        down * np.sin(phase)[:, None, None] - right * np.cos(phase)[:, None, None]
    )
    turn = _counts(offset + gain * np.arccos(np.clip(leaning * up, -1, 1)), generator)
    onset = engine.find_onset(press, travel, dark=20, bright=200, device=device)
    options: dict[str, Any] = {"tilt": TILT, "zenith_gain": gain, "zenith_offset": offset, "noise": _NOISE}
    normals = engine.estimate_normals(turn, phase, device=device, **options)
    absent = missing("pyamg")

    def pyamg() -> Maps:
        from scipy.sparse import diags_array, eye_array, kron

        x, y, z = np.moveaxis(np.asarray(normals.normals, np.float64), -1, 0)
        usable = np.isfinite(x) & (z > 0.1)
        slopes = [np.where(usable, part / np.where(usable, z, 1), 0) for part in (-x, y)]
        weight = np.where(usable, 1 / np.where(usable, normals.normals_sigma, 1).astype(np.float64) ** 2, 0)
        known = np.isfinite(onset.height) & np.isfinite(onset.height_sigma)
        height = np.where(known, onset.height, 0)
        certain = np.where(known, 1 / np.where(known, onset.height_sigma, 1).astype(np.float64) ** 2, 1e-6)
        matrix, right = diags_array(certain.ravel()), (certain * height).ravel()
        for axis, slope in ((1, slopes[0]), (0, slopes[1])):
            size = shape[axis]
            step = diags_array([-1 / PIXEL, 1 / PIXEL], offsets=[0, 1], shape=(size - 1, size))
            across = kron(eye_array(shape[0]), step) if axis else kron(step, eye_array(shape[1]))
            first = np.s_[:, :-1] if axis else np.s_[:-1]
            between = diags_array(weight[first].ravel())
            matrix = matrix + across.T @ between @ across
            right = right + across.T @ (between @ slope[first].ravel())
        solver = import_module("pyamg").smoothed_aggregation_solver(matrix.tocsr())
        return {"height": solver.solve(right, tol=1e-5, accel="cg").reshape(shape)}

    peer = f"pyamg, {LESS_WORK} (no sigma, no intervals)"
    title = f"one surface of a press of 16 and a turn of {STEPS} frames, {shape[0]} x {shape[1]}"
    call = functools.partial(engine.fuse, onset, normals, PIXEL, device=device)
    return _Compared(title, call, {} if absent else {peer: pyamg}, {}, absent)


def _edges(shape: tuple[int, int], device: Device) -> _Compared:
    import cv2

    normals, sigma, contact = roof(shape)
    jump, least = (round(_PER_UNIT * math.radians(degrees)) for degrees in (10, 4))

    def opencv() -> Maps:
        counts = np.rint(_PER_UNIT * normals[..., :2]).astype(np.int16)
        changes = [np.gradient(counts[..., part], axis=axis) for axis in (1, 0) for part in (0, 1)]
        across, down = (np.rint(changes[at] + changes[at + 1]).astype(np.int16) for at in (0, 2))
        return {"edges": cv2.Canny(across, down, least, jump, L2gradient=True)}

    return _Compared(
        f"edges of normals of {shape[0]} x {shape[1]}",
        functools.partial(engine.find_edges, normals, sigma, contact, device=device),
        {f"OpenCV, {LESS_WORK} (one threshold for all, no contact)": opencv},
        {},
    )


def _pose(shape: tuple[int, int], device: Device) -> _Compared:
    import cv2

    shape = min(shape[0], 240), min(shape[1], 320)
    first, second = wavy_dome(shape, 0, 0, 0, seed=0), wavy_dome(shape, 0.05, 0, 0.02, seed=1)

    def opencv() -> Maps:
        clouds = []
        for result in (first, second):
            x, y = np.meshgrid(np.asarray(result.x), np.asarray(result.y))
            points = np.stack([x, y, np.asarray(result.height)], -1)
            clouds.append(np.concatenate([points, np.asarray(result.normals)], -1).reshape(-1, 6))
        cloud, target = (np.ascontiguousarray(points, np.float32) for points in clouds)
        nearest: Any = cv2.ppf_match_3d_ICP(100)  # type: ignore[attr-defined]
        return {"motion": nearest.registerModelToScene(cloud, target)[2]}

    return _Compared(
        f"motion between two results of {shape[0]} x {shape[1]}",
        functools.partial(engine.pose.estimate_pose, first, second, device=device),
        {f"OpenCV ICP, {LESS_WORK} (no covariance)": opencv},
        {},
    )


def _force(shape: tuple[int, int], _: Device) -> _Compared:
    shape = min(shape[0], 240), min(shape[1], 320)
    y, x = ((np.arange(size) - size / 2) * PIXEL for size in shape)
    radius = 0.5 * PIXEL * min(shape)
    ball = -(x**2 + y[:, np.newaxis] ** 2) / (2 * radius)
    travel, modulus, wide = 0.05 * radius, 0.1, [scipy_fft.next_fast_len(2 * size) for size in shape]

    def scipy() -> Maps:
        """Polonsky and Keer's conjugate gradients with a discrete convolution of Boussinesq's cones."""
        down, right = (np.minimum(np.arange(size), size - np.arange(size)) * PIXEL for size in wide)
        distance = np.hypot(right, down[:, np.newaxis])
        distance[0, 0] = PIXEL / (4 * math.log(1 + math.sqrt(2)))
        spread = scipy_fft.rfft2(PIXEL**2 / (math.pi * distance))
        inside = tuple(slice(size) for size in shape)

        def moved(pressure: NDArray[Any]) -> NDArray[Any]:
            filtered = scipy_fft.irfft2(scipy_fft.rfft2(pressure, wide) * spread, wide)
            return np.asarray(filtered[inside])

        target = ball + travel
        pressure = np.where(target > 0, target, 0.0)
        direction, before, keep = np.zeros(shape), 1.0, 0.0
        while True:
            gap, touches = moved(pressure) - target, pressure > 0
            square = float(np.sum(gap[touches] ** 2))
            direction = np.where(touches, gap + keep * square / before * direction, 0.0)
            change = moved(direction)
            step = float(np.sum((gap * direction)[touches]) / np.sum((change * direction)[touches]))
            pressure = np.maximum(pressure - step * direction, 0.0)
            joined = (pressure == 0) & (gap < 0)
            pressure[joined] -= step * gap[joined]
            keep, before = float(not joined.any()), square
            if not joined.any() and float(np.abs(gap[pressure > 0]).max()) < _GAP * travel:
                return {"pressure": 4 / 3 * modulus * pressure}

    return _Compared(
        f"force of a ball of {shape[0]} x {shape[1]}",
        functools.partial(engine.force.find_force, ball, travel, PIXEL, modulus),
        {f"SciPy, {LESS_WORK} (no sigma)": scipy},
        {},
        near={"pressure": 0.02 * modulus},
    )


_FUNCTIONS: dict[str, Callable[[tuple[int, int], Device], _Compared]] = {
    "photometric": _photometric,
    "fringes": _fringes,
    "focus": _focus,
    "displacement": _displacement,
    "change-point": _change_point,
    "normals": _normals,
    "fuse": _fuse,
    "edges": _edges,
    "pose": _pose,
    "force": _force,
}
CASES: Cases = {
    f"peers-{name}": functools.partial(run_peers, f"peers-{name}", make) for name, make in _FUNCTIONS.items()
}


@functools.cache
def _numba_photometric() -> Any:
    """Compile normal equations of each pixel, and their solution by cofactors."""
    import numba

    def fit(frames, lamps, dark, shadow, bright, normals, albedo, residual, normals_sigma, albedo_sigma):  # type: ignore[no-untyped-def]
        count, rows, columns = frames.shape
        for row in range(rows):
            for column in range(columns):
                a = b = c = d = e = f = u = v = w = square = np.float32(0)
                used = 0
                for t in range(count):
                    sample = np.float32(frames[t, row, column])
                    light = sample - dark
                    if light > shadow and sample < bright:
                        x, y, z = lamps[t, 0], lamps[t, 1], lamps[t, 2]
                        a += x * x
                        b += x * y
                        c += x * z
                        d += y * y
                        e += y * z
                        f += z * z
                        u += x * light
                        v += y * light
                        w += z * light
                        square += light * light
                        used += 1
                c00, c01, c02 = d * f - e * e, c * e - b * f, b * e - c * d
                c11, c12, c22 = a * f - c * c, b * c - a * e, a * d - b * b
                scale = np.float32(1) / (a * c00 + b * c01 + c * c02)
                x = (c00 * u + c01 * v + c02 * w) * scale
                y = (c01 * u + c11 * v + c12 * w) * scale
                z = (c02 * u + c12 * v + c22 * w) * scale
                length = np.sqrt(x * x + y * y + z * z)
                left = max(square - (x * u + y * v + z * w), np.float32(0))
                residual[row, column] = np.sqrt(left / max(used - 3, 1))
                x, y, z = x / length, y / length, z / length
                normals[row, column, 0], normals[row, column, 1], normals[row, column, 2] = x, y, z
                albedo[row, column] = length
                radial = x * (c00 * x + c01 * y + c02 * z) + y * (c01 * x + c11 * y + c12 * z)
                radial = (radial + z * (c02 * x + c12 * y + c22 * z)) * scale
                whole = (c00 + c11 + c22) * scale
                normals_sigma[row, column] = np.sqrt(max(whole - radial, np.float32(0))) / length
                albedo_sigma[row, column] = np.sqrt(radial)

    return numba.njit(fit, **_COMPILED)


@functools.cache
def _numba_phase() -> Any:
    """Compile phase, modulation and sigma of a wave."""
    import numba

    def derive(cosine, sine, deviation, phase, modulation, sigma):  # type: ignore[no-untyped-def]
        for row in range(cosine.shape[0]):
            for column in range(cosine.shape[1]):
                c, s = cosine[row, column], sine[row, column]
                size = np.sqrt(c * c + s * s)
                phase[row, column], modulation[row, column] = np.arctan2(s, c), size
                sigma[row, column] = deviation / size

    return numba.njit(derive, **_COMPILED)


@functools.cache
def _numba_directions() -> Any:
    """Compile normals and their sigma by the mean, which shows the zenith, and by the wave's direction."""
    import numba

    def derive(mean, cosine, sine, offset, gain, deviation, normals, sigma):  # type: ignore[no-untyped-def]
        for row in range(mean.shape[0]):
            for column in range(mean.shape[1]):
                c, s = cosine[row, column], sine[row, column]
                size, zenith = np.sqrt(c * c + s * s), (mean[row, column] - offset) / gain
                part = np.sin(zenith)
                normals[row, column, 0], normals[row, column, 1] = part * c / size, part * s / size
                normals[row, column, 2] = np.cos(zenith)
                sigma[row, column] = deviation / size * part

    return numba.njit(derive, **_COMPILED)


@functools.cache
def _numba_step() -> Any:
    """Compile the most likely step of each pixel, by cumulative sums."""
    import numba

    def find(frames, dark, gain, frame):  # type: ignore[no-untyped-def]
        count, rows, columns = frames.shape
        for row in range(rows):
            for column in range(columns):
                total = best = np.float32(0)
                step = 0
                for t in range(count):
                    total += np.float32(0.5) - (np.float32(frames[t, row, column]) - dark) * gain
                    if total > best:
                        best, step = total, t + 1
                frame[row, column] = step

    return numba.njit(find, **_COMPILED)
