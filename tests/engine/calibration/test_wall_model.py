"""The fitted model, compared with the kernels' formula, the ball's geometry, and differences."""

import math

import numpy as np
import pytest

from mirrorskin.engine.calibration.ball import see_ball
from mirrorskin.engine.calibration.wall_fit import Prior, fit_wall, start_curve
from mirrorskin.engine.calibration.wall_model import (
    CURVE_COEFFICIENTS,
    SCALES,
    SENSOR,
    STEPS,
    LightSamples,
    SheetPoints,
    curve_from_steps,
    curve_values,
    light_of,
    linearise,
    look,
    meet_balls,
    predict,
    split,
)
from mirrorskin.kernels.rotation.response import sight_of, wall_light

TRUE = {
    "radius": 17.2,
    "rim": 39.0,
    "axis_x": 0.4,
    "axis_y": -0.3,
    "sight_0": 0.005,
    "sight_2": 1e-7,
    "scatter": 0.05,
    "pivot_x": 0.3,
    "pivot_y": -0.2,
    "pivot_z": 3.0,
    "phase_offset": 0.01,
    "lamp_x": 0.03,
    "lamp_y": -0.02,
    "shade_0": 0.01,
    "shade_1": -0.01,
    "shade_2": 0.004,
    "shade_3": 0.002,
    "shade_4": -0.006,
}
CENTRES = np.array(
    [[0.1, 0.2, -1.0], [3.8, 3.5, -1.1], [-3.7, 3.6, -0.9], [3.4, -3.9, -1.05], [-3.8, -3.5, -1.0]]
)
STEEP = np.full(CURVE_COEFFICIENTS, 0.1)
PHASE = np.arange(8) * np.pi / 4
LEAN = math.radians(2.5) * np.stack([np.cos(PHASE), np.sin(PHASE)], axis=1)


def true_parameters():
    return np.concatenate([[TRUE[name] for name in SENSOR], STEEP, CENTRES.ravel()])


def some_samples(count, seed, noise=0.0):
    rng = np.random.default_rng(seed)
    pose = rng.integers(0, 8 * len(CENTRES), count)
    away, turn = 1.45 * np.sqrt(rng.random(count)), rng.random(count) * 2 * np.pi
    place = CENTRES[pose // 8, :2].T + away * np.stack([np.cos(turn), np.sin(turn)])
    lean = np.tile(LEAN, (len(CENTRES), 1))
    samples = LightSamples(np.zeros(count), place, pose, np.repeat(np.arange(len(CENTRES)), 8), lean, 2.0)
    light = predict(samples, true_parameters(), True) + noise * rng.normal(size=count)
    return LightSamples(light, place, pose, samples.press, lean, 2.0)


def test_the_ball_is_met_where_the_shared_geometry_has_it():
    samples = some_samples(200, 1)
    named, _, centres = split(true_parameters())
    met = meet_balls(samples, {**named, "phase_offset": 0.0}, centres)
    _, lean = look(samples.place, named)
    pivot = [named[f"pivot_{axis}"] for axis in "xyz"]
    for number in range(200):
        pixel = np.concatenate([samples.place[:, number], lean[:, number]])[:, np.newaxis]
        pose = samples.pose[number]
        points = see_ball(pixel, CENTRES[pose // 8], 2.0, LEAN[pose % 8][np.newaxis], pivot)
        if points.contact[0, 0]:
            assert met.z[number] == pytest.approx(points.z[0, 0], abs=1e-12)
            np.testing.assert_allclose(met.normal[:, number], points.normal[0, 0], atol=1e-12)


def test_without_scatter_the_light_is_that_of_the_kernels_formula():
    rng = np.random.default_rng(2)
    place = rng.uniform(-6, 6, (2, 500))
    named = {**TRUE, "scatter": 1e-6, **{f"shade_{number}": 0.0 for number in range(5)}}
    from_axis, lean = look(place, named)
    z = rng.uniform(0, 1, 500)
    zenith, azimuth = np.radians(rng.uniform(15, 42, 500)), rng.uniform(-np.pi, np.pi, 500)
    normal = np.stack([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)])
    coefficients = curve_from_steps(True) @ STEEP
    modelled = light_of(SheetPoints(*(from_axis + z * lean), z, sight_of(lean), normal), named, coefficients)

    whole = math.atan2(TRUE["rim"], TRUE["radius"])
    q = np.linspace(0.0, math.tan(whole / 2), 400)
    light = curve_values(coefficients, 1 - 2 * np.arctan(q) / whole)
    powers = np.polynomial.Polynomial.fit(q, light, 11).convert().coef
    wall, within = wall_light(
        np.stack([*from_axis, z, *lean]),
        normal.T[np.newaxis],
        (TRUE["radius"], TRUE["rim"], 1e-6),
        (TRUE["lamp_x"], TRUE["lamp_y"]),
        powers,
        (q[0], q[-1]),
    )
    assert within[0].sum() > 400
    np.testing.assert_allclose(modelled[within[0]], wall[0][within[0]], atol=1e-3)


def test_slopes_are_those_of_differences():
    samples, parameters = some_samples(300, 3), true_parameters()
    light, slopes = linearise(samples, parameters, True)
    np.testing.assert_allclose(light, samples.light, atol=1e-12)
    steps = [*(SCALES[name] for name in SENSOR), *([0.1] * (len(parameters) - len(SENSOR)))]
    for number, step in enumerate(1e-5 * np.array(steps)):
        more, less = parameters.copy(), parameters.copy()
        more[number] += step
        less[number] -= step
        change = (predict(samples, more, True) - predict(samples, less, True)) / (2 * step)
        off = np.abs(change - slopes[:, number]) / np.abs(change).max()
        # Where an end of the spread ray just passes an edge of the wall, no slope is right.
        assert np.quantile(off, 0.95) < 2e-3, number


def prior_of(sigma_share=1.0):
    mean = true_parameters()
    sigma = np.concatenate(
        [[SCALES[name] for name in SENSOR], np.full(CURVE_COEFFICIENTS, np.inf), np.full(CENTRES.size, 0.5)]
    )
    return Prior(mean, sigma_share * sigma)


def test_a_fit_finds_the_curve_and_where_the_wall_stands():
    samples = some_samples(1500, 4, noise=2e-3)
    prior = prior_of()
    start = prior.mean.copy()
    start[: len(SENSOR)] += 0.5 * prior.sigma[: len(SENSOR)]
    start[STEPS] = 0
    start, rising = start_curve(samples, start)
    assert rising
    fit = fit_wall(samples, prior, start, 2e-3)
    off = (fit.parameters - prior.mean)[: len(SENSOR)]
    sigma = np.sqrt(np.diag(fit.covariance))[: len(SENSOR)]
    assert np.sqrt(np.mean((off / sigma) ** 2)) < 1.8
    assert abs(off[0]) < 0.3
    assert np.std(fit.residuals) == pytest.approx(2e-3, rel=0.1)
    fitted = curve_values(curve_from_steps(True) @ fit.parameters[STEPS], np.linspace(0.1, 0.95, 40))
    true = curve_values(curve_from_steps(True) @ STEEP, np.linspace(0.1, 0.95, 40))
    np.testing.assert_allclose(fitted, true, atol=0.02)


def test_wild_samples_hardly_matter():
    samples = some_samples(1500, 6, noise=2e-3)
    light = samples.light.copy()
    light[::25] += 0.4
    with_outliers = LightSamples(light, samples.place, samples.pose, samples.press, samples.lean, 2.0)
    prior = prior_of()
    clean, spoilt = (fit_wall(each, prior, prior.mean, 2e-3, 1e-5) for each in (samples, with_outliers))
    sigma = np.sqrt(np.diag(clean.covariance))
    free = sigma > 0
    assert np.abs((clean.parameters - spoilt.parameters)[free] / sigma[free]).max() < 3


def test_errors_of_the_fit_match_its_covariance():
    prior = prior_of()
    off = []
    for seed in range(6):
        fit = fit_wall(some_samples(700, 100 + seed, noise=5e-3), prior, prior.mean, 5e-3, 1e-5)
        sigma = np.sqrt(np.diag(fit.covariance))
        off.append(((fit.parameters - prior.mean) / np.where(sigma > 0, sigma, np.inf))[STEPS.stop :])
    assert 0.6 < np.sqrt(np.mean(np.square(off))) < 1.4
