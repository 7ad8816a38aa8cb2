"""How time grows with frames and with pixels."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

from mirrorskin.bench.harness import take_turns
from mirrorskin.bench.limits import Limits
from mirrorskin.bench.memory import check_memory
from mirrorskin.bench.results import Case, Row
from mirrorskin.bench.scaling.works import (
    Scaled,
    Shape,
    scale_correlation,
    scale_press,
    scale_surface,
    scale_turn,
)
from mirrorskin.bench.turns import STEPS
from mirrorskin.kernels.device import Device

_VGA, _SMALL = (480, 640), (24, 32)
_COUNTS, _FEW = (8, 32, 128, 512), (8, 16)
_SHAPES: tuple[Shape, ...] = ((120, 160), (240, 320), (480, 640), (1080, 1920), (2160, 3840), (3648, 5472))
_TINY: tuple[Shape, ...] = ((12, 16), (24, 32))
_PRESS = 16  # frames of a press, where pixels grow
_LARGEST = 3_000_000  # pixels of a surface
_ROUNDS = 5
_ROOM = 200  # bytes of a pixel, for all maps

_Make = Callable[[], Scaled]


def run_frames(device: Device, quick: bool) -> Case:
    """Time a press, a correlation and turns of ever more frames, maps included.

    Raises
    ------
    mirrorskin.io.InputError
        There is not enough memory.
    """
    shape, counts = (_SMALL, _FEW) if quick else (_VGA, _COUNTS)
    check_memory("scaling-frames", 4 * sum(counts) * math.prod(shape))
    makers = {"press": scale_press, "correlation": scale_correlation, "turns": scale_turn}
    made = {
        f"{name}, {count} frames": make(device, shape, count)
        for name, make in makers.items()
        for count in counts
    }
    rows = _time(made, device, quick)
    notes = tuple(_by_frame(name, [row for row in rows if row.name.startswith(name)]) for name in makers)
    title = f"presses, correlations and turns of {shape[0]} x {shape[1]} uint8, maps included"
    return Case("scaling-frames", title, rows, {}, notes)


def run_pixels(device: Device, quick: bool) -> Case:
    """Time a press, a turn and a surface of ever more pixels, maps included.

    Raises
    ------
    mirrorskin.io.InputError
        There is not enough memory.
    """
    shapes = _TINY if quick else _SHAPES
    check_memory("scaling-pixels", sum(math.prod(shape) for shape in shapes) * _ROOM)
    made: dict[str, Scaled] = {}
    for shape in shapes:
        size = f"{shape[0]} x {shape[1]}"
        made[f"press, {size}"] = scale_press(device, shape, _PRESS)
        made[f"turns, {size}"] = scale_turn(device, shape, STEPS)
        if math.prod(shape) <= _LARGEST:
            made[f"surface, {size}"] = scale_surface(device, shape)
    rows = _time(made, device, quick)
    pixels = [float(math.prod(shape)) for shape in shapes]
    names = ("press", "turns", "surface")
    notes = tuple(
        _by_pixel(name, pixels, [row for row in rows if row.name.startswith(name)]) for name in names
    )
    title = f"a press of {_PRESS} frames, a turn of {STEPS}, a surface within a mask; uint8, maps included"
    return Case("scaling-pixels", title, rows, {}, notes)


def _time(made: Mapping[str, Scaled], device: Device, quick: bool) -> list[Row]:
    """Return the limit, of as many bytes as the largest work, and the works."""
    limits = Limits(device, np.zeros(max(one.bytes for one in made.values()), np.uint8))
    works = limits.works() | {name: one.work for name, one in made.items()}
    measured = take_turns(works, 1 if quick else _ROUNDS, device.profile)
    rows = limits.rows(measured)
    return rows + [Row(name, measured[name], one.bytes, one.frames) for name, one in made.items()]


def _by_frame(name: str, rows: list[Row]) -> str:
    """Say what a call costs, and what each frame adds: a straight line, fitted to shares of the time."""
    counts, seconds = np.array([[row.frames, row.measured.wall.median] for row in rows]).T
    slope, fixed = np.polyfit(counts, seconds, 1, w=1 / seconds)
    off = np.max(np.abs((fixed + slope * counts) / seconds - 1))
    return f"{name}: {1e3 * fixed:.2f} ms and {1e6 * slope:.1f} us a frame, within {100 * off:.0f} %"


def _by_pixel(name: str, pixels: list[float], rows: list[Row]) -> str:
    """Say how many pixels are done in a second, and how time grows with them."""
    sizes, seconds = np.array(pixels[: len(rows)]), np.array([row.measured.wall.median for row in rows])
    power = np.polyfit(np.log(sizes[-2:]), np.log(seconds[-2:]), 1)[0]
    least, most = 1e-6 * sizes[0] / seconds[0], 1e-6 * sizes[-1] / seconds[-1]
    grows = f"at the end time grows as pixels to the power of {power:.2f}"
    return f"{name}: {least:.1f} Mpixel/s of the smallest, {most:.1f} of the largest; {grows}"
