"""The light of each frame: what is computed, when, and that it is the same for any order of requests."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from numpy.typing import NDArray

from mirrorskin.twin import Axial, Body, Horizontal, Sphere, Twist, Vertical
from mirrorskin.twin.movement import Movement, Pose, pose_at_press
from mirrorskin.twin.optics import Ideal
from mirrorskin.twin.pattern import Uniform
from mirrorskin.twin.scene import Imprint, Optics, Scene, Skin, Witness
from mirrorskin.twin.skin import Conform, Sheet
from mirrorskin.twin.view import View

Map = NDArray[np.float64]

SHAPE, PIXEL = (41, 52), 0.2
PLENTY = 10**9
VIEW = View(SHAPE, (PIXEL, PIXEL), Body())
BALL = Sphere()

TENTHS = 2 * np.pi * np.arange(30) / 10  # three turns by tenths, which binary numbers only come close to
MOVEMENTS: dict[str, Movement] = {
    "vertical": Vertical([0.1, 0.5, 1.1, 1.1, 0.6, 0.2]),
    "axial": Axial(TENTHS, 0.1, 1.0, (0.0, 0.0, 4.0)),
    "horizontal": Horizontal([[0.0, 0.0], [0.3, -0.2], [0.9, 0.1], [0.9, 0.1], [0.2, 1.0]], 1.0),
    "twist": Twist([0.0, 0.1, 0.3, 0.1, -0.4], 1.0),
}


class Recall:
    """A contact and optics of its own kind: light tells the pose."""

    def __init__(self) -> None:
        self.poses: list[Pose] = []
        self.lit = 0

    def drape(self, pose: Pose) -> Sheet:
        self.poses.append(pose)
        return Sheet(np.full(SHAPE, tell(pose)), np.zeros(SHAPE), np.zeros(SHAPE), np.ones(SHAPE, bool))

    def light(self, sheet: Sheet) -> NDArray[np.float32]:
        self.lit += 1
        return sheet.height.astype(np.float32)


def tell(pose: Pose) -> float:
    """Make one number of a pose that no other has."""
    weights = np.linspace(0.3, 1.1, 9).reshape(3, 3)
    return float(np.sum(pose.rotation * weights) + pose.shift @ [0.7, 0.4, 0.9])


class Film:
    """The scene of a movement, and what touches in all of its poses."""

    def __init__(
        self,
        skin: Skin,
        optics: Optics,
        movement: Movement,
        fraction: float = 0.0,
        kept: int = PLENTY,
        imprint: Imprint | None = None,
    ) -> None:
        self.movement, self.witness = movement, Witness(skin, SHAPE)
        self.scene = Scene(self.witness, optics, fraction, kept, imprint)

    def light(self, frame: int) -> NDArray[np.float32]:
        return self.scene.light(partial(self.movement.pose_at, frame), frame)

    def touched_throughout(self) -> NDArray[np.bool_]:
        for frame in range(len(self.movement.path)):
            for late in self.scene.moments:
                self.witness.force(self.movement.pose_at(frame, late))
        return self.witness.touched


def recalling(movement: Movement, fraction: float = 0.0, kept: int = PLENTY) -> tuple[Film, Recall]:
    contact = Recall()
    return Film(contact, contact, movement, fraction, kept), contact


def real(movement: Movement, fraction: float = 0.0, kept: int = PLENTY) -> Film:
    return Film(Conform(BALL, VIEW), Ideal(Body(), Uniform()), movement, fraction, kept)


def all_light(film: Film) -> NDArray[np.float32]:
    return np.array([film.light(frame).copy() for frame in range(len(film.movement.path))])


def turns(count: int, per_turn: int, start: float = 0.0) -> Axial:
    return Axial(start + 2 * np.pi * np.arange(count * per_turn) / per_turn, 0.1, 1.0)


@pytest.mark.parametrize(("per_turn", "fraction"), [(3, 0.6), (10, 0.0), (36, 0.6)])
def test_places_of_a_rotation_are_worked_out_once_in_the_order_of_their_first_time(
    per_turn: int, fraction: float
) -> None:
    movement = turns(3, per_turn, start=0.4)
    film, contact = recalling(movement, fraction)
    light = all_light(film)
    blur = 1 if fraction == 0 else 5
    # The first frame's exposure begins before any place of the path.
    offsets = 2 * np.pi / per_turn * fraction * (np.arange(blur) - (blur - 1) / 2) / blur
    expected = [movement.pose(np.asarray(p + o)) for p in movement.path[:per_turn] for o in offsets]
    assert len(contact.poses) == contact.lit == len(expected)
    for pose_of_light, pose in zip(contact.poses, expected, strict=True):
        np.testing.assert_allclose(pose_of_light.rotation, pose.rotation, atol=1e-11)
    np.testing.assert_array_equal(light[:per_turn], light[per_turn : 2 * per_turn])
    np.testing.assert_array_equal(light[:per_turn], light[2 * per_turn :])
    assert len({float(frame[0, 0]) for frame in light}) == per_turn


@pytest.mark.parametrize(("kept", "count"), [(10, 10), (9, 30)])
def test_light_is_kept_as_long_as_there_is_room(kept: int, count: int) -> None:
    film, contact = recalling(MOVEMENTS["axial"], kept=kept)
    all_light(film)
    assert len(contact.poses) == count
    all_light(film)
    assert len(contact.poses) == (count if count == 10 else 2 * count)


@pytest.mark.parametrize(
    ("name", "fraction", "kept"),
    [("vertical", 0.0, 0), ("axial", 0.7, PLENTY), ("axial", 0.0, 0), ("horizontal", 0.7, PLENTY)],
)
def test_light_is_the_same_whatever_else_was_asked(name: str, fraction: float, kept: int) -> None:
    movement = MOVEMENTS[name]
    whole = all_light(recalling(movement, fraction, kept)[0])
    film, _ = recalling(movement, fraction, kept)
    np.testing.assert_array_equal(all_light(film), whole)
    for frame in range(3):
        film.light(frame)
    np.testing.assert_array_equal(all_light(film), whole)
    film, _ = recalling(movement, fraction, kept)
    for frame in reversed(range(len(whole))):
        np.testing.assert_array_equal(film.light(frame), whole[frame])
    film, _ = recalling(movement, fraction, kept)
    for frame in range(len(whole)):  # contact is asked for when some frames have been seen
        if frame == 2:
            film.touched_throughout()
        np.testing.assert_array_equal(film.light(frame), whole[frame])


@pytest.mark.parametrize("kept", [0, PLENTY])
def test_contact_is_asked_of_the_places_not_yet_seen_and_without_light(kept: int) -> None:
    movement = MOVEMENTS["axial"]
    film, contact = recalling(movement, kept=kept)
    for frame in (0, 3, 13):  # the third is the second, a turn later
        film.light(frame)
    lit = contact.lit
    film.touched_throughout()
    film.touched_throughout()
    assert contact.lit == lit
    assert len({tell(pose) for pose in contact.poses}) == 10
    assert len(contact.poses) - lit == 8


@pytest.mark.parametrize(
    ("name", "fraction", "kept"), [("axial", 1.0, 0), ("axial", 0.0, PLENTY), ("horizontal", 1.0, PLENTY)]
)
def test_what_lasts_is_the_contact_in_every_pose(name: str, fraction: float, kept: int) -> None:
    movement = MOVEMENTS[name]
    if name == "axial":
        movement = Axial([0.0, 0.7, 1.9], 0.2, 1.0, (0.0, 0.0, 4.0))
    film = real(movement, fraction, kept)
    contact = Conform(BALL, VIEW)
    expected = np.ones(SHAPE, bool)
    for place in exposed(movement, fraction, 5) if fraction else movement.path:
        expected &= contact.drape(movement.pose(place)).contact
    np.testing.assert_array_equal(film.touched_throughout(), expected)
    film.light(0)
    np.testing.assert_array_equal(film.touched_throughout(), expected)
    always = contact.drape(movement.pose(movement.path[0])).contact
    assert 50 < expected.sum() < always.sum()


def exposed(movement: Movement, fraction: float, count: int) -> Map:
    """Return evenly spread places of all exposures, frame by frame: piece by piece at constant velocity."""
    path = movement.path
    number = np.arange(len(path), dtype=float)
    moments = number[:, np.newaxis] + fraction * ((np.arange(count) + 0.5) / count - 0.5)
    longer = np.concatenate([[2 * path[0] - path[1]], path, [2 * path[-1] - path[-2]]])
    expected = np.concatenate([[-1.0], number, [number[-1] + 1]])
    columns = [np.interp(moments.ravel(), expected, column) for column in longer.reshape(len(expected), -1).T]
    places: Map = np.stack(columns, axis=-1).reshape(-1, *path.shape[1:])
    return places


@pytest.mark.parametrize("name", ["axial", "horizontal", "twist"])
def test_an_exposure_is_the_mean_over_the_poses_that_the_body_passes(name: str) -> None:
    movement, fraction = MOVEMENTS[name], 0.8
    if name == "axial":  # slow to work out
        movement = Axial([0.0, 0.7, 1.9], 0.1, 1.0, (0.0, 0.0, 4.0))
    contact, optics = Conform(BALL, VIEW), Ideal(Body(), Uniform())

    def mean(count: int) -> NDArray[np.float32]:
        light = [
            optics.light(contact.drape(movement.pose(place))) for place in exposed(movement, fraction, count)
        ]
        return np.mean(np.reshape(light, (-1, count, *SHAPE)), axis=1, dtype=np.float64)

    actual = all_light(real(movement, fraction))
    assert actual.dtype == np.float32
    np.testing.assert_allclose(actual, mean(5), atol=1e-6)
    np.testing.assert_allclose(actual.mean(axis=(1, 2)), mean(25).mean(axis=(1, 2)), rtol=0.01)
    if name != "twist":  # a ball does not show that it is turned
        still = all_light(real(movement))
        assert np.abs(actual - still).max() > 0.1


# A press, seen from straight above, is worked out at once.

HEIGHT = np.random.default_rng(8).uniform(-2.2, 0.0, SHAPE)
HEIGHT[:3] = np.nan
BEFORE, AFTER = (
    np.random.default_rng(seed).uniform(low, high, SHAPE).astype(np.float32)
    for seed, low, high in ((1, 0, 0.3), (2, 0.5, 1.0))
)
STROKES: dict[str, list[float]] = {
    "down and up": [0.2, 0.9, 1.4, 2.0, 1.1, 0.3],
    "down, hovering, up": [0.2, 1.4, 1.4, 1.4, 0.3],
    "two": [0.5, 1.5],
    "still": [1.0, 1.0],
    "one": [1.2],
}


def press(movement: Movement, fraction: float, imprint: Imprint) -> Film:
    contact = Recall()
    return Film(contact, contact, movement, fraction, imprint=imprint)


@pytest.mark.parametrize(
    ("stroke", "fraction"),
    [("down and up", 0.3), ("down, hovering, up", 1.0), ("two", 0.3), ("still", 1.0), ("one", 0.3)],
)
def test_an_exposed_press_is_the_mean_over_a_fine_grid_of_times(stroke: str, fraction: float) -> None:
    travel = STROKES[stroke]
    moments = 4000
    if len(travel) > 1:
        passed = exposed(Vertical(travel), fraction, moments).reshape(len(travel), moments)
    else:
        passed = np.full((1, moments), travel[0])
    scene = press(Vertical(travel), fraction, Imprint(HEIGHT, AFTER, BEFORE))
    for frame, places in enumerate(passed):
        # Of the sorted depths those from the height's on are in contact; none where there is no object.
        missed = np.searchsorted(np.sort(places), -np.nan_to_num(HEIGHT, nan=-9.0))
        contact = 1 - missed / moments
        expected = BEFORE + contact * (AFTER - BEFORE)
        np.testing.assert_allclose(scene.light(frame), expected, atol=2 / moments + 1e-6)
        np.testing.assert_array_equal(scene.light(frame)[:3], BEFORE[:3])


@pytest.mark.parametrize("stroke", STROKES)
def test_a_film_of_a_press_is_the_press(stroke: str) -> None:
    movement = Vertical(STROKES[stroke])
    optics, contact = Ideal(Body(), Uniform()), Conform(BALL, VIEW)
    touched, untouched = (optics.light(contact.drape(pose_at_press(depth))) for depth in (10.0, -10.0))
    height = BALL.height(VIEW.x, VIEW.y)

    def make(fraction: float) -> Film:
        return press(movement, fraction, Imprint(height, touched, untouched))

    film = all_light(real(movement))
    np.testing.assert_array_equal(film, all_light(make(0.0)))
    assert film.max() > 0.9
    for fraction in (0.4, 1.0):
        blurred = all_light(real(movement, fraction))
        exact = all_light(make(fraction))
        # Five poses tell time to a tenth of an exposure's.
        np.testing.assert_allclose(blurred, exact, atol=0.1 + 1e-6)
        np.testing.assert_allclose(blurred.mean(axis=(1, 2)), exact.mean(axis=(1, 2)), atol=0.01)
