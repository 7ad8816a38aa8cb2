"""Elastic contact against the closed forms of contact mechanics, and against dense matrices."""

from __future__ import annotations

from collections.abc import Callable

import contact_theory
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import optimize

from mirrorskin.hw.twin import elastic
from mirrorskin.hw.twin.elastic import TOLERANCE, Contact, HalfSpace, press

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
def test_bodies_of_revolution_are_those_of_the_books(body: str, radius: float) -> None:
    theory, fall = BODIES[body][0](radius), BODIES[body][1]
    r = np.hypot(*centres((SIDE, SIDE), (PIXEL, PIXEL)))
    found = press(space((SIDE, SIDE), (PIXEL, PIXEL)), theory.depth - fall(r))
    touching = found.pressure > 0
    assert np.sqrt(touching.sum() * PIXEL**2 / np.pi) == pytest.approx(radius, rel=0.01)
    assert found.force == pytest.approx(theory.force, rel=0.01)
    assert found.force / (touching.sum() * PIXEL**2) == pytest.approx(
        theory.force / (np.pi * radius**2), rel=0.01
    )
    # A cone's pressure has no bound at the tip; near the edge a pixel is as wide as the pressure changes.
    well_inside = (r < 0.9 * radius) & (r > (0.1 * radius if body == "cone" else -1))
    np.testing.assert_allclose(found.pressure[well_inside], theory.pressure(r[well_inside]), rtol=0.01)
    if body != "cone":
        assert found.pressure.max() == pytest.approx(theory.pressure(np.zeros(1))[0], rel=0.01)
    outside = r > radius
    np.testing.assert_allclose(found.displacement[outside], theory.surface(r[outside]), rtol=0.01)


@pytest.mark.parametrize("pixel_size", [(0.05, 0.05), (0.04, 0.06)])
@pytest.mark.parametrize("depth", [0.0, 0.05, 0.4])
def test_a_smooth_load_pushes_in_as_its_spectrum_says(pixel_size: tuple[float, float], depth: float) -> None:
    x, y = centres((90, 101), pixel_size)
    r = np.hypot(x, y)
    found = space(r.shape, pixel_size, depth).mirror(np.exp(-(r**2) / (2 * 0.3**2)))
    some = np.s_[::11, ::11]
    np.testing.assert_allclose(
        found[some], contact_theory.gaussian_load(0.3, depth, MODULUS, r[some]), rtol=2e-3
    )


@pytest.mark.parametrize("depth", [0.05, 0.3, 2.0])
def test_below_an_even_disc_the_mirror_is_where_the_books_say(depth: float) -> None:
    r = np.hypot(*centres((129, 129), (0.02, 0.02)))
    load = np.where(r < 1.0, 2.0, 0.0)
    radius = np.sqrt((load > 0).sum() * 0.02**2 / np.pi)
    on_axis = space(r.shape, (0.02, 0.02), depth).mirror(load)[64, 64]
    assert on_axis == pytest.approx(contact_theory.disc_on_axis(2.0, radius, depth, MODULUS), rel=1e-3)


def test_the_mirror_at_the_surface_is_the_surface() -> None:
    load = np.random.default_rng(1).random((9, 14))
    flush = space(load.shape, (0.1, 0.2))
    np.testing.assert_array_equal(flush.mirror(load), flush.surface(load))


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
    found = press(space(shape, pixel_size), obstacle, compliance=compliance)
    assert (expected > 0).any()
    scale = expected.max()
    np.testing.assert_allclose(found.pressure.ravel(), expected, rtol=0, atol=1e-4 * scale)


def rough(shape: tuple[int, int]) -> Map:
    y, x = np.indices(shape, dtype=float)
    return 0.05 * np.random.default_rng(4).normal(size=shape) + 0.5 * np.cos(x / 9) * np.cos(y / 7)


def assert_at_rest(found: Contact, obstacle: Map, compliance: float = 0.0) -> None:
    gap = np.nan_to_num(found.displacement + compliance * found.force - obstacle, nan=np.inf)
    tolerance = 1.01 * TOLERANCE * np.nanmax(obstacle)
    assert (found.pressure >= 0).all()
    assert gap.min() >= -tolerance
    assert np.abs(gap[found.pressure > 0]).max() <= tolerance
    assert (found.pressure > 0).any()


@pytest.mark.parametrize("compliance", [0.0, 0.1, 5.0])
@pytest.mark.parametrize("shape", [(64, 64), (51, 90)])
def test_pressure_and_gap_exclude_each_other(shape: tuple[int, int], compliance: float) -> None:
    obstacle = rough(shape)
    obstacle[10:14, :20] = np.nan
    found = press(space(shape, (0.05, 0.08)), obstacle, compliance=compliance)
    assert_at_rest(found, obstacle, compliance)
    assert (found.pressure[10:14, :20] == 0).all()
    assert found.force == pytest.approx(0.05 * 0.08 * found.pressure.sum())


def test_an_object_that_does_not_reach_the_sheet_leaves_it_flat() -> None:
    for height in (-0.5, 0.0, np.nan):
        found = press(space((12, 15), (0.1, 0.1)), np.full((12, 15), height))
        assert found.force == 0
        assert not found.pressure.any()
        assert not found.displacement.any()


def test_a_needle_presses_on_its_pixel_only() -> None:
    obstacle = np.full((11, 12), np.nan)
    obstacle[3, 4] = 0.2
    found = press(space(obstacle.shape, (0.1, 0.1)), obstacle)
    assert np.argwhere(found.pressure).tolist() == [[3, 4]]
    # The centre of an evenly loaded square of side l goes in by p l ln(1 + sqrt 2) 4 (1 - 0.25) / (pi E).
    expected = 0.2 * np.pi * MODULUS / (3 * 0.1 * np.log(1 + np.sqrt(2)))
    assert found.pressure[3, 4] == pytest.approx(expected, rel=1e-5)


def test_a_plate_as_large_as_the_grid_presses_hardest_at_its_corners() -> None:
    found = press(space((21, 34), (0.1, 0.1)), np.ones((21, 34)))
    assert (found.pressure > 0).all()
    assert np.unravel_index(found.pressure.argmax(), found.pressure.shape) in {
        (0, 0),
        (0, 33),
        (20, 0),
        (20, 33),
    }
    np.testing.assert_allclose(found.displacement, 1, rtol=1e-5)


def test_a_flexible_stage_takes_its_share_of_the_travel() -> None:
    travel, compliance = 1.2, 0.15
    r = np.hypot(*centres((161, 161), (0.03, 0.03)))
    found = press(space(r.shape, (0.03, 0.03)), travel - r**2 / (2 * CURVATURE), compliance=compliance)
    depth = travel - compliance * found.force
    hertz = contact_theory.paraboloid(CURVATURE, np.sqrt(CURVATURE * depth), MODULUS)
    assert 0.2 < depth < 0.8 * travel
    assert found.force == pytest.approx(hertz.force, rel=0.002)


def test_any_start_leads_to_the_same_rest() -> None:
    obstacle = rough((70, 75))
    half_space = space(obstacle.shape, (0.05, 0.05))
    cold = press(half_space, obstacle)
    for start in (
        press(half_space, obstacle - 0.05).pressure,
        press(half_space, obstacle + 0.1).pressure,
        np.random.default_rng(5).exponential(10.0, obstacle.shape),
    ):
        warm = press(half_space, obstacle, start=start)
        np.testing.assert_allclose(warm.pressure, cold.pressure, rtol=0, atol=1e-4 * cold.pressure.max())
        assert warm.force == pytest.approx(cold.force, rel=1e-5)
    assert press(half_space, obstacle, start=cold.pressure).iterations == 0


def test_a_shifted_turned_or_mirrored_object_presses_as_before() -> None:
    obstacle = np.full((60, 60), -0.1)
    obstacle[20:38, 15:41] = rough((18, 26)) + 0.2
    found = press(space((60, 60), (0.05, 0.05)), obstacle).pressure
    assert (found > 0).sum() > 100

    def again(changed: Map) -> Map:
        return press(space((60, 60), (0.05, 0.05)), changed).pressure

    close = {"rtol": 0, "atol": 1e-4 * float(found.max())}
    np.testing.assert_allclose(
        again(np.roll(obstacle, (-15, 9), (0, 1))), np.roll(found, (-15, 9), (0, 1)), **close
    )
    np.testing.assert_allclose(again(np.rot90(obstacle)), np.rot90(found), **close)
    np.testing.assert_allclose(again(obstacle[:, ::-1]), found[:, ::-1], **close)


def test_a_press_that_does_not_come_to_rest_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(elastic, "ITERATIONS", 3)
    with pytest.raises(RuntimeError, match="did not come to rest in 3 iterations"):
        press(space((40, 40), (0.1, 0.1)), rough((40, 40)))


def test_maps_of_another_shape_are_refused() -> None:
    with pytest.raises(ValueError, match="does not fit"):
        press(space((4, 5), (0.1, 0.1)), np.zeros((5, 4)))
    with pytest.raises(ValueError, match="does not fit"):
        press(space((4, 5), (0.1, 0.1)), np.zeros((4, 5)), start=np.zeros((5, 4)))
