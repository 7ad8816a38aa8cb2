"""Options become a movement: each motion's own, its defaults, and no other's."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest

from mirrorskin.cli.options import MotionName
from mirrorskin.cli.simulate import DEFAULTS, FRAMES_MAX, make_movement
from mirrorskin.hw.twin import Axial, Horizontal, Twist, Vertical
from mirrorskin.io import InputError

VERTICAL, AXIAL, HORIZONTAL, TWIST = MotionName
KINDS = {VERTICAL: Vertical, AXIAL: Axial, HORIZONTAL: Horizontal, TWIST: Twist}
EVERY = sorted({name for own in DEFAULTS.values() for name in own})


def make(motion, frames=None, release=False, **given):
    """Make a movement as the command line does: it tells of every option, and None where it is not given."""
    named = {name.replace("_", "-"): value for name, value in given.items()}
    assert set(named) <= set(EVERY)
    return make_movement(motion, frames, release, dict.fromkeys(EVERY) | named)


@pytest.mark.parametrize("motion", MotionName)
def test_each_motion_has_its_movement_and_its_defaults(motion):
    movement = make(motion)
    assert isinstance(movement, KINDS[motion])
    assert movement.motion == motion.value
    spelt = make(motion, **{name.replace("-", "_"): text for name, text in DEFAULTS[motion].items()})
    np.testing.assert_array_equal(spelt.positions, movement.positions)
    assert spelt.header() == movement.header()


@pytest.mark.parametrize("motion", MotionName)
@pytest.mark.parametrize("frames", [1, 2, 50])
def test_there_are_as_many_frames_as_asked_for(motion, frames):
    assert len(make(motion, frames).positions) == frames


def test_a_press_goes_on_by_its_step():
    movement = make(VERTICAL, 4, travel_start="1mm", travel_step="0.5mm")
    np.testing.assert_array_equal(movement.positions, [1, 1.5, 2, 2.5])
    assert (movement.deepest, movement.compliance) == (2.5, 0)
    lifted = make(VERTICAL, 3, travel_start="1mm", travel_step="-0.5mm", compliance="30um/N")
    np.testing.assert_array_equal(lifted.positions, [1, 0.5, 0])
    assert lifted.compliance == pytest.approx(0.03)


@pytest.mark.parametrize(("frames", "travel"), [(1, [1]), (2, [1, 1.5, 1]), (4, [1, 1.5, 2, 2.5, 2, 1.5, 1])])
def test_a_release_goes_back_by_the_same_steps(frames, travel):
    movement = make(VERTICAL, frames, release=True, travel_start="1mm", travel_step="0.5mm")
    np.testing.assert_array_equal(movement.positions, travel)


def test_a_rotation_starts_at_phase_zero():
    movement = make(AXIAL, 3, phase_step="-30deg", tilt="5deg", press="2mm", pivot="1mm,2mm,4cm")
    np.testing.assert_allclose(movement.positions, np.radians([0, -30, -60]))
    assert movement.tilt == pytest.approx(math.radians(5))
    assert (movement.deepest, movement.pivot) == (2, pytest.approx((1, 2, 40)))


@pytest.mark.parametrize(
    ("step", "frames"), [("45deg", 8), ("-45deg", 8), ("7deg", 51), ("1turn", 1), ("3turn", 1), ("0deg", 30)]
)
def test_without_a_number_of_frames_a_rotation_is_one_turn(step, frames):
    assert len(make(AXIAL, phase_step=step).positions) == frames


@pytest.mark.parametrize("step", ["1e-6deg", "-1e-9rad", "1e-320rad"])
def test_a_turn_of_too_many_frames_needs_a_number_of_them(step):
    with pytest.raises(InputError, match=f"more than {FRAMES_MAX} frames: give --frames"):
        make(AXIAL, phase_step=step)
    assert len(make(AXIAL, 5, phase_step=step).positions) == 5


def test_a_displacement_and_a_twist_start_at_rest():
    moved = make(HORIZONTAL, 3, displacement_step="0.1mm,-20um", press="2mm")
    np.testing.assert_allclose(moved.positions, [[0, 0], [0.1, -0.02], [0.2, -0.04]], atol=1e-15)
    turned = make(TWIST, 3, twist_step="-1deg", press="2mm")
    np.testing.assert_allclose(turned.positions, np.radians([0, -1, -2]))
    assert moved.deepest == turned.deepest == 2


@pytest.mark.parametrize(
    ("motion", "name"),
    [(motion, name) for motion in MotionName for name in EVERY if name not in DEFAULTS[motion]],
)
def test_an_option_of_another_motion_is_named(motion, name):
    with pytest.raises(InputError, match=f"^--{name} says nothing of a motion that is {motion.value}: "):
        make(motion, **{name.replace("-", "_"): "1mm"})


@pytest.mark.parametrize("motion", [AXIAL, HORIZONTAL, TWIST])
def test_a_release_belongs_to_a_press(motion):
    with pytest.raises(InputError, match=f"^--release says nothing of a motion that is {motion.value}"):
        make(motion, release=True)


@pytest.mark.parametrize(
    ("motion", "name"), [(motion, name) for motion in MotionName for name in DEFAULTS[motion]]
)
def test_an_option_that_cannot_be_read_is_named(motion, name):
    with pytest.raises(InputError, match=f"^--{name} much: a ") as caught:
        make(motion, **{name.replace("-", "_"): "much"})
    assert "; write e.g. " in str(caught.value)


def test_the_defaults_can_be_told_without_importing_anything_heavy():
    code = "import sys, mirrorskin.cli.simulate; sys.exit(bool({'numpy', 'pint', 'h5py'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
