"""Tangential force and traction: Mindlin's and Cattaneo's contacts, and the twin's skin."""

from __future__ import annotations

import numpy as np
import pytest
from contact_theory import paraboloid, pushed, traction_response

from mirrorskin import io
from mirrorskin.engine.force import find_force, find_tangential_force
from mirrorskin.engine.slip import find_displacement
from mirrorskin.twin import Body, Camera, Horizontal, SheetTexture, Sphere, Twin

MODULUS, PIXEL = 0.1, 0.05
SHEAR = MODULUS / 3


def places(count=61, pixel=PIXEL):
    x = pixel * (np.arange(count) - (count - 1) / 2)
    return x[np.newaxis], -x[:, np.newaxis]


def half_ellipsoid(radius, peak, *grid):
    """The traction peak sqrt(1 - r^2 / a^2) along x, and the displacement in it: Johnson, eq. 3.91."""
    x, y = places(*grid)
    inside = np.hypot(x, y) < radius
    traction = np.where(inside, peak * np.sqrt(np.maximum(1 - (x**2 + y**2) / radius**2, 0)), 0)
    size = np.pi * peak / (32 * SHEAR * radius)
    moved = np.stack([size * (6 * radius**2 - 2.5 * x**2 - 3.5 * y**2), size * x * y], axis=-1)
    return inside, traction, moved


def force_of(force):
    return np.array([force.force_x, force.force_y])


def test_a_disc_that_sticks_is_mindlin_s():
    x, y = places()
    disc = np.hypot(x, y) <= 1
    moved = np.broadcast_to([0.1, -0.05], (61, 61, 2))
    force = find_tangential_force(moved, PIXEL, MODULUS, contact=disc)
    np.testing.assert_allclose(force_of(force), 16 / 3 * SHEAR * np.array([0.1, -0.05]), rtol=0.01)
    assert not force.traction[~disc].any()


def test_a_traction_is_found_from_its_displacement_alone():
    inside, traction, moved = half_ellipsoid(1.0, 0.02)
    force = find_tangential_force(moved, PIXEL, MODULUS, contact=inside)
    np.testing.assert_allclose(force_of(force), [2 / 3 * np.pi * 0.02, 0], atol=1e-4)
    assert np.abs(force.traction[..., 0] - traction)[inside].mean() < 0.01 * 0.02
    turned = np.stack([-moved[..., 1].T, moved[..., 0].T], axis=-1)[::-1, ::-1]
    up = find_tangential_force(turned, PIXEL, MODULUS, contact=inside)
    np.testing.assert_allclose(force_of(up), force_of(force)[::-1], atol=1e-4)


def test_partial_slip_is_cattaneo_s():
    """The displacement is the sum over the pixels of the traction, by quadrature of Cerruti's solution."""
    hertz = paraboloid(3.0, 0.9, MODULUS)
    case = pushed(hertz, 0.5, MODULUS, 0.03)
    count, size = 21, 0.1
    x = size * (np.arange(count) - (count - 1) / 2)
    r = np.hypot(x, x[:, np.newaxis])
    peak = 0.5 * float(hertz.pressure(np.zeros(())))
    whole, stuck = (
        np.sqrt(np.maximum(1 - (r / radius) ** 2, 0)) * radius for radius in (0.9, case.stick_radius)
    )
    traction = peak / 0.9 * (whole - stuck)
    responses = {
        (i, j): traction_response(i * size, j * size, (size, size), MODULUS)[:, 0]
        for i in range(-count + 1, count)
        for j in range(-count + 1, count)
    }
    moved = np.array(
        [
            [
                sum(
                    traction[row, column] * responses[j - column, row - i]
                    for row in range(count)
                    for column in range(count)
                    if traction[row, column]
                )
                for j in range(count)
            ]
            for i in range(count)
        ]
    )
    force = find_tangential_force(moved, size, MODULUS, contact=r <= 1.0)
    # So coarse a grid misses 4 % of the traction itself.
    assert traction.sum() * size**2 == pytest.approx(case.force, rel=0.05)
    np.testing.assert_allclose(force_of(force), [traction.sum() * size**2, 0], atol=0.01 * case.force)


def test_the_error_of_the_force_is_true_for_windows_too():
    from scipy import ndimage

    inside, traction, moved = half_ellipsoid(1.0, 0.02, 27, 0.08)
    generator = np.random.default_rng(1)
    for window in (1, 5):
        drawn = []
        for _ in range(20):
            noise = generator.normal(0, 0.001 * window, moved.shape)
            noise = ndimage.uniform_filter(noise, (window, window, 0))
            force = find_tangential_force(
                moved + noise, 0.08, MODULUS, contact=inside, sigma=0.001, window_size=window
            )
            drawn.append(force_of(force))
        assert np.std(drawn, axis=0).mean() == pytest.approx(
            np.mean([force.force_x_sigma, force.force_y_sigma]), rel=0.25
        )
    assert np.sqrt(np.mean((force.traction[..., 0] - traction)[inside] ** 2)) < 0.15 * 0.02


def test_the_modulus_s_error_counts():
    inside, _, moved = half_ellipsoid(1.0, 0.02)
    force = find_tangential_force(moved, PIXEL, MODULUS, contact=inside, modulus_sigma=0.05 * MODULUS)
    assert force.force_x_sigma == pytest.approx(0.05 * force.force_x)


@pytest.mark.parametrize("friction", [0.3, 0.8])
def test_the_twin_s_skin_is_pushed_with_the_twin_s_force(friction):
    """Held-out loads: 3 % is required, of partial slip and of sliding."""
    path = np.stack([np.linspace(0, 0.35, 6), np.linspace(0, -0.1, 6)], axis=1)
    twin = Twin(
        object=Sphere(6.0),
        shape=(64, 64),
        pixel_size=0.09,
        movement=Horizontal(path, 0.6),
        contact="elastic",
        body=Body(modulus=0.12, friction=friction),
    )
    truth = twin.truth
    pressed = find_force(truth.height, 0.6, 0.09, 0.12)
    generator = np.random.default_rng(0)
    for number in (2, 5):
        moved = truth.displacement[number] + generator.normal(0, 5e-4, (64, 64, 2))
        force = find_tangential_force(moved, 0.09, 0.12, normal_pressure=pressed.pressure, sigma=5e-4)
        expected = truth.force[number, :2]
        assert np.hypot(*(force_of(force) - expected)) < 0.03 * np.hypot(*expected)


def test_frames_of_a_texture_give_the_force_to_three_percent():
    """From frames to newtons: the skin's displacement is found in them, in windows of 8 pixels."""
    path = np.stack([np.linspace(0, 0.3, 7), np.zeros(7)], axis=1)
    twin = Twin(
        object=Sphere(6.0),
        shape=(112, 112),
        pixel_size=0.05,
        movement=Horizontal(path, 0.7),
        contact="elastic",
        optics="cylinder",
        body=Body(modulus=0.12, friction=0.6),
        camera=Camera(noise=1.0, seed=1),
        texture=SheetTexture(size=0.2),
    )
    frames = np.empty(twin.shape, twin.dtype)
    twin.read(frames)
    moved = find_displacement(frames[0], frames, 0.05, window_size=8, window_step=2)
    pressed = find_force(twin.truth.height, 0.7, 0.05, 0.12)
    for number in (3, 6):
        force = find_tangential_force(
            moved.displacement[number],
            0.05,
            0.12,
            contact=pressed.contact,
            sigma=moved.displacement_sigma[number],
            window_size=8,
        )
        expected = twin.truth.force[number, :2]
        assert np.hypot(*(force_of(force) - expected)) < 0.03 * np.hypot(*expected)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"displacement": np.zeros((9, 9))}, "one map"),
        ({"modulus": None}, "modulus is missing"),
        ({"displacement": {"height": np.zeros((9, 9))}}, "displacement has no map of that name"),
        ({"contact": None}, "give contact, or normal_pressure"),
        ({"contact": np.zeros((9, 9))}, "nothing touches"),
        ({"contact": np.ones((9, 8))}, "contact has shape"),
        ({"sigma": np.ones(4)}, "sigma has shape"),
        ({"sigma": np.nan}, "nowhere known"),
        ({"sigma": -1.0}, "below 0"),
        ({"window_size": 0}, "window_size 0"),
        ({"modulus": -1.0}, "modulus of -1 MPa"),
        ({"displacement": np.full((9, 9, 2), np.nan)}, "0% of the contact has a displacement"),
    ],
)
def test_impossible_input_is_one_line(changes, message):
    options = {"displacement": np.zeros((9, 9, 2)), "modulus": 0.1, "contact": np.ones((9, 9))}
    with pytest.raises(io.InputError, match=message):
        find_tangential_force(pixel_size=0.1, **options | changes)


def test_a_few_gaps_are_bridged():
    inside, _, moved = half_ellipsoid(1.0, 0.02)
    moved[28:31, 28:31] = np.nan
    force = find_tangential_force(moved, PIXEL, MODULUS, contact=inside)
    assert force.force_x == pytest.approx(2 / 3 * np.pi * 0.02, rel=0.01)


def test_displacements_of_a_result_bring_their_errors_contact_and_pixels():
    inside, _, moved = half_ellipsoid(1.0, 0.02)
    x, y = (np.ravel(axis) for axis in places())
    sigma = np.full(moved.shape, 5e-4)
    expected = find_tangential_force(moved, PIXEL, MODULUS, contact=inside, sigma=sigma)
    result = io.Result(displacement=moved, displacement_sigma=sigma[..., 0], pressure=1.0 * inside, x=x, y=y)
    several = result.assign(displacement=np.stack([0 * moved, moved]))
    for maps in (result, several, result.to_xarray(), dict(result) | {"x": x, "y": y}):
        force = find_tangential_force(maps, modulus=MODULUS)
        np.testing.assert_allclose(force_of(force), force_of(expected), rtol=1e-9)
        assert force.force_x_sigma == pytest.approx(expected.force_x_sigma)
        np.testing.assert_allclose(force.traction, expected.traction, atol=1e-9)
