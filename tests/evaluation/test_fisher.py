"""The bound of a calibration from touches, against closed forms of planes."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from mirrorskin.evaluation.calibration import fisher

EXACT = 1e-7  # mm: a press whose heights are as good as known


def plane(zenith: float, shape: tuple[int, int] = (6, 8)) -> np.ndarray:
    x, _ = np.meshgrid(np.arange(shape[1]) * fisher.PIXEL, np.arange(shape[0]))
    return -math.tan(zenith) * x


def known_but(*names: str) -> dict[str, float]:
    return {name: 0.0 for name in fisher.NAMES if name not in names}


def test_two_known_normals_give_the_bound_of_a_straight_line() -> None:
    sensor, zeniths, frames = fisher.Sensor(), (0.15, 0.4), 12
    touches = [fisher.bound(plane(zenith), press_sigma=EXACT) for zenith in zeniths]
    prior = fisher.bound(plane(0.15), priors=known_but("gain", "offset")).prior
    both = fisher.Bound(touches[0].information + touches[1].information, prior).sigmas()
    phase, half = np.arange(frames) * 2 * np.pi / frames, sensor.half_angle
    angle = np.concatenate(
        [
            np.arccos(math.cos(z) * math.cos(half) - math.sin(z) * math.sin(half) * np.cos(phase))
            for z in zeniths
        ]
    )
    line = np.stack([angle, np.ones_like(angle)], axis=1)
    covariance = sensor.noise**2 * np.linalg.inv(48 * line.T @ line)
    assert [both["gain"], both["offset"]] == pytest.approx(np.sqrt(np.diag(covariance)), rel=1e-3)


def test_a_turned_plane_gives_the_gain_as_well_as_the_half_angle_is_known() -> None:
    sensor, frames, share = fisher.Sensor(), 12, 0.01
    priors = known_but("gain") | {"half-angle": share * sensor.half_angle}
    sigma = fisher.bound(plane(0.4), press_sigma=None, priors=priors).sigmas()["gain"]
    swing = sensor.gain * sensor.half_angle
    expected = math.hypot(share, sensor.noise / swing * math.sqrt(2 / (48 * frames)))
    assert sigma / sensor.gain == pytest.approx(expected, rel=0.01)


def test_a_turned_plane_does_not_tell_gain_from_half_angle() -> None:
    known = known_but("gain", "half-angle")
    sigmas = fisher.bound(plane(0.4, (20, 20)), press_sigma=None, priors=known).sigmas()
    assert sigmas["gain"] > fisher.Sensor.gain / 2


def test_the_bound_falls_with_the_square_root_of_the_touches() -> None:
    touch = fisher.bound(fisher.woven(*fisher.axes()))
    four = fisher.Bound(4 * touch.information, touch.prior).sigmas()
    assert four["gain"] == pytest.approx(touch.sigmas()["gain"] / 2)


def test_the_stored_table_is_that_of_the_program() -> None:
    stored = json.loads(fisher.STORED.read_text(encoding="utf-8"))
    measured = fisher.measure()
    for case, rows in stored.items():
        for name, row in rows.items():
            assert measured[case][name] == pytest.approx(row, rel=0.01), (case, name)


def test_the_page_has_the_stored_table() -> None:
    page, stored = (path.read_text(encoding="utf-8") for path in (fisher.PAGE, fisher.STORED))
    assert fisher.with_table(page, fisher.as_text(json.loads(stored))) == page
