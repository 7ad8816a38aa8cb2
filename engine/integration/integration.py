"""Heights from slopes: `integrate`, and `Integrator` for frame after frame."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mirrorskin.engine.integration.camera import Camera
from mirrorskin.engine.integration.surface import SolverOptions, Surface, SurfaceSolver
from mirrorskin.engine.integration.validation import (
    Inputs,
    check_above_zero,
    check_inputs,
    check_map,
    check_pixel_size,
    logarithm,
)
from mirrorskin.engine.thread_safe import ThreadSafe
from mirrorskin.io import InputError
from mirrorskin.io.arguments import checked
from mirrorskin.kernels.device import Device, open_device

# The memory of the last call, some 100 bytes a pixel, stays with the device for the next one: making it takes
# as long as a solution (512 x 512 within a mask: 12 ms instead of 26). Not above so many pixels.
_KEPT = 2**23


@checked
def integrate(
    dz_dx: ArrayLike | None = None,
    dz_dy: ArrayLike | None = None,
    pixel_size: ArrayLike | None = None,
    *,
    normals: ArrayLike | None = None,
    camera: Camera | None = None,
    mask: ArrayLike | None = None,
    slope_weights: ArrayLike | None = None,
    edges: ArrayLike | None = None,
    known_heights: ArrayLike | None = None,
    known_height_weights: ArrayLike | None = None,
    robust: bool = False,
    bilateral_sharpness: float = 2.0,
    sigma: bool = True,
    initial_heights: ArrayLike | None = None,
    tolerance: float | None = 1e-5,
    budget: float | None = None,
    device: str | Device | None = None,
) -> Surface:
    """Find the heights that fit slopes, and heights where they are known, best.

    Neighbours i and j with slopes are linked. The heights u are those of the least ::

        sum of w (u_j - u_i - d)^2  +  sum of a (u_i - k_i)^2

    over all links and known heights k; d is the pixel size times the slope of the link, which is
    (-s[-1] + 13 s[0] + 13 s[1] - s[2]) / 24 of four pixels in line where links lead through all of them, else
    the mean of two. w is the harmonic mean of both pixels' weights over the pixel size squared, a the weight
    of the known height. The border is free (natural boundary). A full rectangle with even weights is solved
    directly, all else by conjugate gradients with multigrid.

    Parameters
    ----------
    dz_dx, dz_dy : array_like, (H, W) or (K, H, W), optional
        Slopes along x (to the right) and along y, which runs up the picture. Not finite where there is none.
        Of K surfaces with all else the same: they are solved together, several times as fast as one by one. A
        pixel has slopes where all surfaces have; the first one says to which neighbour ``edges`` are linked.
    pixel_size : array_like, optional
        Millimetres, one number or (x, y). Left out with a camera.
    normals : array_like, (H, W, 3), optional
        Surface normals in place of slopes: along x, y and z, which runs towards the camera; of any length.
        Not finite or 0 where there is none; where the surface faces away, or is seen within 0.6 degrees of
        edge-on, they count as none.
    camera : mirrorskin.engine.integration.Camera, optional
        What saw the normals; by default one so far away that all lines of sight are along z. With a camera,
        ``height``, known and initial heights are *depths* Z > 0: distances from the pinhole along the optical
        axis, which grow away from the camera. The logarithm of Z is integrated: a pixel to the right it rises
        by n_x / (n . v) over the focal length, a pixel up by n_y / (n . v), v = (x, y, 1) along the line of
        sight to the camera. No normal says how large things are: a component without a known depth has the
        geometric mean 1.
    mask : array_like, (H, W), optional
        0 where no answer is wanted.
    slope_weights : array_like, scalar, (H, W) or (2, H, W), optional
        Inverse variances of the slopes, or of dz_dx and of dz_dy; with ``normals`` those of unit normals,
        1/rad^2, and a slope's is (n . v)^2 of it, v = (0, 0, 1) without a camera. 0 where there is none. By
        default all are equally noisy, and ``sigma`` is estimated from how well they fit together. What is
        below 1e-4 or above 1e3 of the slopes' median counts as that; what is 0 in float32, as 0.
    edges : array_like, (H, W), optional
        Not 0 on pixels where the surface breaks: they keep but one link, to that neighbour off the edge whose
        slopes are the most similar, and so never join two sides.
    known_heights : array_like, (H, W), optional
        Known heights, mm, or depths in any unit; NaN elsewhere. They need no slope.
    known_height_weights : array_like, scalar or (H, W), optional
        Their inverse variances, 1/mm^2 (1 over the square of the depths' unit); 0 where nothing is known. 1
        by default. What is above 1e4 of a link's weight w counts as that.
    robust : bool
        Whether to look for discontinuities beyond ``edges``.
    bilateral_sharpness : float
        How sharply, 1/pixel^2: links that miss their slopes by more than 2.4 over the root of 2 k are cut.
    sigma : bool
        Whether to find the standard deviation of the heights, in about the time of the heights themselves.
    initial_heights : array_like, (H, W), optional
        Heights to begin with, NaN where there is none.
    tolerance : float or None
        Of the residual, which is `Surface.residual`; parts of small weight may be less near. None takes what
        two cycles give.
    budget : float, optional
        Seconds, in place of the tolerance: after the first, no cycle is begun that would end later. Neither
        the set-up nor ``sigma`` is cut.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.

    Returns
    -------
    Surface

    Raises
    ------
    mirrorskin.io.InputError
        Maps that do not fit each other, or of which nothing can be used; numbers out of range.
    NotConverged
        The tolerance was not met.
    mirrorskin.kernels.errors.DeviceError
        No device, or one without room for the maps.

    Examples
    --------
    >>> import numpy as np
    >>> from mirrorskin import engine
    >>> surface = engine.integrate(np.full((2, 3), 0.5), np.zeros((2, 3)), 1.0)
    >>> round(float(surface.height[0, 2]), 6)
    0.5
    """
    began = time.perf_counter()
    inputs = check_inputs(
        *(dz_dx, dz_dy, pixel_size, mask, slope_weights, edges, known_heights, known_height_weights),
        normals=normals,
        camera=camera,
        robust=robust,
        crop=True,
        several=not robust and initial_heights is None,
    )
    check_above_zero(bilateral_sharpness=bilateral_sharpness, tolerance=tolerance, budget=budget)
    start = None
    if initial_heights is not None:
        start = check_map("initial_heights", initial_heights, inputs.picture)[inputs.box]
        start = start.astype(np.float64) if camera is None else logarithm("initial_heights", start)
    options = SolverOptions(
        tolerance=tolerance,
        deadline=None if budget is None else began + budget,
        sharpness=bilateral_sharpness if robust else None,
        sigma=sigma,
    )
    with _borrowed_solver(open_device(device), inputs) as solver:
        surface = solver.solve(inputs, options, start)
    if camera is not None:
        depth = np.exp(surface.height)
        deviation = None if surface.sigma is None else depth * surface.sigma
        surface = replace(surface, height=depth, sigma=deviation)
    return surface if inputs.shape == inputs.picture else _put_back(surface, inputs)


def _put_back(surface: Surface, inputs: Inputs) -> Surface:
    """Return the surface of the picture that a box was cut out of."""
    maps: dict[str, Any] = {}
    for name, rest in {"height": np.nan, "sigma": np.nan, "component": -1, "filled": 0, "edges": 0}.items():
        part = getattr(surface, name)
        if part is not None:
            maps[name] = np.full((*part.shape[:-2], *inputs.picture), rest, part.dtype)
            maps[name][(..., *inputs.box)] = part
    return replace(surface, **maps, invalid=surface.invalid + inputs.lost)


@contextmanager
def _borrowed_solver(device: Device, inputs: Inputs) -> Iterator[SurfaceSolver]:
    """Take the last call's solver if it fits, and give it back."""
    key = inputs.shape, inputs.pixel_size
    kept, solver = device.spare.pop("integration", (None, None))  # at once, so that no two threads have it
    if kept != key:
        solver = SurfaceSolver(device, inputs.shape)
    yield solver  # one that failed is not kept
    solver.reset()
    if math.prod(inputs.shape) <= _KEPT:
        device.spare["integration"] = key, solver


class Integrator(ThreadSafe):
    """Integrate slopes frame after frame: memory is kept, and heights start from the last ones.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of the maps.
    pixel_size : array_like
        Millimetres, one number or (x, y).
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.

    Examples
    --------
    >>> import numpy as np
    >>> from mirrorskin import engine
    >>> integrator = engine.Integrator((2, 3), 1.0)
    >>> for slope in (0.25, 0.5):
    ...     integrator.push(np.full((2, 3), slope), np.zeros((2, 3)))
    >>> round(float(integrator.result().height[0, 2]), 6)
    0.5
    """

    def __init__(
        self, shape: tuple[int, int], pixel_size: ArrayLike, *, device: str | Device | None = None
    ) -> None:
        self._shape, self._pixel_size = tuple(shape), check_pixel_size(pixel_size)
        self._solver = SurfaceSolver(open_device(device), shape)
        self._surface: Surface | None = None

    def push(
        self,
        dz_dx: ArrayLike,
        dz_dy: ArrayLike,
        *,
        mask: ArrayLike | None = None,
        slope_weights: ArrayLike | None = None,
        edges: ArrayLike | None = None,
        known_heights: ArrayLike | None = None,
        known_height_weights: ArrayLike | None = None,
        budget: float | None = None,
        tolerance: float | None = None,
    ) -> None:
        """Integrate the slopes of one frame, without the heights' sigma.

        The maps are those of `mirrorskin.engine.integrate`. By default two cycles are done, from the last
        frame's heights on.

        Parameters
        ----------
        budget : float, optional
            Seconds; after the first, cycles are done as long as they end in time, and until they are of no
            more use.
        tolerance : float, optional
            Of the residual; with a budget it may be missed.

        Raises
        ------
        mirrorskin.io.InputError
            Maps that cannot be used, or of another shape than the integrator's.
        NotConverged
            The tolerance was not met, without a budget.
        """
        began = time.perf_counter()
        inputs = check_inputs(
            dz_dx, dz_dy, self._pixel_size, mask, slope_weights, edges, known_heights, known_height_weights
        )
        if inputs.shape != self._shape:
            raise InputError(f"slopes have shape {inputs.shape}, not {self._shape}: make another Integrator")
        check_above_zero(tolerance=tolerance, budget=budget)
        self._surface = None
        deadline = None if budget is None else began + budget
        self._surface = self._solver.solve(inputs, SolverOptions(tolerance=tolerance, deadline=deadline))

    def result(self) -> Surface:
        """Return the surface of the last frame.

        Raises
        ------
        mirrorskin.io.InputError
            There was none, or it had none.
        """
        if self._surface is None:
            raise InputError("there is no surface yet: push the slopes of a frame first")
        return self._surface

    def reset(self) -> None:
        """Forget the last frame's heights: the next frame has nothing to do with it."""
        self._surface = None
        self._solver.reset()
