"""Displacement and slip of a slide in progress equal those found afterwards."""

import numpy as np
import pytest
from speckle import Speckle
from stacks import MadeUp

from mirrorskin.engine import Slide
from mirrorskin.engine.live import LiveRun, Loop
from mirrorskin.io import Block, Header, InputError

SHAPE, PIXEL, COUNT = (64, 72), 0.05, 8
PLACES = np.arange(COUNT)[:, None] * [0.02, 0.01]  # mm; the skin sticks, and stays behind
FRAMES = np.stack([Speckle(3).frame(SHAPE, -x / PIXEL, y / PIXEL, 1.0, k) for k, (x, y) in enumerate(PLACES)])
CONTACT = np.ones(SHAPE)
BLOCK = Block(FRAMES, 0, displacement=PLACES)


def source(motion="horizontal", **changes):
    fields = {"pixel_size": (PIXEL, PIXEL)} | changes
    return MadeUp(FRAMES, Header(motion, **fields), displacement=PLACES, time=0.01 * np.arange(COUNT))


class Timed(MadeUp):
    """A source whose frames are never late."""

    def now(self):
        return 0.01 * self.frames_read


def test_the_displacement_of_the_newest_frame_is_shown_from_the_second_on():
    live = LiveRun(source(), Slide(contact=CONTACT))
    for number in range(COUNT):
        live.push_block(BLOCK, slice(number, number + 1))
        maps = live.maps()
        assert bool(maps) == (number > 0)
        if maps:
            middle = maps["displacement"][16:48, 16:56]
            np.testing.assert_allclose(middle, np.broadcast_to(-PLACES[number], middle.shape), atol=0.005)


def test_a_whole_run_shows_how_far_the_body_has_come():
    recording = source()
    timed = Timed(FRAMES, recording.header, displacement=PLACES, time=0.01 * np.arange(COUNT))
    updates = []
    live = LiveRun(timed, Slide(contact=CONTACT))
    status = Loop(timed, live, updates=1e6, on_update=lambda update, _: updates.append(update)).run()
    assert status.used == COUNT
    assert updates[-1].position == pytest.approx(np.hypot(0.14, 0.07))
    assert updates[-1].displacement is not None


@pytest.mark.parametrize(
    ("recording", "message"),
    [(source("vertical"), "Slide needs horizontal or twist"), (source(pixel_size=None), "pixel size")],
)
def test_what_shows_no_slip_is_refused(recording, message):
    with pytest.raises(InputError, match=message):
        LiveRun(recording, Slide())
