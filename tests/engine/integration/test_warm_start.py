"""Heights that follow changing slopes converge to the best fit, and remain there."""

import numpy as np
import pytest

from mirrorskin.engine import integrate
from mirrorskin.engine.integration.warm_start import MAPS, WarmStartIntegrator

PIXEL = 0.1, 0.05


def scene(shape, seed=0, blobs=True):
    """Slopes with weights from 0.1 to 10, within two blobs or everywhere, NaN and weight 0 elsewhere."""
    random = np.random.default_rng(seed)
    y, x = np.mgrid[: shape[0], : shape[1]] / max(shape)
    mask = np.hypot(x - 0.3, y - 0.3) < 0.2
    mask |= np.hypot(x - 0.7, y - 0.25) < 0.15
    mask = mask if blobs else np.ones(shape, bool)
    dz_dx, dz_dy = np.sin(9 * x) + random.normal(0, 0.1, shape), np.cos(7 * y)
    weights = 10 ** random.uniform(-1, 1, (2, *shape))
    slopes = [np.where(mask, values, np.nan) for values in (dz_dx, dz_dy)]
    return [values.astype(np.float32) for values in (*slopes, *np.where(mask, weights, 0))]


def follow(follower, maps):
    for name, values in zip(MAPS, maps, strict=True):
        array = follower.maps[name]
        array.write(values)
    follower.push(1.0)
    return follower.result()


def best(maps):
    dz_dx, dz_dy, *weights = maps
    return integrate(
        dz_dx, dz_dy, PIXEL, mask=weights[0] > 0, slope_weights=np.stack(weights), tolerance=1e-5
    )


def miss(height, exact):
    np.testing.assert_array_equal(np.isnan(height), np.isnan(exact))
    finite = np.isfinite(exact)
    return np.sqrt(np.mean((height - exact)[finite] ** 2)) / np.ptp(exact[finite])


@pytest.mark.parametrize("shape", [(48, 64), (37, 131), (150, 90)])
def test_they_come_near_at_once_and_nearer_with_each_step(device, shape):
    maps, follower = scene(shape), WarmStartIntegrator(device, shape, PIXEL)
    exact = best(maps)
    misses = [miss(follow(follower, maps), exact.height) for _ in range(10)]
    assert misses[0] < 2e-2
    assert misses[-1] < 2e-3
    assert exact.offset_unknown.sum() == 2


def test_what_changes_little_is_followed(device):
    shape = (60, 80)
    follower, start, end = WarmStartIntegrator(device, shape, PIXEL), scene(shape), scene(shape, seed=1)
    for fraction in np.linspace(0, 1, 30):
        maps = [(1 - fraction) * before + fraction * other for before, other in zip(start, end, strict=True)]
        height = follow(follower, [before.astype(np.float32) for before in maps])
        if fraction > 0.9:
            assert miss(height, best(maps).height) < 2e-2
    assert follower.gap < 0.1


def test_each_piece_has_the_mean_0(device):
    shape = (50, 70)
    maps, follower = scene(shape), WarmStartIntegrator(device, shape, PIXEL)
    component = best(maps).component
    height = follow(follower, maps)
    for piece in range(component.max() + 1):
        assert np.mean(height[component == piece]) == pytest.approx(0, abs=1e-4)


def test_another_surface_is_found_within_some_steps(device):
    shape = (60, 80)
    maps, follower = scene(shape), WarmStartIntegrator(device, shape, PIXEL)
    for _ in range(3):
        follow(follower, maps)
    other = scene(shape, blobs=False)
    other[0] = other[0] * -3
    for _ in range(10):
        height = follow(follower, other)
    assert miss(height, best(other).height) < 5e-3


def test_a_border_that_changes_is_followed(device):
    """As that of a contact: single pixels enter and leave with each frame."""
    shape = (90, 120)
    y, x = np.mgrid[: shape[0], : shape[1]] / max(shape)
    slopes = [np.sin(9 * x), np.cos(7 * y)]
    follower, random = WarmStartIntegrator(device, shape, PIXEL), np.random.default_rng(0)
    for _ in range(12):
        inside = np.hypot(x - 0.5, y - 0.4) + random.normal(0, 0.02, shape) < 0.3
        weights = np.where(inside, 1.0, 0.0)
        cut = [np.where(inside, values, np.nan) for values in slopes]
        maps = [values.astype(np.float32) for values in (*cut, weights, weights)]
        height, exact = follow(follower, maps), best(maps)
        core = np.hypot(x - 0.5, y - 0.4) < 0.2
        assert np.std((height - exact.height)[core]) < 1e-2 * np.ptp(exact.height[core])
    assert follower.gap < 0.1


def test_one_step_is_enough_where_a_contact_moves(device):
    shape, steps = (120, 160), []
    y, x = np.mgrid[: shape[0], : shape[1]] / max(shape)
    follower, random = WarmStartIntegrator(device, shape, PIXEL), np.random.default_rng(0)
    for number in range(24):
        away = 0.02 * np.cos(0.4 * number), 0.02 * np.sin(0.4 * number)
        inside = np.hypot(x - 0.5 - away[0], y - 0.4 - away[1]) < 0.3
        slopes = [values + random.normal(0, 1e-3, shape) for values in (np.sin(9 * x), np.cos(7 * y))]
        cut = [np.where(inside, values, np.nan) for values in slopes]
        maps = [values.astype(np.float32) for values in (*cut, *[np.where(inside, 1.0, 0.0)] * 2)]
        follow(follower, maps)
        steps.append(follower.gap)
    assert max(steps[1:]) < 0.05


def test_nothing_has_no_heights_and_does_not_stay(device):
    shape = (20, 30)
    maps, follower = scene(shape), WarmStartIntegrator(device, shape, PIXEL)
    nothing = [np.full(shape, np.nan, np.float32)] * 2 + [np.zeros(shape, np.float32)] * 2
    exact = best(maps).height
    for _ in range(2):
        assert np.isnan(follow(follower, nothing)).all()
        assert miss(follow(follower, maps), exact) < 2e-2
