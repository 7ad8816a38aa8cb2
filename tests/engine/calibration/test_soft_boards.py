"""Boards in soft, dim and noisy pictures are found, with their marks at the right places."""

import functools
from itertools import product

import boards
import numpy as np
import pytest

from mirrorskin.engine.calibration.board import Charuco, Dots
from mirrorskin.engine.calibration.lens import locate_marks

BOARDS = {
    "charuco": (Charuco(7, 5, 2.0, 1.5), boards.charuco(7, 5, 2.0, 1.5)),
    "dots": (Dots(11, 9, 1.0), boards.dots(11, 9, 1.0, 0.5)),
}
SHAPE, POSE = (300, 400), (8.0, 0.2, -0.1)
VIEWS = {
    "level": (boards.View(SHAPE, 0.042, 400.0), None),
    "tilted": (boards.View(SHAPE, 0.042, 400.0, tilt=25, towards=30), None),
    "unevenly lit": (boards.View(SHAPE, 0.042, 400.0), boards.uneven_light(SHAPE)),
}
BLURS, CONTRASTS, NOISES = (1, 2, 3, 4), (20, 40, 60), (2, 5)
BLACK = 30  # counts
QUICK = {"level": (4, 60, 2), "tilted": (2, 20, 2), "unevenly lit": (4, 60, 2)}  # blur, contrast, noise
TOO_FAINT = (4, 20, 5)


@functools.cache
def sharp_view(board, view, blur):
    return boards.photograph(
        VIEWS[view][0], BOARDS[board][1], POSE, blur=blur, dtype=np.float64, counts=(0, 1)
    )


def taken(board, view, blur, contrast, noise):
    """Return the picture, (H, W), uint8."""
    light = 1.0 if VIEWS[view][1] is None else VIEWS[view][1]
    samples = light * (BLACK + contrast * sharp_view(board, view, blur))
    samples += noise * np.random.default_rng(blur).standard_normal(SHAPE)
    return np.clip(np.rint(samples), 0, 255).astype(np.uint8)


def worst_error(marks, board, view):
    """Return the largest distance of a mark from its true place, pixels; dots look the same upside down."""
    kind, errors = BOARDS[board][0], []
    true = boards.marks_in(VIEWS[view][0], kind, POSE)
    for side in (1, -1):
        gaps = np.linalg.norm(kind.marks()[:, np.newaxis] - side * marks.board, axis=2)
        errors.append(np.hypot(*(marks.places - true[gaps.argmin(axis=0)]).T).max())
    return min(errors) if board == "dots" else errors[0]


def check(board, view, blur, contrast, noise):
    kind = BOARDS[board][0]
    marks = locate_marks(taken(board, view, blur, contrast, noise), kind, "a.png")
    assert len(marks.board) > 0.9 * len(kind.marks())
    contrast_seen = contrast if VIEWS[view][1] is None else 0.6 * contrast
    assert worst_error(marks, board, view) < 0.15 + 1.2 * (1 + blur) * noise / contrast_seen


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("board", BOARDS)
def test_marks_of_soft_boards_are_located(board, view):
    check(board, view, *QUICK[view])


@pytest.mark.slow
@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("board", BOARDS)
@pytest.mark.parametrize(
    ("blur", "contrast", "noise"),
    [variant for variant in product(BLURS, CONTRASTS, NOISES) if variant != TOO_FAINT],
)
def test_marks_of_all_soft_boards_are_located(board, view, blur, contrast, noise):
    check(board, view, blur, contrast, noise)


def test_uneven_light_does_not_move_marks():
    level, uneven = (
        locate_marks(taken("charuco", view, 2, 60, 2), BOARDS["charuco"][0], "a.png")
        for view in ("level", "unevenly lit")
    )
    assert np.abs(level.places - uneven.places).max() < 0.15
