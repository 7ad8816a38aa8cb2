"""Heights of frame after frame: what one frame found is where the next one starts."""

from __future__ import annotations

import time

from numpy.typing import ArrayLike

from mirrorskin.engine.integration.inputs import check_above_zero, check_inputs, check_pixel_size
from mirrorskin.engine.integration.solver import SurfaceSolver, Wish
from mirrorskin.engine.integration.surface import Surface
from mirrorskin.io import InputError
from mirrorskin.kernels.device import Device, open_device


class Integrator:
    """Integrate slopes again and again: its room on the device stays, and heights start from the last ones.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of the maps.
    pixel_size : array_like
        Millimetres, one number or (x, y).
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.
    """

    def __init__(
        self, shape: tuple[int, int], pixel_size: ArrayLike, *, device: str | Device | None = None
    ) -> None:
        self._shape, self._pixel_size = tuple(shape), check_pixel_size(pixel_size)
        self._solver = SurfaceSolver(open_device(device), shape)

    def integrate(
        self,
        dz_dx: ArrayLike,
        dz_dy: ArrayLike,
        *,
        mask: ArrayLike | None = None,
        weights: ArrayLike | None = None,
        edges: ArrayLike | None = None,
        heights: ArrayLike | None = None,
        height_weights: ArrayLike | None = None,
        budget: float | None = None,
        tolerance: float | None = None,
    ) -> Surface:
        """Return the surface of one frame, without its sigma.

        The maps are those of `mirrorskin.engine.integrate`. By default two cycles after the last frame's
        heights must do.

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
            Maps that cannot be used, or of another size than was said.
        NotConverged
            The tolerance was not met, without a budget.
        """
        began = time.perf_counter()
        inputs = check_inputs(
            dz_dx,
            dz_dy,
            self._pixel_size,
            mask=mask,
            weights=weights,
            edges=edges,
            heights=heights,
            height_weights=height_weights,
        )
        if inputs.shape != self._shape:
            raise InputError(f"slopes have shape {inputs.shape}, not {self._shape}: make another Integrator")
        check_above_zero(tolerance=tolerance, budget=budget)
        deadline = None if budget is None else began + budget
        return self._solver.solve(inputs, Wish(tolerance=tolerance, deadline=deadline))

    def restart(self) -> None:
        """Forget the last frame's heights: the next frame has nothing to do with it."""
        self._solver.restart()
