"""Heights of a press in progress equal those found afterwards."""

import numpy as np
import pytest
from live_frames import PIXEL, paced, press_frames, press_header, turn_header
from suite.scenes import references

from mirrorskin import engine
from mirrorskin.engine import Press, find_onset
from mirrorskin.engine.live import LiveRun, Loop
from mirrorskin.io import InputError
from mirrorskin.twin.emulator.simulated_clock import SimulatedClock

SHAPE = (30, 17, 23)
TRAVEL = np.sort(np.random.default_rng(3).uniform(0, 1.5, SHAPE[0]))


def make(dtype="uint8", device=None, **options):
    frames = press_frames(SHAPE, dtype)
    dark, bright = references(SHAPE[1:], np.dtype(dtype))
    header = press_header(dark=dark, bright=bright)
    return frames, LiveRun(paced(frames, header, TRAVEL), Press(device=device, **options))


@pytest.mark.parametrize("dtype", ["uint8", "float32"])
def test_heights_are_bit_by_bit_those_of_the_same_frames_offline(device, dtype):
    frames, live = make(dtype, device, fill=False)
    live.precompile()
    for part in np.split(np.arange(SHAPE[0]), np.cumsum([1, 1, 3, 2, 11, 1, 1])):
        live.push(frames[part], travel=TRAVEL[part])
        live.maps()
    dark, bright = references(SHAPE[1:], np.dtype(dtype))
    result, exact = live.result(), find_onset(frames, TRAVEL, dark=dark, bright=bright, device=device)
    assert (exact.status == 1).sum() > 50
    np.testing.assert_array_equal(result.height, exact.height)
    np.testing.assert_array_equal(result.height_sigma, exact.height_sigma)
    np.testing.assert_array_equal(result.status, exact.status)
    assert result.process["noise"] == exact.process["noise"]


def test_the_map_grows_as_contact_spreads_and_nothing_writes_to_it_later():
    frames, live = make()
    areas, kept = [], []
    for number in range(SHAPE[0]):
        live.push(frames[number : number + 1], travel=TRAVEL[number : number + 1])
        maps = live.maps()
        assert bool(maps) == (number > 0)
        if maps:
            finite = np.isfinite(maps["height"])
            assert not np.any(finite & (maps["contact"] == 0))
            assert maps["contact_area"] == pytest.approx(maps["contact"].sum() * PIXEL**2)
            areas.append(maps["contact_area"])
            kept.append((maps["height"], maps["height"].copy()))
    assert areas[-1] > areas[2] >= 0
    assert np.all(np.diff(areas) >= -(PIXEL**2) * 3)
    for now, then in kept:
        np.testing.assert_array_equal(now, then)


def test_holes_are_filled_in_the_result_which_stores_its_provenance():
    frames, live = make()
    live.push(frames, travel=TRAVEL)
    result = live.result()
    assert result.filled is not None
    assert result.process["fill"] == "holes"
    assert result.process["source"] == "memory"
    assert result.process["live"] is True
    assert result.x is not None


def test_a_whole_run_uses_each_frame():
    frames = press_frames(SHAPE)
    dark, bright = references(SHAPE[1:], np.dtype("uint8"))
    source = paced(frames, press_header(dark=dark, bright=bright), TRAVEL, 1000.0, SimulatedClock())
    live = LiveRun(source, Press(fill=False))
    assert Loop(source, live).run().used == SHAPE[0]
    expected = engine.run(frames, engine.Onset(dark=dark, bright=bright), travel=TRAVEL)
    np.testing.assert_array_equal(live.result().height, expected.height)


def test_a_single_frame_has_no_result():
    frames, live = make()
    live.push(frames[:1], travel=TRAVEL[:1])
    with pytest.raises(InputError, match="at least 2"):
        live.result()


def test_a_rotation_is_refused():
    with pytest.raises(InputError, match="vertical"):
        LiveRun(paced(press_frames(SHAPE), turn_header(), TRAVEL), Press())
