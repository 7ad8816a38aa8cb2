"""Captures on the emulated rig are as accurate as frames rendered directly at the same places."""

import math
from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs

from mirrorskin import engine
from mirrorskin.hw.rig.plans import AxialPlan, VerticalPlan
from mirrorskin.hw.rig.rig import Rig
from mirrorskin.hw.rig.scan import StepScan
from mirrorskin.hw.rig.sweep import SweepScan
from mirrorskin.io.base.types import Block, Closing
from mirrorskin.twin import Axial, Vertical
from mirrorskin.twin.emulator.rig import EmulatedRig
from mirrorskin.twin.emulator.simulated_clock import SimulatedClock

pytestmark = pytest.mark.slow

TILT = math.radians(2.5)
DELAY = 0.05
NEAR_DELAY = pytest.approx(DELAY, abs=0.002)
PLANS = {
    "vertical, steps": VerticalPlan(0.0, 1.0, step=0.25),
    "vertical, continuous": VerticalPlan(0.0, 1.0, speed=1.0),
    "axial, steps": AxialPlan(1.0, TILT, phase_step=math.radians(90)),
    "axial, continuous": AxialPlan(1.0, TILT, rate=0.7),
}


class Kept(Closing):
    """Frames and their places, as a source."""

    name, rewindable = "kept", True

    def __init__(self, frames, places, header):
        self.header, self.motion = header, header.motion
        self.shape, self.dtype = frames.shape, frames.dtype
        self.frames, self.places = frames, places
        self.travel, self.phase = (places, None) if header.motion == "vertical" else (None, places)
        self.rewind()

    def rewind(self):
        self._next = 0

    def read(self, out=None, /):
        out = np.empty((1, *self.shape[1:]), self.dtype) if out is None else out
        part = slice(self._next, min(self._next + len(out), len(self.frames)))
        if part.start == part.stop:
            return None
        self._next = part.stop
        out = out[: part.stop - part.start]
        out[:] = self.frames[part]
        travel, phase = (
            None if positions is None else positions[part] for positions in (self.travel, self.phase)
        )
        return Block(out, index=part.start, travel=travel, phase=phase)


def capture(plan, seed):
    """Return what a scan of a sphere gave, the frames' numbers, the scan, and a twin that saw the same."""
    optics = {"shape": (48, 64), "pixel_size": 0.125}
    optics["pattern"] = "uniform" if plan.motion == "vertical" else "linear"
    # Steps need few frames, and no delay that is measured.
    rate, arrivals = (10.0, {"dark": 16.0, "delay": DELAY}) if plan.in_steps else (20.0, {"dark": 16.0})
    clock = SimulatedClock()
    with EmulatedRig(
        "sphere", **optics, rate=rate, delay=DELAY, jitter=0.003, seed=seed, clock=clock
    ) as emulated:
        settings = emulated.settings
        settings = replace(settings, camera=structs.replace(settings.camera, **arrivals))
        with Rig(emulated.open_stage(settings.stage), emulated.camera, settings, clock) as rig:
            frames, numbers, take = [], {}, rig.take

            def noted(limit):
                taken = take(limit)
                numbers.update(zip(taken.time.tolist(), taken.number.tolist(), strict=True))
                return taken

            rig.take = noted
            with StepScan(rig, plan) if plan.in_steps else SweepScan(rig, plan) as scan:
                buffer = np.empty((16, *scan.shape[1:]), scan.dtype)
                while (block := scan.read(buffer)) is not None:
                    frames.append(replace(block, frames=block.frames.copy()))
                origin = clock.now() - scan.now()
            (places,) = scan.positions().values()
        is_axial = isinstance(plan, AxialPlan)
        movement = Axial(places, plan.tilt, plan.press) if is_axial else Vertical(places)
        arrival = origin + np.concatenate([block.time for block in frames])
        arrivals = np.array(list(numbers))
        number = [numbers[arrivals[np.argmin(abs(arrivals - item))]] for item in arrival]
        captured = Kept(np.concatenate([block.frames for block in frames]), places, scan.header)
        return captured, number, scan, emulated.twin(movement)


def errors(source, truth):
    actual = engine.score(engine.reconstruct(source), truth)
    return tuple(math.nan if result is None else result.rms for result in (actual.height, actual.normal))


@pytest.fixture(scope="module")
def compared():
    """RMS errors of heights and normals, captured and rendered."""
    captures = {name: capture(plan, seed) for seed, (name, plan) in enumerate(PLANS.items())}
    actual = {}
    for name, (captured, numbers, scan, twin) in captures.items():
        rendered = np.empty_like(captured.frames)
        # The same noise and the same references, so that only the places differ.
        for number, place, frame in zip(numbers, captured.places, rendered, strict=True):
            pose = twin.movement.pose(place)
            twin.look(lambda late, pose=pose: pose, number, frame)
        direct = Kept(rendered, captured.places, captured.header)
        heights, normals = zip(*(errors(source, twin.truth) for source in (captured, direct)), strict=True)
        actual[name] = heights, normals, scan
    return actual


@pytest.mark.parametrize("name", PLANS)
def test_heights_are_as_good_as_the_twins(compared, name):
    captured, direct = compared[name][0]
    # A turn as quick as this one makes much of an error of the delay; its heights are good to a micrometre.
    factor = 2.0 if name == "axial, continuous" else 1.2
    assert 0 < captured < factor * direct


@pytest.mark.parametrize("name", ["axial, steps", "axial, continuous"])
def test_normals_are_as_good_as_the_twins(compared, name):
    captured, direct = compared[name][1]
    assert 0 < captured < 1.2 * direct


@pytest.mark.parametrize("name", ["vertical, continuous", "axial, continuous"])
def test_the_delay_is_found(compared, name):
    assert compared[name][2].delay.seconds == NEAR_DELAY
