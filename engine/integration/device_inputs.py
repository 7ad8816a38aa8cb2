"""Inputs of an integration whose slopes or normals are on a device."""

from __future__ import annotations

import math
from typing import Any, cast

import numpy as np

from mirrorskin.engine.integration.camera import EDGE_ON
from mirrorskin.engine.integration.validation import (
    LEAST,
    MOST,
    SAMPLES,
    Floats,
    Inputs,
    as_marks,
    check_one_source,
    median_weight,
    noise_variance,
    split_weights,
)
from mirrorskin.io import InputError
from mirrorskin.io.base.arguments import check_pixel_size
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.numerics.samples import take_samples

_CHUNK = 256  # columns of a work-item on a CPU; see facing.cl


def check_device_inputs(
    dz_dx: Any, dz_dy: Any, normals: Any, pixel_size: Any, mask: Any, slope_weights: Any, edges: Any
) -> Inputs:
    """Return the result of `check_inputs` for slopes or normals on a device, with one weight for all."""
    check_one_source(dz_dx, dz_dy, normals)
    maps = [normals] if normals is not None else [dz_dx, dz_dy]
    axes = 3 if normals is not None else 2
    if (
        not all(
            isinstance(values, Array) and values.dtype == np.float32 and values.ndim == axes
            for values in maps
        )
        or any(values.shape != maps[0].shape for values in maps)
        or (normals is not None and maps[0].shape[2] != 3)
    ):
        kinds = ", ".join(f"{getattr(values, 'dtype', values)} {np.shape(values)}" for values in maps)
        expected = "normals (H, W, 3)" if axes == 3 else "two maps of slopes (H, W)"
        raise InputError(f"on the device are {kinds}: {expected} of float32 are needed")
    shape = maps[0].shape[:2]
    weight, _ = split_weights("slope_weights", slope_weights, shape)
    planes: list[Array] = []
    marks = as_marks("mask", mask, shape)
    if normals is not None:
        maps, planes = _find_slopes(normals, weight)
        if slope_weights is not None:
            maps, planes = _weigh_slopes(maps[0], maps[1], weight, marks)
    return Inputs(
        # Arrays on a device instead of NumPy's: solvers copy neither to nor from the host.
        dz_dx=cast(Floats, maps[0]),
        dz_dy=cast(Floats, maps[1]),
        pixel_size=check_pixel_size(pixel_size),
        mask=marks,
        edges=as_marks("edges", edges, shape),
        weight_x=cast(Floats, planes[0]) if planes else None,
        weight_y=cast(Floats, planes[1]) if len(planes) > 1 else None,
        typical_weight=_clip(planes) if planes else weight,
        weights_given=slope_weights is not None,
        picture=shape,
    )


def _find_slopes(normals: Array, weight: float) -> tuple[list[Array], list[Array]]:
    """Return slopes along x and y, and their weights; see `camera.find_slopes`."""
    device, shape = normals.device, normals.shape[:2]
    pixels = shape[0] * shape[1]
    names = "dz_dx", "dz_dy", "weight"
    x, y, weights = (device.array(name, shape, np.float32, zeroed=False) for name in names)
    device.kernel("facing", "facing_slopes")(
        -(-pixels // device.layout.tile), pixels=pixels, normals=normals, edge_on=EDGE_ON, unit=weight,
        dz_dx=x, dz_dy=y, weight=weights, moved=2 * normals.nbytes,
    )  # fmt: skip
    return [x, y], [weights]


def _weigh_slopes(dz_dx: Array, dz_dy: Array, weight: float, mask: Any) -> tuple[list[Array], list[Array]]:
    """Return slopes without the bias by noise, and their weights; see `camera.weigh_slopes`."""
    device, (rows, columns) = dz_dx.device, dz_dx.shape
    names = "unbiased_x", "unbiased_y", "weight_x", "weight_y"
    maps: dict[str, Any] = {name: device.array(name, dz_dx.shape, np.float32, zeroed=False) for name in names}
    marks: dict[str, Any] = {} if mask is None else {"mask": device.share("mask", mask)}
    device.kernel("facing", "facing_weigh", MASK=len(marks))(
        rows * -(-columns // min(device.layout.tile, _CHUNK)), rows=rows, columns=columns, dz_dx=dz_dx,
        dz_dy=dz_dy, variance=noise_variance(weight), unit=weight, **marks, **maps, moved=6 * dz_dx.nbytes,
    )  # fmt: skip
    x, y, *weights = maps.values()
    return [x, y], weights


def _clip(planes: list[Array]) -> float:
    """Clip maps of weights to the range that can be solved, and return their median."""
    typical = median_weight([sample_evenly(weights) for weights in planes])
    for weights in planes:
        device, pixels = weights.device, math.prod(weights.shape)
        device.kernel("facing", "facing_clip")(
            -(-pixels // device.layout.tile), pixels=pixels, lowest=typical * LEAST, highest=typical * MOST,
            weight=weights, moved=2 * weights.nbytes,
        )  # fmt: skip
    return typical


def sample_evenly(map_: Array) -> Floats:
    """Return enough pixels of a map for its median."""
    step = max(1, math.isqrt(math.prod(map_.shape) // SAMPLES))
    return sample_grid(map_, step, step)


def sample_grid(map_: Array, down: int, across: int) -> Floats:
    """Return every n-th pixel of a map, beginning in the middle of the first step."""
    rows, columns = map_.shape
    shape = len(range(down // 2, rows, down)), len(range(across // 2, columns, across))
    first, steps = down // 2 * columns + across // 2, (0, down * columns, across)
    samples: Floats = take_samples(map_, first, steps, (1, *shape))[0]
    return samples
