"""Levels, cycles and passes of a device, compared with the reference."""

from typing import Any

import graphs
import numpy as np
import pytest

from mirrorskin.engine.integration.cycle import Cycle
from mirrorskin.engine.integration.graph import Links
from mirrorskin.engine.integration.height_variance import find_exact_variance, local_part
from mirrorskin.engine.integration.hierarchy import STRENGTH, Hierarchy, near_nodes, part_of, place_of_coarse
from mirrorskin.kernels.integration import multigrid as twin

SHAPE = 90, 300  # several tiles, parts of sums and items, none of them full
GRAPHS = [("rectangle", False), ("holes", False), ("soft", False), ("cuts", True), ("uneven", True)]
STRAIGHT, CROSSED = ("rectangle", False), ("cuts", True)


class Case:
    """A graph's levels on a device and by the reference, and random pictures of both."""

    def __init__(self, device, kind, anchored, *, plain=False):
        self.device, self.rng = device, np.random.default_rng(0)
        graph = self.graph = graphs.pixel_graph(kind, SHAPE, anchored)
        self.h = Hierarchy(SHAPE, anchored, device)
        right, down = (self.map(getattr(graph, name)) for name in ("right", "down"))
        anchor = self.map(graph.anchor) if anchored else None
        self.h.build(Links(device, SHAPE, right, down, anchor, right), plain=plain)
        Cycle(self.h).prepare()
        host_maps = [None if values is None else values.read() for values in (right, down, anchor)]
        self.levels = twin.build(*host_maps, None if plain else STRENGTH)

    def map(self, values, dtype=np.float32):
        array = self.device.array("map", values.shape, dtype)
        array.write(values)
        return array

    def random(self, number=0):
        """Return a picture of a level, and an array that holds it."""
        picture = self.rng.normal(size=self.levels[number].to.shape).astype(np.float32)
        array = self.h.array("picture")
        values = array.read()
        self._inside(number, values)[...] = picture
        array.write(values)
        return picture.astype(np.float64), array

    def _inside(self, number, values):
        level = self.h.levels[number]
        return values[level.first : level.end - level.stride].reshape(level.rows, level.stride)[
            :, : level.columns
        ]

    def get(self, array, number=0):
        return self._inside(number, array.read()).copy()

    def sums(self, name, parts=1, **arguments):
        """Run a pass that adds up; return its sums."""
        count = -(-self.h.levels[0].nodes // part_of(self.device))
        array = self.h.array("parts", parts * count)
        self.h.over_parts(name, array, **arguments, **({"count": count} if parts > 1 else {}))
        return array.read().reshape(parts, count).sum(axis=1, dtype=np.float64)


def close(actual, expected, within=1e-5):
    np.testing.assert_allclose(actual, expected, rtol=within, atol=within * np.abs(expected).max())


@pytest.fixture(scope="module")
def cases(device):
    opened: dict[Any, Case] = {}
    return lambda kind, anchored: opened.setdefault((kind, anchored), Case(device, kind, anchored))


@pytest.mark.parametrize(("kind", "anchored"), [*GRAPHS, ("isolated", False)])
def test_levels_are_those_of_the_reference(device, kind, anchored):
    for plain in (False, True):
        case = Case(device, kind, anchored, plain=plain)
        for number, (level, moves) in enumerate(zip(case.levels, case.h.moves, strict=True)):
            for name, weights in zip(("right", "down", "falling", "rising"), level.links, strict=True):
                np.testing.assert_allclose(
                    case.get(case.h.graph[name], number), weights, rtol=1e-5, atol=1e-5
                )
            if anchored:
                np.testing.assert_allclose(case.get(case.h.graph["anchor"], number), level.anchor, rtol=1e-5)
            close(case.get(case.h.inverse, number), twin.inverse_of(level.diagonal))
            np.testing.assert_array_equal(case.get(case.h.to, number) if moves else 0 * level.to, level.to)
            assert moves == len(changed(level))
            if moves:
                coarse = case.h.levels[number + 1]
                changes = case.h.changed.read()[coarse.base : coarse.base + moves] - coarse.first
                assert sorted(np.transpose(np.divmod(changes, coarse.stride)).tolist()) == changed(level)
        assert plain == (not case.h.moves.any()) or kind == "rectangle"


def changed(level):
    """Return the aggregates that are no blocks."""
    y, x = np.nonzero(level.to)
    row, column = level.aggregate
    pairs = {*zip((y // 2).tolist(), (x // 2).tolist(), strict=True)}
    return sorted(map(list, pairs | {*zip(row[y, x].tolist(), column[y, x].tolist(), strict=True)}))


@pytest.mark.parametrize(("kind", "anchored"), GRAPHS)
def test_a_cycle_answers_as_the_reference_wherever_one_group_takes_over(cases, kind, anchored, monkeypatch):
    case = cases(kind, anchored)
    b = case.graph.centred(case.rng.normal(size=SHAPE)).astype(np.float32)
    on_device = case.h.array("right side")
    case.h.copy_picture("admit", on_device, case.map(b))
    near, usual, last = near_nodes(case.device, 1), case.h.first_of_tail(1), len(case.levels) - 1
    for first in (usual if near else 1, 3, last):
        monkeypatch.setattr(Hierarchy, "first_of_tail", lambda self, lanes, first=first: first)
        cycle = Cycle(case.h)
        cycle.prepare()
        cycle.b = on_device
        product = cycle.run()
        order = {"twice_from": first, "large": twin.LARGE_STEPS} if near else {}
        expected = twin.cycle(case.levels, b.astype(np.float64), **order)
        within = 1e-4 if kind == "soft" else 1e-5  # rounding of a side's sum leads over weak links
        close(case.get(cycle.x), expected, within)
        assert product == pytest.approx((b * expected).sum(), rel=within)


@pytest.mark.parametrize(("kind", "anchored"), [*GRAPHS, ("isolated", False), ("isolated", True)])
def test_the_coarsest_level_is_inverted(cases, kind, anchored):
    case = cases(kind, anchored)
    level, grid = case.levels[-1], case.h.levels[-1]
    inverse = case.h.matrix.read().reshape(2 * (grid.rows, grid.stride))
    inside = inverse[:, : grid.columns, :, : grid.columns].reshape(2 * (level.to.size,))
    close(inside, twin.inverse_matrix(level))
    assert np.count_nonzero(inverse) == np.count_nonzero(inside)
    matrix = np.diag(level.diagonal.ravel())
    for n, unit in enumerate(np.eye(level.to.size)):
        matrix[n] -= twin.around(level, unit.reshape(level.to.shape)).ravel()
    close(matrix @ twin.inverse_matrix(level) @ matrix, matrix)


@pytest.mark.parametrize("graph", [STRAIGHT, CROSSED], ids=str)
@pytest.mark.parametrize("number", [0, 1])
def test_a_residual_is_that_of_the_reference(cases, graph, number):
    case = cases(*graph)
    (b, b_given), (x, x_given), residual = case.random(number), case.random(number), case.h.array("found")
    arrays = {"inverse": case.h.inverse, "b": b_given, "x": x_given, "residual": residual}
    case.h.over("residual", case.h.levels[number], **case.h.graph, **arrays)
    close(case.get(residual, number), twin.residual(case.levels[number], b, x))


@pytest.mark.parametrize("graph", [STRAIGHT, CROSSED], ids=str)
def test_steps_of_conjugate_gradients_and_sums(cases, graph):
    case = cases(*graph)
    level, zero = case.levels[0], np.zeros(SHAPE)
    (z, z_given), (before, before_given), (b, b_given), (x, x_given) = (case.random() for _ in range(4))
    assert case.sums("dot", one=b_given, other=x_given) == pytest.approx((b * x).sum(), rel=1e-3, abs=1e-2)
    if case.h.anchored:
        weighed = case.sums("weigh", anchor=case.h.graph["anchor"], x=x_given)
        assert weighed == pytest.approx((level.anchor * x**2).sum(), rel=1e-5)
    direction, buffers = case.h.array("direction"), {**case.h.graph, "inverse": case.h.inverse}
    put, history = case.device.from_host, case.device.array("history", (3, 3, 1), np.float32)
    history.write(np.array([[[10], [0.2], [1]]]))
    buffers |= {"cycle": 1, "history": history}
    sums = {"products": 2, "product": put("product", [3, 4]), "squares": put("squares", np.ones(99))}
    arrays = {"z": z_given, "before": before_given, "direction": direction, "x": x_given}
    curvature = case.sums("direct", step=2, count=99, **buffers, **sums, **arrays)
    p, x = z + 0.7 * before, x + 0.2 * before
    image = -twin.residual(level, zero, p)
    close(case.get(direction), p)
    close(case.get(x_given), x)
    assert curvature == pytest.approx((p * image).sum(), rel=1e-5)
    products = {"count": 3, "products": put("products", [5, 10, 5])}
    moving = put("moving", [1])
    square = case.sums("advance", moving=moving, **buffers, **products, direction=direction, b=b_given)
    b -= 7 / 20 * image
    close(case.get(b_given), b)
    assert square == pytest.approx((case.get(b_given).astype(float) ** 2).sum(), rel=1e-5)
    np.testing.assert_allclose(history.read()[1, :, 0], [7, 7 / 20, 99], rtol=1e-6)
    step = {"cycle": 1, "history": history, "direction": direction}
    for number, expected in ((2, x + 7 / 20 * p), (1, 7 / 20 * p)):
        case.h.over("take", case.h.levels[0], step=number, **step, x=x_given)
        close(case.get(x_given), expected)
    for number, expected in ((0, 7 / 20 * p), (2, 14 / 20 * p), (1, 7 / 20 * p)):
        whole = case.map(np.zeros(SHAPE))
        case.h.copy_picture("finish", x_given, whole, **{**step, "step": number})
        close(case.get(x_given), expected)
        close(whole.read(), expected)


@pytest.mark.parametrize(
    ("product", "curvature", "moving"), [(-1, 5, 1), (np.nan, 5, 1), (7, -5, 1), (7, 5, 0)]
)
def test_an_impossible_step_is_not_done(cases, product, curvature, moving):
    case = cases(*STRAIGHT)
    (b, b_given), (x, x_given), endless = case.random(), case.random(), case.h.array("direction")
    endless.fill(np.inf)
    history = case.device.array("history", (2, 3, 1), np.float32)
    history.write(np.array([[[product], [9], [1]]]))
    buffers = {**case.h.graph, "inverse": case.h.inverse, "cycle": 0, "history": history}
    numbers = {
        name: case.device.from_host(name, [value])
        for name, value in (("products", curvature), ("moving", moving))
    }
    case.sums("advance", count=1, **buffers, **numbers, direction=endless, b=b_given)
    assert history.read()[0, 1, 0] == 0
    np.testing.assert_array_equal(case.get(b_given), b)
    case.h.over("take", case.h.levels[0], cycle=0, step=2, history=history, direction=endless, x=x_given)
    np.testing.assert_array_equal(case.get(x_given), x)


@pytest.mark.parametrize("same", [False, True], ids=["plane", "line"])
@pytest.mark.parametrize("graph", [STRAIGHT, CROSSED], ids=str)
def test_the_best_step_in_a_plane(cases, graph, same):
    case = cases(*graph)
    level, zero = case.levels[0], np.zeros(SHAPE)
    (z, z_given), (p, p_given), (b, b_given), (x, x_given) = (case.random() for _ in range(4))
    if same:
        p, p_given = z, case.h.array("same")
        p_given.write(z_given.read())
    z_image, p_image = (-twin.residual(level, zero, field) for field in (z, p))
    expected = [(field * other).sum() for field, other in ((z, z_image), (z, p_image), (p, p_image), (b, p))]
    products = case.sums("curve", 4, **case.h.graph, inverse=case.h.inverse, b=b_given, z=z_given, p=p_given)
    np.testing.assert_allclose(products, expected, rtol=1e-4, atol=1e-5 * np.abs(expected).max())
    halves = np.array([0.25, 0.75]) * (b * z).sum()
    parts = np.repeat(expected, 2) * np.tile([0.5, 0.5], 4)
    arguments = {
        name: case.device.from_host(name, values) for name, values in (("product", halves), ("parts", parts))
    }
    lengths = case.h.array("lengths", 2)
    case.h.alone("best", case.h.levels[-1], products=2, count=2, **arguments, lengths=lengths)
    case.h.over("follow", case.h.levels[0], lengths=lengths, z=z_given, p=p_given, x=x_given)
    along, again = twin.best_step((b * z).sum(), *expected)
    close(lengths.read(), [along, again], 1e-4)
    assert (again == 0) == same
    close(case.get(p_given), along * z + again * p, 1e-4)
    close(case.get(x_given), x + along * z + again * p, 1e-4)


@pytest.mark.parametrize("graph", [STRAIGHT, CROSSED], ids=str)
@pytest.mark.parametrize("number", [0, 1])
def test_what_a_level_adds_to_variances(cases, graph, number):
    case = cases(*graph)
    h, fine, level = case.h, case.h.levels[number], case.levels[number]
    coarse, rising = case.random(number + 1)
    evened, returns, brought, variance = (h.array(name) for name in "abcd")
    links, c = {name: h.graph[name] for name in ("right", "down")}, local_part(number == 0)
    walk = {"evened": evened, "returns": returns, "t": brought}
    above = {**place_of_coarse(h.levels[number + 1]), "moved_nodes": h.moves[number], "to": h.to}
    h.over("even", fine, **h.graph, evened=evened)
    h.over("returns", fine, **links, **above, **walk, e=rising)
    numbers = {f"c{k}": value for k, value in enumerate(c)}
    h.over("spread", fine, **h.graph, inverse=h.inverse, **walk, **numbers, x=variance)
    d, r = twin.walk(level)
    close(case.get(evened, number), d)
    close(case.get(returns, number), r)
    close(case.get(brought, number), twin.injected(level, coarse))
    close(case.get(variance, number), twin.spread(level, coarse, twin.local_part(level, c)))


def test_pictures_come_to_the_finest_level_and_back(cases):
    case = cases(*CROSSED)
    picture = case.rng.normal(size=SHAPE).astype(np.float32)
    level, back, returned = case.h.array("level"), case.map(0 * picture), case.map(0 * picture)
    case.h.copy_picture("admit", level, case.map(picture))
    np.testing.assert_array_equal(case.get(level), picture)
    case.h.copy_picture("release", level, back)
    np.testing.assert_array_equal(back.read(), picture)
    flags = case.rng.choice([1, 4, 6, 8], SHAPE)
    arguments = {
        "min_variance": 0.12,
        "flag": 12,
        "flags": case.map(flags, np.uint8),
        "inverse": case.h.inverse,
    }
    case.h.copy_picture("deviation", level, returned, **arguments)
    lowest = 0.12 * twin.inverse_of(case.levels[0].diagonal)
    expected = np.where(flags & 12, np.sqrt(np.maximum(picture, lowest)), np.nan)
    np.testing.assert_allclose(returned.read(), expected, rtol=1e-5)


def test_nodes_that_enter_get_heights_along_the_slopes(cases):
    case = cases("holes", False)
    heights, level = case.random()
    slopes = np.where(case.rng.random((2, *SHAPE)) < 0.9, case.rng.normal(size=(2, *SHAPE)), np.nan)
    slopes[:, np.isnan(slopes).any(axis=0)] = np.nan
    dz_dx, dz_dy = (case.map(slope.astype(np.float32)) for slope in slopes)
    links = {name: case.h.graph[name] for name in ("right", "down")}
    case.h.copy_picture("enter", level, dz_dx, dz_dy=dz_dy, **links, step_x=0.2, step_y=-0.3)
    right, down = case.levels[0].links[:2]
    expected = twin.enter(right, down, *slopes, (0.2, -0.3), heights)
    assert np.any(expected != heights)
    close(case.get(level), expected)


@pytest.mark.parametrize(("kind", "anchored"), [*GRAPHS, ("isolated", False), ("isolated", True)])
@pytest.mark.parametrize("number", [3, 4, 5])
def test_the_variance_of_a_level_is_exact(cases, kind, anchored, number):
    case = cases(kind, anchored)
    flags = case.rng.choice([1, 4, 8, 12], SHAPE).astype(np.uint8)
    arrays = [case.h.array(name) for name in "abcde"]
    find_exact_variance(case.h, number, case.map(flags, np.uint8), *arrays)
    masses = ((flags & 12) > 0).astype(float)
    for level in case.levels[:number]:
        masses = twin.gathered(level, masses)
    close(case.get(arrays[0], number), twin.exact_variance(case.levels[number], masses), 1e-4)
