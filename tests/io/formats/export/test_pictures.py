"""Heights in 16 bits, opened by OpenCV, Pillow and tifffile."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

from mirrorskin import io

HOLE, PEAK = (4, 2), (1, 6)


def read_opencv(path):
    # From memory: of a file it would say on standard error that GDAL's tag is none of its own.
    return cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)


def read_pillow(path):
    with Image.open(path) as picture:
        return np.asarray(picture)


def read_tifffile(path):
    return tifffile.imread(path)


READERS = [
    *(("png", read) for read in (read_opencv, read_pillow)),
    *((suffix, read) for suffix in ("tif", "tiff") for read in (read_opencv, read_pillow, read_tifffile)),
]


def scale_of(path):
    """Return the height at count 0 and that of one count, mm, as the file tells them."""
    if path.suffix == ".png":
        with Image.open(path) as picture:
            texts = [picture.text["height offset"], picture.text["height step"]]
        assert all(text.endswith(" mm") for text in texts)
        return [float(text.removesuffix(" mm")) for text in texts]
    with tifffile.TiffFile(path) as file:
        metadata = file.imagej_metadata
    assert (metadata["vunit"], metadata["cf"]) == ("mm", 0)
    return metadata["c0"], metadata["c1"]


@pytest.mark.parametrize(("suffix", "read"), READERS)
def test_heights_come_back_within_half_a_count(slope, tmp_path, suffix, read):
    path = tmp_path / f"out.{suffix}"
    description = io.export_result(slope, path)
    counts = read(path)
    assert (counts.shape, counts.dtype) == ((6, 9), np.uint16)
    offset, step = scale_of(path)
    assert description == f"height in mm = {offset!r} + {step!r} x count; count 0: no answer"
    finite = np.isfinite(slope.height)
    np.testing.assert_allclose(
        offset + step * counts[finite], slope.height[finite], rtol=0, atol=0.501 * step
    )
    # The range is used, and nothing but the hole is 0.
    assert step == pytest.approx((slope.height[finite].max() - slope.height[finite].min()) / 65534)
    assert np.argwhere(counts == 0).tolist() == [list(HOLE)]
    assert (counts[finite].min(), counts.max()) == (1, 65535)
    # Row 0 is the top: the peak is above the middle.
    assert np.unravel_index(np.argmax(counts), counts.shape) == PEAK


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_a_picture_has_its_size_in_millimetres(slope, tmp_path, suffix):
    path = tmp_path / f"out.{suffix}"
    io.export_result(slope, path)
    with Image.open(path) as picture:
        size = 25.4 * np.array(picture.size) / picture.info["dpi"]
    np.testing.assert_allclose(size, [9 * 0.5, 6 * 0.25])


def test_a_tiff_contains_what_imagej_and_gdal_need(slope, tmp_path):
    path = tmp_path / "out.tif"
    io.export_result(slope, path)
    with tifffile.TiffFile(path) as file:
        page, metadata = file.pages[0], file.imagej_metadata
    assert page.nodata == 0
    assert page.resolutionunit == tifffile.RESUNIT.CENTIMETER
    assert metadata["unit"] == "cm"
    # A column's x and a row's y, mm, as ImageJ reckons them with a y that runs up.
    assert metadata["inverty"] is True
    across, up = (10 / number for number in page.resolution)
    np.testing.assert_allclose((np.arange(9) - metadata["xorigin"]) * across, slope.x)
    np.testing.assert_allclose((metadata["yorigin"] - np.arange(6)) * up, slope.y)
    assert page.software == "mirrorskin 1.2.3"
    assert metadata["source"] == "Münze 五円.h5"
    assert metadata["date"] == "2026-01-02T03:04:05+00:00"


def test_a_png_contains_what_gwyddion_needs(slope, tmp_path):
    path = tmp_path / "out.png"
    # Of a part of the picture, so that the middle of it is not the origin.
    io.export_result(slope.assign(x=slope.x + 3, y=slope.y + 7), path)
    with Image.open(path) as picture:
        numbers = {
            name.removeprefix("Gwy::"): text for name, text in picture.text.items() if name[:5] == "Gwy::"
        }
    texts = {name: numbers.pop(name) for name in ("XYUnit", "XYUnits", "ZUnit", "ZUnits", "Title")}
    assert set(texts.values()) == {"m", "Münze 五円.h5"}
    offset, _ = scale_of(path)
    assert {name: float(text) for name, text in numbers.items()} == pytest.approx(
        {
            "XReal": 4.5e-3,
            "YReal": 1.5e-3,
            "XOffset": (3 - 2.25) * 1e-3,
            "YOffset": -(7 + 0.75) * 1e-3,
            "ZMin": offset * 1e-3,
            "ZMax": float(np.nanmax(slope.height)) * 1e-3,
        }
    )


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_heights_that_are_all_one_come_back(tmp_path, suffix):
    path = tmp_path / f"out.{suffix}"
    x, y = io.pixel_axes((3, 4), (0.5, 0.25))
    height = np.full((3, 4), -1.25, np.float32)
    height[0, 0] = np.inf
    io.export_result(io.Result(height=height, x=x, y=y), path)
    counts = read_pillow(path)
    offset, step = scale_of(path)
    assert counts[0, 0] == 0
    np.testing.assert_allclose(offset + step * np.delete(counts.ravel(), 0), -1.25, atol=1e-12)
