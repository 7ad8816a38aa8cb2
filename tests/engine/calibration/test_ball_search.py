from __future__ import annotations

import numpy as np
import pytest
from leaning_turns import EIGHTHS, Ball, circle, pictures

from mirrorskin.engine.calibration.ball import find_ball, follow_ball, moved, smooth_turn
from mirrorskin.hw.twin import Camera
from mirrorskin.io import InputError

TILT = np.radians(2.5)
RADIUS = 2.0
PIXEL = (0.15, 0.15)
SHAPE = (80, 80)


def turn(x, y, depth, pivot=(0.0, 0.0, 10.0), phase=EIGHTHS, **options):
    distance = 150.0 if options.get("optics") == "cylinder" else np.inf
    camera = Camera(noise=1.5, seed=3, gain_deviation=0.05, offset_deviation=1.0, distance=distance)
    lean = circle(TILT, phase)
    return pictures(
        Ball(RADIUS, x, y), lean, depth, pivot, shape=SHAPE, pixel_size=PIXEL[0], camera=camera, **options
    )


@pytest.mark.parametrize(
    ("optics", "pattern", "x", "y", "depth"),
    [
        ("ideal", "linear", 0, 0, 0.5),
        ("ideal", "linear", 4, 5.9, 0.6),
        ("ideal", "uniform", 3, 2, 0.6),
        ("cylinder", "linear", -5.2, 4, 0.7),
        ("cylinder", "linear", 4, 5.9, 0.6),
        ("cylinder", "uniform", 0, 0, 0.5),
        ("cylinder", "uniform", -5.2, 4, 0.7),
    ],
)
def test_a_ball_is_found(optics, pattern, x, y, depth):
    frames = turn(x, y, depth, optics=optics, pattern=pattern)

    found = find_ball(frames, EIGHTHS, PIXEL, RADIUS)

    assert np.hypot(found.x - x, found.y - y) < 0.1
    assert found.depth == pytest.approx(depth, abs=0.25)


@pytest.mark.parametrize("height", [-5.0, 0.0, 40.0])
def test_a_ball_is_followed_wherever_the_pivot_is(height):
    pivot = (1.0, -0.5, height)

    centres = follow_ball(turn(1, -2, 0.6, pivot, pattern="linear"), PIXEL, RADIUS).centres

    assert centres == pytest.approx(moved((1, -2, 0.6 - RADIUS), circle(TILT), pivot), abs=0.05)


def test_the_direction_and_the_zero_of_the_phases_do_not_matter():
    frames = turn(2, 1, 0.6, (0, 0, 30), pattern="linear")

    assert find_ball(frames, EIGHTHS, PIXEL, RADIUS)[:2] == pytest.approx((2, 1), abs=0.03)
    assert find_ball(frames, 1.0 - EIGHTHS, PIXEL, RADIUS)[:2] == pytest.approx((2, 1), abs=0.03)


def test_phases_may_be_uneven():
    phase = np.radians([178.1, 220.8, 280.5, 316.5, 7.6, 48.0, 96.3, 136.4])
    frames = turn(2, 1, 0.6, (0, 0, 30), phase, pattern="linear")

    assert find_ball(frames, phase, PIXEL, RADIUS)[:2] == pytest.approx((2, 1), abs=0.03)


def test_pixels_need_not_be_square_nor_few():
    lean = circle(TILT, EIGHTHS[::2])
    frames = pictures(Ball(5.0, 1.0, 0.4), lean, 1.2, (0, 0, 10), shape=(300, 700), pixel_size=(0.02, 0.03))

    found = find_ball(frames, EIGHTHS[::2], (0.02, 0.03), 5.0)

    assert found[:2] == pytest.approx((1.0, 0.4), abs=0.03)


def test_light_will_do_as_well_as_counts_and_pixels_may_be_defect():
    frames = (turn(2, 1, 0.6, pattern="linear") - 16.0) / 208
    frames[:, 47, 33] = 40.0
    frames[:, 33, 56] = frames[:, 14:17, 20:23] = np.nan

    assert find_ball(frames.astype(np.float32), EIGHTHS, PIXEL, RADIUS)[:2] == pytest.approx((2, 1), abs=0.03)


def test_a_frame_without_the_ball_does_not_matter():
    frames = turn(2, 1, 0.6, pattern="linear")
    frames[3] = frames[3, 0, 0]

    assert np.isnan(follow_ball(frames, PIXEL, RADIUS).centres[3]).all()
    assert find_ball(frames, EIGHTHS, PIXEL, RADIUS)[:2] == pytest.approx((2, 1), abs=0.03)


def noise():
    return np.random.default_rng(5).normal(20, 1.5, (8, 60, 70))


def bright_square():
    frames = noise()
    frames[:, 12:48, 15:51] += 150
    return frames


@pytest.mark.parametrize(
    "frames",
    [
        noise(),
        np.rint(noise() * (1 + 0.05 * noise()[:1])).astype(np.uint8),
        np.full((8, 60, 70), 7, np.uint8),
        np.full((8, 1, 1), 7, np.uint8),
        np.full((8, 60, 70), np.nan),
        bright_square(),
        np.broadcast_to(np.linspace(0, 200, 70), (8, 60, 70)),
    ],
    ids=["noise", "uneven pixels", "all equal", "one pixel", "no numbers", "square", "ramp"],
)
def test_where_there_is_no_ball_none_is_found(frames):
    with pytest.raises(InputError, match="a ball of 4 mm is seen in 0 of 8 frames"):
        find_ball(frames, EIGHTHS, PIXEL, RADIUS)


def test_a_ball_that_is_pressed_too_little_is_not_found():
    with pytest.raises(InputError, match="press it until a ring of light shows"):
        find_ball(turn(0, 0, 0.03, pattern="linear"), EIGHTHS, PIXEL, RADIUS)


def test_a_turn_needs_three_phases():
    with pytest.raises(InputError, match="at least 3"):
        find_ball(turn(0, 0, 0.6, phase=EIGHTHS[:2]), EIGHTHS[:2], PIXEL, RADIUS)


def test_a_wave_is_found_below_values_that_are_wrong_or_missing():
    phase = np.arange(12) * np.pi / 6
    values = np.stack([1 + 2 * np.cos(phase), 3 - np.sin(phase)], axis=1)
    values[2] += 50
    values[7] = np.nan

    assert smooth_turn(values, phase) == pytest.approx(np.array([[1, 3], [2, 0], [0, -1]]), abs=1e-6)
