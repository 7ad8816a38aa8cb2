"""From samples to a response: any print, gels that leave the ball early, presses that do not fit."""

import math

import numpy as np
import pytest
from wall_presses import light_of_response

from mirrorskin import io
from mirrorskin.engine.calibration.wall import fit_touch
from mirrorskin.engine.calibration.wall_fit import BallPress, Prior, join
from mirrorskin.engine.calibration.wall_model import (
    CURVE_COEFFICIENTS,
    SENSOR,
    LightSamples,
    SheetPoints,
    curve_means,
    light_of,
    look,
    predict,
)
from mirrorskin.engine.calibration.wall_response import make_response, threshold_zenith
from mirrorskin.evaluation.calibration.scenes import Frames
from mirrorskin.kernels.rotation.response import sight_of

NOMINAL = dict.fromkeys(SENSOR, (0.0, 3.0)) | dict.fromkeys(SENSOR[-5:], (0.0, 0.02))
NOMINAL |= {"radius": (17.5, 1.75), "rim": (40.0, 4.0), "axis_x": (0.0, 1.0), "axis_y": (0.0, 1.0)}
NOMINAL |= {"sight_0": (0.004, 0.004), "sight_2": (0.0, 3e-7), "scatter": (0.052, 0.03)}
NOMINAL |= {"phase_offset": (0.0, 0.03), "lamp_x": (0.0, 0.2), "lamp_y": (0.0, 0.2)}
TRUE = dict.fromkeys(SENSOR, 0.0) | {
    "radius": 17.1,
    "rim": 38.5,
    "axis_x": 0.3,
    "axis_y": -0.2,
    "sight_0": 0.005,
}
TRUE |= {"scatter": 0.055, "pivot_z": 2.0, "lamp_x": 0.03, "lamp_y": -0.02}
CENTRES = np.array(
    [[0.1, 0.2, -1.1], [3.6, 3.5, -1.2], [-3.7, 3.4, -1.0], [3.4, -3.7, -1.1], [-3.6, -3.5, -1.15]]
)
PHASE = np.arange(8) * np.pi / 4
LEAN = math.radians(2.5) * np.stack([np.cos(PHASE), np.sin(PHASE)], axis=1)
OFF = np.array([0.03, -0.04, 0.1])
NOISE = 4e-3
PICTURE = Frames(np.zeros((1, 12, 12), np.uint8), io.Header("axial", pixel_size=(1.0, 1.0)), "place-1")


def coefficients_of(exponent):
    fraction = np.linspace(0, 1, 400)
    basis = curve_means(fraction - 1e-6, fraction + 1e-6)[1:-1]
    return np.maximum.accumulate(
        np.maximum(np.linalg.lstsq(basis, fraction[1:-1] ** exponent, rcond=None)[0], 0)
    )


def some_presses(coefficients, balls=(2.0,) * 5, touched=1.0, each=720):
    """Return presses of balls; the sheet leaves them at that share of the outline."""
    rng = np.random.default_rng(8)
    presses = []
    for number, (centre, ball) in enumerate(zip(CENTRES, balls, strict=True), 1):
        frame = np.repeat(np.arange(8), each // 8)
        away, turn = 1.5 * np.sqrt(rng.random(each)), 2 * np.pi * rng.random(each)
        offset = away * np.stack([np.cos(turn), np.sin(turn)])
        parts = [TRUE[name] for name in SENSOR], np.diff(coefficients, prepend=0), centre
        # The light of a flatter sheet is that of a place farther in.
        apparent = offset * np.minimum(1, 1.44 * touched / away)
        samples, inner = (
            LightSamples(
                np.zeros(each), centre[:2, np.newaxis] + place, frame, np.zeros(8, np.intp), LEAN, ball
            )
            for place in (offset, apparent)
        )
        light = predict(inner, np.concatenate(parts), True) + NOISE * rng.normal(size=each)
        start = centre + OFF
        outline = 1.44
        presses.append(
            BallPress(
                f"place-{number}", light, samples.place, frame, LEAN, start, np.ones(3), outline, (0, 0, 0)
            )
        )
    return presses


def nominal(uniform=False):
    mean, sigma = np.array([NOMINAL[name] for name in SENSOR]).T
    steps, free = np.zeros(CURVE_COEFFICIENTS), np.full(CURVE_COEFFICIENTS, np.inf)
    if uniform:
        steps[0], free[1:] = 1.0, 0.0
    start = (CENTRES + OFF).ravel()
    return Prior(np.concatenate([mean, steps, start]), np.concatenate([sigma, free, np.ones(15)]))


def respond(presses, uniform=False):
    touch = fit_touch(join(presses, 2.0), presses, nominal(uniform))
    return make_response(touch.fit, touch.samples, touch.noise, "uniform" if uniform else "graded", PICTURE)


def bias(response, coefficients, highest):
    """Return by how many degrees the zenith would be off all over the field."""
    rng = np.random.default_rng(1)
    place = rng.uniform(-4, 4, (2, 600))
    zenith, azimuth = np.radians(rng.uniform(17, highest, 600)), rng.uniform(-np.pi, np.pi, 600)
    z = np.full(600, 0.5)

    def true(theta):
        normal = np.stack([np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.cos(theta)])
        at, lean = look(place, TRUE)
        met = SheetPoints(*(at + z * lean), z, sight_of(lean), normal)
        return light_of(met, TRUE, coefficients), normal

    (light, normal), (more, _) = true(zenith), true(zenith + 1e-4)
    modelled, within = light_of_response(response, place, 0.5, normal.T[np.newaxis])
    return np.where(within[0], np.degrees((modelled[0] - light) * 1e-4 / (more - light)), np.nan)


def test_a_printed_gamma_is_found():
    coefficients = coefficients_of(2.2)
    response = respond(some_presses(coefficients))
    off = bias(response, coefficients, 43)
    assert np.isfinite(off).mean() > 0.75
    assert np.sqrt(np.nanmean(off**2)) < 0.1
    assert set(SENSOR) < set(response.parameters)
    assert len(response.parameters) == len(response.covariance)


def test_a_gel_that_leaves_the_ball_early_teaches_nothing_wrong():
    coefficients = coefficients_of(1.0)
    response = respond(some_presses(coefficients, touched=0.87))
    off = bias(response, coefficients, 33)
    assert np.sqrt(np.nanmean(off**2)) < 3 * np.degrees(np.nanmax(response.zenith_sigma))
    assert np.sqrt(np.nanmean(off**2)) < 0.4


def test_a_uniform_wall_shows_where_light_begins():
    response = respond(some_presses(np.full(CURVE_COEFFICIENTS, 0.95), each=480), uniform=True)
    assert response.curve == pytest.approx([0.95], abs=0.01)
    assert np.isnan(response.azimuth_sigma).all()
    assert np.nanmax(np.degrees(response.zenith_sigma)) < 0.2
    zenith = threshold_zenith(response, 0.3, -0.2, 0.0, 0.475 * (1 + 0.03))
    assert math.degrees(zenith) == pytest.approx(math.degrees(math.atan2(17.1, 38.5) / 2), abs=0.1)


def test_walls_with_and_without_a_print_are_distinguished():
    with pytest.raises(io.InputError, match="give --pattern uniform"):
        respond(some_presses(np.full(CURVE_COEFFICIENTS, 0.95), each=400))


def test_a_press_of_another_ball_is_named():
    presses = some_presses(coefficients_of(1.0), balls=(2.0, 2.0, 2.5, 2.0, 2.0), each=480)
    with pytest.raises(io.InputError, match="place-3: its ball does not fit to the other presses"):
        respond(presses)
