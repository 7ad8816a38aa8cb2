"""What the twin's frames go through: ``wall.cl`` and ``exposure.cl``."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.sweep.sweep import FRAME_TYPES, MAPS_ONLY, Family, Job, Shape, agree, run_kernel
from mirrorskin.hw.twin.optics import fade_angle, scatter_rays
from mirrorskin.kernels.device import C_TYPES, Device
from mirrorskin.kernels.exposure import expose
from mirrorskin.kernels.wall import wall_light

_RADIUS, _RIM, _INDEX = 17.5, 40.0, 1.41  # of the paper's body, mm
_SCATTER = float(np.radians(3))
_RAY = 60  # multiply-adds of a ray, roots included
_NOISE = 55  # multiply-adds of a sample: two polynomials, roots, a bend; Philox' integers are not counted
_SCALE = {"uint8": 1.0, "uint16": 16.0, "float32": 1.0}  # counts of a count of 8 bits
_READ, _GRAIN = 1.5, 1 / 40  # noise, and counts of an electron, of 8 bits


def _make_wall(device: Device, shape: Shape, _kind: str, _: int) -> dict[str, Job]:
    """Return the light of a wall that fades towards its rim, in a bumpy sheet of 12 mm."""
    sheet, places = _sheet(shape)
    rays, rows = scatter_rays(_SCATTER), 64
    table = np.repeat(np.linspace(0.2, 1, rows + 2)[:, np.newaxis], 3, axis=1)
    given = sheet, places, np.asarray(rays, np.float32), table.astype(np.float32)
    arrays = [
        device.given(name, one) for name, one in zip(("sheet", "places", "rays", "table"), given, strict=True)
    ]
    light = device.given("light", np.zeros(shape))
    pixels = shape[0] * shape[1]
    numbers = _RADIUS, _RIM, 0.0, _INDEX, _SCATTER, fade_angle(_SCATTER), 0.0, 0.0
    sizes = pixels, len(rays), rows, 1
    moved = pixels * (12 + 8 + 4)

    def launch() -> None:
        kernel = device.kernel("wall", "wall_light", TABLE=1, GAP=0, LAMPS=0, OBLIQUE=0)
        arguments: dict[str, Any] = dict(
            zip(kernel.arguments, [*sizes, *arrays, *numbers, light], strict=True)
        )
        kernel(-(-pixels // device.layout.tile), **arguments, moved=moved)

    def check() -> None:
        launch()
        expected = wall_light(*given, *numbers).reshape(shape)
        agree("wall_light", light.download(), expected, 1e-3)
        agree("wall_light", light.download(), expected, 2e-5, pixels // 50)

    return {"wall_light": Job(run_kernel(device, launch), moved, check, 0, pixels * len(rays) * _RAY)}


def _sheet(shape: Shape) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return height and slopes of a sheet on waves as steep as 42 degrees, and where its pixels are."""
    y, x = (6.0 * np.linspace(-1, 1, size, dtype=np.float32) * size / max(shape) for size in shape)
    wide, high = np.broadcast_to(x, shape), np.broadcast_to(y[:, np.newaxis], shape)
    height = 1.5 + 0.9 * np.sin(wide) * np.cos(high)
    slopes = 0.9 * np.cos(wide) * np.cos(high), -0.9 * np.sin(wide) * np.sin(high)
    maps = np.stack([height, *slopes]).reshape(3, -1), np.stack([wide, high]).reshape(2, -1)
    return maps[0].astype(np.float32), maps[1].astype(np.float32)


def _make_exposure(device: Device, shape: Shape, kind: str, _: int) -> dict[str, Job]:
    """Return the exposure of one frame, with shot and read noise."""
    scale, generator = _SCALE[kind], np.random.default_rng(0)
    quarter = -(-shape[0] * shape[1] // 4)
    light = generator.random(4 * quarter, np.float32)
    offset = scale * (16 + generator.standard_normal(4 * quarter, np.float32))
    span = scale * (200 + 5 * generator.standard_normal(4 * quarter, np.float32))
    maps = light, offset.astype(np.float32), span.astype(np.float32)
    arrays = [device.given(name, one) for name, one in zip(("light", "offset", "span"), maps, strict=True)]
    counts = device.given("counts", np.zeros(4 * quarter), kind)
    top = 0.0 if kind == "float32" else float(np.iinfo(kind).max)
    reals = _READ * scale, _GRAIN * scale, top
    moved = 4 * quarter * (12 + np.dtype(kind).itemsize)

    def launch() -> None:
        kernel = device.kernel(
            "exposure", "expose", FRAME=C_TYPES[kind], WHOLE=int(kind != "float32"), SHOT=1
        )
        arguments: dict[str, Any] = dict(
            zip(kernel.arguments, [*arrays, quarter, 5, 9, *reals, counts], strict=True)
        )
        kernel(-(-quarter // device.layout.tile), **arguments, moved=moved)

    def check() -> None:
        launch()
        expected = np.empty(4 * quarter, kind)
        expose(*maps, 5, 9, *reals, expected)
        near = 1e-5 * 256 if kind == "float32" else 0
        agree("expose", counts.download(), expected, near, max(1, quarter // 250))

    operations = 4 * quarter * _NOISE
    return {"expose": Job(run_kernel(device, launch), moved, check, 1, operations)}


WALL = Family(
    "sweep-wall",
    f"wall.cl: light of a wall in a sheet, {len(scatter_rays(_SCATTER))} rays a pixel",
    _make_wall,
    MAPS_ONLY,
    "triad",
    80,
    f"bytes are those of sheet, places and light; {_RAY} multiply-adds a ray, as if no pixel "
    "were dark at once",
)
EXPOSURE = Family(
    "sweep-exposure",
    "exposure.cl: one frame with shot and read noise",
    _make_exposure,
    FRAME_TYPES,
    "triad",
    60,
    f"bytes are those of light, offset, span and counts; {_NOISE} multiply-adds a sample, and besides them "
    "the integers of Philox, which bind on most devices",
)
