"""Steps that follow the normals of a rotation: edges, and heights."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.base.options import option
from mirrorskin.engine.base.steps import Context, Step
from mirrorskin.engine.diagnosis.normals_uncertainty import SystematicUncertainty
from mirrorskin.engine.diagnosis.registration import Registered
from mirrorskin.engine.integration.normals_to_height import (
    Slopes,
    integrate_result,
    separate_errors,
    slopes_of,
)
from mirrorskin.engine.rotation.edges import find_edges
from mirrorskin.io import Result
from mirrorskin.io.base.findings import merged

_NO_PIXEL_SIZE = "none: the recording has no pixel size"
_SLOPES = "dz_dx", "dz_dy", "dz_dx_weight", "dz_dy_weight"  # maps of `SlopeMaps`


class Edges(Step):
    """Draw edges where the normal jumps and where contact ends; see `mirrorskin.engine.find_edges`.

    Corrections of normals and of their errors, which are smooth, do not change them.
    """

    needs = ("normals", "normals_sigma", "contact")

    def apply(self, result: Result, context: Context) -> Result:
        """Return the result with ``edges``."""
        computed, device = context.computed, context.operation.device
        maps = computed.normals, computed.normals_sigma, computed.contact
        if computed.contact.ndim == 2:
            return result.assign(edges=find_edges(*maps, device=device))
        turns = [find_edges(*turn, device=device) for turn in zip(*maps, strict=True)]
        return result.assign(edges=np.stack(turns))


class Integration(Step):
    """Find the heights that fit the normals; the mean height of each connected component is 0.

    Needs the pixel size.
    """

    needs = ("normals", "normals_sigma", "contact")

    robust: bool = option(
        default=False,
        help="let the surface break at discontinuities that are found in it; they are drawn as edges, too",
    )

    def apply(self, result: Result, context: Context) -> Result:
        """Return the result with ``height``, ``component`` and ``offset_unknown``."""
        pixel_size = context.source.header.pixel_size
        if pixel_size is None:
            return result.assign(process={**result.process, "height": _NO_PIXEL_SIZE})
        surface = integrate_result(
            _without_response(result, context),
            pixel_size,
            robust=self.robust,
            device=context.operation.device,
            noise_gain=_noise_gain(context),
        )
        if surface.edges is not None and result.edges is not None:
            surface = surface.assign(edges=result.edges | surface.edges)
        process = merged(result.process, surface.process)
        return result.assign(surface, process=process, fitted=result.fitted | surface.fitted)


class SlopeMaps(Step):
    """Add the slopes that `Integration` would integrate, as maps; see `take_slopes`."""

    needs = ("normals", "normals_sigma", "contact")

    def apply(self, result: Result, context: Context) -> Result:
        """Return the result with slopes along x and y, and their weights."""
        slopes = slopes_of(*separate_errors(_without_response(result, context), _noise_gain(context)))
        return result.assign(dict(zip(_SLOPES, (slopes.dz_dx, slopes.dz_dy, *slopes.weights), strict=True)))


def take_slopes(result: Result) -> tuple[Result, Slopes]:
    """Return a result without the maps of `SlopeMaps`, and the slopes."""
    dz_dx, dz_dy, *weights = (result[name] for name in _SLOPES)
    return result.assign(dict.fromkeys(_SLOPES)), Slopes(dz_dx, dz_dy, np.stack(weights))


def _without_response(result: Result, context: Context) -> Result:
    """Return a result without the errors of a calibrated response, which differ from pixel to pixel."""
    if getattr(context.operation, "response", None) is None:
        return result
    return result.assign(normals_sigma=context.before(SystematicUncertainty, result).normals_sigma)


def _noise_gain(context: Context) -> NDArray[np.float32] | None:
    """Return the factor of the noise of registered samples; None if frames were not registered."""
    return context.stream.noise_gain if isinstance(context.stream, Registered) else None
