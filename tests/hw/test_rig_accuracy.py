"""Captures on the emulated rig are as good as what the twin renders directly."""

import math
from concurrent.futures import ThreadPoolExecutor

import pytest
from capture_report import TILT, compare, watch

from mirrorskin.hw.grbl.link import Link
from mirrorskin.hw.rig import calibration
from mirrorskin.hw.rig import rig as rigs
from mirrorskin.hw.rig.plans import AxialPlan, VerticalPlan

pytestmark = pytest.mark.slow  # it runs in real time

DELAY = 0.05
OPTICS = {"shape": (48, 64), "pixel_size": 0.125}
CAMERA = {"delay": DELAY, "jitter": 0.003}
PLANS = {
    "vertical, steps": VerticalPlan(0.0, 1.0, step=0.25),
    "vertical, continuous": VerticalPlan(0.0, 1.0, speed=1.0),
    "axial, steps": AxialPlan(1.0, TILT, phase_step=math.radians(90)),
    "axial, continuous": AxialPlan(1.0, TILT, rate=0.7),
}


def rate_and_known(plan):
    """Steps need few frames, and no delay that is measured."""
    if plan.in_steps:
        return {"rate": 10.0, "known": {"dark": 16.0, "delay": DELAY}}
    return {"rate": 20.0, "known": {"dark": 16.0}}


@pytest.fixture(scope="module")
def compared():
    """All captures at once: they mostly wait."""
    with pytest.MonkeyPatch.context() as patch, ThreadPoolExecutor(len(PLANS)) as pool:
        # Emulators are late where other programs have the processors; that is no fault here.
        patch.setattr(rigs, "_STALL", 3.0)
        patch.setattr(calibration, "_SECONDS", 1.0)
        patch.setattr(calibration, "_FRAMES", 20)
        patch.setattr(calibration, "_LONGEST_DELAY", 0.1)
        patch.setattr(Link, "_limit", lambda link: 3.0)
        tasks = {
            name: pool.submit(watch, plan, **OPTICS, **CAMERA, **rate_and_known(plan), seed=number)
            for number, (name, plan) in enumerate(PLANS.items())
        }
        watched = {name: task.result() for name, task in tasks.items()}
    return {name: compare(one) for name, one in watched.items()}


@pytest.mark.parametrize("name", PLANS)
def test_heights_are_as_good_as_the_twins(compared, name):
    captured, direct = compared[name].height
    # A turn as quick as this one makes an error of the delay 3.5 times that of capture_report.py, where it
    # counts for a few hundredths; the heights of a rotation are good to a micrometre.
    factor = 2.0 if name == "axial, continuous" else 1.2
    assert 0 < captured < factor * direct


@pytest.mark.parametrize("name", ["axial, steps", "axial, continuous"])
def test_normals_are_as_good_as_the_twins(compared, name):
    captured, direct = compared[name].normal
    assert 0 < captured < 1.2 * direct


@pytest.mark.parametrize("name", ["vertical, continuous", "axial, continuous"])
def test_the_delay_is_found(compared, name):
    # Within 2 ms where nothing else runs: see test_delay.py, and tests/support/capture_report.py.
    assert compared[name].delay == pytest.approx(DELAY, abs=0.005)
