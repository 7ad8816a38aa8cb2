"""Stick and slip, compared with closed forms for balls and discs, and with the law of friction."""

from __future__ import annotations

import contact_theory
import numpy as np
import pytest
from numpy.typing import NDArray

from mirrorskin.twin import friction
from mirrorskin.twin.elastic import HalfSpace
from mirrorskin.twin.friction import Friction

Map = NDArray[np.float64]

MODULUS, MU = 0.7, 0.6
SIDE, PIXEL, RADIUS = 125, 0.03, 1.8
HERTZ = contact_theory.paraboloid(4.0, RADIUS, MODULUS)

row, column = np.indices((SIDE, SIDE), dtype=float)
X, Y = (column - (SIDE - 1) / 2) * PIXEL, ((SIDE - 1) / 2 - row) * PIXEL
R = np.hypot(X, Y)
SPACE = HalfSpace((SIDE, SIDE), (PIXEL, PIXEL), MODULUS)
BALL = HERTZ.pressure(np.minimum(R, RADIUS))
FAR = contact_theory.sliding_distance(HERTZ, MU, MODULUS)


def push(x: float, y: float = 0.0, shape: tuple[int, int] = (SIDE, SIDE)) -> Map:
    return np.stack([np.full(shape, x), np.full(shape, y)])


def twist(angle: float) -> Map:
    return angle * np.stack([-Y, X])


def force(contact: Friction) -> Map:
    total: Map = contact.traction.sum(axis=(1, 2)) * PIXEL**2
    return total


def torque(contact: Friction) -> float:
    return float(np.sum(X * contact.traction[1] - Y * contact.traction[0])) * PIXEL**2


def stick_radius(slips: NDArray[np.bool_], pressure: Map) -> float:
    return float(np.sqrt(np.sum((pressure > 0) & ~slips) / np.pi)) * PIXEL


@pytest.mark.parametrize("pixel_size", [(0.1, 0.1), (0.05, 0.2)])
def test_tractions_shift_the_surface_by_cerrutis_solution(pixel_size: tuple[float, float]) -> None:
    rows, columns = 4, 5
    half_space = HalfSpace((rows, columns), pixel_size, MODULUS)
    for loaded in [(0, 0), (2, 3)]:
        for axis in (0, 1):
            traction = np.zeros((2, rows, columns))
            traction[(axis, *loaded)] = 1.0
            shift = half_space.tangential(traction)
            for target in np.ndindex(rows, columns):
                x, y = (target[1] - loaded[1]) * pixel_size[0], (loaded[0] - target[0]) * pixel_size[1]
                expected = contact_theory.traction_response(x, y, pixel_size, MODULUS)[:, axis]
                np.testing.assert_allclose(shift[:, *target], expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("fraction", [0.2, 0.5, 0.8])
def test_a_pushed_ball_sticks_in_the_disc_of_cattaneo_and_mindlin(fraction: float) -> None:
    theory = contact_theory.pushed(HERTZ, MU, MODULUS, fraction * FAR)
    contact = Friction(SPACE, BALL, MU)
    contact.move(push(fraction * FAR / 2))
    slips = contact.move(push(fraction * FAR))
    assert force(contact)[0] == pytest.approx(theory.force, rel=0.01)
    assert force(contact)[1] == pytest.approx(0, abs=1e-3 * theory.force)
    assert stick_radius(slips, BALL) == pytest.approx(theory.stick_radius, rel=0.01)
    # One disc with some pixels off on its edge: the inside sticks, the outside slips.
    assert not slips[0.97 * theory.stick_radius > R].any()
    assert slips[(1.03 * theory.stick_radius < R) & (R < RADIUS)].all()


def test_a_ball_pushed_far_enough_slides() -> None:
    contact = Friction(SPACE, BALL, MU)
    slips = contact.move(push(0.0, -1.2 * FAR))
    np.testing.assert_array_equal(slips, BALL > 0)
    assert force(contact)[1] == pytest.approx(-MU * HERTZ.force, rel=0.005)
    slips = contact.move(push(50.0, -1.2 * FAR))
    np.testing.assert_array_equal(slips, BALL > 0)
    np.testing.assert_allclose(contact.traction[0], MU * BALL, rtol=0, atol=1e-3 * MU * BALL.max())


def test_a_ball_pushed_back_goes_through_mindlins_loop() -> None:
    # By Masing's rule the way back is the way there, doubled: Johnson (1985), section 7.4.
    target = 0.6 * FAR
    contact = Friction(SPACE, BALL, MU)
    contact.move(push(target))
    limit = contact_theory.pushed(HERTZ, MU, MODULUS, target).force
    for back in (0.2, 0.6, 1.0):
        slips = contact.move(push(target - back * FAR))
        half = contact_theory.pushed(HERTZ, MU, MODULUS, back * FAR / 2)
        assert force(contact)[0] == pytest.approx(limit - 2 * half.force, abs=0.01 * limit)
        assert stick_radius(slips, BALL) == pytest.approx(half.stick_radius, rel=0.01)


@pytest.mark.parametrize("fraction", [0.9, 0.6, 0.3])
def test_a_twisted_ball_sticks_in_the_disc_of_lubkin(fraction: float) -> None:
    theory = contact_theory.twisted(HERTZ, MU, MODULUS, fraction * RADIUS)
    contact = Friction(SPACE, BALL, MU)
    contact.move(twist(theory.angle / 2))
    slips = contact.move(twist(theory.angle))
    assert torque(contact) == pytest.approx(theory.torque, rel=0.005)
    assert stick_radius(slips, BALL) == pytest.approx(fraction * RADIUS, abs=0.01 * RADIUS)
    np.testing.assert_allclose(force(contact), 0, atol=1e-4 * HERTZ.force)


@pytest.fixture
def glued() -> tuple[Friction, float]:
    disc = np.where(R < RADIUS, 1.0, 0.0)
    return Friction(SPACE, disc, 1e6), float(np.sqrt(disc.sum() / np.pi)) * PIXEL


def test_a_glued_disc_has_the_stiffness_of_reissner_and_sagoci(glued: tuple[Friction, float]) -> None:
    contact, radius = glued
    slips = contact.move(twist(-0.1))
    assert not slips.any()
    assert torque(contact) == pytest.approx(contact_theory.disc_torque(radius, MODULUS, -0.1), rel=0.01)


def test_each_pixel_obeys_coulomb() -> None:
    shape = (40, 53)
    half_space = HalfSpace(shape, (0.05, 0.08), MODULUS)
    pressure = np.maximum(np.random.default_rng(1).normal(0.1, 0.2, shape), 0.0)
    contact = Friction(half_space, pressure, MU)
    y, x = np.indices(shape, dtype=float)
    here = np.zeros((2, *shape))
    shares = []
    for target in (push(0.02, shape=shape), push(0.05, 0.03, shape=shape), 0.002 * np.stack([y - 20, x - 9])):
        before = contact.traction.copy()
        slips = contact.move(target)
        step = target - here
        slip = step - half_space.tangential(contact.traction - before)
        close = 2 * friction.TOLERANCE * float(np.hypot(*step)[pressure > 0].max())
        size = np.hypot(*contact.traction)
        assert (size <= MU * pressure * (1 + 1e-12)).all()
        assert not slips[pressure == 0].any()
        assert np.hypot(*slip)[(pressure > 0) & ~slips].max() <= close
        np.testing.assert_allclose(size[slips], MU * pressure[slips], rtol=1e-6)
        along = np.sum(slip * contact.traction, axis=0) / np.where(size > 0, size, 1.0)
        assert (along[slips] > 0).all()
        assert np.abs(np.hypot(*slip) - along)[slips].max() <= close
        shares.append(slips.sum() / (pressure > 0).sum())
        here = target
    assert all(0.02 < fraction < 0.98 for fraction in shares)


def test_a_body_that_stands_still_does_not_slip() -> None:
    contact = Friction(SPACE, BALL, MU)
    assert not contact.move(push(0.0)).any()
    contact.move(push(0.1))
    held = contact.traction.copy()
    assert not contact.move(push(0.1)).any()
    np.testing.assert_array_equal(contact.traction, held)


def test_a_step_that_does_not_settle_reports_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(friction, "ITERATIONS", 2)
    with pytest.raises(RuntimeError, match="did not converge in 2 iterations"):
        Friction(SPACE, BALL, MU).move(push(0.5 * FAR))


LESS = contact_theory.paraboloid(4.0, 1.5, MODULUS)
SMALLER = LESS.pressure(np.minimum(R, 1.5))
LARGER = contact_theory.paraboloid(4.0, 1.85, MODULUS).pressure(np.minimum(R, 1.85))


def test_an_object_that_is_pressed_more_holds_its_traction_and_slips_nowhere() -> None:
    contact = Friction(SPACE, BALL, MU)
    contact.move(push(0.5 * FAR))
    held, slid = force(contact), contact.slid.copy()
    contact.press(LARGER)
    np.testing.assert_allclose(force(contact), held, rtol=1e-6)
    np.testing.assert_allclose(contact.slid, slid, atol=1e-3 * FAR)


def test_an_object_that_is_pressed_less_slips_where_its_traction_exceeds_the_limit() -> None:
    contact = Friction(SPACE, BALL, MU)
    contact.move(push(0.5 * FAR))
    contact.press(SMALLER)
    traction = np.hypot(*contact.traction)
    assert np.all(traction <= MU * SMALLER * (1 + 1e-9))
    assert traction[R > 1.2].sum() == pytest.approx((MU * SMALLER)[R > 1.2].sum(), rel=1e-3)
    assert np.hypot(*contact.slid)[SIDE // 2, SIDE // 2] < 1e-3 * FAR


def test_an_object_that_is_pressed_less_slides_under_the_friction_of_that_press() -> None:
    contact = Friction(SPACE, BALL, MU)
    contact.move(push(0.5 * FAR))
    contact.press(SMALLER)
    contact.move(push(3 * FAR))
    assert force(contact)[0] == pytest.approx(MU * SMALLER.sum() * PIXEL**2, rel=1e-3)
    middle = contact.slid[:, SIDE // 2, SIDE // 2]
    far = contact_theory.sliding_distance(LESS, MU, MODULUS)
    np.testing.assert_allclose(middle, [3 * FAR - far, 0], atol=2e-3 * FAR)


def test_an_object_that_is_lifted_and_pressed_again_holds_no_traction() -> None:
    contact = Friction(SPACE, BALL, MU)
    contact.move(push(0.5 * FAR))
    contact.press(0 * BALL)
    contact.press(BALL)
    assert not contact.traction.any()
    assert not contact.slid.any()
    contact.move(push(FAR))  # by half of it since the contact
    theory = contact_theory.pushed(HERTZ, MU, MODULUS, 0.5 * FAR)
    assert force(contact)[0] == pytest.approx(theory.force, rel=0.01)


def test_small_steps_after_a_large_one_converge() -> None:
    contact = Friction(SPACE, BALL, MU)
    contact.move(push(0.5 * FAR))
    for step in (1e-3, 1e-4, 1e-5):
        contact.move(push((0.5 + step) * FAR))
    theory = contact_theory.pushed(HERTZ, MU, MODULUS, (0.5 + 1e-5) * FAR)
    assert force(contact)[0] == pytest.approx(theory.force, rel=0.01)
