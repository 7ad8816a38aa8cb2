"""The skin's history, compared with theory: sticking, slipping and displacement."""

from __future__ import annotations

import functools

import contact_theory
import numpy as np
import pytest
from numpy.typing import NDArray

from mirrorskin.hw.base.stage import Position
from mirrorskin.io import InputError
from mirrorskin.io.base.types import Floats
from mirrorskin.kernels.device import open_device
from mirrorskin.twin import Body, Horizontal, SheetTexture, Sphere, Twin, Twist, Vertical
from mirrorskin.twin.emulator.camera import pose_at
from mirrorskin.twin.movement import pose_at_press
from mirrorskin.twin.skin import Elastic
from mirrorskin.twin.slip import SkinHistory
from mirrorskin.twin.view import View

BALL, SIDE, FRAMES = Sphere(20.0), 91, 13
SHARES = np.linspace(0, 0.9, FRAMES)
ALONG = np.array([0.6, -0.8])


def history(movement: Horizontal | Twist, friction: float, pixel: float, side: int = SIDE) -> SkinHistory:
    body = Body(friction=friction, sheet=0.0)
    view = View((side, side), (pixel, pixel), body)
    skin = Elastic(BALL, [pose_at_press(movement.deepest)], view, body)
    return SkinHistory(skin, movement, friction, open_device())


def displacement(actual: SkinHistory, frame: int) -> NDArray[np.float32]:
    """Return that of a frame, (2, H, W)."""
    return np.moveaxis(actual.displacements()[frame], -1, 0)


class Pushed:
    """A ball that is pushed to 0.9 of full sliding."""

    def __init__(self, friction: float, radius: float) -> None:
        self.friction, self.radius, self.pixel = friction, radius, 2.2 * radius / SIDE
        self.press = contact_theory.sphere(10.0, radius, 1.0)
        self.far = contact_theory.sliding_distance(self.press, friction, 1.0)
        self.movement = Horizontal(self.far * np.outer(SHARES, ALONG), self.press.depth)
        self.found = history(self.movement, friction, self.pixel)
        x = (np.arange(SIDE) - (SIDE - 1) / 2) * self.pixel
        self.r = np.hypot(x, x[:, np.newaxis])

    def stick_radius(self, frame: int) -> float:
        """Return the radius by the force along the sheet: Cattaneo and Mindlin."""
        fraction = np.hypot(*self.found.force[frame]) / (self.friction * self.press.force)
        return float(self.radius * np.cbrt(1 - fraction))


pushed = functools.cache(Pushed)
CASES = pytest.mark.parametrize(
    ("friction", "radius"), [(mu, a) for mu in (0.2, 0.5, 0.9) for a in (0.8, 1.2, 1.6)]
)


@CASES
def test_a_pushed_ball_sticks_within_the_radius_of_cattaneo_and_mindlin(
    friction: float, radius: float
) -> None:
    case = pushed(friction, radius)
    for frame in range(1, FRAMES):
        stuck = (case.r < radius) & ~(case.found.slip_onset <= case.found.travel[frame])
        actual = np.sqrt(stuck.sum() / np.pi) * case.pixel
        assert actual == pytest.approx(case.stick_radius(frame), rel=0.02)


@CASES
def test_what_has_slipped_is_known_but_for_a_pixel_at_the_border(friction: float, radius: float) -> None:
    case = pushed(friction, radius)
    for frame in range(1, FRAMES):
        border = case.stick_radius(frame)
        clear = (np.abs(case.r - border) > case.pixel) & (case.r < radius - case.pixel)
        actual = (case.found.slip_onset <= case.found.travel[frame])[clear]
        expected = (case.r > border)[clear]
        both = (actual & expected).sum()
        assert both >= 0.98 * actual.sum()
        assert both >= 0.98 * expected.sum()


@CASES
def test_a_point_breaks_loose_when_the_border_comes_by(friction: float, radius: float) -> None:
    case = pushed(friction, radius)
    expected = case.far * (1 - (case.r / radius) ** 2)
    inside = (case.r < radius - 1.5 * case.pixel) & (expected < 0.95 * case.far * SHARES[-1])
    late = (case.found.slip_onset - expected)[inside] / (case.far * SHARES[1])
    assert np.abs(late).max() < 0.25
    assert np.sqrt(np.mean(late**2)) < 0.1
    assert np.isnan(case.found.slip_onset[case.r > radius + 1.5 * case.pixel]).all()


def test_few_frames_give_the_onsets_of_many() -> None:
    many = pushed(0.5, 1.2)
    few = history(Horizontal(many.movement.path[[0, -1]], many.press.depth), 0.5, many.pixel)
    late = (few.slip_onset - many.found.slip_onset) / (many.far * SHARES[1])
    assert np.nanmax(np.abs(late[many.r < 1.1])) < 0.25
    np.testing.assert_allclose(few.force[-1], many.found.force[-1], rtol=2e-3)


def test_a_twisted_ball_sticks_within_the_radius_of_lubkin() -> None:
    radius, friction, pixel = 1.2, 0.5, 2.6 / SIDE
    press = contact_theory.sphere(10.0, radius, 1.0)
    inner = np.array([0.95, 0.8, 0.6, 0.4]) * radius
    angles = [contact_theory.twisted(press, friction, 1.0, rest).angle for rest in inner]
    actual = history(Twist(-np.array(angles), press.depth), friction, pixel)
    np.testing.assert_allclose(actual.travel, angles)
    pressed = np.hypot(*actual._skin.places) < radius
    for angle, rest in zip(angles, inner, strict=True):
        stuck = (pressed & ~(actual.slip_onset <= angle)).sum()
        assert np.sqrt(stuck / np.pi) * pixel == pytest.approx(rest, rel=0.02)


def test_stuck_skin_goes_with_the_object_and_far_skin_stays() -> None:
    case = pushed(0.5, 1.2)
    last = FRAMES - 1
    moved = displacement(case.found, last)
    stuck = case.r < 0.95 * case.stick_radius(last)
    object_s = -case.movement.path[last][:, np.newaxis]
    np.testing.assert_allclose(moved[:, stuck] - object_s, 0, atol=2e-3 * case.far)
    lag = np.sum((moved - object_s[:, np.newaxis]) * ALONG[:, np.newaxis, np.newaxis], axis=0)
    assert lag[case.r > 1.1].min() > 0.02 * case.far  # what slips stays behind

    twisted = history(Twist([0.0, 0.6], 0.05), 1e3, 0.05)
    x, y = twisted._skin.places
    near = np.hypot(x, y) < 0.55  # of a contact of 0.7 mm
    turned = (x + 1j * y) * np.exp(-0.6j)
    actual = displacement(twisted, 1)
    np.testing.assert_allclose((x + actual[0] - turned.real)[near], 0, atol=2e-3)
    np.testing.assert_allclose((y + actual[1] - turned.imag)[near], 0, atol=2e-3)
    assert np.abs(actual[:, 0, 0]).max() < 0.02


def test_a_sliding_ball_drags_the_skin_by_johnsons_theory() -> None:
    radius, friction, shear = 0.8, 0.5, 1 / 3
    press = contact_theory.paraboloid(10.0, radius, 1.0)
    distance = 1.5 * contact_theory.sliding_distance(press, friction, 1.0)
    actual = history(
        Horizontal([[0.0, 0.0], [distance / 2, 0.0], [distance, 0.0]], press.depth), friction, 0.03
    )
    x, y = actual._skin.places
    object_s = np.stack([x - distance, y])  # where the object's points of the press have gone
    dragged = object_s - actual.drag(2).material(object_s)
    limit = friction * float(press.pressure(np.zeros(())))
    # Eq. 3.91 at Poisson ratio 0.5; the object goes to the left, and so does the skin.
    scale, inside = np.pi * limit / (32 * shear * radius), np.hypot(x, y) < 0.9 * radius
    along, across = -scale * (6 * radius**2 - 2.5 * x**2 - 3.5 * y**2), -scale * x * y
    np.testing.assert_allclose(dragged[0][inside], along[inside], rtol=0.02)
    np.testing.assert_allclose(dragged[1][inside], across[inside], atol=0.02 * np.abs(along).max())


def test_displacement_and_material_are_each_other_s_inverse() -> None:
    case = pushed(0.9, 1.6)
    target = case.found._skin.places + displacement(case.found, 7)
    np.testing.assert_allclose(
        case.found.drag(7).material(target), case.found._skin.places, atol=1e-4 * case.pixel
    )


def test_a_long_slide_drags_the_skin_along_beneath_the_object_alone() -> None:
    # The object goes 3 mm to the left over a field of 6 mm: the dragged skin goes with it and springs back.
    far, press = 3.0, 0.1
    path = np.stack([np.linspace(0, far, 7), np.zeros(7)], axis=1)
    actual = history(Horizontal(path, press), 0.3, 0.1, side=61)
    half, last = displacement(actual, 3), displacement(actual, 6)
    assert np.isfinite(last).all()
    assert np.unravel_index(half[0].argmin(), (61, 61)) == pytest.approx((30, 15), abs=2)
    assert np.unravel_index(last[0].argmin(), (61, 61)) == pytest.approx((30, 1), abs=2)
    assert abs(last[0, 30, 30]) < 0.5 * abs(last[0, 30, 1])


def test_between_frames_the_skin_is_between() -> None:
    case = pushed(0.5, 1.2)
    points: Floats = case.found._skin.places
    before, middle, after = (case.found.drag(frame).material(points) for frame in (5, 5.5, 6))
    np.testing.assert_allclose(middle, (before + after) / 2, atol=0.02 * case.far * SHARES[1])


def test_a_body_that_does_not_press_moves_no_skin() -> None:
    free = history(Horizontal([[0.0, 0.0], [0.5, 0.0]], -0.1), 0.5, 0.1)
    assert not free.force.any()
    assert np.isnan(free.slip_onset).all()
    np.testing.assert_allclose(displacement(free, 1), 0, atol=1e-12)


def test_too_long_a_displacement_is_refused() -> None:
    with pytest.raises(InputError, match=r"a displacement of 50 mm .* points, .*: use larger pixels"):
        history(Horizontal([[0.0, 0.0], [50.0, 0.0]], 0.1), 0.5, 0.005)


def test_a_body_that_is_lifted_while_it_slides_is_dragged_by_the_friction_of_its_press() -> None:
    friction = 0.3
    twin = Twin(
        object=Sphere(10.0),
        shape=(32, 32),
        pixel_size=0.12,
        movement=Vertical([0.5]),
        contact="elastic",
        body=Body(friction=friction),
        texture=SheetTexture("flakes", size=0.5, contrast=0.5),
    )
    out = np.empty(twin.shape[1:], twin.dtype)
    for x, travel in ((0.0, 0.5), (0.4, 0.5), (0.45, 0.3), (0.5, 0.3)):
        twin.look(lambda late, x=x, travel=travel: pose_at(Position(travel, x=x)), 0, out)
    lifted = Twin(
        object=Sphere(10.0), shape=(32, 32), pixel_size=0.12, movement=Vertical([0.3]), contact="elastic"
    )
    assert np.hypot(*twin.grip.force) == pytest.approx(friction * lifted.sheet(0).force, rel=0.01)
    assert twin.grip.slid[0] < -0.2
    twin.look(lambda late: pose_at(Position(-0.1, x=0.5)), 0, out)
    assert not np.any(twin.grip.force)
