"""Planes and spheres through surfaces that are known, and how sure they are where errors go together."""

import numpy as np
import pytest
from height_maps import cap, places
from scipy import ndimage

from mirrorskin import io
from mirrorskin.engine.metrology import fit_plane, fit_polynomial, fit_sphere

SHAPE, SIZE = (39, 51), (0.11, 0.13)
NAN = np.nan


def axes(shape=SHAPE, size=SIZE):
    return io.pixel_axes(shape, size)


def leaning(p=0.3, q=-0.4, offset=2.0):
    x, y = places(SHAPE, SIZE)
    return offset + p * x + q * y


def noise(shape, kind, rng):
    """Return errors of variance 1: white, alike over pixels, or as noise of slopes integrates to."""
    if kind == "white":
        return rng.standard_normal(shape)
    wide = 2 * max(shape)
    white = rng.standard_normal((wide, wide))
    if kind == "alike":
        far = ndimage.gaussian_filter(white, 4.0, mode="wrap") * 4.0 * np.sqrt(4 * np.pi)
    else:
        wave = np.hypot(np.fft.fftfreq(wide)[:, np.newaxis], np.fft.rfftfreq(wide))
        wave[0, 0] = np.inf
        spread = np.sqrt(
            np.mean(np.hypot(np.fft.fftfreq(wide)[:, np.newaxis], np.fft.fftfreq(wide))[1:] ** -2)
        )
        far = np.fft.irfft2(np.fft.rfft2(white) / wave) / spread
    return far[: shape[0], : shape[1]]


def test_a_plane_is_found_exactly():
    plane = fit_plane(leaning(), *axes())
    assert plane.tilt.value == pytest.approx(np.degrees(np.arctan(0.5)))
    assert plane.azimuth.value == pytest.approx(np.degrees(np.arctan2(0.4, -0.3)))  # downhill
    assert plane.offset.value == pytest.approx(2.0)
    assert plane.rms.value == pytest.approx(0, abs=1e-9)
    assert max(plane.tilt.sigma, plane.offset.sigma) < 1e-9
    assert plane.outliers == 0
    height = np.zeros(SHAPE)
    height[:10] = 1.0
    assert fit_plane(height, *axes()).outliers == 0  # a quarter of the surface


def test_distances_from_a_plane_are_at_right_angles_to_it():
    height = leaning()
    height[5, 7] += 0.02
    plane = fit_plane(height, *axes(), robust=True)
    assert plane.outliers == 1
    assert plane.residual[5, 7] == pytest.approx(0.02 * np.cos(np.arctan(0.5)))
    assert np.count_nonzero(abs(plane.residual) > 1e-9) == 1


def test_a_plane_is_that_of_least_squares_unless_it_is_robust():
    height = leaning() + np.random.default_rng(2).normal(0, 0.001, SHAPE)
    height[3:6, 40:45] += 0.5
    x, y = places(SHAPE, SIZE)
    rows = np.stack([np.ones(x.size), x.ravel(), y.ravel()], axis=1)
    (_, p, q), *_ = np.linalg.lstsq(rows, height.ravel())
    plain, robust = (fit_plane(height, *axes(), robust=robust) for robust in (False, True))
    assert plain.tilt.value == pytest.approx(np.degrees(np.arctan(np.hypot(p, q))), rel=1e-9)
    assert robust.tilt.value == pytest.approx(np.degrees(np.arctan(0.5)), rel=1e-4)
    assert plain.outliers == robust.outliers == 15
    assert abs(plain.tilt.value - robust.tilt.value) < 3 * plain.tilt.sigma


@pytest.mark.parametrize("degree", [2, 3, 4])
def test_a_polynomial_is_found_exactly_and_leaves_what_is_of_a_higher_degree(degree):
    x, y = places(SHAPE, SIZE)
    height = 2 + 0.1 * x - 0.02 * x * y + 0.03 * x**degree - 0.01 * x * y ** (degree - 1)
    found = fit_polynomial(height, *axes(), degree=degree)
    assert found.rms.value == pytest.approx(0, abs=1e-6)
    assert found.range.value == pytest.approx(np.ptp(height), rel=1e-9)
    more = fit_polynomial(height + 0.01 * np.sin(40 * x), *axes(), degree=degree)
    assert more.rms.value == pytest.approx(10 / np.sqrt(2), rel=0.05)
    with pytest.raises(io.InputError, match="no polynomial"):
        fit_polynomial(height[:1], *io.pixel_axes((1, SHAPE[1]), SIZE), degree=degree)


@pytest.mark.parametrize("degree", [2, 4])
@pytest.mark.parametrize("kind", ["white", "alike", "integrated"])
def test_uncertainties_of_a_polynomial_cover_what_went_wrong(kind, degree):
    rng, (x, y) = np.random.default_rng(3), places(SHAPE, SIZE)
    true = 0.05 * x + 0.02 * x**2 - 0.01 * x * y
    range_, field = [], []
    for _ in range(30):
        height = true + 0.001 * noise(SHAPE, kind, rng)
        found = fit_polynomial(height, *axes(), np.full(SHAPE, 0.001), degree=degree)
        range_.append(((found.range.value - np.ptp(true)) / found.range.sigma) ** 2)
        variance = sum(error**2 for error in found.errors)
        field.append(np.mean((height - found.residual - true) ** 2) / np.mean(variance))
    assert 0.3 < np.mean(range_) < 2
    assert 0.3 < np.mean(field) < 2


def test_a_level_plane_falls_nowhere():
    plane = fit_plane(np.full(SHAPE, 3.0), *axes())
    assert (plane.tilt.value, plane.offset.value) == pytest.approx((0, 3))
    assert plane.azimuth.sigma > 100


@pytest.mark.parametrize("zenith", [1, 60])
@pytest.mark.parametrize("side", [1, -1])
def test_a_sphere_is_found_exactly(zenith, side):
    width = 5 * np.sin(np.radians(zenith))
    size = tuple(width * extent / 20 for extent in (1.3, 0.8))
    centre = 0.1 * width, -0.05 * width, 0.25
    height = side * cap(SHAPE, size, 5.0, width, centre)
    sphere = fit_sphere(height, *axes(SHAPE, size))
    assert sphere.hollow == (side < 0)
    assert sphere.radius.value == pytest.approx(5.0, rel=1e-7)
    assert (sphere.x.value, sphere.y.value) == pytest.approx(centre[:2])
    assert sphere.top.value == pytest.approx(side * 0.25)
    assert sphere.z.value == pytest.approx(side * (0.25 - 5), rel=1e-7)
    assert sphere.rms.value == pytest.approx(0, abs=1e-6)


def test_holes_and_heights_without_a_sigma_do_not_count():
    height = cap(SHAPE, SIZE, 5.0, 2.5)
    sigma = np.full(SHAPE, 0.001)
    height[20:25, 30:35] = NAN
    height[10, 10:40], sigma[10, 10:40] = 7.0, NAN
    sphere = fit_sphere(height, *axes(), sigma)
    assert sphere.radius.value == pytest.approx(5.0)
    assert np.isnan(sphere.residual[10, 10:40]).all()


def test_late_heights_at_the_rim_of_visibility_do_not_spoil_the_radius():
    height = cap(SHAPE, SIZE, 5.0, 2.5) + np.random.default_rng(1).normal(0, 0.001, SHAPE)
    rim = np.isfinite(height) & np.isnan(cap(SHAPE, SIZE, 5.0, 2.38))
    assert 0.08 < rim.sum() / np.isfinite(height).sum() < 0.12
    height[rim] -= 0.7
    sigma = np.where(rim, 0.0003, 0.001)  # and they claim to be surer than others
    sphere = fit_sphere(height, *axes(), sigma)
    assert sphere.outliers == rim.sum()
    assert abs(sphere.radius.value - 5) < 3 * sphere.radius.sigma < 0.02


def test_heights_count_by_their_inverse_variance():
    height = np.zeros(SHAPE)
    height[:, 30:] = 0.01 * (places(SHAPE, SIZE)[0] + 5)[:, 30:]
    sigma = np.where(height > 0, 0.1, 0.03)
    equal, weighted = (fit_plane(height, *axes(), weights) for weights in (None, sigma))
    assert weighted.tilt.value < 0.8 * equal.tilt.value


@pytest.mark.parametrize(
    "height", [np.zeros((1, 9)), np.zeros((1, 1)), np.eye(5) + np.where(np.eye(5), 0, NAN)]
)
def test_pixels_in_one_line_make_no_form(height):
    at = io.pixel_axes(height.shape, (0.1, 0.1))
    with pytest.raises(io.InputError, match="no plane fits"):
        fit_plane(height, *at)
    with pytest.raises(io.InputError, match="no sphere fits"):
        fit_sphere(height, *at)


@pytest.mark.parametrize("height", [np.zeros((9, 9)), leaning(), np.full((3, 3), NAN)])
def test_what_is_flat_or_nothing_makes_no_sphere(height):
    with pytest.raises(io.InputError, match="no sphere fits"):
        fit_sphere(height, *io.pixel_axes(height.shape, (0.1, 0.1)))


@pytest.mark.parametrize("kind", ["white", "alike", "integrated"])
def test_uncertainties_cover_what_went_wrong(kind):
    rng = np.random.default_rng(3)
    ball, plane = cap(SHAPE, SIZE, 5.0, 2.5), leaning(0.1, 0.05, 0.0)
    sigma = np.full(SHAPE, 0.001)
    pulls = []
    for _ in range(30):
        error = 0.001 * noise(SHAPE, kind, rng)
        sphere = fit_sphere(ball + error, *axes(), sigma)
        flat = fit_plane(plane + error, *axes(), sigma)
        tilt = np.degrees(np.arctan(np.hypot(0.1, 0.05)))
        truths = (sphere.radius, 5), (sphere.x, 0), (sphere.top, 0), (flat.tilt, tilt), (flat.offset, 0)
        pulls.append([(estimate.value - true) / estimate.sigma for estimate, true in truths])
    assert (np.mean(np.abs(pulls) <= 2, axis=0) >= 0.8).all()
    radius, tilt = np.array(pulls)[:, [0, 3]].T
    # They are not covered by saying nothing, either.
    assert 0.4 < np.sqrt(np.mean(radius**2)) < 1.2
    assert 0.4 < np.sqrt(np.mean(tilt**2)) < 1.3


def test_all_heights_may_be_wrong_together():
    error = 1e-4 * np.random.default_rng(12).standard_normal(SHAPE)
    sigma = np.full(SHAPE, 0.02)
    flat = fit_plane(leaning() + error, *axes(), sigma)
    ball = fit_sphere(cap(SHAPE, SIZE, 5.0, 2.5) + error, *axes(), sigma)
    assert min(estimate.sigma for estimate in (flat.offset, ball.top, ball.z)) >= 0.02


@pytest.mark.parametrize("claimed", [0.5, 2.0])
def test_birges_ratio_is_that_of_errors_to_what_is_claimed(claimed):
    rng = np.random.default_rng(11)
    sigma = np.full(SHAPE, 0.001 * claimed)
    error = 0.001 * rng.standard_normal(SHAPE)
    for form in (
        fit_plane(leaning() + error, *axes(), sigma),
        fit_sphere(cap(SHAPE, SIZE, 5.0, 2.5) + error, *axes(), sigma),
    ):
        assert form.birge == pytest.approx(1 / claimed, rel=0.05)
    assert np.isnan(fit_plane(leaning() + error, *axes()).birge)
