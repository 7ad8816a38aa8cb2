"""Estimators in several threads: one pushes, others look on, and every answer is that of a single thread."""

import importlib
import inspect
import pkgutil
import threading
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, is_dataclass
from functools import cached_property, partial

import numpy as np
import pytest
from live_frames import paced, phases, press_frames, press_header, turn_frames, turn_header
from speckle import Speckle
from stacks import MadeUp
from suite.scenes import SCALES, TILT

from mirrorskin import engine
from mirrorskin.engine import live
from mirrorskin.engine.live.status import STAGES, Monitor
from mirrorskin.engine.press.estimated_levels import EstimatedLevels, EstimatedLevelSearch
from mirrorskin.engine.press.levels import LevelSearch
from mirrorskin.engine.rotation.normals_window import NormalWindow
from mirrorskin.engine.thread_safe import ThreadSafe
from mirrorskin.io import Header, InputError
from mirrorskin.io.types import body_axes

PIECES, SHAPE = 60, (24, 32)
TRAVEL = np.linspace(0, 1.2, 2 * PIECES)
STROKES = 0.6 - 0.6 * np.cos(0.15 * np.arange(2 * PIECES))
PRESS = press_frames((2 * PIECES, *SHAPE))
PHASE = phases(2 * PIECES)
TURNS = turn_frames((2 * PIECES, *SHAPE))
OFFSET, GAIN, NOISE = SCALES["uint8"]
SCALE = {"gain": GAIN, "offset": OFFSET, "noise": NOISE}
LEAN = 0.05 * np.sin(0.8 * np.arange(2 * PIECES))
ROCKED = np.clip(120 + 400 * LEAN[:, None, None] + np.zeros(SHAPE), 0, 255).astype(np.uint8)
PIXEL = 0.05
SLIDE = np.arange(PIECES)[:, None] * [0.006, 0.003]
SKIN = np.stack([Speckle(3).frame((64, 72), -x / PIXEL, y / PIXEL, 1.0, k) for k, (x, y) in enumerate(SLIDE)])
LIGHTS = np.stack([np.cos(PHASE), np.sin(PHASE), np.ones(len(PHASE))], axis=1)


class Brightest:
    """An estimator of a user's, which returns its own map."""

    def __init__(self, shape, dtype):
        self.most = np.zeros(shape, dtype)

    def reset(self):
        self.most[:] = 0

    def push(self, frames):
        for frame in frames:
            np.maximum(self.most, frame, out=self.most)

    def result(self):
        return {"brightest": self.most, "height": self.most.astype(np.float32)}


class Pushes:
    """How an estimator is made, the pushes that it gets, and what other threads call meanwhile."""

    def __init__(self, make, frames, reads=("result",), each=2, every=True, looks=10**6, **known):
        self.make, self.reads, self.every, self.looks = make, reads, every, looks
        cuts = [slice(start, start + each) for start in range(0, len(frames), each)]
        self.pieces = [
            ((frames[cut],), {name: values[cut] for name, values in known.items()}) for cut in cuts
        ]


def slopes(number):
    return (0.01 * number * np.ones(SHAPE), np.linspace(0, 0.02 * number, SHAPE[1]) * np.ones(SHAPE))


def integrations():
    case = Pushes(partial(engine.Integrator, SHAPE, 0.1), [])
    case.pieces = [(slopes(number), {}) for number in range(PIECES)]
    return case


def rocking():
    source = MadeUp(ROCKED, Header("axial", pixel_size=(PIXEL, PIXEL), zenith_gain=np.asarray(400.0)))
    return live.LiveRocking(source, noise=1.0)


SEEN = ("result", "travel", "room")
PICTURE = (SHAPE, "uint8")
LEVELS = EstimatedLevels(20.0, 230.0, 1.0, 2.0)
CASES = {
    "OnsetSearch": Pushes(partial(engine.OnsetSearch, *PICTURE), PRESS, (*SEEN, "noise"), travel=TRAVEL),
    "LevelSearch": Pushes(partial(LevelSearch, *PICTURE, [0.3, 0.7]), PRESS, SEEN, travel=TRAVEL),
    "EstimatedLevelSearch": Pushes(
        partial(EstimatedLevelSearch, *PICTURE, LEVELS, threshold=0.5), PRESS, SEEN, travel=TRAVEL
    ),
    "StrokeSearch": Pushes(partial(engine.StrokeSearch, *PICTURE), PRESS, (*SEEN, "onset"), travel=STROKES),
    "ChangePointSearch": Pushes(
        partial(engine.ChangePointSearch, *PICTURE, dark=20, bright=230), PRESS, SEEN, travel=TRAVEL
    ),
    "Correlator": Pushes(partial(engine.Correlator, *PICTURE), TURNS, ("result", "room"), phase=PHASE),
    "Correlator of a window": Pushes(
        partial(engine.Correlator, *PICTURE, window=8), TURNS, ("result", "room"), phase=PHASE
    ),
    "NormalEstimator": Pushes(
        partial(engine.NormalEstimator, *PICTURE, tilt=TILT, **SCALE), TURNS, ("result", "room"), phase=PHASE
    ),
    "NormalEstimator of each turn": Pushes(
        partial(engine.NormalEstimator, *PICTURE, tilt="estimate", gain=GAIN, offset=OFFSET, per_turn=True),
        TURNS,
        phase=PHASE,
    ),
    "PoseEstimator": Pushes(
        partial(engine.PoseEstimator, *PICTURE, gain=400, noise=1.0), ROCKED, pose=body_axes(0 * LEAN, LEAN)
    ),
    "NormalWindow": Pushes(
        partial(NormalWindow, *PICTURE, window=8, tilt=TILT, **SCALE),
        TURNS,
        ("result", "correlation", "is_full", "room"),
        phase=PHASE,
    ),
    "SlipSearch": Pushes(
        partial(engine.SlipSearch, (64, 72), SKIN.dtype, PIXEL),
        SKIN,
        ("result", "newest", "room"),
        each=1,
        every=False,
        looks=10,
        displacement=SLIDE,
    ),
    "FringeEstimator": Pushes(partial(engine.FringeEstimator, *PICTURE), TURNS, phase=PHASE),
    "FocusEstimator": Pushes(partial(engine.FocusEstimator, *PICTURE, noise=2.0), PRESS, travel=TRAVEL),
    "PhotometricStereo": Pushes(partial(engine.PhotometricStereo, *PICTURE), TURNS, light=LIGHTS),
    "Integrator": integrations(),
    "LivePress": Pushes(
        lambda: live.LivePress(paced(PRESS, press_header(), STROKES)),
        PRESS,
        ("result", "maps"),
        travel=STROKES,
    ),
    "LiveRotation": Pushes(
        lambda: live.LiveRotation(paced(TURNS, turn_header(), PHASE), window=8, noise=NOISE),
        TURNS,
        ("result", "maps", "normals", "correlation", "room"),
        every=False,
        looks=10,
        phase=PHASE,
    ),
    "LiveRocking": Pushes(rocking, ROCKED, ("result", "maps"), pose=body_axes(0 * LEAN, LEAN)),
    "LiveSlip": Pushes(
        lambda: live.LiveSlip(MadeUp(SKIN, Header("horizontal", pixel_size=(PIXEL, PIXEL)))),
        SKIN,
        ("result", "maps"),
        each=1,
        every=False,
        looks=10,
        displacement=SLIDE,
    ),
    "LiveOwn": Pushes(
        lambda: live.LiveOwn(paced(PRESS, press_header(), TRAVEL), Brightest),
        PRESS,
        ("result", "maps"),
        travel=TRAVEL,
    ),
}


def parts_of(answer):
    """Yield all numbers of an answer as bytes, but for the date in ``process``."""
    if isinstance(answer, np.ndarray):
        yield np.ascontiguousarray(answer).tobytes()
    elif is_dataclass(answer):
        for field in fields(answer):
            if field.name != "process":
                yield from parts_of(getattr(answer, field.name))
    elif isinstance(answer, Mapping):
        for name, one in sorted(answer.items()):
            yield name.encode()
            yield from parts_of(one)
    elif isinstance(answer, tuple | list):
        for one in answer:
            yield from parts_of(one)
    else:
        yield repr(answer).encode()


def digest(answer):
    return hash(b"|".join(parts_of(answer)))


def read(estimator, name):
    """Return what a method or property gives, or None where there are too few frames yet."""
    try:
        member = getattr(estimator, name)
        return member() if callable(member) else member
    except InputError:
        return None


@pytest.mark.parametrize("name", CASES)
def test_each_answer_beside_pushes_is_that_of_a_single_thread(name):
    case = CASES[name]
    alone = case.make()
    known = {digest(read(alone, "result"))}
    for args, named in case.pieces:
        alone.push(*args, **named)
        if case.every:
            known.add(digest(read(alone, "result")))
    expected = digest(alone.result())

    shared, start, done = case.make(), threading.Barrier(3), threading.Event()

    def push():
        start.wait()
        try:
            for args, named in case.pieces:
                shared.push(*args, **named)
        finally:
            done.set()

    def look_on():
        kept = []
        start.wait()
        for _ in range(case.looks):
            if done.is_set():
                break
            for one in case.reads:
                answer = read(shared, one)
                if one == "result" and answer is not None:
                    kept = [*kept[:2], *kept[-2:], (answer, digest(answer))]
                    assert not case.every or kept[-1][1] in known
        return kept

    with ThreadPoolExecutor(3) as pool:
        pushing, *looking = pool.submit(push), pool.submit(look_on), pool.submit(look_on)
        pushing.result()
        kept = [one for each in looking for one in each.result()]
    assert digest(shared.result()) == expected
    assert all(digest(answer) == before for answer, before in kept)  # nothing wrote to them later


def classes():
    """Return the classes of the engine that are pushed to, and answer."""
    modules = [
        importlib.import_module(one.name)
        for one in pkgutil.walk_packages(engine.__path__, "mirrorskin.engine.")
        if not one.name.startswith("mirrorskin.engine.batch")
    ]
    return {
        one
        for module in modules
        for one in vars(module).values()
        if inspect.isclass(one) and one.__module__.startswith("mirrorskin.engine.")
        if callable(getattr(one, "push", None)) and not getattr(one, "_is_protocol", False)
        if callable(getattr(one, "result", None)) or one.__name__ in engine.__all__
    }


def test_every_estimator_is_thread_safe_and_hammered():
    found = classes()
    assert not {one.__name__ for one in found if not issubclass(one, ThreadSafe)}
    hammered = {name.split()[0] for name in CASES}
    # The tracker has no method but push; the other is part of LiveRotation.
    assert {one.__name__ for one in found} - hammered == {"PoseTracker", "WarmStartIntegrator"}


class Meeting(ThreadSafe):
    """Its members see whether two threads are in them at once."""

    def __init__(self):
        self.inside, self.most, self.made = 0, 0, 0

    def _meet(self):
        self.inside += 1
        self.most = max(self.most, self.inside)
        threading.Event().wait(0.0005)  # lets other threads run
        self.inside -= 1

    def push(self):
        self._meet()
        _ = self.seen

    @property
    def seen(self):
        self._meet()
        return self.most

    @cached_property
    def room(self):
        self._meet()
        self.made += 1
        return object()

    def fail(self):
        raise InputError("no")


class Later(Meeting):
    def push(self):
        super().push()
        self._meet()


@pytest.mark.parametrize("kind", [Meeting, Later])
def test_no_two_threads_are_in_an_object_at_once(kind):
    shared, start = kind(), threading.Barrier(4)

    def use():
        start.wait()
        for _ in range(20):
            shared.push()
            with pytest.raises(InputError):  # which leaves it to others
                shared.fail()
        return shared.room, shared.seen

    with ThreadPoolExecutor(4) as pool:
        found = [pool.submit(use) for _ in range(4)]
        rooms, seen = zip(*(one.result() for one in found), strict=True)
    assert (set(seen), len(set(rooms)), shared.made) == ({1}, 1, 1)


def test_an_object_does_not_wait_for_another():
    one, other = Meeting(), Meeting()
    with one._thread_lock, ThreadPoolExecutor(1) as pool:
        assert pool.submit(other.push).result(timeout=60) is None


def test_a_status_can_be_read_while_the_loop_counts():
    monitor, start, done = Monitor(), threading.Barrier(3), threading.Event()

    def count():
        start.wait()
        try:
            for number in range(3000):
                monitor.took(0.01 * number, 1, 1, 0)
                monitor.time(STAGES[0], 0.1)
        finally:
            done.set()

    def look_on():
        start.wait()
        while not done.is_set():
            status = monitor.status(fresh=True)
            assert status.frames == status.used

    with ThreadPoolExecutor(3) as pool:
        for one in [pool.submit(count), pool.submit(look_on), pool.submit(look_on)]:
            one.result()
    assert monitor.status(fresh=True).frames == 3000


def test_threads_that_integrate_at_once_get_what_each_gets_alone():
    inputs = [slopes(number) for number in range(1, 7)]
    alone = [digest(engine.integrate(*one, 0.1)) for one in inputs]
    with ThreadPoolExecutor(3) as pool:
        found = list(pool.map(lambda one: digest(engine.integrate(*one, 0.1)), inputs * 3))
    assert found == alone * 3


@pytest.mark.parametrize("kind", [engine.OnsetSearch, engine.StrokeSearch])
def test_an_estimator_that_refuses_frames_goes_on_as_if_they_had_not_come(kind):
    search, whole = kind(*PICTURE), kind(*PICTURE)
    whole.push(PRESS, travel=TRAVEL)
    search.push(PRESS[:50], travel=TRAVEL[:50])
    back = TRAVEL[40::-1]
    for frames, travel in ((PRESS[:41, 1:], back), (PRESS[:41].astype(np.uint16), back), (PRESS[:9], [1.0])):
        with pytest.raises(InputError), ThreadPoolExecutor(1) as pool:
            pool.submit(search.push, frames, travel=travel).result()
    search.push(PRESS[50:], travel=TRAVEL[50:])
    assert digest(search.result()) == digest(whole.result())
