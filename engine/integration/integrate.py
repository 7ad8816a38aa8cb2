"""Heights from slopes: the call."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import ArrayLike

from mirrorskin.engine.integration.inputs import Inputs, check_above_zero, check_inputs, fitting
from mirrorskin.engine.integration.solver import SurfaceSolver, Wish
from mirrorskin.engine.integration.surface import Surface
from mirrorskin.kernels.device import Device, open_device

_KEPT = 2**21  # pixels up to which the room of the last call, some 100 bytes each, is kept for the next
_spare: list[tuple[tuple[Device, tuple[int, int], tuple[float, float]], SurfaceSolver]] = []


def integrate(
    dz_dx: ArrayLike,
    dz_dy: ArrayLike,
    pixel_size: ArrayLike,
    *,
    mask: ArrayLike | None = None,
    weights: ArrayLike | None = None,
    edges: ArrayLike | None = None,
    heights: ArrayLike | None = None,
    height_weights: ArrayLike | None = None,
    robust: bool = False,
    k: float = 2.0,
    sigma: bool = True,
    start: ArrayLike | None = None,
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
    of the known height. Nothing is asked of the surface's border. What is full and even all over is solved
    directly, all else by conjugate gradients with multigrid.

    Parameters
    ----------
    dz_dx, dz_dy : array_like, (H, W)
        Slopes along x (to the right) and along y, which runs up the picture. Not finite where there is none.
    pixel_size : array_like
        Millimetres, one number or (x, y).
    mask : array_like, (H, W), optional
        0 where no answer is wanted.
    weights : array_like, scalar, (H, W) or (2, H, W), optional
        Inverse variances of the slopes, or of dz_dx and of dz_dy; 0 where there is none. By default all are
        as noisy as each other; how noisy that is, for ``sigma``, is told from how well they fit together.
        What is below 1e-4 or above 1e3 of their median counts as that; what is 0 in float32, as 0.
    edges : array_like, (H, W), optional
        Not 0 on pixels where the surface breaks: they keep but one link, to that neighbour off the edge whose
        slopes are the most similar, and so never join two sides.
    heights : array_like, (H, W), optional
        Known heights, mm; NaN elsewhere. They need no slope.
    height_weights : array_like, scalar or (H, W), optional
        Their inverse variances, 1/mm^2; 0 where nothing is known. 1 by default. What is above 1e4 of a link's
        weight w counts as that: such a height stands against all that slopes say, but for a part in 1e4.
    robust : bool
        Whether to look for discontinuities that ``edges`` do not tell, by bilateral weights.
    k : float
        How sharply these choose a side, 1/pixel^2 (Cao et al., Bilateral normal integration, 2022).
    sigma : bool
        Whether to tell how sure the heights are; this takes as long as 80 hasty solves.
    start : array_like, (H, W), optional
        Heights to begin with, NaN where there is none.
    tolerance : float or None
        Of the residual: how far the heights are from the solution, as the sum above weighs it, over the
        heights themselves, both without the plane that the slopes lean with; parts of small weight may be
        less near. None takes what full multigrid and two cycles give.
    budget : float, optional
        Seconds, in place of the tolerance: after the first, no cycle is begun that would end later. The
        set-up is not cut.
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
    """
    began = time.perf_counter()
    inputs = check_inputs(
        dz_dx,
        dz_dy,
        pixel_size,
        mask=mask,
        weights=weights,
        edges=edges,
        heights=heights,
        height_weights=height_weights,
    )
    check_above_zero(k=k, tolerance=tolerance, budget=budget)
    first = None if start is None else fitting("start", start, inputs.shape).astype(np.float64)
    deadline = None if budget is None else began + budget
    wish = Wish(tolerance=tolerance, deadline=deadline, k=k if robust else None, sigma=sigma)
    with _solver(open_device(device), inputs) as solver:
        return solver.solve(inputs, wish, first)


@contextmanager
def _solver(device: Device, inputs: Inputs) -> Iterator[SurfaceSolver]:
    """Lend the last call's solver if it fits, for making its room takes as long as a solution."""
    key = device, inputs.shape, inputs.pixel_size
    try:
        kept, solver = _spare.pop()  # at once, so that no two threads have it
    except IndexError:
        kept, solver = None, None
    if solver is None or kept != key:
        solver = SurfaceSolver(device, inputs.shape)
    yield solver  # one that failed is not kept
    solver.restart()
    if math.prod(inputs.shape) <= _KEPT and not _spare:
        _spare.append((key, solver))
