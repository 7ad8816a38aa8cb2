"""The ball of 10 mm as one surface: on data of eq. 10, on the twin's frames, and from a press alone."""

from functools import cache

import fused_ball
import geometry
import numpy as np
import pytest
from fused_ball import judge, pressed, turned, within
from stacks import ball

from mirrorskin import engine
from mirrorskin.engine.fusion import fuse_sources

SHAPE, PIXEL = (121, 125), 0.07
TWIN, TWIN_PIXEL = (101, 105), 0.072


@cache
def fused(name, step, seed=3):
    turn = turned(name, SHAPE, PIXEL, seed=seed)
    return engine.fuse(pressed(step, SHAPE, PIXEL), turn, PIXEL)


@pytest.mark.parametrize("step", [0.1, 0.01])
@pytest.mark.parametrize("name", ["uint8", "uint16"])
def test_the_ball_is_whole_and_true_on_data_of_equation_10(name, step):
    found = fused(name, step)
    told = judge(found.height, 55, PIXEL)
    assert told.answered >= 0.99
    assert told.rms <= 0.003
    assert told.apex <= 0.003
    assert told.radius == pytest.approx(geometry.SPHERE_RADIUS, abs=0.01)
    assert not found.offset_unknown[found.component[60, 62]]


def test_sigma_of_the_fused_ball_is_of_the_error_s_size():
    expected = geometry.sphere(SHAPE, PIXEL).height
    squares = []
    for seed in range(2):
        found = fused("uint8", 0.1, seed)
        seen = within(50, SHAPE, PIXEL) & np.isfinite(found.height)
        assert np.isfinite(found.sigma[seen]).all()
        squares.append(np.mean(((found.height - expected)[seen] / found.sigma[seen]) ** 2))
    assert 0.3 <= np.mean(squares) <= 3


@pytest.mark.parametrize("pivot", [(0.0, 0.0, 0.0), (0.0, 0.0, 1.25)], ids=["sheet", "apex"])
def test_the_ball_is_true_on_the_twins_frames(pivot):
    sources = fused_ball.twins(TWIN, TWIN_PIXEL, 0.1, 20, pivot=pivot)
    told = judge(fuse_sources(*sources).height, 38, TWIN_PIXEL)
    assert told.answered >= 0.99
    assert told.rms <= 0.010
    assert told.apex <= 0.010
    assert told.radius == pytest.approx(geometry.SPHERE_RADIUS, abs=0.01)


def test_the_hole_of_a_press_alone_is_closed():
    shape, pixel = (111, 111), 0.08
    source = ball(shape, pixel, 0.01 * np.arange(1, 161), noise=1.5, seed=7)
    found = engine.reconstruct(source)
    error = found.height - geometry.sphere(shape, pixel).height
    hole = within(11, shape, pixel)
    np.testing.assert_array_equal(found.filled[hole], 1)
    assert np.abs(error[hole]).max() <= 0.020  # the apex in the middle
    beyond = ~within(50, shape, pixel)
    assert beyond.sum() > 100
    np.testing.assert_array_equal(found.filled[beyond], 0)
