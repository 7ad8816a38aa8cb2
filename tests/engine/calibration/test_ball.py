from __future__ import annotations

import numpy as np
import pytest
from poses import leaning

from mirrorskin.engine.calibration.ball import BallView, ball_view, moved, rotations

RADIUS, DEPTH = 2.0, 0.6
CENTRE = (1.0, -0.5, DEPTH - RADIUS)
PIVOT = (0.7, -1.2, 15.0)
PHASES = np.radians([10.0, 100.0, 200.0, 310.0])
TILT = np.radians(2.5)
CIRCLE = TILT * np.stack([np.cos(PHASES), np.sin(PHASES)], axis=1)


def picture():
    return BallView.of_picture((41, 33), (0.12, 0.15))


def slanted():
    """Lines of a pinhole 80 mm above the rest plane, in the same material."""
    x, y = picture().place[:2]
    return BallView(np.stack([x, y, -x / 80, -y / 80]))


def test_an_upright_ball_is_a_sphere_where_it_stands_above_the_rest_plane():
    pixels = picture()
    x, y = pixels.place[:2]

    seen = ball_view(pixels, CENTRE, RADIUS, np.zeros((1, 2)), (0, 0, 0))

    away = (x - CENTRE[0]) ** 2 + (y - CENTRE[1]) ** 2
    rim = RADIUS**2 - (RADIUS - DEPTH) ** 2
    assert np.array_equal(seen.contact[0], away < rim)
    assert 50 < np.count_nonzero(seen.contact) < x.size / 2
    touched = seen.contact[0]
    assert seen.z[0, touched] == pytest.approx(CENTRE[2] + np.sqrt(RADIUS**2 - away[touched]))
    zenith = np.arcsin(np.sqrt(away[touched]) / RADIUS)
    assert np.arccos(seen.normal[0, touched, 2]) == pytest.approx(zenith, abs=1e-7)
    assert seen.normal[0, touched, 0] * RADIUS == pytest.approx(x[touched] - CENTRE[0])
    assert seen.normal[0, touched, 1] * RADIUS == pytest.approx(y[touched] - CENTRE[1])


def test_where_the_ball_is_not_touched_there_is_no_number():
    seen = ball_view(picture(), CENTRE, RADIUS, CIRCLE, PIVOT)

    assert seen.contact.any()
    assert not seen.contact.all()
    assert np.array_equal(np.isfinite(seen.z), seen.contact)
    assert np.array_equal(np.isfinite(seen.normal).all(axis=-1), seen.contact)


def test_a_ball_below_the_sheet_is_not_seen():
    seen = ball_view(picture(), (0, 0, -RADIUS - 0.1), RADIUS, np.zeros((1, 2)), (0, 0, 0))

    assert not seen.contact.any()


def test_of_a_ball_beyond_its_equator_only_the_upper_half_is_seen():
    pixels = BallView.straight([0.0, 0.9, 1.1], 0.0)

    seen = ball_view(pixels, (0, 0, 3.0), 1.0, np.zeros((1, 2)), (0, 0, 0))

    assert seen.contact.tolist() == [[True, True, False]]
    assert seen.z[0, :2] == pytest.approx([4.0, 3.0 + np.sqrt(1 - 0.81)])


@pytest.mark.parametrize("pixels", [picture(), slanted()], ids=["straight", "slanted"])
def test_what_is_seen_lies_on_the_line_of_sight_and_on_the_ball_turned_back(pixels):
    seen = ball_view(pixels, CENTRE, RADIUS, CIRCLE, PIVOT)

    x, y, slope_x, slope_y = pixels.place
    for frame, phase in enumerate(PHASES):
        touched = seen.contact[frame]
        z = seen.z[frame, touched]
        across, up = x[touched] + z * slope_x[touched], y[touched] + z * slope_y[touched]
        # The book's world: the untouched ball's top at the rest plane, the body lowered by the depth.
        pose = leaning(phase, TILT, DEPTH, PIVOT)
        from_centre = pose.to_world(np.stack([across, up, z], axis=1)) - (np.array(CENTRE) - (0, 0, DEPTH))
        assert np.count_nonzero(touched) > 50
        assert (z > 0).all()
        assert np.linalg.norm(from_centre, axis=1) == pytest.approx(RADIUS)
        assert seen.normal[frame, touched] == pytest.approx(from_centre @ pose.turn.T / RADIUS, abs=1e-12)
        assert (seen.normal[frame, touched, 2] > 0).all()


def test_a_sight_line_sees_the_upper_side():
    pixels = slanted()
    x, y, slope_x, slope_y = pixels.place

    seen = ball_view(pixels, CENTRE, RADIUS, np.zeros((1, 2)), (0, 0, 0))

    # Just above what is seen, the line is outside the ball.
    above = seen.z[0] + 1e-6
    out = (x + above * slope_x - CENTRE[0]) ** 2 + (y + above * slope_y - CENTRE[1]) ** 2
    out += (above - CENTRE[2]) ** 2
    assert (out[seen.contact[0]] > RADIUS**2).all()
    assert seen.contact.any()


def test_the_rotation_is_that_of_equation_10():
    for turn, phase in zip(rotations(CIRCLE), PHASES, strict=True):
        assert turn == pytest.approx(leaning(phase, TILT, 0.0).turn, abs=1e-15)


def test_a_body_that_does_not_lean_sees_the_world_as_it_is():
    assert np.array_equal(rotations(np.zeros((2, 2))), np.stack([np.eye(3)] * 2))


def test_the_pivot_stays_where_it_is():
    assert moved(PIVOT, CIRCLE, PIVOT) == pytest.approx(np.tile(PIVOT, (4, 1)), abs=1e-15)


def test_one_pixel_is_enough():
    seen = ball_view(BallView.straight(0.0, 0.0), (0, 0, -1.0), 1.5, np.zeros((1, 2)), (0, 0, 0))

    assert seen.z.shape == (1, 1)
    assert seen.z[0, 0] == pytest.approx(0.5)
    assert seen.normal[0, 0] == pytest.approx([0, 0, 1])
