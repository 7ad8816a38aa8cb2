"""Small stacks, sources of them, and checks of the files that contain them."""

from __future__ import annotations

from dataclasses import is_dataclass
from typing import Any, NamedTuple

import h5py
import numpy as np

from mirrorskin import io
from mirrorskin.io.model.result import FIELDS
from mirrorskin.twin import Camera, Twin, Vertical

SHAPE = (8, 5, 7)
TRAVEL = np.round(np.arange(8) * 0.3, 10)


def random_stack(dtype="uint8", shape=SHAPE, seed=0):
    """Noise over the whole range of a type; float frames hold a NaN as well."""
    generator = np.random.default_rng(seed)
    dtype = np.dtype(dtype)
    if dtype.kind == "f":
        stack = generator.normal(100, 30, shape).astype(dtype)
        stack.flat[0] = np.nan
        return stack
    return generator.integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)


def ball(shape, pixel_size, travel, **camera):
    """The twin, pressed on a ball of 10 mm: what its camera makes of the paper's own idealisation."""
    return Twin(
        object="sphere",
        shape=shape,
        pixel_size=pixel_size,
        movement=Vertical(travel),
        camera=Camera(**camera),
    )


def sphere(dtype="uint8"):
    """The twin, pressed on a ball: 8 frames of 7 x 5."""
    return ball(SHAPE[1:], (0.5, 0.6), TRAVEL, dtype=dtype)


class MadeUp:
    """A source of given frames, which may fail on the way or announce another number of them."""

    rewindable = False
    name = "made up"

    def __init__(self, frames, header, announced=None, fails=None, **series):
        self.frames, self.header, self.motion = frames, header, header.motion
        self.shape = (announced or len(frames), *frames.shape[1:])
        self.dtype = frames.dtype
        self.left = False
        self._fails, self._series, self.frames_read = fails, series, 0

    def read(self, out=None, /):
        part = slice(
            self.frames_read, min(self.frames_read + (1 if out is None else len(out)), len(self.frames))
        )
        if self._fails is not None and part.stop > 3:
            raise self._fails
        if part.start == len(self.frames):
            return None
        self.frames_read = part.stop
        return io.Block(self.frames[part], part.start, **{n: v[part] for n, v in self._series.items()})

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.left = True


def record(source, path, compression="raw", block=1, truth=None):
    """Record a source in blocks of so many frames; an older file of that name is replaced."""
    with io.Recorder(source, path, compression, truth=truth, overwrite=True) as recorder:
        out = np.empty((block, *source.shape[1:]), source.dtype)
        while recorder.read(out) is not None:
            pass
    return path


class Read(NamedTuple):
    """All frames of a source, and what its blocks say beside them."""

    frames: Any
    time: Any
    travel: Any
    phase: Any
    displacement: Any
    twist: Any


def read_all(source, block):
    """Read a source in blocks; return the frames, and the series of what the blocks say beside them."""
    out = np.empty((block, *source.shape[1:]), source.dtype)
    blocks = []
    while (got := source.read(out)) is not None:
        assert got.index == sum(len(frames) for frames, *_ in blocks)
        blocks.append((got.frames.copy(), *(getattr(got, name) for name in Read._fields[1:])))
    return Read(*(None if parts[0] is None else np.concatenate(parts) for parts in zip(*blocks, strict=True)))


def put(path, name, value, units=None):
    """Replace a dataset of a file, or take it away."""
    with h5py.File(path, "r+") as file:
        if name in file:
            del file[name]
        if value is not None:
            file[name] = value
            if units is not None:
                file[name].attrs["units"] = units


def assert_same(actual, expected):
    """Hold two headers, truths or results equal: arrays to the last bit and type, the rest by value."""
    names = expected.__dataclass_fields__ if is_dataclass(expected) else (*expected, *FIELDS)
    assert is_dataclass(expected) or list(actual) == list(expected)
    for name in names:
        mine, right = getattr(actual, name), getattr(expected, name)
        if isinstance(right, np.ndarray):
            assert mine.dtype == right.dtype, name
            np.testing.assert_array_equal(mine, right, err_msg=name)
        else:
            assert mine == right, name


def plot_of(path):
    """Walk to what a NeXus viewer plots unasked; return its group, its signal and its axes."""
    node = h5py.File(path)
    while isinstance(node, h5py.Group) and node.attrs["NX_class"] != "NXdata":
        node = node[node.attrs["default"]]
    signal = node[node.attrs["signal"]]
    axes = list(node.attrs.get("axes", []))
    assert len(axes) in (0, signal.ndim)
    for length, axis in zip(signal.shape, axes, strict=False):
        assert axis == "." or node[axis].shape == (length,)
    for name in node.attrs.get("auxiliary_signals", []):
        assert node[name].shape == signal.shape
    return node, signal, axes
