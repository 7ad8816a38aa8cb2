"""Surface files of metrology, read by the readers of libraries: heights, pixel size, unit, origin, holes."""

from __future__ import annotations

import gsffile
import numpy as np
import pytest
import surfalize
import tifffile
import trimesh
import x3pio

from mirrorskin import io

SUFFIXES = [".x3p", ".sur", ".gsf", ".obj", ".tif", ".csv"]


@pytest.fixture
def exported(slope, tmp_path):
    """Write the slope with a suffix, and return the path."""

    def write(suffix, **options):
        path = tmp_path / f"a{suffix}"
        io.export_result(slope, path, **options)
        return path

    return write


def test_an_x3p_has_the_heights_in_metres_from_the_top_row(slope, exported):
    file = x3pio.read(exported(".x3p"))
    assert file.revision is x3pio.Revision.ISO5436_2000
    (layer,) = file.layers
    np.testing.assert_allclose(layer.z, slope.height.astype(float) * 1e-3, rtol=1e-12)


def test_an_x3p_has_the_positions_of_x_and_y(slope, exported):
    (layer,) = x3pio.read(exported(".x3p")).layers
    points = layer.points(coordinate_system=x3pio.CoordinateSystem.GLOBAL).reshape(6, 9, 3)
    np.testing.assert_allclose(points[0, :, 0], 1e-3 * slope.x, atol=1e-12)
    np.testing.assert_allclose(points[:, 0, 1], -1e-3 * slope.y, atol=1e-12)  # down the picture


def test_an_x3p_states_program_date_and_notes(exported):
    metadata = x3pio.read(exported(".x3p")).metadata
    assert (metadata.instrument.model, metadata.instrument.version) == ("mirrorskin", "1.2.3")
    assert metadata.date.isoformat() == "2026-01-02T03:04:05+00:00"
    assert "heights: from the sheet at rest" in metadata.comment
    assert "filled: 1 of 53 heights" in metadata.comment


@pytest.mark.filterwarnings("ignore:The surface has different pixel size in x and y")
@pytest.mark.parametrize("suffix", [".x3p", ".sur"])
def test_surfalize_reads_the_same_surface(slope, exported, suffix):
    surface = surfalize.Surface.load(exported(suffix))
    np.testing.assert_allclose(surface.data, 1e3 * slope.height, rtol=1e-5)
    assert (surface.step_x, surface.step_y) == pytest.approx((500, 250))


def test_a_gsf_has_heights_size_and_origin_in_metres(slope, exported):
    heights, fields = gsffile.read_gsf(exported(".gsf"))
    np.testing.assert_allclose(heights, 1e-3 * slope.height, rtol=1e-6)
    assert (fields["XReal"], fields["YReal"]) == pytest.approx((9 * 0.5e-3, 6 * 0.25e-3))
    assert (fields["XOffset"], fields["YOffset"]) == pytest.approx((-9 * 0.25e-3, -6 * 0.125e-3))
    assert (fields["XYUnits"], fields["ZUnits"]) == ("m", "m")


def test_a_tiff_of_float32_has_the_heights_in_mm(slope, exported):
    with tifffile.TiffFile(exported(".tif", float32=True)) as file:
        (page,) = file.pages
        np.testing.assert_array_equal(page.asarray(), slope.height)
        assert page.tags["XResolution"].value[0] / page.tags["XResolution"].value[1] == pytest.approx(20)
        assert page.tags["YResolution"].value[0] / page.tags["YResolution"].value[1] == pytest.approx(40)
        assert page.tags["ImageDescription"].value.startswith("unit: mm\npixel size: 0.5 x 0.25 mm\n")


def test_a_matrix_has_the_heights_in_mm(slope, exported):
    path = exported(".csv")
    np.testing.assert_allclose(np.loadtxt(path, delimiter=","), slope.height, rtol=1e-8)
    head = path.read_text(encoding="utf-8")
    assert "# pixel size: 0.5 x 0.25 mm (x, y)\n" in head
    assert "# first value: x = -2.0 mm, y = 0.625 mm; y decreases from line to line\n" in head


def test_an_obj_is_the_surface_of_the_ply(exported):
    flat, same = (trimesh.load(exported(suffix), process=False) for suffix in (".obj", ".ply"))
    np.testing.assert_allclose(flat.vertices, same.vertices, rtol=1e-6, atol=1e-7)
    np.testing.assert_array_equal(flat.faces, same.faces)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_an_export_replaces_an_older_one(exported, suffix):
    assert exported(suffix).read_bytes()[:200] == exported(suffix).read_bytes()[:200]


@pytest.mark.parametrize("suffix", [".x3p", ".sur", ".gsf"])
def test_no_export_replaces_a_surface_of_another_program(exported, suffix):
    path = exported(suffix)
    if suffix == ".x3p":
        x3pio.write(path, np.zeros((2, 3)), x_scale=1e-6, y_scale=1e-6)
    else:
        path.write_bytes(path.read_bytes().replace(b"mirrorskin", b"other_name"))
    with pytest.raises(io.InputError, match=r"is an archive|is a surface of another program"):
        exported(suffix)


def test_a_package_that_is_missing_is_one_line(slope, tmp_path, monkeypatch):
    monkeypatch.setattr("mirrorskin.io.formats.registry.find_spec", lambda name: None)
    with pytest.raises(io.InputError, match=r"needs the package x3pio: pip install 'mirrorskin\[metrology\]"):
        io.export_result(slope, tmp_path / "a.x3p")
