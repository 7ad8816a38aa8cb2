"""The tests' own book of rays and poses, against closed forms and against brute force."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import poses
import pytest
import rays
from numpy.typing import NDArray

Map = NDArray[np.float64]

UP = np.array([0.0, 0.0, 1.0])
BARE = rays.Chamber()


def leaning_mirror(zenith: float | Map, azimuth: float | Map = 0.0) -> Map:
    return np.array([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)])


def random_units(count: int, steepest: float, seed: int) -> Map:
    rng = np.random.default_rng(seed)
    zenith, azimuth = rng.uniform(0.0, steepest, count), rng.uniform(-np.pi, np.pi, count)
    return np.moveaxis(leaning_mirror(zenith, azimuth), 0, -1)


# --- rays ----------------------------------------------------------------------------------------


def test_a_mirror_sends_back_what_comes_at_the_same_angle_in_the_same_plane() -> None:
    for normal, to_camera in zip(random_units(50, 0.7, 0), random_units(50, 0.5, 1), strict=True):
        ray = rays.reflected(normal, to_camera)
        assert ray @ normal == pytest.approx(to_camera @ normal, abs=1e-14)
        assert np.linalg.norm(ray) == pytest.approx(1, abs=1e-14)
        assert np.linalg.det([ray, normal, to_camera]) == pytest.approx(0, abs=1e-14)
        assert ray @ to_camera == pytest.approx(np.cos(2 * np.arccos(normal @ to_camera)), abs=1e-12)


@pytest.mark.parametrize("zenith", np.radians([12, 20, 30, 44]))
def test_a_mirror_at_the_centre_shows_the_wall_at_twice_its_zenith(zenith: float) -> None:
    seen: list[tuple[float, float]] = []

    def watched(height: Map, azimuth: Map) -> Map:
        seen.extend(zip(height, azimuth, strict=True))
        return np.ones_like(height)

    assert rays.wall_light(BARE, watched, (0, 0, 0), leaning_mirror(zenith, 2.0)) == 1
    assert seen == [pytest.approx((17.5 / np.tan(2 * zenith), 2.0), abs=1e-12)]


def test_the_wall_is_seen_from_the_centre_between_12_and_45_degrees() -> None:
    degrees = np.array([0.0, 5.0, 11.8, 11.9, 20.0, 44.9, 45.1, 60.0])
    light = [rays.wall_light(BARE, rays.uniform, (0, 0, 0), leaning_mirror(z)) for z in np.radians(degrees)]
    assert light == [0, 0, 0, 1, 1, 1, 0, 0]


def test_rays_meet_the_wall_where_walking_along_them_does() -> None:
    rng = np.random.default_rng(2)
    for ray in random_units(40, 1.5, 3):
        if ray[2] > 0.95:
            continue  # too far to walk
        start = np.array([*rng.uniform(-11, 11, 2), rng.uniform(0, 3)])
        step = 0.001
        walk = start + step * np.arange(120_000)[:, np.newaxis] * ray
        arrival = walk[np.argmax(np.hypot(walk[:, 0], walk[:, 1]) >= 17.5)]
        found: list[Map] = []

        def marked(height: Map, azimuth: Map, found: list[Map] = found) -> Map:
            found.append(np.concatenate([17.5 * np.cos(azimuth), 17.5 * np.sin(azimuth), height]))
            return np.ones_like(height)

        light = rays.traced(rays.Chamber(height=1000.0), marked, start, ray[np.newaxis])
        assert light[0] == 1
        np.testing.assert_allclose(found[0], arrival, atol=2 * step)


def test_the_wall_stands_from_the_rest_plane_to_the_rim() -> None:
    high = np.array([0.0, 0.0, 2.0])  # above the rest plane, 17.5 mm from the wall
    rise = np.array([-2.01, -1.99, 0.0, 37.99, 38.01])
    directions = np.stack([np.full(5, 17.5), np.zeros(5), rise], axis=-1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    assert rays.traced(BARE, rays.uniform, high, directions).tolist() == [0, 1, 1, 1, 0]


def test_what_starts_outside_the_body_is_dark() -> None:
    across = np.array([[-1.0, 0.0, 0.1]]) / np.hypot(1, 0.1)
    inside, outside = np.array([17.4, 0, 0]), np.array([17.6, 0, 0])
    assert rays.traced(BARE, rays.uniform, inside, across) == 1
    assert rays.traced(BARE, rays.uniform, outside, across) == 0


def test_light_goes_from_gap_to_mirror_on_the_shortest_way() -> None:
    # Fermat: to first order the optical length does not depend on where the ray leaves the silicone.
    chamber = rays.Chamber(air_gap=2.0, height=1000.0)
    start, hair = np.array([3.0, -5.0, 1.0]), 1e-4
    checked = 0
    for ray in random_units(200, 1.5, 4):
        place, _ = rays._to_cylinder(start[np.newaxis], ray[np.newaxis], chamber.radius)
        beyond, passed = rays._into_air(place, ray[np.newaxis], chamber.index)
        if passed[0] == 0:
            continue
        end = rays._to_cylinder(place, beyond, chamber.radius + chamber.air_gap)[0][0]
        for turned, lifted in ((hair / 17.5, 0.0), (0.0, hair)):
            lengths = []
            for side in (1, -1):
                leaves = poses.rotation_z(side * turned) @ place[0] + [0, 0, side * lifted]
                lengths.append(1.41 * np.linalg.norm(leaves - start) + np.linalg.norm(end - leaves))
            assert (lengths[0] - lengths[1]) / (2 * hair) == pytest.approx(0, abs=1e-6)
        checked += 1
    assert checked > 50


def test_some_rays_leave_the_silicone_and_some_do_not() -> None:
    directions = random_units(500, 1.5, 5)
    straight_out = directions[:, 0] / np.hypot(directions[:, 0], directions[:, 1])
    place = np.broadcast_to([17.5, 0.0, 1.0], directions.shape)
    outwards = straight_out > 0
    _, passed = rays._into_air(place[outwards], directions[outwards], 1.41)
    np.testing.assert_array_equal(passed > 0, directions[outwards, 0] > np.sqrt(1 - 1 / 1.41**2))
    assert 0.1 < np.mean(passed > 0) < 0.9


@pytest.mark.parametrize(
    ("incidence", "share"),
    [
        (0.0, 4 * 1.41 / 2.41**2),
        # At Brewster's angle all of one polarisation passes, of the other all but ((n^2 - 1)/(n^2 + 1))^2.
        (np.arctan(1 / 1.41), 1 - 0.5 * ((1.41**2 - 1) / (1.41**2 + 1)) ** 2),
        (np.arcsin(1 / 1.41) + 1e-6, 0.0),
    ],
)
def test_fresnel_lets_through_what_is_known_of_special_angles(incidence: float, share: float) -> None:
    ray = np.array([[np.cos(incidence), 0.0, np.sin(incidence)]])
    _, passed = rays._into_air(np.array([[17.5, 0.0, 1.0]]), ray, 1.41)
    assert passed[0] == pytest.approx(share, abs=1e-12)


@pytest.mark.parametrize("direction", [(1, 0, 0), (0, 1, 0), (1, -2, 0)])
def test_scattered_offsets_are_evenly_spread_along_any_line(direction: tuple[float, float, float]) -> None:
    largest = 1e-3  # so small that the sphere of directions is flat
    offset = rays.scattered(UP, largest) @ (np.array(direction) / np.linalg.norm(direction))
    expected = np.linspace(-largest, largest, len(offset))
    np.testing.assert_allclose(np.sort(offset), expected, atol=0.01 * largest)


def test_scattered_rays_lie_round_the_ray_within_the_largest_angle() -> None:
    for ray in random_units(5, 1.4, 6):
        directions = rays.scattered(ray, np.radians(3))
        away = poses.between(directions, np.broadcast_to(ray, directions.shape))
        assert np.degrees(away.max()) == pytest.approx(3, abs=0.01)
        assert np.degrees(away.max()) <= 3
        np.testing.assert_allclose(np.cross(directions.mean(axis=0), ray), 0, atol=1e-5)
    np.testing.assert_array_equal(rays.scattered(UP, 0.0), [UP])


def test_a_linear_wall_seen_from_the_centre_is_linear_in_zenith() -> None:
    pattern = rays.linear_in_zenith(17.5, np.radians(15), np.radians(40))
    zenith = np.radians(np.linspace(12, 44, 33))
    light = [rays.wall_light(BARE, pattern, (0, 0, 0), leaning_mirror(z, 1.0)) for z in zenith]
    np.testing.assert_allclose(light, np.clip((np.degrees(zenith) - 15) / 25, 0, 1), atol=1e-12)


def test_a_picture_is_itself_at_its_elements_and_half_way_between_them_a_mean() -> None:
    image = np.random.default_rng(7).uniform(size=(4, 6))
    pattern = rays.picture(image, 40.0)
    height = np.array([35.0, 25.0, 15.0, 5.0])[:, np.newaxis]  # from the top row downwards
    azimuth = np.radians([-150.0, -90, -30, 30, 90, 150])
    np.testing.assert_allclose(pattern(height, azimuth), image, atol=1e-12)
    np.testing.assert_allclose(
        pattern(height, azimuth + np.radians(30)), (image + np.roll(image, -1, axis=1)) / 2, atol=1e-12
    )
    np.testing.assert_allclose(pattern(height[1:] + 5, azimuth), (image[1:] + image[:-1]) / 2, atol=1e-12)
    np.testing.assert_allclose(pattern(np.array([[40.0], [0.0]]), azimuth), image[[0, -1]], atol=1e-12)
    around = np.linspace(-np.pi, np.pi, 101)
    expected = np.interp(around, azimuth, image[2], period=2 * np.pi)
    np.testing.assert_allclose(pattern(np.array([[15.0]]), around)[0], expected, atol=1e-12)


def test_lamps_brighter_on_one_side_light_that_side_fully_and_the_other_less() -> None:
    chamber = rays.Chamber(asymmetry=0.25, asymmetry_azimuth=0.5)
    light = [
        rays.wall_light(chamber, rays.uniform, (0, 0, 0), leaning_mirror(0.5, 0.5 + turned))
        for turned in (0, np.pi / 2, np.pi)
    ]
    assert light == pytest.approx([1, 0.8, 0.6])


@pytest.mark.parametrize("distance", [60.0, 150.0, 1000.0])
@pytest.mark.parametrize("away", [0.5, 6.0, 15.0])
def test_a_sight_line_is_the_shortest_optical_way_to_the_pinhole(distance: float, away: float) -> None:
    view = rays.sight_line(0.6 * away, -0.8 * away, distance)
    assert view[0] * -0.8 == pytest.approx(view[1] * 0.6)  # in the plane of the axis
    leaves = np.linspace(0, away, 200_001)
    length = 1.41 * np.hypot(away - leaves, 40.0) + np.hypot(leaves, distance - 40.0)
    assert away - np.hypot(*view) * 40.0 == pytest.approx(leaves[np.argmin(length)], abs=2e-4 * away)
    assert view[0] < 0  # the line leans inwards


def test_without_refraction_a_sight_line_is_straight() -> None:
    assert rays.sight_line(3.0, 4.0, 100.0, index=1.0) == pytest.approx((-0.03, -0.04))
    assert rays.sight_line(0.0, 0.0, 100.0) == pytest.approx((0, 0), abs=0)


# --- poses ---------------------------------------------------------------------------------------

SOLIDS: dict[str, poses.Solid] = {"ball": poses.Ball(), "cone": poses.Cone(), "plate": poses.Plate()}
HEIGHTS: dict[str, Callable[[Map, Map], Map]] = {
    "ball": lambda x, y: np.sqrt(np.maximum(25.0 - x**2 - y**2, 0)) - 5.0,
    "cone": lambda x, y: -np.tan(np.pi / 6) * np.hypot(x, y),
    "plate": lambda x, y: -np.tan(np.pi / 9) * (5 + x * np.cos(np.pi / 6) + y * np.sin(np.pi / 6)),
}


def test_a_leaning_body_sees_normals_as_equation_10_says() -> None:
    tilt = 0.2
    for normal, phase in zip(random_units(100, 1.2, 8), np.linspace(-9, 9, 100), strict=True):
        (zenith, azimuth), body = poses.angles(normal), poses.leaning(phase, tilt, 1.0).turn @ normal
        expected = np.cos(zenith) * np.cos(tilt) - np.sin(zenith) * np.sin(tilt) * np.cos(azimuth - phase)
        assert body[2] == pytest.approx(expected, abs=1e-14)


def test_the_axis_of_a_leaning_body_leans_away_from_the_phase() -> None:
    phase, tilt = 0.7, 0.3
    pose = poses.leaning(phase, tilt, 1.0, (1.0, 2.0, 3.0))
    axis = pose.to_world(UP) - pose.to_world(np.zeros(3))
    expected = [-np.sin(tilt) * np.cos(phase), -np.sin(tilt) * np.sin(phase), np.cos(tilt)]
    np.testing.assert_allclose(axis, expected, atol=1e-14)


def test_a_body_turns_about_the_pivot_that_it_took_down_with_it() -> None:
    pivot = np.array([3.0, -2.0, 40.0])
    for phase in (0.0, 1.0, 4.0):
        pose = poses.leaning(phase, 0.3, 2.0, pivot)
        np.testing.assert_allclose(pose.to_world(pivot), pivot - [0, 0, 2.0], atol=1e-13)
        np.testing.assert_allclose(
            pose.to_body(pose.to_world(np.array([1.0, 2.0, 3.0]))), [1, 2, 3], atol=1e-13
        )
    np.testing.assert_allclose(
        poses.leaning(1.0, 0.0, 2.0, pivot).shift, poses.lowered(2.0).shift, atol=1e-13
    )


def test_what_the_body_leaves_behind_moves_and_turns_the_other_way() -> None:
    point = np.array([1.0, 0.0, -1.0])
    np.testing.assert_allclose(poses.lowered(0.5).to_body(point), [1, 0, -0.5])
    np.testing.assert_allclose(poses.moved_aside((0.25, -0.5), 0.5).to_body(point), [0.75, 0.5, -0.5])
    np.testing.assert_allclose(poses.twisted(np.pi / 2, 0.5).to_body(point), [0, -1, -0.5], atol=1e-15)


@pytest.mark.parametrize("view", [(0.0, 0.0), (-0.12, 0.2)])
@pytest.mark.parametrize("tilt", np.radians([0, 2.5, 20]))
@pytest.mark.parametrize("name", SOLIDS)
def test_a_line_of_sight_ends_where_walking_down_it_meets_the_object(
    name: str, tilt: float, view: tuple[float, float]
) -> None:
    solid, pose = SOLIDS[name], poses.leaning(0.8, tilt, 2.0, (0.5, 0.0, 3.0))
    x, y = (part.ravel() for part in np.meshgrid(np.linspace(-5, 5, 9), np.linspace(-4, 4, 7)))
    seen = poses.see(solid, pose, x, y, view)
    good = seen.contact & poses.clear(solid, pose, x, y, view, hair=0.05, edge=0.05)
    assert good.sum() > 10
    x, y = x[good], y[good]
    # Both ends of each line, and the middle in between, are halved 60 times: above the object, or inside it.
    low, high = np.full(x.shape, -0.1), np.full(x.shape, 8.0)
    for _ in range(60):
        middle = (low + high) / 2
        line = np.stack([x + middle * view[0], y + middle * view[1], middle], axis=-1)
        world = pose.to_world(line)
        above = world[:, 2] > HEIGHTS[name](world[:, 0], world[:, 1])
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    np.testing.assert_allclose(seen.height[good], low, atol=1e-11)


@pytest.mark.parametrize("name", SOLIDS)
def test_normals_are_upright_on_the_surface_that_the_lines_of_sight_meet(name: str) -> None:
    solid, pose, view = SOLIDS[name], poses.leaning(2.0, 0.3, 1.5, (0.5, 0.0, 3.0)), (-0.1, 0.15)
    x, y = np.meshgrid(np.linspace(-3, 3, 11), np.linspace(-4, 4, 11))
    seen = poses.see(solid, pose, x, y, view)
    good = seen.contact & poses.clear(solid, pose, x, y, view, hair=0.01, edge=0.01)
    assert good.sum() > 20
    hair = 1e-5

    def point(x: Map, y: Map) -> Map:
        height = poses.see(solid, pose, x, y, view).height
        return np.stack([x + height * view[0], y + height * view[1], height], axis=-1)

    for across in ((hair, 0.0), (0.0, hair)):
        tangent = point(x + across[0], y + across[1]) - point(x - across[0], y - across[1])
        slant = np.sum(tangent * seen.normal, axis=-1) / np.linalg.norm(tangent, axis=-1)
        assert np.abs(slant[good]).max() < 1e-8
    np.testing.assert_allclose(np.linalg.norm(seen.normal, axis=-1), 1)
    assert np.all(seen.normal[good][:, 2] > 0)


def test_a_turned_ball_is_a_ball() -> None:
    pose = poses.leaning(2.5, 0.1, 1.0, (2.0, 1.0, 30.0))
    centre = pose.to_body(np.array([0.0, 0.0, -5.0]))
    x, y = np.meshgrid(np.linspace(-8, 8, 65), np.linspace(-8, 8, 65))
    seen = poses.see(poses.Ball(), pose, x, y)
    height = centre[2] + np.sqrt(np.maximum(25 - (x - centre[0]) ** 2 - (y - centre[1]) ** 2, 0))
    np.testing.assert_array_equal(seen.contact, height >= 0)
    np.testing.assert_allclose(seen.height, np.maximum(height, 0), atol=1e-12)
    zenith = np.arcsin(np.hypot(x - centre[0], y - centre[1])[seen.contact] / 5)
    np.testing.assert_allclose(seen.zenith[seen.contact], zenith, atol=1e-12)
    azimuth = np.arctan2(y - centre[1], x - centre[0])[seen.contact]
    np.testing.assert_allclose(seen.azimuth[seen.contact], azimuth, atol=1e-9)


@pytest.mark.parametrize("name", SOLIDS)
def test_what_is_below_the_edge_is_known_by_walking_down_the_line_of_sight(name: str) -> None:
    solid, pose, view = SOLIDS[name], poses.leaning(2.0, 0.35, 4.0, (0.5, 0.0, 4.0)), (-0.1, 0.15)
    reach = solid.radius + 2
    x, y = np.meshgrid(np.linspace(-reach, reach, 41), np.linspace(-reach, reach, 37))
    seen = poses.see(solid, pose, x, y, view)
    down = np.arange(12.0, 0.0, -0.02)[:, np.newaxis, np.newaxis]
    line = np.stack(np.broadcast_arrays(x + down * view[0], y + down * view[1], down), axis=-1)
    world = pose.to_world(line)
    over = np.hypot(world[..., 0], world[..., 1]) < solid.radius
    if name == "plate":
        over &= world[..., 0] * np.cos(np.pi / 6) + world[..., 1] * np.sin(np.pi / 6) > -5
    inside = over & (world[..., 2] < HEIGHTS[name](world[..., 0], world[..., 1]))
    met = inside.any(axis=0)
    # Seen over the edge a step before it is inside: it came through the top.
    came = np.take_along_axis(over, np.maximum(inside.argmax(axis=0) - 1, 0)[np.newaxis], axis=0)[0]
    clear = poses.clear(solid, pose, x, y, view, hair=0.05, edge=0.05) | seen.below
    assert (seen.below & clear).sum() > 5
    assert np.mean((seen.below == (met & ~came))[clear]) > 0.99
    assert np.mean((seen.contact == (met & came))[clear]) > 0.99


def test_an_untouched_sheet_is_level() -> None:
    seen = poses.see(poses.Ball(), poses.lowered(1.0), np.array([0.0, 2.9, 3.1]), np.zeros(3))
    assert seen.contact.tolist() == [True, True, False]
    assert (seen.height[2], seen.zenith[2], seen.zenith[0]) == (0, 0, 0)
    assert np.isnan(seen.azimuth[[0, 2]]).all()
    assert seen.height[0] == pytest.approx(1)


def test_small_angles_between_vectors_are_exact() -> None:
    for angle in (0.0, 1e-9, 1e-3, 2.0):
        assert poses.between(UP, leaning_mirror(angle, 1.0)) == pytest.approx(angle, rel=1e-9)


def test_slopes_and_angles_say_the_same_of_a_normal() -> None:
    zenith, azimuth = poses.angles(poses.normals(np.array([-1.0, 0.0]), np.array([1.0, 0.0])))
    np.testing.assert_allclose(zenith, [np.arctan(np.sqrt(2)), 0])
    np.testing.assert_allclose(azimuth, [-np.pi / 4, np.nan])
