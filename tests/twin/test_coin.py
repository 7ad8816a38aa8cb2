"""The coin: its relief, and that this sensor can see all its ramps."""

from __future__ import annotations

import geometry
import numpy as np
from numpy.typing import NDArray

from mirrorskin.twin.coin import Coin
from mirrorskin.twin.objects import zenith_azimuth

PIXEL = 0.04
SHAPE = (660, 660)
FIELD = -0.25  # between the motifs
TABLE = -1.5

Map = NDArray[np.float64]


def on_circle(radius: float, start: float = 0.0, stop: float = 360.0) -> Map:
    """Return the heights along a circle about the hole, counter-clockwise from x."""
    angle = np.radians(np.linspace(start, stop, 7200, endpoint=False))
    return Coin().height(radius * np.cos(angle), radius * np.sin(angle))


def along(x0: float, y0: float, x1: float, y1: float) -> Map:
    """Return the heights along a straight line, one every 2 um or so."""
    return Coin().height(np.linspace(x0, x1, 5000), np.linspace(y0, y1, 5000))


def ridges(profile: Map) -> int:
    """Count how often a closed profile rises above half of a line's relief."""
    up = profile > FIELD + 0.1
    return int(np.sum(up & ~np.roll(up, 1)))


def test_outline_hole_and_table() -> None:
    np.testing.assert_array_equal(on_circle(10.98), 0)  # the rim is the highest
    np.testing.assert_array_equal(on_circle(2.52), 0)  # and so is the ring round the hole
    for radius in (11.02, 2.48):  # both fall off at 22 and 5 mm
        assert (on_circle(radius) < 0).all()
    for radius in (12.9, 16.0, 0.5, 0.0):
        np.testing.assert_array_equal(on_circle(radius), TABLE)


def test_relief_is_two_to_three_tenths_of_a_millimetre() -> None:
    x, y = geometry.pixel_centres(SHAPE, PIXEL)
    height = Coin().height(x, y)
    face = height[(np.hypot(x, y) > 2.5) & (np.hypot(x, y) < 11)]
    assert face.min() == FIELD
    assert face.max() == 0
    lines = [on_circle(6.9, 130, 195).max(), along(0, -4.3, 0, -9.2).max(), along(-5.4, -3.5, -5.4, -7).max()]
    assert all(0.2 <= line - FIELD <= 0.3 for line in lines)
    assert height.min() == TABLE


def test_every_ramp_is_in_the_visible_window_and_all_else_is_level() -> None:
    # A little off the pixel centres, which lie on many a foot and ridge of a drawing on the same grid.
    x, y = (places + 0.0037 for places in geometry.pixel_centres(SHAPE, PIXEL))
    zenith, _ = zenith_azimuth(*Coin().slope(x, y))
    degrees = np.degrees(zenith)
    assert np.isfinite(degrees).all()
    level, ramp = degrees < 0.01, (degrees > 30) & (degrees < 40.1)
    assert (level | ramp).mean() > 0.9995  # the rest are ridges and feet met by chance
    assert 0.3 < ramp.mean() < 0.7
    np.testing.assert_array_equal(geometry.response(zenith[ramp]), 1)
    np.testing.assert_array_equal(geometry.response(zenith[level]), 0)


def test_ramps_are_at_least_three_pixels_wide() -> None:
    """Walk up and down from places on ramps: the normal stays for 3 pixels of 0.04 mm."""
    coin = Coin()
    x, y = (places.ravel()[::7] for places in geometry.pixel_centres(SHAPE, PIXEL))
    zenith, azimuth = zenith_azimuth(*coin.slope(x, y))
    on_ramp = (zenith > np.radians(25)) & (zenith < np.radians(45))
    x, y, azimuth = x[on_ramp], y[on_ramp], azimuth[on_ramp]

    width = np.zeros(len(x))
    for direction in (-1, 1):
        walking = np.full(len(x), True)
        for step in range(1, 13):
            distance = direction * step * PIXEL / 4
            ahead = coin.slope(x + distance * np.cos(azimuth), y + distance * np.sin(azimuth))
            ahead_zenith, ahead_azimuth = zenith_azimuth(*ahead)
            turned = np.abs(np.angle(np.exp(1j * (ahead_azimuth - azimuth))))
            walking &= (ahead_zenith > np.radians(25)) & (turned < np.radians(15))
            width += walking * PIXEL / 4
    assert np.mean(width >= 3 * PIXEL - 0.5 * PIXEL) > 0.97  # less only where a ramp ends in a corner
