"""The visible texture of the sheet: unbounded, and moving with the skin to a fraction of a pixel."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from mirrorskin.io import InputError
from mirrorskin.twin import Axial, Body, Camera, Horizontal, SheetTexture, Sphere, Twin, Twist, Vertical
from mirrorskin.twin.movement import Movement
from mirrorskin.twin.texture import TEXTURES

SHAPE, PIXEL, DIFFUSE = (80, 90), 0.05, 0.25
DARK, SPAN = 16.0, 208.0
EACH = pytest.mark.parametrize("kind", TEXTURES)


def make_twin(movement: Movement, texture: SheetTexture | None, **changes: Any) -> Twin:
    camera = {"dtype": np.dtype(np.float32), "noise": 0.0}
    camera |= {name: changes.pop(name) for name in ("exposure", "distance", "noise") if name in changes}
    options: dict[str, Any] = {"object": Sphere(20.0), "shape": SHAPE, "pixel_size": PIXEL, **changes}
    return Twin(movement=movement, texture=texture, camera=Camera(**camera), **options)


def read_all(twin: Twin) -> NDArray[np.float32]:
    frames = np.empty(twin.shape, twin.dtype)
    assert twin.read(frames) is not None
    return frames


def grid(shape: tuple[int, int] = SHAPE, pixel: float = PIXEL) -> NDArray[np.float64]:
    row, column = np.indices(shape, dtype=float)
    return np.stack([column - (shape[1] - 1) / 2, (shape[0] - 1) / 2 - row]) * pixel


def reflectance_of_the_dark(frames: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return what the sheet reflects where the mirror shows no light."""
    return (frames.astype(np.float64) - DARK) / (SPAN * DIFFUSE)


@EACH
def test_a_texture_takes_its_contrast_and_has_no_end(kind: Any) -> None:
    texture = SheetTexture(kind, 0.2, contrast=0.4)
    near, far = (texture.reflectance(grid((200, 200)) + away) for away in (0.0, 1e4))
    for maps in (near, far):
        assert 0.6 - 1e-12 <= maps.min() < 0.65
        assert 0.95 < maps.max() <= 1 + 1e-12
    assert (near != SheetTexture(kind, 0.2, 0.4, seed=1).reflectance(grid((200, 200)))).any() == (
        kind != "dots"
    )


def test_flakes_have_the_stated_width() -> None:
    size, pixel = 0.3, 0.025
    reflectance = SheetTexture("flakes", size).reflectance(grid((600, 600), pixel))
    reflectance -= reflectance.mean()
    power = np.abs(np.fft.fft2(reflectance)) ** 2
    likeness = np.fft.ifft2(power).real[0, :40] / power.mean()
    width = 2 * pixel * np.interp(0.5, -likeness[:30] / likeness[0] + 1, np.arange(30))
    assert width == pytest.approx(size, rel=0.1)
    wavenumber = np.abs(np.fft.fftfreq(600, pixel))
    assert power[0, wavenumber > 3 / size].sum() < 1e-3 * power[0].sum()  # a band is all that there is


def test_dots_are_averaged_over_the_pixel() -> None:
    texture = SheetTexture("dots", 0.1)
    fine = texture.reflectance(grid((160, 160), 0.01))
    pixels = texture.reflectance(grid((40, 40), 0.04), (0.04, 0.04))
    np.testing.assert_allclose(pixels, fine.reshape(40, 4, 40, 4).mean(axis=(1, 3)), atol=0.02)


def test_dots_are_round_and_two_diameters_apart() -> None:
    size, pixel = 0.4, 0.01
    reflectance = SheetTexture("dots", size, contrast=1.0).reflectance(grid((160, 160), pixel))
    np.testing.assert_allclose(reflectance[:80], reflectance[80:], atol=1e-9)
    assert (reflectance < 0.5).sum() * pixel**2 == pytest.approx(4 * np.pi / 4 * size**2, rel=0.03)


@EACH
@pytest.mark.parametrize(
    "movement", [Horizontal([[0.0, 0.0], [0.13, 0.04], [0.2, 0.06]], 0.15), Twist([0.0, 0.4], 0.15)]
)
def test_the_texture_is_where_the_skin_has_gone(kind: Any, movement: Movement) -> None:
    texture = SheetTexture(kind, 0.4)
    twin = make_twin(movement, texture, contact="elastic", body=Body(friction=0.9))
    pictures = reflectance_of_the_dark(read_all(twin))
    moved = np.moveaxis(twin.truth.displacement, -1, 1)  # type: ignore[arg-type]
    assert np.abs(moved[-1]).max() > 1.5 * PIXEL
    rest = texture.reflectance(grid(), (PIXEL, PIXEL))
    for frame, shift in zip(pictures, moved, strict=True):
        at = grid() + shift
        index = np.stack([(SHAPE[0] - 1) / 2 - at[1] / PIXEL, at[0] / PIXEL + (SHAPE[1] - 1) / 2])
        target = map_coordinates(frame, index, order=5)
        inside = np.s_[8:-8, 8:-8]
        close = 4e-3 if kind == "flakes" else 0.02  # what interpolation leaves of the dots' rims
        np.testing.assert_allclose(target[inside], rest[inside], atol=close)
    np.testing.assert_allclose(pictures[0], rest, atol=1e-4)


def test_references_know_the_texture_of_a_sheet_at_rest() -> None:
    texture = SheetTexture("flakes", 0.2)
    press = Vertical([0.5, 1.5])
    plain, coated = make_twin(press, None, object="sphere"), make_twin(press, texture, object="sphere")
    dark, bright = coated.header.dark, coated.header.bright
    assert dark is not None
    assert bright is not None
    assert bright.std() > 10
    light = (read_all(coated) - dark) / (bright - dark)
    np.testing.assert_allclose(light, (read_all(plain) - DARK) / SPAN, atol=1e-5)


def test_the_zenith_s_scale_includes_the_texture() -> None:
    turn = Axial([0.0, 2.0, 4.0], 0.04, 1.0)
    plain, coated = (
        make_twin(turn, texture, pattern="linear", object="sphere", contact="elastic")
        for texture in (None, SheetTexture("random-dots", 0.3))
    )
    zenith = []
    for twin in (plain, coated):
        gain, offset = twin.header.zenith_gain, twin.header.zenith_offset
        assert gain is not None
        zenith.append((read_all(twin) - offset) / gain)
    np.testing.assert_allclose(zenith[0], zenith[1], atol=1e-5)


def test_a_pinhole_camera_sees_the_texture_of_the_point_that_it_sees() -> None:
    texture = SheetTexture("flakes", 0.4)
    low, high = (
        make_twin(Vertical([depth]), texture, object="plane", distance=60.0) for depth in (-1.0, 3.0)
    )
    assert np.abs(read_all(low)[0] - read_all(high)[0]).max() > 1
    view, sheet = high._view, high.sheet(0)
    at = np.stack([view.x + sheet.height * view.slope_x, view.y + sheet.height * view.slope_y])
    plain = (read_all(make_twin(Vertical([3.0]), None, object="plane", distance=60.0))[0] - DARK) / SPAN
    expected = texture.reflectance(at) * (0.75 * plain + 0.25)
    high.rewind()
    np.testing.assert_allclose((read_all(high)[0] - DARK) / SPAN, expected, atol=1e-5)


def test_a_moving_skin_is_blurred_over_the_exposure() -> None:
    texture = SheetTexture("flakes", 0.15, contrast=1.0)
    path = np.outer(np.linspace(0, 0.45, 31), [1.0, 0.0])
    rough: dict[str, Any] = {"contact": "elastic", "body": Body(friction=10.0)}
    fine = read_all(make_twin(Horizontal(path, 0.15), texture, **rough))
    blurred = read_all(make_twin(Horizontal(path[::10], 0.15), texture, exposure=1 / 30, **rough))
    assert np.abs(blurred[1] - fine[10]).max() > 4
    np.testing.assert_allclose(blurred[1], fine[6:15:2].mean(axis=0), atol=0.8)


def test_frames_are_the_same_in_any_order() -> None:
    movement = Horizontal([[0.0, 0.0], [0.1, 0.0], [0.0, 0.0]], 0.2)
    texture = SheetTexture("random-dots", 0.2)
    twin, other = (make_twin(movement, texture, contact="elastic", noise=1.0) for _ in range(2))
    frames = read_all(twin)
    other.skip(2)
    np.testing.assert_array_equal(read_all_left(other), frames[2:])
    # The body is back, and skin that has slipped is not.
    assert np.abs(frames[2] - frames[0]).max() > 9


def read_all_left(twin: Twin) -> NDArray[np.float32]:
    block = twin.read(np.empty(twin.shape, twin.dtype))
    assert block is not None
    frames: NDArray[np.float32] = block.frames
    return frames


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"kind": "stripes"}, "texture 'stripes' is unknown: take flakes, dots, random-dots"),
        ({"size": 0.0}, "size 0.0 of the texture.*mm, more than 0"),
        ({"size": np.inf}, "size inf of the texture"),
        ({"contrast": 0.0}, "contrast 0.0 of the texture"),
        ({"contrast": 1.1}, "contrast 1.1 of the texture"),
        ({"diffuse": -0.1}, "diffuse -0.1 of the texture"),
        ({"seed": -1}, "seed -1 of the texture"),
        ({"size": 0.09}, "a texture of 0.09 mm is too fine for pixels of 0.05 mm: use 2 pixels or more"),
    ],
)
def test_impossible_input_is_refused_in_one_line(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        make_twin(Vertical([1.0]), SheetTexture(**changes))
    assert "\n" not in str(caught.value)
