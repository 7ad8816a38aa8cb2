"""Robust integration of figures on which none of its constants was chosen: no harm, and true errors."""

from functools import cache

import numpy as np
import pytest

from mirrorskin import engine
from mirrorskin.evaluation.scenes.figures import HELD_OUT, doll, random_figure

SHAPE = 64, 64
NAMES = "figure 100", "figure 106", "figure 115", "figure 124", "figure 127"


@cache
def integrated(number, robust):
    figure = random_figure(number, SHAPE)
    return figure, engine.integrate(**figure.arguments(), robust=robust)


@pytest.mark.parametrize("number", [100, 106, 115, 124, 127])
def test_robust_heights_are_not_worse_than_plain_ones(number):
    figure, robust = integrated(number, True)
    _, plain = integrated(number, False)
    assert figure.error(robust.height) <= 1.1 * figure.error(plain.height)


@pytest.mark.parametrize("number", [100, 106, 124, 127])
def test_standard_deviations_contain_what_breaks_leave_open(number):
    figure, robust = integrated(number, True)
    scores = figure.scores(robust)
    scores = scores[np.isfinite(scores)]
    assert len(scores) > 0.9 * figure.mask.sum()
    assert np.mean(scores**2) <= 2
    assert np.mean(np.abs(scores) > 3) <= 0.02


@pytest.mark.slow
def test_no_held_out_figure_is_worse_than_plain():
    ratios, chi_squares = [], []
    for make in HELD_OUT.values():
        figure = make()
        plain, robust = (engine.integrate(**figure.arguments(), robust=which) for which in (False, True))
        ratios.append(figure.error(robust.height) / figure.error(plain.height))
        scores = figure.scores(robust)
        chi_squares.append(np.nanmean(scores**2))
    assert max(ratios) <= 1.1
    assert np.mean(np.array(chi_squares) <= 2) >= 0.8


def test_relative_heights_of_parts_are_unknown():
    figure = doll(SHAPE, pinhole=True)
    surface = engine.integrate(**figure.arguments(), robust=True, sigma=False)
    assert 2 <= len(surface.offset_unknown) <= 12
    assert surface.offset_unknown.all()
    assert surface.component[figure.mask].min() == 0


def test_the_mean_of_all_parts_is_that_of_the_surface():
    figure = doll(SHAPE, pinhole=False)
    surface = engine.integrate(**figure.arguments(), robust=True, sigma=False)
    assert len(surface.offset_unknown) > 1
    assert float(np.nanmean(surface.height)) == pytest.approx(0, abs=1e-3)
