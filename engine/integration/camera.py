"""A pinhole camera, slopes of the logarithmic depth that it sees, and the part of a picture that counts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import InputError
from mirrorskin.kernels.rotation.facing import mean_variances

Box = tuple[slice, slice]
"""Rows and columns of a part of a picture."""

Mask = NDArray[np.bool_]


def find_box(shape: tuple[int, int], answered: Callable[[Box], Mask]) -> Box:
    """Return the smallest box that contains all pixels with an answer; the whole picture if there are none.

    ``answered`` returns a mask of the pixels of a box. It is only called for the margins and a few lines.
    """
    columns = slice(0, shape[1])
    rows = _find_ends(shape[0], lambda lines: np.any(answered((lines, columns)), axis=1))
    return rows, _find_ends(shape[1], lambda lines: np.any(answered((rows, lines)), axis=0))


def _find_ends(count: int, answered: Callable[[slice], Mask]) -> slice:
    """Return the range from the first to the last line with an answer, searching from both ends."""
    begin, strip = 0, 1
    while not (some := answered(slice(begin, begin + strip))).any():
        begin, strip = begin + strip, 2 * strip
        if begin >= count:
            return slice(0, count)
    begin, end, strip = begin + int(some.argmax()), count, 1
    while not (some := answered(slice(max(begin, end - strip), end))).any():
        end, strip = end - strip, 2 * strip
    return slice(begin, end - int(some[::-1].argmax()))


Slopes = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32] | None]
"""Slopes along x and y, (H, W), and the squared cosine to the line of sight; None without normals."""

EDGE_ON = 1e-4  # squared cosine of the angle between normal and line of sight, up to which there is no slope


@dataclass(frozen=True, slots=True)
class Camera:
    """A pinhole camera without distortion, for `mirrorskin.engine.integrate`.

    The pixel in column c and row r shows the point ::

        Z ((c - c0) / f_x, -(r - r0) / f_y, -1)

    in axes of the camera: x to the right, y up the picture, z towards the camera, from the pinhole. Z is the
    depth: the distance from the pinhole along the optical axis.

    Parameters
    ----------
    focal_length : float or (float, float)
        f, or f_x and f_y, pixels.
    principal_point : (float, float), optional
        Column c0 and row r0 where the optical axis meets the picture, pixels from the middle of the top left
        pixel. By default the middle of the picture.

    Raises
    ------
    mirrorskin.io.InputError
        Focal length or principal point is not possible.

    Examples
    --------
    A plane inclined by 45 degrees, whose right end is 1.25 / 0.75 times as far away as its left end.

    >>> import numpy as np
    >>> from mirrorskin import engine
    >>> normals = np.broadcast_to([1.0, 0.0, 1.0], (9, 101, 3))
    >>> camera = engine.integration.Camera(focal_length=200.0)
    >>> depth = engine.integrate(normals=normals, camera=camera).height
    >>> round(float(depth[4, 100] / depth[4, 0]), 4)
    1.6667
    """

    focal_length: float | tuple[float, float]
    principal_point: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        focal = np.asarray(self.focal_length, np.float64)
        if focal.shape not in ((), (2,)) or not np.all((focal > 0) & (focal < np.inf)):
            raise InputError(
                f"focal length {self.focal_length!r}: pixels above 0 are needed, one number or (x, y)"
            )
        point = self.principal_point
        if point is not None and (np.shape(point) != (2,) or not np.isfinite(point).all()):
            raise InputError(f"principal point {point!r}: column and row are needed, in pixels")

    @property
    def pixel_size(self) -> tuple[float, float]:
        """Width and height of a pixel at depth 1."""
        width, height = (1 / np.broadcast_to(np.asarray(self.focal_length, np.float64), 2)).tolist()
        return width, height

    def sight(self, shape: tuple[int, int]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return x, (W,), and y, (H, 1), of vectors (x, y, 1) from the object at each pixel to the camera."""
        rows, columns = shape
        column, row = self.principal_point or ((columns - 1) / 2, (rows - 1) / 2)
        width, height = self.pixel_size
        x, y = (column - np.arange(columns)) * width, (np.arange(rows) - row) * height
        return x.astype(np.float32), y.astype(np.float32)[:, np.newaxis]


def find_slopes(normals: NDArray[Any], camera: Camera | None, box: Box) -> Slopes:
    """Return slopes along x and y within a box, and the squared cosine between normal and line of sight.

    Without a camera: the slopes of the height, -n_x / n_z and -n_y / n_z.
    With one: the slopes of the logarithm of the depth, per pixel size at depth 1. A step along x changes the
    point Z r by Z (r d(ln Z) + dr), to which n is perpendicular; so the slopes are n_x / (n . v) and
    n_y / (n . v) with v = -r. Slopes are NaN where the surface faces away or is seen edge-on, and without a
    finite normal; the squared cosine is 1 there.
    """
    with np.errstate(all="ignore"):
        x, y, z = (np.asarray(normals[(*box, axis)], np.float32) for axis in range(3))
        facing = z.copy()
        if camera is not None:
            across, up = sight_within(camera, (normals.shape[0], normals.shape[1]), box)
            facing += x * across + y * up
        square = x * x + y * y + z * z
        weight = np.square(facing) / square
        undefined = ~((facing > 0) & (weight > EDGE_ON))
        facing[undefined], weight[undefined] = np.nan, 1
        factor = np.reciprocal(facing if camera is not None else -facing)
        return x * factor, y * factor, weight


def sight_within(
    camera: Camera | None, shape: tuple[int, int], box: Box
) -> tuple[NDArray[np.float32] | np.float32, NDArray[np.float32] | np.float32]:
    """Return x and y of vectors (x, y, 1) to the camera from the pixels of a box."""
    if camera is None:
        return np.float32(0), np.float32(0)
    across, up = camera.sight(shape)
    return across[box[1]], up[box[0]]


def weigh_slopes(
    slopes: tuple[NDArray[np.float32], NDArray[np.float32]],
    variances: list[NDArray[np.float32]],
    sight: tuple[Any, Any],
    defined: Mask,
) -> tuple[list[NDArray[np.float32]], list[NDArray[np.float32]]]:
    """Return slopes without the bias by noise, and the factors of their weights.

    ``variances`` are those of unit normals, of one or both slopes; 0 without a bias. The slope p along x is
    n_x / (n . v); see `find_slopes`. An error d of the unit normal changes it by d . (e_x - p v) / (n . v),
    so its weight has the factor (n . v)^2 / |e_x - p v|^2, along y with q and e_y; without a camera ::

        1 / ((1 + p^2) (1 + p^2 + q^2)),    1 / ((1 + q^2) (1 + p^2 + q^2))

    Noise of variance s^2 makes n . v as often smaller as larger, but its reciprocal larger in the mean: the
    slope p (1 + s^2 |v|^2 / (n . v)^2) - s^2 v_x / (n . v)^2 is expected. All factors are means; see
    `mean_variances`.
    """
    x, y = sight
    *along, slant = mean_variances(*slopes, sight, defined)
    unbiased = [
        (slope + noise * v * slant) / (1 + noise * (1 + x * x + y * y) * slant)
        for slope, noise, v in zip(slopes, (variances[0], variances[-1]), sight, strict=True)
    ]
    factors = [np.reciprocal(variance).astype(np.float32) for variance in along]
    return [slope.astype(np.float32) for slope in unbiased], factors
