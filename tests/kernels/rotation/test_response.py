import math

import numpy as np

from mirrorskin.kernels.rotation.response import light_slopes, wall_light

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


def test_the_point_met_is_on_the_wall_and_on_the_ray():
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
    slopes = light_slopes(place, normals, GEOMETRY, LAMPS, CURVE)
    rng = np.random.default_rng(2)
    across = np.cross(normals, rng.normal(size=normals.shape))
    step = 1e-5
    ends = []
    for sign in (-1, 1):
        moved = normals + sign * step * across
        moved /= np.linalg.norm(moved, axis=-1, keepdims=True)
        ends.append(wall_light(place, moved, GEOMETRY, LAMPS, CURVE, ALL)[0])
    np.testing.assert_allclose((slopes * across).sum(axis=-1), (ends[1] - ends[0]) / (2 * step), atol=2e-9)


def test_within_are_rays_all_of_whose_scattered_ones_meet_the_wall():
    zenith = np.radians(np.linspace(8.0, 48.0, 401))[np.newaxis]
    _, within = wall_light(np.zeros((5, 401)), facing(zenith, 1.0), GEOMETRY, LAMPS, CURVE, ALL)
    rim = math.atan2(17.5, 40.0) / 2
    expected = (zenith >= rim + GEOMETRY[2] / 2) & (zenith <= math.pi / 4 - GEOMETRY[2] / 2)
    assert (within == expected).all()


def test_out_of_reach_the_curve_goes_on_straight():
    zenith = np.radians(np.linspace(5.0, 60.0, 56))[np.newaxis]
    normals, place, reach = facing(zenith, 1.0), np.zeros((5, 56)), (0.1, 0.4)
    q = np.tan(np.pi / 4 - zenith)
    held = np.clip(q, *reach)
    polynomial = np.polynomial.Polynomial(CURVE)
    light, _ = wall_light(place, normals, GEOMETRY, (0, 0), CURVE, reach)
    np.testing.assert_allclose(light, polynomial(held) + polynomial.deriv()(held) * (q - held), atol=1e-14)
    along = facing(zenith + np.pi / 2, 1.0)
    slopes = (light_slopes(place, normals, GEOMETRY, (0, 0), CURVE, reach) * along).sum(axis=-1)
    np.testing.assert_allclose(slopes, -polynomial.deriv()(held) * (1 + q**2), atol=1e-12)
