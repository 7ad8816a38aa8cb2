"""Sigma is the standard deviation of the heights, compared with dense algebra in float64."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse
from slope_oracle import Problem, build, centred

from mirrorskin import engine

SHAPE = 32, 36
FLAT = np.zeros(SHAPE)
ROW, COLUMN = np.indices(SHAPE)
DISTANCE = np.hypot(ROW - 15.5, COLUMN - 17.5)
LEFT = np.where(COLUMN < 9, 0.0, np.nan)


def exact_variance(problem):
    """The heights' variance by dense algebra, where the weights are inverse variances."""
    graph = build(problem)
    weighted = graph.difference.T @ sparse.diags(graph.weight)
    matrix = (weighted @ graph.difference).toarray() + np.diag(graph.pull)
    for label in np.flatnonzero(graph.free):
        member = (graph.label == label).astype(float)
        matrix += np.outer(member, member)
    weights = np.broadcast_to(
        1.0 if problem.slope_weights is None else problem.slope_weights, (2, *SHAPE)
    ).reshape(-1)
    moves = weighted @ graph.reading @ sparse.diags(1 / np.sqrt(np.where(weights > 0, weights, 1)))
    moves = sparse.hstack([moves, sparse.diags(np.sqrt(graph.pull))])
    variance = np.sum(centred(graph, np.linalg.inv(matrix) @ moves) ** 2, axis=1)
    picture = np.full(SHAPE, np.nan)
    picture[graph.pixel >= 0] = variance
    return picture


RANDOM = np.random.default_rng(1)
EDGES = (ROW == 12) & (COLUMN < 20)
CAP = np.exp(1.5 * np.stack([np.cos(COLUMN / 8), np.sin(ROW / 7)]))  # as of normals: along x not as along y

# Options, the pixel's size, how far from 1 the mean may be, and the share of pixels off by more than a tenth.
SCENES = {
    "rectangle": ({}, (1.0, 1.0), 0.01, 0.0),
    "rectangle of long pixels": ({}, (0.5, 2.0), 0.01, 0.0),
    "heights known all over": ({"known_heights": FLAT, "known_height_weights": 0.05}, (1.0, 1.0), 0.01, 0.0),
    "annulus": ({"mask": (DISTANCE < 15) & (DISTANCE > 7)}, (1.0, 1.0), 0.04, 0.07),
    "disc of long pixels": ({"mask": DISTANCE < 15}, (1.0, 2.5), 0.04, 0.08),
    "cut": ({"edges": EDGES}, (1.0, 1.0), 0.03, 0.06),
    "heights known on the left": (
        {"known_heights": LEFT, "known_height_weights": 4.0},
        (1.0, 1.0),
        0.04,
        0.12,
    ),
    "uneven": ({"slope_weights": np.exp(RANDOM.normal(0, 0.5, SHAPE) + COLUMN / 18)}, (1.0, 1.0), 0.02, 0.06),
    "uneven along x and y": ({"slope_weights": CAP}, (1.0, 1.0), 0.03, 0.1),
    "holes at random": ({"mask": RANDOM.random(SHAPE) > 0.2}, (1.0, 1.0), 0.12, 0.5),
}


@pytest.mark.parametrize(("options", "size", "mean", "doubtful"), SCENES.values(), ids=SCENES)
def test_sigma_is_that_of_the_noise(options, size, mean, doubtful):
    problem = Problem(FLAT, FLAT, size, **options)
    sigma = engine.integrate(FLAT, FLAT, size, **{"slope_weights": 1.0, **options}).height_sigma
    exact = exact_variance(problem)
    np.testing.assert_array_equal(np.isnan(sigma), np.isnan(exact))
    some = exact > 1e-12  # a pixel alone has no error
    ratio = exact[some] / sigma[some] ** 2
    assert len(ratio) > 400
    assert np.mean(ratio) == pytest.approx(1, abs=mean)
    assert np.mean(np.abs(ratio - 1) > 0.1) <= doubtful


def test_noise_without_weights_is_estimated_from_the_misfit():
    slopes = np.random.default_rng(2).normal(0, 0.07, (2, *SHAPE))
    stated = engine.integrate(*slopes, 1.0, mask=DISTANCE < 15, slope_weights=1 / 0.07**2)
    estimated = engine.integrate(*slopes, 1.0, mask=DISTANCE < 15)
    np.testing.assert_array_equal(np.isnan(stated.height_sigma), DISTANCE >= 15)
    np.testing.assert_array_equal(np.isnan(estimated.height_sigma), DISTANCE >= 15)
    ratio = estimated.height_sigma / stated.height_sigma
    assert np.nanmedian(ratio) == pytest.approx(1, abs=0.05)
    assert np.nanstd(ratio) < 1e-4


def test_sigma_goes_with_pixel_size_and_noise():
    flat = np.zeros((9, 11))
    first = engine.integrate(flat, flat, 0.5, slope_weights=1.0).height_sigma
    second = engine.integrate(flat, flat, 0.05, slope_weights=4e6).height_sigma
    np.testing.assert_allclose(second, first / 10 / 2000, rtol=1e-4)
    assert engine.integrate(flat, flat, 0.5, sigma=False).height_sigma is None
    line = np.ones((1, 9))
    assert np.isnan(engine.integrate(line, line, 1.0).height_sigma).all()  # no loop, so no misfit
    assert np.isfinite(engine.integrate(line, line, 1.0, slope_weights=4.0).height_sigma).all()


def test_sigma_is_that_of_the_picture_not_of_the_one_before():
    disc, ring = DISTANCE < 15, (DISTANCE < 15) & (DISTANCE > 7)
    slopes = np.random.default_rng(2).normal(0, 0.07, (2, *SHAPE))
    cases = [
        {"mask": disc, "slope_weights": 1.0},
        {"mask": ring, "slope_weights": 1.0},
        {"mask": disc, "slope_weights": 4.0},
        {"mask": disc, "slope_weights": 4.0, "robust": True},
        {"mask": disc, "slope_weights": 4.0, "known_heights": LEFT},
        {"slope_weights": 4.0},
    ]
    alone = []
    for case in cases:
        engine.integrate(*slopes[:, 1:], 1.0)  # of another shape: nothing is kept
        alone.append(engine.integrate(*slopes, 1.0, **case).height_sigma)
    for case, expected in zip(2 * cases, 2 * alone, strict=True):
        np.testing.assert_array_equal(engine.integrate(*slopes, 1.0, **case).height_sigma, expected)
    np.testing.assert_array_equal(engine.integrate(*slopes, 1.0, **cases[-1]).height_sigma, alone[-1])
