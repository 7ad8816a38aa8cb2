"""Scores against errors that were put in by hand."""

import numpy as np
import pytest

from mirrorskin import engine, io

NAN = np.float32(np.nan)


def truth_of(height, contact=None):
    flat = np.zeros_like(height)
    touched = np.ones(height.shape, np.uint8) if contact is None else np.array(contact, np.uint8)
    return io.Truth(height, flat, flat, touched)


def test_errors_are_what_they_are():
    truth = truth_of(np.zeros((2, 3), np.float32), [[1, 1, 1], [1, 0, 0]])
    height = np.array([[0.3, -0.1, NAN], [0.1, 0.1, NAN]], np.float32)
    sigma = np.full((2, 3), 0.1, np.float32)
    score = engine.score(io.Result(height=height, height_sigma=sigma), truth)
    assert (score.answered, score.touched) == (4, 4)
    assert score.coverage == pytest.approx(0.75)
    assert score.rms == pytest.approx(np.sqrt(0.03))
    assert score.mean == pytest.approx(0.1)
    assert score.median == pytest.approx(0.1)
    assert score.largest == pytest.approx(0.3)
    assert score.chi_square == pytest.approx(3.0)


def test_no_answer_at_all_is_scored_too():
    height = np.full((2, 2), NAN)
    score = engine.score(io.Result(height=height), truth_of(np.zeros((2, 2), np.float32)))
    assert score.answered == 0
    assert score.coverage == 0
    assert np.isnan([score.rms, score.mean, score.chi_square]).all()
    assert str(engine.summarise(io.Result(height=height))) == "no height at any of 4 pixels"


def test_what_cannot_be_compared_is_refused():
    truth = truth_of(np.zeros((2, 2), np.float32))
    with pytest.raises(io.InputError, match="no heights"):
        engine.score(io.Result(), truth)
    with pytest.raises(io.InputError, match="not of one stack"):
        engine.score(io.Result(height=np.zeros((2, 3), np.float32)), truth)


def test_the_far_end_is_the_99th_percentile():
    height = np.arange(1, 102, dtype=np.float32).reshape(1, 101)
    sigma = np.where(height > 50, 0, height).astype(np.float32)  # of a sigma of 0 no ratio can be told
    truth = truth_of(np.zeros_like(height), np.zeros_like(height))
    score = engine.score(io.Result(height=height, height_sigma=sigma), truth)
    assert score.p99 == pytest.approx(100)
    assert score.chi_square == pytest.approx(1)
    assert np.isnan(score.coverage)
    summary = engine.summarise(io.Result(height=height))
    assert (summary.lowest, summary.highest, summary.answered) == (1, 101, 101)
