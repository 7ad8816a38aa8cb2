"""The named objects: closed forms, symmetries, and sizes."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from mirrorskin.io import InputError
from mirrorskin.twin.catalogue import OBJECT_NAMES, check_fits, make_object
from mirrorskin.twin.objects import Cylinder, Object, Sphere, Step, Texture, zenith_azimuth

SHAPE, PIXEL = (480, 480), 0.025

Map = NDArray[np.float64]


def named(name: str) -> Object:
    return make_object(name, SHAPE, (PIXEL, PIXEL))


def ring(radius: float) -> tuple[Map, Map]:
    angle = np.linspace(-np.pi, np.pi, 7200, endpoint=False)
    return radius * np.cos(angle), radius * np.sin(angle)


def across(azimuth: float, distance: Map, sideways: Map) -> tuple[Map, Map]:
    """Return x and y of places so far along the azimuth, and so far to the left of it."""
    return (
        distance * np.cos(azimuth) - sideways * np.sin(azimuth),
        distance * np.sin(azimuth) + sideways * np.cos(azimuth),
    )


AZIMUTHS = [0.7, -2.5]


@pytest.mark.parametrize("azimuth", AZIMUTHS)
def test_a_rod_is_round_across_and_straight_along(azimuth: float) -> None:
    rod = Cylinder(diameter=6.0, length=8.0, azimuth=azimuth)
    along, angle = np.meshgrid(np.linspace(-3.99, 3.99, 30), np.radians(np.linspace(-80, 80, 41)))
    x, y = across(azimuth, along, 3 * np.sin(angle))
    np.testing.assert_allclose(rod.height(x, y), 3 * np.cos(angle) - 3, rtol=0, atol=1e-12)
    slope = across(azimuth, np.zeros_like(angle), -np.tan(angle))
    np.testing.assert_allclose(rod.slope(x, y), slope, rtol=0, atol=1e-9)


@pytest.mark.parametrize("azimuth", AZIMUTHS)
def test_a_rod_ends_at_its_ends_and_at_its_equator(azimuth: float) -> None:
    rod = Cylinder(diameter=6.0, length=8.0, azimuth=azimuth)
    x, y = across(azimuth, np.array([4.01, -4.01, 0.0, 0.0]), np.array([0.0, 0.0, 3.01, -3.01]))
    assert np.isnan(rod.height(x, y)).all()
    assert np.isnan(rod.slope(x, y)).all()


@pytest.mark.parametrize("azimuth", AZIMUTHS)
def test_a_step_has_two_levels_and_a_straight_ramp_between(azimuth: float) -> None:
    step = Step(drop=0.4, zenith=np.radians(45), azimuth=azimuth)
    downhill = np.array([-9.0, -0.2001, -0.1, 0.0, 0.05, 0.2001, 9.0])
    x, y = across(azimuth, downhill, np.linspace(-5, 5, 7))
    np.testing.assert_allclose(step.height(x, y), [0, 0, -0.1, -0.2, -0.25, -0.4, -0.4], atol=1e-12)
    zenith, direction = zenith_azimuth(*step.slope(x, y))
    np.testing.assert_allclose(np.degrees(zenith), [0, 0, 45, 45, 45, 0, 0])
    np.testing.assert_allclose(direction, [np.nan, np.nan, azimuth, azimuth, azimuth, np.nan, np.nan])


@pytest.mark.parametrize("azimuth", AZIMUTHS)
def test_a_texture_is_a_sinusoid_with_its_ridges_at_the_sheet(azimuth: float) -> None:
    texture = Texture(wavelength=3.0, amplitude=0.25, azimuth=azimuth)
    places = np.array([-3.0, 0.0, 3.0, 1.5, 0.75, 0.5])
    x, y = across(azimuth, places, np.linspace(-4, 4, 6))
    np.testing.assert_allclose(texture.height(x, y), [0, 0, 0, -0.5, -0.25, -0.125], atol=1e-12)
    steepest = 2 * np.pi * 0.25 / 3.0
    slope = across(azimuth, steepest * np.array([0, 0, 0, 0, -1, -np.sqrt(0.75)]), np.zeros(6))
    np.testing.assert_allclose(texture.slope(x, y), slope, atol=1e-12)


@pytest.mark.parametrize("name", OBJECT_NAMES)
def test_no_named_object_rises_above_the_sheet_and_all_fit_under_the_sensor(name: str) -> None:
    thing = named(name)
    assert thing.name == name
    steps = np.arange(-17.5, 17.5, 0.05)
    heights = thing.height(*np.meshgrid(steps, steps))
    assert -0.05 < np.nanmax(heights) <= 0
    check_fits(thing, 17.5)


@pytest.mark.parametrize("name", OBJECT_NAMES)
def test_the_radius_is_that_of_the_smallest_circle_that_holds_the_object(name: str) -> None:
    thing = named(name)
    table = -1.5 if name == "coin" else np.nan
    np.testing.assert_array_equal(thing.height(*ring(thing.radius + 1e-3)), table)
    inside = thing.height(*ring(thing.radius - 0.01))
    assert (np.isfinite(inside) & (inside != table)).any()


def test_a_plane_covers_its_field_or_the_whole_body() -> None:
    within = make_object("plane", (600, 800), (0.04, 0.04))
    assert np.isfinite(within.height(np.array([-13.9, 13.9]), np.array([-10.0, 10.0]))).all()
    beyond = make_object("plane", (900, 1200), (0.04, 0.04))
    check_fits(beyond, 17.5)
    around = np.linspace(0, 2 * np.pi, 60)
    assert np.isfinite(beyond.height(17.4 * np.cos(around), 17.4 * np.sin(around))).all()


def test_an_object_larger_than_the_sensor_is_refused() -> None:
    with pytest.raises(InputError) as caught:
        check_fits(Sphere(diameter=35.5), 17.5)
    message = str(caught.value)
    for word in ("sphere", "35.5 mm", "35 mm", "smaller"):
        assert word in message
    assert "\n" not in message


@pytest.mark.parametrize("name", ["teapot", "Sphere", "sphere.step", "", "."])
def test_an_unknown_name_is_refused_with_the_known_ones(name: str) -> None:
    with pytest.raises(InputError) as caught:
        named(name)
    message = str(caught.value)
    assert repr(name) in message
    assert all(expected in message for expected in (*OBJECT_NAMES, ".png", ".npy", ".stl", ".ply"))
    assert "\n" not in message
