"""Trackers and events of live loops: answers for each frame, contact that is lost and found, and limits."""

import asyncio
import math

import cv2
import numpy as np
import pyopencl as cl
import pytest
from live_frames import paced, turn_header

from mirrorskin import engine, io
from mirrorskin.cli.commands.bench.scenes import FIELD, moving_domes, round_contact, sliding_texture
from mirrorskin.engine.live import SHOWN, Frames, Limit, LiveRun, Loop, Stream
from mirrorskin.kernels.device import open_device
from mirrorskin.twin.emulator.simulated_clock import SimulatedClock

COUNT, RATE = 40, 100.0
NUMBERS = np.arange(COUNT, dtype=np.uint8)[:, np.newaxis, np.newaxis] * np.ones((2, 3), np.uint8)
SHAPE, PIXEL = (80, 96), 0.05


class Slow:
    """A tracker of frames that takes a time of its own."""

    takes = ("picture",)

    def __init__(self, clock=None, seconds=0.0):
        self.clock, self.seconds = clock, seconds
        self.frames, self.compiled = [], []

    def precompile(self, shape, dtype):
        assert not self.frames
        self.compiled.append((shape, dtype))

    def push(self, frame):
        self.frames.append(int(frame[0, 0]))
        if self.clock is not None:
            self.clock.sleep(self.seconds)
        return self.frames[-1]


def run(seconds, latency, **options):
    """Run a loop of 40 frames at 100 Hz; return its slow tracker, the updates and the status."""
    clock, updates = SimulatedClock(), []
    source = paced(NUMBERS, turn_header(), np.zeros(COUNT), RATE, clock)
    slow = Slow(clock, seconds)
    loop = Loop(
        source,
        LiveRun(source, Frames()),
        latency=latency,
        trackers={"number": slow},
        on_update=lambda update, status: updates.append(update),
        **options,
    )
    return slow, updates, loop.run()


def test_each_frame_has_an_update_with_the_answer_for_it_and_the_time_of_its_exposure():
    _, updates, _ = run(0.001, math.inf)
    assert [update.tracked["number"] for update in updates] == list(range(COUNT))
    np.testing.assert_allclose([update.time for update in updates], np.arange(COUNT) / RATE)
    np.testing.assert_allclose([update.latency for update in updates], 0.001)


def test_with_an_infinite_latency_a_slow_tracker_gets_all_frames_one_by_one():
    slow, _, status = run(0.025, math.inf)
    assert slow.frames == list(range(COUNT))
    assert (status.skipped, status.updates) == (0, COUNT)


def test_with_a_latency_of_0_a_slow_tracker_gets_the_newest_frames_only():
    slow, updates, status = run(0.025, 0.0)
    assert status.used + status.skipped == COUNT
    assert status.used == len(slow.frames) < COUNT / 2
    assert slow.frames[-1] == COUNT - 1
    assert max(update.latency for update in updates) < 0.025 + 1 / RATE


def test_a_latency_bounds_the_age_of_the_frames_that_a_slow_tracker_gets():
    _, updates, status = run(0.025, 0.05)
    assert status.skipped > 0
    assert max(update.latency for update in updates) <= 0.05 + 0.025 + 1e-9


def test_updates_can_be_limited():
    slow, updates, status = run(0.0, math.inf, updates=10.0)
    assert status.used == COUNT
    assert len(slow.frames) == len(updates) == pytest.approx(COUNT / RATE * 10, abs=2)


def test_an_update_has_the_99th_percentile_of_latencies():
    _, updates, status = run(0.025, math.inf)
    assert updates[-1].latency_p99 == pytest.approx(status.latency[SHOWN].p99, rel=0.3)
    assert status.latency[SHOWN].p99 == pytest.approx(np.percentile([each.latency for each in updates], 99))


def stream(trackers, operation=None, shape=(2, 3), **options):
    return Stream(operation or Frames(), shape, latency=math.inf, trackers=trackers, **options)


def test_trackers_are_compiled_before_the_first_frame():
    slow = Slow()
    with stream({"number": slow}) as pushed:
        assert slow.compiled == [((2, 3), np.uint8)]
        pushed.push(NUMBERS[3])
    assert slow.frames == [3]


def test_a_function_gets_the_answers_of_the_trackers_before_it():
    with stream({"number": Slow(), "double": lambda update: 2 * update.tracked["number"]}) as pushed:
        pushed.push(NUMBERS[3])
        pushed.result()
        assert pushed.latest().tracked == {"number": 3, "double": 6}


class Deferred:
    """A tracker that notes when it starts and when its answer is taken."""

    takes = ("picture",)

    def __init__(self, name, notes, refused=None):
        self.name, self.notes, self.refused = name, notes, refused

    def push(self, frame):
        return self.submit(frame)()

    def submit(self, frame):
        self.notes.append(f"{self.name} starts")
        self._refuse("starts")

        def answer():
            self.notes.append(f"{self.name} answers")
            self._refuse("answers")
            return self.name

        return answer

    def _refuse(self, when):
        if when == self.refused:
            raise io.InputError(f"{self.name} refused")


def test_all_trackers_start_before_the_first_answer_is_waited_for():
    notes = []
    function = {"last": lambda update: notes.append(f"last after {[*update.tracked]}")}
    with stream({"a": Deferred("a", notes), "b": Deferred("b", notes), **function}) as pushed:
        pushed.push(NUMBERS[0])
    assert notes == ["a starts", "b starts", "a answers", "b answers", "last after ['a', 'b']"]


def test_a_tracker_that_has_answered_starts_with_a_frame_that_waits():
    notes = []
    function = {"last": lambda update: notes.append(f"last of {update.frames}")}
    with stream({"a": Deferred("a", notes), "b": Deferred("b", notes), **function}) as pushed:
        pushed.push(NUMBERS[:2])
    first = ["a starts", "b starts", "a answers", "a starts", "b answers", "b starts", "last of 1"]
    assert notes == [*first, "a answers", "b answers", "last of 2"]


def test_a_tracker_that_is_replaced_does_not_answer_for_a_frame_that_waits():
    notes, answers = [], []
    trackers = {"a": Deferred("a", notes)}

    def replace(update, status):
        answers.append(update.tracked["a"])
        trackers["a"] = Deferred("b", notes)

    with stream(trackers, on_update=replace) as pushed:
        pushed.push(NUMBERS[:2])
    assert answers == ["a", "b"]


def test_a_frame_that_is_refused_loses_no_answer_for_the_one_before():
    class Refusing(Frames):
        def push(self, frames):
            if frames[-1].any():
                raise io.InputError("refused")
            super().push(frames)

    answers = []
    pushed = stream(
        {"a": Deferred("a", []), "b": Deferred("b", [])},
        Refusing(),
        on_update=lambda update, status: answers.append(update.tracked),
    )
    pushed.push(NUMBERS[:2])
    with pytest.raises(io.InputError, match="refused"):
        pushed.close()
    assert answers == [{"a": "a", "b": "b"}]


@pytest.mark.parametrize("when", ["starts", "answers"])
def test_the_refusal_of_one_tracker_leaves_the_answers_of_the_others(when):
    notes = []
    with stream({"a": Deferred("a", notes, when), "b": Deferred("b", notes)}) as pushed:
        pushed.push(NUMBERS[0])
        pushed.result()
        update = pushed.latest()
    assert (update.tracked, update.lost) == ({"a": None, "b": "b"}, {"a": "a refused"})


def test_an_error_in_the_answer_of_a_tracker_ends_the_stream():
    notes = []
    failing = Deferred("a", notes)
    failing.submit = lambda frame: lambda: 1 / 0
    pushed = stream({"a": failing, "b": Deferred("b", notes)})
    pushed.push(NUMBERS[:2])
    with pytest.raises(ZeroDivisionError):
        pushed.close()
    assert notes == ["b starts"]


def test_pose_and_slip_together_answer_as_each_alone():
    maps, frames = moving_domes((60, 80))[:4], sliding_texture((60, 80))[:4]
    contact = round_contact((60, 80))

    class Domes(engine.Operation):
        motions = ("vertical",)
        updates_per_second = math.inf

        def push(self, frames, *, travel):
            self.number = int(travel[-1])

        def result(self):
            return {}

        def preview(self, seconds):
            return maps[self.number]

    def trackers():
        return {
            "pose": engine.pose.PoseTracker(),
            "slip": engine.slip.SlipTracker(contact, FIELD / 80),
        }

    updates = []
    with stream(
        trackers(), Domes(), (60, 80), on_update=lambda update, status: updates.append(update)
    ) as pushed:
        for number, frame in enumerate(frames):
            pushed.push(frame, travel=number)
    pose, slip = trackers().values()
    for update, result, frame in zip(updates, maps, frames, strict=True):
        np.testing.assert_array_equal(update.tracked["pose"].translation, pose.push(result).translation)
        np.testing.assert_array_equal(update.tracked["slip"].displacement, slip.push(frame).displacement)


def test_trackers_do_not_wait_for_earlier_work_of_the_device():
    device, gate = open_device(), cl.UserEvent(open_device().context)
    blocked = cl.enqueue_marker(device.queue, wait_for=[gate])
    try:
        pose = engine.pose.PoseTracker(device=device)
        for result in moving_domes((60, 80))[:3]:
            pose.push(result)
        slip = engine.slip.SlipTracker(round_contact((60, 80)), FIELD / 80, device=device)
        for frame in sliding_texture((60, 80))[:3]:
            slip.push(frame)
        assert blocked.command_execution_status != cl.command_execution_status.COMPLETE
    finally:
        gate.set_status(cl.command_execution_status.COMPLETE)
        device.finish()


def test_trackers_can_be_replaced_while_the_stream_runs():
    first, second = Slow(), Slow()
    trackers = {"number": first}
    with stream(trackers) as pushed:
        pushed.push(NUMBERS[3])
        pushed.result()
        trackers["number"] = second
        pushed.push(NUMBERS[4])
    assert (first.frames, second.frames) == ([3], [4])


def test_answers_and_events_are_awaited():
    async def watch(pushed):
        return await anext(pushed.updates())

    events = {"high": Limit(lambda update: update.tracked["number"], above=2)}
    with stream({"number": Slow()}, events=events) as pushed:
        pushed.push(NUMBERS[3], time=pushed.now())
        pushed.result()
        update = asyncio.run(watch(pushed))
    assert update.tracked["number"] == 3
    assert [(event.name, event.started, event.value) for event in update.events] == [("high", True, 3.0)]


def test_events_of_updates_that_were_not_awaited_are_in_the_next_one():
    async def watch(pushed):
        updates = pushed.updates()
        pushed.push(NUMBERS[0])
        found = [await anext(updates)]
        pushed.push(NUMBERS[1:4])
        pushed.result()
        found.append(await anext(updates))
        return found

    events = {"odd": Limit(lambda update: update.tracked["number"] % 2, above=0)}
    with stream({"number": Slow()}, events=events) as pushed:
        first, second = asyncio.run(watch(pushed))
    assert (first.events, second.tracked["number"]) == ((), 3)
    assert [event.started for event in second.events] == [True, False, True]


def test_an_error_of_a_tracker_ends_the_stream():
    pushed = stream({"none": lambda update: 1 / 0})
    pushed.push(NUMBERS[0])
    with pytest.raises(ZeroDivisionError):
        pushed.result()


def test_what_is_neither_a_tracker_nor_a_limit_is_refused():
    with pytest.raises(io.InputError, match=r"trackers: pose is a str. Give a tracker"):
        stream({"pose": "pose"})
    with pytest.raises(io.InputError, match=r"events: slip is a float. Give a Limit"):
        stream({"number": Slow()}, events={"slip": 0.1})
    with pytest.raises(io.InputError, match="until must not be larger"):
        Limit(lambda update: 0.0, above=1.0, until=2.0)


def events_of(values, **limit):
    """Return when an event starts and ends along values of a quantity."""
    changes, numbers = [], iter(values)
    events = {"it": Limit(lambda update: next(numbers), **limit)}
    with stream({}, events=events, on_update=lambda update, status: changes.append(update.events)) as pushed:
        for number in range(len(values)):
            pushed.push(NUMBERS[number])
    return [(number, event.started) for number, found in enumerate(changes) for event in found]


def test_an_event_starts_above_the_limit_and_ends_at_the_lower_one():
    assert events_of([0, 2, 1.5, 2, 1, 2], above=1.8, until=1.0) == [(1, True), (4, False), (5, True)]


def test_an_unknown_quantity_starts_and_ends_nothing():
    assert events_of([2, None, math.nan, 2, 0], above=1.0) == [(0, True), (4, False)]


# Contact that is lost and found again.


def ball(depth):
    """Return the height of a ball, mm, with its standard deviation; nothing is known out of contact."""
    x, y = io.pixel_axes(SHAPE, (PIXEL, PIXEL))
    height = -(x**2 + (y**2)[:, np.newaxis]) / 12
    known = height > -depth
    values = {"height": height, "height_sigma": np.full(SHAPE, 1e-3)}
    return io.Result({name: np.where(known, each, np.nan) for name, each in values.items()}, x=x, y=y)


class Balls(engine.Operation):
    """Maps of a ball, as deep as each frame says, in hundredths of a millimetre."""

    motions = ("vertical",)
    updates_per_second = math.inf

    def push(self, frames, *, travel):
        self.depth = 0.01 * float(frames[-1, 0, 0])

    def result(self):
        return {"contact": np.isfinite(ball(self.depth).height).astype(np.uint8)}

    def preview(self, seconds):
        return ball(self.depth).assign(self.result())


def follow(trackers, depths, **options):
    """Return the updates of a stream of balls."""
    updates = []
    with stream(
        trackers, Balls(), SHAPE, on_update=lambda update, status: updates.append(update), **options
    ) as pushed:
        for depth in depths:
            pushed.push(np.full(SHAPE, round(100 * depth), np.uint8), travel=depth)
    return updates


def hertz(depth, modulus):
    return 16 / 9 * modulus * math.sqrt(6.0) * depth**1.5


def test_forces_are_found_lost_and_found_again():
    tracker = engine.force.ForceTracker(PIXEL, modulus=0.1)
    forces = [each.tracked["force"].force for each in follow({"force": tracker}, [0.3, 0.0, 0.3])]
    assert forces == pytest.approx([hertz(0.3, 0.1), 0.0, hertz(0.3, 0.1)], rel=0.02)


def test_a_pose_is_lost_without_contact_and_found_again():
    updates = follow({"pose": engine.pose.PoseTracker(PIXEL)}, [0.3, 0.3, 0.0, 0.3])
    assert [update.tracked["pose"] is None for update in updates] == [False, False, True, False]
    assert "pose" in updates[2].lost
    found = updates[3].tracked["pose"]
    assert np.all(np.abs(found.translation) < 5e-3)


def test_a_pose_is_found_when_contact_grows_from_a_few_pixels():
    tracker = engine.pose.PoseTracker(PIXEL)
    tracker.push(ball(0.001))
    with pytest.raises(io.InputError, match="too few pixels"):
        tracker.push(ball(0.3))
    assert np.all(np.abs(tracker.push(ball(0.3)).translation) < 5e-3)
    assert tracker.keys == 1


def test_trackers_of_maps_have_no_answer_before_there_are_maps():
    press = engine.Press(dark=0, bright=255)
    with stream({"pose": engine.pose.PoseTracker()}, press, SHAPE) as pushed:
        pushed.push(np.zeros(SHAPE, np.uint8), travel=0.0)
    assert pushed.latest().lost == {"pose": "the frames do not determine maps yet"}


def test_slip_starts_anew_when_contact_is_found_again():
    texture = np.random.default_rng(1).normal(0, 1, (60, 80))
    texture = cv2.GaussianBlur(texture, (0, 0), 1.5)
    texture = (120 + 60 * texture / np.abs(texture).max()).astype(np.float32)
    touched = np.zeros((60, 80), np.uint8)
    touched[6:54, 8:72] = 1

    class Touch(engine.Operation):
        motions = ("vertical",)
        updates_per_second = math.inf
        contact = io.Map("contact", dtype="uint8")

        def push(self, frames, *, travel):
            self.place = float(travel[-1])

        def result(self):
            return {"contact": touched * (self.place > 0)}

    updates = []
    with Stream(
        Touch(),
        (60, 80),
        np.float32,
        latency=math.inf,
        trackers={"slip": engine.slip.SlipTracker(pixel_size=0.1, noise=0.1)},
        events={"contact": Limit.contact(), "slip": Limit.slip()},
        on_update=lambda update, status: updates.append(update),
    ) as pushed:
        for travel, moved in ((1.0, 0), (1.0, 1), (0.0, 0), (0.0, 0), (1.0, 0), (1.0, 1)):
            pushed.push(np.roll(texture, moved, axis=1), travel=travel)
    shifts = [update.tracked["slip"].shift_x for update in updates]
    assert shifts[1] == pytest.approx(0.1, abs=0.002)
    assert math.isnan(shifts[3])
    assert shifts[5] == pytest.approx(0.1, abs=0.002)
    changes = [(event.name, event.started) for update in updates for event in update.events]
    assert changes == [("contact", True), ("contact", False), ("contact", True)]


def test_events_of_contact_and_of_a_force():
    events = {"contact": Limit.contact(), "strong": Limit.force(0.1, until=0.08)}
    depths = [0.0, 0.1, 0.4, 0.0, 0.4]
    trackers = {"force": engine.force.ForceTracker(PIXEL, modulus=0.1)}
    updates = follow(trackers, depths, events=events)
    changes = [
        (number, event.name, event.started)
        for number, update in enumerate(updates)
        for event in update.events
    ]
    assert changes == [
        (1, "contact", True),
        (2, "strong", True),
        (3, "contact", False),
        (3, "strong", False),
        (4, "contact", True),
        (4, "strong", True),
    ]


def test_a_sudden_slip_is_an_event_within_two_frames():
    texture = np.random.default_rng(1).normal(100, 20, (60, 80))
    texture = cv2.GaussianBlur(texture, (0, 0), 1.5).astype(np.float32)
    right = np.arange(80) >= 62
    starts, updates = 4, []
    tracker = engine.slip.SlipTracker(np.ones((60, 80)), pixel_size=0.1, noise=0.1)
    with Stream(
        Frames(),
        (60, 80),
        np.float32,
        latency=math.inf,
        trackers={"slip": tracker},
        events={"slip": Limit.slip()},
        on_update=lambda update, status: updates.append(update),
    ) as pushed:
        for number in range(9):
            moved = np.roll(texture, number, axis=1)
            stays = np.roll(texture, min(number, starts), axis=1)  # the skin at the right stays behind
            pushed.push(np.where(right, stays, moved), time=0.0)
    found = [number for number, update in enumerate(updates) for event in update.events]
    assert len(found) == 1
    assert starts < found[0] <= starts + 2


def test_a_press_that_is_lifted_loses_contact_and_finds_it_again():
    x, y = io.pixel_axes(SHAPE, (PIXEL, PIXEL))
    height = -(x**2 + (y**2)[:, np.newaxis]) / 12
    down = np.arange(-0.1, 0.5, 0.02)
    travel = np.concatenate([down, down[::-1], down])
    areas, changes = [], []

    def note(update, status):
        areas.append(update.contact_area)
        changes.extend((round(update.position, 2), event.started) for event in update.events)

    with Stream(
        engine.Press(dark=0, bright=255, noise=1.0, fill=False),
        SHAPE,
        header=io.Header("vertical", pixel_size=(PIXEL, PIXEL)),
        latency=math.inf,
        trackers={},
        events={"contact": Limit.contact()},
        on_update=note,
    ) as pushed:
        for place in travel:
            pushed.push(np.where(place > -height, 255, 0).astype(np.uint8), travel=place)
        result = pushed.result()
    assert [started for _, started in changes] == [True, False, True]
    assert all(abs(place) <= 0.06 for place, _ in changes)
    assert areas[len(down) - 1] == pytest.approx(areas[-1], rel=0.05)
    assert np.nanmax(np.abs(result.height - height)) < 0.011
