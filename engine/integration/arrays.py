"""Heights from slopes or normals in arrays; see `mirrorskin.engine.integrate`."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from mirrorskin.engine.base.device_arrays import AnyArray, device_of, on_host
from mirrorskin.engine.integration.camera import Camera
from mirrorskin.engine.integration.device_inputs import check_device_inputs
from mirrorskin.engine.integration.slope_errors import add_gain
from mirrorskin.engine.integration.surface import IntegrationOptions, SurfaceSolver
from mirrorskin.engine.integration.validation import Inputs, check_inputs, check_map, logarithm
from mirrorskin.io import Result, pixel_axes
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.device import Device

# Maximum number of pixels for which the memory of the last call is cached on the device, about 100 bytes per
# pixel: allocation takes as long as a solution (512 x 512 within a mask: 12 ms with the cache, 26 without).
_LARGEST_CACHED = 2**23
_OUTSIDE = {"height": np.nan, "height_sigma": np.nan, "component": -1, "filled": 0, "edges": 0}


def integrate_arrays(
    dz_dx: AnyArray = None,
    dz_dy: AnyArray = None,
    pixel_size: Any = None,
    *,
    normals: AnyArray = None,
    camera: Camera | None = None,
    mask: Any = None,
    slope_weights: Any = None,
    edges: Any = None,
    known_heights: Any = None,
    known_height_weights: Any = None,
    initial_heights: Any = None,
    **options: Any,
) -> Result:
    """Return the surface of slopes or normals in arrays."""
    on_device = any(isinstance(values, Array) for values in (dz_dx, dz_dy, normals))
    if on_device:
        options["device"] = device_of(options.get("device"), dz_dx, dz_dy, normals)
    chosen = IntegrationOptions(**options)
    others = camera, known_heights, initial_heights
    one_weight = slope_weights is None or np.ndim(slope_weights) == 0
    if on_device and one_weight and not chosen.robust and all(values is None for values in others):
        inputs = check_device_inputs(dz_dx, dz_dy, normals, pixel_size, mask, slope_weights, edges)
    else:
        dz_dx, dz_dy, normals = (on_host(values) for values in (dz_dx, dz_dy, normals))
        inputs = check_inputs(
            *(dz_dx, dz_dy, pixel_size, mask, slope_weights, edges, known_heights, known_height_weights),
            normals=normals,
            camera=camera,
            robust=chosen.robust,
            crop=True,
            several=not chosen.robust and initial_heights is None,
        )
    start = None
    if initial_heights is not None:
        start = check_map("initial_heights", initial_heights, inputs.picture)[inputs.box]
        start = start.astype(np.float64) if camera is None else logarithm("initial_heights", start)
    with _cached_solver(chosen.device, inputs) as solver:
        result = add_gain(solver.solve(inputs, chosen, start), chosen.slope_gain_sigma)
    if camera is not None:
        depth = np.exp(result.height)
        sigma = None if result.height_sigma is None else depth * result.height_sigma
        result = result.assign(height=depth, height_sigma=sigma)
    else:
        x, y = pixel_axes(inputs.picture, inputs.pixel_size)
        result = result.assign(x=x, y=y)
    return result if inputs.shape == inputs.picture else _uncropped(result, inputs)


def _uncropped(result: Result, inputs: Inputs) -> Result:
    """Return the maps of the whole picture."""
    maps = {}
    for name, part in result.maps().items():
        maps[name] = np.full((*part.shape[:-2], *inputs.picture), _OUTSIDE[name], part.dtype)
        maps[name][(..., *inputs.box)] = part
    invalid = (result.fitted.integration_invalid or 0) + inputs.lost
    return result.assign(maps).with_fitted(integration_invalid=invalid)


@contextmanager
def _cached_solver(device: Device, inputs: Inputs) -> Iterator[SurfaceSolver]:
    """Use the solver of the last call again if it fits, and keep it for the next call."""
    key = inputs.shape, inputs.pixel_size
    cached_key, solver = device.cache.pop("integration", (None, None))  # atomic: one thread gets it
    if cached_key != key:
        solver = SurfaceSolver(device, inputs.shape)
    yield solver  # after an exception it is not kept
    solver.reset()
    if math.prod(inputs.shape) <= _LARGEST_CACHED:
        device.cache["integration"] = key, solver
