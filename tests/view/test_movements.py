"""What figures of slip and of motion tell, of made answers whose errors are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mirrorskin import engine, io, view

HERE = np.zeros((4, 5))
CONTACT = np.array([[0, 1, 1, 1, 0]] * 4, bool)
ONSET = np.where([[True, True, True, False, True]] * 4, np.arange(5.0), np.nan)


def slipped(**changed: object) -> view.Slipped:
    moved = np.zeros((3, 4, 5, 2), np.float32)
    truth = io.Truth(HERE, HERE, HERE, CONTACT, **({"displacement": moved, "slip_onset": ONSET} | changed))  # type: ignore[arg-type]
    found = io.Result(
        displacement=moved[-1] + np.float32(0.25),
        slip_onset=(ONSET + 0.5).astype(np.float32),
        stick_ratio=np.ones(3),
        slide_distance=np.array([0.0, 1.0, 2.0]),
    )
    return view.Slipped(found, truth, CONTACT, np.ones(3), np.arange(5.0), np.arange(4.0)[::-1])


def test_errors_of_slip_are_found_less_true_in_contact() -> None:
    assert np.unique(slipped().onset_error[:, 1:3]).tolist() == [0.5]
    assert np.isnan(slipped().onset_error[:, [0, 3, 4]]).all()
    assert np.unique(slipped().displacement_error).tolist() == [0.25]


def test_what_truly_sticks_is_what_has_not_yet_slipped() -> None:
    np.testing.assert_allclose(slipped().true_ratio, [1, 2 / 3, 1 / 3])


def test_slip_without_truth_is_refused() -> None:
    with pytest.raises(io.InputError, match="needs a truth with displacement and slip onset"):
        slipped(slip_onset=None)


def followed(first: io.Result) -> view.Followed:
    vector, shift, error = np.array([0.1, 0.2, -0.3]), np.array([1.0, 2.0, 0.5]), np.array([0.01, 0.0, -0.02])
    turn = Rotation.from_rotvec(error)
    found = engine.pose.Pose(
        rotation=(turn * Rotation.from_rotvec(vector)).as_rotvec(),
        translation=turn.apply(shift) + np.array([0.03, 0.02, 0.01]),
        covariance=np.diag(np.arange(1.0, 7.0) ** 2),
        chi_square=1.0,
        pixels=1,
        undetermined=np.zeros((0, 6)),
    )
    return view.Followed(first, first, [found], vector[None], shift[None])


def test_errors_of_motion_are_the_small_motion_that_is_too_much() -> None:
    told = followed(io.Result())
    np.testing.assert_allclose(told.errors, [[0.01, 0, -0.02, 0.03, 0.02, 0.01]], atol=1e-12)
    np.testing.assert_allclose(told.sigmas, [np.arange(1.0, 7.0)])


def test_motion_without_heights_is_refused(tmp_path: Path) -> None:
    with pytest.raises(io.InputError, match="needs results with a height"):
        view.pose_figure(followed(io.Result()), "title", tmp_path / "pose.png")
