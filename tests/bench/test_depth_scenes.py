"""Scenes that hide parts of themselves: normals, heights and pieces belong together."""

import numpy as np
import pytest
from suite.bilateral import integrate_bilaterally
from suite.depth_scenes import HELD_OUT, SCENES

from mirrorskin.engine import Camera

SHAPE = 96, 128


def rises(scene):
    """Give the rise of heights, or their logarithms, along links, and what normals of both ends say."""
    across, up, towards = np.moveaxis(scene.normals, -1, 0)
    unit, heights = scene.pixel_size, scene.height
    if scene.camera:
        row, column = np.indices(SHAPE)
        x, y = scene.camera.principal_point
        towards = ((column - x) * across + (y - row) * up) / scene.camera.focal_length - towards
        unit, heights = 1 / scene.camera.focal_length, np.log(heights)
    for axis, slope in ((1, -across / towards), (0, up / towards)):
        ends = [np.moveaxis(one, axis, 0) for one in (heights, unit * slope, towards, scene.piece)]
        kept = (np.minimum(*(np.abs(ends[2][part]) for part in (np.s_[1:], np.s_[:-1]))) > 0.4) & (
            ends[3][1:] == ends[3][:-1]
        )
        yield np.diff(ends[0], axis=0)[kept] / unit, np.stack([ends[1][1:], ends[1][:-1]])[:, kept] / unit


@pytest.mark.parametrize("name", [*SCENES, "heap 0", "heap 2", "heap 4"])
def test_heights_rise_as_normals_say(name):
    known = {"noise": 0.0} if name in ("bear", "folds") else {}
    scene = (SCENES | HELD_OUT)[name](SHAPE, **known)
    assert scene.mask[SHAPE[0] // 2].any()
    assert np.array_equal(np.isfinite(scene.height), scene.mask)
    assert np.array_equal(scene.piece >= 0, scene.mask)
    for rise, said in rises(scene):
        smooth = np.abs(said[0] - said[1]) < 0.1
        away = np.abs(rise - said.mean(axis=0))[smooth]
        assert np.quantile(away, 0.9) < 0.01  # the rest are cliffs between level steps


def test_heaps_are_the_same_each_time_and_differ_from_each_other():
    one, again, other = (HELD_OUT[f"heap {k}"]((48, 64)) for k in (2, 2, 3))
    np.testing.assert_array_equal(one.height, again.height)
    assert one.mask.mean() > 0.2
    assert one.piece.max() > 3
    assert not np.array_equal(one.height, other.height)


def test_errors_are_after_each_piece_s_offset_or_scale():
    level = SCENES["ball"](SHAPE)
    moved = level.height + np.where(level.piece == 1, 3.0, -2.0)
    assert level.error(moved) == pytest.approx(0, abs=1e-12)
    assert level.error(moved + 0.1 * np.indices(SHAPE)[0]) > 1
    seen = SCENES["balls"](SHAPE)
    assert isinstance(seen.camera, Camera)
    assert seen.error(seen.height * np.where(seen.piece == 1, 0.5, 2e-3)) == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize(("name", "most"), [("ball", 0.25), ("balls", 0.5)])
def test_the_published_method_finds_what_is_before_and_behind(name, most):
    scene = SCENES[name](SHAPE)
    found, steps = integrate_bilaterally(scene)
    assert 5 < steps < 150
    assert scene.error(found) < most
