"""Frame after frame: each starts from the last, and is as good as if it were alone."""

from __future__ import annotations

import numpy as np
import pytest
from slope_oracle import Problem, solve

from mirrorskin import engine, io

SHAPE = 41, 53
ROW, COLUMN = np.indices(SHAPE)
DISC = np.hypot(ROW - 20, COLUMN - 26) < 19


def frame(number):
    """Slopes that change by a hundredth from frame to frame."""
    random = np.random.default_rng(1)
    first, change = random.normal(0, 0.3, (2, 2, *SHAPE))
    return (first + 0.01 * number * change).astype(np.float32)


def exact(slopes, **options):
    return solve(Problem(*slopes, (0.03, 0.03), **options))


def surface(live, *slopes, **options):
    live.push(*slopes, **options)
    return live.result()


def span(height):
    return np.nanmax(height) - np.nanmin(height)


def test_frames_are_as_good_as_alone(device):
    live = engine.Integrator(SHAPE, 0.03, device=device)
    for number in range(4):
        found = surface(live, *frame(number), mask=DISC, tolerance=1e-5)
        true = exact(frame(number), mask=DISC)
        np.testing.assert_allclose(found.height, true.height, atol=2e-5 * span(true.height))
        np.testing.assert_array_equal(found.component, true.component)
        assert found.sigma is None


def test_a_frame_starts_from_the_last():
    live = engine.Integrator(SHAPE, 0.03)
    first = surface(live, *frame(0), mask=DISC, tolerance=1e-5).iterations
    assert surface(live, *frame(0), mask=DISC, tolerance=1e-4).iterations <= 1
    assert surface(live, *frame(1), mask=DISC, tolerance=1e-5).iterations <= first
    live.reset()
    assert surface(live, *frame(0), mask=DISC, tolerance=1e-5).iterations == first


def test_without_a_tolerance_frames_get_truer():
    live = engine.Integrator(SHAPE, 0.03)
    true = exact(frame(0), mask=DISC).height
    errors = [np.nanmax(np.abs(surface(live, *frame(0), mask=DISC).height - true)) for _ in range(3)]
    assert errors[0] < 0.05 * span(true)
    assert errors[2] < 1e-4 * span(true)


CHANGES = {
    "another mask": {"mask": DISC & (COLUMN > 15)},
    "a full picture": {},
    "slope_weights": {"mask": DISC, "slope_weights": 1 + ROW / 9},
    "other weights": {"mask": DISC, "slope_weights": np.stack([2 + COLUMN / 9, 1 + ROW / 9])},
    "edges": {"mask": DISC, "edges": COLUMN == 30},
    "known_heights": {"mask": DISC, "known_heights": np.where(COLUMN == 20, -3.0, np.nan)},
    "heavier heights": {
        "mask": DISC,
        "known_heights": np.where(COLUMN == 20, -3.0, np.nan),
        "known_height_weights": 50.0,
    },
}


def test_from_frame_to_frame_everything_may_change(device):
    live = engine.Integrator(SHAPE, 0.03, device=device)
    for number, options in enumerate([{"mask": DISC}, *CHANGES.values(), {"mask": DISC}]):
        true = exact(frame(number), **options)
        found = surface(live, *frame(number), **options, tolerance=1e-5)
        np.testing.assert_allclose(found.height, true.height, atol=3e-5 * span(true.height))
        np.testing.assert_array_equal(found.component, true.component)
        np.testing.assert_array_equal(found.offset_unknown, true.offset_unknown)


def test_a_surface_stays_what_it_is_when_the_next_comes():
    live = engine.Integrator(SHAPE, 0.03)
    first = surface(live, *frame(0), mask=DISC)
    kept = first.height.copy(), first.component.copy()
    surface(live, *frame(3), mask=DISC)
    surface(live, *frame(5), mask=DISC & (COLUMN > 20))
    np.testing.assert_array_equal(first.height, kept[0])
    np.testing.assert_array_equal(first.component, kept[1])


def test_a_budget_is_kept_and_used():
    live = engine.Integrator(SHAPE, 0.03)
    surface(live, *frame(0), mask=DISC)
    true = exact(frame(9), mask=DISC).height
    hasty = surface(live, *frame(9), mask=DISC, budget=1e-9)
    assert hasty.iterations <= 1
    patient = surface(live, *frame(9), mask=DISC, budget=30.0)
    assert np.nanmax(np.abs(patient.height - true)) < 1e-3 * span(true)


def test_frames_of_another_size_are_refused():
    live = engine.Integrator(SHAPE, 0.03)
    with pytest.raises(io.InputError, match=r"shape \(40, 53\), not \(41, 53\)"):
        surface(live, *frame(0)[:, 1:])
    with pytest.raises(io.InputError, match="budget 0"):
        surface(live, *frame(0), budget=0)
    with pytest.raises(io.InputError, match="pixel size -1"):
        engine.Integrator(SHAPE, -1)
