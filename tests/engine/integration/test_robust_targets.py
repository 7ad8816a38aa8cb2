"""Depth discontinuities that nobody marked: what is kept, what is not invented (tests/support/steps.py)."""

from functools import cache

import bilateral_oracle
import numpy as np
import pytest
import steps
from scipy import ndimage
from steps import CASES

from mirrorskin import engine

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
def reference(name, k=K):
    """Return the residuals, and what float64 makes of them."""
    case, slopes, _ = asked(name)
    terms = bilateral_oracle.terms(*slopes, case.pixel_size, case.mask)
    return terms, bilateral_oracle.alternate(terms, k)


@cache
def found(name, k=K):
    case, slopes, _ = asked(name)
    options = {"mask": case.mask, "robust": True, "bilateral_sharpness": k, "sigma": False}
    return engine.integrate(*slopes, case.pixel_size, **options)


@pytest.mark.parametrize("name", CASES)
def test_heights_are_kept_wherever_the_normals_determine_them(name):
    case, _, part = asked(name)
    surface = found(name)
    np.testing.assert_array_equal(np.isfinite(surface.height), case.mask)
    assert np.nanmax(np.abs(steps.errors(surface.height, case, part))) <= 0.02


@pytest.mark.parametrize("name", CASES)
def test_nothing_steps_where_the_surface_is_smooth(name):
    case, slopes, _ = asked(name)
    # The slope's own noise, of which a link sees the mean of two pixels, is no step.
    noise = case.pixel_size[0] * NOISE * (1 + np.max(slopes[:, case.mask] ** 2)) * 4 / case.step
    for links in steps.smooth_links(case, found(name).height):
        assert len(links) > 0.5 * case.mask.sum()
        assert np.abs(links).max() <= max(0.02, noise)


@pytest.mark.parametrize("name", CASES)
def test_no_edge_is_marked_where_there_is_none(name):
    case, _, _ = asked(name)
    edges = found(name).edges
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
    marked = found("torn sheet").edges[:, middle].any(axis=1)
    assert torn.sum() > 25
    assert marked[torn].mean() >= 0.95


@pytest.mark.parametrize(
    ("name", "k"), [*((name, K) for name in CASES), ("ball on a plane, long pixels", 5.0), ("stairs", 1.0)]
)
def test_the_energy_ends_no_higher_than_that_of_float64(name, k):
    terms, least = reference(name, k)
    mine = bilateral_oracle.energy_of(terms, found(name, k).height, k)
    assert mine <= 1.001 * least.energy[-1]


def test_the_energy_of_float64_never_rises():
    for name in ("ball on a plane", "stairs", "torn sheet"):
        course = reference(name)[1].energy
        assert len(course) > 2
        assert np.diff(course).max() <= 1e-9 * course[0]
