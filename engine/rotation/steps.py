"""Steps that follow the normals of a rotation: edges, and heights."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.options import option
from mirrorskin.engine.rotation.edges import find_edges
from mirrorskin.engine.rotation.normals_to_height import Slopes, integrate_normals, slopes_of
from mirrorskin.engine.rotation.normals_uncertainty import SystematicUncertainty
from mirrorskin.engine.rotation.registration import Registered
from mirrorskin.engine.steps import Context, Step
from mirrorskin.io import Result

if TYPE_CHECKING:
    from mirrorskin.engine.rotation.normals import Normals

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
        integrated, sigma = _without_systematic(result, context)
        device = context.operation.device
        surface = integrate_normals(integrated, sigma, pixel_size, robust=self.robust, device=device)
        if surface.edges is not None and result.edges is not None:
            surface = surface.assign(edges=result.edges | surface.edges)
        for share in _common_shares(integrated, context):
            sigma = np.hypot(surface.height_sigma, np.float32(share) * surface.height)
            surface = surface.assign(height_sigma=sigma)
        process = {**result.process, **surface.process}
        return result.assign(surface, process=process, fitted=result.fitted | surface.fitted)


class SlopeMaps(Step):
    """Add the slopes that `Integration` would integrate, as maps; see `take_slopes`."""

    needs = ("normals", "normals_sigma", "contact")

    def apply(self, result: Result, context: Context) -> Result:
        """Return the result with slopes along x and y, and their weights."""
        slopes = slopes_of(*_without_systematic(result, context))
        return result.assign(dict(zip(_SLOPES, (slopes.dz_dx, slopes.dz_dy, *slopes.weights), strict=True)))


def take_slopes(result: Result) -> tuple[Result, Slopes]:
    """Return a result without the maps of `SlopeMaps`, and the slopes."""
    dz_dx, dz_dy, *weights = (result[name] for name in _SLOPES)
    return result.assign(dict.fromkeys(_SLOPES)), Slopes(dz_dx, dz_dy, np.stack(weights))


def _without_systematic(result: Result, context: Context) -> tuple[Result, NDArray[np.float32]]:
    """Return a result without errors of the response, and the errors that differ from pixel to pixel.

    Those of pixels are without registration: it reduces errors but correlates those of neighbours, so that
    means over many pixels are not better.
    """
    result = result.assign(normals_sigma=context.before(SystematicUncertainty, result).normals_sigma)
    sigma: NDArray[np.float32] = result.normals_sigma
    if context.operation.corrected_kinds:
        common = cast("Normals", context.operation).systematic_sigma(result.normals)
        sigma = np.sqrt(np.maximum(sigma**2 - common**2, 0))
    if isinstance(context.stream, Registered):
        sigma = sigma / context.stream.noise_gain
    return result, sigma


def _common_shares(result: Result, context: Context) -> list[float]:
    """Return by which shares all heights may be wrong together.

    Errors of slopes that are common to all pixels, such as those of the light of a frame, change slopes, and
    with them heights, by about the same share everywhere.
    """
    shares = []
    if context.operation.corrected_kinds:
        cosine = result.normals[..., 2].astype(np.float64)
        error = cast("Normals", context.operation).systematic_sigma(result.normals) / cosine**2
        known = np.isfinite(error) & (result.contact > 0)
        steepness = np.sqrt(1 / cosine[known] ** 2 - 1)
        shares.append(math.sqrt(float(np.mean(error[known] ** 2) / np.mean(steepness**2))))
    swing = result.fitted.swing_range
    return shares if swing is None else [*shares, swing]
