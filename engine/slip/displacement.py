"""Displacement of the skin from frames: dense, to a hundredth of a pixel, with standard errors."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.base.device_arrays import AnyArray, device_of, on_host
from mirrorskin.engine.base.frames import as_frames, check_frames
from mirrorskin.engine.base.resample import fill_with_nearest
from mirrorskin.engine.slip.tracking import GRADIENT_NOISE, Level, NodeField, Tracker, invert_symmetric
from mirrorskin.io import InputError, Result, pixel_axes
from mirrorskin.io.base.arguments import check_count, check_number, check_pixel_size, checked, in_unit
from mirrorskin.io.base.findings import Finding, with_findings
from mirrorskin.io.model.maps import TABLE, DisplacementStatus, status_of
from mirrorskin.io.watch.saturation import MAD
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.skin.slip import CORRELATED_SAMPLES, LAPLACIAN_NOISE

MAPS = {
    "displacement": TABLE["displacement"],
    "displacement_sigma": replace(
        TABLE["displacement"].deviation("displacement"), components=("x", "y"), per_frame=True
    ),
    "status": replace(status_of(DisplacementStatus), per_frame=True),
}
"""Declarations of the maps of `find_displacement`: each component has its own standard deviation."""

XY = np.array([1, 1j])
"""Converts vectors (x, y) to x + i y."""

_RANK = np.array([1, 0, 2, 3], np.uint8)  # rank of a status: a pixel has the highest of its nodes
_MOST_STEP = 64  # maximum distance of nodes, pixels
_LEAST_VARIANCE = 1e-4  # of samples of a window, relative to the median
_LEAST_WINDOWS = 20  # for an estimate of their scatter
_MEDIAN_NOISE = 2.3  # standard deviation of the median of n squares, times sqrt(n), relative to their mean
_SCATTERED = 2.5  # excess of the variance above which there is a finding
_LEAST_TEXTURED = 0.1  # minimum share of windows with texture; edges of light on a clear sheet may reach it


@checked(
    reference=as_frames,
    frames=as_frames,
    pixel_size=in_unit("mm"),
    window_size=check_count,
    window_step=check_count,
    noise=check_number,
)
def find_displacement(
    reference: AnyArray,
    frames: AnyArray,
    pixel_size: ArrayLike,
    *,
    window_size: int = 12,
    window_step: int = 4,
    noise: float | None = None,
    device: str | Device | None = None,
) -> Result:
    """Estimate the displacement of the texture of a reference in frames.

    The method is least squares in square windows. In each window, the displacement is an affine field, and
    the brightness may change by a gain and a plane; see the documentation, "Slip". The texture at the pixel x
    of the reference is at x + displacement in the frame. The initial displacement of each frame is
    extrapolated from earlier ones, so steps may be as long as half of the texture's grain; after a longer
    step, coarser resolutions and the correlation of the whole picture are tried.

    Parameters
    ----------
    reference : ndarray or device array, (H, W), uint8, uint16 or float32
    frames : ndarray or device array, (T, H, W), of the same type
        In the order in which they were taken.
    pixel_size : float or (float, float)
        Millimetres, along x and y.
    window_size : int
        Side of a window, pixels. Doubling it halves the standard deviation and the resolution.
    window_step : int
        Distance between the centres of adjacent windows, pixels.
    noise : float, optional
        Standard deviation of a sample, counts; by default estimated from the residuals, window by window.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.

    Returns
    -------
    Result
        ``displacement`` and ``displacement_sigma``, (T, H, W, 2), mm along x and y (up), are undefined unless
        ``status``, (T, H, W), is 1. Other values are 0 if the window leaves the picture or has no usable
        sample, 2 if the texture was not found, and 3 if it does not exceed the noise. ``process`` contains
        the ``noise``, counts. If frames are on a device, displacement and sigma are returned there.

    Raises
    ------
    mirrorskin.io.InputError
        Frames or parameters cannot be used, or hardly any window has texture beyond the noise.
    mirrorskin.kernels.errors.DeviceError
        There is no device, or its memory is too small.

    Examples
    --------
    >>> import cv2
    >>> texture = np.random.default_rng(1).normal(100, 20, (60, 80))
    >>> texture = cv2.GaussianBlur(texture, (0, 0), 1.5).astype(np.float32)
    >>> moved = np.roll(texture, 3, axis=1)[None]
    >>> found = find_displacement(texture, moved, 0.1, noise=0.1)
    >>> found.displacement[0, 30, 40].astype(float).round(3).tolist()
    [0.3, 0.0]
    """
    if frames.ndim != 3 or reference.ndim != 2:
        shapes = f"reference has shape {reference.shape}, frames {frames.shape}"
        raise InputError(f"{shapes}: (H, W) and (T, H, W) are needed")
    check_frames(frames, reference.dtype, reference.shape)
    if reference.dtype.kind == "f" and not np.isfinite(on_host(reference)).all():
        raise InputError("the reference has samples that are not finite: leave out the part that has them")
    size = check_pixel_size(pixel_size)
    check_windows(reference.shape, window_size, window_step)
    check_noise(noise)
    tracker = Tracker(reference, window_size, window_step, device_of(device, reference, frames))
    fields = [tracker.follow(frame) for frame in frames]
    texture = Texture.of(tracker.finest, np.mean([field.variance for field in fields], axis=0), noise)
    texture.refuse_clear("the frames")
    sigma = np.sqrt(np.einsum("yxii->yxi", texture.covariance)) * size
    nodes = [_at_nodes(tracker, field, texture, window_size, sigma, size) for field in fields]
    displacement, sigma, status = (np.stack(part) for part in zip(*nodes, strict=True))
    excess = excess_scatter(displacement, sigma, window_step, window_size)
    sigma *= math.sqrt(excess)
    on_device = isinstance(frames, Array)
    maps = {
        "displacement": tracker.to_pixels(displacement, on_device),
        "displacement_sigma": tracker.positive_to_pixels(sigma, on_device),
        "status": tracker.worst_at_pixels(status, _RANK),
    }
    x, y = pixel_axes(frames.shape[1:], size)
    result = Result(maps, x=x, y=y, declarations=MAPS).with_fitted(noise=texture.noise)
    return with_findings(result, *([_scattered(excess)] if excess > _SCATTERED else []))


@dataclass(frozen=True, slots=True)
class Texture:
    """Information in the windows of a reference.

    Attributes
    ----------
    covariance : ndarray, (rows, columns, 2, 2), float64
        Covariance of a displacement, pixels^2, to the right and down.
    textured : ndarray, (rows, columns), bool
        Whether the texture's derivatives exceed those of noise, in every direction.
    usable : ndarray, (rows, columns), bool
        Whether the window has enough samples.
    variance : ndarray, (rows, columns), float64
        Variance of a sample, counts^2.
    noise : float
        Square root of the median variance, counts.
    """

    covariance: Doubles
    textured: NDArray[np.bool_]
    usable: NDArray[np.bool_]
    variance: Doubles
    noise: float

    @classmethod
    def of(cls, level: Level, variance: Doubles, noise: float | None) -> Texture:
        """Evaluate a reference, given the variance of a sample in the frames, (rows, columns).

        Both the reference and a frame have noise, so that the covariance is 2 variance / information.
        """
        variances = variance[np.isfinite(variance)] if noise is None else np.array([noise**2])
        usual = float(np.median(variances)) if variances.size else np.nan
        variance = np.where(
            np.isfinite(variance) & (noise is None), np.maximum(variance, _LEAST_VARIANCE * usual), usual
        )
        spurious = GRADIENT_NOISE * variance * level.measured
        first, mixed, last = level.information
        mean, half = (first + last) / 2, (first - last) / 2
        smallest = mean - spurious - np.sqrt(half**2 + mixed**2)  # smaller eigenvalue
        textured = smallest >= np.maximum(spurious, np.finfo(float).tiny)
        inverse = np.where(textured, 2 * variance, np.nan) * invert_symmetric(level.information)
        covariance = np.empty((*level.grid, 2, 2))
        covariance[..., 0, 0], covariance[..., 1, 1] = inverse[0], inverse[2]
        covariance[..., 0, 1] = covariance[..., 1, 0] = inverse[1]
        return cls(covariance, textured, level.usable, variance, float(np.sqrt(usual)))

    def refuse_clear(self, name: str) -> None:
        """Raise InputError if hardly any window has texture."""
        fraction = float(np.mean(self.textured))
        if fraction < _LEAST_TEXTURED:
            noise = f" beyond the noise of {self.noise:.2g} counts" if np.isfinite(self.noise) else ""
            raise InputError(
                f"{name}: {100 * (1 - fraction):.0f} % of the windows show no texture{noise}: displacement"
                " needs a speckled or printed sheet"
            )


def _at_nodes(
    tracker: Tracker,
    field: NodeField,
    texture: Texture,
    window: int,
    sigma: Doubles,
    size: tuple[float, float],
) -> tuple[Doubles, Doubles, NDArray[np.uint8]]:
    """Return a frame's displacement, sigma, mm, and status, of all nodes."""
    status = node_status(field, texture)
    found_nodes = (status == DisplacementStatus.FOUND)[..., None]
    displacement = np.where(found_nodes, field.moved.transpose(1, 2, 0) * [size[0], -size[1]], np.nan)
    variance = sigma**2
    bending = bending_variance(
        displacement @ XY,
        np.moveaxis(variance, -1, 0),
        tracker.finest.step,
        window,
    )
    variance = variance * misfit(field.variance, texture.variance, window)[..., None]
    sigma = np.sqrt(variance + np.moveaxis(bending, 0, -1))
    return displacement, np.where(found_nodes, sigma, np.nan), status


def misfit(variance: Doubles, usual: Doubles, window: int) -> Doubles:
    """Return the factor of the variance of a displacement for a frame's misfit beyond noise.

    It is computed from the variance of a sample in the frame and the usual one. Residuals due to changes of
    brightness are correlated over some samples; the factor allows for that.
    """
    chance = 1 + 2 * math.sqrt(2) / window  # two standard deviations of a window's variance
    return np.asarray(1 + CORRELATED_SAMPLES * np.fmax(variance / usual - chance, 0))


def bending_variance(
    displacement: NDArray[np.complex128], variance: Doubles, step: int, window: int
) -> Doubles:
    """Return the approximate squared bias along x and y of displacements that bend within windows.

    An affine field misses the mean of the second-order terms, window^2 / 24 times the Laplacian, which is
    computed from displacements x + i y, (rows, columns), a window apart. Its noise, from the ``variance``,
    (2, rows, columns), is subtracted.
    """
    apart = max(1, round(window / step))
    laplacian = np.zeros_like(displacement)
    for sums, values in ((laplacian, displacement), (laplacian.T, displacement.T)):
        if len(values) > 2 * apart:
            second = values[: -2 * apart] + values[2 * apart :]
            second -= 2 * values[apart:-apart]
            sums[apart:-apart] += second
            sums[:apart] += second[0]
            sums[-apart:] += second[-1]
    bias = fill_with_nearest(laplacian) * ((window / (apart * step)) ** 2 / 24)
    square = np.empty(variance.shape)
    np.square(bias.real, out=square[0])
    np.square(bias.imag, out=square[1])
    square -= LAPLACIAN_NOISE * variance
    return np.fmax(square, 0, out=square)


def excess_scatter(displacement: Doubles, sigma: Doubles, step: int, window: int) -> float:
    """Return the variance of displacements, (T, rows, columns, 2), over that which is stated; at least 1.

    It is computed from third differences of windows that do not overlap, which smooth movement hardly
    changes. The residuals in a window do not show errors that are correlated there, as those of a codec.
    """
    apart = max(1, math.ceil(window / step))
    places = [k * apart for k in range(4)]
    ratios = []
    for axis in (1, 2):
        count = displacement.shape[axis] - 3 * apart
        if count > 0:
            third, variance = (
                np.tensordot(
                    weights, np.stack([part.take(range(k, k + count), axis) for k in places]), axes=1
                )
                for part, weights in ((displacement, (1, -3, 3, -1)), (sigma**2, (1, 9, 9, 1)))
            )
            ratios.append(np.ravel(third**2 / variance))
    ratio = np.concatenate(ratios) if ratios else np.empty(0)
    ratio = ratio[np.isfinite(ratio)]
    windows = len(ratio) / apart**2  # that are independent
    if windows < _LEAST_WINDOWS:
        return 1.0
    return max(1.0, MAD**2 * float(np.median(ratio)) - _MEDIAN_NOISE / math.sqrt(windows))


def _scattered(excess: float) -> Finding:
    """Return the finding that displacements of windows scatter more than noise explains."""
    return Finding(
        "scatter",
        f"displacements of neighbouring windows differ by {math.sqrt(excess):.2g} times what noise explains,"
        " as with lossy compression, or texture finer than two pixels: standard deviations are enlarged, but"
        " errors that windows have in common are unknown",
    )


def node_status(field: NodeField, texture: Texture) -> NDArray[np.uint8]:
    """Return the status of a frame's nodes, (rows, columns)."""
    status = np.where(field.converged, DisplacementStatus.FOUND, DisplacementStatus.NOT_FOUND)
    status = np.where(np.isfinite(field.moved[0]), status, DisplacementStatus.INVALID_INPUT)
    status = np.where(texture.textured, status, DisplacementStatus.NO_TEXTURE)
    return np.where(texture.usable, status, DisplacementStatus.INVALID_INPUT).astype(np.uint8)


def check_noise(noise: float | None) -> None:
    """Raise InputError unless a standard deviation is possible."""
    if noise is not None and not 0 < noise < 1e9:
        raise InputError(f"noise {noise}: a standard deviation in counts above 0 is needed, such as 1.5")


def check_windows(shape: tuple[int, ...], window_size: int, window_step: int) -> None:
    """Raise InputError unless windows fit into a picture, and nodes are close enough."""
    side = min(shape)
    if not 6 <= window_size <= side:
        raise InputError(f"window_size {window_size}: 6 to {side} pixels are possible in frames of {shape}")
    if not 1 <= window_step <= min(_MOST_STEP, side):
        raise InputError(f"window_step {window_step}: 1 to {min(_MOST_STEP, side)} pixels are possible")
