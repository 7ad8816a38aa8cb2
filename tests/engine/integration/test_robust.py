"""Robust integration: how its energy falls, what it does with known heights, weights, masks and edges, and
which depth discontinuities it keeps and does not invent (tests/support/steps.py).
"""

from functools import cache

import numpy as np
import pytest
import steps
from scipy import ndimage
from steps import CASES

from mirrorskin import engine


def noisy(slopes, angle, seed=0):
    """Return slopes of normals whose numbers have noise of so many radians."""
    normals = np.stack([-slopes[0], -slopes[1], np.ones_like(slopes[0])])
    normals /= np.linalg.norm(normals, axis=0)
    normals += np.random.default_rng(seed).normal(0, angle, normals.shape)
    return np.asarray(-normals[:2] / normals[2])


def ramps(rows=46, columns=96, landing=20, slopes=(0.0, 0.6, -0.4, 0.8)):
    """Return heights and slopes of ramps side by side that go down the picture from one landing."""
    row = np.arange(rows)[:, np.newaxis]
    falls = np.array(slopes)[np.arange(columns) * len(slopes) // columns]
    down = np.where(row >= landing, falls, 0.0)
    return falls * np.maximum(row - landing + 0.5, 0.0), np.stack([np.zeros((rows, columns)), -down])


def ball(size=40, radius=14.0):
    """Return a ball on a plane, up to a zenith of 60 degrees: heights, slopes, and which is ball."""
    y, x = (places - (size - 1) / 2 for places in np.indices((size, size)))
    on = x * x + y * y < (radius * np.sin(np.radians(60))) ** 2
    rise = np.sqrt(np.where(on, radius**2 - x * x - y * y, 1.0))
    slopes = np.stack([np.where(on, -x / rise, 0.0), np.where(on, y / rise, 0.0)])
    return np.where(on, radius + rise, 0.0), slopes, on


def bump(size=48, sigma=8.0, peak=6.0):
    y, x = (places - (size - 1) / 2 for places in np.indices((size, size)))
    height = peak * np.exp(-(x * x + y * y) / (2 * sigma**2))
    return height, np.stack([-x * height, y * height]) / sigma**2


@pytest.mark.parametrize(("k", "noise"), [(2.0, 0.0), (8.0, 0.02)])
def test_nothing_steps_on_a_smooth_surface(k, noise):
    truth, slopes = bump()
    surface = engine.integrate(*noisy(slopes, noise), 1.0, robust=True, bilateral_sharpness=k, sigma=False)
    assert not surface.edges.any()
    for axis in (0, 1):
        off = np.diff(surface.height - truth, axis=axis)
        assert np.abs(off).max() < 0.02 + 4 * noise * (1 + np.max(slopes**2))


def uneven(size=36, radius=14.0):
    """Return a ball on a plane with slopes of unequal weight and some known heights."""
    truth, slopes, on = ball(size, radius)
    rng = np.random.default_rng(5)
    weights = rng.uniform(0.3, 3.0, (2, size, size)) * 1000
    heights = np.where(rng.random(truth.shape) < 0.1, truth + rng.normal(0, 0.2, truth.shape), np.nan)
    return truth, noisy(slopes, 0.02), on, weights, heights, rng.uniform(10, 40, truth.shape)


def test_known_heights_lift_a_ball_off_its_plane():
    truth, slopes, _, weights, known_heights, height_weights = uneven()
    surface = engine.integrate(
        *slopes,
        1.0,
        slope_weights=weights,
        known_heights=known_heights,
        known_height_weights=height_weights,
        robust=True,
        sigma=False,
    )
    y, x = (places - 17.5 for places in np.indices(truth.shape))
    rim = np.abs(np.hypot(x, y) - 14 * np.sin(np.radians(60))) < 2.5
    assert np.ptp(truth[rim]) > 20
    assert np.abs(surface.height - truth)[~rim].max() < 0.02 * 21
    np.testing.assert_array_equal(surface.offset_unknown, np.zeros(len(surface.offset_unknown), bool))
    assert surface.edges[rim].mean() > 0.3
    assert not surface.edges[~rim].any()


def test_what_is_cut_all_round_is_a_component_of_its_own(device):
    truth, slopes, on = ball()
    surface = engine.integrate(
        *noisy(slopes, 0.01), 1.0, robust=True, initial_heights=truth, sigma=False, device=device
    )
    assert surface.offset_unknown.tolist() == [1, 1]
    np.testing.assert_array_equal(surface.component, on)
    for part in (on, ~on):
        off = (surface.height - truth)[part]
        assert np.abs(off - np.median(off)).max() < 0.02 * np.ptp(truth)


def test_links_that_are_not_there_stay_away():
    slopes = noisy(bump()[1][:, :30, :], 0.02)
    slopes[:, 3:6, 7:11] = np.nan
    mask, edges = np.ones((30, 48), bool), np.zeros((30, 48), bool)
    mask[:, 40] = False
    edges[20, :30] = True
    surface = engine.integrate(*slopes, 1.0, mask=mask, edges=edges, robust=True, sigma=False)
    good = mask & np.isfinite(slopes[0])
    np.testing.assert_array_equal(np.isfinite(surface.height), good)
    assert surface.process["integration_invalid"] == 12
    assert surface.component[0, 0] != surface.component[0, 47]
    # Edges that are given cut links, and no others are found.
    assert not surface.edges.any()


@pytest.mark.parametrize("shape", [(1, 1), (1, 9)])
def test_the_smallest_pictures_have_heights(device, shape):
    slopes = np.full((2, *shape), 0.25)
    surface = engine.integrate(*slopes, 1.0, robust=True, sigma=False, device=device)
    y, x = np.indices(shape)
    plane = 0.25 * (x - y)
    np.testing.assert_allclose(surface.height, plane - plane.mean(), atol=1e-6)
    assert not surface.edges.any()


def test_a_search_that_must_stop_reports_it():
    slopes = noisy(ramps()[1], 0.02)
    surface = engine.integrate(*slopes, 1.0, robust=True, sigma=False, budget=1e-6)
    assert not surface.process["integration_converged"]
    assert surface.process["integration_iterations"] == 2


K, NOISE = 2.0, np.radians(1.0)


@cache
def asked(name):
    """Return a case, its noisy slopes, and where they determine the height."""
    case = CASES[name]()
    slopes = steps.tilted(case.seen, NOISE)
    part = steps.determined(case, slopes)
    assert np.mean(part[case.mask] >= 0) >= 0.9
    return case, slopes, part


@cache
def robust_surface(name, k=K):
    case, slopes, _ = asked(name)
    options = {"mask": case.mask, "robust": True, "bilateral_sharpness": k, "sigma": False}
    return engine.integrate(*slopes, case.pixel_size, **options)


@pytest.mark.parametrize("name", CASES)
def test_heights_are_kept_wherever_the_normals_determine_them(name):
    case, _, part = asked(name)
    surface = robust_surface(name)
    np.testing.assert_array_equal(np.isfinite(surface.height), case.mask)
    assert np.nanmax(np.abs(steps.errors(surface.height, case, part))) <= 0.02


@pytest.mark.parametrize("name", CASES)
def test_no_edge_is_marked_where_there_is_none(name):
    case, _, _ = asked(name)
    edges = robust_surface(name).edges
    assert edges.shape == case.mask.shape
    assert edges.dtype == np.uint8
    assert set(np.unique(edges)) <= {0, 1}
    bent = np.zeros(case.mask.shape, bool)
    for slope in (case.seen.dz_dx, case.seen.dz_dy):
        bent |= ndimage.maximum_filter(slope, 3) - ndimage.minimum_filter(slope, 3) > 0.3
    near = ndimage.binary_dilation(steps.beside_steps(case) | bent, iterations=2)
    assert (~near).sum() > 0.1 * near.size
    assert np.mean(edges[~near]) <= 0.001


def test_a_tear_is_marked():
    case, _, _ = asked("torn sheet")
    torn = (np.abs(np.diff(case.seen.height, axis=1)) > 3 * case.pixel_size[0]).any(axis=1)
    middle = slice(case.mask.shape[1] // 2 - 3, case.mask.shape[1] // 2 + 3)
    marked = robust_surface("torn sheet").edges[:, middle].any(axis=1)
    assert torn.sum() > 25
    assert marked[torn].mean() >= 0.95


@pytest.mark.parametrize("slope", [(0.6, 0.2), (1.7, 0.0)])
def test_a_noisy_plane_is_not_flattened(slope):
    row, column = np.indices((64, 64))
    height = slope[0] * column - slope[1] * row
    normals = np.array([-slope[0], -slope[1], 1]) / np.sqrt(1 + slope[0] ** 2 + slope[1] ** 2)
    noisy = normals + 0.03 * np.random.default_rng(0).standard_normal((64, 64, 3))
    errors = [
        np.std(
            engine.integrate(normals=noisy, pixel_size=1.0, slope_weights=0.03**-2, **options).height - height
        )
        for options in ({}, {"robust": True})
    ]
    assert errors[1] < 1.3 * errors[0]


def test_breaks_are_reported_and_noise_is_not():
    row, column = np.indices((64, 64)) - 31.5
    noise = 0.02 * np.random.default_rng(0).standard_normal((2, 64, 64))
    ball = np.hypot(row, column) < 20
    steep = np.sqrt(np.where(ball, 20.5**2 - row**2 - column**2, 1))
    slopes = np.where(ball, np.stack([-column, row]) / steep, 0.3)
    surfaces = [engine.integrate(*(maps + noise), 1.0, robust=True) for maps in (slopes, 0 * slopes)]
    assert ["the surface has breaks" in surface.process.get("warnings", "") for surface in surfaces] == [
        True,
        False,
    ]
