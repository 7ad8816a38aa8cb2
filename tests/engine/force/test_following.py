"""Contacts near earlier ones: kernels and their references, and transforms on a padded grid."""

from __future__ import annotations

import numpy as np
import pytest
from references import agree

from mirrorskin.engine.force.blocks import Blocks
from mirrorskin.engine.force.following import ContactFollower, Maps, wave_tables
from mirrorskin.engine.force.halfspace import HalfSpace, press
from mirrorskin.engine.force.tangential import ContactShear
from mirrorskin.kernels.skin import contact

PIXEL = 0.05, 0.06
NAMES = "basis", "across", "weights", "inverse"


def dome(shape, centre=(0.0, 0.0), radius=4.0):
    y, x = ((np.arange(size) - (size - 1) / 2) * step for size, step in zip(shape, PIXEL[::-1], strict=True))
    return -((x - centre[0]) ** 2 + (y[:, np.newaxis] - centre[1]) ** 2) / (2 * radius)


def tables_of(space, columns, parts):
    return dict(zip(NAMES, wave_tables(space, columns, parts), strict=True))


def groups(device, values):
    return device.layout.group


def is_found(blocks, tolerance):
    """Return a check of what ``contact_follow`` finds, in which gaps are below a tolerance."""

    def check(actual, expected, values):
        sheet, other = (
            found[blocks : -contact.NUMBERS].reshape(contact.PLANES, -1) for found in (actual, expected)
        )
        np.testing.assert_allclose(actual[:blocks], expected[:blocks], atol=1e-6)
        np.testing.assert_array_equal(sheet[2], other[2])
        np.testing.assert_allclose(sheet[0], other[0], atol=0.05 * tolerance)
        np.testing.assert_allclose(sheet[1], other[1], atol=1e-3 * other[1].max())
        np.testing.assert_allclose(sheet[3:], other[3:], rtol=1e-5, atol=1e-6)
        numbers, goal = actual[-contact.NUMBERS :], expected[-contact.NUMBERS :]
        np.testing.assert_allclose(numbers[:12], goal[:12], rtol=1e-4, atol=1e-3)
        np.testing.assert_allclose(numbers[12:15], goal[12:15], atol=0.05 * tolerance * 40)
        np.testing.assert_allclose(numbers[15:], goal[15:], rtol=1e-3, atol=1e-4)

    return check


@pytest.mark.parametrize(("binning", "kinds"), [(1, 0), (2, 1), (4, 2)])
def test_contact_follow_computes_its_reference(device, binning, kinds):
    rng, shape, window, place = (
        np.random.default_rng(binning),
        (27 * binning + 1, 30 * binning),
        (22, 24),
        (2, 8),
    )
    height = np.repeat(np.repeat(dome((28, 30), (0.05, 0.02)), binning, 0), binning, 1)[
        : shape[0], : shape[1]
    ]
    height = height + rng.normal(0, 1e-3, shape)
    height[3:8, 3:8] = np.nan
    height[5 * binning : 7 * binning, 12 * binning : 15 * binning] = -np.inf
    blocks = shape[0] // binning * (shape[1] // binning)
    space = HalfSpace((shape[0] // binning, shape[1] // binning), PIXEL)
    start = press(space, dome(space.shape).astype(np.float64) + 0.1)
    found = rng.normal(size=blocks + contact.PLANES * window[0] * window[1] + contact.NUMBERS)
    sheet = found[blocks : -contact.NUMBERS].reshape(contact.PLANES, *window)
    inside = tuple(slice(first, first + size) for first, size in zip(place, window, strict=True))
    wide = start.contact[inside].shape[1]
    sheet[1:3] = 0
    sheet[1, :, :wide], sheet[2, :, :wide] = start.strain[inside], start.contact[inside]
    loads = rng.normal(size=(contact.LOADS, *window))
    loads[10:] = sheet[2] > 0
    sigma = rng.uniform(1e-3, 2e-3, shape)
    moved_sigma = rng.uniform(1e-3, 2e-3, (*shape, 2)[: 1 + kinds])
    values = {
        "map_rows": shape[0],
        "map_columns": shape[1],
        "top": place[0],
        "left": place[1],
        "shape": window,
        "reach": space.shape[0],
        "is_same": 0,
        "travel": 0.1,
        "bend": 0.03,
        "loose": 5e-4,
        "least": 1e-4,
        "lift": 1e-4,
        "own": space.own_displacement,
        "sigma_kinds": 1,
        "displacement_kinds": 2 if kinds else 0,
        "displacement_sigma_kinds": kinds,
        "height": height,
        "sigma": sigma,
        "displacement": rng.normal(size=(*shape, 2)),
        "displacement_sigma": moved_sigma,
        "loads": loads,
        "work": np.zeros(
            contact.WORK * window[0] * window[1] + blocks + 2 * shape[1] + 128 * contact.NUMBERS
        ),
        "found": found,
        "binning": binning,
        "macros": {"BINNING": binning},
    }
    if not kinds:
        values |= {"displacement": None, "displacement_sigma": None}
    checks = {"found": is_found(blocks, 1e-4), "work": lambda *_: None}
    with np.errstate(invalid="ignore"):
        agree(device, "contact_follow", values | tables_of(space, window[1], 1), per=groups, checks=checks)


@pytest.mark.parametrize("parts", [1, 2])
def test_contact_load_computes_its_reference(device, parts):
    window = 19, 24
    touches = dome(window) > -0.04
    forms = np.zeros((2, parts, *window))
    forms[0, 0], forms[1, -1] = 1.0, np.linspace(-1, 1, window[1])
    strains = np.random.default_rng(1).normal(size=forms.shape)
    values = {
        "count": 2,
        "parts": parts,
        "shape": window,
        "reach": 25,
        "tolerance": 1e-3,
        "lift": 0.01 if parts == 1 else 0.0,
        "contact": touches.astype(np.float64),
        "forms": forms,
        "strains": strains,
        "work": np.zeros((2, parts, contact.WORK, *window)),
        "macros": {"BINNING": 1},
    }
    checks = {"work": lambda *_: None}
    tables = tables_of(HalfSpace((25, 30), PIXEL), window[1], parts)
    agree(
        device,
        "contact_load",
        values | tables,
        per=lambda device, values: 2 * device.layout.group,
        atol=1e-4,
        checks=checks,
    )


def test_waves_are_transforms_on_a_padded_grid():
    space, strain = HalfSpace((33, 41), PIXEL), np.zeros((33, 41))
    strain[5:20, 9:30] = np.random.default_rng(0).uniform(size=(15, 21))
    basis, _, weights, _ = wave_tables(space, 24, 1)
    moved = contact._convolution(basis, weights)(strain[np.newaxis, :, 8:32])
    np.testing.assert_allclose(moved[0], space.displacement(strain)[:, 8:32], rtol=1e-10)


def test_tractions_that_move_a_contact_are_those_on_a_padded_grid(device):
    shape = 30, 36
    follower = ContactFollower(Blocks(shape, PIXEL, 1), 0.0, device)
    maps = Maps(dome(shape, (0.1, 0.0), 2.0).astype(np.float32), None, None, None)
    assert not follower.follow(maps, 0.1, 1e-4, 0.0)
    follower.restart(press(HalfSpace(shape, PIXEL), follower.surface))
    units = np.eye(2, dtype=np.float32)[:, :, np.newaxis, np.newaxis]
    nothing = np.zeros((2, 2, *shape), np.float32)
    found = follower.load(np.broadcast_to(units, nothing.shape), nothing)
    expected = ContactShear(follower.contact, PIXEL).weights()
    np.testing.assert_allclose(found, expected, atol=5e-3 * expected.max())
    np.testing.assert_allclose(found.sum(axis=(2, 3)), expected.sum(axis=(2, 3)), atol=1e-3 * expected.sum())
