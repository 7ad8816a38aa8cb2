"""Calls of every public function with one wrong argument.

``CALLS`` has a sound call of each; ``odd_values`` makes what may be given in an argument's place. A call may
answer or refuse in one line, and nothing else.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import numpy as np

from mirrorskin import engine, io
from mirrorskin.kernels.errors import DeviceError

REFUSALS = (io.InputError, engine.NotConverged, DeviceError)
SHAPE = (16, 20)
_COUNTS = (
    "mean",
    "cosine",
    "sine",
    "modulation",
    "residual",
)  # of a pixel's samples, which may be infinite themselves
ELSEWHERE = {"reconstruct", "run", "option", "function_of"}
"""Public functions that take no arrays of numbers; other tests call them."""

_ROW, _COLUMN = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
_FAR = np.hypot(_ROW - 7.5, _COLUMN - 9.5)


def _texture() -> np.ndarray:
    waves = sum(np.sin(a * _ROW + b * _COLUMN + a * b) for a, b in ((0.9, 0.2), (-0.4, 1.1), (0.3, -0.8)))
    return (100 + 20 * waves).astype(np.float32)


def _press(frames: int = 8) -> np.ndarray:
    travel = np.linspace(0, 1, frames)[:, None, None]
    return np.where(travel > _FAR / 15, 200, 10).astype(np.uint8)


def _rotation(phases: np.ndarray) -> np.ndarray:
    return np.rint(100 + 12 * np.cos(phases[:, None, None] - _COLUMN / 9)).astype(np.uint8)


@cache
def calls() -> dict[str, tuple[Callable[..., Any], dict[str, Any]]]:
    """Return the functions by their names, each with arguments that it answers to."""
    phases, sure = np.arange(8) * math.pi / 4, np.full(SHAPE, 0.01, np.float32)
    height = (-0.002 * _FAR**2).astype(np.float32)
    normals = np.dstack([0.004 * (_COLUMN - 9.5), -0.004 * (_ROW - 7.5), np.ones(SHAPE)])
    normals = (normals / np.linalg.norm(normals, axis=-1, keepdims=True)).astype(np.float32)
    flat, contact = np.zeros(SHAPE, np.float32), np.ones(SHAPE, np.uint8)
    places = {"x": 0.1 * (np.arange(20) - 9.5), "y": 0.1 * (7.5 - np.arange(16))}
    result = io.Result(height=height, height_sigma=sure, normals=normals, normals_sigma=sure, **places)
    wave = 0.5 + 0.1 * np.sin(np.arange(64) * 0.8)
    dither = (100 + 40 * (wave[:, None, None] - 0.5) + 0 * _FAR).astype(np.float32)
    heights = {"height": height, "height_sigma": sure}
    turned = {"normals": normals, "normals_sigma": sure, "contact": contact}
    disc = _FAR < 5
    fringes = {"phase": 0.3 * _COLUMN, "phase_sigma": np.full(SHAPE, 0.05)}
    arguments: dict[str, dict[str, Any]] = {
        "find_onset": {"frames": _press(), "travel": np.linspace(0, 1, 8), "noise": 1.0},
        "find_change_point": {"frames": _press(), "travel": np.linspace(0, 1, 8)},
        "estimate_normals": {
            "frames": _rotation(phases), "phase": phases, "tilt": 0.04, "zenith_gain": 300.0,
        },
        "correlate": {"frames": _rotation(phases), "phase": phases},
        "integrate": {"normals": normals, "pixel_size": 0.1},
        "invert_laplacian": {"right": np.ones((16, 19)), "down": np.ones((15, 20))},
        "fill_holes": {"height": height, "sigma": sure, "pixel_size": 0.1},
        "find_edges": {"normals": normals, "normals_sigma": sure, "contact": contact},
        "find_displacement": {
            "reference": _texture(), "frames": _texture()[None], "pixel_size": 0.1, "noise": 1.0,
        },
        "find_force": {"height": height, "travel": 0.2, "pixel_size": 0.1, "modulus": 0.1},
        "find_tangential_force": {
            "displacement": np.full((*SHAPE, 2), 0.01), "pixel_size": 0.1, "modulus": 0.1, "contact": disc,
        },
        "find_growth": {"frames": dither, "travel": wave, "dark": 0.0, "bright": 255.0},
        "fit_fringes": {"frames": _rotation(phases), "phase": phases},
        "unwrap_frequencies": {
            "fringes": [fringes, {**fringes, "phase": 2.4 * _COLUMN % math.tau}],
            "frequency": np.array([1.0, 8.0]),
        },
        "decode_gray": {"frames": _press(), "threshold": 100.0, "noise": 2.0},
        "unwrap_gray": {
            "fringes": fringes, "stripes": {"stripe": 0.3 * _COLUMN // math.pi, "risk": flat},
        },
        "find_focus": {
            "frames": np.exp(-((np.arange(8) - 3.3) ** 2) / 6)[:, None, None].astype(np.float32) * _texture(),
            "travel": np.arange(8.0), "noise": 0.1,
        },
        "photometric_stereo": {"frames": _rotation(phases), "phase": phases, "zenith": 0.6, "dark": flat},
        "estimate_frequency": {"samples": wave, "time": 0.01 * np.arange(64)},
        "estimate_pose": {"first": result, "second": result, "pixel_size": 0.1},
        "stitch": {"results": [result, result], "pixel_size": 0.1},
        "measure": {"result": result},
        "score": {"result": result, "truth": io.Truth(height, flat, flat, contact)},
        "fuse": {"heights": heights, "normals": turned, "pixel_size": 0.1},
    }  # fmt: skip
    return {name: (_functions()[name], arguments) for name, arguments in arguments.items()}


@cache
def _functions() -> dict[str, Callable[..., Any]]:
    """Return the public functions of the engine, and of its sub-packages for single computations."""
    packages = (
        "correlation",
        "force",
        "integration",
        "optical",
        "pose",
        "press",
        "rotation",
        "slip",
        "vibration",
    )
    functions = {}
    for package in [engine, *(getattr(engine, name) for name in packages)]:
        names = getattr(package, "__all__", None) or [name for name in vars(package) if name[0] != "_"]
        for name in names:
            function = getattr(package, name)
            if inspect.isfunction(function) and function.__module__.startswith(package.__name__):
                functions[name] = function
    return functions


def public_functions() -> set[str]:
    """Return the names of the engine's public functions."""
    return set(_functions())


def odd_values(sound: Any) -> Iterator[tuple[str, Any]]:
    """Yield what may be given in place of a sound argument."""
    array = np.asarray(sound, float) if isinstance(sound, np.ndarray | float | int) else None
    yield from (("text", "abc"), ("none", None), ("table", {"a": 1}), ("object", object()))
    yield from (
        ("complex", 1j),
        ("huge", 1e308),
        ("tiny", 1e-320),
        ("below 0", -1.0),
        ("not a number", math.nan),
    )
    yield from (("empty", np.empty(0)), ("five axes", np.zeros((1, 2, 3, 4, 5))), ("ragged", [[1], [1, 2]]))
    if array is None or not array.ndim:
        return
    yield "list", np.asarray(sound).tolist()
    yield "masked", np.ma.masked_array(sound, np.arange(array.size).reshape(array.shape) % 5 == 0)
    for name, value in (("infinite", math.inf), ("unknown", math.nan)):
        part = array.copy()
        part.flat[-1] = value
        yield f"{name} in part", part.astype(np.float32)
    extreme = np.finfo(sound.dtype).max / 4 if sound.dtype.kind == "f" else np.iinfo(np.int64).max
    part = array.copy()
    part.flat[-1] = extreme
    yield "huge in part", part.astype(sound.dtype if sound.dtype.kind == "f" else np.float64)
    yield "all huge", np.full_like(part, extreme)
    yield "transposed", np.asarray(sound).T
    yield "one too few", np.asarray(sound)[:-1]
    yield "complex array", array * 1j
    yield "objects", array.astype(object)
    yield "texts", array.astype(str)
    yield "dates", array.astype("M8[s]") if np.isfinite(array).all() else None
    yield "infinite", np.full(array.shape, math.inf)


def trial(name: str, argument: str, value: Any) -> str | None:
    """Call a function with one argument replaced; return what is wrong with how it ended, None if nothing."""
    try:
        answer(name, **{argument: value})
    except REFUSALS as refusal:
        return "refuses in more than a line" if "\n" in str(refusal) else None
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return None


def answer(name: str, **changed: Any) -> None:
    """Call a function with some arguments replaced; no map of its answer may hold infinite values."""
    function, arguments = calls()[name]
    infinite = [
        part for part, values in _arrays(function(**{**arguments, **changed})) if np.isinf(values).any()
    ]
    assert not infinite, f"infinite {', '.join(infinite)}"


def to_bytes(name: str) -> bytes:
    """Return the numbers of a call's arrays, one after the other."""
    return b"".join(sound.tobytes() for sound in _given_arrays(name).values())


def call_with(name: str, data: bytes) -> None:
    """Call a function with arrays of other numbers; where there are too few, the last arrays are shorter."""
    changed = {}
    for argument, sound in _given_arrays(name).items():
        part, data = data[: sound.nbytes], data[sound.nbytes :]
        rows = len(part) // sound[:1].nbytes
        stored = np.uint8 if sound.dtype == bool else sound.dtype
        values = np.frombuffer(part[: rows * sound[:1].nbytes], stored)
        changed[argument] = values.reshape(rows, *sound.shape[1:]).astype(sound.dtype)
    answer(name, **changed)


def _given_arrays(name: str) -> dict[str, np.ndarray]:
    return {key: sound for key, sound in calls()[name][1].items() if isinstance(sound, np.ndarray)}


def _arrays(answer: Any) -> Iterator[tuple[str, np.ndarray]]:
    if isinstance(answer, io.Result):
        for name, values in answer.items():
            if name not in _COUNTS and isinstance(values, np.ndarray) and values.dtype.kind == "f":
                yield name, values
        return
    for name in getattr(answer, "__dataclass_fields__", ()):
        if name in _COUNTS:
            continue
        values = getattr(answer, name)
        if isinstance(values, np.ndarray) and values.dtype.kind == "f":
            yield name, values
