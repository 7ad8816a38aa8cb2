"""Standard deviations on hard surfaces are not worse than stored; camera and sheets are as formulas say.

``python -m mirrorskin.evaluation.faults.hard --freeze`` stores cells that became better, and the page.
"""

import numpy as np
import pytest

from mirrorskin.evaluation.faults.camera import (
    DARK,
    SENSORS,
    SPAN,
    Fault,
    centres,
    combined,
    points,
    record,
)
from mirrorskin.evaluation.faults.estimators import (
    PIXEL,
    RECORDINGS,
    STEEPEST,
    TILT,
    Surface,
    leaning,
    touched,
)
from mirrorskin.evaluation.faults.hard import fault_of, measure, measured, places, stored, with_tables
from mirrorskin.evaluation.faults.matrix import PAGE
from mirrorskin.evaluation.faults.objects import OBJECTS, SHAPE, SHEETS, smoothed, under_sheet

EXACT = Fault("", bits=12, electrons=1e9, read_noise=0.0)
COUNT = 0.6 / EXACT.scale / SPAN  # half a count as a share of full light, and the shot noise


def plane(along_x, along_y):
    def heights(x, y):
        height = along_x * x + along_y * y - 0.5
        return height, along_x + 0 * height, along_y + 0 * height

    return Surface.from_function("plane", heights, (8, 16), (0.2, 0.9))


def shares(light, positions, fault=EXACT):
    return (record(light, np.asarray(positions, float), fault, 1) / fault.scale - DARK) / SPAN


@pytest.mark.parametrize("along_x", [0.0, 0.3, 1.5])
def test_the_light_of_a_plane_is_the_touched_area_of_each_pixel(along_x):
    travel = np.arange(0.2, 0.9, 0.013)[:, np.newaxis, np.newaxis]
    surface = plane(along_x, 0.0)
    area = np.clip((travel + surface.height) / (along_x * PIXEL + 1e-9) + 0.5, 0, 1)
    np.testing.assert_allclose(shares(touched(surface), travel[:, 0, 0]), area, atol=COUNT)


def test_the_light_of_a_turn_is_the_angle_to_the_axis():
    surface, phase = plane(0.4, -0.7), np.arange(8) * np.pi / 4
    axis = np.stack([-np.sin(TILT) * np.cos(phase), -np.sin(TILT) * np.sin(phase)])
    cosine = (np.array([-0.4, 0.7]) @ axis + np.cos(TILT)) / np.sqrt(1 + 0.4**2 + 0.7**2)
    angle = np.arccos(cosine)[:, np.newaxis, np.newaxis] / STEEPEST
    np.testing.assert_allclose(
        shares(leaning(surface), phase), np.broadcast_to(angle, (8, 8, 16)), atol=COUNT
    )


def test_a_lens_keeps_the_light():
    x, y = points((16, 24), PIXEL)
    light = np.exp(-((x / 0.1) ** 2) - (y / 0.08) ** 2)[np.newaxis]
    sharp, blurred = (
        shares(lambda _: light, [0, 1], combined(EXACT, Fault("", blur=blur))) for blur in (0, 0.8)
    )
    assert blurred.max() < 0.8 * sharp.max()
    assert blurred.sum() == pytest.approx(sharp.sum(), rel=1e-3)


@pytest.mark.parametrize("sensor", SENSORS)
def test_the_noise_is_that_of_the_sensor(sensor):
    fault = SENSORS[sensor]
    frames = record(lambda _: np.full((1, 128, 128), 0.5), np.arange(200.0), fault, 1) / fault.scale
    step = 1 / fault.scale
    variance = 0.5 * SPAN / fault.electrons + fault.read_noise**2 + step**2 / 12
    assert frames.var(axis=0).mean() == pytest.approx(variance, rel=0.1)
    pattern = (fault.gain * 0.5 * SPAN) ** 2 + fault.dark_pattern**2
    middle = np.percentile(frames.mean(axis=0), [16, 84])
    assert np.ptp(middle) / 2 == pytest.approx(np.sqrt(pattern), rel=0.1)


def test_lag_and_waves_and_fading_change_the_light_as_stated():
    light = {0: 1.0, 1: 0.0, 2: 0.0}

    def flash(at):
        return np.full((1, 32, 32), light[int(np.ravel(at)[0])])

    lagging = shares(flash, [0, 1, 2], combined(EXACT, Fault("", lag=0.1)))
    np.testing.assert_allclose(lagging.mean(axis=(1, 2)), [1, 0.1, 0.01], atol=COUNT)
    steady = np.full((1, 32, 32), 0.5)
    fading = shares(lambda _: steady, np.arange(5.0), combined(EXACT, Fault("", fading=0.1)))
    np.testing.assert_allclose(fading.mean(axis=(1, 2)), 0.5 - 0.05 * np.arange(5) / 4, atol=COUNT)
    wave = shares(lambda _: steady, np.arange(16.0), combined(EXACT, Fault("", wave=0.1)))
    assert np.abs(np.fft.rfft(wave.mean(axis=(1, 2))))[1] / 8 == pytest.approx(0.05, rel=0.01)


def test_a_codec_changes_frames_by_about_its_quantum():
    def light(at):
        return np.broadcast_to(0.5 + 0.4 * np.sin(points((32, 32), PIXEL)[0] * 5 + at), (1, 128, 128))

    plain, coded = (record(light, np.arange(20.0) / 10, Fault("", codec=codec), 1) for codec in ("", "dct"))
    assert 0.8 < np.std(coded.astype(float) - plain) < 3


@pytest.mark.parametrize("sheet", SHEETS)
def test_a_sheet_flattens_waves_as_its_gaussian_does(sheet):
    length = 0.6
    surface = smoothed("", lambda x, y: 0.1 * np.sin(2 * np.pi * (0.8 * x + 0.6 * y) / length), sheet)
    x, y = centres(SHAPE, PIXEL)
    wave = 2 * np.pi / length
    gain = 0.1 * np.exp(-((wave * sheet * PIXEL) ** 2) / 2)
    along = wave * (0.8 * x + 0.6 * y)
    middle = np.s_[16:-16, 16:-16]
    height = surface.height - surface.height[middle].mean()
    true = gain * np.sin(along)
    np.testing.assert_allclose(height[middle], (true - true[middle].mean())[middle], atol=2e-5)
    for slope, part in zip(surface.true[1:], (0.8, 0.6), strict=True):
        np.testing.assert_allclose(slope[middle], (part * wave * gain * np.cos(along))[middle], atol=2e-3)


@pytest.mark.parametrize("name", OBJECTS)
def test_the_slopes_of_an_object_are_those_of_its_heights(name):
    surface = under_sheet(name, 2.0)
    along_y, along_x = np.gradient(surface.height, PIXEL)
    inner = np.s_[2:-2, 2:-2]
    for slope, numeric in zip(surface.true[1:], (along_x, -along_y), strict=True):
        assert np.corrcoef(slope[inner].ravel(), numeric[inner].ravel())[0, 1] > 0.998
        assert np.abs(slope[inner] - numeric[inner]).max() < 0.15 * np.abs(surface.true[1:]).max()


def test_objects_and_faults_meet_all_sheets_and_sensors():
    chosen = places(faults=["none", "blur 0.5 px", "blur 1.5 px", "saturation", "gamma 0.9", "flicker 2 %"])
    for name in OBJECTS:
        assert len({(place.sheet, place.sensor) for place in chosen if place.thing == name}) == 6
    assert len({(place.sheet, place.sensor) for place in chosen if place.fault == "none"}) == 6


def test_a_cell_is_measured_with_its_sensor_and_fault():
    (place,) = places(["dimples"], ["blur + gamma"], ["press50"], sensors=["scientific"], sheets=[2.0])
    fault = fault_of(place)
    assert (fault.bits, fault.blur, fault.gamma) == (12, 0.7, 0.95)
    outcome = measure(place)
    assert outcome.cell.kept > 0.9
    assert outcome.cell.error < 0.05


def test_heights_of_a_flat_field_have_standard_deviations():
    """A normal along the axis is a rounding error too long."""
    level = smoothed("coin", lambda x, y: OBJECTS["coin"](x, y) - 0.02 * x - 0.015 * y, 0.5)
    fault = combined(SENSORS["machine vision"], Fault("", flicker=0.02))
    assert np.isfinite(RECORDINGS["heights of two turns"](level, fault, 1).sigma).mean() > 0.9


def became_wrong(chosen):
    """Return the cells that lie and are not stored as such."""
    cells = stored()["cells"]
    return [
        str(outcome)
        for outcome in measured(chosen, processes=1)
        if outcome.cell.clearly_wrong
        and not cells[outcome.place.door][outcome.place.fault][outcome.place.thing].endswith("*")
    ]


def test_no_cell_of_some_became_wrong():
    assert became_wrong(places(["dimples", "coin"], ["none", "fading 3 %", "usual deviations"])) == []


def test_no_press_without_a_fault_has_a_warning():
    plain = measured(places(faults=["none"], doors=["press20", "change50"]), processes=1)
    assert [str(outcome) for outcome in plain if outcome.cell.warned] == []


@pytest.mark.slow
@pytest.mark.parametrize("door", ["press20", "change50", "heights"])
def test_no_cell_became_wrong(door):
    assert became_wrong(places(doors=[door])) == []


def test_the_page_shows_the_stored_cells():
    page = PAGE.read_text(encoding="utf-8")
    assert with_tables(page) == page, "write it: python -m mirrorskin.evaluation.faults.hard --freeze"
