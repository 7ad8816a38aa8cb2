"""The emulated stage with the twin on it: the frames show the commanded positions."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import astuple, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec import structs
from numpy.typing import NDArray

from mirrorskin.hw.base.rig_file import load_rig
from mirrorskin.hw.base.stage import Position
from mirrorskin.hw.rig.plans import VerticalPlan
from mirrorskin.hw.rig.rig import Rig
from mirrorskin.hw.rig.sweep import SweepScan
from mirrorskin.io import InputError
from mirrorskin.twin import Axial, Camera, Horizontal, SheetTexture, Sphere, Twin, Twist, Vertical
from mirrorskin.twin.emulator.rig import EmulatedRig
from mirrorskin.twin.emulator.simulated_clock import SimulatedClock

SMALL: dict[str, Any] = {"shape": (31, 42), "pixel_size": 0.3, "rate": 100.0}


@pytest.fixture
def running(clock: SimulatedClock) -> Iterator[Callable[..., EmulatedRig]]:
    """Make rigs that run until the test ends."""
    with ExitStack() as stack:
        yield lambda *objects, **scene: stack.enter_context(
            EmulatedRig(*objects, clock=clock, **{**SMALL, **scene})
        )


def command(rig: EmulatedRig, words: str) -> str:
    """Send a line by hand, wait until it is answered and all rests, and return the answer."""
    line = rig.port.open()
    line.write(f"{words}\n".encode())
    heard = b""
    while b"ok" not in heard and b"error" not in heard:
        heard += line.read(1000)
    while rig.machine.moving() or rig.machine.state not in ("Idle", "Alarm"):
        rig.clock.sleep(0.005)
    return heard.decode()


def newest(rig: EmulatedRig) -> tuple[int, NDArray[Any]]:
    """Return a frame that was exposed from now on."""
    now = rig.clock.now()
    while True:
        frames = rig.camera.take(1, 1.0)
        if frames.time[0] - 0.011 > now:
            return int(frames.number[0]), frames.pixels[0].copy()


def direct(twin: Twin, number: int) -> NDArray[Any]:
    twin.skip(number)
    block = twin.read()
    assert block is not None
    return block.frames[0]


def test_what_the_stage_does_is_what_the_camera_sees(running, clock) -> None:
    rig = running()
    assert rig.where(clock.now()) == Position(-4.0, 0.0, 0.0)
    _, lifted = newest(rig)
    assert lifted.max() < 30
    command(rig, "G21 G90 G1 Z-5.25 F900")  # 4 mm down are at the object
    number, pressed = newest(rig)
    assert pressed.max() > 200
    np.testing.assert_array_equal(pressed, direct(rig.twin(Vertical(np.full(number + 1, 1.25))), number))


def test_pitch_and_roll_are_the_lean_of_a_precession(running, clock) -> None:
    pivot = (0.5, -0.2, 3.0)
    rig = running(pattern="linear", pivot=pivot)
    command(rig, "G21 G90 G1 X1.5 Y-2 Z-5 F2000")
    number, sight = newest(rig)
    phase, tilt = math.atan2(-2.0, 1.5), math.radians(2.5)
    place = rig.where(clock.now())
    assert (place.travel, place.tilt, place.phase) == pytest.approx((1.0, tilt, phase))
    target = Axial(np.full(number + 1, phase), tilt, 1.0, pivot)
    assert np.mean(sight != direct(rig.twin(target), number)) < 0.001  # the angles are rounded


def test_x_y_and_twist_are_those_of_the_twins_movements(running) -> None:
    rig = running("coin", pattern="linear")
    command(rig, "G21 G90 G1 Z-5 A0.6 B-0.3 F2000")
    number, sight = newest(rig)
    slide = Horizontal(np.tile((0.6, -0.3), (number + 1, 1)), 1.0)
    np.testing.assert_array_equal(sight, direct(rig.twin(slide), number))
    command(rig, "G1 A0 B0 C30 F2000")
    number, turned = newest(rig)
    twist = Twist(np.full(number + 1, math.radians(30)), 1.0)
    assert np.mean(turned != direct(rig.twin(twist), number)) < 0.001  # the angle is rounded
    assert np.any(turned != sight)


def test_friction_drags_the_skin_and_its_texture_along(running) -> None:
    scene: dict[str, Any] = {"shape": (40, 50), "pixel_size": 0.15, "rate": 30.0, "contact": "elastic"}
    rig = running(Sphere(8.0), texture=SheetTexture("flakes", 0.5), **scene)
    command(rig, "G21 G90 G1 Z-4.4 F600")
    _, pressed = newest(rig)
    command(rig, "A0.2 F60")
    number, sight = newest(rig)
    slide = Horizontal(np.tile((0.2, 0.0), (number + 1, 1)), 0.4)
    expected = direct(rig.twin(slide), number).astype(int)
    assert abs(sight - expected).mean() < 0.3
    assert abs(sight.astype(int) - pressed).mean() > 3


def test_an_arc_goes_round_at_the_tilt(running, clock) -> None:
    rig, begun = running(), clock.now()
    command(rig, "G21 G90 G17 G1 X2 F2400")
    command(rig, "G3 X-2 Y0 I-2 J0 F2400")
    places = [rig.where(float(at)) for at in np.linspace(begun, clock.now(), 300)]
    assert places[-1].phase == pytest.approx(math.pi)
    round_it = [place for place in places if place.phase > 0.1]
    assert len(round_it) > 5
    assert [place.tilt for place in round_it] == pytest.approx([math.radians(2.0)] * len(round_it), rel=2e-3)


def test_a_rig_that_homes_is_locked_before_and_has_a_position_afterwards(running, clock) -> None:
    rig = running(home=True)
    assert rig.machine.state == "Alarm"
    assert rig.where(clock.now()) == Position(-4.0, 0.0, 0.0)
    assert "error" in command(rig, "G1 X1 F100")
    assert "ok" in command(rig, "$H")
    assert "ok" in command(rig, "G21 G90 G53 G1 X-10 Y-10 Z-6 A-2.5 B-2.5 C-50 F2000")
    place = rig.where(clock.now())
    assert astuple(place) == pytest.approx((1.0, 0.0, 0.0, 0.0, 0.0, 0.0), abs=1e-9)


@pytest.mark.parametrize("home", [False, True])
def test_all_places_that_the_settings_allow_are_on_the_axes(running, home: bool) -> None:
    rig = running(home=home)
    stage = rig.settings.stage
    assert stage.port == rig.port.url
    for axis in stage.axes.values():
        ends = [axis.zero + axis.direction * value for value in axis.limits]
        length = {"X": 20.0, "Y": 20.0, "Z": 10.0, "A": 5.0, "B": 5.0, "C": 100.0}[axis.letter]
        assert abs(ends[0] - ends[1]) < length
        if home:
            assert -length < min(ends)
            assert max(ends) <= -0.5 + 1e-9  # where homing ends


def test_the_rig_file_contains_the_settings(tmp_path: Path) -> None:
    with EmulatedRig(pattern="linear", home=True, camera=Camera(np.dtype(np.uint16)), **SMALL) as rig:
        path = rig.write(tmp_path / "a new one", "tcp://127.0.0.1:1234")
        actual, expected = load_rig(path), rig.settings
        bright = str(path.parent / "bright.npy")
        np.testing.assert_array_equal(np.load(bright), rig.twin(Vertical([0.0])).header.bright)
    assert (actual.name, actual.stage) == (expected.name, structs.replace(expected.stage, silence=0.5))
    camera = structs.replace(expected.camera, source="tcp://127.0.0.1:1234", bright=bright, stall=0.5)
    assert actual.camera == camera
    assert (actual.camera.shape, actual.camera.dtype, actual.camera.rate) == (SMALL["shape"], "uint16", 100.0)
    header = rig.twin(Vertical([0.0])).header
    assert actual.camera.pixel_sides == header.pixel_size
    assert (actual.camera.counts_per_radian, actual.camera.zenith_offset) == pytest.approx(
        (float(np.mean(header.zenith_gain)), float(np.mean(header.zenith_offset))), rel=1e-5
    )
    np.testing.assert_array_equal(rig.references()[0], header.dark)


def test_only_its_own_rig_file_is_replaced(tmp_path: Path) -> None:
    with EmulatedRig(**SMALL) as rig:
        path = rig.write(tmp_path, "tcp://127.0.0.1:1")
        rig.write(tmp_path, "tcp://127.0.0.1:2")
        assert tomllib.loads(path.read_text())["camera"]["source"].endswith(":2")
        path.write_text("# mine\n")
        with pytest.raises(InputError, match="did not write"):
            rig.write(tmp_path, "tcp://127.0.0.1:3")
        (tmp_path / "file").write_text("")
        with pytest.raises(InputError, match="cannot be written"):
            rig.write(tmp_path / "file" / "below", "tcp://127.0.0.1:4")
    assert path.read_text() == "# mine\n"


def test_its_files_are_removed_when_it_ends(tmp_path: Path) -> None:
    with EmulatedRig(**SMALL) as rig:
        rig.write(tmp_path / "rig", "tcp://127.0.0.1:1")
        assert {path.name for path in (tmp_path / "rig").iterdir()} == {"rig.toml", "bright.npy"}
    assert list((tmp_path / "rig").iterdir()) == []


def test_another_users_picture_is_kept(tmp_path: Path) -> None:
    (tmp_path / "bright.npy").write_bytes(b"mine")
    with EmulatedRig(**SMALL) as rig, pytest.raises(InputError, match=r"bright\.npy exists"):
        rig.write(tmp_path, "tcp://127.0.0.1:1")
    assert (tmp_path / "bright.npy").read_bytes() == b"mine"


def test_a_rig_that_cannot_be_leaves_nothing_running(running) -> None:
    with pytest.raises(InputError, match="delay"):
        running(delay=-1.0)


@pytest.mark.parametrize(("every", "late"), [(2, math.inf), (7, 0.05)])
def test_a_sweep_with_lost_or_late_frames_has_the_right_positions(running, clock, every, late) -> None:
    rig = running(delay=0.02)
    rig.camera.lateness = lambda number: late if number % every == 0 else 0.0
    camera = structs.replace(rig.settings.camera, delay=0.02, dark=16.0)
    settings = replace(rig.settings, camera=camera)
    with Rig(rig.open_stage(settings.stage), rig.camera, settings, clock) as opened:
        with SweepScan(opened, VerticalPlan(0.0, 1.0, speed=1.0)) as scan:
            while scan.read(np.empty((8, *SMALL["shape"]), np.uint8)) is not None:
                pass
        number, arrival = (np.concatenate(frame) for frame in zip(*scan._frames, strict=True))
        sound = np.flatnonzero(number % every)[0]  # a frame in time
        exposed = arrival[sound] - 0.02 + (number - number[sound]) / SMALL["rate"]
        true = np.array([rig.where(float(at)).travel for at in exposed])
    assert abs(scan.positions()["travel"] - true).max() < (0.005 if late == math.inf else late)
    assert (scan.dropped > 0) == (late == math.inf)
