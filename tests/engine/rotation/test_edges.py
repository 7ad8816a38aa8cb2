"""Lines at creases and at the end of contact, on held-out objects (tests/support/creases.py)."""

from functools import cache

import creases
import numpy as np
import pytest
from creases import CONE, DOME, PYRAMID, RELIEFS, SMOOTH
from geometry import pixel_centres
from stacks import read_all

from mirrorskin import engine, io
from mirrorskin.evaluation.scenes import rotations
from mirrorskin.evaluation.scenes.rotations import EIGHTHS, TILT, Setup
from mirrorskin.twin import Axial, Body, Camera, Twin

SHAPE, PIXEL = (93, 98), 0.05
PRESS = {"pyramid": 0.9, "hip roof": 0.8, "frustum": 0.7, "cone on a plate": 2.0, "dome": 3.0}
LABS = {"lab": Setup(), "noisy lab": Setup(gain=3.0, noise=1.5)}


def grid():
    return pixel_centres(SHAPE, PIXEL)


@cache
def scene(name):
    """Normals, contact and true lines of an upright press, to the bottom unless PRESS tells."""
    relief = next(candidate for candidate in RELIEFS if candidate.name == name)
    touch = creases.pressed(relief, PRESS.get(name, 100.0))
    x, y = grid()
    lines = creases.edges_of(relief, touch, SHAPE, PIXEL)
    return creases.normals(relief, x, y), touch(x, y), lines


def noisy(normals, setup, seed):
    """Err as the best estimates do: return vectors and their sigma."""
    covariance = np.linalg.inv(rotations.information(normals, setup))
    half = np.linalg.cholesky(covariance)
    step = half @ np.random.default_rng(seed).normal(0, 1, (*normals.shape[:2], 2, 1))
    right, up = rotations.tangents(normals)
    moved = normals + right * step[..., 0, :] + up * step[..., 1, :]
    moved /= np.linalg.norm(moved, axis=-1, keepdims=True)
    return moved, np.sqrt(np.trace(covariance, axis1=-2, axis2=-1))


def find(vectors, sigma, contact, device):
    """Draw the edges; what is not in contact has no normal."""
    vectors = np.where(contact[..., np.newaxis], vectors, np.nan).astype(np.float32)
    sigma = np.where(contact, sigma, np.nan).astype(np.float32)
    edges = engine.find_edges(vectors, sigma, contact.astype(np.uint8), device=device)
    assert edges.dtype == np.uint8
    assert edges.shape == contact.shape
    assert set(np.unique(edges)) <= {0, 1}
    return edges


def assert_follows(edges, lines, minimum=0.95):
    agreement = creases.agreement(edges, lines)
    assert agreement.recall >= minimum, agreement
    assert agreement.precision >= minimum, agreement
    assert agreement.thickness <= 1.5, agreement


@pytest.mark.parametrize("name", [relief.name for relief in RELIEFS])
def test_edges_are_where_the_surface_is_creased(device, name):
    normals, contact, lines = scene(name)
    assert_follows(find(normals, np.full(SHAPE, 1e-4), contact, device), lines)


CREASED = ("pyramid", "hip roof", "frustum", "dome", "gentle and steep")
# Round a cone's tip the normal turns as fast as the noise of the worse lab makes it jump.
NOISY = [("lab", "cone on a plate"), *((lab, name) for lab in LABS for name in CREASED)]


@pytest.mark.parametrize(("lab", "name"), NOISY)
def test_edges_are_found_in_the_noise_of_normals(device, lab, name):
    normals, contact, lines = scene(name)
    vectors, sigma = noisy(normals, LABS[lab], seed=1)
    assert_follows(find(vectors, sigma, contact, device), lines)


@pytest.mark.parametrize("setup", LABS.values(), ids=LABS)
def test_noise_alone_makes_hardly_any_edge(device, setup):
    normals, contact, lines = scene(SMOOTH.name)
    assert len(lines.points) == 0
    vectors, sigma = noisy(normals, setup, seed=2)
    assert np.mean(find(vectors, sigma, contact, device)) <= 0.001


@cache
def roof(jump, azimuth):
    zenith = 15 - jump / 2
    relief = creases.Profile(
        creases.fall((3, zenith), (3, zenith + jump), start=-3.013), azimuth, name="roof"
    )
    lines = creases.edges_of(relief, creases.pressed(relief, 100.0), SHAPE, PIXEL)
    return creases.normals(relief, *grid()), lines


@pytest.mark.parametrize(
    ("jump", "azimuth"), [(8.0, 17.0), (12.5, 45.0), (12.5, 0.0), (20.0, 17.0), (20.0, 90.0)]
)
def test_a_jump_counts_from_ten_degrees_on(device, jump, azimuth):
    normals, lines = roof(jump, azimuth)
    edges = find(normals, np.full(SHAPE, 1e-4), np.ones(SHAPE, bool), device)
    assert (len(lines.points) > 0) == (jump > 10)
    assert_follows(edges, lines, minimum=0.99)


@cache
def rotation(name):
    """Frames of the rotating twin on an object, and the lines that are true all the turn."""
    relief = next(candidate for candidate in RELIEFS if candidate.name == name)
    press = {"pyramid": 0.5, "cone on a plate": 0.4, "dome": 0.45}[name]
    twin = Twin(
        object=relief,
        shape=SHAPE,
        pixel_size=PIXEL,
        movement=Axial(EIGHTHS, TILT, press=press),
        pattern="linear",
        body=Body(height=1e5, scatter=0.0),
        camera=Camera(noise=1.0, seed=3),
    )
    lines = creases.edges_of(relief, creases.turned(relief, press, EIGHTHS, TILT), SHAPE, PIXEL)
    return read_all(twin, 8).frames, twin.header, lines


@pytest.mark.parametrize("relief", [PYRAMID, CONE, DOME], ids=lambda relief: relief.name)
def test_edges_are_found_in_what_the_twin_sees(device, relief):
    frames, header, lines = rotation(relief.name)
    spread = float(np.hypot(1.0, 1 / np.sqrt(12)))
    gain, offset = header.zenith_gain, header.zenith_offset
    result = engine.estimate_normals(
        frames, EIGHTHS, tilt=TILT, zenith_gain=gain, zenith_offset=offset, noise=spread, device=device
    )
    edges = engine.find_edges(result.normals, result.normals_sigma, result.contact, device=device)
    assert len(lines.points) > 400
    assert_follows(edges, lines)


SMALL = (21, 34)


def plain_roof(degrees=30.0, sigma=0.01):
    """Normals of a roof whose ridge runs between columns 15 and 16."""
    angle = np.radians(degrees) / 2
    facing = np.where(np.arange(SMALL[1]) < 16, -angle, angle)
    vectors = np.stack([np.sin(facing), np.zeros_like(facing), np.cos(facing)], axis=-1)
    vectors = np.broadcast_to(vectors, (*SMALL, 3)).astype(np.float32)
    return vectors.copy(), np.full(SMALL, sigma, np.float32), np.ones(SMALL, np.uint8)


def test_wrong_flags_of_contact_are_no_edges_and_true_ends_are(device):
    vectors, sigma, contact = plain_roof(0.0)
    contact[3, 3] = contact[9, 20] = 0
    assert not engine.find_edges(vectors, sigma, contact, device=device).any()
    contact[:, 25:] = 0
    contact[8, 30] = 1
    edges = engine.find_edges(vectors, sigma, contact, device=device)
    expected = np.zeros(SMALL, np.uint8)
    expected[:, 24] = 1
    np.testing.assert_array_equal(edges, expected)


def test_what_has_no_normal_makes_no_edge_of_its_own(device):
    vectors, sigma, contact = plain_roof()
    vectors[:5], sigma[:5] = np.nan, np.nan
    edges = engine.find_edges(vectors, sigma, contact, device=device)
    assert not edges[:5].any()
    assert (edges[6:-1].sum(axis=1) == 1).all()


@pytest.mark.parametrize("wrong", ["vectors", "sigma", "empty"])
def test_maps_that_do_not_fit_are_refused(wrong):
    vectors, sigma, contact = plain_roof()
    arguments = {
        "vectors": (vectors[1:], sigma, contact),
        "sigma": (vectors, sigma[:, 1:], contact),
        "empty": (vectors[:0], sigma[:0], contact[:0]),
    }
    with pytest.raises(io.InputError, match="do not fit"):
        engine.find_edges(*arguments[wrong])
