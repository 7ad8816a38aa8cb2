"""Precessions from the twin's turns on balls and plates, and from tracks without pictures."""

from dataclasses import replace

import numpy as np
import pytest
from leaning_turns import EIGHTHS, Ball, Flat, pictures
from poses import leaning

from mirrorskin.engine.calibration.ball import moved
from mirrorskin.engine.calibration.brightness import LinearBrightness, WallBrightness
from mirrorskin.engine.calibration.tilt import fit_precession
from mirrorskin.engine.calibration.tilt_tracks import BallTrack, PlateTrack, track_ball, track_plate
from mirrorskin.evaluation.calibration.scenes import Frames
from mirrorskin.io import Header, InputError, Precession, WallResponse
from mirrorskin.twin import Axial, Body, Camera, Twin

RADIUS, DEPTH = 2.0, 0.45
PIXEL = (0.1, 0.1)
SHAPE = (64, 64)
TALL = Body(height=1e5, scatter=0.0)  # whose wall reaches up to the camera: zeniths from 0 on are seen
DEGREE = np.radians(1)
ANGLES = ("tilt", "phase_offset", "major_axis", "centre_x", "centre_y")


def precession(**changes):
    """What is to be found; the recordings say a circle of phase 0 at x."""
    usual = Precession(2.53 * DEGREE, 0.05, 1, 0.0, 0.0, (0.0, 0.0), (0.3, -0.2, 12.0))
    return replace(usual, **changes)


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
    return LinearBrightness.of_header(twin.header, shape)


def recording(name, frames, phase=EIGHTHS, press=None, pixel_size=PIXEL):
    return Frames(frames, Header("axial", pixel_size=pixel_size, press=press), name, phase=phase)


def ball_turn(truth, x=0.0, y=0.0, *, shape=SHAPE, depth=DEPTH, stated_depth=DEPTH, **options):
    thing, lean = Ball(RADIUS, x, y), truth.lean(EIGHTHS)
    frames = pictures(thing, lean, depth, truth.pivot, shape=shape, **{"pattern": "linear"} | options)
    return recording("ball", frames, press=stated_depth)


def plate_turn(truth, *, thing=None, press=0.5, **options):
    frames = pictures(
        thing or Flat(), truth.lean(EIGHTHS), press, truth.pivot, shape=SHAPE, pattern="linear", **options
    )
    return recording("plate", frames)


def ball_track(truth, centre, seed=0, phase=EIGHTHS, sigma=(1e-3, 1e-3, 3e-3)):
    """Measure a ball without pictures."""
    exact = moved(centre, truth.lean(phase), truth.pivot)
    random = np.random.default_rng((seed, *np.abs(np.array(centre) * 1000).astype(int)))
    sigma = np.broadcast_to(sigma, exact.shape)
    return BallTrack(phase, exact + sigma * random.normal(size=exact.shape), sigma.copy())


def plate_track(truth, seed=0, phase=EIGHTHS, sigma=5e-5):
    """Measure a level plate without pictures."""
    lean = np.hypot(*truth.lean(phase).T)
    noise = np.random.default_rng((seed, 99)).normal(size=len(phase))
    return PlateTrack(phase, lean + sigma * noise, np.full(len(phase), sigma), True)


def off(fitted, truth):
    """Return how far numbers are off, by name."""
    names = ("tilt", "phase_offset", "major_axis", "ellipticity")
    errors = {name: getattr(fitted, name) - getattr(truth, name) for name in names}
    errors |= {f"centre_{a}": fitted.centre[k] - truth.centre[k] for k, a in enumerate("xy")}
    return errors | {f"pivot_{a}": fitted.pivot[k] - truth.pivot[k] for k, a in enumerate("xyz")}


def assert_within_errors(fitted, truth, *names, limit=4.0):
    errors = off(fitted, truth)
    strays = {name: errors[name] for name in names if abs(errors[name]) > limit * fitted.sigma[name]}
    assert not strays


@pytest.mark.parametrize("direction", [1, -1])
def test_a_flat_and_a_ball_determine_the_precession(direction):
    truth = precession(
        direction=direction, ellipticity=0.02, major_axis=0.4, centre=(0.1 * DEGREE, -0.2 * DEGREE)
    )
    scale = scale_of(TALL)
    ball = track_ball(ball_turn(truth, 0.2, -0.1, body=TALL, seed=4), RADIUS, scale)
    plate = track_plate(plate_turn(truth, body=TALL, seed=3), True, scale)
    assert plate.zenith == pytest.approx(np.hypot(*truth.lean(EIGHTHS).T), abs=0.02 * DEGREE)
    assert (plate.sigma < 0.01 * DEGREE).all()
    fit = fit_precession([ball], [plate])
    fitted, errors = fit.precession, off(fit.precession, truth)
    assert fitted.direction == direction
    assert abs(errors["tilt"]) < 0.02 * DEGREE
    assert abs(errors["phase_offset"]) < 0.1 * DEGREE
    assert abs(errors["pivot_z"]) < 1.0
    assert fitted.sigma["ellipticity"] < 0.002
    assert fitted.sigma["centre_x"] < 0.01 * DEGREE
    names = "tilt", "phase_offset", "centre_x", "centre_y", "pivot_z", "ellipticity", "major_axis"
    assert_within_errors(fitted, truth, *names)
    assert fit.residual["zenith"] < 0.01 * DEGREE
    assert fit.residual["place"] < 0.005


def test_a_wedge_shows_the_half_angle_where_a_flat_is_dark():
    truth, scale = precession(direction=-1, phase_offset=-0.3), scale_of(None)
    wedge = track_plate(plate_turn(truth, thing=Flat(25 * DEGREE, 1.0), press=8.0, seed=7), False, scale)
    fitted = fit_precession([track_ball(ball_turn(truth, seed=8), RADIUS, scale)], [wedge]).precession
    assert fitted.direction == -1
    assert abs(off(fitted, truth)["tilt"]) < 0.02 * DEGREE
    assert_within_errors(fitted, truth, "tilt", "phase_offset", "pivot_z")
    assert fitted.centre == (0.0, 0.0)
    assert "centre_x" not in fitted.sigma


def test_balls_at_three_places_determine_all_but_the_mean_lean_even_a_lean_to_the_other_side():
    truth = precession(phase_offset=2.0, pivot=(0.3, -0.2, 6.0))
    shape, places = (90, 90), ((-2.2, 1.8), (2.3, 1.5), (-0.4, -2.4))
    turns = [ball_turn(truth, *place, shape=shape, seed=n) for n, place in enumerate(places)]
    fit = fit_precession([track_ball(turn, RADIUS, scale_of(None, shape)) for turn in turns])
    assert abs(off(fit.precession, truth)["tilt"]) < 0.1 * DEGREE
    assert_within_errors(fit.precession, truth, "tilt", "phase_offset", "pivot_x", "pivot_y", "pivot_z")
    assert fit.notes == ("the mean pose is assumed to be upright: a level plate would show the mean lean",)


def test_with_one_ball_the_side_of_the_pivot_is_an_assumption():
    truth = precession(pivot=(0.0, 0.0, -8.0))
    fit = fit_precession([ball_track(truth, (0.0, 0.0, -1.5))], [plate_track(truth)], depth_sigma=3.0)
    assert fit.precession.phase_offset == pytest.approx(truth.phase_offset, abs=5e-3)
    assert fit.precession.pivot[2] == pytest.approx(-8.0, abs=0.05)
    assert fit.precession.sigma["pivot_z"] == pytest.approx(3.0, abs=0.1)
    assert any("within 90 deg of 0" in note for note in fit.notes)


def test_standard_errors_are_those_of_the_errors():
    truth = precession(ellipticity=0.02, major_axis=0.4, centre=(2e-3, -1e-3), direction=-1)
    shares = []
    for seed in range(6):
        balls = [ball_track(truth, (0.5, 0.2, -1.5), seed), ball_track(truth, (-2.0, 3.0, -1.5), seed)]
        fitted = fit_precession(balls, [plate_track(truth, seed)]).precession
        shares += [error / fitted.sigma[name] for name, error in off(fitted, truth).items()]
    assert np.sqrt(np.mean(np.square(shares))) == pytest.approx(0.95, abs=0.25)
    assert np.max(np.abs(shares)) < 5


def test_errors_that_are_stated_too_small_are_estimated_again():
    balls = [ball_track(precession(), (3 * k, k, -1.5), 1) for k in (-1, 1)]
    daring = [ball._replace(sigma=ball.sigma / 10) for ball in balls]
    honest, again = (fit_precession(some).precession.sigma for some in (balls, daring))
    for name in ("tilt", "phase_offset"):
        assert again[name] == pytest.approx(honest[name], rel=0.2)


def test_a_wrong_frame_hardly_matters():
    truth = precession()
    ball = ball_track(truth, (0.5, 0.2, -1.5), 2)
    ball.centres[3] += 0.2
    ball.centres[6] = np.nan
    fitted = fit_precession([ball], [plate_track(truth)]).precession
    assert abs(off(fitted, truth)["phase_offset"]) < 0.5 * DEGREE
    assert abs(off(fitted, truth)["pivot_z"]) < 0.1


def test_phases_may_be_uneven_and_more_than_a_turn():
    truth = precession(direction=-1)
    phase = np.concatenate([np.radians([178.1, 220.8, 280.5, 316.5, 7.6, 48.0, 96.3, 136.4]), EIGHTHS + 6.0])
    ball, plate = ball_track(truth, (0.1, 0.2, -1.5), phase=phase), plate_track(truth, phase=phase)
    fitted = fit_precession([ball], [plate]).precession
    assert fitted.direction == -1
    assert_within_errors(fitted, truth, "tilt", "phase_offset", "pivot_z")


def test_what_does_not_determine_a_precession_is_refused():
    truth, place = precession(), (0.5, 0.2, -1.5)
    with pytest.raises(InputError, match=r"half-angle is not determined: a ball at one place.* add a turn"):
        fit_precession([ball_track(truth, place)])
    with pytest.raises(InputError, match=r"half-angle \(2\.53. deg\), but neither phases .* nor pivot: add"):
        fit_precession([], [plate_track(truth)])
    with pytest.raises(InputError, match="add a turn on a ball"):
        fit_precession([])
    still = precession(pivot=place)
    with pytest.raises(InputError, match="hardly moves"):
        fit_precession([ball_track(still, place)], [plate_track(still)])


def test_an_unknown_depth_leaves_the_pivot_across_the_axis_undetermined():
    truth = precession()
    fit = fit_precession([ball_track(truth, (0.5, 0.2, -1.5), sigma=(8e-3, 8e-3, 0.5))], [plate_track(truth)])
    assert np.isnan(fit.precession.pivot[:2]).all()
    assert fit.precession.pivot[2] == pytest.approx(truth.pivot[2], abs=3.0)
    assert "the pivot's x is not determined" in fit.notes


# --- tracks -------------------------------------------------------------------------------------------------


def test_a_ball_is_placed_within_its_errors_whatever_its_pixels_gains():
    truth = precession()
    camera = Camera(noise=1.5, seed=9, gain_deviation=0.05, offset_deviation=1.0)
    turn = ball_turn(truth, 0.31, -0.17, camera=camera)
    track = track_ball(turn, RADIUS, scale_of(None, camera=camera))
    error = track.centres - moved((0.31, -0.17, DEPTH - RADIUS), truth.lean(EIGHTHS), truth.pivot)
    assert (track.sigma[:, :2] < 2e-3).all()
    assert np.sqrt(np.mean((error / track.sigma)[:, :2] ** 2)) < 1.5
    assert np.abs(error[:, 2]).max() < 0.03


@pytest.mark.parametrize(
    "options",
    [{"depth": 0.9, "stated_depth": 0.9}, {"depth": 0.6, "contact": "elastic", "stated_depth": 0.6}],
    ids=["the wall ends first", "the gel gives way"],
)
def test_an_outline_that_is_not_the_contacts_gives_no_depth(options):
    track = track_ball(ball_turn(precession(), **options), RADIUS, scale_of(None))
    assert (track.sigma[:, 2] > 0.4).all()
    assert (track.sigma[:, :2] < 5e-3).all()


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
    light = WallBrightness.of_pixels(wall(shape), 16.0, 224.0, shape, PIXEL)
    turn = ball_turn(truth, *place, shape=shape, optics="cylinder", depth=0.5)
    track = track_ball(turn, RADIUS, light)
    error = track.centres - moved((*place, 0.5 - RADIUS), truth.lean(EIGHTHS), truth.pivot)
    assert (track.sigma[:, :2] < 2e-3).all()
    assert (track.sigma[:, 2] < 0.05).all()
    assert np.sqrt(np.mean((error / track.sigma) ** 2)) < 1.6
    with pytest.raises(InputError, match="linear in it: give the zenith gain and offset, or take balls"):
        track_plate(turn, True, light)


def test_turns_that_cannot_be_used_are_refused():
    scale, dark = scale_of(None, (30, 30)), np.full((8, 30, 30), 16, np.uint8)
    no_phase = Frames(dark, Header("axial", pixel_size=PIXEL), "turn")
    long = recording("turn", np.broadcast_to(dark[:1, :1, :1], (5000, 1000, 1000)))
    vertical = Frames(dark, Header("vertical", pixel_size=PIXEL), "turn", travel=EIGHTHS)
    for source, radius, message in (
        (vertical, 2.0, "turn is of vertical motion"),
        (recording("turn", dark, pixel_size=None), 2.0, "turn has no pixel size: calibrate the scale first"),
        (recording("turn", dark), 0.0, "the ball.s diameter is 0 mm"),
        (long, 2.0, r"turn: 5\.0 GB of frames are too much"),
        (no_phase, 2.0, "turn has no phases"),
        (recording("turn", dark[:3], EIGHTHS[:3]), 2.0, "turn: 3 different phases, at least 4 are needed"),
        (recording("turn", dark), 2.0, "turn: a ball of 4 mm is seen in 0 of 8 frames"),
    ):
        with pytest.raises(InputError, match=message):
            track_ball(source, radius, scale)
    with pytest.raises(InputError, match=r"turn: no flat plate is seen.* take a wedge"):
        track_plate(recording("turn", dark), True, scale)


# --- brightness ---------------------------------------------------------------------------------------------


def test_a_wall_needs_references_and_a_graded_pattern_and_has_an_error_of_depth():
    with pytest.raises(InputError, match="no dark and bright references"):
        WallBrightness.of_pixels(wall(SHAPE), None, None, SHAPE, PIXEL)
    with pytest.raises(InputError, match="of a uniform pattern, without zeniths"):
        WallBrightness.of_pixels(replace(wall(SHAPE), pattern="uniform"), 16.0, 224.0, SHAPE, PIXEL)
    vague = replace(wall(SHAPE), zenith_sigma=np.full(SHAPE, 5e-4, np.float32))
    assert WallBrightness.of_pixels(vague, 16.0, 224.0, SHAPE, PIXEL).depth_sigma == pytest.approx(0.05)
    assert scale_of(None).depth_sigma == 0


def test_clipped_samples_and_pixels_without_gain_contain_no_information():
    header = Header("axial", zenith_gain=np.array([[100.0, 0.0, 200.0]]), zenith_offset=np.array(20.0))
    light, pixels = LinearBrightness.of_header(header, (1, 3)), np.arange(3)
    zenith = light.of_counts(np.array([[120, 120, 220], [0, 30, 255]], np.uint8), pixels)
    assert zenith[0, [0, 2]].tolist() == [1.0, 1.0]
    assert np.isnan(zenith[:, 1]).all()
    assert np.isnan(zenith[1]).all()
    assert light.of_counts(np.array([0.0, 0.0, 255.0]), pixels)[2] == pytest.approx(235 / 200)
    with pytest.raises(InputError, match="no zenith gain and offset"):
        LinearBrightness.of_header(Header("axial"), SHAPE)


def test_the_line_is_trusted_within_the_references_alone():
    header = Header(
        "axial",
        zenith_gain=np.array(-100.0),
        zenith_offset=np.array(100.0),
        dark=np.full((1, 2), 20.0, np.float32),
        bright=np.full((1, 2), 90.0, np.float32),
    )
    light, nothing = LinearBrightness.of_header(header, (1, 2)), np.zeros((1, 1))
    low, high = (leaning(0.0, angle, 0.0).turn[np.newaxis, np.newaxis, :, 2] for angle in (0.12, 0.5))
    zenith, within = light.of_normals(low, nothing, np.array([0]))
    assert zenith[0, 0] == pytest.approx(0.12)
    assert not within[0, 0]
    assert light.of_normals(high, nothing, np.array([1]))[1][0, 0]
