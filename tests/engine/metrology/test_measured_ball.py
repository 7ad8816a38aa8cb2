"""The ball that the twin was pressed on and turned about, measured: the radius is within what is claimed."""

import fused_ball
import numpy as np
import pytest

from mirrorskin import engine
from mirrorskin.engine.fusion import fuse_sources
from mirrorskin.engine.metrology.forms import fit_sphere


@pytest.fixture(scope="module")
def fused():
    """What the engine makes of 8 bits, noise, and a wall as the demo has them."""
    press, turn = fused_ball.twins((61, 61), 0.2, 0.1, 30, noise=1.0)
    return fuse_sources(press, turn)


def test_the_radius_of_a_fused_ball_is_covered_by_its_uncertainty(fused):
    told = engine.measure(fused).quantities
    radius = told["sphere radius"]
    assert radius.value == pytest.approx(5, abs=0.01)
    assert abs(radius.value - 5) < 2 * radius.sigma < 0.02
    top = told["sphere top"]
    assert abs(top.value) < 2 * top.sigma < 0.01


def test_of_the_press_alone_the_radius_is_less_sure_but_covered(fused):
    press, _ = fused_ball.twins((61, 61), 0.2, 0.1, 30, noise=1.0)
    result = engine.reconstruct(press)
    sphere = fit_sphere(
        np.where(result.filled, np.nan, result.height), result.x, result.y, result.height_sigma
    )
    assert abs(sphere.radius.value - 5) < 2 * sphere.radius.sigma
    assert sphere.radius.sigma > 5 * engine.measure(fused).quantities["sphere radius"].sigma
