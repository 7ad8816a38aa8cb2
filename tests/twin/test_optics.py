"""The picture in the mirror: patterns, ideal optics and the traced wall, calculated by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from mirrorskin.io.base.types import Floats, InputError
from mirrorskin.kernels.device import Device
from mirrorskin.twin.body import Body
from mirrorskin.twin.optics import (
    Ideal,
    Wall,
    design_range,
    scatter_rays,
    visible_zenith,
)
from mirrorskin.twin.pattern import Linear, Pattern, Picture, Uniform, linear_pattern, make_pattern
from mirrorskin.twin.skin import Sheet
from mirrorskin.twin.view import View

BODY = Body()
LINEAR = linear_pattern(BODY)
RIM, HORIZON = np.arctan2(17.5, 40) / 2, np.pi / 4


def mirrors(zenith: Floats, azimuth: Floats, height: float = 0.0) -> Sheet:
    """A sheet of one row that leans at each pixel as told."""
    slope = -np.tan(zenith)[np.newaxis]
    level = np.full(slope.shape, height)
    return Sheet(level, slope * np.cos(azimuth), slope * np.sin(azimuth), np.ones(slope.shape, bool))


def look_from(
    place: tuple[float, float], sheet: Sheet, body: Body, pattern: Pattern, device: Device
) -> Floats:
    """What is seen in each mirror of a row, all of them at one place: that of a corner of 2 x 2 pixels."""
    shape, pixel = (2, 2), (2 * abs(place[0]) or 1e-9, 2 * abs(place[1]) or 1e-9)
    wall = Wall(body, pattern, View(shape, pixel, body, np.inf), device)
    corner = int(place[1] < 0), int(place[0] >= 0)
    light = []
    for z, dz_dx, dz_dy in zip(sheet.height[0], sheet.dz_dx[0], sheet.dz_dy[0], strict=True):
        maps = (np.full(shape, value) for value in (z, dz_dx, dz_dy))
        light.append(wall.light(Sheet(*maps, np.ones(shape, bool)))[corner])
    return np.array(light, np.float64)


def boxed(response: Floats, zenith: Floats, half_width: float) -> Floats:
    """The mean of a response, told at evenly spaced zeniths, over a box: by adding up."""
    total = np.concatenate([[0], np.cumsum((response[1:] + response[:-1]) / 2)]) * (zenith[1] - zenith[0])
    mean = np.interp(zenith + half_width, zenith, total) - np.interp(zenith - half_width, zenith, total)
    return mean / (2 * half_width)


# Patterns


def test_a_picture_is_shared_out_over_the_wall() -> None:
    picture = np.array([[0, 51, 102], [153, 204, 255]], np.uint8)
    table = Picture(picture).table(BODY)
    np.testing.assert_allclose(table[1:-1, 1:-1], picture / 255.0, rtol=1e-6)
    np.testing.assert_array_equal(table[:, 0], table[:, -2])
    np.testing.assert_array_equal(table[:, -1], table[:, 1])
    np.testing.assert_array_equal(table[0], table[1])
    np.testing.assert_array_equal(table[-1], table[-2])


@pytest.mark.parametrize(
    ("values", "problem"),
    [
        (np.zeros((2, 2, 3)), "rows and columns"),
        (np.zeros((0, 4)), "rows and columns"),
        (np.array([[0, 1]]), "int64"),
        (np.array([[0.5, 1.01]]), "is 0 to 1"),
        (np.array([[0.5, np.nan]]), "is 0 to 1"),
    ],
)
def test_what_is_not_a_picture_is_refused(values: np.ndarray, problem: str) -> None:
    with pytest.raises(InputError, match=problem):
        Picture(values)


def test_the_linear_pattern_is_linear_in_the_zenith_that_shows_it() -> None:
    rows = LINEAR.table(BODY)[:, 1].astype(float)
    height = 40 * (1 - (np.arange(256) + 0.5) / 256)
    shown_by = np.arctan2(17.5, height) / 2
    np.testing.assert_allclose(rows[1:-1], (shown_by - RIM) / (HORIZON - RIM), atol=1e-6)
    np.testing.assert_allclose([rows[:2].mean(), rows[-2:].mean()], [0, 1], atol=1e-6)
    assert LINEAR.offset + LINEAR.gain * RIM == pytest.approx(0, abs=1e-12)
    assert LINEAR.offset + LINEAR.gain * HORIZON == pytest.approx(1)


@pytest.mark.parametrize(("lower", "upper"), [(0.5, 0.5), (-0.1, 0.5), (np.nan, 1.0)])
def test_a_linear_pattern_must_rise(lower: float, upper: float) -> None:
    with pytest.raises(InputError, match="lower one first"):
        Linear(lower, upper)


def test_patterns_have_names() -> None:
    assert make_pattern("uniform", BODY) == Uniform()
    linear = make_pattern("linear", BODY)
    assert isinstance(linear, Linear)
    assert (linear.lower, linear.upper) == pytest.approx((RIM, HORIZON))


def test_a_pattern_can_be_a_file(tmp_path: Path) -> None:
    picture = np.arange(12, dtype=np.uint16).reshape(3, 4) * 5000
    for name in ("wall.png", "wall.tif"):
        assert cv2.imwrite(str(tmp_path / name), picture)
        pattern = make_pattern(tmp_path / name, BODY)
        assert isinstance(pattern, Picture)
        np.testing.assert_allclose(pattern.values, picture / 65535)


def test_a_pattern_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"missing\.png"):
        make_pattern(tmp_path / "missing.png", BODY)
    (tmp_path / "broken.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match=r"broken\.png"):
        make_pattern(str(tmp_path / "broken.png"), BODY)


# Ideal optics


@pytest.mark.parametrize("scatter", [1.0, 10.0])
def test_the_ideal_light_is_the_walls_mean_over_the_scatter(scatter: float) -> None:
    body = Body(scatter=np.radians(scatter))
    zenith = np.linspace(-0.3, 1.2, 300_001)
    window = ((zenith >= RIM) & (zenith <= HORIZON)).astype(float)
    ramp = np.clip((zenith - RIM) / (HORIZON - RIM), 0, 1)
    asked = zenith[(zenith >= 0) & (zenith < 1)][::1000]
    for pattern, response in ((Uniform(), window), (LINEAR, ramp)):
        expected = np.interp(asked, zenith, boxed(response, zenith, body.scatter / 2))
        light = Ideal(body, pattern).light(mirrors(asked, asked * 7))
        assert light.dtype == np.float32
        np.testing.assert_allclose(light[0], expected, atol=4e-4)


def test_the_ideal_light_is_exactly_linear_over_the_design_range() -> None:
    ideal = Ideal(BODY, LINEAR)
    lower, upper = design_range(BODY)
    assert np.degrees([lower, upper]) == pytest.approx([13.3147, 43.5], abs=1e-4)
    zenith = np.linspace(lower, upper, 101)
    np.testing.assert_allclose(ideal.response(zenith), LINEAR.offset + LINEAR.gain * zenith, atol=1e-12)
    beyond = np.array([lower - 0.01, upper + 0.01])
    assert (np.abs(ideal.response(beyond) - LINEAR.offset - LINEAR.gain * beyond) > 1e-3).all()


@pytest.mark.parametrize(
    ("body", "pattern", "problem"),
    [
        (BODY, Picture(np.eye(3)), "a picture"),
        (Body(air_gap=0.1), Uniform(), "an air gap"),
        (Body(asymmetry=0.1), LINEAR, "lamps"),
    ],
)
def test_what_is_not_a_function_of_zenith_is_not_ideal(body: Body, pattern: Pattern, problem: str) -> None:
    with pytest.raises(InputError, match=f"{problem}.*use the optics 'cylinder'"):
        Ideal(body, pattern)


# Scatter


def test_every_cut_through_the_scatter_is_a_box() -> None:
    rays = scatter_rays(BODY.scatter)
    np.testing.assert_allclose((rays**2).sum(axis=1), 1)
    off = np.arccos(rays[:, 0])
    assert off.max() < BODY.scatter
    turned = rays[:, 1:] * (off / np.sin(off))[:, np.newaxis]
    even = (np.arange(len(rays)) + 0.5) / len(rays) * 2 - 1
    for turn in np.linspace(0, np.pi, 37):
        places = np.sort(turned @ [np.cos(turn), np.sin(turn)]) / BODY.scatter
        assert np.abs(places - even).max() < 0.06


def exact_light(zenith: float, azimuth: float, place: tuple[float, float]) -> float:
    """The share of the scattered rays that meet the paper's wall: of 40 000, for points all over a sphere."""
    cosine = (np.arange(200) + 0.5) / 100 - 1
    turn = (np.arange(200) + 0.5) * (2 * np.pi / 200)
    u = BODY.scatter * np.repeat(cosine, 200)
    v = BODY.scatter * np.outer(np.sqrt(1 - cosine**2), np.cos(turn)).ravel()
    lean, off = 2 * zenith, np.hypot(u, v)
    along = np.array([np.sin(lean) * np.cos(azimuth), np.sin(lean) * np.sin(azimuth), np.cos(lean)])
    down = np.array([np.cos(lean) * np.cos(azimuth), np.cos(lean) * np.sin(azimuth), -np.sin(lean)])
    aside = np.array([-np.sin(azimuth), np.cos(azimuth), 0])
    turned = np.sin(off) / off * (np.outer(down, u) + np.outer(aside, v))
    x, y, z = np.cos(off) * along[:, np.newaxis] + turned
    a, b = x * x + y * y, place[0] * x + place[1] * y
    height = z * (-b + np.sqrt(b * b - a * (place[0] ** 2 + place[1] ** 2 - 17.5**2))) / a
    return float(((height >= 0) & (height <= 40)).mean())


@pytest.mark.parametrize(("place", "azimuth"), [((0, 0), 0.3), ((0, 10), -1.2), ((-6, 8), 0.5)])
def test_the_walls_edges_have_no_visible_steps(
    device: Device, place: tuple[float, float], azimuth: float
) -> None:
    lower, upper = visible_zenith(BODY, *place, azimuth)
    for edge in (float(lower), float(upper)):
        zenith = edge + np.radians(np.linspace(-2.1, 2.1, 15))
        light = look_from(place, mirrors(zenith, np.full(15, azimuth)), BODY, Uniform(), device)
        expected = np.array([exact_light(t, azimuth, place) for t in zenith])
        assert expected.min() < 0.05
        assert expected.max() > 0.95
        assert np.abs(light - expected).max() < 0.006


# The wall


def test_the_wall_from_the_centre_is_nearly_ideal(device: Device) -> None:
    zenith = np.radians(np.linspace(0, 50, 101))
    for pattern in (Uniform(), LINEAR):
        ideal = Ideal(BODY, pattern).light(mirrors(zenith, zenith))[0]
        traced = look_from((0, 0), mirrors(zenith, zenith * 50), BODY, pattern, device)
        below = zenith < design_range(BODY)[1] if pattern is LINEAR else slice(None)
        # The plane of incidence is one cut of many: the others see a rim that is curved.
        assert np.abs(traced - ideal)[below].max() < 0.018


@pytest.mark.parametrize("gap", [0.0, 1.0])
def test_mirrors_show_the_wall_from_the_visible_zenith_on(device: Device, gap: float) -> None:
    body = Body(scatter=0.0, air_gap=gap)
    for place in ((0, 0), (-4, 7), (0, -15)):
        azimuth = np.linspace(-np.pi, np.pi, 8, endpoint=False)
        lower, upper = visible_zenith(body, *place, azimuth)
        margin = np.radians(0.01)
        for zenith, visible in (
            (lower - margin, 0),
            (lower + margin, 1),
            (upper - margin, 1),
            (upper + margin, 0),
        ):
            expected = ~np.isnan(zenith)
            light = look_from(place, mirrors(zenith[expected], azimuth[expected]), body, Uniform(), device)
            np.testing.assert_array_equal(light > 0, visible)
        hidden = np.isnan(lower)
        assert hidden.any() == (gap > 0 and np.hypot(*place) > 17.5 / 1.41)
        for zenith in np.radians([15.0, 40.0]):
            calls = mirrors(np.full(hidden.sum(), zenith), azimuth[hidden])
            if hidden.any():
                assert not look_from(place, calls, body, Uniform(), device).any()


@pytest.mark.parametrize("distance", [np.inf, 60.0])
def test_an_oblique_view_of_the_flat_sheet_shows_the_wall_beyond(device: Device, distance: float) -> None:
    # Seen from a near pinhole, the mirrored ray leans outwards as much as the line of sight leans inwards.
    shape, pixel = (1, 29), (1.0, 1.0)
    body = Body(scatter=0.0)
    view = View(shape, pixel, body, distance)
    light = Wall(body, Uniform(), view, device).light(Sheet(*np.zeros((3, *shape)), np.zeros(shape, bool)))
    reaches = np.abs(view.x) + 40 * np.abs(view.slope_x) > 17.5
    assert reaches.any() == (distance == 60)
    np.testing.assert_array_equal(light > 0, reaches)


def test_the_pattern_counts_where_the_ray_meets_it(device: Device) -> None:
    # Clear on the right half, opaque on the left: only mirrors that face right are light.
    halves = Picture(np.array([[0, 0, 0, 255, 255, 255, 255, 255, 255, 0, 0, 0]], np.uint8))
    azimuth = np.radians([0, 60, -60, 120, -120, 180])
    light = look_from((0, 0), mirrors(np.radians(np.full(6, 30)), azimuth), BODY, halves, device)
    np.testing.assert_allclose(light, [1, 1, 1, 0, 0, 0], atol=1e-5)
    # The top row of a picture is the wall's upper edge, which the least zenith shows.
    upper = Picture(np.array([[255], [255], [0], [0]], np.uint8))
    light = look_from((0, 0), mirrors(np.radians([15, 35]), np.zeros(2)), BODY, upper, device)
    np.testing.assert_allclose(light, [1, 0], atol=1e-5)


def test_lamps_and_gap_reach_the_kernel(device: Device) -> None:
    sheet = mirrors(np.radians(np.full(2, 35)), np.array([0.5, 0.5 + np.pi]))
    even = look_from((0, 0), sheet, BODY, Uniform(), device)
    uneven = look_from((0, 0), sheet, replace(BODY, asymmetry=0.5, asymmetry_azimuth=0.5), Uniform(), device)
    np.testing.assert_allclose(even, 1)
    np.testing.assert_allclose(uneven, [1, 0.5 / 1.5], atol=2e-3)
    behind = look_from((0, 0), sheet, replace(BODY, air_gap=1.0), Uniform(), device)
    assert (behind > 0.9).all()
    assert (behind < 0.98).all()
