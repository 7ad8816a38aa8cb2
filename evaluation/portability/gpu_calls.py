"""Every public call on a picture of a given size, with its work on the device."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import cycle
from typing import Any

import numpy as np

from mirrorskin import engine
from mirrorskin.cli.commands.bench.scenes import wavy_dome
from mirrorskin.engine.live import LiveRun
from mirrorskin.evaluation.scenes.depth import SCENES
from mirrorskin.evaluation.scenes.inputs import (
    LEVELS,
    PIXEL,
    SCALES,
    TILT,
    Shape,
    blob_mask,
    drifting_slopes,
    fill_press,
    fill_turns,
    noisy_slopes,
    phases,
    random_cuts,
    roof,
    travel_of,
)
from mirrorskin.io import Block, Header, pixel_axes
from mirrorskin.kernels.device import Device

Call = Callable[[], object]
Row = dict[str, Any]

MEGAPIXEL, UHD, VGA = (1024, 1024), (2160, 3840), (480, 640)
DARK, BRIGHT = LEVELS["uint8"]
OFFSET, GAIN, _ = SCALES["uint8"]
TURN: dict[str, Any] = {"tilt": TILT, "zenith_gain": GAIN, "zenith_offset": OFFSET}
LONGEST = 6  # kernels that a row names


def tiled(shape: Shape, count: int, fill: Callable[[Any], None]) -> Any:
    """Return frames that repeat a small picture, which is quick to make."""
    small = np.empty((count, *(max(n // 4, 32) for n in shape)), np.uint8)
    fill(small)
    return np.ascontiguousarray(np.tile(small, (1, 4, 4))[:, : shape[0], : shape[1]])


def placed(values: Any, device: Device) -> Any:
    """Return an array on the device."""
    values = np.ascontiguousarray(values)
    return device.from_host("given", values, values.dtype)


def calls(shape: Shape, device: Device, frames: int = 64, divisor: int = 1) -> Iterator[tuple[str, Call]]:
    """Give the calls by name; the arrays of a call are made when it is asked for.

    Calls of a size of their own have rows and columns divided by ``divisor``.
    """
    yield from presses(shape, device, frames)
    yield from rotations(shape, device)
    yield from surfaces(shape, device)
    yield "find_edges", partial(engine.find_edges, *roof(shape), device=device)
    if math.prod(shape) <= math.prod(MEGAPIXEL):
        yield from others(shape, device, divisor)


def presses(shape: Shape, device: Device, frames: int) -> Iterator[tuple[str, Call]]:
    """Give what is called with a press."""
    press, travel = tiled(shape, frames, fill_press), travel_of(frames)
    levels: dict[str, Any] = {"dark": DARK, "bright": BRIGHT, "device": device}
    onset = partial(engine.find_onset, travel=travel, **levels)
    yield f"find_onset, {frames} frames", partial(onset, press)
    yield f"find_onset, {frames} frames on the device", partial(onset, placed(press, device))
    if frames <= 64:
        change_point = partial(engine.find_change_point, press, travel, **levels)
        yield f"find_change_point, {frames} frames", change_point
        focus = partial(engine.optical.find_focus, press, travel, noise=2.0, device=device)
        yield f"find_focus, {frames} frames", focus


def rotations(shape: Shape, device: Device) -> Iterator[tuple[str, Call]]:
    """Give what is called with two turns."""
    turns, phase = tiled(shape, 16, fill_turns), phases(16)
    placed_turns = placed(turns, device)
    yield "correlate, 16 frames", partial(engine.correlate, turns, phase, device=device)
    yield "correlate, 16 frames on the device", partial(engine.correlate, placed_turns, phase)
    yield "fit_fringes, 16 frames", partial(engine.optical.fit_fringes, turns, phase, device=device)
    yield (
        "estimate_normals, 16 frames",
        partial(engine.estimate_normals, turns, phase, device=device, **TURN),
    )
    yield (
        "estimate_normals, 16 frames on the device",
        partial(engine.estimate_normals, placed_turns, phase, **TURN),
    )
    yield (
        "from frames to heights on the device",
        lambda: engine.integrate(
            normals=engine.estimate_normals(placed_turns, phase, noise=1.0, **TURN).on_device("normals"),
            pixel_size=PIXEL,
            sigma=False,
        ),
    )
    lamps: dict[str, Any] = {"zenith": 0.7, "dark": DARK, "device": device}
    stereo = partial(engine.optical.photometric_stereo, turns, phase, **lamps)
    yield "photometric_stereo, 16 frames", stereo


def surfaces(shape: Shape, device: Device) -> Iterator[tuple[str, Call]]:
    """Give the integrations."""
    slopes, mask = noisy_slopes(shape), blob_mask(shape)
    masks = cycle([mask, mask[::-1].copy()])
    options: dict[str, Any] = {"device": device}
    integrate: Any = engine.integrate
    yield "integrate", lambda: integrate(*slopes, PIXEL, sigma=False, **options)
    placed_slopes = [placed(slope, device) for slope in slopes]
    yield "integrate on the device", lambda: integrate(*placed_slopes, PIXEL, sigma=False)
    yield "integrate with sigma", lambda: integrate(*slopes, PIXEL, **options)
    yield "integrate, same mask", lambda: integrate(*slopes, PIXEL, mask=mask, sigma=False, **options)
    yield (
        "integrate, same mask, on the device",
        lambda: integrate(*placed_slopes, PIXEL, mask=mask, sigma=False),
    )
    yield "integrate, same mask, sigma", lambda: integrate(*slopes, PIXEL, mask=mask, **options)
    yield "integrate, new mask, sigma", lambda: integrate(*slopes, PIXEL, mask=next(masks), **options)
    if math.prod(shape) <= 1 << 20:
        cuts = random_cuts(shape, 200)
        yield (
            "integrate with cuts, sigma",
            lambda: integrate(*slopes, PIXEL, mask=mask, edges=cuts, **options),
        )


def pressed_and_turned(shape: Shape) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return maps of a press and of a rotation of the same wavy surface, which agree within their errors."""
    generator, step, noise = np.random.default_rng(0), 0.05, 0.01
    x, y = (2 * np.pi * axis / 6 for axis in pixel_axes(shape, (PIXEL, PIXEL)))
    y = y[:, np.newaxis]
    height = 0.6 * np.sin(x) * np.cos(y) - 1.0
    along_x, along_y = 0.2 * np.pi * np.cos(x) * np.cos(y), -0.2 * np.pi * np.sin(x) * np.sin(y)
    along_x, along_y = (slope + generator.normal(0, noise, shape) for slope in (along_x, along_y))
    normal = np.stack([-along_x, -along_y, np.ones(shape)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    steps = np.where(height < -0.5, (np.floor(height / step) + 0.5) * step, np.nan)  # a hole at each top
    heights = {"height": steps, "height_sigma": np.where(np.isfinite(steps), step / np.sqrt(12), np.nan)}
    normals = {"normals": normal, "normals_sigma": np.full(shape, noise)}
    first, second = (
        {name: map_.astype(np.float32) for name, map_ in maps.items()} for maps in (heights, normals)
    )
    return first, second


def others(shape: Shape, device: Device, divisor: int = 1) -> Iterator[tuple[str, Call]]:
    """Give what is measured at one size only."""
    half, quarter, small, vga = (
        (rows // divisor, columns // divisor) for rows, columns in ((512, 512), (256, 256), (240, 320), VGA)
    )
    heights, normals = pressed_and_turned(half)
    yield "fuse, 512 x 512", partial(engine.fuse, heights, normals, PIXEL, device=device)
    maps = [{name: placed(values, device) for name, values in part.items()} for part in (heights, normals)]
    yield "fuse, 512 x 512, maps on the device", partial(engine.fuse, maps[0], maps[1], PIXEL)
    heap = SCENES["leaves"](quarter)
    steep: dict[str, Any] = {"normals": heap.normals, "mask": heap.mask, "pixel_size": heap.pixel_size}
    robustly = partial(engine.integrate, **steep, robust=True, device=device)
    yield "integrate robustly, 256 x 256", robustly
    texture = np.random.default_rng(0).integers(0, 255, shape, dtype=np.uint8)
    moved = np.stack([np.roll(texture, n, axis=1) for n in range(1, 4)])
    yield (
        "find_displacement, 3 frames",
        lambda: engine.slip.find_displacement(texture, moved, PIXEL, device=device),
    )
    pictures = placed(texture, device), placed(moved, device)
    yield (
        "find_displacement, 3 frames on the device",
        lambda: engine.slip.find_displacement(pictures[0], pictures[1], PIXEL),
    )
    first, second = (wavy_dome(small, 0.05 * n, 0.03 * n, 0.02 * n, n) for n in (0, 1))
    yield "estimate_pose, 240 x 320", lambda: engine.pose.estimate_pose(first, second, device=device)
    results = [
        result.assign({name: placed(values, device) for name, values in result.maps().items()})
        for result in (first, second)
    ]
    yield "estimate_pose, 240 x 320 on the device", lambda: engine.pose.estimate_pose(results[0], results[1])
    yield "live press, one frame of VGA", live_press(vga, device)
    yield "live rotation, one frame of VGA", live_rotation(vga, device)
    steps = cycle(drifting_slopes(vga, 16, 0.01))
    integrator = engine.Integrator(vga, PIXEL, device=device)
    mask = blob_mask(vga)

    def follow() -> object:
        integrator.push(*next(steps), mask=mask)
        return integrator.result()

    yield "Integrator.push, one frame of VGA", follow


class Memory:
    """A live source that is never read; a live operation takes its header."""

    name, rewindable = "memory", False

    def __init__(self, header: Header, shape: tuple[int, int, int]) -> None:
        self.header, self.motion, self.shape, self.dtype = header, header.motion, shape, np.dtype(np.uint8)


def live_press(shape: Shape, device: Device) -> Call:
    """Return a call that pushes one frame and asks for the maps."""
    count = 256
    frames = np.empty((count, *shape), np.uint8)
    fill_press(frames)
    dark, bright = (np.full(shape, level, np.float32) for level in (DARK, BRIGHT))
    header = Header("vertical", pixel_size=(PIXEL, PIXEL), dark=dark, bright=bright)
    source: Any = Memory(header, frames.shape)
    live = LiveRun(source, engine.Press(device=device))
    numbers = iter(range(count))

    def push() -> object:
        n = next(numbers)
        block = Block(frames[n : n + 1], n, time=np.array([n / 100]), travel=np.array([0.01 * n]))
        live.push_block(block)
        return live.maps()

    return push


def live_rotation(shape: Shape, device: Device) -> Call:
    """Return a call that pushes one frame, and asks for normals and heights."""
    frames = np.empty((8, *shape), np.uint8)
    fill_turns(frames)
    offset, gain = (np.asarray(float(value)) for value in (OFFSET, GAIN))
    header = Header(
        "axial", pixel_size=(PIXEL, PIXEL), tilt=TILT, press=1.0, zenith_gain=gain, zenith_offset=offset
    )
    source: Any = Memory(header, (256, *shape))
    live = LiveRun(source, engine.Rotation(window_frames=8, device=device))
    numbers = iter(range(256))

    def push() -> object:
        n = next(numbers)
        phase = np.array([2 * np.pi / 8 * n])
        live.push_block(Block(frames[n % 8][np.newaxis], n, time=np.array([n / 66]), phase=phase))
        return live.maps()

    for _ in range(16):  # a full window, and the first heights
        push()
    return push


def measure(name: str, call: Call, device: Device, rounds: int, seconds: float) -> Row:
    """Call at least twice, then up to so many rounds or seconds; return the times and the last account."""
    walls: list[float] = []
    begin = time.monotonic()
    while len(walls) < 3 or (len(walls) < rounds + 1 and time.monotonic() - begin < seconds):
        device.finish()
        device.profile.clear()
        start = time.perf_counter()
        kept = call()
        walls.append(time.perf_counter() - start)
        del kept
    return {
        "call": name,
        "first_ms": 1e3 * walls[0],
        "ms": 1e3 * float(np.median(walls[1:])),
        **account(device),
    }


def account(device: Device) -> Row:
    """Return what was done since the profile was cleared."""
    records = device.profile.records()
    row: Row = {}
    for kind in ("kernel", "upload", "download"):
        mine = [record for record in records if record.kind == kind]
        row[f"{kind}s"] = sum(record.runs for record in mine)
        row[f"{kind}_MB"] = sum(record.bytes for record in mine) / 1e6
        row[f"{kind}_ms"] = 1e3 * sum(record.seconds for record in mine)
    row["waits"] = sum(record.runs for record in records if record.kind == "wait")
    kernels = [record for record in records if record.kind == "kernel"][:LONGEST]
    row["longest"] = {kernel.name: [kernel.runs, round(1e3 * kernel.seconds, 4)] for kernel in kernels}
    return row
