"""The wall in the mirror: the kernel against its reference, and the reference against plain geometry."""

from __future__ import annotations

import numpy as np
import pytest
from launches import launch

from mirrorskin.kernels.wall import wall_light

RADIUS, RIM, INDEX = 17.5, 40.0, 1.41
SCATTER = np.radians(3)
ONE_RAY = np.array([[1.0, 0.0, 0.0]])
CLEAR = np.ones((3, 3))


def some_rays(count=24, scatter=SCATTER):
    """A few rays within the scatter, in no order; the mirrored one comes first."""
    generator = np.random.default_rng(count)
    off, turn = scatter * generator.random(count), 2 * np.pi * generator.random(count)
    off[0] = 0
    return np.stack([np.cos(off), np.sin(off) * np.cos(turn), np.sin(off) * np.sin(turn)], axis=1)


def tables():
    """One of each kind: alike everywhere, by height alone, by both."""
    generator = np.random.default_rng(3)
    rows = np.repeat(generator.random((12, 1)), 5, axis=1)
    both = np.pad(np.pad(generator.random((9, 14)), ((1, 1), (0, 0)), "edge"), ((0, 0), (1, 1)), "wrap")
    return {0: np.full((3, 3), 0.75), 1: rows, 2: both}


def some_sheet(pixels, steepest=60.0, seed=1):
    """Mirrors of any zenith and azimuth, many of them flat, at places some of which are outside the body."""
    generator = np.random.default_rng(seed)
    zenith = np.radians(steepest) * generator.random(pixels) * (generator.random(pixels) > 0.3)
    azimuth = 2 * np.pi * generator.random(pixels)
    height = 3 * generator.random(pixels) * (zenith > 0)
    slopes = -np.tan(zenith) * np.array([np.cos(azimuth), np.sin(azimuth)])
    away, turn = 18.5 * np.sqrt(generator.random(pixels)), 2 * np.pi * generator.random(pixels)
    return np.stack([height, *slopes]), away * np.array([np.cos(turn), np.sin(turn)])


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


def run(device, sheet, places, rays, table, gap, scatter, fade, lamps):
    values = {"sheet": sheet, "places": places, "rays": rays, "table": table}
    arrays = []
    for name, value in values.items():
        array = device.array(name, value.shape, np.float32)
        array.host[:] = value
        array.upload()
        arrays.append(array)
    light = device.array("light", sheet.shape[1:], np.float32)
    light.host[:] = -1
    light.upload()
    kind = 2 if len(table) == 11 else int(np.ptp(table) > 0)
    macros = {
        "TABLE": kind,
        "GAP": int(gap > 0),
        "LAMPS": int(lamps != (0, 0)),
        "OBLIQUE": int(len(places) == 4),
    }
    sizes = sheet.shape[1], len(rays), len(table) - 2, table.shape[1] - 2
    numbers = RADIUS, RIM, gap, INDEX, scatter, fade, *lamps
    kernel = device.kernel("wall", "wall_light", **macros)
    launch(kernel, -(-sheet.shape[1] // device.layout.tile), *sizes, *arrays, *numbers, light)
    return light.download().copy()


def single(*values):
    """Round to what the device is told, so that reference and kernel are asked the same."""
    return [np.asarray(value, np.float32).astype(np.float64) for value in values]


@pytest.mark.parametrize(
    ("kind", "gap", "lamps", "oblique"),
    [
        (0, 0.0, (0.0, 0.0), False),
        (1, 0.0, (0.3, -0.2), True),
        (2, 0.0, (0.0, 0.0), False),
        (0, 2.0, (0.0, 0.0), True),
        (1, 0.6, (0.0, 0.0), False),
        (2, 0.6, (0.1, 0.2), True),
    ],
)
def test_the_kernel_computes_the_reference(device, kind, gap, lamps, oblique):
    sheet, places = some_sheet(1100)  # a tile and a part of one
    if oblique:
        places = np.concatenate([places, -places / 90])
    sheet, places, rays, table = single(sheet, places, some_rays(), tables()[kind])
    fade = SCATTER / 12
    found = run(device, sheet, places, rays, table, gap, SCATTER, fade, lamps)
    expected = wall_light(sheet, places, rays, table, RADIUS, RIM, gap, INDEX, SCATTER, fade, *lamps)
    assert 0.1 < (expected > 0.01).mean() < 0.9
    difference = np.abs(found - expected)
    assert difference.max() < 1e-3
    assert np.median(difference) < 1e-6
    # Light grows as a root from the angle of total reflection on, and hard by the side the way is uncertain.
    if gap == 0:
        assert difference[RADIUS - np.hypot(*places[:2]) > 0.2].max() < 2e-5


def test_without_scatter_only_rays_at_an_edge_may_differ(device):
    sheet, places = some_sheet(1500)
    sheet, places = single(sheet, places)
    found = run(device, sheet, places, ONE_RAY, CLEAR, 0.0, 0.0, 0.0, (0.0, 0.0))
    expected = wall_light(sheet, places, ONE_RAY, CLEAR, RADIUS, RIM, 0.0, INDEX, 0.0, 0.0, 0.0, 0.0)
    assert set(np.unique(expected)) == {0.0, 1.0}
    assert (found != expected).sum() <= 1


@pytest.mark.parametrize("zenith", [13.0, 20.0, 30.0, 44.0])
@pytest.mark.parametrize("height", [0.0, 2.5])
def test_a_mirror_at_the_centre_shows_the_wall_twice_its_zenith_off_the_axis(zenith, height):
    seen = look(mirror(zenith, 70, height), (0, 0), by_height())
    assert seen * RIM == pytest.approx(height + RADIUS / np.tan(np.radians(2 * zenith)), abs=2e-5)


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
    seen = look(mirror(15), (0, 0, -tilt, 0), by_height())
    assert seen * RIM == pytest.approx(RADIUS / np.tan(np.radians(40)), abs=2e-5)
    # Raised by 2 mm, it is seen further back along that line.
    seen = look(mirror(15, height=2), (0, 0, -tilt, 0), by_height())
    assert seen * RIM == pytest.approx(2 + (RADIUS + 2 * tilt) / np.tan(np.radians(40)), abs=2e-5)


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
        seen = look(mirror(zenith, 30), (0, 0), by_height(), gap) / look(
            mirror(zenith, 30), (0, 0), CLEAR, gap
        )
        assert seen * RIM == pytest.approx(RADIUS * np.tan(inside) + gap * np.tan(outside), abs=2e-5)


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
        share = (1 + 0.4 * np.cos(np.radians(azimuth - 50))) / 1.4
        assert look(mirror(30, azimuth), (0, 0), gap=gap, lamps=lamps) == pytest.approx(
            plain * share, abs=1e-6
        )
