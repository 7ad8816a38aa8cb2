"""The camera's lines of sight inside the body, compared with Snell, Fermat and straight lines."""

from __future__ import annotations

import numpy as np
import pytest

from mirrorskin.io.base.types import InputError
from mirrorskin.twin.body import Body
from mirrorskin.twin.view import View

SHAPE, PIXEL = (13, 17), (2.0, 2.4)


def at_top(view: View, body: Body) -> tuple[np.ndarray, np.ndarray]:
    """Where the lines of sight cross the body's top."""
    return view.x + body.height * view.slope_x, view.y + body.height * view.slope_y


def test_an_orthographic_camera_looks_straight_down() -> None:
    view = View(SHAPE, PIXEL, Body(), np.inf)
    assert view.orthographic
    assert not view.slope_x.any()
    assert not view.slope_y.any()
    assert view.x[0, -1] == pytest.approx(16.0)
    assert view.y[0, 0] == pytest.approx(14.4)


@pytest.mark.parametrize("distance", [40.001, 60.0, 200.0, 5000.0])
@pytest.mark.parametrize("index", [1.0, 1.41, 2.0])
def test_lines_are_refracted_at_the_top_towards_the_pinhole(distance: float, index: float) -> None:
    body = Body(index=index)
    view = View(SHAPE, PIXEL, body, distance)
    assert not view.orthographic
    x, y = at_top(view, body)
    in_air = np.hypot(x, y) / np.hypot(np.hypot(x, y), distance - body.height)
    slope = np.hypot(view.slope_x, view.slope_y)
    inside = slope / np.sqrt(1 + slope**2)
    np.testing.assert_allclose(in_air, index * inside, rtol=0, atol=1e-9)
    # In one plane with the axis, towards which they lean.
    np.testing.assert_allclose(view.slope_x * view.y, view.slope_y * view.x, atol=1e-12)
    assert (view.slope_x * view.x + view.slope_y * view.y <= 0).all()


@pytest.mark.parametrize("distance", [40.0, 39.0, 0.0, -50.0, -np.inf, np.nan])
def test_a_camera_must_be_above_the_body(distance: float) -> None:
    with pytest.raises(InputError, match=r"use more than 40\.0 mm"):
        View(SHAPE, PIXEL, Body(), distance)
