import math

import numpy as np
import pytest

from mirrorskin.kernels.response import light_slopes, wall_light

GEOMETRY = 17.5, 40.0, math.radians(1.5)
LAMPS = 0.03, -0.04
CURVE = np.array([1.0, -1.1, 0.4, -0.3])
ALL = -1.0, 1.0


def mirrors(count=400, seed=1):
    rng = np.random.default_rng(seed)
    place = np.stack(
        [*rng.uniform(-8, 8, (2, count)), rng.uniform(0, 2, count), *rng.uniform(-0.1, 0.1, (2, count))]
    )
    zenith, azimuth = rng.uniform(0.25, 0.75, (3, count)), rng.uniform(-math.pi, math.pi, (3, count))
    return place, facing(zenith, azimuth)


def facing(zenith, azimuth):
    sine = np.sin(zenith)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), np.cos(zenith) + 0 * azimuth], axis=-1)


def test_a_mirror_at_the_centre_shows_the_wall_at_twice_its_zenith():
    zenith = np.radians(np.linspace(12.0, 44.0, 33))[np.newaxis]
    q, _ = wall_light(np.zeros((5, 33)), facing(zenith, 0.3), GEOMETRY, (0, 0), [0.0, 1.0], ALL)
    np.testing.assert_allclose(math.pi / 4 - np.arctan(q), zenith, atol=1e-14)
    height = 17.5 / np.tan(2 * zenith)
    np.testing.assert_allclose(q, height / (17.5 + np.sqrt(height**2 + 17.5**2)), atol=1e-14)


def test_a_mirror_off_the_axis_worked_out_by_hand():
    # At x = 3.5 and z = 1 a zenith of 30 degrees towards x sends the ray 60 degrees off the axis: 14 mm on,
    # it is 14 / tan 60 higher.
    place = np.array([[3.5], [0.0], [1.0], [0.0], [0.0]])
    height = 1 + 14 / math.tan(math.radians(60))
    q = height / (17.5 + math.hypot(height, 17.5))
    light, within = wall_light(place, facing(np.radians([[30.0]]), 0.0), GEOMETRY, LAMPS, CURVE, ALL)
    assert light[0, 0] == pytest.approx((1 + 0.03) * (1 - 1.1 * q + 0.4 * q**2 - 0.3 * q**3), abs=1e-14)
    assert within[0, 0]


def test_an_oblique_sight_meets_the_raised_mirror_beside_its_pixel():
    # The line through x = 2 on the rest plane leans by 0.1 to x: 2 mm higher it is at 2.2. A level mirror
    # sends it on to -x, 0.1 along for each 1 up: far above the rim.
    place = np.array([[2.0], [0.0], [2.0], [0.1], [0.0]])
    level = np.array([[[0.0, 0.0, 1.0]]])
    q, within = wall_light(place, level, GEOMETRY, (0, 0), [0.0, 1.0], ALL)
    height = 2 + (17.5 + 2.2) / 0.1
    assert q[0, 0] == pytest.approx(height / (17.5 + math.hypot(height, 17.5)), abs=1e-14)
    assert not within[0, 0]


def test_the_point_met_lies_on_the_wall_and_on_the_ray():
    place, normals = mirrors()
    mx, my, q = (
        wall_light(place, normals, GEOMETRY, lamps, curve, ALL)[0] - (not any(curve[1:]))
        for lamps, curve in (((1, 0), [1.0, 0.0]), ((0, 1), [1.0, 0.0]), ((0, 0), [0.0, 1.0]))
    )
    np.testing.assert_allclose(np.hypot(mx, my), 1, atol=1e-13)
    height = 17.5 * 2 * q / (1 - q**2)
    x, y, z, vx, vy = place
    to = np.stack([17.5 * mx - x - z * vx, 17.5 * my - y - z * vy, height - z], axis=-1)
    out = to / np.linalg.norm(to, axis=-1, keepdims=True)
    back = np.stack([vx, vy, np.ones_like(vx)], axis=-1)
    half = out + back / np.linalg.norm(back, axis=-1, keepdims=True)
    np.testing.assert_allclose(half / np.linalg.norm(half, axis=-1, keepdims=True), normals, atol=1e-12)


def test_slopes_are_those_of_small_differences():
    place, normals = mirrors()
    told = light_slopes(place, normals, GEOMETRY, LAMPS, CURVE)
    rng = np.random.default_rng(2)
    across = np.cross(normals, rng.normal(size=normals.shape))
    step = 1e-5
    ends = []
    for sign in (-1, 1):
        moved = normals + sign * step * across
        moved /= np.linalg.norm(moved, axis=-1, keepdims=True)
        ends.append(wall_light(place, moved, GEOMETRY, LAMPS, CURVE, ALL)[0])
    np.testing.assert_allclose((told * across).sum(axis=-1), (ends[1] - ends[0]) / (2 * step), atol=2e-9)


def test_a_wall_that_is_evenly_lit_has_no_slopes():
    place, normals = mirrors(20)
    np.testing.assert_array_equal(light_slopes(place, normals, GEOMETRY, (0, 0), [1.0]), 0)
    light, _ = wall_light(place, normals, GEOMETRY, (0, 0), [1.0], ALL)
    np.testing.assert_array_equal(light, 1)


def test_within_are_rays_all_of_whose_scattered_ones_meet_the_wall():
    zenith = np.radians(np.linspace(8.0, 48.0, 401))[np.newaxis]
    _, within = wall_light(np.zeros((5, 401)), facing(zenith, 1.0), GEOMETRY, LAMPS, CURVE, ALL)
    rim = math.atan2(17.5, 40.0) / 2
    expected = (zenith >= rim + GEOMETRY[2] / 2) & (zenith <= math.pi / 4 - GEOMETRY[2] / 2)
    assert (within == expected).all()


def test_beyond_the_reach_of_the_curve_nothing_is_within():
    zenith = np.radians(np.linspace(14.0, 43.0, 30))[np.newaxis]
    reach = math.tan(math.radians(45.0 - 40.2)), math.tan(math.radians(45.0 - 20.2))
    _, within = wall_light(np.zeros((5, 30)), facing(zenith, 1.0), GEOMETRY, LAMPS, CURVE, reach)
    assert (within == (zenith > math.radians(20.2)) & (zenith < math.radians(40.2))).all()


def test_each_sample_may_have_a_place_of_its_own():
    place, normals = mirrors(7)
    each = (
        place[:, np.newaxis]
        + np.array([0.1, 0, 0, 0, 0])[:, np.newaxis, np.newaxis] * np.arange(3)[:, np.newaxis]
    )
    together = wall_light(each, normals, GEOMETRY, LAMPS, CURVE, ALL)[0]
    slopes = light_slopes(each, normals, GEOMETRY, LAMPS, CURVE)
    for k in range(3):
        one = each[:, k], normals[k : k + 1]
        np.testing.assert_array_equal(together[k], wall_light(*one, GEOMETRY, LAMPS, CURVE, ALL)[0][0])
        np.testing.assert_array_equal(slopes[k], light_slopes(*one, GEOMETRY, LAMPS, CURVE)[0])


def test_a_place_without_a_number_gives_none():
    place, normals = mirrors(5)
    place[2, 1] = np.nan
    light, within = wall_light(place, normals, GEOMETRY, LAMPS, CURVE, ALL)
    assert np.isnan(light[:, 1]).all()
    assert not within[:, 1].any()
    assert np.isfinite(np.delete(light, 1, axis=1)).all()


def test_out_of_reach_the_curve_goes_on_straight():
    zenith = np.radians(np.linspace(5.0, 60.0, 56))[np.newaxis]
    normals, place, reach = facing(zenith, 1.0), np.zeros((5, 56)), (0.1, 0.4)
    q = np.tan(np.pi / 4 - zenith)
    held = np.clip(q, *reach)
    polynomial = np.polynomial.Polynomial(CURVE)
    light, _ = wall_light(place, normals, GEOMETRY, (0, 0), CURVE, reach)
    np.testing.assert_allclose(light, polynomial(held) + polynomial.deriv()(held) * (q - held), atol=1e-14)
    along = facing(zenith + np.pi / 2, 1.0)
    told = (light_slopes(place, normals, GEOMETRY, (0, 0), CURVE, reach) * along).sum(axis=-1)
    np.testing.assert_allclose(told, -polynomial.deriv()(held) * (1 + q**2), atol=1e-12)
