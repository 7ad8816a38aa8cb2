"""Registration of frames: ``registration.cl`` in plain NumPy with float64.

Frames are interpolated by the cubic through the four nearest samples of a row and of a column (Lagrange's
formula): 16 samples, with weights that sum to one. Independent noise of the samples is scaled by the root of
the sum of the squared weights, 0.64 to 1.

RMS errors in counts for frames of the digital twin, with pixels of 0.05 mm, a gain of 265 counts per radian
and a lens that blurs by 0.5 pixels:

==========================  ======  ==========  ==========  =======
object                      linear  Keys cubic  this cubic  quintic
==========================  ======  ==========  ==========  =======
ball                        0.08    0.03        0.03        0.02
ridges every 2 mm           0.70    0.19        0.19        0.13
ridges every 0.6 mm         4.2     1.4         1.3         0.7
coin                        1.8     0.8         0.8         0.6
scale of the noise (mean)   0.67    0.80        0.77        0.82
==========================  ======  ==========  ==========  =======

The noise of a sample is 1.5 counts. The error of linear interpolation exceeds it. The quintic through six
samples improves by less than the noise, takes twice the operations, and loses more pixels around missing
samples. No formula is accurate at creases of a picture without blur.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

MEAN_NOISE_GAIN = 0.776
"""Factor of the noise of a sample by interpolation, RMS over all positions between the pixels."""
BORDER = 2
"""Width of the border of NaN around a padded frame: results that need one of them are NaN."""


def registration_admit(frame: Array, offset: Array, gain: Array, padded: Array) -> None:
    """Write the usable part of a frame, on a scale common to all pixels, into a padded map.

    ``offset`` and ``gain`` are the counts of each pixel at 0 of the common scale, and per unit of it; 0 and
    1, (1, 1), if all pixels are equal. The border is NaN, and so are counts that are clipped or not finite.
    """
    value = (frame.astype(np.float64) - offset) / gain
    if frame.dtype.kind == "u":
        usable = (frame > 0) & (frame < np.iinfo(frame.dtype).max)
    else:
        usable = np.isfinite(frame)
    padded[BORDER:-BORDER, BORDER:-BORDER] = np.where(usable, value, np.nan)


def registration_mend(places: Array, padded: Array) -> None:
    """Replace each sample that is never valid by the mean of four samples.

    ``places``, (n, 5), are the flat positions of the sample and of the four samples in the padded frame. None
    of the four is replaced itself.
    """
    flat = padded.reshape(-1)
    flat[places[:, 0]] = flat[places[:, 1:]].astype(np.float64).mean(axis=1)


def weights(part: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the weights, (4, ...), of the samples at -1, 0, 1 and 2 for a position from 0 to 1."""
    before, behind, beyond = part + 1, part - 1, part - 2
    return np.stack(
        [
            -part * behind * beyond / 6,
            before * behind * beyond / 2,
            -before * part * beyond / 2,
            before * part * behind / 6,
        ]
    )


def registration_resample(
    padded: Array, height: Array, shift: Array, offset: Array, gain: Array, registered: Array, noise: Array
) -> None:
    """Write the frame in which each pixel sees its own point of the object.

    Parameters
    ----------
    padded, offset, gain : as of ``registration_admit``
    height : (H, W), of the object's points, mm; NaN where unknown
    shift : (2, 4) or (2, 7), displacement of the point of a pixel to the right and down, pixels: a constant,
        and coefficients of column, row and height in mm; optionally also of the column's square, the column
        times the row, and the row's square
    registered : (H, W), counts on the scale of the target pixel; NaN where one of the 16 samples is missing
    noise : (2, H, W), sums over the frames, updated where there is a sample: of the squared factors that
        scale the noise of a sample, and of the samples
    """
    rows, columns = height.shape
    column, row = np.meshgrid(np.arange(float(columns)), np.arange(float(rows)))
    place = np.stack([np.ones(height.shape), column, row, height, column**2, column * row, row**2])
    place = place[: shift.shape[1]]
    right, down = np.tensordot(shift.astype(np.float64), place, 1)
    west, part_x = _split(column, right, columns)
    north, part_y = _split(row, down, rows)
    weights_x, weights_y = weights(part_x), weights(part_y)
    value = np.zeros(height.shape)
    for y in range(4):
        for x in range(4):
            value += weights_y[y] * weights_x[x] * padded[north - 1 + y + BORDER, west - 1 + x + BORDER]
    registered[:] = offset + gain * value
    valid = ~np.isnan(registered)
    noise[0] += np.where(valid, np.sum(weights_x**2, axis=0) * np.sum(weights_y**2, axis=0), 0)
    noise[1] += valid


def _split(
    start: NDArray[np.float64], shift: NDArray[np.float64], length: int
) -> tuple[Array, NDArray[np.float64]]:
    """Return the sample before a position, and the fraction beyond it, 0 to 1.

    An unknown or distant position is replaced by one with samples outside the picture.
    """
    place = np.clip(np.where(np.isnan(shift), -1, start + shift), -1, length - 1)
    before = np.floor(place).astype(np.intp)
    return before, place - before
