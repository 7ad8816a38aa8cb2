"""The printed pattern as a monotone curve, compared with quadrature and closed forms."""

import itertools

import numpy as np
import pytest
from scipy.integrate import quad

from mirrorskin.engine.calibration.wall_model import (
    CURVE_COEFFICIENTS,
    curve_from_steps,
    curve_means,
    curve_roughness,
    curve_values,
)


def gamma_coefficients(exponent):
    fraction = np.linspace(0, 1, 400)
    width = 1e-6
    basis = curve_means(fraction - width, fraction + width)[1:-1]
    return np.linalg.lstsq(basis, fraction[1:-1] ** exponent, rcond=None)[0]


@pytest.mark.parametrize("rising", [True, False])
def test_a_curve_of_steps_from_0_up_never_turns_back(rising):
    rng = np.random.default_rng(3)
    for _ in range(20):
        steps = rng.exponential(size=CURVE_COEFFICIENTS) * (rng.random(CURVE_COEFFICIENTS) < 0.6)
        light = curve_values(curve_from_steps(rising) @ steps, np.linspace(0, 1, 500))
        changes = np.diff(light) * (1 if rising else -1)
        assert (changes >= -1e-12).all()
        assert light.min() >= 0


@pytest.mark.parametrize(("low", "high"), [(0.2, 0.3), (-0.2, 0.1), (0.93, 1.4), (1.1, 1.2)])
def test_means_over_intervals_are_those_of_quadrature(low, high):
    coefficients = np.random.default_rng(5).random(CURVE_COEFFICIENTS)
    inside = sorted(
        {max(low, 0), *(knot for knot in np.linspace(0, 1, 9) if low < knot < high), min(high, 1)}
    )
    whole = sum(
        quad(lambda fraction: float(curve_values(coefficients, fraction)), first, second)[0]
        for first, second in itertools.pairwise(inside)
        if second > first
    )
    mean = curve_means([low], [high]) @ coefficients
    assert mean[0] == pytest.approx(whole / (high - low), abs=1e-8)


@pytest.mark.parametrize("exponent", [1.0, 2.2, 1 / 2.2])
def test_a_printed_gamma_is_such_a_curve(exponent):
    fraction = np.linspace(0.05, 1, 300)
    light = curve_values(gamma_coefficients(exponent), fraction)
    np.testing.assert_allclose(light, fraction**exponent, atol=6e-3 if exponent < 1 else 3e-4)


def test_a_parabola_is_not_rough_and_a_step_is():
    parabola = gamma_coefficients(2.0)
    assert np.abs(curve_roughness() @ parabola)[2:-2].max() < 1e-6
    assert np.abs(curve_roughness() @ (np.arange(CURVE_COEFFICIENTS) > 5)).max() > 1
