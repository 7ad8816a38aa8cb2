"""Heights from slopes: `integrate`, and `Integrator` for frame after frame."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from numpy.typing import ArrayLike

from mirrorskin.engine.base.device_arrays import as_any_array, as_any_array_or_number, device_of_maps
from mirrorskin.engine.base.inputs import Maps, is_maps, of_one_size, pixel_size_of, required_maps
from mirrorskin.engine.integration.arrays import integrate_arrays
from mirrorskin.engine.integration.camera import Camera
from mirrorskin.engine.integration.normals_to_height import integrate_result
from mirrorskin.engine.integration.surface import IntegrationOptions, SurfaceSolver
from mirrorskin.engine.integration.validation import check_inputs
from mirrorskin.io import InputError, Result, pixel_axes
from mirrorskin.io.base.arguments import Check, as_array_or_number, check_pixel_size, checked, in_unit
from mirrorskin.io.base.findings import carried
from mirrorskin.io.base.threads import ThreadSafe
from mirrorskin.io.model.maps import IN_PIXELS
from mirrorskin.kernels.device import Device, open_device

_MAPS: Mapping[str, Check] = {
    **dict.fromkeys(("dz_dx", "dz_dy"), as_any_array_or_number),
    **dict.fromkeys(("mask", "slope_weights", "edges", "known_height_weights"), as_array_or_number),
    "known_heights": in_unit("mm"),
}


def _or_maps(check: Check) -> Check:
    """Return a check that also allows maps with normals."""
    return lambda name, value: value if is_maps(value) else check(name, value)


@checked(
    **{**_MAPS, "dz_dx": _or_maps(as_any_array_or_number)},
    pixel_size=in_unit("mm"),
    normals=_or_maps(partial(as_any_array, components=True)),
    initial_heights=in_unit("mm"),
)
def integrate(
    dz_dx: Maps | None = None,
    dz_dy: ArrayLike | None = None,
    pixel_size: ArrayLike | None = None,
    *,
    normals: Maps | None = None,
    camera: Camera | None = None,
    mask: ArrayLike | None = None,
    slope_weights: ArrayLike | None = None,
    edges: ArrayLike | None = None,
    known_heights: ArrayLike | None = None,
    known_height_weights: ArrayLike | None = None,
    initial_heights: ArrayLike | None = None,
    **options: Any,
) -> Result:
    """Integrate slopes, or the normals of a result, to heights that fit them and known heights best.

    Neighbouring pixels i and j with slopes are linked. The heights u minimise ::

        sum of w (u_j - u_i - d)^2  +  sum of a (u_i - k_i)^2

    over all links and known heights k. d is the pixel size times the slope of the link: the fourth-order
    formula (-s[-1] + 13 s[0] + 13 s[1] - s[2]) / 24 of four pixels in line if links connect all of them,
    otherwise the mean of two. w is the harmonic mean of both pixels' weights over the pixel size squared, a
    the weight of the known height. The boundary is free (Neumann condition). A full rectangle with uniform
    weights is solved directly, everything else by conjugate gradients with multigrid.

    Slopes or normals of one surface that are on a device, in float32, stay there, and so does ``height``; see
    `mirrorskin.io.Result.on_device`. They are copied to the host first with ``robust``, a camera, known or
    initial heights, or a map of weights.

    The normals of a result are integrated as `reconstruct` integrates those of a rotation: weighted by their
    standard deviations, where there is contact, with the same heights and standard deviations, bit by bit.
    The result states which errors all normals have in common; an array of normals does not. Of the other
    arguments, only ``pixel_size``, ``robust`` and ``device`` are allowed then.

    Parameters
    ----------
    dz_dx, dz_dy : array_like or device array, (H, W) or (K, H, W), optional
        Slopes along x (to the right) and along y (up the picture); not finite where undefined. K surfaces
        with the same other arguments are solved together, several times as fast as one after the other. A
        pixel has slopes if all surfaces have them; the first surface determines the links of ``edges``.

        Instead of dz_dx also a Result, mapping, xarray.Dataset or path of a result file, with ``normals``,
        ``normals_sigma`` and, optionally, ``contact``.
    pixel_size : array_like, optional
        Millimetres, one number or (x, y); by default that of the result. Without one, heights are in pixels,
        and the result has no ``x`` and ``y``. Not allowed with a camera.
    normals : array_like or device array, (H, W, 3), optional
        Surface normals instead of slopes: components along x, y and z, which points to the camera; of any
        length. Not finite or 0 where undefined. Normals of surfaces that face away, or within 0.6 degrees of
        edge-on, are ignored. Or a result, as for dz_dx.
    camera : mirrorskin.engine.integration.Camera, optional
        The pinhole camera that saw the normals; by default all lines of sight are along z. With a camera,
        ``height``, known and initial heights are *depths* Z > 0: distances from the pinhole along the optical
        axis, which increase away from the camera. The logarithm of Z is integrated: it rises by n_x / (n . v)
        over the focal length from a pixel to the next one on the right, and by n_y / (n . v) to the one
        above, where v = (x, y, 1) points along the line of sight to the camera. Normals do not determine the
        scale: a component without a known depth has the geometric mean 1.
    mask : array_like, (H, W), optional
        0 where no height is wanted.
    slope_weights : array_like, scalar, (H, W) or (2, H, W), optional
        Inverse variances of the slopes, or of dz_dx and of dz_dy; 0 where undefined. With ``normals``,
        inverse variances of unit normals, 1/rad^2: the variances of slopes follow from them, and the bias of
        noise is removed from the slopes if the median of the standard deviations is at most 0.1 rad; see
        "Heights from slopes" in the documentation. By default all slopes, or normals, have the same noise,
        which is estimated from the misfit for ``height_sigma``. Weights are clipped to 1e-4 to 1e3 times the
        median; values that are 0 in float32 count as 0.
    edges : array_like, (H, W), optional
        Nonzero at pixels where the surface is discontinuous. Such a pixel keeps only one link, to the
        neighbour off the edge with the most similar slopes, so that it does not connect both sides.
    known_heights : array_like, (H, W), optional
        Known heights, in the unit of ``height``, or depths in any unit; NaN elsewhere. These pixels need
        no slope.
    known_height_weights : array_like, scalar or (H, W), optional
        Inverse variances of known heights, 1/mm^2 (or the inverse square of the unit of depths), 0 where
        unknown; default 1. Weights are clipped at 1e4 times the weight w of a link.
    initial_heights : array_like, (H, W), optional
        Heights to start from, NaN where undefined.
    **options
        ``robust``, ``bilateral_sharpness``, ``sigma``, ``slope_correlation``, ``slope_gain_sigma``,
        ``tolerance``, ``budget`` and ``device``; see
        `mirrorskin.engine.integration.surface.IntegrationOptions`.

    Returns
    -------
    Result
        ``height``, (H, W) or (K, H, W), mm, or pixels without a pixel size: with a camera the depth, in the
        unit of known ones. NaN where undefined. Other maps are (H, W), and shared by all surfaces.

        ``height_sigma``: expected standard deviation, about the mean of the component if it has no known
        height; NaN where the noise of the slopes cannot be estimated. With ``robust`` it contains the
        difference from the surface without breaks.

        ``component``: connected component of each pixel, numbered in reading order of the first pixels; -1
        without an answer. ``offset_unknown``, (components,): 1 for a component without a known height, whose
        mean is 0, or whose depth has the geometric mean 1. With ``robust``, parts that breaks separate are
        components; their heights relative to each other are the best estimate, and the mean is that of all
        parts that were connected without breaks.

        ``filled``: all 0. ``edges``: 1 on both sides of a discontinuity, if ``robust``.

        ``x`` and ``y``: pixel centres, with a pixel size.

        Of a result, also its ``fitted``; its warnings and notes are in ``process``.

        ``process``: the method ("direct", "multigrid" or "robust") as ``integration``; the solver's
        ``integration_iterations`` and final ``integration_residual``, each the largest of several surfaces;
        ``integration_converged``: whether the residual is within the tolerance, or, without one, below 0.3;
        ``integration_invalid``: number of wanted pixels whose slopes are not finite.

    Raises
    ------
    mirrorskin.io.InputError
        Maps of different sizes, or without anything to integrate; numbers outside of their limits; a result
        without normals, or with other arguments than those allowed.
    NotConverged
        The tolerance was not reached.
    mirrorskin.kernels.errors.DeviceError
        No device, or too little memory for the maps.

    Notes
    -----
    Of results of registered frames, the factor by which registration reduces the noise is assumed to be that
    for evenly distributed shifts; errors of a calibrated response count as independent from pixel to pixel.
    `reconstruct` has both for each pixel.

    Examples
    --------
    >>> import numpy as np
    >>> from mirrorskin import engine
    >>> surface = engine.integrate(np.full((2, 3), 0.5), np.zeros((2, 3)), 1.0)
    >>> round(float(surface.height[0, 2]), 6)
    0.5

    Normals of a rotation, of a plane that is inclined by 0.3 rad:

    >>> phase = np.arange(8) * np.pi / 4
    >>> cosine = np.cos(0.3) * np.cos(0.05) - np.sin(0.3) * np.sin(0.05) * np.cos(phase)
    >>> frames = (500 * np.arccos(cosine)[:, None, None] * np.ones((4, 5))).astype(np.float32)
    >>> turn = engine.estimate_normals(frames, phase, tilt=0.05, zenith_gain=500, noise=1.0)
    >>> surface = engine.integrate(turn, pixel_size=0.1)
    >>> round(float(surface.height[0, 4] - surface.height[0, 0]), 3)
    -0.124
    """
    arrays: dict[str, Any] = {
        "dz_dy": dz_dy,
        "camera": camera,
        "mask": mask,
        "slope_weights": slope_weights,
        "edges": edges,
        "known_heights": known_heights,
        "known_height_weights": known_height_weights,
        "initial_heights": initial_heights,
    }
    if is_maps(dz_dx):
        return _integrate_maps(dz_dx, pixel_size, arrays | {"normals": normals}, options)
    if is_maps(normals):
        return _integrate_maps(normals, pixel_size, arrays | {"dz_dx": dz_dx}, options)
    unknown = pixel_size is None and camera is None
    size = 1.0 if unknown else pixel_size
    surface = integrate_arrays(dz_dx, pixel_size=size, normals=normals, **arrays, **options)
    return surface.assign(x=None, y=None, declarations=IN_PIXELS) if unknown else surface


def _integrate_maps(
    maps: Maps, pixel_size: ArrayLike | None, arrays: Mapping[str, Any], options: Mapping[str, Any]
) -> Result:
    """Return the surface of the normals of a result."""
    robust = IntegrationOptions(**options).robust
    others = {name: value for name, value in options.items() if name not in ("robust", "device")}
    for name, value in {**arrays, **others}.items():
        if value is not None:
            raise InputError(f"{name} is for arrays: leave it out, or give normals=result.normals")
    needed = "normals", "normals_sigma"
    result = of_one_size(required_maps("normals", maps, *needed, pixel_size=pixel_size), "normals")
    device, unknown = device_of_maps(options.get("device"), result), result.x is None or result.y is None
    size = (1.0, 1.0) if unknown else pixel_size_of(result, "normals")
    surface = integrate_result(result, size, robust=robust, device=device)
    process = {**surface.process, **carried(surface.process, normals=result.process)}
    surface = surface.assign(x=result.x, y=result.y, process=process, fitted=result.fitted | surface.fitted)
    return surface.assign(declarations=IN_PIXELS) if unknown else surface


class Integrator(ThreadSafe):
    """Integrate slopes frame after frame: memory is reused, and each frame starts from the last heights.

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
        self._result: Result | None = None

    @checked(**_MAPS)
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
        """Integrate the slopes of one frame, without ``height_sigma``.

        For the maps see `mirrorskin.engine.integrate`. By default two cycles are done, starting from the
        heights of the last frame.

        Parameters
        ----------
        budget : float, optional
            Time limit, seconds: after the first cycle, further ones are done while they are expected to end
            in time and reduce the error.
        tolerance : float, optional
            Residual to stop at; it may not be reached within a budget.

        Raises
        ------
        mirrorskin.io.InputError
            Maps that cannot be used, or of another shape than the integrator's.
        NotConverged
            The tolerance was not reached, without a budget.
        """
        options = IntegrationOptions(tolerance=tolerance, budget=budget, sigma=False)
        inputs = check_inputs(
            dz_dx, dz_dy, self._pixel_size, mask, slope_weights, edges, known_heights, known_height_weights
        )
        if inputs.shape != self._shape:
            raise InputError(f"slopes have shape {inputs.shape}, not {self._shape}: make another Integrator")
        self._result = None
        x, y = pixel_axes(inputs.shape, inputs.pixel_size)
        self._result = self._solver.solve(inputs, options).assign(x=x, y=y)

    def result(self) -> Result:
        """Return the surface of the last frame; see `mirrorskin.engine.integrate`.

        Raises
        ------
        mirrorskin.io.InputError
            No frame has been pushed, or the last one could not be integrated.
        """
        if self._result is None:
            raise InputError("there is no surface yet: push the slopes of a frame first")
        return self._result

    def reset(self) -> None:
        """Forget the last heights: the next frame starts from zero."""
        self._result = None
        self._solver.reset()
