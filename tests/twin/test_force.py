"""The twin's force of each frame, compared with closed forms for balls."""

from __future__ import annotations

import contact_theory
import numpy as np
import pytest

from mirrorskin.io.base.types import Floats
from mirrorskin.twin import Axial, Body, Camera, Horizontal, Sphere, Twin, Twist, Vertical
from mirrorskin.twin.movement import Movement

MODULUS, MU, PIXEL = 0.35, 0.6, 0.05
PRESSED = [contact_theory.sphere(10.0, radius, MODULUS) for radius in (0.5, 1.0, 1.5)]
DEEP = PRESSED[-1]
FAR = contact_theory.sliding_distance(DEEP, MU, MODULUS)


def force(movement: Movement, **changes: object) -> Floats:
    twin = Twin(
        object=Sphere(20.0),
        shape=(66, 66),
        pixel_size=PIXEL,
        movement=movement,
        body=Body(modulus=MODULUS, friction=MU, sheet=0.0),
        camera=Camera(**changes),  # type: ignore[arg-type]
        contact="elastic",
    )
    actual = twin.truth.force
    assert actual is not None
    return actual


@pytest.mark.parametrize("exposure", [0.0, 0.02])
def test_a_press_has_the_force_of_hertz_at_the_middle_of_each_exposure(exposure: float) -> None:
    actual = force(Vertical([theory.depth for theory in PRESSED]), exposure=exposure)
    assert actual.shape == (3, 3)
    assert not actual[:, :2].any()
    np.testing.assert_allclose(actual[:, 2], [theory.force for theory in PRESSED], rtol=0.01)


def test_a_push_has_the_force_of_cattaneo_and_mindlin_against_the_movement() -> None:
    shares, along = np.array([0.0, 0.2, 0.5, 0.8, 1.3]), np.array([0.6, -0.8])
    actual = force(Horizontal(FAR * np.outer(shares, along), DEEP.depth))
    theory = [contact_theory.pushed(DEEP, MU, MODULUS, fraction * FAR).force for fraction in shares]
    np.testing.assert_allclose(actual[:, :2], -np.outer(theory, along), atol=0.01 * MU * DEEP.force)
    np.testing.assert_allclose(actual[:, 2], DEEP.force, rtol=0.01)


def test_a_twist_and_a_turn_of_the_axis_have_no_force_along_the_sheet() -> None:
    about_the_ball_s_centre = (0.0, 0.0, DEEP.depth - 10.0)
    for movement in (
        Twist([0.0, 0.2], DEEP.depth),
        Axial([0.0, 2], 0.04, DEEP.depth, about_the_ball_s_centre),
    ):
        actual = force(movement)
        np.testing.assert_allclose(actual[:, :2], 0, atol=1e-3 * DEEP.force)
        np.testing.assert_allclose(actual[:, 2], DEEP.force, rtol=0.01)
