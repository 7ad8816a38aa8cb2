"""Records of a map for the fit of a motion: ``pose_maps.cl`` in NumPy with float64.

For the format of records see `mirrorskin.kernels.skin.pose`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.kernels.skin.pose import FAR, NEAR, VAGUE

Array = NDArray[Any]

STEEPEST = 0.17
"""Cosine of the largest zenith at which slopes are used."""
NOT_COMPARED = 1e6
"""Mean square error of normals that are not compared, radians^2."""
SHARPEST = 1e-10
"""Smallest variance of a normal or height, radians^2 or mm^2; interpolation between pixels errs by more."""
SUMMARY, STRIP = 6, 16
"""Length of the record of a strip in `pose_summary`, and number of its pixels."""
SPIKE = 8.0
"""Least difference of a spike from the means of opposite neighbours, on all four lines, sigmas."""
AROUND = 2  # pixels around edges and the border of contact that are excluded; reach of a gradient
_MIN_PIXELS = 7  # minimum number of pixels of a gradient
_SINGULAR = 1e-3  # relative determinant of a singular arrangement of them


def pose_gradient(step_x: float, step_y: float, values: Array, gradient: Array) -> None:
    """Write the slopes along x and y, (H, W, 2), of the plane fitted to the valid heights of 5 x 5 pixels.

    NaN if the pixel itself is invalid, or fewer than seven are valid, or these are collinear.
    """
    rows, columns = values.shape
    wide = np.pad(values.astype(np.float64), AROUND, constant_values=np.nan)
    sums = np.zeros((9, rows, columns))
    for row in range(-AROUND, AROUND + 1):
        for column in range(-AROUND, AROUND + 1):
            first_row, first_column = AROUND + row, AROUND + column
            value = wide[first_row : first_row + rows, first_column : first_column + columns] - values
            defined = np.isfinite(value)
            value = np.where(defined, value, 0)
            for number, factor in enumerate((1, column, row, column**2, column * row, row**2)):
                sums[number] += defined * factor
            for number, factor in enumerate((1, column, row), 6):
                sums[number] += value * factor
    count, x, y, xx, xy, yy, z, xz, yz = sums
    with np.errstate(invalid="ignore", divide="ignore"):
        xx, xy, yy = xx - x * x / count, xy - x * y / count, yy - y * y / count
        xz, yz = xz - x * z / count, yz - y * z / count
        area = xx * yy - xy * xy
        good = (count >= _MIN_PIXELS) & (area > _SINGULAR * count**2)
        gradient[..., 0] = np.where(good, (yy * xz - xy * yz) / area / step_x, np.nan)
        gradient[..., 1] = np.where(good, -(xx * yz - xy * xz) / area / step_y, np.nan)


def pose_spikes(height: Array, height_sigma: Array, clean: Array) -> None:
    """Copy heights, and write NaN instead of spikes.

    A spike differs from the means of opposite neighbours by `SPIKE` sigmas, on all of the four lines through
    it whose neighbours are valid, two or more (one at the border); and from the cubic of four neighbours, if
    they are valid, by half as much, as a curved surface does not.
    """
    clean[...] = np.where(_spikes(height, height_sigma), np.nan, height)


def pose_means(
    height: Array, height_sigma: Array | None, mean: Array, mean_sigma: Array | None, size: int = 1
) -> None:
    """Write the means of size x size heights, and their standard deviations; NaN if one is unknown."""
    mean[...], sigma = _means(height, height_sigma, size)
    if mean_sigma is not None:
        mean_sigma[...] = sigma


def pose_records(
    height: Array,
    height_sigma: Array | None,
    component: Array | None,
    offset_unknown: Array | None,
    normals: Array | None,
    gradient: Array | None,
    normals_sigma: Array | None,
    filled: Array | None,
    contact: Array | None,
    edges: Array | None,
    records: Array,
    slopes: Array | None,
    spiky: int,
    size: int = 1,
) -> None:
    """Write the records of a map without second derivatives, (H, W, 8), and its slopes, (2, H, W).

    Records and slopes of unused pixels are NaN. All maps but the height may be None. Without normals, they
    are computed from the ``gradient``, (H, W, 2). Heights of components with unknown offset are not compared.
    A pixel is not used if it is filled, steep, or at most two pixels away from an edge or a pixel without
    contact; or, if ``spiky``, a spike as of `pose_spikes`.

    A pixel of the records is a block of ``size`` x ``size`` pixels of the maps. Its normal is the mean of
    theirs, its height as of `pose_means`. With a gradient, it and the heights are means already.
    """
    if normals is None:
        assert gradient is not None
        normals = np.dstack([-gradient, np.ones(height.shape)])
        normals = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
    else:
        height, height_sigma = _means(height, height_sigma, size)
        normals = _blocks(normals, size).mean(axis=0)
    square, variance = np.full(height.shape, NOT_COMPARED), np.full(height.shape, FAR)
    with np.errstate(invalid="ignore", divide="ignore"):
        if normals_sigma is not None:
            squares = _blocks(np.where(normals_sigma > 0, normals_sigma**2, np.nan), size)
            square = np.maximum(squares.mean(axis=0) / size**2, SHARPEST)
        if height_sigma is not None:
            variance = np.where(height_sigma > 0, np.maximum(height_sigma**2, SHARPEST), FAR)
        if component is not None and offset_unknown is not None:
            unknown = np.append(offset_unknown, 1).astype(bool)[component]
            variance = np.where(_blocks(unknown, size).any(axis=0), FAR, variance)
        used = np.isfinite(height) & (normals[..., 2] > STEEPEST) & np.isfinite(square)
        if spiky and height_sigma is not None:
            used &= ~_spikes(height, height_sigma)
        if filled is not None:
            used &= ~_blocks(filled != 0, size).any(axis=0)
        for border in (None if edges is None else edges != 0, None if contact is None else contact == 0):
            if border is not None:
                used &= ~_blocks(_near(border), size).any(axis=0)
        if slopes is not None:
            slopes[...] = np.where(used, -np.moveaxis(normals[..., :2], -1, 0) / normals[..., 2], np.nan)
    records[...] = 0
    records[..., :2], records[..., 2], records[..., 3] = normals[..., :2], square, height
    records[..., 4] = variance
    records[~used] = np.nan


def pose_curvature(step_x: float, step_y: float, slopes: Array, records: Array) -> None:
    """Write the second derivatives xx, xy and yy of the height, from slopes; NaN records where unknown."""
    across, up = np.zeros((2, *slopes.shape[1:], 2))
    pose_gradient(step_x, step_y, slopes[0], across)
    pose_gradient(step_x, step_y, slopes[1], up)
    second = across[..., 0], (across[..., 1] + up[..., 0]) / 2, up[..., 1]
    records[..., 5:] = np.stack(second, axis=-1)
    records[~np.isfinite(across[..., 0])] = np.nan


def pose_halve(fine: Array, records: Array) -> None:
    """Write records at half the resolution: means of 2 x 2 pixels, if all four are valid."""
    rows, columns = records.shape[:2]
    records[...] = fine[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2, 8).mean(axis=(1, 3))
    records[..., [2, 4]] /= 4


def pose_summary(x0: float, y0: float, step_x: float, step_y: float, records: Array, summary: Array) -> None:
    """Write six numbers for each strip of 16 pixels of a row, (strips, 6), row after row.

    They are the number of valid pixels, the number with a height or a normal to compare, the sums of x, y and
    z, and the sum of squared distances from the mean of the strip, mm^2. ``x0`` and ``y0`` are the position
    of the first pixel.
    """
    rows, columns = records.shape[:2]
    row, column = np.indices((rows, columns))
    places = np.stack([x0 + column * step_x, y0 - row * step_y, records[..., 3]], axis=-1)
    defined = np.isfinite(records[..., 0])
    compared = defined & ((records[..., 2] < VAGUE) | (records[..., 4] < NEAR))
    strip = row * -(-columns // STRIP) + column // STRIP
    for number, out in enumerate(summary):
        here = (strip == number) & defined
        points = places[here]
        spread = np.sum((points - points.mean(axis=0)) ** 2) if len(points) else 0.0
        out[:] = len(points), np.count_nonzero(compared[here]), *points.sum(axis=0), spread


def _blocks(values: Array, size: int) -> Array:
    """Return the values of blocks of size x size pixels, (size^2, rows, columns, ...), without the rest."""
    rows, columns = values.shape[0] // size, values.shape[1] // size
    return np.stack(
        [
            values[row : rows * size : size, column : columns * size : size]
            for row, column in np.ndindex(size, size)
        ]
    )


def _means(height: Array, height_sigma: Array | None, size: int) -> tuple[Array, Array | None]:
    """Return the means of size x size heights, and their standard deviations; NaN if one is unknown."""
    mean = np.asarray(_blocks(height, size).mean(axis=0))
    if height_sigma is None:
        return mean, None
    sigmas = _blocks(np.where(height_sigma > 0, height_sigma, np.nan), size)
    return mean, np.asarray(np.sqrt(np.sum(sigmas**2, axis=0)) / size**2)


def _near(border: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the pixels within two pixels of a border."""
    wide = np.pad(border, AROUND)
    rows, columns = border.shape
    shifts = np.ndindex(2 * AROUND + 1, 2 * AROUND + 1)
    return np.asarray(np.any([wide[i : i + rows, k : k + columns] for i, k in shifts], axis=0))


def _spikes(height: Array, height_sigma: Array) -> NDArray[np.bool_]:
    wide, (rows, columns) = np.pad(height, 2, constant_values=np.nan), height.shape

    def both(down: int, right: int) -> Array:
        ahead, back = (
            wide[2 + k * down : 2 + k * down + rows, 2 + k * right : 2 + k * right + columns] for k in (1, -1)
        )
        return np.asarray(ahead + back)

    steps = (0, 1), (1, 0), (1, 1), (1, -1)
    near = np.array([both(*step) for step in steps])
    far = np.array([both(2 * down, 2 * right) for down, right in steps])
    with np.errstate(invalid="ignore"):
        bends, rests = np.abs(height - near / 2), np.abs(height - (4 * near - far) / 6)
        lines, high = np.isfinite(bends), (bends > SPIKE * height_sigma) & ~(rests < bends / 2)
        spikes = np.all(high | ~lines, axis=0)
    needed = np.full((rows, columns), 1)
    needed[1:-1, 1:-1] = 2
    return np.asarray(spikes & (lines.sum(axis=0) >= needed))
