"""A dark level that drifts during a press is warned of, and nothing is without a fault."""

import itertools

import numpy as np
import pytest

from mirrorskin import engine
from mirrorskin.evaluation.faults.camera import Fault, points, record
from mirrorskin.io import MirrorskinWarning

SHAPE, PIXEL = (36, 48), 0.05
TRAVEL = np.arange(0.0, 1.0, 0.05)
PENUMBRA = 0.02  # mm of travel in which a point turns light
BITS, BLURS = (8, 10, 12), (0.0, 1.5, 2.5)  # blurs in pixels
DEPTHS = (1.05, 1.3)  # mm; the press ends before
X, Y = points(SHAPE, PIXEL)
RADIUS = np.hypot(X, Y)


def staircase(depth):
    tread = np.floor(8 * (X - X[0, 0]) / np.ptp(X)).clip(0, 7)
    return -depth * (tread + 0.5) / 8 + 0 * Y


SURFACES = {
    "staircase": staircase,
    "ball": lambda depth: depth * (np.sqrt(1.01 - (RADIUS / RADIUS.max()) ** 2) - 1.01),
    "cone": lambda depth: -depth * RADIUS / RADIUS.max(),
    "plane": lambda depth: depth * (X - X.max()) / np.ptp(X) + 0 * Y,
    "texture": lambda depth: depth * (np.sin(4 * X) * np.cos(3 * Y) - 1) / 2,
    "needle": lambda depth: np.where(RADIUS < 0.3, -0.2, -3 * depth),
}


def pressed(height, event="onset", **fault):
    """Return the result of a press, or a release, as recorded by an independent camera with a fault."""
    travel = TRAVEL[::-1] if event == "release" else TRAVEL

    def light(at):
        return np.clip((at + height) / PENUMBRA + 0.5, 0, 1)

    frames = record(light, travel, Fault("", **fault), seed=1)
    return engine.reconstruct(frames, travel=travel, pixel_size=PIXEL, event=event, fill=False)


@pytest.mark.parametrize("bits", BITS)
@pytest.mark.parametrize("surface", SURFACES)
def test_a_press_without_a_fault_has_no_warning(surface, bits):
    for depth, blur in itertools.product(DEPTHS, BLURS):
        result = pressed(SURFACES[surface](depth), bits=bits, blur=blur)
        assert "warnings" not in result.process, (depth, blur)


@pytest.mark.parametrize("blur", BLURS)
def test_a_release_without_a_fault_has_no_warning(blur):
    assert "warnings" not in pressed(staircase(DEPTHS[0]), "release", blur=blur).process


@pytest.mark.parametrize("drift", [-5.0, 5.0])
@pytest.mark.parametrize("bits", BITS)
@pytest.mark.parametrize("surface", SURFACES)
def test_a_dark_level_that_drifts_is_warned_of(surface, bits, drift):
    with pytest.warns(MirrorskinWarning, match="the dark level drifts by"):
        result = pressed(SURFACES[surface](3.0), bits=bits, blur=1.0, drift=drift)
    assert "the dark level drifts by" in result.process["warnings"]


def test_a_drift_is_seen_where_all_pixels_turn_light():
    with pytest.warns(MirrorskinWarning, match="the dark level drifts by"):
        pressed(staircase(0.8), drift=10.0)
