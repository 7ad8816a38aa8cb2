"""Frames for live work, and a source of them on simulated time."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.cli.commands.bench.paced import Pace, Paced
from mirrorskin.evaluation.scenes import inputs as scenes
from mirrorskin.io import Block, Header
from mirrorskin.twin.emulator.simulated_clock import SimulatedClock

PIXEL = 0.05


def press_frames(shape: tuple[int, int, int], dtype: str = "uint8") -> NDArray[Any]:
    frames = np.empty(shape, dtype)
    scenes.fill_press(frames)
    return frames


def turn_frames(shape: tuple[int, int, int], dtype: str = "uint8") -> NDArray[Any]:
    frames = np.empty(shape, dtype)
    scenes.fill_turns(frames)
    return frames


def phases(count: int, seed: int = 0) -> NDArray[np.float64]:
    """Phases of eight frames a turn, as uneven as live ones are."""
    even = np.arange(count) * (2 * np.pi / scenes.STEPS)
    return even + np.random.default_rng(seed).normal(0, 0.02, count)


def press_header(**other: Any) -> Header:
    return Header("vertical", **{"pixel_size": (PIXEL, PIXEL), **other})


def turn_header(dtype: str = "uint8", **other: Any) -> Header:
    offset, gain, _ = scenes.SCALES[dtype]
    scale = {"zenith_gain": np.asarray(gain), "zenith_offset": np.asarray(offset), "tilt": scenes.TILT}
    return Header("axial", **{"pixel_size": (PIXEL, PIXEL), **scale, **other})


def paced(
    frames: NDArray[Any],
    header: Header,
    places: NDArray[np.float64],
    rate: float = 100.0,
    clock: SimulatedClock | None = None,
    slots: int = 64,
) -> Paced:
    return Paced(
        frames,
        lambda number: number,
        header,
        lambda number: places[number],
        Pace(rate, len(frames), clock or SimulatedClock()),
        slots=slots,
    )


def blocks(frames: NDArray[Any], cuts: list[int], **places: NDArray[np.float64]) -> list[Block]:
    """Cut frames, and where the body was, into blocks of these lengths."""
    ends = np.cumsum([0, *cuts])
    assert ends[-1] == len(frames)
    return [
        Block(
            frames[a:b],
            a,
            time=0.01 * np.arange(a, b),
            **{name: values[a:b] for name, values in places.items()},
        )
        for a, b in pairwise(ends.tolist())
    ]
