"""An object followed along a stream of results."""

from __future__ import annotations

import numpy as np
import pytest
from moved_surfaces import bumpy, error_of, sampled

from mirrorskin import engine, io


def test_a_stream_is_followed_over_keys_with_true_errors() -> None:
    rng, tracker = np.random.default_rng(0), engine.pose.PoseTracker()
    for number in range(24):
        vector, shift = np.array([0, 0, 0.02 * number]), np.array([0.1 * number, 0.02 * number, 0])
        pose = tracker.push(sampled(bumpy, vector, shift, rng=rng))
        error = error_of(pose, vector, shift)
        if number:
            assert error @ np.linalg.solve(pose.covariance, error) / 6 < 5
    assert tracker.keys > 1


def test_a_result_that_shares_nothing_is_refused() -> None:
    rng, tracker = np.random.default_rng(1), engine.pose.PoseTracker()
    tracker.push(sampled(bumpy, rng=rng))
    with pytest.raises(io.InputError, match="share too few pixels"):
        tracker.push(sampled(bumpy, shift=(50, 0, 0), rng=rng))
