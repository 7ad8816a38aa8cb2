"""Forces of a stream on averaged maps: closed forms, the functions for one result, and the twin's skin."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from scipy import ndimage

from mirrorskin import io
from mirrorskin.engine.force import ForceTracker, find_force
from mirrorskin.twin import Body, Horizontal, Sphere, Twin

MODULUS, PIXEL, SHAPE = 0.1, 0.05, (160, 200)
X, Y = io.pixel_axes(SHAPE, (PIXEL, PIXEL))
AXES = {"x": X, "y": Y}


def paraboloid(radius=4.0, centre=(0.0, 0.0)):
    return -((X - centre[0]) ** 2 + (Y[:, np.newaxis] - centre[1]) ** 2) / (2 * radius)


def hertz(radius, depth):
    return 16 / 9 * np.sqrt(radius) * depth**1.5 * MODULUS


def result(height, sigma=0.0, **maps):
    spread = np.full(SHAPE, sigma, np.float32)
    return io.Result(height=height.astype(np.float32), height_sigma=spread, **AXES, **maps)


def errors_of(found, force, centre):
    """Return the errors of force and centre in standard deviations."""
    return [
        (found.force - force) / found.force_sigma,
        (found.pressure_centre_x - centre[0]) / found.pressure_centre_x_sigma,
        (found.pressure_centre_y - centre[1]) / found.pressure_centre_y_sigma,
    ]


@pytest.mark.parametrize("noise", [0.0, 0.003, 0.02])
def test_moving_presses_have_hertz_force_and_centre_within_their_sigma(noise):
    errors = []
    for seed in range(100, 112):
        random = np.random.default_rng(seed)
        radius, depth, centre = random.uniform(3, 9), random.uniform(0.2, 0.5), random.uniform(-0.4, 0.4, 2)
        step, deeper = random.uniform(-0.03, 0.03, 2), random.uniform(-0.005, 0.01)
        tracker = ForceTracker(modulus=MODULUS)
        for number in range(6):
            at, travel = centre + number * step, depth + number * deeper
            height = paraboloid(radius, at) + random.normal(0, noise, SHAPE)
            found = tracker.push(result(height, noise), travel)
            errors.append(errors_of(found, hertz(radius, travel), at))
    force, *centres = np.mean(np.square(errors), axis=0)
    # Without noise, sigma is that of contacts of whole blocks, which is larger for cylinders along the rows.
    assert 0.3 < force < 2
    assert all(0.3 < chi_square < 2 for chi_square in centres)


@pytest.mark.parametrize("length", [0.0, 0.1, np.inf])
def test_sigma_is_the_scatter_that_errors_of_heights_cause(length):
    """Independent errors, those of fused heights, and those of integrated slopes, which are all alike."""
    tracker, found, noise = ForceTracker(modulus=MODULUS), [], 0.03 if length == 0 else 0.005
    fitted = io.Fitted(integration="direct") if np.isinf(length) else io.Fitted(height_correlation=length)
    for seed in range(40):
        random = np.random.default_rng(seed)
        added = random.normal(0, 1, SHAPE)
        if np.isinf(length):
            added = np.full(SHAPE, added[0, 0])
        elif length:
            added = ndimage.gaussian_filter(added, length / PIXEL / np.sqrt(2), mode="wrap")
            added *= 2 * np.sqrt(np.pi) * length / PIXEL / np.sqrt(2)
        found.append(tracker.push(result(paraboloid() + noise * added, noise, fitted=fitted), 0.4))
    scatter = np.std([one.force for one in found])
    assert scatter == pytest.approx(np.mean([one.force_sigma for one in found]), rel=0.35)
    scatter = np.std([one.pressure_centre_x for one in found])
    assert scatter < 1.4 * np.mean([one.pressure_centre_x_sigma for one in found])


@pytest.mark.parametrize(("binning", "rel"), [(1, 1e-4), (2, 5e-4), (4, 2e-3)])
def test_force_and_pressure_are_those_of_find_force(binning, rel):
    height = np.maximum(paraboloid(3.0, (0.9, 0.2)), paraboloid(5.0, (-0.8, -0.3)) - 0.05)
    expected = find_force(height, 0.4, PIXEL, MODULUS)
    found = ForceTracker(modulus=MODULUS, binning=binning).push(result(height), 0.4)
    assert found.force == pytest.approx(expected.force, rel=rel)
    assert abs(found.force - expected.force) < 3 * found.force_sigma
    centre = float((expected.pressure * X).sum() / expected.pressure.sum())
    assert abs(found.pressure_centre_x - centre) < 3 * found.pressure_centre_x_sigma
    rows, columns = (size // binning for size in SHAPE)
    blocks = expected.pressure.reshape(rows, binning, columns, binning).mean(axis=(1, 3))
    assert found.pressure.shape == found.contact.shape == (rows, columns)
    assert np.sqrt(np.mean((found.pressure - blocks) ** 2)) < 0.02 * blocks.max()
    assert (found.x[0], found.y[0]) == pytest.approx((X[:binning].mean(), Y[:binning].mean()))


def test_errors_of_travel_and_modulus_are_propagated():
    height = paraboloid()
    plain = ForceTracker(modulus=MODULUS).push(result(height), 0.4)
    found = ForceTracker(modulus=MODULUS, travel_sigma=0.004).push(result(height), 0.4)
    by_travel = np.hypot(1.5 * 0.004 / 0.4 * found.force, plain.force_sigma)
    assert found.force_sigma == pytest.approx(by_travel, rel=0.05)
    found = ForceTracker(modulus=MODULUS, modulus_sigma=0.05 * MODULUS).push(result(height), 0.4)
    assert found.force_sigma == pytest.approx(0.05 * found.force, rel=0.01)
    assert found.pressure_centre_x_sigma == pytest.approx(plain.pressure_centre_x_sigma)


def test_an_answer_depends_on_earlier_results_by_less_than_its_sigma():
    random, tracker = np.random.default_rng(1), ForceTracker(modulus=MODULUS)
    for centre in ((0, 0), (0.02, 0), (1.5, -1.0), (1.52, -1.0), (0.5, 0.5)):
        pressed = result(paraboloid(4.0, centre) + random.normal(0, 0.003, SHAPE), 0.003)
        warm, cold = tracker.push(pressed, 0.4), ForceTracker(modulus=MODULUS).push(pressed, 0.4)
        assert abs(warm.force - cold.force) < 0.2 * cold.force_sigma
        assert abs(warm.pressure_centre_x - cold.pressure_centre_x) < 0.2 * cold.pressure_centre_x_sigma


@pytest.mark.parametrize("step", [0.002, 0.004, -0.004])
def test_tangential_force_of_a_changing_contact_depends_little_on_earlier_results(step):
    random, tracker, errors = np.random.default_rng(1), ForceTracker(modulus=MODULUS), []
    for number in range(10):
        moved = np.broadcast_to([0.05, -0.02], (*SHAPE, 2))
        height, depth = paraboloid(4.0) + random.normal(0, 0.002, SHAPE), 0.4 + step * number
        pressed = result(height, 0.002, displacement=moved, displacement_sigma=np.full((*SHAPE, 2), 1e-4))
        warm, cold = tracker.push(pressed, depth), ForceTracker(modulus=MODULUS).push(pressed, depth)
        errors.append((warm.force_x / cold.force_x - 1, (warm.force_x - cold.force_x) / warm.force_x_sigma))
    relative, sigmas = np.transpose(errors)
    assert np.sqrt(np.mean(relative**2)) < 0.008
    assert np.sqrt(np.mean(sigmas**2)) < 0.7


def test_contact_is_lost_and_found_again():
    tracker, moved = ForceTracker(modulus=MODULUS), np.full((*SHAPE, 2), 0.01, np.float32)
    pressed = result(paraboloid(), 0.001, displacement=moved)
    first = tracker.push(pressed, 0.4)
    lifted = tracker.push(pressed, -0.1)
    assert (lifted.force, lifted.force_x, lifted.contact.any()) == (0.0, 0.0, False)
    assert np.isnan(lifted.pressure_centre_x)
    again = tracker.push(pressed, 0.4)
    with pytest.raises(io.InputError, match="one size"):
        tracker.push(pressed.assign(displacement=moved[1:]), 0.4)
    assert again.force == first.force == pytest.approx(tracker.push(pressed, 0.4).force, rel=1e-5)
    small = io.Result(height=pressed.height[:100, :100], x=X[:100], y=Y[:100])
    assert tracker.push(small, 0.1).pressure.shape == (25, 25)


def shifted(kind, radius, centre):
    """Return a displacement, and the force: a disc that sticks (Mindlin), or Johnson's equation 3.91."""
    x, y, shear = X - centre[0], Y[:, np.newaxis] - centre[1], MODULUS / 3
    if kind == "sticks":
        force = 16 / 3 * shear * radius * np.array([0.1, -0.05])
        return np.broadcast_to([0.1, -0.05], (*SHAPE, 2)), force
    size = np.pi * 0.02 / (32 * shear * radius)
    moved = [size * (6 * radius**2 - 2.5 * x**2 - 3.5 * y**2), size * x * y]
    return np.stack(moved, axis=-1), np.array([2 / 3 * np.pi * 0.02 * radius**2, 0.0])


@pytest.mark.parametrize(("kind", "least"), [("sticks", 0.3), ("slips at the border", 0.0)])
def test_tangential_forces_are_the_closed_forms_within_their_sigma(kind, least):
    """Sigma is that of skin that sticks up to the border, where the traction is infinite."""
    errors = []
    for seed in range(24):
        random = np.random.default_rng(200 + seed)
        radius, centre = random.uniform(3, 8), random.uniform(-0.3, 0.3, 2)
        depth = random.uniform(0.2, 0.5)
        moved, force = shifted(kind, np.sqrt(radius * depth), centre)
        moved = moved + random.normal(0, 1e-4, moved.shape)
        maps = {"displacement": moved, "displacement_sigma": np.full(SHAPE, 1e-4)}
        found = ForceTracker(modulus=MODULUS).push(result(paraboloid(radius, centre), **maps), depth)
        assert np.hypot(found.force_x - force[0], found.force_y - force[1]) < 0.03 * np.hypot(*force)
        errors.append((found.force_x - force[0]) / found.force_x_sigma)
    assert least < np.mean(np.square(errors)) < 2


@pytest.mark.parametrize("window", [1, 9, 21])
def test_errors_of_displacements_are_correlated_within_windows(window):
    tracker, forces = ForceTracker(modulus=MODULUS, window_size=window), []
    for seed in range(40):
        noise = np.random.default_rng(seed).normal(0, 0.02 * window, (*SHAPE, 2))
        noise = ndimage.uniform_filter(noise, (window, window, 0))
        maps = {"displacement": noise, "displacement_sigma": np.full(SHAPE, 0.02)}
        forces.append(tracker.push(result(paraboloid(), **maps), 0.4))
    scatter = np.std([(found.force_x, found.force_y) for found in forces])
    assert scatter == pytest.approx(np.mean([found.force_x_sigma for found in forces]), rel=0.25)


def test_the_twin_s_skin_is_pushed_with_the_twin_s_force():
    path = np.stack([np.linspace(0, 0.35, 8), np.linspace(0, -0.1, 8)], axis=1)
    twin = Twin(
        object=Sphere(6.0),
        shape=(96, 96),
        pixel_size=0.06,
        movement=Horizontal(path, 0.6),
        contact="elastic",
        body=Body(modulus=MODULUS, friction=0.6),
    )
    truth, tracker = twin.truth, ForceTracker(0.06, MODULUS, binning=2)
    for number in range(2, 8):
        found = tracker.push({"height": truth.height, "displacement": truth.displacement[number]}, 0.6)
        expected = truth.force[number]
        assert found.force == pytest.approx(expected[2], rel=0.01)
        assert np.hypot(*np.array([found.force_x, found.force_y]) - expected[:2]) < 0.02 * np.hypot(
            *expected[:2]
        )


def test_missing_displacements_and_the_edge_are_reported():
    moved = np.full((*SHAPE, 2), 0.01, np.float32)
    moved[70:90, 90:110] = np.nan
    tracker = ForceTracker(modulus=MODULUS)
    whole = tracker.push(result(paraboloid(), displacement=np.full((*SHAPE, 2), 0.01, np.float32)), 0.4)
    bridged = tracker.push(result(paraboloid(), displacement=moved), 0.4)
    assert bridged.force_x == pytest.approx(whole.force_x, rel=0.01)
    assert "warnings" not in bridged.process
    moved[60:100] = np.nan
    found = tracker.push(result(paraboloid(), displacement=moved), 0.4)
    assert found.force_x is None
    assert "of the contact has a displacement" in found.process["warnings"]
    found = tracker.push(result(paraboloid(4.0, (4.5, 0))), 0.4)
    assert "reaches the edge" in found.process["warnings"]


def test_contacts_smaller_than_a_block_are_reported():
    height = np.full(SHAPE, -0.5)
    height[80:82, 100:102] = 0.0
    found = ForceTracker(modulus=MODULUS).push(result(height, 0.001), 0.1)
    assert found.force == 0
    assert "use a smaller binning" in found.process["warnings"]
    found = ForceTracker(modulus=MODULUS, binning=1).push(result(height, 0.001), 0.1)
    assert found.force > 0
    assert "warnings" not in found.process


def test_results_need_no_new_memory_of_their_size():
    shape, size = (480, 640), 0.0125
    x, y = io.pixel_axes(shape, (size, size))
    height = (-(x**2 + y[:, np.newaxis] ** 2) / 10).astype(np.float32)
    sigma = np.full(shape, 1e-3, np.float32)
    moved = np.full((*shape, 2), 0.01, np.float32)
    maps = {"height": height, "height_sigma": sigma, "displacement": moved}
    pressed = io.Result(maps | {"displacement_sigma": 0.1 * moved}, x=x, y=y)
    tracker = ForceTracker(modulus=MODULUS)
    for _ in range(3):
        tracker.push(pressed, 0.3)
    tracemalloc.start()
    try:
        tracker.push(pressed, 0.3)
        assert tracemalloc.get_traced_memory()[1] < 0.6 * height.nbytes  # of both displacements: 0.2
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("missing", [np.nan, -np.inf])
def test_an_object_may_end_within_the_maps(missing):
    height = np.where(np.hypot(X, Y[:, np.newaxis]) < 1.5, paraboloid(), missing)
    height[75:78, 100:103] = np.nan
    expected = find_force(paraboloid(), 0.4, PIXEL, MODULUS)
    found = ForceTracker(modulus=MODULUS).push(result(height), 0.4)
    assert found.force == pytest.approx(expected.force, rel=0.003)


@pytest.mark.parametrize(
    ("options", "maps", "message"),
    [
        ({}, {"height": np.zeros((8, 8))}, "height has no pixel size"),
        ({"pixel_size": 0.1, "modulus": None}, {"height": np.zeros((8, 8))}, "modulus is missing"),
        ({"pixel_size": 0.1}, {"height": np.zeros((4, 8))}, "too small"),
        ({"pixel_size": 0.1}, {"height": np.zeros((2, 8, 8))}, "one map"),
        ({"binning": 0}, {}, "binning 0"),
        ({"travel_sigma": -1.0}, {}, "travel_sigma -1"),
    ],
)
def test_impossible_input_is_one_line(options, maps, message):
    with pytest.raises(io.InputError, match=message):
        ForceTracker(**{"modulus": MODULUS} | options).push(maps, 0.1)


def test_a_tracker_that_was_compiled_before_gives_the_same_forces():
    pressed, tracker = result(paraboloid(), 0.001), ForceTracker(modulus=MODULUS)
    tracker.precompile(SHAPE)
    found = [each.push(pressed, 0.4).force for each in (tracker, ForceTracker(modulus=MODULUS))]
    assert found[0] == found[1] > 0
    tracker.precompile((4, 4))  # too small for a block
