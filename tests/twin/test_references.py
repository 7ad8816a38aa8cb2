"""References as taken in a laboratory, compared with the twin's true levels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from geometry import pixel_centres
from numpy.typing import NDArray

from mirrorskin.twin import Body, Camera, Twin, Vertical

Counts = NDArray[np.float32]

SHAPE, PIXEL = (30, 36), 0.3
NOISE = 1.5


def make_twin(shape: tuple[int, int] = SHAPE, pixel: float = PIXEL, **changes: Any) -> Twin:
    options: dict[str, Any] = {"object": "sphere", "movement": Vertical([0.0, 1.0]), "references": "ball"}
    options["camera"] = Camera(np.dtype(np.float32), NOISE)
    return Twin(shape=shape, pixel_size=pixel, **(options | changes))


def references(shape: tuple[int, int] = SHAPE, pixel: float = PIXEL, **changes: Any) -> tuple[Counts, Counts]:
    header = make_twin(shape, pixel, **changes).header
    assert header.dark is not None
    assert header.bright is not None
    assert header.dark.dtype == header.bright.dtype == np.float32
    assert header.dark.shape == header.bright.shape == shape
    return header.dark, header.bright


@pytest.mark.parametrize(
    ("dtype", "optics"), [("uint8", "cylinder"), ("uint16", "ideal"), ("float32", "cylinder")]
)
def test_a_ball_brings_dark_and_bright_of_each_pixel(dtype: str, optics: str) -> None:
    scale = 16 if dtype == "uint16" else 1
    camera = Camera(np.dtype(dtype), NOISE * scale, 3, gain_deviation=0.03, offset_deviation=4.0 * scale)
    exact = references(camera=camera, optics=optics, references="exact")
    taken = references(camera=camera, optics=optics)
    dark, bright = (actual - level for actual, level in zip(taken, exact, strict=True))
    # Dark is the mean of 16 samples, which may be rounded.
    noise = scale * np.hypot(NOISE, (12**-0.5 / scale if dtype != "float32" else 0))
    assert dark.std() == pytest.approx(noise / 4, rel=0.1)
    assert abs(dark.mean()) < 5 * noise / 4 / np.sqrt(dark.size)
    # Bright is the third of the brightest samples: some tenths of the noise above, never of one glint.
    assert 0 < bright.mean() < 1.2 * noise
    assert np.abs(bright).max() < 4 * noise
    full = exact[1] - exact[0]
    np.testing.assert_allclose(taken[1] - taken[0], full, rtol=0.04)
    assert np.mean(np.abs((taken[1] - taken[0]) / full - 1)) < 0.01
    assert np.corrcoef((taken[1] - taken[0]).ravel(), full.ravel())[0, 1] > 0.99
    assert np.corrcoef(taken[0].ravel(), exact[0].ravel())[0, 1] > 0.99


@pytest.mark.parametrize(("shape", "pixel"), [((40, 40), 1.2), ((60, 12), 1.0)])
def test_beyond_the_body_there_are_no_references(shape: tuple[int, int], pixel: float) -> None:
    away = np.hypot(*pixel_centres(shape, pixel))
    for optics in ("ideal", "cylinder"):
        dark, bright = references(shape, pixel, optics=optics)
        for reference in (dark, bright):
            assert np.isnan(reference[away > 17.5]).all()
            assert np.isfinite(reference[away < 17.2]).all()
        assert (away > 17.5).sum() > 50
        np.testing.assert_allclose(bright[away < 16], 224, atol=6)


def test_without_noise_the_ball_shows_the_exact_levels() -> None:
    camera = Camera(np.dtype(np.float32), 0.0, gain_deviation=0.05, offset_deviation=2.0)
    for actual, exact in zip(
        references(camera=camera), references(camera=camera, references="exact"), strict=True
    ):
        np.testing.assert_allclose(actual, exact, atol=1e-3)


def test_references_have_noise_of_their_own() -> None:
    twin = make_twin(movement=Vertical(np.full(100, -1.0)))
    dark, bright = twin.header.dark, twin.header.bright
    assert dark is not None
    assert bright is not None
    block = twin.read(np.empty(twin.shape, np.float32))
    assert block is not None
    noise = (block.frames - 16).reshape(100, -1)
    for frames in (noise[:1], noise[1:17], noise[:16], noise[16:32]):
        assert abs(np.corrcoef(frames.mean(axis=0), dark.ravel())[0, 1]) < 0.15
    # No frame has just the noise of the bright reference, but by chance.
    nearest = np.abs(noise - (bright.ravel() - 224)).min(axis=0)
    assert np.mean(nearest < 1e-3) < 0.2


def test_bright_follows_the_lamps() -> None:
    lamps = Body(asymmetry=0.4, asymmetry_azimuth=0.0)
    camera = Camera(np.dtype(np.float32), 0.0)
    shape, pixel = (36, 36), 0.9
    x, y = pixel_centres(shape, pixel)
    inside = np.hypot(x, y) < 15
    _, even = references(shape, pixel, camera=camera, optics="cylinder")
    _, uneven = references(shape, pixel, camera=camera, optics="cylinder", body=lamps)
    fraction = ((uneven - 16) / (even - 16))[inside]
    assert fraction.max() <= 1 + 1e-4
    assert fraction.min() > 0.6 / 1.4  # of the darkest side
    assert fraction[np.hypot(x, y)[inside] < 8].min() > 0.75  # what sees all sides has the brighter ones
    assert fraction.std() > 0.005
    # Mirrored lamps, mirrored references.
    turned = Body(asymmetry=0.4, asymmetry_azimuth=np.pi)
    _, mirrored = references(shape, pixel, camera=camera, optics="cylinder", body=turned)
    np.testing.assert_allclose(mirrored[inside], uneven[:, ::-1][inside], atol=0.5)
    assert np.abs(mirrored - uneven)[inside].max() > 1


def test_exact_references_are_within_what_a_sample_holds() -> None:
    camera = Camera(np.dtype(np.uint8), 0.0, gain_deviation=0.3, offset_deviation=20.0)
    dark, bright = references(camera=camera, references="exact")
    assert dark.min() == 0
    assert bright.max() == 255
    floats = Camera(np.dtype(np.float32), 0.0, gain_deviation=0.3, offset_deviation=20.0)
    for clipped, levels in zip((dark, bright), references(camera=floats, references="exact"), strict=True):
        np.testing.assert_array_equal(clipped, np.clip(levels, 0, 255))
        assert (clipped != levels).sum() > 20


def test_references_are_those_of_the_clear_wall(tmp_path: Path) -> None:
    # No more than a third of the light comes through.
    checks = np.kron(np.indices((4, 6)).sum(axis=0) % 2, np.ones((8, 8))) * 90
    picture = tmp_path / "checks.png"
    assert cv2.imwrite(str(picture), checks.astype(np.uint8))
    camera = Camera(np.dtype(np.float32), 0.0, gain_deviation=0.05)
    clear, exact = (
        references(camera=camera, optics="cylinder", references=name) for name in ("ball", "exact")
    )
    for optics, pattern in (("ideal", "linear"), ("cylinder", "linear"), ("cylinder", picture)):
        taken = references(camera=camera, optics=optics, pattern=pattern)
        for level_taken, level in zip(taken, exact, strict=True):
            np.testing.assert_allclose(level_taken, level, atol=0.02 * 208)
        if optics == "cylinder":
            np.testing.assert_array_equal(taken, clear)
