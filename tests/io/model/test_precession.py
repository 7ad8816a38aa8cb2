"""Conversion of a recording's phases to inclinations by a precession."""

import math

import numpy as np
import pytest
from calibrations import a_precession

PHASE = np.linspace(-7.0, 20.0, 400)


def a_circle(**changes):
    return a_precession(**{"ellipticity": 0.0, "centre": (0.0, 0.0)} | changes)


@pytest.mark.parametrize("direction", [1, -1])
def test_a_circle_is_gone_round_from_the_offset_on(direction):
    lean = a_circle(direction=direction).lean(PHASE)
    azimuth = direction * PHASE + 0.3
    np.testing.assert_allclose(lean, 0.04 * np.stack([np.cos(azimuth), np.sin(azimuth)], -1), atol=1e-15)
    np.testing.assert_allclose(a_circle(direction=direction).phase(PHASE), azimuth, atol=1e-13)


def test_an_ellipse_leans_most_along_its_major_axis():
    lean = a_precession(centre=(0.0, 0.0)).lean(np.linspace(0, math.tau, 100_001))
    lengths = np.hypot(*lean.T)
    greatest, lowest = lean[np.argmax(lengths)], lean[np.argmin(lengths)]
    assert np.max(lengths) == pytest.approx(0.04 * 1.05)
    assert np.min(lengths) == pytest.approx(0.04 * 0.95)
    assert math.atan2(greatest[1], greatest[0]) % math.pi == pytest.approx(1.0, abs=1e-3)
    assert math.atan2(lowest[1], lowest[0]) % math.pi == pytest.approx(1.0 + math.pi / 2, abs=1e-3)


@pytest.mark.parametrize("direction", [1, -1])
def test_the_phase_is_the_azimuth_of_the_lean_and_runs_on(direction):
    precession = a_precession(direction=direction, ellipticity=0.3)
    along, across = (precession.lean(PHASE) - precession.centre).T
    phases = precession.phase(PHASE)
    np.testing.assert_allclose(np.cos(phases), along / np.hypot(along, across), atol=1e-9)
    np.testing.assert_allclose(np.sin(phases), across / np.hypot(along, across), atol=1e-9)
    assert np.all(np.diff(phases) * direction > 0)
    assert np.max(np.abs(phases - direction * PHASE - 0.3)) < math.pi / 4


def test_the_mean_lean_is_the_centre():
    lean = a_precession().lean(np.arange(8) * math.tau / 8)
    np.testing.assert_allclose(lean.mean(0), (0.001, -0.002), atol=1e-15)
