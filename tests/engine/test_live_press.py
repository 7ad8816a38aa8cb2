"""A press that is told while it goes on is the one that is told afterwards."""

import numpy as np
import pytest
from live_frames import PIXEL, Clock, blocks, paced, press_frames, press_header, turn_header

from mirrorskin.bench.stacks import references
from mirrorskin.engine import find_onset
from mirrorskin.engine.live import LivePress, run
from mirrorskin.io import InputError

SHAPE = (30, 17, 23)
TRAVEL = np.sort(np.random.default_rng(3).uniform(0, 1.5, SHAPE[0]))


def make(dtype="uint8", device=None, **options):
    frames = press_frames(SHAPE, dtype)
    dark, bright = references(SHAPE[1:], np.dtype(dtype))
    header = press_header(dark=dark, bright=bright)
    return frames, LivePress(paced(frames, header, TRAVEL), device=device, **options)


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
def test_onset_is_bit_by_bit_that_of_the_same_frames_offline(device, dtype):
    frames, live = make(dtype, device, fill=False)
    live.warm()
    for block in blocks(frames, [1, 1, 3, 2, 11, 1, 1, 10], travel=TRAVEL):
        live.push(block)
        live.update()
    dark, bright = references(SHAPE[1:], np.dtype(dtype))
    found, exact = live.result(), find_onset(frames, TRAVEL, dark=dark, bright=bright, device=device)
    assert (exact.status == 1).sum() > 50
    for one, other in ((found.height, exact.height), (found.height_sigma, exact.sigma)):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(found.status, exact.status)
    assert found.process["noise"] == exact.noise


def test_the_map_grows_as_contact_spreads():
    frames, live = make()
    areas = []
    for block in blocks(frames, [1] * SHAPE[0], travel=TRAVEL):
        live.push(block)
        update = live.update()
        assert (update.height is None) == (update.frames < 2)
        assert update.position == block.travel[0]
        assert update.time == block.time[0]
        np.testing.assert_array_equal(update.picture, block.frames[0])
        if update.height is not None:
            known = np.isfinite(update.height)
            assert not np.any(known & (update.contact == 0))
            assert update.contact_area == pytest.approx(update.contact.sum() * PIXEL**2)
            areas.append(update.contact_area)
    assert areas[-1] > areas[2] >= 0
    assert np.all(np.diff(areas) >= -(PIXEL**2) * 3)


def test_updates_are_the_receivers_own():
    frames, live = make()
    first, second = blocks(frames, [15, 15], travel=TRAVEL)
    live.push(first)
    update = live.update()
    kept = update.height.copy(), update.picture.copy()
    live.push(second)
    live.update()
    frames[:] = 0
    np.testing.assert_array_equal(update.height, kept[0])
    np.testing.assert_array_equal(update.picture, kept[1])


def test_holes_are_filled_in_the_result_and_it_says_how_it_came_about():
    frames, live = make()
    for block in blocks(frames, [30], travel=TRAVEL):
        live.push(block)
    result = live.result()
    assert result.filled is not None
    assert result.process["fill"] == "holes"
    assert result.process["source"] == "memory"
    assert result.process["live"] is True
    assert result.x is not None


def test_a_whole_run_uses_each_frame():
    frames = press_frames(SHAPE)
    clock = Clock()
    source = paced(frames, press_header(), TRAVEL, 1000.0, clock)
    live = LivePress(source, fill=False)
    status = run(source, live)
    assert status.used == SHAPE[0]
    np.testing.assert_array_equal(live.result().height, find_onset(frames, TRAVEL).height)


def test_a_single_frame_has_no_result():
    frames, live = make()
    live.push(blocks(frames[:1], [1], travel=TRAVEL)[0])
    with pytest.raises(InputError, match="at least 2"):
        live.result()


def test_a_rotation_is_refused():
    with pytest.raises(InputError, match="vertical"):
        LivePress(paced(press_frames(SHAPE), turn_header(), TRAVEL))
