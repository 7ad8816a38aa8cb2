"""Phases: what a fit makes of samples, and which phases determine none."""

from __future__ import annotations

import numpy as np
import pytest

from mirrorskin.engine.rotation.design_matrix import basis, check_phases, fit_matrix
from mirrorskin.io import InputError

MEASURED = np.deg2rad([178.1, 133.4, 91.0, 44.6, 1.9, 313.7, 268.8, 226.2])


@pytest.mark.parametrize("count", [3, 4, 8, 36])
def test_even_phases_make_the_papers_sums(count: int) -> None:
    alpha = 0.3 + 2 * np.pi * np.arange(count) / count
    expected = np.stack([np.ones(count), 2 * np.cos(alpha), 2 * np.sin(alpha)]) / count
    np.testing.assert_allclose(fit_matrix(alpha), expected, atol=1e-14)


@pytest.mark.parametrize("weights", [None, [1, 1, 0, 1, 1, 0, 1, 1], [3, 0.5, 1, 0.25, 2, 1e-3, 1, 7]])
def test_uneven_phases_give_back_what_the_samples_were_made_of(weights: list[float] | None) -> None:
    made = np.array([120.0, -7.5, 3.25])
    samples = made[0] + made[1] * np.cos(MEASURED) + made[2] * np.sin(MEASURED)
    np.testing.assert_allclose(fit_matrix(MEASURED, weights) @ samples, made, rtol=1e-12)


def test_no_other_fit_misses_the_samples_by_less() -> None:
    rng = np.random.default_rng(1)
    samples, weights = rng.normal(100, 20, 8), rng.uniform(0, 3, 8)
    found = fit_matrix(MEASURED, weights) @ samples

    def misfit(fit: np.ndarray) -> float:
        model = fit[0] + fit[1] * np.cos(MEASURED) + fit[2] * np.sin(MEASURED)
        return float(np.sum(weights * (samples - model) ** 2))

    for step in rng.normal(0, 1e-3, (100, 3)):
        assert misfit(found + step) > misfit(found)


def test_a_frame_of_weight_0_is_as_if_it_were_not_there() -> None:
    weights = np.ones(8)
    weights[[2, 5]] = 0
    with_gaps = fit_matrix(MEASURED, weights)
    assert not with_gaps[:, [2, 5]].any()
    np.testing.assert_allclose(with_gaps[:, weights > 0], fit_matrix(MEASURED[weights > 0]), atol=1e-15)


def test_weights_matter_only_in_proportion() -> None:
    weights = np.arange(1.0, 9.0)
    np.testing.assert_allclose(
        fit_matrix(MEASURED, 1e-4 * weights), fit_matrix(MEASURED, weights), rtol=1e-12
    )


def test_phases_of_many_turns_are_phases_of_one() -> None:
    turns = MEASURED + 2 * np.pi * np.array([0, 3, -2, 100, 7, -50, 1, 0])
    np.testing.assert_allclose(fit_matrix(turns), fit_matrix(MEASURED), atol=1e-12)


def test_the_basis_is_one_cosine_and_sine() -> None:
    np.testing.assert_allclose(basis([0, np.pi / 2]), [[1, 1, 0], [1, 0, 1]], atol=1e-15)


def test_usable_phases_come_back_as_they_are() -> None:
    found = check_phases([0, 1, 2])
    assert found.dtype == np.float64
    np.testing.assert_array_equal(found, [0, 1, 2])


@pytest.mark.parametrize(
    ("phase", "weights", "message"),
    [
        ([0, 1], None, "2 frames at 2 different phases .* at least 3"),
        ([], None, "0 frames at 0 different phases"),
        ([0, 0, 0, 0], None, "4 frames at 1 different phases"),
        ([0, 2 * np.pi, np.pi, -np.pi, 20 * np.pi], None, "5 frames at 2 different phases"),
        ([0, 1, 2, 3], [1, 1, 0, 0], "2 frames at 2 different phases"),
        ([0, 1e-3, 2e-3], None, "too close together .*spread them over more of the turn"),
        ([0, 1, 2], [1, 1, 1e-12], "too close together|condition"),
        ([0, 1, 2], [0, 0, 0], "all 3 frames have weight 0"),
        ([0, 1, np.nan], None, "nan at frame 2"),
        ([0, np.inf, 2], None, "inf at frame 1"),
        (["a", "b", "c"], None, "numbers are needed"),
        ([[0, 1, 2]], None, "one number a frame"),
        ([0, 1, 2], [1, -1, 1], "weight -1 at frame 1"),
        ([0, 1, 2], [1, 1, np.nan], "weight nan at frame 2"),
        ([0, 1, 2], [1, 1], "shape .2,. for 3 frames"),
        ([0, 1, 2], 1, "shape .. for 3 frames"),
    ],
)
def test_phases_that_determine_no_fit_are_refused_in_one_line(
    phase: list[float], weights: list[float] | None, message: str
) -> None:
    for use in (check_phases, fit_matrix):
        with pytest.raises(InputError, match=message) as caught:
            use(phase, weights)
        assert "\n" not in str(caught.value)
