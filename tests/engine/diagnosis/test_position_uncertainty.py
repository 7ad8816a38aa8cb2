"""Errors of the frames' travel are found from bends of the surface at their heights."""

import numpy as np
import pytest

from mirrorskin import engine
from mirrorskin.evaluation.faults.camera import DARK, SPAN, Fault, centres, points, record

SHAPE, PIXEL, STEP = (48, 64), 0.05, 0.02
TRAVEL = np.arange(0.2, 1.1, STEP)
MIDDLE = len(TRAVEL) // 2  # the frame that is lost
JITTER = 0.1  # steps
CLEAN = Fault("none")


def waves(x, y):
    return 0.2 * np.sin(2 * np.pi * x / 1.6) * np.cos(2 * np.pi * y / 1.9) - 0.6


def domes_on_a_plate(x, y):
    """A dome and a pit in a plate, whose height is that of a frame."""
    dome, pit = (1 - ((x + side) ** 2 + y**2) / 0.5 for side in (0.8, -0.8))
    return 0.3 * (np.maximum(dome, 0) - np.maximum(pit, 0)) - 0.6


def terraces(x, y):
    return 0.1 * sum(np.tanh(6 * (x - at)) for at in (-0.8, 0, 0.8)) - 0.65 + 0 * y


def rough(x, y):
    generator = np.random.default_rng(5)
    angle, phase = generator.uniform(0, 2 * np.pi, (2, 40))
    length = 10 ** generator.uniform(-0.6, 0.4, 40)
    return -0.65 + sum(
        0.03 * size * np.cos(2 * np.pi / size * (np.cos(turn) * x + np.sin(turn) * y) + start)
        for turn, size, start in zip(angle, length, phase, strict=True)
    )


def reconstruct(surface, fault=CLEAN, seed=1, **options):
    """Reconstruct a press on a surface whose pixels turn light while the sheet passes over their area."""
    x, y = points(SHAPE, PIXEL)
    along, up = (np.abs(surface(x + a, y + b) - surface(x - a, y - b)) for a, b in ((1e-4, 0), (0, 1e-4)))
    width = (along + up) / 2e-4 * PIXEL / 4 + 1e-9
    height = surface(x, y)
    frames = record(lambda travel: np.clip((travel + height) / width + 0.5, 0, 1), TRAVEL, fault, seed)
    levels = {"dark": DARK, "bright": DARK + SPAN}
    return engine.reconstruct(frames, travel=TRAVEL, pixel_size=PIXEL, fill=False, **levels, **options)


@pytest.mark.parametrize("method", ["threshold", "change-point"])
@pytest.mark.parametrize("surface", [waves, rough])
def test_a_lost_frame_is_named(surface, method):
    with pytest.warns(match=f"at the height of frame {MIDDLE},"):
        reconstruct(surface, Fault("lost", dropped=True), method=method)


def test_random_errors_are_in_the_standard_deviations():
    result = reconstruct(waves, Fault("jitter", jitter=JITTER))
    error = result.height - waves(*centres(SHAPE, PIXEL))
    assert np.mean((error / result.height_sigma)[3:-3, 3:-3] ** 2) < 1


def test_random_errors_are_estimated():
    notes = reconstruct(waves, Fault("jitter", jitter=JITTER)).process["notes"]
    assert float(notes.split("about ")[1].split()[0]) == pytest.approx(1000 * JITTER * STEP, rel=0.3)


def test_random_errors_that_are_stated_are_not_added_again():
    stated = reconstruct(waves, Fault("jitter", jitter=JITTER), travel_sigma=2 * JITTER * STEP)
    assert "notes" not in stated.process


@pytest.mark.parametrize("surface", [waves, rough, domes_on_a_plate, terraces])
def test_positions_of_a_clean_recording_fit(surface):
    assert {"notes", "warnings"} & set(reconstruct(surface).process) == set()
