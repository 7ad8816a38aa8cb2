"""`mirrorskin export`: one result, many files for other programs."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
import trimesh
from commands import refused, run

from mirrorskin import io

SIZE = 0.05  # mm
X, Y = io.pixel_axes((31, 41), (SIZE, SIZE))
HOLE = 5, 30


def cap(apex=(0.3, -0.2), radius=5.0):
    """Return the heights of a ball that is not in the middle."""
    across, up = X - apex[0], Y[:, None] - apex[1]
    return (np.sqrt(radius**2 - across**2 - up**2) - radius - 1).astype(np.float32)


@pytest.fixture(autouse=True)
def folder():
    height = cap()
    height[HOLE] = np.nan
    sigma = np.full(height.shape, 0.002, np.float32)
    result = io.Result(height=height, height_sigma=sigma, x=X, y=Y, process={"source": "ball.h5"})
    io.save_result(result, "ball-result.h5")
    two = np.stack([cap(), cap(apex=(-0.5, 0.5))])
    io.save_result(io.Result(height=two, x=X, y=Y), "turns-result.h5")


def columns_of(path):
    """Return a table's columns, by the names in its head."""
    lines = [line for line in Path(path).read_text(encoding="utf-8").splitlines() if line[0] != "#"]
    rows = [[float(cell or "nan") for cell in line.split(",")] for line in lines[1:]]
    return dict(zip(lines[0].split(","), np.array(rows).T, strict=True))


def place_of_top(path):
    vertices = trimesh.load(path).vertices
    return vertices[np.argmax(vertices[:, 2]), :2]


def test_each_file_is_written_and_printed_in_a_line():
    names = ["ball.ply", "ball.stl", "ball.xyz", "ball.png", "ball.tif", "ball.csv", "ball.npz"]
    ended = run("export ball-result.h5", *(word for name in names for word in ("-o", name)))
    assert (ended.code, ended.said) == (0, "")
    lines = ended.out.splitlines()
    assert [line.partition(": ")[0] for line in lines] == names
    size = f"2 x 1.5 x {np.ptp(cap()):.4g} mm"
    assert lines[0] == f"ball.ply: {2 * 30 * 40 - 4} triangles between 1270 points, {size}"
    assert lines[2] == "ball.xyz: 1270 points"
    assert lines[6] == "ball.npz: height, height_sigma"
    assert len(trimesh.load("ball.stl").faces) == 2 * 30 * 40 - 4
    assert len(np.loadtxt("ball.xyz")) == 1270
    counts = cv2.imread("ball.png", cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(tifffile.imread("ball.tif"), counts)
    assert np.argwhere(counts == 0).tolist() == [list(HOLE)]
    assert np.loadtxt("ball.csv", delimiter=",").shape == (31, 41)
    with np.load("ball.npz") as file:
        np.testing.assert_array_equal(file["height"], io.open_result("ball-result.h5").height)


def test_the_ball_stays_at_its_place():
    assert run("export ball-result.h5 -o ball.ply -o ball.png").code == 0
    np.testing.assert_allclose(place_of_top("ball.ply"), [0.3, -0.2], atol=1e-6)
    counts = cv2.imread("ball.png", cv2.IMREAD_UNCHANGED)
    row, column = np.unravel_index(np.argmax(counts), counts.shape)
    np.testing.assert_allclose([X[column], Y[row]], [0.3, -0.2], atol=1e-6)


def test_points_are_asked_for():
    assert run("export ball-result.h5 -o ball.ply --points").out == "ball.ply: 1270 points\n"
    assert isinstance(trimesh.load("ball.ply"), trimesh.PointCloud)


def test_a_turn_is_chosen():
    refused("has maps of 2 turns: choose one with --turn 0 to 1", "export turns-result.h5 -o turn.ply")
    assert run("export turns-result.h5 --turn", 1, "-o", "turn.ply", "-o", "turn.xyz").code == 0
    np.testing.assert_allclose(place_of_top("turn.ply"), [-0.5, 0.5], atol=1e-6)
    assert "# turn: 1" in Path("turn.xyz").read_text(encoding="utf-8")


def test_a_cross_section_runs_across_the_apex():
    assert run("export ball-result.h5 -o cut.csv --section apex").code == 0
    columns = columns_of("cut.csv")
    assert list(columns) == ["distance [mm]", "x [mm]", "y [mm]", "height [mm]", "sigma [mm]"]
    np.testing.assert_allclose(columns["y [mm]"], -0.2)
    np.testing.assert_allclose(columns["x [mm]"], X, atol=1e-9)
    np.testing.assert_allclose(columns["distance [mm]"], X - X[0], atol=1e-9)
    expected = cap()[np.argmin(np.abs(Y + 0.2))]
    np.testing.assert_allclose(columns["height [mm]"], expected, atol=1e-6)
    np.testing.assert_allclose(columns["sigma [mm]"], 0.002, rtol=1e-6)
    assert "# source: ball.h5" in Path("cut.csv").read_text(encoding="utf-8")


def test_a_cross_section_runs_between_two_points_and_a_hole_is_empty():
    x, y = X[HOLE[1]], Y[HOLE[0]]
    ends = f"--section={x:.3f}mm,0mm:{x:.3f}mm,{y + 0.2:.3f}mm"
    assert run("export ball-result.h5 -o cut.csv", ends).code == 0
    columns = columns_of("cut.csv")
    np.testing.assert_allclose(columns["x [mm]"], x, atol=1e-9)
    assert columns["y [mm]"][[0, -1]] == pytest.approx([0, y + 0.2], abs=1e-9)
    missing = columns["y [mm]"][np.isnan(columns["height [mm]"])]
    np.testing.assert_allclose(missing, y, atol=1e-9)
    assert len(missing) == 1


def test_a_filled_height_is_marked_in_a_cross_section():
    filled = np.zeros((31, 41), np.uint8)
    filled[:, 20] = 1
    io.save_result(io.Result(height=cap(), filled=filled, x=X, y=Y), "filled-result.h5")
    assert run("export filled-result.h5 -o cut.csv --section apex").code == 0
    columns = columns_of("cut.csv")
    assert list(columns) == ["distance [mm]", "x [mm]", "y [mm]", "height [mm]", "filled"]
    assert np.flatnonzero(columns["filled"]).tolist() == [20]


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (
            "-o first.npz -o a.off",
            "a.off: .off is not a supported format: name a file that ends with one of .sur .gsf .png .tif",
        ),
        ("-o ball-result.h5", "ball-result.h5 is the input, or part of it: name another output with -o"),
        ("-o first.npz -o no/a.ply", "no/a.ply: there is no folder no: make it first"),
        ("-o a.ply --turn 0", "not of single turns: leave --turn out"),
        ("-o a.ply --section 0mm,0mm:1mm,1mm", "--section is for a .csv file: name one with -o"),
        ("-o a.stl --float32", "--float32 is for a .tif file: name one with -o, or leave --float32 out"),
        ("-o a.stl --points", "--points is for a .ply file: name one with -o, or leave --points out"),
        ("-o a.csv --section 0mm,0mm", "two points are needed"),
        ("-o a.csv --section 0,0:1,1", "a unit is needed"),
        ("-o a.csv --section 0.9mm,0.9mm:1mm,1mm", "no height is known along the section"),
        ("-o a.ply -o a.stl -o ./a.ply", "a.ply is to be written twice"),
        ("", "Missing option '--output'"),
    ],
)
def test_impossible_input_is_one_line_and_writes_nothing(words, line):
    before = {path: path.stat().st_mtime_ns for path in Path().iterdir()}
    refused(line, f"export ball-result.h5 {words}")
    assert {path: path.stat().st_mtime_ns for path in Path().iterdir()} == before


def test_a_result_without_a_pixel_size_is_refused_but_for_its_arrays():
    io.save_result(io.Result(height=cap()), "bare-result.h5")
    for suffix in ("ply", "stl", "xyz", "png", "tif", "tiff", "csv"):
        message = refused(f"bare.{suffix} needs millimetres", "export bare-result.h5 -o", f"bare.{suffix}")
        assert "--pixel-size" in message
    assert run("export bare-result.h5 -o bare.npz").code == 0


def test_a_file_that_is_not_a_result_is_one_line():
    Path("notes.txt").write_text("no result")
    refused("notes.txt is not an HDF5 file", "export notes.txt -o a.ply")
