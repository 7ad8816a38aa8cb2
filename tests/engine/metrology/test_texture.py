"""Roughness of gratings, whose parameters are known in closed form, and of noise."""

import numpy as np
import pytest
from height_maps import places
from scipy import ndimage

from mirrorskin import io
from mirrorskin.engine.metrology import roughness
from mirrorskin.engine.metrology.filters import Gaussian

NAN = np.nan


def grating(shape=(120, 161), size=(0.02, 0.03), length=0.4, amplitude=0.005):
    """Return waves across x, so many whole ones that the picture holds; the border's pixels are half ones."""
    x, _ = places(shape, size)
    return amplitude * np.cos(2 * np.pi * x / length)


def test_a_cosine_grating_has_its_closed_form():
    # 8 whole waves of 20 pixels.
    result = roughness(grating((31, 160)), (0.02, 0.03))
    assert result.sa.value == pytest.approx(5 * 2 / np.pi, rel=5e-3)  # 20 samples a wave
    fine = roughness(grating((31, 1600), (0.002, 0.03)), (0.002, 0.03))
    assert fine.sa.value == pytest.approx(5 * 2 / np.pi, rel=1e-3)
    assert fine.sq.value == pytest.approx(5 / np.sqrt(2), rel=1e-3)
    assert fine.sz.value == pytest.approx(10, rel=1e-3)
    assert fine.pixels == 31 * 1600


def test_two_levels_have_their_closed_form():
    height = np.zeros((10, 20))
    height[:, :5] = 0.004  # a quarter of it: 3 um above the mean, the rest 1 below
    result = roughness(height, (1.0, 1.0))
    assert (result.sa.value, result.sq.value, result.sz.value) == pytest.approx((1.5, np.sqrt(3), 4))


@pytest.mark.parametrize("transmission", [0.5, 2.0])
@pytest.mark.parametrize("upright", [False, True])
def test_the_filter_has_the_transmission_of_the_standard(transmission, upright):
    # ISO 16610-61: of a wave of length l, exp(-pi (alpha cutoff / l)^2) goes into the long waves.
    height, size = grating((301, 303), (0.02, 0.02)), (0.02, 0.02)
    if upright:
        height, size = np.ascontiguousarray(height.T), (0.02, 0.02)
    cutoff = 0.4 / transmission
    chain = Gaussian.of(np.ones(height.shape, bool), size, cutoff)
    inside = chain.weight > 0.9999
    passed = 1 - np.exp(-np.log(2) / transmission**2)
    assert np.ptp((height - chain.long_waves(height))[inside]) == pytest.approx(0.01 * passed, rel=2e-3)
    assert roughness(height, size, l_filter=cutoff).left_out == 0


def test_a_filter_keeps_planes_at_ends_and_holes():
    x, y = places((60, 80), (0.02, 0.03))
    measured = (np.hypot(x, y) < 0.85) & (np.hypot(x - 0.3, y) > 0.2)
    plane = np.where(measured, 7.0 + 0.3 * x - 0.2 * y, NAN)
    for level, tolerance in ((False, 1e-6), (True, np.inf)):
        smooth = Gaussian.of(measured, (0.03, 0.02), 0.5).long_waves(plane, level=level)
        assert np.abs(smooth - plane)[measured].max() < tolerance


@pytest.mark.parametrize("round_field", [False, True])
@pytest.mark.parametrize("cutoff", [0.3, 0.8])
def test_the_whole_field_counts_and_its_edges_are_as_uncertain_as_they_are(cutoff, round_field):
    size, chi2 = (0.01, 0.01), {}
    x, y = places((120, 160), size)
    measured = (np.hypot(x / 0.78, y / 0.58) < 1) if round_field else np.ones(x.shape, bool)
    for seed in range(8):
        white = np.random.default_rng(seed).standard_normal((2, 360, 400))
        large = ndimage.gaussian_filter(white[0], 3, mode="wrap")
        large += 12 * ndimage.gaussian_filter(white[1], 12, mode="wrap")
        large *= 1e-3 / large.std()
        waves = Gaussian.of(np.ones(large.shape, bool), size, cutoff).long_waves(large)
        field = slice(120, 240), slice(120, 280)
        true = roughness(np.where(measured, (large - waves)[field], NAN), size).parameters
        found = roughness(np.where(measured, large[field], NAN), size, l_filter=cutoff)
        assert found.left_out == 0
        for name in ("Sa", "Sq", "Sk", "Vmc", "Sal"):
            error = found.parameters[name].value - true[name].value
            chi2.setdefault(name, []).append((error / found.budget[name]["filter edges"]) ** 2)
    medians = {name: np.median(values) for name, values in chi2.items()}
    assert all(0.1 < value < 2.5 for value in medians.values()), medians


def test_the_filter_takes_sizes_along_x_and_y_for_what_they_are():
    x, y = places((151, 401), (0.01, 0.04))
    for wave in (x, y):
        result = roughness(0.005 * np.cos(2 * np.pi * wave / 0.8), (0.01, 0.04), l_filter=0.8)
        assert result.sz.value == pytest.approx(5, rel=5e-3)


def test_a_hole_is_not_taken_for_a_height():
    height = 7.0 + grating()
    height[60, 80] = NAN
    result = roughness(height, (0.02, 0.03), l_filter=0.8)
    assert result.sz.value < 12


def test_noise_changes_sq_by_no_more_than_its_uncertainty():
    rng = np.random.default_rng(5)
    height = grating()
    error = 0.001 * rng.standard_normal(height.shape)
    sigma = np.full(height.shape, np.sqrt(np.mean(error**2)))
    true, noisy = (roughness(heights, (0.02, 0.03), sigma=sigma) for heights in (height, height + error))
    for name in ("sa", "sq", "sz"):
        first, other = getattr(noisy, name), getattr(true, name)
        assert abs(first.value - other.value) <= 2 * first.sigma
    assert noisy.parameters["Sq of noise"].value == pytest.approx(1e3 * sigma[0, 0], rel=0.01)


@pytest.mark.parametrize(("fraction", "left_out"), [(0.1, True), (0.2, False)])
def test_pixels_that_are_far_less_certain_are_left_out_if_they_are_few(fraction, left_out):
    height, sigma = grating((30, 100), (0.02, 0.03)), np.full((30, 100), 1e-4)
    few = slice(0, round(30 * fraction))
    height[few], sigma[few] = height[few] + 0.5, 0.1
    result = roughness(height, (0.02, 0.03), sigma=sigma)
    assert (result.sz.value < 11) == left_out
    assert result.uncertain == (300 if left_out else 0)
    assert result.pixels == 3000 - result.uncertain


def test_what_has_no_roughness_is_refused():
    with pytest.raises(io.InputError, match="no height"):
        roughness(np.full((3, 3), NAN), (0.1, 0.1))
    with pytest.raises(io.InputError, match="shorter than two pixels"):
        roughness(np.zeros((30, 30)), (0.1, 0.2), l_filter=0.3)
    for cutoff in (5.0, 1e6):
        with pytest.raises(io.InputError, match="too long for this surface"):
            roughness(np.zeros((30, 30)), (0.1, 0.1), l_filter=cutoff)
