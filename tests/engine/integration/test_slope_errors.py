"""Standard deviations of heights when errors of slopes are correlated, or have a gain in common."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from mirrorskin import engine

SHAPE, NOISE = (96, 110), 0.02
Y, X = (places - (size - 1) / 2 for places, size in zip(np.indices(SHAPE), SHAPE, strict=True))
HEIGHT = 10 * np.exp(-(X * X + Y * Y) / 800)
SLOPES = np.stack([-X, Y]) * HEIGHT / 400
HEIGHT -= HEIGHT.mean()
DISC = X * X + Y * Y < 46**2


def noise(reach, seed=0):
    """Return noise of slopes whose correlation is 1/e at twice the reach, pixels."""
    values = np.random.default_rng([seed, 3]).standard_normal((2, *SHAPE))
    values = gaussian_filter(values, (0, reach, reach)) if reach else values
    return NOISE * values / values.std()


def scores(slopes, **options):
    """Return errors of heights over their standard deviations."""
    surface = engine.integrate(*slopes, 1.0, **options)
    error = surface.height - HEIGHT
    for number in range(surface.component.max() + 1):
        part = surface.component == number
        error[part] = error[part] - error[part].mean() if np.count_nonzero(part) > 4 else np.nan
    return error / np.where(np.isfinite(error), surface.height_sigma, 1)


def is_honest(values):
    values = values[np.isfinite(values)]
    return np.mean(values**2) <= 2 and np.mean(np.abs(values) > 3) <= 0.02


@pytest.mark.parametrize("mask", [None, DISC], ids=["full", "disc"])
@pytest.mark.parametrize("reach", [1, 2, 4])
def test_correlated_noise_is_recognised(reach, mask):
    surface = engine.integrate(*(SLOPES + noise(reach)), 1.0, mask=mask)
    assert surface.process["slope_correlation"] == pytest.approx(2 * reach, rel=0.3)
    assert is_honest(scores(SLOPES + noise(reach), mask=mask))


@pytest.mark.parametrize("seed", range(5))
def test_independent_noise_is_not_correlated(seed):
    surface = engine.integrate(*(SLOPES + noise(0, seed)), 1.0)
    assert "slope_correlation" not in surface.process


@pytest.mark.parametrize("options", [{}, {"slope_weights": 1 / NOISE**2}], ids=["no weights", "weights"])
def test_a_stated_correlation_is_used(options):
    slopes = SLOPES + noise(2)
    assert not is_honest(scores(slopes, slope_correlation=0, **options))
    assert is_honest(scores(slopes, slope_correlation=4, **options))


@pytest.mark.parametrize("mask", [None, DISC], ids=["full", "disc"])
def test_a_gain_of_slopes_is_used(mask):
    slopes = 1.01 * SLOPES + 0.05 * noise(0)
    assert not is_honest(scores(slopes, mask=mask))
    assert is_honest(scores(slopes, mask=mask, slope_gain_sigma=0.01))


def test_a_gain_with_a_camera_scales_the_relief_of_the_depth():
    camera = engine.integration.Camera(200.0)
    normals = np.stack([0.3 * np.sin(X / 9), 0 * X, np.ones(SHAPE)], axis=-1)
    surface, other = (
        engine.integrate(normals=normals, camera=camera, slope_gain_sigma=gain) for gain in (0.0, 0.02)
    )
    added = np.sqrt(other.height_sigma**2 - surface.height_sigma**2) / surface.height
    relief = np.log(surface.height) - np.log(surface.height).mean()
    np.testing.assert_allclose(added, 0.02 * np.abs(relief), atol=1e-4)


def test_several_surfaces_have_the_largest_of_their_errors():
    slopes = np.stack([SLOPES, 3 * SLOPES], axis=1)
    surfaces = engine.integrate(*slopes, 1.0, slope_gain_sigma=0.1)
    np.testing.assert_allclose(surfaces.height_sigma, 0.3 * np.abs(HEIGHT), atol=0.02)


def grooved(angle, period, pixel=0.05):
    """Return heights and slopes of V grooves, mm, without noise, from the first pixel's corner."""
    rows, columns = np.indices(SHAPE)
    along = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
    place = (along[0] * columns - along[1] * rows) * pixel + 0.37
    place = np.mod(place, period) - period / 2
    return 0.8 * np.abs(place), 0.8 * np.sign(place) * along[:, np.newaxis, np.newaxis]


GROOVES = [(angle, period) for angle in (0, 19, 45, 69, 90) for period in (0.5, 1.0)]


@pytest.mark.parametrize("noise_of_slopes", [0.0, 1e-6])
@pytest.mark.parametrize("robust", [False, True])
@pytest.mark.parametrize("groove", GROOVES, ids=str)
def test_sigma_of_grooves_is_not_beyond_their_depth(groove, robust, noise_of_slopes):
    height, slopes = grooved(*groove)
    slopes = slopes + noise(0) / NOISE * noise_of_slopes
    surface = engine.integrate(*slopes, 0.05, robust=robust)
    assert np.isfinite(surface.height_sigma).all()
    assert surface.height_sigma.max() < np.ptp(height)


@pytest.mark.parametrize("angle", [19, 37, 69])
def test_sigma_of_oblique_grooves_is_about_the_error_at_their_creases(angle):
    height, slopes = grooved(angle, 1.0)
    surface = engine.integrate(*slopes, 0.05)
    error = np.std(surface.height - height)
    assert error / 3 < np.median(surface.height_sigma) < 3 * error


CORRIDORS = (np.indices(SHAPE) % 12 < 3).any(axis=0)
SCATTERED = np.random.default_rng(0).random(SHAPE) > 0.3
HALF = np.random.default_rng(0).random(SHAPE) > 0.5


@pytest.mark.parametrize("weight", [None, NOISE**-2, 4 * NOISE**-2], ids=["none", "true", "too large"])
@pytest.mark.parametrize(
    "mask", [None, SCATTERED, HALF, CORRIDORS], ids=["full", "70 %", "50 %", "corridors"]
)
@pytest.mark.parametrize("reach", [0, 1, 2, 4])
def test_sigma_is_true_whatever_is_missing_and_stated(reach, mask, weight):
    chi2 = [
        np.nanmean(scores(SLOPES + noise(reach, seed), mask=mask, slope_weights=weight) ** 2)
        for seed in range(4)
    ]
    assert 0.3 < np.mean(chi2) < 2


def test_understated_errors_are_reported_once():
    slopes = SLOPES + noise(0)
    surfaces = [engine.integrate(*slopes, 1.0, slope_weights=factor / NOISE**2) for factor in (0.2, 1, 4)]
    assert [surface.process.get("warnings", "")[:36] for surface in surfaces] == [
        "",
        "",
        "slopes contradict each other more th",
    ]
    np.testing.assert_allclose(surfaces[2].height_sigma, surfaces[1].height_sigma, rtol=0.05)
    assert np.mean(surfaces[0].height_sigma) > 2 * np.mean(surfaces[1].height_sigma)


def test_slopes_on_the_device_are_examined_as_well(device):
    slopes = (SLOPES + noise(2)).astype(np.float32)
    expected = engine.integrate(*slopes, 1.0, mask=SCATTERED, slope_weights=NOISE**-2, device=device)
    placed = [device.from_host("slope", slope) for slope in slopes]
    surface = engine.integrate(*placed, 1.0, mask=SCATTERED, slope_weights=NOISE**-2)
    assert surface.process["slope_correlation"] == expected.process["slope_correlation"]
    np.testing.assert_allclose(surface.height_sigma, expected.height_sigma, rtol=1e-4)


def test_too_few_slopes_to_show_a_correlation_are_noted():
    surface = engine.integrate(*(SLOPES + noise(0))[:, :6, :7], 1.0)
    assert "assumed to be independent" in surface.process["notes"]
