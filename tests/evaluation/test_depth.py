"""Scenes that hide parts of themselves: normals, heights and pieces are consistent."""

import numpy as np
import pytest

from mirrorskin.evaluation.bilateral import integrate_bilaterally
from mirrorskin.evaluation.scenes.depth import HELD_OUT, SCENES

SHAPE = 96, 128


def rises(scene):
    """Give the rise of heights along links, in pixels, and that according to the normals of both ends."""
    across, up, towards = np.moveaxis(scene.normals, -1, 0)
    for axis, slope in ((1, -across / towards), (0, up / towards)):
        ends = [np.moveaxis(values, axis, 0) for values in (scene.height, slope, towards, scene.piece)]
        kept = (np.minimum(ends[2][1:], ends[2][:-1]) > 0.4) & (ends[3][1:] == ends[3][:-1])
        rise = np.diff(ends[0], axis=0)[kept] / scene.pixel_size
        yield rise, np.stack([ends[1][1:], ends[1][:-1]])[:, kept]


@pytest.mark.parametrize("name", [*SCENES, "heap 0", "heap 2", "heap 4"])
def test_heights_rise_along_the_normals(name):
    options = {"noise": 0.0} if name == "folds" else {}
    scene = (SCENES | HELD_OUT)[name](SHAPE, **options)
    assert scene.mask[SHAPE[0] // 2].any()
    assert np.array_equal(np.isfinite(scene.height), scene.mask)
    assert np.array_equal(scene.piece >= 0, scene.mask)
    for rise, slopes in rises(scene):
        smooth = np.abs(slopes[0] - slopes[1]) < 0.1
        away = np.abs(rise - slopes.mean(axis=0))[smooth]
        assert np.quantile(away, 0.9) < 0.01  # the rest are cliffs between level steps


def test_heaps_are_the_same_each_time_and_differ_from_each_other():
    heap, again, other = (HELD_OUT[f"heap {k}"]((48, 64)) for k in (2, 2, 3))
    np.testing.assert_array_equal(heap.height, again.height)
    assert heap.mask.mean() > 0.2
    assert heap.piece.max() > 3
    assert not np.array_equal(heap.height, other.height)


def test_errors_are_after_the_offset_of_each_piece():
    scene = SCENES["ball"](SHAPE)
    moved = scene.height + np.where(scene.piece == 1, 3.0, -2.0)
    assert scene.error(moved) == pytest.approx(0, abs=1e-12)
    assert scene.error(moved + 0.1 * np.indices(SHAPE)[0]) > 1


def test_the_published_method_finds_what_is_in_front_and_behind():
    scene = SCENES["ball"](SHAPE)
    height, steps = integrate_bilaterally(scene)
    assert 5 < steps < 150
    assert scene.error(height) < 0.25
