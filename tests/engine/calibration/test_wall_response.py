"""The zenith at which mirrors turn light, compared with closed forms of the cylinder."""

import math

import numpy as np
import pytest

from mirrorskin.engine.calibration.wall_response import full_light, threshold_zenith
from mirrorskin.io import WallResponse
from mirrorskin.twin import Body, visible_zenith

BODY = Body()
NOTHING = np.zeros((2, 2), np.float32)


def response(curve=(1.0,), scatter=1e-6, **fields):
    arguments = {
        "radius": BODY.radius,
        "rim": BODY.height,
        "axis": (0.0, 0.0),
        "sight": (0.0, 0.0),
        "lamps": (0.0, 0.0),
        "scatter": scatter,
        "curve": np.array(curve),
        "reach": (0.0, math.tan(math.atan2(BODY.height, BODY.radius) / 2)),
        "shade": np.zeros(5),
        "pattern": "uniform",
        "zenith_sigma": NOTHING,
        "azimuth_sigma": NOTHING,
        "parameters": (),
        "covariance": np.zeros((0, 0)),
        "error": 0.0,
    }
    return WallResponse(**{**arguments, **fields})


def test_in_the_middle_light_begins_at_half_the_rims_angle():
    azimuth = np.linspace(-np.pi, np.pi, 7)
    expected = math.atan2(BODY.radius, BODY.height) / 2
    np.testing.assert_allclose(threshold_zenith(response(), 0.0, 0.0, azimuth), expected, atol=1e-5)


def test_elsewhere_it_begins_where_the_rim_is_seen():
    x, y = np.meshgrid(np.linspace(-8, 8, 5), np.linspace(-8, 8, 5))
    for azimuth in (0.3, 2.0, -2.5):
        expected, _ = visible_zenith(BODY, x, y, azimuth)
        zenith = threshold_zenith(response(), x, y, azimuth)
        assert zenith.shape == x.shape
        np.testing.assert_allclose(zenith, expected, atol=1e-5)


def test_scatter_does_not_move_half_the_light_but_other_shares():
    wide = response(scatter=math.radians(3))
    middle = threshold_zenith(wide, 0.0, 0.0, 0.0)
    assert middle == pytest.approx(threshold_zenith(response(), 0.0, 0.0, 0.0), abs=1e-4)
    # A ray turns by twice as much as its mirror: the box of 6 degrees passes within 3.
    early, late = (threshold_zenith(wide, 0.0, 0.0, 0.0, fraction) for fraction in (0.25, 0.75))
    assert math.degrees(late - early) == pytest.approx(1.5, abs=1e-3)


def test_a_higher_mirror_sees_the_rim_sooner_and_places_are_relative_to_the_axis():
    assert threshold_zenith(response(), 0, 0, 0, z=2.0) == pytest.approx(math.atan2(17.5, 38.0) / 2, abs=1e-5)
    moved = response(axis=(1.0, -2.0))
    moved_zenith, here = threshold_zenith(moved, 4.0, 0.5, 0.7), threshold_zenith(response(), 3.0, 2.5, 0.7)
    assert moved_zenith == pytest.approx(here, abs=1e-12)


def test_the_threshold_of_a_graded_wall_follows_from_its_curve():
    # Light 1 - q: the elevation is 2 atan(q), so half the light is at q = 0.5 if the wall reaches so far.
    graded = response(curve=(1.0, -1.0))
    zenith = threshold_zenith(graded, 0.0, 0.0, 1.0, 0.6)
    assert zenith == pytest.approx(math.pi / 4 - math.atan(0.4), abs=1e-4)


def test_where_no_zenith_is_light_there_is_none():
    assert np.isnan(threshold_zenith(response(), 0.0, 0.0, 0.0, 1.5))
    assert np.isnan(threshold_zenith(response(), 18.0, 0.0, 0.0))


def test_lamps_and_shade_count():
    bright = response(lamps=(0.1, 0.0), shade=np.array([0.0, 0.2, 0.0, 0.0, 0.0]))
    place = np.array([[0.0], [3.5], [0.0]])
    steep, zero = np.array([math.radians(40)]), np.array([0.0])
    shade = 1 + 0.2 * 3.5 / BODY.radius
    at_x = math.sqrt(1 - (3.5 / BODY.radius) ** 2)
    assert full_light(bright, place, steep, zero)[0] == pytest.approx(shade * (1 + 0.1 * at_x), rel=1e-9)
