"""Robust integration: how its energy falls, and what it does with known heights, weights, masks and edges."""

import time
from functools import cache

import bilateral_oracle
import numpy as np
import pytest
from bilateral import Weighed

from mirrorskin import engine
from mirrorskin.engine.integration.graph import PixelGraph
from mirrorskin.engine.integration.robust import solve_robust
from mirrorskin.engine.integration.validation import check_inputs
from mirrorskin.kernels.device import open_device


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


def search(slopes, device, k=2.0, pixel_size=1.0, start=None, limit=100, deadline=None, **known):
    """Return what the search itself tells, and its heights."""
    inputs = check_inputs(*slopes, pixel_size, **known)
    graph = PixelGraph(device, inputs.shape)
    flags, leaning = graph.upload(inputs), graph.mean_plane()
    width, height = inputs.pixel_size
    row, column = np.indices(slopes[0].shape)
    plane = leaning[2] + leaning[0] * width * column - leaning[1] * height * row
    begin = None if start is None else start - plane - inputs.datum
    found = solve_robust(
        inputs, graph.links(leaning), flags, leaning, k, start=begin, limit=limit, deadline=deadline
    )
    return found, found.relief.download() + plane + inputs.datum


@cache
def found_ramps():
    """Return four ramps that are searched once: heights, noisy slopes, and what was found."""
    truth, slopes = ramps()
    slopes = noisy(slopes, 0.02)
    return truth, slopes, *search(slopes, open_device())


def assert_falls(found):
    assert found.converged
    assert len(found.energies) > 3
    assert (np.diff(found.energies) < 0).all()


def test_the_energy_never_rises_and_ends_below_that_of_float64():
    _, slopes, found, height = found_ramps()
    assert_falls(found)
    terms = bilateral_oracle.terms(*slopes, (1.0, 1.0), np.ones(height.shape, bool))
    assert found.energies[-1] == pytest.approx(bilateral_oracle.energy_of(terms, height, 2.0), rel=1e-5)
    assert found.energies[-1] <= 1.00001 * bilateral_oracle.alternate(terms, 2.0).energy[-1]


@pytest.mark.parametrize("k", [0.5, 8.0])
def test_so_it_does_at_any_k(device, k):
    _, slopes = ramps(18, 24, 8, (0.0, 0.9))
    slopes = noisy(slopes, 0.02)
    found, height = search(slopes, device, k)
    assert_falls(found)
    terms = bilateral_oracle.terms(*slopes, (1.0, 1.0), np.ones(height.shape, bool))
    assert found.energies[-1] == pytest.approx(bilateral_oracle.energy_of(terms, height, k), rel=1e-5)
    assert found.energies[-1] <= 1.00001 * bilateral_oracle.alternate(terms, k).energy[-1]


def test_ramps_keep_their_steps():
    truth, _, found, height = found_ramps()
    off = height - truth
    steps = np.abs(np.diff(truth, axis=1))
    # A step lower than two pixels is a bend at this k, and what is next to it is bent.
    low = np.zeros(truth.shape, bool)
    for row, column in np.argwhere((steps > 0) & (steps < 2.5)):
        low[max(row - 3, 0) : row + 4, max(column - 3, 0) : column + 5] = True
    assert np.abs(off - np.median(off))[~low].max() <= 0.02 * steps.max()
    across = np.argwhere(steps > 4)
    assert len(across) > 40
    for side in (0, 1):
        assert found.edges[across[:, 0], across[:, 1] + side].all()
        assert not found.links.right.download()[across[:, 0], across[:, 1]].any()
    assert not found.edges[:, :20].any()
    assert not found.edges[:15].any()


@pytest.mark.parametrize(("k", "noise"), [(0.5, 0.05), (2.0, 0.0), (2.0, 0.05), (8.0, 0.02)])
def test_nothing_steps_on_a_smooth_surface(k, noise):
    truth, slopes = bump()
    found, height = search(noisy(slopes, noise), open_device(), k)
    assert not found.edges.any()
    assert (found.links.right.download()[:, :-1] > 0.2).all()
    for axis in (0, 1):
        off = np.diff(height - truth, axis=axis)
        assert np.abs(off).max() < 0.02 + 4 * noise * (1 + np.max(slopes**2))


def uneven(size=36, radius=14.0):
    """Return a ball on a plane with slopes unequally sure and some known heights."""
    truth, slopes, on = ball(size, radius)
    rng = np.random.default_rng(5)
    sure = rng.uniform(0.3, 3.0, (2, size, size)) * 1000
    known = np.where(rng.random(truth.shape) < 0.1, truth + rng.normal(0, 0.2, truth.shape), np.nan)
    return truth, noisy(slopes, 0.02), on, sure, known, rng.uniform(10, 40, truth.shape)


def test_weights_and_known_heights_count_as_in_float64(device):
    width, _ = pixel_size = (0.03, 0.05)
    _, slopes, _, sure, known, sure_z = uneven(20, 7.0)
    slopes, known, sure_z = slopes * [[[1.0]], [[width / pixel_size[1]]]], width * known, sure_z / width**2
    given = {"slope_weights": sure, "known_heights": known, "known_height_weights": sure_z}
    found, height = search(slopes, device, 2.0, pixel_size, **given)
    mask = np.ones(height.shape, bool)
    problem = Weighed(*slopes, pixel_size, mask, *sure, known, sure_z)
    _, course = problem.alternate(2.0)
    assert found.energies[-1] == pytest.approx(problem.energy(height, 2.0), rel=1e-4)
    assert found.energies[-1] <= 1.0001 * course[-1]
    assert (np.diff(found.energies) < 0).all()


def test_known_heights_lift_a_ball_off_its_plane():
    truth, slopes, _, sure, known, sure_z = uneven()
    surface = engine.integrate(
        *slopes,
        1.0,
        slope_weights=sure,
        known_heights=known,
        known_height_weights=sure_z,
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


def test_what_is_cut_all_round_is_a_piece_of_its_own(device):
    truth, slopes, on = ball()
    surface = engine.integrate(
        *noisy(slopes, 0.01), 1.0, robust=True, initial_heights=truth, sigma=False, device=device
    )
    assert surface.offset_unknown.tolist() == [True, True]
    np.testing.assert_array_equal(surface.component, on)
    for part in (on, ~on):
        off = (surface.height - truth)[part]
        assert np.abs(off - np.median(off)).max() < 0.02 * np.ptp(truth)


def test_heights_go_with_the_pixel_size():
    _, slopes, found, height = found_ramps()
    other, finer = search(slopes, open_device(), pixel_size=0.03)
    np.testing.assert_allclose(other.energies[-1], found.energies[-1], rtol=1e-5)
    np.testing.assert_allclose(finer / 0.03 - finer.mean() / 0.03, height - height.mean(), atol=0.02)


def test_links_that_are_not_there_stay_away():
    slopes = noisy(bump()[1][:, :30, :], 0.02)
    slopes[:, 3:6, 7:11] = np.nan
    mask, edges = np.ones((30, 48), bool), np.zeros((30, 48), bool)
    mask[:, 40] = False
    edges[20, :30] = True
    surface = engine.integrate(*slopes, 1.0, mask=mask, edges=edges, robust=True, sigma=False)
    good = mask & np.isfinite(slopes[0])
    np.testing.assert_array_equal(np.isfinite(surface.height), good)
    assert surface.invalid == 12
    assert surface.component[0, 0] != surface.component[0, 47]
    # Edges that are given cut links, and no others are found.
    assert not surface.edges.any()


@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (2, 1), (1, 9)])
def test_the_smallest_pictures_have_heights(device, shape):
    slopes = np.full((2, *shape), 0.25)
    surface = engine.integrate(*slopes, 1.0, robust=True, sigma=False, device=device)
    y, x = np.indices(shape)
    plane = 0.25 * (x - y)
    np.testing.assert_allclose(surface.height, plane - plane.mean(), atol=1e-6)
    assert not surface.edges.any()


def test_a_search_that_must_stop_says_so():
    _, slopes, *_ = found_ramps()
    found, _ = search(slopes, open_device(), limit=2)
    assert not found.converged
    found, _ = search(slopes, open_device(), deadline=time.perf_counter())
    assert not found.converged
    assert len(found.energies) <= 2
