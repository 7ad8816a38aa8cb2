"""Refusals of exports: one line with cause and remedy, and no file."""

from __future__ import annotations

import errno
from io import BytesIO

import numpy as np
import pytest

from mirrorskin import io
from mirrorskin.io.formats.export import check_export
from mirrorskin.io.formats.registry import export_suffixes

PICTURES = ["out.png", "out.tif", "out.tiff"]
IN_MILLIMETRES = ["out.ply", "out.stl", "out.xyz", "out.csv", *PICTURES]


def refused(result, path, **options):
    with pytest.raises(io.InputError) as caught:
        io.export_result(result, path, **options)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(str(path))
    return str(caught.value).removeprefix(str(path))


@pytest.mark.parametrize(
    ("name", "wrong"), [("out.off", "off is not a supported format"), ("out", "its name has no suffix")]
)
def test_a_suffix_that_is_unknown_names_those_that_are_known(slope, tmp_path, name, wrong):
    line = refused(slope, tmp_path / name)
    assert wrong in line
    assert line.endswith(f"name a file that ends with one of {' '.join(export_suffixes())}")


@pytest.mark.parametrize("name", IN_MILLIMETRES[:2])
@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"x": None, "y": None}, "the result has no pixel size: reconstruct it again with --pixel-size, or"),
        ({"height": None}, ": the result has no heights: reconstruct it again with them, or export"),
        (
            {"height": np.full((6, 9), np.nan, np.float32)},
            "no pixel of the result has a height: look at its",
        ),
    ],
)
def test_what_needs_millimetres_is_not_made_without(slope, tmp_path, name, change, line):
    lacking = slope.assign(**change)
    assert line in refused(lacking, tmp_path / name)
    with pytest.raises(io.InputError, match=r"as \.npz"):
        check_export(lacking, tmp_path / name)
    check_export(lacking, tmp_path / "out.npz")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("name", "shape"), [("out.ply", (1, 9)), ("out.stl", (6, 1)), ("out.ply", (1, 1))])
def test_a_single_row_is_not_a_surface(tmp_path, name, shape):
    x, y = io.pixel_axes(shape, (0.5, 0.5))
    row = io.Result(height=np.zeros(shape, np.float32), x=x, y=y)
    line = refused(row, tmp_path / name)
    assert line == ": no three adjacent pixels have heights, so there is no surface: export points, .xyz"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["ply", "csv"])
def test_a_file_that_cannot_be_written_is_one_line(slope, tmp_path, name):
    section = {"distance": np.zeros(2), "height": np.zeros(2)}
    assert "there is no folder" in refused(slope, tmp_path / "nowhere" / f"out.{name}", section=section)


def test_a_full_disk_is_one_line_and_leaves_the_older_file(slope, tmp_path, monkeypatch):
    class Full(BytesIO):
        def writelines(self, parts):
            raise OSError(errno.ENOSPC, "no room")

    path = tmp_path / "out.ply"
    path.write_text("older")
    with monkeypatch.context() as patched:
        patched.setattr("os.fdopen", lambda *words, **options: Full())
        assert " could not be written: No space left on device; make room" in refused(slope, path)
    assert path.read_text() == "older"
    assert list(tmp_path.iterdir()) == [path]
