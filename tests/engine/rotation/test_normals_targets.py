"""Normals from axial rotations, against the statistical limit (evaluation/scenes/rotations.py)."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from mirrorskin import engine
from mirrorskin.evaluation.scenes import rotations
from mirrorskin.evaluation.scenes.rotations import BINS, SETUPS, TILT, UNEVEN, Setup

DRAWS = 10_000
# So little noise that an estimate's own curvature, of second order in it, is no bias that one could see.
CALM = Setup(gain=60.0, noise=3.0, offset=150.0, dtype="uint16")
FLOATS = replace(CALM, dtype="float32")


@cache
def drawn(name):
    return rotations.draw(SETUPS[name], DRAWS, seed=1)


def estimate(frames, setup, device, **options):
    """Estimate with what a lab knows: phases, tilt, gain, offset, and the noise of a sample."""
    arguments = {"noise": setup.spread, "device": device, **options}
    return rotations.estimate(
        frames, setup.phase, tilt=setup.tilt, zenith_gain=setup.slope, zenith_offset=setup.offset, **arguments
    )


@pytest.fixture(scope="module", params=SETUPS)
def answered(request, device):
    """What the exact method makes of thousands of draws a bin, and the score of it."""
    stack = drawn(request.param)
    normals = estimate(stack.frames, stack.setup, device)
    return normals, rotations.scores(normals.normals, normals.normals_sigma, stack), stack


def test_the_exact_method_reaches_the_bound_in_every_bin_and_sigma_is_true(answered):
    normals, scores, stack = answered
    np.testing.assert_allclose(scores.ratio, 1, rtol=0, atol=0.05)
    np.testing.assert_allclose(scores.chi_square, 1, rtol=0, atol=0.05)
    assert normals.contact.shape == stack.bound.shape
    assert np.all(np.mean(normals.contact == 0, axis=1) <= 0.01)


@pytest.mark.parametrize("noise", [None, 1.0])
def test_frames_without_noise_are_answered_exactly(device, noise):
    setup = replace(SETUPS["float32"], noise=0.0, offset=10.0)
    normals = rotations.random_normals(300, seed=2)
    normals[0, :8] = rotations.axes(setup.phase, TILT)  # a sample's own axis, where its angle has no slope
    normals[0, 8:16] = rotations.direction(2 * TILT, setup.phase)
    result = estimate(rotations.expose(normals, setup, seed=2), setup, device, noise=noise)
    assert np.degrees(rotations.between(result.normals.astype(float), normals)).max() <= 0.01
    np.testing.assert_allclose(np.linalg.norm(result.normals, axis=-1), 1, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "phase"), [("uint8", rotations.EIGHTHS), ("uint16", UNEVEN), ("float32", UNEVEN)]
)
def test_the_paper_method_is_equations_16_to_22(device, name, phase):
    setup = replace(SETUPS[name], phase=phase)
    stack = rotations.draw(setup, 500, seed=3)
    expected = rotations.paper(stack.frames, setup)
    result = estimate(stack.frames, setup, device, method="paper")
    swings = expected.modulation > 1e-5  # without a swing there is no direction to tell
    assert np.mean(swings) > 0.99
    np.testing.assert_allclose(result.zenith[swings], expected.zenith[swings], rtol=0, atol=1e-5)
    turned = result.azimuth.astype(float) - expected.azimuth
    turned = np.abs(np.arctan2(np.sin(turned), np.cos(turned)))
    assert np.all(turned[swings] <= 1e-5 * TILT / expected.modulation[swings])


def test_the_paper_method_fails_as_the_errata_describe(device):
    stack = drawn("float32")
    score = rotations.scores(estimate(stack.frames, stack.setup, device, method="paper").normals, None, stack)
    assert np.all(score.ratio[1:6] > 3)  # at and below the tilt
    assert np.all(score.ratio[-6:] < 1.05)  # far above


UNUSUAL = {
    "uneven phases, one frame missing": (replace(CALM, phase=UNEVEN), "weight"),
    "one frame left out": (CALM, "left out"),
    "one sample missing, any": (FLOATS, "nan"),
}


@cache
def unusual(case):
    return rotations.draw(UNUSUAL[case][0], 2500, seed=4)


def without_one(stack, how, device):
    """Estimate without one frame, or one sample of each pixel; return the bound of what is left, too."""
    frames, setup, options = stack.frames.copy(), stack.setup, {}
    weight = np.ones(frames.shape)
    if how == "weight":
        frames[3], weight[3] = 0, 0
        options = {"frame_weights": weight[:, 0, 0]}
    elif how == "nan":
        lost = np.random.default_rng(0).integers(0, 8, (1, *stack.bound.shape))
        np.put_along_axis(frames, lost, np.nan, axis=0)
        np.put_along_axis(weight, lost, 0, axis=0)
    elif how == "left out":
        frames, weight = np.delete(frames, 3, axis=0), np.delete(weight, 3, axis=0)
        setup = replace(setup, phase=tuple(np.delete(setup.phase, 3)))
    return estimate(frames, setup, device, **options), rotations.bound(stack.normals, setup, weight)


@pytest.mark.parametrize("case", UNUSUAL)
def test_uneven_phases_and_missing_frames_cost_what_they_must_and_no_bias(device, case):
    stack = unusual(case)
    normals, best = without_one(stack, UNUSUAL[case][1], device)
    assert np.all(np.abs(rotations.mean_error(normals.normals, stack)) < 4)
    scores = rotations.scores(normals.normals, normals.normals_sigma, stack._replace(bound=best))
    np.testing.assert_allclose(scores.ratio, 1, atol=0.06)
    np.testing.assert_allclose(scores.chi_square, 1, atol=0.12)


@cache
def clipped(side):
    """Draw normals of which about one sample of eight is beyond what is linear."""
    setup = replace(CALM, noise=1.5)
    normals = rotations.random_normals(2500, seed=5, bins=BINS[2:])  # upright, all samples are alike
    each = np.sort(rotations.levels(normals, setup), axis=0)
    ends = {"low": np.ceil(each[:2].mean(axis=0)), "high": np.floor(each[-2:].mean(axis=0))}
    setup = replace(setup, **{side: ends[side]})
    best = rotations.bound(normals, setup, rotations.clipped_share(normals, setup))
    return rotations.Stack(rotations.expose(normals, setup, seed=5), normals, setup, best)


@pytest.mark.parametrize("side", ["low", "high"])
def test_a_clipped_frame_is_no_bias(device, side):
    stack = clipped(side)
    lost = np.mean(stack.frames == getattr(stack.setup, side), axis=(0, 2)) * 8
    assert np.all((lost > 0.9) & (lost < 1.6)), lost
    end = "dark" if side == "low" else "bright"
    normals = estimate(stack.frames, stack.setup, device, **{end: getattr(stack.setup, side)})
    assert np.all(np.abs(rotations.mean_error(normals.normals, stack)) < 4)
    scores = rotations.scores(normals.normals, normals.normals_sigma, stack)
    np.testing.assert_allclose(scores.ratio, 1, atol=0.08)
    np.testing.assert_allclose(scores.chi_square, 1, atol=0.2)


@cache
def tilted(name, tilt):
    setup = replace(SETUPS[name], tilt=float(np.radians(tilt)))
    stack = rotations.draw(setup, 200, seed=7, bins=[(0, 55)] * 200)
    return stack, rotations.tilt_bound(stack.normals, setup)


@pytest.mark.parametrize(("name", "tilt"), [("uint8", 2.5), ("float32", 4.0)])
def test_an_unknown_tilt_is_reported_within_its_own_error(device, name, tilt):
    stack, error = tilted(name, tilt)
    setup = stack.setup
    assert error < 1e-3 * setup.tilt
    result = engine.estimate_normals(
        stack.frames,
        setup.phase,
        tilt="estimate",
        zenith_gain=setup.slope,
        zenith_offset=setup.offset,
        noise=setup.spread,
        device=device,
    )
    assert result.process["tilt"] == pytest.approx(setup.tilt, abs=4 * error)
    scores = rotations.scores(result.normals.reshape(1, -1, 3), None, flat(stack))
    assert scores.ratio[0] <= 1.05


def flat(stack):
    return stack._replace(normals=stack.normals.reshape(1, -1, 3), bound=stack.bound.reshape(1, -1))
