"""Levels that differ from their references are part of the standard deviation of heights on slopes."""

import numpy as np
import pytest

from mirrorskin import engine

SHAPE, PIXEL, NOISE = (60, 70), 0.05, 1.0
TRAVEL = np.arange(0.0, 1.0, 0.02)
DARK, BRIGHT = 20.0, 220.0
SLOPE = 0.6


def pressed(dark=0.0, light=0.0, scatter=0.0):
    """Return frames of a cone, whose levels change linearly by some counts, and its height."""
    x, y = ((np.arange(n) - (n - 1) / 2) * PIXEL for n in SHAPE[::-1])
    y = y[:, np.newaxis]
    radius = np.hypot(x, y)
    height = -0.1 - SLOPE * radius / 2
    width = SLOPE / 2 * (np.abs(x) + np.abs(y)) / radius * PIXEL  # of the light's edge, over a pixel
    fraction = np.clip((TRAVEL[:, np.newaxis, np.newaxis] + height) / width + 0.5, 0, 1)
    generator, time = np.random.default_rng(1), np.linspace(0, 1, len(TRAVEL))[:, np.newaxis, np.newaxis]
    gain = 1 + scatter * generator.normal(size=SHAPE)
    counts = DARK + dark * time + fraction * gain * (BRIGHT - DARK + (light - dark) * time)
    counts += generator.normal(0, NOISE, counts.shape)
    return np.clip(np.rint(counts), 0, 255).astype(np.uint8), height


def reconstruct(frames, **options):
    levels = {"dark": DARK, "bright": BRIGHT}
    return engine.reconstruct(frames, travel=TRAVEL, pixel_size=PIXEL, fill=False, **levels, **options)


@pytest.mark.parametrize("method", ["threshold", "change-point"])
def test_heights_have_true_errors_while_the_dark_level_drifts(method):
    frames, height = pressed(dark=6.0, light=6.0)
    result = reconstruct(frames, method=method)
    assert np.nanmean(((result.height - height) / result.height_sigma) ** 2) < 1.5


def test_the_note_states_the_difference_of_levels():
    notes = reconstruct(pressed(light=-8.0)[0]).process["notes"]
    assert notes.startswith("levels differ from their references, light by -3.")


def test_levels_of_single_pixels_are_not_common_to_all():
    assert "notes" not in reconstruct(pressed(light=-8.0, scatter=0.1)[0]).process


def test_levels_as_stated_add_nothing():
    assert "notes" not in reconstruct(pressed()[0]).process
