"""Profile parameters of waves, whose values are known in closed form."""

import numpy as np
import pytest
from height_maps import places, result_of

from mirrorskin import engine, io
from mirrorskin.engine.metrology import profile_parameters

STEP = 0.01


def wave(length=0.5, amplitude=0.002, count=1001):
    return amplitude * np.sin(2 * np.pi * STEP * np.arange(count) / length + 0.1)


def values(heights, **options):
    return {name: entry.value for name, entry in profile_parameters(heights, STEP, **options)[0].items()}


def test_a_sine_has_its_closed_form():
    parameters = values(wave())
    assert parameters["Pa"] == pytest.approx(4 / np.pi, rel=2e-3)
    assert parameters["Pq"] == pytest.approx(2 / np.sqrt(2), rel=2e-3)
    assert (parameters["Pz"], parameters["Pt"]) == pytest.approx((4, 4), rel=1e-3)
    assert parameters["Psk"] == pytest.approx(0, abs=1e-2)
    assert parameters["Pku"] == pytest.approx(1.5, rel=2e-3)
    assert parameters["PSm"] == pytest.approx(0.5, rel=1e-6)


def test_the_filter_halves_waves_of_its_length():
    parameters = values(wave(length=0.8), l_filter=0.8)
    assert parameters["Rt"] == pytest.approx(2, rel=0.02)
    assert parameters["RSm"] == pytest.approx(0.8, rel=0.01)


def test_the_height_of_section_lengths_is_a_mean_and_the_total_one_is_not():
    heights = wave(length=0.1)
    heights[500:510] *= 5
    parameters = values(heights, l_filter=0.8)
    assert parameters["Rt"] > 2.5 * 4
    assert parameters["Rz"] < 1.5 * 4


def test_small_peaks_do_not_count_in_the_spacing():
    assert values(wave() + wave(length=0.03, amplitude=0.0001))["PSm"] == pytest.approx(0.5, rel=0.01)


def test_holes_end_a_stretch_in_which_spacings_are_counted():
    heights = wave()
    heights[400:420] = np.nan
    assert values(heights)["PSm"] == pytest.approx(0.5, rel=1e-3)


def test_without_a_peak_there_is_no_spacing():
    assert np.isnan(values(wave(length=50.0))["PSm"])


def test_falls_count_in_the_spacing_and_half_an_element_is_doubled_with_its_uncertainty():
    x = STEP * np.arange(160)
    noise = [2e-5 * np.random.default_rng(seed).standard_normal(160) for seed in range(24)]
    for phase in np.linspace(0, 6, 13):
        parameters, _ = profile_parameters(0.002 * np.sin(2 * np.pi * x / 1.1 + phase), STEP, errors=noise)
        spacing = parameters["PSm"]
        assert spacing.value == pytest.approx(1.1, rel=0.35)
        assert abs(spacing.value - 1.1) < 2 * spacing.sigma + 0.02


def test_an_s_filter_removes_short_waves_of_a_profile():
    heights = wave() + wave(length=0.03, amplitude=0.001)
    assert values(heights, s_filter=0.12)["Pz"] == pytest.approx(4, rel=0.05)
    assert values(heights, s_filter=0.12, l_filter=2.0)["Rz"] == pytest.approx(4, rel=0.1)


def test_too_few_samples_are_refused():
    with pytest.raises(io.InputError, match="at least 8 measured samples"):
        values(np.zeros(7))


def test_a_section_has_the_parameters_of_its_profile():
    x, _ = places((60, 300), (0.02, 0.02))
    height = 0.002 * np.sin(2 * np.pi * x / 0.5) + 0.3 * x
    result = result_of(height, (0.02, 0.02), sigma=1e-5)
    ends = (-2.5, 0.0), (2.5, 0.0)
    measured = engine.measure(result, form="plane", section=ends)
    assert measured.quantities["Pq"].value == pytest.approx(2 / np.sqrt(2) / np.sqrt(1.09), rel=0.02)
    assert measured.quantities["PSm"].value == pytest.approx(0.5, rel=0.01)
    assert 0 < measured.quantities["Pq"].sigma < 0.01
    rough = engine.measure(result, form="plane", section=ends, l_filter=0.8).quantities
    assert {"Ra", "Rq", "Rz", "Rt", "Rsk", "Rku", "RSm"} <= set(rough)
    assert not any(name.startswith("P") for name in rough)


def test_a_section_that_is_too_short_for_a_profile_is_a_note():
    result = result_of(np.zeros((20, 20)), (0.1, 0.1), sigma=0.001)
    measured = engine.measure(result, form="none", section=((-0.2, 0.0), (0.2, 0.0)))
    assert any(note.startswith("no profile parameters: a profile needs at least") for note in measured.notes)
