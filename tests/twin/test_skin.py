"""The elastic sheet in the sensor: its computed part, its pixels, and its end."""

from __future__ import annotations

import contact_theory
import numpy as np
import pytest
import rays
from geometry import pixel_centres
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from mirrorskin.io import InputError
from mirrorskin.twin import Axial, Body, Coin, Object, Plane, Sphere
from mirrorskin.twin.movement import Pose, pose_at_press
from mirrorskin.twin.skin import Conform, Elastic, Sheet
from mirrorskin.twin.view import View

Map = NDArray[np.float64]

BODY = Body()
RADIUS = 17.5


def view(shape: tuple[int, int], pixel: float, distance: float = np.inf) -> View:
    return View(shape, (pixel, pixel), BODY, distance)


def elastic(
    thing: Object, pose: Pose, shape: tuple[int, int], pixel: float, body: Body = BODY, **more: float
) -> Elastic:
    return Elastic(
        thing, [pose], View(shape, (pixel, pixel), body, more.pop("distance", np.inf)), body, **more
    )


def drape(thing: Object, pose: Pose, shape: tuple[int, int], pixel: float, body: Body = BODY) -> Sheet:
    return elastic(thing, pose, shape, pixel, body).drape(pose)


def inner(values: NDArray[np.generic], shape: tuple[int, int]) -> NDArray[np.generic]:
    """Cut the middle out of a map; what is left on opposite sides is alike."""
    rows, columns = ((big - small) // 2 for big, small in zip(values.shape, shape, strict=True))
    return values[rows : rows + shape[0], columns : columns + shape[1]]


def parts(sheet: Sheet) -> tuple[Map, Map, Map]:
    return sheet.height, sheet.dz_dx, sheet.dz_dy


LEANING = Axial([2.0], 0.15, 0.8, (0.0, 0.0, 20.0))
REACHES: dict[str, tuple[Object, Pose]] = {
    "plane": (Plane(), pose_at_press(3.0)),
    "the coin's table": (Coin(), pose_at_press(1.7)),
    "a ball aside": (Sphere(8.0), Pose(np.eye(3), np.array([5.0, -3.0, 1.0]))),
    "a leaning ball": (Sphere(), LEANING.pose(LEANING.path[0])),
}


@pytest.mark.parametrize("reach", REACHES)
def test_a_small_field_shows_what_a_field_as_large_as_the_body_shows(reach: str) -> None:
    # What touches beyond the field's edge pushes the sheet in within it, too.
    thing, pose = REACHES[reach]
    small, large, pixel = (10, 16), (90, 90), 0.4
    actual, expected = drape(thing, pose, small, pixel), drape(thing, pose, large, pixel)
    assert expected.contact.sum() > inner(expected.contact, small).sum() + 10
    assert actual.height.max() > 0.05
    np.testing.assert_array_equal(actual.contact, inner(expected.contact, small))
    for here, target in zip(parts(actual), parts(expected), strict=True):
        assert here.shape == small
        np.testing.assert_allclose(here, inner(target, small), atol=2e-5)


def test_an_object_that_needs_too_many_points_is_refused_with_a_remedy() -> None:
    with pytest.raises(
        InputError, match=r"coin needs 17500 x 17500 points.*larger pixels or.*conform"
    ) as caught:
        elastic(Coin(), pose_at_press(1.7), (20, 20), 0.002)
    assert "\n" not in str(caught.value)


def test_the_sheet_is_on_the_object_in_contact_and_bulges_next_to_it() -> None:
    # A ball of 20 mm, and a sheet without thickness. Hertz: contact to sqrt(10 mm x 0.6 mm).
    body, pose, shape, pixel = Body(sheet=0.0), pose_at_press(0.6), (100, 100), 0.08
    thing = Sphere(20.0)
    actual = drape(thing, pose, shape, pixel, body)
    soft = Conform(thing, view(shape, pixel)).drape(pose)
    x, y = pixel_centres(shape, pixel)
    theory = contact_theory.sphere(10.0, 2.4164, 1.0)
    assert theory.depth == pytest.approx(0.6, rel=0.01)
    radius = np.sqrt(actual.contact.sum() / np.pi) * pixel
    assert radius == pytest.approx(2.4164 * np.sqrt(0.6 / theory.depth), rel=0.01)
    np.testing.assert_allclose(actual.height[actual.contact], soft.height[actual.contact], atol=1e-5)
    assert (soft.contact | ~actual.contact).all()
    assert soft.contact.sum() > 1.5 * actual.contact.sum()
    assert (actual.height >= soft.height - 1e-5).all()
    assert (actual.height[~actual.contact] > soft.height[~actual.contact]).all()
    well_inside = np.hypot(x, y) < 0.9 * radius
    np.testing.assert_allclose(actual.dz_dx[well_inside], soft.dz_dx[well_inside], atol=1e-3)
    np.testing.assert_allclose(actual.dz_dy[well_inside], soft.dz_dy[well_inside], atol=1e-3)
    assert soft.dz_dx[well_inside].min() < -0.15


def test_slopes_are_those_of_the_height_along_x_and_y() -> None:
    body = Body(sheet=0.0)
    field = View((40, 30), (0.2, 0.1), body)
    pose = Pose(np.eye(3), np.array([0.5, -0.4, 1.0]))
    actual = Elastic(Sphere(20.0), [pose], field, body).drape(pose)
    by_row, by_column = np.gradient(actual.height)
    some = np.s_[1:-1, 1:-1]  # the grid goes on beyond the edge
    np.testing.assert_allclose(actual.dz_dx[some], by_column[some] / 0.2, atol=1e-12)
    np.testing.assert_allclose(actual.dz_dy[some], -by_row[some] / 0.1, atol=1e-12)
    # In contact the sheet falls as the ball does, away from its apex.
    x, y = field.x - 0.5, field.y + 0.4
    down = np.sqrt(10.0**2 - x**2 - y**2)
    inside = np.hypot(x, y) < 1.5
    assert actual.contact[inside].all()
    np.testing.assert_allclose(actual.dz_dx[inside], (-x / down)[inside], atol=1e-3)
    np.testing.assert_allclose(actual.dz_dy[inside], (-y / down)[inside], atol=1e-3)


@pytest.mark.parametrize("shape", [(1, 9), (9, 1), (1, 1)])
def test_a_field_of_one_row_or_column_has_slopes(shape: tuple[int, int]) -> None:
    sheet = drape(Sphere(2.0), pose_at_press(0.05), shape, 0.5)
    assert all(part.shape == shape and np.isfinite(part).all() for part in parts(sheet))


def test_a_thick_sheet_shows_softer_slopes() -> None:
    slopes = [
        float(np.abs(drape(Coin(), pose_at_press(0.4), (60, 60), 0.2, Body(sheet=depth)).dz_dx).max())
        for depth in (0.0, 0.2)
    ]
    assert slopes[0] > 1.3 * slopes[1] > 0


def test_there_is_no_sheet_beyond_the_body() -> None:
    shape, pixel = (80, 84), 0.5
    x, y = pixel_centres(shape, pixel)
    outside = np.hypot(x, y) > RADIUS
    for distance in (np.inf, 90.0):
        # The plate is pressed up to the body's very rim.
        contact = elastic(
            Plane(radius=RADIUS, reach=10.0), pose_at_press(9.0), shape, pixel, distance=distance
        )
        sheet = contact.drape(pose_at_press(9.0))
        assert sheet.height[~outside].max() > 2
        assert sheet.contact[~outside & (np.hypot(x, y) > RADIUS - 1)].any()
        assert not sheet.contact[outside].any()
        for part in parts(sheet):
            assert not part[outside].any()


@pytest.mark.parametrize("distance", [50.0, 65.0])
def test_a_pinhole_camera_sees_where_its_lines_meet_the_sheet(distance: float) -> None:
    shape, pixel, press = (60, 80), 0.4, 2.5
    pose = Pose(np.eye(3), np.array([9.0, 4.0, press]))
    oblique = elastic(Sphere(20.0), pose, shape, pixel, distance=distance)
    upright = elastic(Sphere(20.0), pose, shape, pixel)
    assert oblique.space.shape == upright.space.shape == shape
    pressure = upright.solve(pose).pressure
    slanted, whole = oblique.sheet(pressure), upright.sheet(pressure)

    x, y = pixel_centres(shape, pixel)
    lean_x, lean_y = rays.sight_line(x, y, distance)
    maps = [
        RegularGridInterpolator((y[::-1, 0], x[0]), part[::-1], bounds_error=False, fill_value=0.0)
        for part in parts(whole)
    ]

    def on_line(values: RegularGridInterpolator, z: Map) -> Map:
        actual: Map = values(np.stack([y + z * lean_y, x + z * lean_x], axis=-1))
        return actual

    low, high = np.zeros(shape), np.full(shape, 4.0)
    for _ in range(30):
        middle = (low + high) / 2
        above = middle > on_line(maps[0], middle)
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    # The grid's outermost row is where brute force knows no more.
    clear = (np.hypot(x, y) < RADIUS) & np.pad(np.ones((56, 76), bool), 2)
    np.testing.assert_allclose(slanted.height[clear], low[clear], atol=5e-6)
    for part, values in zip(parts(slanted)[1:], maps[1:], strict=True):
        np.testing.assert_allclose(part[clear], on_line(values, low)[clear], atol=1e-5)
    assert np.abs(slanted.height - whole.height)[clear].max() > 0.03  # it does matter
    # Contact is that of the nearest point of the grid.
    row, column = (29.5 - (y + low * lean_y) / pixel, 39.5 + (x + low * lean_x) / pixel)
    sure = clear & (np.abs(row % 1 - 0.5) > 1e-3) & (np.abs(column % 1 - 0.5) > 1e-3)
    nearest = whole.contact[np.rint(row).astype(int).clip(0, 59), np.rint(column).astype(int).clip(0, 79)]
    np.testing.assert_array_equal(slanted.contact[sure], nearest[sure])
    assert (slanted.contact != whole.contact).sum() > 10


def test_the_field_is_in_the_middle_of_the_grown_grid() -> None:
    shape, pixel = (12, 20), 0.3
    contact = elastic(Coin(), pose_at_press(1.7), shape, pixel)
    assert contact.space.shape != shape
    expected = pixel_centres(contact.space.shape, pixel)
    np.testing.assert_allclose(contact.grid_places, expected, atol=1e-12)
    np.testing.assert_allclose(contact.crop(contact.grid_places), pixel_centres(shape, pixel), atol=1e-12)
    np.testing.assert_allclose(contact.places, pixel_centres(shape, pixel), atol=1e-12)
