"""Integration: every solver finds the same heights, or nothing is timed; the peers against brute force."""

from importlib.util import find_spec

import cv2
import numpy as np
import pytest

from mirrorskin import bench, engine
from mirrorskin.bench import integration, run_suite, slopes, solvers
from mirrorskin.bench.peers.integration import find_peers, graph, pyamg_, rectangle, scipy_, system
from mirrorskin.bench.same import DisagreementError
from mirrorskin.bench.truth import find_truth
from mirrorskin.kernels.device import open_device

CASES = ["integrate-rectangle", "integrate-mask", "integrate-cuts", "integrate-live"]
PARTS = ["from slopes", "set-up and solve", "solve only"]
PIXELS = 48 * 64  # of a quick run
HAVE_PYAMG = find_spec("pyamg") is not None
WITH_PYAMG = pytest.mark.skipif(not HAVE_PYAMG, reason="pyamg is not installed")


def moved(name, part):
    """Return the bytes of a pixel that a row should count."""
    if "rectangle" in name:
        return 12 if part == "from slopes" else 8
    if name == "integrate-cuts":
        return 14 if part == "from slopes" else 16
    return 16 if part in PARTS[1:] else 13


def brute_links(given, size, mask, edges):
    """Return every link as (from row, from column, to row, to column, rise), a pixel at a time."""
    known = (mask != 0) & np.isfinite(given).all(axis=0)
    inside = set(map(tuple, np.argwhere(known).tolist()))

    def around(r, c):
        return [p for p in ((r, c + 1), (r, c - 1), (r + 1, c), (r - 1, c)) if p in inside]

    linked = set()
    for r, c in inside:
        near = [p for p in around(r, c) if not edges[p]]
        if edges[r, c] and near:
            near = [min(near, key=lambda p: np.sum((given[:, r, c] - given[(slice(None), *p)]) ** 2))]
        linked |= {((r, c), p) for p in near}
    linked = {tuple(sorted(pair)) for pair in linked}
    found = []
    for (r, c), (r2, c2) in sorted(linked):
        axis, sign = (0, 1) if r == r2 else (1, -1)
        slope = given[axis]
        step = np.array([r2 - r, c2 - c])
        before, after = (r - step[0], c - step[1]), (r2 + step[0], c2 + step[1])
        mean = (slope[r, c] + slope[r2, c2]) / 2
        if (before, (r, c)) in linked and ((r2, c2), after) in linked:
            mean = (13 * slope[r, c] + 13 * slope[r2, c2] - slope[before] - slope[after]) / 24
        found.append((r, c, r2, c2, sign * size * mean))
    return found


def least_squares(links, shape):
    """Return the heights of smallest norm that fit the links best, (H, W)."""
    model = np.zeros((len(links), np.prod(shape)))
    for line, (r, c, r2, c2, _) in zip(model, links, strict=True):
        line[np.ravel_multi_index((r, c), shape)], line[np.ravel_multi_index((r2, c2), shape)] = -1, 1
    values, *_ = np.linalg.lstsq(model, np.array([link[4] for link in links]), rcond=None)
    return values.reshape(shape)


@pytest.fixture
def torn():
    """Slopes with an unknown pixel, a mask with a piece and a pixel alone, and two lines of edges."""
    generator = np.random.default_rng(3)
    shape = 11, 13
    given = generator.normal(0, 0.3, (2, *shape))
    given[1, 5, 6] = np.nan
    mask, edges = np.ones(shape, np.uint8), np.zeros(shape, np.uint8)
    mask[:, 9] = mask[0] = 0
    mask[0, 0], mask[1, 0] = 1, 0
    edges[3, 1:7] = edges[4:8, 6] = edges[7:9, 10:13] = 1
    return given, mask, edges


@pytest.mark.parametrize("name", CASES)
def test_a_case_agrees_on_every_device(device, name):
    (case,) = run_suite(device, [name], quick=True)
    limits, rows = case.rows[:3], case.rows[3:]
    assert [row.name for row in limits] == ["triad limit", "read limit", "copy limit"]
    whose = ["mirrorskin", *(["SciPy", "OpenCV"] if "rectangle" in name else ["pyamg"] * HAVE_PYAMG)]
    works = [f"{who}, {part}" for who in whose for part in PARTS]
    assert [row.name for row in rows] == (["mirrorskin"] if name == "integrate-live" else works)
    for row in rows:
        assert row.frames == (16 if name == "integrate-live" else 0)
        assert row.bytes == PIXELS * moved(name, row.name.rpartition(", ")[2]) * max(row.frames, 1)
        assert ("kernel" in row.measured.device) == row.name.startswith("mirrorskin")
    (errors,) = (note for note in case.notes if note.startswith("root mean square error"))
    assert all(row.name in errors for row in rows if PARTS[1] not in row.name)


def test_every_case_can_be_named():
    assert set(CASES) < set(bench.NAMES)


@pytest.fixture
def timed(monkeypatch):
    """What was timed so far."""
    timed = []
    monkeypatch.setattr("mirrorskin.bench.harness._measured", lambda *given: timed.append(given))
    return timed


def test_a_transform_that_differs_is_named_and_nothing_is_timed(monkeypatch, timed):
    def solve(source, divisors):
        heights = scipy_.solve(source, divisors)
        heights[3, 5] += 0.01
        return heights

    monkeypatch.setattr(integration, "find_peers", lambda: [rectangle.Peer("Odd one", solve)])
    said = "Odd one, from slopes differs from a direct solution in the height of 1 of 3072"
    with pytest.raises(DisagreementError, match=said):
        run_suite(open_device(), ["integrate-rectangle"], quick=True)
    assert not timed


@WITH_PYAMG
def test_a_matrix_solver_that_differs_is_named_and_nothing_is_timed(monkeypatch, timed):
    def solve(hierarchy, source, iterations):
        values = pyamg_.set_up(hierarchy.levels[0].A).solve(source, accel="cg")
        values[7] += 0.1
        return values

    monkeypatch.setattr(solvers.pyamg_, "solve", solve)
    with pytest.raises(DisagreementError, match="pyamg, from slopes differs from a direct solution"):
        run_suite(open_device(), ["integrate-cuts"], quick=True)
    assert not timed


@pytest.mark.parametrize("value", [1.0, np.nan])
@pytest.mark.parametrize("name", ["integrate-rectangle", "integrate-mask"])
def test_our_own_heights_are_compared_too(monkeypatch, timed, name, value):
    integrate = engine.integrate

    def wrong(*given, **options):
        found = integrate(*given, **options)
        row, column = np.argwhere(np.isfinite(found.height))[40]
        found.height[row, column] = value
        return found

    monkeypatch.setattr(engine, "integrate", wrong)
    with pytest.raises(DisagreementError, match="mirrorskin, from slopes differs from a direct solution"):
        run_suite(open_device(), [name], quick=True)
    assert not timed


def test_live_heights_that_stay_behind_are_named_and_nothing_is_timed(monkeypatch, timed):
    result = engine.Integrator.result
    first = []

    def still(integrator):
        first.append(result(integrator))
        first[0].height[...] *= 1.1
        return first[0]

    monkeypatch.setattr(engine.Integrator, "result", still)
    with pytest.raises(DisagreementError, match="mirrorskin differs from a direct solution"):
        run_suite(open_device(), ["integrate-live"], quick=True)
    assert not timed


def test_without_pyamg_that_is_told_and_ours_is_timed(monkeypatch):
    monkeypatch.setattr(integration, "find_absent", lambda: {"pyamg": "not installed"})
    (case,) = run_suite(open_device(), ["integrate-mask"], quick=True)
    assert case.absent == {"pyamg": "not installed"}
    assert [row.name for row in case.rows[3:]] == [f"mirrorskin, {part}" for part in PARTS]


@pytest.mark.parametrize("cut", [True, False])
def test_links_and_heights_are_those_of_brute_force(torn, cut):
    given, mask, edges = torn
    links = brute_links(given, 0.5, mask, edges if cut else np.zeros_like(edges))
    made = graph.link(given, 0.5, mask, edges if cut else None)
    right = {(r, c) for r, c, r2, _, _ in links if r == r2}
    down = {(r, c) for r, c, _, c2, _ in links if c == c2}
    assert set(map(tuple, np.argwhere(made.right).tolist())) == right
    assert set(map(tuple, np.argwhere(made.down).tolist())) == down
    equations = system.assemble(made)
    values = system.solve_exactly(equations)
    expected = least_squares(links, mask.shape)
    np.testing.assert_allclose(system.centre(equations, values), expected[equations.linked], atol=1e-12)
    assert system.components(equations)[0] == (3 if cut else 2)
    heights = system.as_map(equations, expected[equations.linked], mask != 0)
    np.testing.assert_array_equal(np.isnan(heights), mask == 0)
    assert heights[0, 0] == 0
    np.testing.assert_array_equal(heights[equations.linked], expected[equations.linked].astype(np.float32))


@pytest.mark.parametrize("peer", find_peers(), ids=lambda peer: peer.name)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_transform_solves_a_rectangle(peer, dtype):
    given = np.random.default_rng(0).normal(0, 0.3, (2, 8, 10))
    whole, none = np.ones((8, 10), np.uint8), np.zeros((8, 10), np.uint8)
    source = graph.link(given, 0.5).source.astype(dtype)
    found = peer.solve(source, rectangle.divisors((8, 10), dtype))
    assert found.dtype == dtype
    expected = least_squares(brute_links(given, 0.5, whole, none), (8, 10))
    np.testing.assert_allclose(found, expected, atol=1e-6 if dtype == np.float32 else 1e-13)


@WITH_PYAMG
@pytest.mark.parametrize("error", [1e-2, 1e-4, 1e-6])
def test_pyamg_does_no_more_iterations_than_the_error_takes(error):
    given = slopes.noisy_slopes((60, 80))
    truth = find_truth(given, slopes.blob_mask((60, 80)), slopes.random_cuts((60, 80), 5))
    hierarchy = pyamg_.set_up(truth.system.matrix)
    count = pyamg_.fewest_iterations(hierarchy, truth.system.source, truth.error, error)
    enough, fewer = (pyamg_.solve(hierarchy, truth.system.source, count - less) for less in (0, 1))
    assert count > 1
    assert truth.error(enough) <= error < truth.error(fewer)


def test_an_error_is_told_in_ranges_whatever_the_offsets():
    mask = np.ones((20, 30), np.uint8)
    mask[:, 11] = 0
    truth = find_truth(slopes.noisy_slopes((20, 30)), mask, None)
    shifted = truth.map
    shifted[:, :11] += 0.5
    assert truth.error(shifted) < 1e-5
    half = truth.values + 0.1 * truth.range * (np.arange(len(truth.values)) % 2)
    assert truth.error(half) == pytest.approx(0.05, rel=0.01)


def test_a_mask_has_holes_and_islands():
    mask = slopes.blob_mask((480, 640))
    assert mask.mean() == pytest.approx(0.65, abs=0.01)
    pieces, _ = cv2.connectedComponents(mask, connectivity=4)
    gaps, number = cv2.connectedComponents(1 - mask, connectivity=4)
    at_border = set(number[0]) | set(number[-1]) | set(number[:, 0]) | set(number[:, -1])
    assert pieces - 1 > 1
    assert gaps - len(at_border) > 5


def test_the_same_scene_is_made_again():
    for make in (slopes.noisy_slopes, slopes.blob_mask, lambda shape: slopes.random_cuts(shape, 9)):
        np.testing.assert_array_equal(make((48, 64)), make((48, 64)))


def test_slopes_are_those_of_a_surface():
    dz_dx, dz_dy = slopes.smooth_slopes((200, 300)).astype(float)
    # Around every pixel's corner the rises add up to nothing.
    across = (dz_dx[:, :-1] + dz_dx[:, 1:]) / 2
    down = -(dz_dy[:-1] + dz_dy[1:]) / 2
    curl = across[:-1] + down[:, 1:] - across[1:] - down[:, :-1]
    assert np.abs(curl).max() < 1e-3
    assert np.std(dz_dx) > 0.1


def test_each_live_frame_differs_from_the_next_by_one_per_cent():
    frames = slopes.drifting_slopes((120, 160), 8, 0.01)
    for before, frame in zip(frames[-1:] + frames, frames, strict=False):
        change = np.sqrt(np.mean((frame - before) ** 2) / np.mean(frame**2))
        assert change == pytest.approx(0.01, rel=0.05)
