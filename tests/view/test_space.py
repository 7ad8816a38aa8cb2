"""A surface in space: where its vertices are, how they are lit, and what colours they have."""

import subprocess
import sys

import numpy as np
import pytest
from shown import ball

from mirrorskin import io
from mirrorskin.view import space
from mirrorskin.view.colours import FILLED_RGB


class Stream:
    """What keeps what is logged."""

    def __init__(self):
        self.logged = {}

    def log(self, place, what, static):
        assert static
        self.logged[place] = what

    def send_blueprint(self, blueprint): ...
    def flush(self, timeout_sec): ...
    def disconnect(self): ...


@pytest.fixture
def stream(monkeypatch):
    made = Stream()
    monkeypatch.setattr(space, "open_stream", lambda where, option: made)
    return made


def shown(stream, result):
    """Return vertices, triangles, normals and colours of a surface that is shown."""
    space.show_surface(result, "window", "it")
    mesh = stream.logged["surface"]
    vertices, triangles, normals = (
        np.array(part.as_arrow_array().to_pylist())
        for part in (mesh.vertex_positions, mesh.triangle_indices, mesh.vertex_normals)
    )
    packed = np.array(mesh.vertex_colors.as_arrow_array().to_pylist(), np.uint32)
    return vertices, triangles, normals, np.stack([packed >> shift & 255 for shift in (24, 16, 8)], axis=-1)


def test_vertices_lie_in_millimetres_the_right_way_up(stream):
    result = ball()
    vertices, triangles, _, _ = shown(stream, result)
    column, row = (np.argmin(np.abs(known - 0.65)) for known in (result.x, result.y))
    place = result.x[column], result.y[row], result.height[row, column]
    assert np.abs(vertices - place).sum(axis=1).min() < 1e-5
    assert len(vertices) <= np.count_nonzero(np.isfinite(result.height))
    a, b, c = (vertices[triangles[:, corner]] for corner in range(3))
    assert np.all(np.cross(b - a, c - a)[:, 2] > 0)  # they face the camera


def test_light_falls_on_the_surface_s_own_normals(stream):
    vertices, _, normals, _ = shown(stream, ball((96, 128), (0.025, 0.03)))
    expected = vertices + np.array([0, 0, 2.0])
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    inner = np.hypot(vertices[:, 0], vertices[:, 1]) < 1.2
    angles = np.degrees(np.arccos(np.clip(np.sum(expected * normals, axis=1), -1, 1)))
    assert np.median(angles[inner]) < 0.5
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)


def test_colours_tell_the_height_and_what_was_filled(stream):
    result = ball()
    vertices, _, _, colours = shown(stream, result)
    radius = np.hypot(vertices[:, 0], vertices[:, 1])
    filled = radius < 0.2
    assert filled.any()
    np.testing.assert_array_equal(colours[filled], np.broadcast_to(FILLED_RGB, (filled.sum(), 3)))
    low, high = (colours[np.argmin(np.where(filled, 0, sign * vertices[:, 2]))] for sign in (1, -1))
    assert low[2] > low[1]  # violet
    assert high[1] > high[2]  # yellow


def test_what_is_seen_is_told(stream):
    shown(stream, ball(offset_unknown=np.ones(1, np.uint8)))
    told = stream.logged["about"].text.as_arrow_array().to_pylist()[0]
    assert "heights from -1." in told
    assert "orange: not measured but filled" in told
    assert "relative to its mean" in told


@pytest.mark.parametrize(
    ("result", "told"),
    [
        (ball(height=None), "it has no heights"),
        (ball(x=None, y=None), "reconstruct it again with --pixel-size"),
        (ball((1, 40)), "no three neighbours"),
        (io.Result(height=np.zeros((2, 3, 4), np.float32)), "--turn"),
    ],
    ids=["no heights", "no pixel size", "one row", "turns"],
)
def test_what_is_no_surface_is_said(stream, result, told):
    with pytest.raises(io.InputError, match=told):
        space.show_surface(result, "window", "it")
    assert not stream.logged


def test_a_file_keeps_the_surface(tmp_path):
    path = tmp_path / "ball.rrd"
    space.show_surface(ball(), path, "it")
    command = [sys.executable, "-m", "rerun_cli", "rrd", "print", str(path)]
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert "/surface" in printed
    assert "/about" in printed
