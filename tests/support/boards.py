"""Pictures of boards on the sheet, painted by a pinhole camera with distortion; the truth is known.

Each pixel is the mean over a fine grid of rays; the fit's code is not used.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, radians, sin

import cv2
import numpy as np
from scipy import ndimage


@dataclass(frozen=True)
class View:
    """A camera over the sheet: ``focal`` pixels, looking at the sheet's origin, which it sees tilted.

    Distortion is OpenCV's, (k1, k2, p1, p2, k3), in units of the focal length about ``middle``: pixels from
    the picture's centre.
    """

    shape: tuple[int, int] = (240, 320)
    scale: float = 0.05  # mm a pixel at the sheet's origin, without tilt
    focal: float = 300.0
    tilt: float = 0.0  # degrees
    towards: float = 0.0  # degrees: azimuth on the sheet of the axis of the tilt
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    middle: tuple[float, float] = (0.0, 0.0)
    roll: float = 0.0

    def plane(self):
        """The homography from (x, y, 1), mm, y up, to normalised (right, down, 1)."""
        axis, angle, turn = radians(self.towards), radians(self.tilt), radians(self.roll)
        ahead = np.array([[cos(turn), -sin(turn), 0], [sin(turn), cos(turn), 0], [0, 0, 1]])
        about = np.array([cos(axis), sin(axis), 0])
        lean = cv2.Rodrigues(about * angle)[0] @ ahead
        distance = self.scale * self.focal
        flip = np.diag([1.0, -1.0, -1.0])
        whole = flip @ np.column_stack([lean[:, 0], lean[:, 1], [0, 0, -distance]])
        return whole / whole[2, 2]

    def _centre(self):
        rows, columns = self.shape
        return np.array([(columns - 1) / 2 + self.middle[0], (rows - 1) / 2 + self.middle[1]])

    def _bend(self, u, v):
        k1, k2, p1, p2, k3 = self.distortion
        r2 = u * u + v * v
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return (
            u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u),
            v * radial + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v,
        )

    def place(self, x, y):
        """Column and row at which a point of the sheet is seen."""
        image = np.tensordot(self.plane(), np.stack([x, y, np.ones_like(x)]), 1)
        # The principal ray of a camera whose middle is off the centre still meets the origin off its middle.
        u, v = image[:2] / image[2] - (self.middle / np.float64(self.focal))[:, None].reshape(
            2, *[1] * np.ndim(x)
        )
        u, v = self._bend(u, v)
        column, row = self._centre()
        return column + self.focal * u, row + self.focal * v

    def sheet(self, column, row):
        """Point of the sheet, mm, that is seen at a place of the picture."""
        middle = self._centre()
        a, b = (column - middle[0]) / self.focal, (row - middle[1]) / self.focal
        u, v = a.copy(), b.copy()
        for _ in range(60):
            bent = self._bend(u, v)
            off = a - bent[0], b - bent[1]
            u, v = u + off[0], v + off[1]
            if max(np.abs(off[0]).max(), np.abs(off[1]).max()) < 1e-7:
                break
        else:
            raise ValueError("nothing is seen at the corners")
        off = self.middle / np.float64(self.focal)
        homography = np.tensordot(
            np.linalg.inv(self.plane()), np.stack([u + off[0], v + off[1], np.ones_like(u)]), 1
        )
        return homography[0] / homography[2], homography[1] / homography[2]


def charuco(columns, rows, square, marker, dictionary=cv2.aruco.DICT_4X4_50):
    """A ChArUco board about its middle as a function of x and y up, mm: 1 white, 0 black."""
    markers = cv2.aruco.getPredefinedDictionary(dictionary)
    side = markers.markerSize + 2
    numbers = iter(range(columns * rows))
    bits = np.zeros((rows, columns, side, side))
    for row in range(rows):
        for column in range(columns):
            if (row + column) % 2:
                bits[row, column] = cv2.aruco.generateImageMarker(markers, next(numbers), side) / 255

    def paint(x, y):
        across, down = x / square + columns / 2, rows / 2 - y / square
        inside = (across >= 0) & (across < columns) & (down >= 0) & (down < rows)
        i, j = (
            np.clip(np.floor(position), 0, n - 1).astype(int)
            for position, n in ((down, rows), (across, columns))
        )
        white = (i + j) % 2 == 1
        margin = (square - marker) / 2
        p, q = (
            np.floor(((position - k) * square - margin) / marker * side)
            for position, k in ((down, i), (across, j))
        )
        coded = white & (p >= 0) & (p < side) & (q >= 0) & (q < side)
        cell = bits[i, j, np.clip(p, 0, side - 1).astype(int), np.clip(q, 0, side - 1).astype(int)]
        return np.where(inside, np.where(coded, cell, white), 1.0)

    return paint


def dots(columns, rows, pitch, diameter):
    """Black dots about the middle."""

    def paint(x, y):
        p, q = x / pitch + (columns - 1) / 2, y / pitch + (rows - 1) / 2
        i, j = np.clip(np.rint(p), 0, columns - 1), np.clip(np.rint(q), 0, rows - 1)
        return np.where(np.hypot(p - i, q - j) * pitch < diameter / 2, 0.0, 1.0)

    return paint


def photograph(
    view,
    paint,
    pose=(0.0, 0.0, 0.0),
    *,
    blur=0.0,
    noise=0.0,
    seed=0,
    dtype=np.uint8,
    fine=3,
    counts=(30, 210),
    light=None,
):
    """Take a picture of a board that lies turned by an angle (degrees) and moved (x, y) mm on the sheet.

    ``counts`` of black and white, and ``noise``, are of 8 bits; samples of 16 have 257 times as many.
    ``light`` is a factor of each pixel.
    """
    rows, columns = view.shape
    reach = 6  # pixels around, that blur brings in
    down, across = ((np.arange((n + 2 * reach) * fine) + 0.5) / fine - 0.5 - reach for n in (rows, columns))
    x, y = view.sheet(*np.meshgrid(across, down))
    angle, dx, dy = pose
    c, s = cos(radians(angle)), sin(radians(angle))
    picture = paint(c * (x - dx) + s * (y - dy), c * (y - dy) - s * (x - dx))
    picture = picture.reshape(rows + 2 * reach, fine, columns + 2 * reach, fine).mean((1, 3))
    # The mean over a pixel is a blur of its own; a Gauss over means differs from one over rays by little.
    picture = (
        ndimage.gaussian_filter(picture, blur)[reach:-reach, reach:-reach]
        if blur
        else picture[reach:-reach, reach:-reach]
    )
    samples = counts[0] + (counts[1] - counts[0]) * picture
    if light is not None:
        samples = samples * light
    samples = samples + noise * np.random.default_rng(seed).standard_normal(samples.shape)
    if np.dtype(dtype).kind == "f":
        return samples.astype(dtype)
    full = np.iinfo(dtype).max
    return np.clip(np.rint(samples * (full / 255)), 0, full).astype(dtype)


def marks_in(view, board, pose):
    """The places, (n, 2), of a board's marks in the picture of `photograph`."""
    turn, right, up = pose
    x, y = board.marks().T
    c, s = cos(radians(turn)), sin(radians(turn))
    return np.stack(view.place(c * x - s * y + right, s * x + c * y + up), axis=1)


def uneven_light(shape):
    """Light that falls to 36 % in one corner."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    x, y = x / shape[1] - 0.3, y / shape[0] - 0.4
    light = (0.88 - 0.4 * x) * (1 - 0.5 * (x * x + y * y))
    return light / light.max()
