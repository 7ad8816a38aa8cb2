"""The twin as a camera, at any position of its body."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mirrorskin.hw.base.camera import Frames
from mirrorskin.hw.base.errors import HardwareError
from mirrorskin.hw.base.stage import Position
from mirrorskin.io import InputError
from mirrorskin.twin import (
    Axial,
    Body,
    Camera,
    Horizontal,
    SheetTexture,
    Sphere,
    Twin,
    Twist,
    Vertical,
)
from mirrorskin.twin.emulator.camera import TwinCamera, pose_at
from mirrorskin.twin.emulator.simulated_clock import SimulatedClock
from mirrorskin.twin.movement import Movement, Pose, pose_at_lean

SHAPE = (33, 47)
TRAVEL = [-0.3, 0.0, 0.2, 0.9, 1.4, 0.6]
PHASES = [0.0, 0.3, 2.0, 3.9, -1.0, 7.0]
TILT, PRESS, PIVOT = 0.06, 1.0, (0.5, -0.3, 5.0)
PATIENCE = 1.0  # seconds

MOVEMENTS: dict[str, Movement] = {"press": Vertical(TRAVEL), "lean": Axial(PHASES, TILT, PRESS, PIVOT)}
SCENES: dict[str, dict[str, Any]] = {
    "the paper's": {},
    "linear": {"pattern": "linear"},
    "traced": {"optics": "cylinder", "body": Body(air_gap=0.5)},
    "elastic": {"contact": "elastic"},
    "a pinhole": {"camera": Camera(np.dtype(np.uint16), distance=150.0, electrons=40.0)},
    "floats": {"camera": Camera(np.dtype(np.float32), gain_deviation=0.1, seed=5)},
}


def make_twin(movement: Movement, **scene: Any) -> Twin:
    return Twin(object="sphere", shape=SHAPE, pixel_size=0.2, movement=movement, **scene)


def read_all(twin: Twin) -> NDArray[Any]:
    block = twin.read(np.empty(twin.shape, twin.dtype))
    assert block is not None
    return block.frames


def look(twin: Twin, number: int, pose_at: Callable[[float], Pose]) -> NDArray[Any]:
    out = np.empty(twin.shape[1:], twin.dtype)
    twin.look(pose_at, number, out)
    return out


def lean_at(place: Position) -> Pose:
    return pose_at_lean(place.travel, place.tilt, place.phase, PIVOT)


# The twin, anywhere.


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("name", MOVEMENTS)
def test_what_is_seen_at_a_place_is_the_frame_of_a_movement_there(name: str, scene: str) -> None:
    movement = MOVEMENTS[name]
    twin = make_twin(movement, **SCENES[scene])
    frames = read_all(make_twin(movement, **SCENES[scene]))
    assert frames.std() > 0
    for number in (4, 0, 3, 3, 5, 1, 2):
        pose = movement.pose(movement.path[number])
        np.testing.assert_array_equal(look(twin, number, lambda late, pose=pose: pose), frames[number])


# As a camera.


@pytest.fixture
def running(clock: SimulatedClock) -> Iterator[Callable[..., TwinCamera]]:
    """Make cameras that run until the test ends."""
    with ExitStack() as stack:

        def make(where: Callable[[float], Position], rate: float = 100.0, **timing: Any) -> TwinCamera:
            twin = make_twin(MOVEMENTS["press"], camera=Camera(frame_rate=rate))
            return stack.enter_context(TwinCamera(twin, where, clock=clock, **timing))

        yield make


def still(at: float) -> Position:
    return Position(travel=0.8)


def take(camera: TwinCamera, count: int) -> list[Frames]:
    taken: list[Frames] = []
    while sum(len(frames.number) for frames in taken) < count:
        taken.append(camera.take(count, PATIENCE))
    return taken


def drain(camera: TwinCamera, timeout: float = PATIENCE) -> Iterator[Frames]:
    """Take until an error ends it."""
    while True:
        yield camera.take(8, timeout)


def times_of(taken: list[Frames]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    return np.concatenate([f.number for f in taken]), np.concatenate([f.time for f in taken])


def test_counts_above_the_dark_level_are_proportional_to_the_exposure(running) -> None:
    def light(exposure: float, strength: float = 1.0) -> float:
        camera = running(still, 50.0, light=strength)
        camera.set_exposure(exposure)
        camera.flush()
        return float(np.mean([frames.pixels.mean() for frames in take(camera, 8)[1:]]) - Camera().dark)

    whole = light(0.02)
    assert [light(0.01), light(0.005, 2.0)] == pytest.approx([whole / 2, whole / 2], abs=0.2)


@pytest.mark.parametrize("exposure", [0.0, -1.0, math.inf, math.nan])
def test_an_impossible_exposure_is_refused(running, exposure: float) -> None:
    with pytest.raises(InputError, match="give one above 0"):
        running(still).set_exposure(exposure)


def test_a_frame_shows_the_body_where_it_was_when_it_was_exposed(running, clock) -> None:
    began = clock.now()

    def where(at: float) -> Position:
        return Position(1.0, 0.05 * math.cos(at - began), 0.05 * math.sin(at - began))

    twin = make_twin(MOVEMENTS["press"])
    for frames in take(running(where, 20.0, delay=0.03, pivot=PIVOT), 4):
        for pixels, number, arrived in zip(frames.pixels, frames.number, frames.time, strict=True):
            pose = lean_at(where(float(arrived) - 0.03))
            sight = look(twin, int(number), lambda late, pose=pose: pose)
            assert np.mean(pixels != sight) < 0.001  # times are rounded


def test_frames_arrive_late_by_delay_and_jitter_and_in_order(running, clock) -> None:
    exposed: list[float] = []

    def where(at: float) -> Position:
        exposed.append(at)
        return still(at)

    number, arrived = times_of(take(running(where, 200.0, delay=0.03, jitter=0.004, seed=3), 150))
    assert clock.now() == arrived[-1]
    assert (np.diff(arrived) >= 0).all()
    late = arrived - (exposed[0] + (number - number[0]) / 200.0)
    assert abs(late.mean() - 0.03) < 0.002
    assert 0.002 < late.std() < 0.005


def test_a_camera_that_cannot_keep_up_loses_frames_and_counts_them(running, clock) -> None:
    def where(at: float) -> Position:
        clock.sleep(0.02)
        return still(at)

    camera = running(where, 200.0)
    taken = take(camera, 8)
    number, arrived = times_of(taken)
    assert number[-1] > 2 * len(number)
    assert sum(frames.dropped for frames in taken) == number[-1] + 1 - len(number) > 0
    assert camera.counts.dropped >= sum(frames.dropped for frames in taken)
    np.testing.assert_allclose(np.diff(arrived), np.diff(number) / 200.0, atol=1e-9)


@pytest.mark.parametrize("every", [2, 3, 10])
def test_each_nth_frame_may_be_lost_or_late(running, every: int) -> None:
    camera = running(still, 100.0, delay=0.02)
    camera.lateness = lambda number: math.inf if number % every == 1 else 0.0
    number, _ = times_of(take(camera, 40))
    assert number.tolist() == [n for n in range(number[-1] + 1) if n % every != 1]
    assert camera.counts.dropped == number[-1] + 1 - len(number)
    other = running(still, 100.0, delay=0.02)
    other.lateness = lambda number: 0.015 if number % every == 0 else 0.0
    number, arrived = times_of(take(other, 40))
    assert number.tolist() == list(range(len(number)))
    assert (np.diff(arrived) >= 0).all()


def test_a_stalled_camera_delivers_nothing(running) -> None:
    camera = running(still, delay=0.02)
    take(camera, 3)
    camera.stall()
    for timeout in (0.5, 0.1):  # the first takes what was on its way
        with pytest.raises(HardwareError, match="no frame"):
            list(drain(camera, timeout))
    assert camera.error is None


def test_a_lost_camera_is_reported_to_readers(running) -> None:
    camera = running(still)
    take(camera, 2)
    camera.lose()
    assert camera.error is not None
    with pytest.raises(HardwareError, match="lost"):
        list(drain(camera))


@pytest.mark.parametrize("options", [{"delay": -0.1}, {"jitter": math.nan}])
def test_impossible_input_is_refused(options: dict[str, float]) -> None:
    with pytest.raises(InputError, match=f"^{next(iter(options))} .* is not possible"):
        TwinCamera(make_twin(MOVEMENTS["press"]), still, **options)


@pytest.mark.parametrize(
    "movement",
    [
        Horizontal(np.outer([0.0, 0.1, 0.25, 0.2], [0.6, 0.8]), 0.4),
        Twist(np.radians([0.0, 4.0, 9.0, 7.0]), 0.4),
    ],
    ids=["horizontal", "twist"],
)
def test_a_skin_with_a_texture_is_dragged_as_in_the_twin_itself(movement: Horizontal | Twist) -> None:
    options: dict[str, Any] = {"object": Sphere(8.0), "shape": (40, 50), "pixel_size": 0.12}
    camera = Camera(noise=0.0, exposure=0.0)
    twin = Twin(
        movement=movement, contact="elastic", texture=SheetTexture("flakes", 0.4), camera=camera, **options
    )
    expected = read_all(twin)
    places = [
        Position(0.4, twist=float(at)) if movement.motion == "twist" else Position(0.4, x=at[0], y=at[1])
        for at in movement.positions
    ]
    look(twin, 0, lambda late: pose_at(Position(0.2)))
    for place, frame in zip(places, expected, strict=True):
        sight = look(twin, 0, lambda late, at=place: pose_at(at))
        np.testing.assert_allclose(sight.astype(int), frame, atol=1)
    assert (expected[0] != expected[-1]).any()
