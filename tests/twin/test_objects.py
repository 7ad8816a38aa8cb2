"""The objects' surfaces, compared with the tests' own geometry; the optics, with the body's."""

from __future__ import annotations

import geometry
import numpy as np
import pytest

from mirrorskin.twin.catalogue import make_object
from mirrorskin.twin.coin import Coin
from mirrorskin.twin.object_files import HeightMap
from mirrorskin.twin.objects import Cone, Cylinder, Object, Plane, Sphere, Step, Texture, zenith_azimuth
from mirrorskin.twin.optics import uniform_response

PIXEL = 0.05
SHAPES = [(211, 230), (1, 1)]


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("name", geometry.SURFACES)
def test_surface_is_the_geometry(name: str, shape: tuple[int, int]) -> None:
    thing = make_object(name, shape, (PIXEL, PIXEL))
    x, y = geometry.pixel_centres(shape, PIXEL)
    expected = geometry.SURFACES[name](shape, PIXEL)
    np.testing.assert_allclose(thing.height(x, y), expected.height, rtol=0, atol=1e-9)
    zenith, azimuth = zenith_azimuth(*thing.slope(x, y))
    np.testing.assert_allclose(zenith, expected.zenith, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(np.isnan(azimuth), np.isnan(expected.azimuth))
    turn = np.nan_to_num(azimuth - expected.azimuth)
    np.testing.assert_allclose(np.remainder(turn + 1, 2 * np.pi), 1, rtol=0, atol=1e-9)


THINGS: list[Object] = [
    Sphere(),
    Cone(),
    Plane(),
    Coin(),
    Cylinder(azimuth=0.3),
    Step(azimuth=0.3),
    Texture(azimuth=0.3),
]


@pytest.mark.parametrize("thing", THINGS, ids=lambda thing: thing.name)
def test_slope_is_the_height_differentiated(thing: Object) -> None:
    places = np.random.default_rng(0).uniform(-4, 4, (2, 4000))
    x, y = places[:, np.hypot(*places) < 4.5]
    step = 1e-5
    dz_dx, dz_dy = thing.slope(x, y)
    actual = np.stack([dz_dx, dz_dy])
    expected = np.stack(
        [
            (thing.height(x + step, y) - thing.height(x - step, y)) / (2 * step),
            (thing.height(x, y + step) - thing.height(x, y - step)) / (2 * step),
        ]
    )
    near = np.isclose(actual, expected, rtol=1e-5, atol=1e-6, equal_nan=True)
    assert near.mean() > 0.998  # a kink of the coin may fall between the two steps


@pytest.mark.parametrize(
    ("slope", "azimuth"),
    [((-1, 0), 0), ((0, -1), 90), ((1, 0), 180), ((1, -0.0), 180), ((0, 1), -90), ((-1, -1), 45)],
)
def test_azimuth_is_counter_clockwise_downhill(slope: tuple[float, float], azimuth: float) -> None:
    dz_dx, dz_dy = (np.array([component], float) for component in slope)
    zenith, actual = zenith_azimuth(dz_dx, dz_dy)
    assert np.degrees(actual[0]) == pytest.approx(azimuth)
    assert np.tan(zenith[0]) == pytest.approx(np.hypot(*slope))


@pytest.mark.parametrize(
    ("degrees", "fraction"),
    [
        (0, 0),
        (10.31, 0),
        (11.8147, 0.5),
        (13.32, 1),
        (30, 1),
        (43.49, 1),
        (44.25, 0.75),
        (45, 0.5),
        (46.51, 0),
    ],
)
def test_response_in_numbers(degrees: float, fraction: float) -> None:
    assert uniform_response(np.radians([degrees]))[0] == pytest.approx(fraction, abs=2e-5)


def test_height_map_gives_its_samples_between_them_the_line_and_outside_nothing() -> None:
    heights = np.array([[0.0, -1.0, -4.0], [-2.0, -3.0, np.nan]])
    thing = HeightMap(heights, (0.5, 0.25))
    x, y = np.meshgrid([-0.5, 0.0, 0.5], [0.125, -0.125])
    np.testing.assert_array_equal(thing.height(x, y), heights)
    inside = thing.height(
        np.array([-0.25, -0.5, 0.25, 0.25, 0.51]), np.array([0.125, 0.0, 0.125, 0.0, 0.125])
    )
    np.testing.assert_allclose(inside, [-0.5, -1.0, -2.5, np.nan, np.nan])


def test_height_map_slopes_are_one_sided_at_its_edges() -> None:
    heights = np.array([[0.0, -1.0, -4.0], [-2.0, -3.0, np.nan]])
    x, y = np.meshgrid([-0.5, 0.0, 0.5], [0.125, -0.125])
    dz_dx, dz_dy = HeightMap(heights, (0.5, 0.25)).slope(x, y)
    np.testing.assert_allclose(dz_dx, [[-2.0, -4.0, -6.0], [-2.0, -2.0, np.nan]])
    np.testing.assert_allclose(dz_dy, [[8.0, 8.0, np.nan], [8.0, 8.0, np.nan]])


def test_the_radius_of_a_height_map_leaves_out_the_table() -> None:
    heights = np.full((41, 61), -2.0)
    heights[20, 30:46] = -1.0
    assert HeightMap(heights, (0.5, 0.25)).radius == pytest.approx(7.5)
    heights[heights == -2] = np.nan  # no table: one level is the object
    assert HeightMap(heights, (0.5, 0.25)).radius == pytest.approx(7.5)
