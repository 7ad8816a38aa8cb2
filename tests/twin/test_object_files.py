"""Objects from files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import geometry
import numpy as np
import pytest
from numpy.typing import NDArray

from mirrorskin.io import InputError
from mirrorskin.twin.catalogue import make_object
from mirrorskin.twin.object_files import load_height_map
from mirrorskin.twin.objects import Sphere

SHAPE = (40, 56)
PIXEL = 0.1


def write(path: Path, values: NDArray[Any]) -> Path:
    if path.suffix == ".npy":
        np.save(path, values)
    else:
        assert cv2.imwrite(str(path), values)
    return path


def hill() -> NDArray[np.float64]:
    x, y = geometry.pixel_centres(SHAPE, PIXEL)
    return np.exp(-((x - 0.4) ** 2) - (y + 0.3) ** 2 / 2) + 0.01 * x


@pytest.mark.parametrize("suffix", [".png", ".tif", ".tiff"])
@pytest.mark.parametrize("scale", [0.001, 0.00005])
def test_sixteen_bit_pictures(tmp_path: Path, suffix: str, scale: float) -> None:
    counts = np.rint((hill() + 0.1) / scale).astype(np.uint16)
    path = write(tmp_path / f"hill{suffix}", counts)
    thing = make_object(path, SHAPE, (PIXEL, PIXEL), scale=scale)
    expected = (counts.astype(int) - counts.max()) * scale
    height = thing.height(*geometry.pixel_centres(SHAPE, PIXEL))
    np.testing.assert_allclose(height, expected, rtol=0, atol=1e-12)
    assert thing.name == path.name


@pytest.mark.parametrize("suffix", [".npy", ".NPY", ".tif"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_floating_point_is_millimetres_below_the_highest(tmp_path: Path, suffix: str, dtype: Any) -> None:
    heights = hill().astype(dtype)
    heights[3:9, 5] = np.nan
    path = write(tmp_path / f"hill{suffix.lower()}", heights).rename(tmp_path / f"hill{suffix}")
    actual = load_height_map(path, (PIXEL, PIXEL)).heights
    np.testing.assert_allclose(actual, heights.astype(float) - np.nanmax(heights), rtol=0, atol=1e-12)


def test_a_file_of_the_truth_is_like_the_object_itself(tmp_path: Path) -> None:
    x, y = geometry.pixel_centres((81, 81), PIXEL)
    heights = Sphere().height(x, y)
    copy = make_object(write(tmp_path / "ball.npy", heights), (81, 81), (PIXEL, PIXEL))
    assert copy.name == "ball.npy"
    np.testing.assert_array_equal(copy.height(x, y), heights)
    gentle = np.hypot(x, y) < 5 * np.sin(np.radians(40))
    for actual, expected in zip(copy.slope(x, y), Sphere().slope(x, y), strict=True):
        np.testing.assert_allclose(actual[gentle], expected[gentle], atol=3e-3)


@pytest.mark.parametrize(
    ("name", "values", "words"),
    [
        ("bytes.png", np.zeros((4, 4), np.uint8), "uint8"),
        ("colour.png", np.zeros((4, 4, 3), np.uint16), "rows and columns"),
        ("stack.npy", np.zeros((2, 4, 4)), "rows and columns"),
        ("empty.npy", np.zeros((0, 4)), "rows and columns"),
        ("whole.npy", np.zeros((4, 4), np.int64), "int64"),
        ("nowhere.npy", np.full((4, 4), np.nan), "finite"),
        ("deep.npy", np.array([[0.0, -np.inf]]), "finite"),
        ("objects.npy", np.array([[None]]), "it contains object"),
    ],
)
def test_unusable_values_are_refused(tmp_path: Path, name: str, values: NDArray[Any], words: str) -> None:
    refused(write(tmp_path / name, values), words)


@pytest.mark.parametrize("name", ["text.npy", "text.png", "text.tiff"])
@pytest.mark.parametrize("content", [b"", b"not a height map"])
def test_files_that_are_not_what_they_claim(tmp_path: Path, name: str, content: bytes) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    refused(path, "is not a NumPy array|is neither a PNG nor a TIFF|is not a TIFF|is damaged")


@pytest.mark.parametrize("name", ["missing.npy", "missing.png"])
def test_missing_files(tmp_path: Path, name: str) -> None:
    refused(tmp_path / name, "No such file")


def refused(path: Path, words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        make_object(path, SHAPE, (PIXEL, PIXEL))
    assert path.name in str(caught.value)
    assert "\n" not in str(caught.value)
