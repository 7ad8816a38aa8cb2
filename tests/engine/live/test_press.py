"""Heights of a press in progress equal those found afterwards."""

import numpy as np
import pytest
from live_frames import PIXEL, paced, press_frames, press_header, turn_header

from mirrorskin.engine import Press
from mirrorskin.engine.live import LiveRun
from mirrorskin.evaluation.scenes.inputs import references
from mirrorskin.io import InputError

SHAPE = (30, 17, 23)
TRAVEL = np.sort(np.random.default_rng(3).uniform(0, 1.5, SHAPE[0]))


def test_the_map_grows_as_contact_spreads_and_nothing_writes_to_it_later():
    frames = press_frames(SHAPE)
    dark, bright = references(SHAPE[1:], np.dtype("uint8"))
    live = LiveRun(paced(frames, press_header(dark=dark, bright=bright), TRAVEL), Press())
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


def test_a_rotation_is_refused():
    with pytest.raises(InputError, match="vertical"):
        LiveRun(paced(press_frames(SHAPE), turn_header(), TRAVEL), Press())
