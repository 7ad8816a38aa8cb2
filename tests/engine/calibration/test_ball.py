"""A ball in each frame, compared with independent poses, and found in the twin's pictures."""

import numpy as np
import pytest
from leaning_turns import EIGHTHS, Ball, circle, pictures
from poses import leaning

from mirrorskin.engine.calibration.ball import find_ball, follow_ball, moved, rotations, see_ball, smooth_turn
from mirrorskin.io import InputError, pixel_axes
from mirrorskin.twin import Camera

RADIUS, DEPTH = 2.0, 0.6
CENTRE = (1.0, -0.5, DEPTH - RADIUS)
PIVOT = (0.7, -1.2, 15.0)
PHASES = np.radians([10.0, 100.0, 200.0, 310.0])
TILT = np.radians(2.5)
CIRCLE = circle(TILT, PHASES)
UPRIGHT = np.zeros((1, 2))
X, Y = (axis.ravel() for axis in np.meshgrid(*pixel_axes((41, 33), (0.12, 0.15))))
STRAIGHT = np.stack([X, Y, 0 * X, 0 * X])
SLANTED = np.stack([X, Y, -X / 80, -Y / 80])  # of a pinhole 80 mm above the rest plane
PIXEL, SHAPE = (0.15, 0.15), (80, 80)


def test_an_upright_ball_is_a_sphere_above_the_rest_plane():
    points = see_ball(STRAIGHT, CENTRE, RADIUS, UPRIGHT, (0, 0, 0))
    away = (X - CENTRE[0]) ** 2 + (Y - CENTRE[1]) ** 2
    touched = points.contact[0]
    assert np.array_equal(touched, away < RADIUS**2 - (RADIUS - DEPTH) ** 2)
    assert 50 < np.count_nonzero(touched) < X.size / 2
    assert points.z[0, touched] == pytest.approx(CENTRE[2] + np.sqrt(RADIUS**2 - away[touched]))
    assert points.normal[0, touched, 0] * RADIUS == pytest.approx(X[touched] - CENTRE[0])
    assert points.normal[0, touched, 1] * RADIUS == pytest.approx(Y[touched] - CENTRE[1])
    assert np.array_equal(np.isfinite(points.normal).all(axis=-1), points.contact)
    assert not see_ball(STRAIGHT, (0, 0, -RADIUS - 0.1), RADIUS, UPRIGHT, (0, 0, 0)).contact.any()


def test_of_a_ball_beyond_its_equator_only_the_upper_half_is_seen():
    sight = np.array([[0.0, 0.9, 1.1], [0, 0, 0], [0, 0, 0], [0, 0, 0]])
    points = see_ball(sight, (0, 0, 3.0), 1.0, UPRIGHT, (0, 0, 0))
    assert points.contact.tolist() == [[True, True, False]]
    assert points.z[0, :2] == pytest.approx([4.0, 3.0 + np.sqrt(1 - 0.81)])


@pytest.mark.parametrize("sight", [STRAIGHT, SLANTED], ids=["straight", "slanted"])
def test_what_is_seen_is_on_the_line_of_sight_and_on_the_ball_turned_back(sight):
    points = see_ball(sight, CENTRE, RADIUS, CIRCLE, PIVOT)
    for frame, phase in enumerate(PHASES):
        touched = points.contact[frame]
        z = points.z[frame, touched]
        x, y, slope_x, slope_y = sight[:, touched]
        # The book's world: the untouched ball's top at the rest plane, the body lowered by the depth.
        pose = leaning(phase, TILT, DEPTH, PIVOT)
        point = pose.to_world(np.stack([x + z * slope_x, y + z * slope_y, z], axis=1))
        from_centre = point - (np.array(CENTRE) - (0, 0, DEPTH))
        assert np.count_nonzero(touched) > 50
        assert (z > 0).all()
        assert np.linalg.norm(from_centre, axis=1) == pytest.approx(RADIUS)
        assert points.normal[frame, touched] == pytest.approx(from_centre @ pose.turn.T / RADIUS, abs=1e-12)
        assert (points.normal[frame, touched, 2] > 0).all()


def test_the_rotation_is_that_of_equation_10():
    for turn, phase in zip(rotations(CIRCLE), PHASES, strict=True):
        assert turn == pytest.approx(leaning(phase, TILT, 0.0).turn, abs=1e-15)
    assert np.array_equal(rotations(UPRIGHT)[0], np.eye(3))
    assert moved(PIVOT, CIRCLE, PIVOT) == pytest.approx(np.tile(PIVOT, (4, 1)), abs=1e-15)


def turn(x, y, depth, pivot=(0.0, 0.0, 10.0), phase=EIGHTHS, **options):
    """Return frames of the twin about a ball of 4 mm."""
    distance = 150.0 if options.get("optics") == "cylinder" else np.inf
    camera = Camera(noise=1.5, seed=3, gain_deviation=0.05, offset_deviation=1.0, distance=distance)
    lean = circle(TILT, phase)
    return pictures(
        Ball(RADIUS, x, y), lean, depth, pivot, shape=SHAPE, pixel_size=PIXEL[0], camera=camera, **options
    )


@pytest.mark.parametrize(
    ("optics", "pattern", "x", "y", "depth"),
    [("ideal", "uniform", 3, 2, 0.6), ("cylinder", "linear", -5.2, 4, 0.7)],
)
def test_a_ball_is_found(optics, pattern, x, y, depth):
    centre = find_ball(turn(x, y, depth, optics=optics, pattern=pattern), EIGHTHS, PIXEL, RADIUS)
    assert np.hypot(centre[0] - x, centre[1] - y) < 0.1
    assert centre[2] + RADIUS == pytest.approx(depth, abs=0.25)


@pytest.mark.parametrize("height", [-5.0, 40.0])
def test_a_ball_is_followed_wherever_the_pivot_is(height):
    pivot = (1.0, -0.5, height)
    centres = follow_ball(turn(1, -2, 0.6, pivot, pattern="linear"), PIXEL, RADIUS).centres
    assert centres == pytest.approx(moved((1, -2, 0.6 - RADIUS), circle(TILT), pivot), abs=0.05)


def test_phases_may_be_uneven_and_of_any_direction_and_zero():
    phase = np.radians([178.1, 220.8, 280.5, 316.5, 7.6, 48.0, 96.3, 136.4])
    frames = turn(2, 1, 0.6, (0, 0, 30), phase, pattern="linear")
    for phases in (phase, 1.0 - phase):
        assert find_ball(frames, phases, PIXEL, RADIUS)[:2] == pytest.approx((2, 1), abs=0.03)
    with pytest.raises(InputError, match="at least 3"):
        find_ball(frames[:2], phase[:2], PIXEL, RADIUS)


def test_pixels_need_not_be_square_nor_few():
    lean = circle(TILT, EIGHTHS[::2])
    frames = pictures(Ball(5.0, 1.0, 0.4), lean, 1.2, (0, 0, 10), shape=(300, 500), pixel_size=(0.02, 0.03))
    centre = find_ball(frames, EIGHTHS[::2], (0.02, 0.03), 5.0)
    assert centre[:2] == pytest.approx((1.0, 0.4), abs=0.03)


def test_light_is_accepted_instead_of_counts_and_pixels_and_frames_may_be_defective():
    frames = ((turn(2, 1, 0.6, pattern="linear") - 16.0) / 208).astype(np.float32)
    frames[:, 47, 33] = 40.0
    frames[:, 33, 56] = frames[:, 14:17, 20:23] = np.nan
    frames[3] = frames[3, 0, 0]
    assert np.isnan(follow_ball(frames, PIXEL, RADIUS).centres[3]).all()
    assert find_ball(frames, EIGHTHS, PIXEL, RADIUS)[:2] == pytest.approx((2, 1), abs=0.03)


NOISE = np.random.default_rng(5).normal(20, 1.5, (8, 60, 70))


@pytest.mark.parametrize(
    "frames",
    [
        NOISE,
        np.full((8, 1, 1), 7, np.uint8),
        np.full((8, 60, 70), np.nan),
        NOISE + np.pad(np.full((36, 36), 150.0), ((12, 12), (15, 19))),
        np.broadcast_to(np.linspace(0, 200, 70), (8, 60, 70)),
    ],
    ids=["noise", "one pixel", "no numbers", "square", "ramp"],
)
def test_where_there_is_no_ball_none_is_found(frames):
    with pytest.raises(InputError, match=r"a ball of 4 mm is seen in 0 of 8 frames.* press it until a ring"):
        find_ball(frames, EIGHTHS, PIXEL, RADIUS)


def test_a_wave_is_found_below_values_that_are_wrong_or_missing():
    phase = np.arange(12) * np.pi / 6
    values = np.stack([1 + 2 * np.cos(phase), 3 - np.sin(phase)], axis=1)
    values[2] += 50
    values[7] = np.nan
    assert smooth_turn(values, phase) == pytest.approx(np.array([[1, 3], [2, 0], [0, -1]]), abs=1e-6)
