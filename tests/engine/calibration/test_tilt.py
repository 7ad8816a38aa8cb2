from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from leaning_turns import EIGHTHS, Ball, Flat, circle, pictures
from poses import leaning

from mirrorskin.engine.calibration.ball import Followed, moved
from mirrorskin.engine.calibration.brightness import LinearShown, WallShown
from mirrorskin.engine.calibration.tilt import (
    BallTrack,
    PlateTrack,
    fit_precession,
    study_precession,
    study_tracks,
)
from mirrorskin.engine.calibration.tilt_tracks import (
    BallTurn,
    PlateTurn,
    Tilts,
    read_ball,
    read_plate,
    track_ball,
    track_plate,
)
from mirrorskin.hw.twin import Axial, Body, Camera, Twin
from mirrorskin.io import Header, InputError, Precession, WallResponse

RADIUS, DEPTH = 2.0, 0.45
PIXEL = (0.1, 0.1)
SHAPE = (64, 64)
TALL = Body(height=1e5, scatter=0.0)  # whose wall reaches up to the camera: zeniths from 0 on are seen
DEGREE = np.radians(1)


def precession(**known):
    """What is to be found; the recordings say a circle of phase 0 at x."""
    usual = Precession(2.53 * DEGREE, 0.05, 1, 0.0, 0.0, (0.0, 0.0), (0.3, -0.2, 12.0))
    return replace(usual, **known)


def scale_of(body, shape=SHAPE, camera=None):
    twin = Twin(
        object=Ball(1.0),
        shape=shape,
        pixel_size=0.1,
        movement=Axial([0.0], 0.04, 0.1),
        pattern="linear",
        body=body,
        camera=camera,
    )
    return LinearShown.of_header(twin.header, shape)


def ball_turn(truth, x=0.0, y=0.0, *, phase=EIGHTHS, shape=SHAPE, depth=DEPTH, **options):
    lean = truth.lean(phase)
    frames = pictures(Ball(RADIUS, x, y), lean, depth, truth.pivot, shape=shape, pattern="linear", **options)
    return BallTurn("ball", frames, phase, PIXEL, RADIUS, depth)


def flat_turn(truth, *, phase=EIGHTHS, level=True, thing=None, press=0.5, **options):
    lean = truth.lean(phase)
    frames = pictures(thing or Flat(), lean, press, truth.pivot, shape=SHAPE, pattern="linear", **options)
    return PlateTurn("plate", frames, phase, level)


def off(found, truth):
    """Return how far numbers are off, by name; angles in degrees."""
    names = ("tilt", "phase_offset", "major_axis")
    errors = {name: (getattr(found, name) - getattr(truth, name)) / DEGREE for name in names}
    errors["ellipticity"] = found.ellipticity - truth.ellipticity
    errors |= {f"centre_{a}": (found.centre[k] - truth.centre[k]) / DEGREE for k, a in enumerate("xy")}
    return errors | {f"pivot_{a}": found.pivot[k] - truth.pivot[k] for k, a in enumerate("xyz")}


def within_errors(found, truth, names, most=4.0):
    errors = off(found, truth)
    angles = ("tilt", "phase_offset", "major_axis", "centre_x", "centre_y")
    sigma = {name: found.sigma[name] / (DEGREE if name in angles else 1) for name in names}
    strays = {name: (errors[name], sigma[name]) for name in names if abs(errors[name]) > most * sigma[name]}
    assert not strays


@pytest.mark.parametrize("direction", [1, -1])
def test_a_flat_and_a_ball_tell_the_precession(direction):
    truth = precession(direction=direction)
    turns = [flat_turn(truth, body=TALL, seed=3), ball_turn(truth, 0.2, -0.1, body=TALL, seed=4)]

    found = fit_precession(turns, scale_of(TALL))

    errors = off(found, truth)
    assert found.direction == direction
    assert abs(errors["tilt"]) < 0.02
    assert abs(errors["phase_offset"]) < 0.1
    assert abs(errors["pivot_z"]) < 1.0
    assert np.hypot(errors["pivot_x"], errors["pivot_y"]) < 1.0
    assert abs(found.ellipticity) < 0.002
    within_errors(found, truth, ("tilt", "phase_offset", "centre_x", "centre_y", "pivot_z"))


def test_an_oval_way_and_a_mean_lean_are_found_within_their_errors():
    truth = precession(ellipticity=0.02, major_axis=0.4, centre=(0.1 * DEGREE, -0.2 * DEGREE))
    turns = [flat_turn(truth, body=TALL, seed=5), ball_turn(truth, body=TALL, seed=6)]

    study = study_precession(turns, scale_of(TALL))

    found = study.precession
    assert found.sigma["ellipticity"] < 0.002
    assert found.sigma["centre_x"] < 0.01 * DEGREE
    within_errors(found, truth, ("ellipticity", "major_axis", "centre_x", "centre_y", "tilt", "phase_offset"))
    assert study.left["zenith"] < 0.01 * DEGREE
    assert study.left["place"] < 0.005


def test_a_wedge_tells_the_half_angle_where_a_flat_is_dark():
    truth = precession(direction=-1, phase_offset=-0.3)
    wedge = flat_turn(truth, level=False, thing=Flat(25 * DEGREE, 1.0), press=8.0, seed=7)

    found = fit_precession([wedge, ball_turn(truth, seed=8)], scale_of(None))

    assert found.direction == -1
    assert abs(off(found, truth)["tilt"]) < 0.02
    within_errors(found, truth, ("tilt", "phase_offset", "pivot_z"))
    assert found.centre == (0.0, 0.0)
    assert "centre_x" not in found.sigma


def test_balls_at_three_places_tell_all_but_the_mean_lean_even_a_lean_to_the_other_side():
    truth = precession(phase_offset=2.0, pivot=(0.3, -0.2, 6.0))
    places = ((-2.2, 1.8), (2.3, 1.5), (-0.4, -2.4))
    shape = (90, 90)
    turns = (ball_turn(truth, *place, shape=shape, seed=n) for n, place in enumerate(places))

    study = study_precession(turns, scale_of(None, shape))

    assert abs(off(study.precession, truth)["tilt"]) < 0.1
    within_errors(study.precession, truth, ("tilt", "phase_offset", "pivot_x", "pivot_y", "pivot_z"))
    assert study.notes == ("the mean pose is taken for upright: a level plate would tell the mean lean",)


def test_which_side_the_pivot_is_on_is_said_to_be_taken_for_granted_with_one_ball():
    truth = precession(pivot=(0.0, 0.0, -8.0))

    study = study_tracks([tracked(truth, (0.0, 0.0, -1.5))], [level(truth)])

    assert study.precession.phase_offset == pytest.approx(truth.phase_offset, abs=5e-3)
    assert study.precession.pivot[2] == pytest.approx(-8.0, abs=0.05)
    assert any("within 90 deg of 0" in note for note in study.notes)


def tracked(truth, centre, seed=0, phase=EIGHTHS, sigma=(1e-3, 1e-3, 3e-3)):
    """Measure a ball without pictures."""
    exact = moved(centre, truth.lean(phase), truth.pivot)
    noise = np.random.default_rng((seed, *np.abs(np.array(centre) * 1000).astype(int))).normal(
        size=exact.shape
    )
    sigma = np.broadcast_to(sigma, exact.shape)
    return BallTrack(phase, Followed(exact + sigma * noise, sigma.copy()))


def level(truth, seed=0, phase=EIGHTHS, sigma=5e-5):
    """Measure a level plate without pictures."""
    lean = np.hypot(*truth.lean(phase).T)
    noise = np.random.default_rng((seed, 99)).normal(size=len(phase))
    return PlateTrack(phase, Tilts(lean + sigma * noise, np.full(len(phase), sigma)), True)


def test_standard_errors_are_those_of_the_errors():
    truth = precession(ellipticity=0.02, major_axis=0.4, centre=(2e-3, -1e-3), direction=-1)
    shares = []
    for seed in range(6):
        balls = [tracked(truth, (0.5, 0.2, -1.5), seed), tracked(truth, (-2.0, 3.0, -1.5), seed)]
        found = study_tracks(balls, [level(truth, seed)]).precession
        errors = off(found, truth)
        for name, error in errors.items():
            unit = 1.0 if name.startswith(("pivot", "ellip")) else DEGREE
            shares.append(error * unit / found.sigma[name])

    assert np.sqrt(np.mean(np.square(shares))) == pytest.approx(0.95, abs=0.25)
    assert np.max(np.abs(shares)) < 5


def test_errors_that_were_told_too_small_are_told_again():
    truth = precession()
    balls = [tracked(truth, (3 * k, k, -1.5), 1) for k in (-1, 1)]
    daring = [BallTrack(ball.phase, ball.seen._replace(sigma=ball.seen.sigma / 10)) for ball in balls]

    honest, again = (study_tracks(some, []).precession.sigma for some in (balls, daring))

    assert again["tilt"] == pytest.approx(honest["tilt"], rel=0.2)
    assert again["phase_offset"] == pytest.approx(honest["phase_offset"], rel=0.2)


def test_one_frame_that_is_wrong_hardly_matters():
    truth = precession()
    ball = tracked(truth, (0.5, 0.2, -1.5), 2)
    ball.seen.centres[3] += 0.2
    ball.seen.centres[6] = np.nan

    found = study_tracks([ball], [level(truth)]).precession

    assert abs(off(found, truth)["phase_offset"]) < 0.5
    assert abs(off(found, truth)["pivot_z"]) < 0.1


def test_phases_may_be_uneven_and_more_than_a_turn():
    truth = precession(direction=-1)
    phase = np.concatenate([np.radians([178.1, 220.8, 280.5, 316.5, 7.6, 48.0, 96.3, 136.4]), EIGHTHS + 6.0])

    found = study_tracks(
        [tracked(truth, (0.1, 0.2, -1.5), phase=phase)], [level(truth, phase=phase)]
    ).precession

    assert found.direction == -1
    within_errors(found, truth, ("tilt", "phase_offset", "pivot_z"))


def test_a_ball_alone_does_not_tell_the_half_angle():
    with pytest.raises(
        InputError, match=r"half-angle is not determined: a ball at one place.* add a turn on a flat"
    ):
        study_tracks([tracked(precession(), (0.5, 0.2, -1.5))], [])


def test_a_flat_alone_tells_no_phases_and_no_pivot():
    with pytest.raises(InputError, match=r"half-angle \(2\.53. deg\), but neither phases .* nor pivot: add"):
        study_tracks([], [level(precession())])


def test_nothing_tells_nothing():
    with pytest.raises(InputError, match="add a turn on a ball"):
        fit_precession([], scale_of(None))


def test_a_ball_about_whose_centre_the_body_turns_tells_no_phases():
    truth = precession(pivot=(0.5, 0.2, -1.5))

    with pytest.raises(InputError, match="hardly moves"):
        study_tracks([tracked(truth, (0.5, 0.2, -1.5))], [level(truth)])


def test_a_depth_that_is_not_known_leaves_the_pivot_across_the_axis_unknown():
    truth = precession()
    ball = tracked(truth, (0.5, 0.2, -1.5), sigma=(8e-3, 8e-3, 0.5))

    study = study_tracks([ball], [level(truth)])

    assert np.isnan(study.precession.pivot[:2]).all()
    assert study.precession.pivot[2] == pytest.approx(truth.pivot[2], abs=3.0)
    assert "the pivot's x is not determined" in study.notes


def test_three_phases_are_too_few():
    turn = BallTurn("few", np.zeros((3, 20, 20), np.uint8), EIGHTHS[:3], PIXEL, RADIUS)

    with pytest.raises(InputError, match="few: 3 different phases, at least 4 are needed"):
        fit_precession([turn], scale_of(None))


def test_a_dark_plate_is_not_taken_for_a_level_one():
    with pytest.raises(InputError, match=r"plate: no flat plate is seen.* take a wedge"):
        fit_precession([flat_turn(precession())], scale_of(None))


def test_where_there_is_no_ball_the_recording_is_named():
    turn = BallTurn("empty", np.full((8, 30, 30), 16, np.uint8), EIGHTHS, PIXEL, RADIUS)

    with pytest.raises(InputError, match="empty: a ball of 4 mm is seen in 0 of 8 frames"):
        fit_precession([turn], scale_of(None, (30, 30)))


def test_a_ball_is_placed_within_its_errors_whatever_its_pixels_gains():
    truth = precession()
    camera = Camera(noise=1.5, seed=9, gain_deviation=0.05, offset_deviation=1.0)
    turn = ball_turn(truth, 0.31, -0.17, camera=camera)

    seen = track_ball(turn, scale_of(None, camera=camera))

    error = seen.centres - moved((0.31, -0.17, DEPTH - RADIUS), truth.lean(EIGHTHS), truth.pivot)
    assert (seen.sigma[:, :2] < 2e-3).all()
    assert np.sqrt(np.mean((error / seen.sigma)[:, :2] ** 2)) < 1.5
    assert np.abs(error[:, 2]).max() < 0.03


def test_an_outline_where_the_wall_ends_before_the_contact_tells_no_depth():
    deep = ball_turn(precession(), depth=0.9)

    seen = track_ball(deep, scale_of(None))

    assert (seen.sigma[:, 2] > 0.4).all()
    assert (seen.sigma[:, :2] < 3e-3).all()


def test_the_outline_on_a_gel_that_gives_way_tells_no_depth():
    gives_way = ball_turn(precession(), contact="elastic", depth=0.6)

    seen = track_ball(gives_way, scale_of(None))

    assert (seen.sigma[:, 2] > 0.4).all()
    assert (seen.centres[:, 2] < DEPTH - 0.05 - RADIUS).all()


def test_a_plate_shows_its_lean():
    truth = precession(ellipticity=0.05)

    seen = track_plate(flat_turn(truth, body=TALL), scale_of(TALL))

    assert seen.zenith == pytest.approx(np.hypot(*truth.lean(EIGHTHS).T), abs=0.02 * DEGREE)
    assert (seen.sigma < 0.01 * DEGREE).all()


def wall(shape, scatter=3 * DEGREE):
    """Return the response of the twin's own wall, worked out by hand: linear in the central zenith."""
    low, high = np.arctan2(17.5, 40.0) / 2, np.pi / 4
    q = np.linspace(0, 0.65, 200)
    light = (np.pi / 4 - np.arctan(q) - low) / (high - low)
    curve = np.polynomial.Polynomial.fit(q, light, 9).convert().coef
    maps, none = np.zeros(shape, np.float32), np.zeros((0, 0))
    return WallResponse(
        *(17.5, 40.0, (0.0, 0.0), (0.0, 0.0), (0.0, 0.0), scatter, curve, (0.0, 0.65), np.zeros(5)),
        *("graded", maps, maps, (), none, 0.0),
    )


def test_a_real_wall_off_the_axis_is_seen_through():
    shape, place = (80, 80), (2.0, -1.6)
    truth = precession(pivot=(0.3, -0.2, 5.0))
    shown = WallShown.of_pixels(wall(shape), 16.0, 224.0, shape, PIXEL)

    seen = track_ball(ball_turn(truth, *place, shape=shape, optics="cylinder", depth=0.5), shown)

    error = seen.centres - moved((*place, 0.5 - RADIUS), truth.lean(EIGHTHS), truth.pivot)
    assert (seen.sigma[:, :2] < 2e-3).all()
    assert (seen.sigma[:, 2] < 0.05).all()
    assert np.sqrt(np.mean((error / seen.sigma) ** 2)) < 1.6


def test_a_wall_tells_no_flat():
    shown = WallShown.of_pixels(wall(SHAPE), 16.0, 224.0, SHAPE, PIXEL)

    with pytest.raises(InputError, match="linear in it: give the zenith gain and offset, or take balls"):
        fit_precession([flat_turn(precession())], shown)


def test_what_a_wall_is_wrong_by_is_in_the_error_of_depths():
    wrong = replace(wall(SHAPE), zenith_sigma=np.full(SHAPE, 5e-4, np.float32))

    assert WallShown.of_pixels(wrong, 16.0, 224.0, SHAPE, PIXEL).depth_sigma == pytest.approx(0.05)
    assert scale_of(None).depth_sigma == 0


def test_a_wall_needs_references_and_a_graded_pattern():
    with pytest.raises(InputError, match="no dark and bright references"):
        WallShown.of_pixels(wall(SHAPE), None, None, SHAPE, PIXEL)
    with pytest.raises(InputError, match="uniform pattern"):
        WallShown.of_pixels(replace(wall(SHAPE), pattern="uniform"), 16.0, 224.0, SHAPE, PIXEL)


def test_a_recording_without_a_scale_is_of_no_use():
    with pytest.raises(InputError, match="no zenith gain and offset"):
        LinearShown.of_header(Header("axial"), SHAPE)


def test_samples_at_the_ends_of_a_type_and_pixels_without_gain_tell_nothing():
    header = Header("axial", zenith_gain=np.array([[100.0, 0.0, 200.0]]), zenith_offset=np.array(20.0))
    shown, pixels = LinearShown.of_header(header, (1, 3)), np.arange(3)

    zenith = shown.of_counts(np.array([[120, 120, 220], [0, 30, 255]], np.uint8), pixels)

    assert zenith[0, [0, 2]].tolist() == [1.0, 1.0]
    assert np.isnan(zenith[:, 1]).all()
    assert np.isnan(zenith[1]).all()
    assert shown.of_counts(np.array([0.0, 0.0, 255.0]), pixels)[2] == pytest.approx(235 / 200)


def test_the_line_is_trusted_within_the_references_alone():
    header = Header(
        "axial",
        zenith_gain=np.array(-100.0),
        zenith_offset=np.array(100.0),
        dark=np.full((1, 2), 20.0, np.float32),
        bright=np.full((1, 2), 90.0, np.float32),
    )
    normals = leaning(0.0, 0.12, 0.0).turn[np.newaxis, np.newaxis, :, 2]
    steep = leaning(0.0, 0.5, 0.0).turn[np.newaxis, np.newaxis, :, 2]
    shown, nothing = LinearShown.of_header(header, (1, 2)), np.zeros((1, 1))

    zenith, within = shown.of_normals(normals, nothing, np.array([0]))

    assert zenith[0, 0] == pytest.approx(0.12)
    assert not within[0, 0]
    assert shown.of_normals(steep, nothing, np.array([1]))[1][0, 0]


class Recorded:
    """A source as the readers need it."""

    name = "recorded"

    def __init__(self, motion="axial", pixel_size=PIXEL, size=(5, 3, 4)):
        self.motion, self.shape, self.dtype = motion, size, np.dtype(np.uint8)
        self.header = Header(motion, pixel_size=pixel_size, press=0.4)
        self.phase = np.arange(5.0)
        self.index = 0

    def read(self, out):
        from mirrorskin.io import Block

        count = min(2, len(out), self.shape[0] - self.index)
        if count == 0:
            return None
        some = slice(self.index, self.index + count)
        out[:count] = self.index
        self.index += count
        return Block(out[:count], some.start, phase=None if self.phase is None else self.phase[some])


def test_a_recording_is_read_in_pieces():
    ball, plate = read_ball(Recorded(), 2.0), read_plate(Recorded(), level=True)

    assert ball.frames[:, 0, 0].tolist() == [0, 0, 2, 2, 4]
    assert ball.phase.tolist() == plate.phase.tolist() == [0, 1, 2, 3, 4]
    assert (ball.radius, ball.pixel_size, ball.press, plate.level) == (2.0, PIXEL, 0.4, True)


def test_recordings_that_cannot_be_used_are_refused():
    lost = Recorded()
    lost.phase = None
    for source, radius, told in (
        (Recorded("vertical"), 2.0, "recorded is of vertical motion"),
        (Recorded(pixel_size=None), 2.0, "recorded: its pixel size is not told"),
        (Recorded(), 0.0, "a ball of 0 mm cannot be"),
        (Recorded(size=(5000, 1000, 1000)), 2.0, "recorded: 5.0 GB of frames are too much"),
        (lost, 2.0, "recorded tells no phases"),
    ):
        with pytest.raises(InputError, match=told):
            read_ball(source, radius)


def test_a_circle_is_a_precession():
    assert precession().lean(EIGHTHS) == pytest.approx(circle(2.53 * DEGREE, EIGHTHS + 0.05))
