"""Elastic contact, compared with closed forms of contact mechanics and with dense matrices."""

from __future__ import annotations

from collections.abc import Callable

import contact_theory
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import optimize

from mirrorskin.twin import elastic
from mirrorskin.twin.elastic import TOLERANCE, Contact, HalfSpace, press

Map = NDArray[np.float64]

MODULUS = 0.7
BALL, CURVATURE, STEEPNESS = 5.0, 4.0, 0.4
SIDE, PIXEL = 231, 0.03


def centres(shape: tuple[int, int], pixel_size: tuple[float, float]) -> tuple[Map, Map]:
    row, column = np.indices(shape, dtype=float)
    return (column - (shape[1] - 1) / 2) * pixel_size[0], ((shape[0] - 1) / 2 - row) * pixel_size[1]


def space(shape: tuple[int, int], pixel_size: tuple[float, float], depth: float = 0.0) -> HalfSpace:
    return HalfSpace(shape, pixel_size, MODULUS, depth)


def ball_fall(r: Map) -> Map:
    return BALL - np.sqrt(np.where(r < BALL, BALL**2 - r**2, np.nan))


BODIES: dict[str, tuple[Callable[[float], contact_theory.Pressed], Callable[[Map], Map]]] = {
    "paraboloid": (
        lambda a: contact_theory.paraboloid(CURVATURE, a, MODULUS),
        lambda r: r**2 / (2 * CURVATURE),
    ),
    "sphere": (lambda a: contact_theory.sphere(BALL, a, MODULUS), ball_fall),
    "cone": (lambda a: contact_theory.cone(STEEPNESS, a, MODULUS), lambda r: STEEPNESS * r),
}


@pytest.mark.parametrize("radius", [1.8, 2.0, 2.2])
@pytest.mark.parametrize("body", BODIES)
def test_bodies_of_revolution_follow_closed_forms(body: str, radius: float) -> None:
    theory, fall = BODIES[body][0](radius), BODIES[body][1]
    r = np.hypot(*centres((SIDE, SIDE), (PIXEL, PIXEL)))
    actual = press(space((SIDE, SIDE), (PIXEL, PIXEL)), theory.depth - fall(r))
    touching = actual.pressure > 0
    assert np.sqrt(touching.sum() * PIXEL**2 / np.pi) == pytest.approx(radius, rel=0.01)
    assert actual.force == pytest.approx(theory.force, rel=0.01)
    assert actual.force / (touching.sum() * PIXEL**2) == pytest.approx(
        theory.force / (np.pi * radius**2), rel=0.01
    )
    # A cone's pressure has no bound at the tip; near the edge a pixel is as wide as the pressure changes.
    well_inside = (r < 0.9 * radius) & (r > (0.1 * radius if body == "cone" else -1))
    np.testing.assert_allclose(actual.pressure[well_inside], theory.pressure(r[well_inside]), rtol=0.01)
    if body != "cone":
        assert actual.pressure.max() == pytest.approx(theory.pressure(np.zeros(1))[0], rel=0.01)
    outside = r > radius
    np.testing.assert_allclose(actual.displacement[outside], theory.surface(r[outside]), rtol=0.01)


@pytest.mark.parametrize("pixel_size", [(0.05, 0.05), (0.04, 0.06)])
@pytest.mark.parametrize("depth", [0.0, 0.05, 0.4])
def test_a_smooth_load_indents_by_its_spectrum(pixel_size: tuple[float, float], depth: float) -> None:
    x, y = centres((90, 101), pixel_size)
    r = np.hypot(x, y)
    actual = space(r.shape, pixel_size, depth).mirror(np.exp(-(r**2) / (2 * 0.3**2)))
    some = np.s_[::11, ::11]
    np.testing.assert_allclose(
        actual[some], contact_theory.gaussian_load(0.3, depth, MODULUS, r[some]), rtol=2e-3
    )


@pytest.mark.parametrize("depth", [0.05, 0.3, 2.0])
def test_below_a_uniform_disc_the_mirror_follows_the_closed_form(depth: float) -> None:
    r = np.hypot(*centres((129, 129), (0.02, 0.02)))
    load = np.where(r < 1.0, 2.0, 0.0)
    radius = np.sqrt((load > 0).sum() * 0.02**2 / np.pi)
    on_axis = space(r.shape, (0.02, 0.02), depth).mirror(load)[64, 64]
    assert on_axis == pytest.approx(contact_theory.disc_on_axis(2.0, radius, depth, MODULUS), rel=1e-3)


@pytest.mark.parametrize("shape", [(1, 1), (1, 6), (5, 1), (4, 7), (8, 8)])
def test_nothing_comes_round_from_the_other_side(shape: tuple[int, int]) -> None:
    pixel_size = (0.3, 0.05)
    matrix = contact_theory.rectangle_responses(shape, pixel_size, MODULUS)
    load = np.random.default_rng(2).random(shape)
    expected = (matrix @ load.ravel()).reshape(shape)
    np.testing.assert_allclose(space(shape, pixel_size).surface(load), expected, rtol=1e-8)


@pytest.mark.parametrize("compliance", [0.0, 0.3])
@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (7, 1), (9, 13)])
def test_rough_objects_rest_where_a_dense_solver_puts_them(shape: tuple[int, int], compliance: float) -> None:
    pixel_size = (0.2, 0.1)
    obstacle = np.random.default_rng(3).uniform(-0.3, 0.6, shape)
    obstacle.flat[0] = 0.5  # something always touches
    matrix = contact_theory.rectangle_responses(shape, pixel_size, MODULUS) + compliance * 0.2 * 0.1
    # Least of p K p / 2 - p h over p >= 0 is least of |R p - R^-T h|, with K = R^T R.
    root = np.linalg.cholesky(matrix).T
    expected, _ = optimize.nnls(root, np.linalg.solve(root.T, obstacle.ravel()))
    actual = press(space(shape, pixel_size), obstacle, compliance=compliance)
    assert (expected > 0).any()
    scale = expected.max()
    np.testing.assert_allclose(actual.pressure.ravel(), expected, rtol=0, atol=1e-4 * scale)


def rough(shape: tuple[int, int]) -> Map:
    y, x = np.indices(shape, dtype=float)
    return 0.05 * np.random.default_rng(4).normal(size=shape) + 0.5 * np.cos(x / 9) * np.cos(y / 7)


def assert_at_rest(actual: Contact, obstacle: Map, compliance: float = 0.0) -> None:
    gap = np.nan_to_num(actual.displacement + compliance * actual.force - obstacle, nan=np.inf)
    tolerance = 1.01 * TOLERANCE * np.nanmax(obstacle)
    assert (actual.pressure >= 0).all()
    assert gap.min() >= -tolerance
    assert np.abs(gap[actual.pressure > 0]).max() <= tolerance
    assert (actual.pressure > 0).any()


@pytest.mark.parametrize("compliance", [0.0, 0.1, 5.0])
@pytest.mark.parametrize("shape", [(64, 64), (51, 90)])
def test_pressure_and_gap_exclude_each_other(shape: tuple[int, int], compliance: float) -> None:
    obstacle = rough(shape)
    obstacle[10:14, :20] = np.nan
    actual = press(space(shape, (0.05, 0.08)), obstacle, compliance=compliance)
    assert_at_rest(actual, obstacle, compliance)
    assert (actual.pressure[10:14, :20] == 0).all()
    assert actual.force == pytest.approx(0.05 * 0.08 * actual.pressure.sum())


def test_a_flexible_stage_takes_its_share_of_the_travel() -> None:
    travel, compliance = 1.2, 0.15
    r = np.hypot(*centres((161, 161), (0.03, 0.03)))
    actual = press(space(r.shape, (0.03, 0.03)), travel - r**2 / (2 * CURVATURE), compliance=compliance)
    depth = travel - compliance * actual.force
    hertz = contact_theory.paraboloid(CURVATURE, np.sqrt(CURVATURE * depth), MODULUS)
    assert 0.2 < depth < 0.8 * travel
    assert actual.force == pytest.approx(hertz.force, rel=0.002)


def test_a_press_that_does_not_come_to_rest_reports_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(elastic, "ITERATIONS", 3)
    with pytest.raises(RuntimeError, match="did not converge in 3 iterations"):
        press(space((40, 40), (0.1, 0.1)), rough((40, 40)))


def test_maps_of_another_shape_are_refused() -> None:
    with pytest.raises(ValueError, match="does not fit"):
        press(space((4, 5), (0.1, 0.1)), np.zeros((5, 4)))
    with pytest.raises(ValueError, match="does not fit"):
        press(space((4, 5), (0.1, 0.1)), np.zeros((4, 5)), start=np.zeros((5, 4)))
