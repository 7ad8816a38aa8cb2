"""The wall in the mirror: the reference, compared with plain geometry."""

from __future__ import annotations

import numpy as np
import pytest

from mirrorskin.kernels.twin.wall import wall_light

RADIUS, RIM, INDEX = 17.5, 40.0, 1.41
SCATTER = np.radians(3)
ONE_RAY = np.array([[1.0, 0.0, 0.0]])
CLEAR = np.ones((3, 3))


def mirror(zenith, azimuth=0.0, height=0.0):
    """One mirror, angles in degrees, as the sheet of one pixel."""
    slope = -np.tan(np.radians(zenith))
    return np.array([[height], [slope * np.cos(np.radians(azimuth))], [slope * np.sin(np.radians(azimuth))]])


def look(sheet, place, table=CLEAR, gap=0.0, lamps=(0.0, 0.0)):
    """What one unscattered pixel sees."""
    places = np.asarray(place, float).reshape(-1, 1)
    return wall_light(sheet, places, ONE_RAY, table, RADIUS, RIM, gap, INDEX, 0.0, 0.0, *lamps)[0]


def by_height(rows=4000):
    """A wall whose radiance is its height over the rim's."""
    column = 1 - (np.arange(rows + 2) - 0.5) / rows
    return np.repeat(column[:, np.newaxis], 3, axis=1)


def by_azimuth(columns=4000):
    """A wall whose radiance grows from 0 at azimuth -pi to 1 at pi."""
    return np.repeat(((np.arange(columns + 2) - 0.5) / columns)[np.newaxis], 3, axis=0)


@pytest.mark.parametrize("zenith", [13.0, 20.0, 30.0, 44.0])
@pytest.mark.parametrize("height", [0.0, 2.5])
def test_a_mirror_at_the_centre_shows_the_wall_twice_its_zenith_off_the_axis(zenith, height):
    light = look(mirror(zenith, 70, height), (0, 0), by_height())
    assert light * RIM == pytest.approx(height + RADIUS / np.tan(np.radians(2 * zenith)), abs=2e-5)


def test_a_mirror_off_the_centre_shows_where_its_ray_meets_the_circle():
    x, y, turn = 6.0, -9.0, np.radians(115)
    # By hand: the greater root of |(x, y) + t (cos, sin)| = radius.
    t = max(np.roots([1, 2 * (x * np.cos(turn) + y * np.sin(turn)), x * x + y * y - RADIUS**2]).real)
    azimuth = np.arctan2(y + t * np.sin(turn), x + t * np.cos(turn))
    assert look(mirror(30, 115), (x, y), by_azimuth()) == pytest.approx(azimuth / (2 * np.pi) + 0.5, abs=1e-6)
    assert look(mirror(30, 115), (x, y), by_height()) * RIM == pytest.approx(t / np.tan(np.pi / 3), abs=2e-5)


def test_a_line_of_sight_is_mirrored_as_a_vector():
    # Looking down at 10 degrees towards +x, a mirror of 15 degrees towards +x sends the ray 40 degrees off.
    tilt = np.tan(np.radians(10))
    light = look(mirror(15), (0, 0, -tilt, 0), by_height())
    assert light * RIM == pytest.approx(RADIUS / np.tan(np.radians(40)), abs=2e-5)
    # Raised by 2 mm, it is seen further back along that line.
    light = look(mirror(15, height=2), (0, 0, -tilt, 0), by_height())
    assert light * RIM == pytest.approx(2 + (RADIUS + 2 * tilt) / np.tan(np.radians(40)), abs=2e-5)


@pytest.mark.parametrize(
    ("zenith", "place", "height", "light"),
    [
        (0, (0, 0), 0, 0),
        (11.7, (0, 0), 0, 0),  # over the rim: atan(17.5 / 40) / 2 is 11.81 degrees
        (11.9, (0, 0), 0, 1),
        (44.9, (0, 0), 0, 1),
        (45.1, (0, 0), 0, 0),  # down, on to the sheet
        (45.1, (0, 0), 1, 1),  # down, but from above: it still meets the wall
        (50.0, (0, 0), 1, 0),
        (30, (17.4, 0), 0, 1),
        (30, (17.6, 0), 0, 0),  # outside the body
        (30, (0, -17.6), 0, 0),
    ],
)
def test_light_comes_from_between_rim_and_rest_plane(zenith, place, height, light):
    assert look(mirror(zenith, height=height), place) == light


def test_across_a_gap_light_is_refracted():
    gap = 1.5
    for zenith in (25.0, 35.0, 43.0):
        inside = np.radians(90 - 2 * zenith)  # to the side's normal
        outside = np.arcsin(INDEX * np.sin(inside))
        ratio = look(mirror(zenith, 30), (0, 0), by_height(), gap) / look(
            mirror(zenith, 30), (0, 0), CLEAR, gap
        )
        assert ratio * RIM == pytest.approx(RADIUS * np.tan(inside) + gap * np.tan(outside), abs=2e-5)


def test_the_bodys_side_reflects_part_of_the_light():
    # A level ray from above the rest plane meets it at a right angle.
    normal = look(mirror(45, height=1), (0, 0), gap=0.5)
    assert normal == pytest.approx(1 - ((INDEX - 1) / (INDEX + 1)) ** 2, abs=1e-6)
    # At Brewster's angle nothing of one polarisation is reflected.
    brewster = np.arctan(1 / INDEX)
    zenith = (90 - np.degrees(brewster)) / 2
    other = (np.cos(brewster) * INDEX - np.sin(brewster)) / (np.cos(brewster) * INDEX + np.sin(brewster))
    assert look(mirror(zenith), (0, 0), gap=0.5) == pytest.approx(1 - other**2 / 2, abs=1e-6)


def test_beyond_the_critical_angle_all_light_is_reflected():
    critical = np.degrees(np.arcsin(1 / INDEX))
    assert look(mirror((90 - critical) / 2 - 0.05), (0, 0), gap=0.1) == 0
    assert look(mirror((90 - critical) / 2 + 0.05), (0, 0), gap=0.1) > 0.25


@pytest.mark.parametrize("gap", [0.0, 1.0])
def test_lamps_light_one_side_more(gap):
    lamps = 0.4 * np.cos(np.radians(50)), 0.4 * np.sin(np.radians(50))
    plain = look(mirror(30, 50), (0, 0), gap=gap)
    for azimuth in (50, 110, 230):
        expected = (1 + 0.4 * np.cos(np.radians(azimuth - 50))) / 1.4
        assert look(mirror(30, azimuth), (0, 0), gap=gap, lamps=lamps) == pytest.approx(
            plain * expected, abs=1e-6
        )
