"""``mirrorskin capture`` from the command line to the file, on an emulated rig, on simulated time."""

import re
import signal

import numpy as np
import pytest
from commands import done, refused, run
from injected_faults import failing
from mishaps import state_of
from simulated import simulated_rig
from stacks import record, sphere

from mirrorskin import io
from mirrorskin.hw.rig import rig as rigs
from mirrorskin.hw.stages.grbl import GrblStage
from mirrorskin.twin import Axial

SHAPE = (24, 32)


@pytest.fixture(scope="module")
def emulated(tmp_path_factory):
    """The rig's file; its emulators run as long as the tests of this module."""
    with simulated_rig(tmp_path_factory.mktemp("rig"), SHAPE, rate=40.0, delay=0.02) as served:
        yield served


def capture(emulated, *words):
    return run("capture", *words, "--rig", emulated[1])


def test_a_press_in_steps_becomes_a_recording(emulated, tmp_path):
    path = tmp_path / "press.h5"
    words = ("--stop", "1mm", "--step", "500um", "--settle", "0s", "--frames", "2")
    ended = capture(emulated, "vertical", "-o", path, *words)
    assert ended.code == 0, ended.said
    assert re.fullmatch(rf"{path}: 6 frames of 32 x 24 at \d+\.?\d* Hz, 0 dropped, \d+ late\n", ended.out)
    assert ended.said == ""
    with io.open_recording(path) as recording:
        assert recording.shape == (6, *SHAPE)
        assert recording.state == "complete"
        assert list(recording.travel) == [0, 0, 0.5, 0.5, 1, 1]
        assert recording.header.dark is not None
        assert recording.header.bright is not None


def test_strokes_become_a_recording_of_which_heights_and_hysteresis_are_made(emulated, tmp_path):
    path = tmp_path / "strokes.h5"
    words = (
        "--stop",
        "1mm",
        "--strokes",
        "4",
        "--stroke-depth",
        "0.8mm",
        "--step",
        "0.4mm",
        "--settle",
        "0.1s",
    )
    ended = capture(emulated, "vertical", "-o", path, *words)
    assert ended.code == 0, ended.said
    with io.open_recording(path) as recording:
        travel = [0.2, 0.6, 1.0, 0.6, 0.2, 0.6, 1.0, 0.6, 0.2]
        np.testing.assert_allclose(recording.travel, travel)
    assert run("reconstruct", path, "-o", tmp_path / "heights.h5").code == 0
    result = io.open_result(tmp_path / "heights.h5")
    assert np.nanmax(result.strokes) >= 2
    assert np.nanmedian(abs(result.hysteresis)) < 0.05


def test_a_slide_in_steps_becomes_a_recording(emulated, tmp_path):
    path = tmp_path / "slide.h5"
    words = ("--press", "0.5mm", "--distance", "0.4mm", "--direction", "90deg", "--step", "0.2mm")
    ended = capture(emulated, "horizontal", "-o", path, *words, "--wait", "0s", "--settle", "0s")
    assert ended.code == 0, ended.said
    with io.open_recording(path) as recording:
        assert recording.motion == "horizontal"
        assert recording.state == "complete"
        np.testing.assert_allclose(recording.displacement, [[0, 0], [0, 0.2], [0, 0.4]])
        assert recording.header.press == 0.5
        assert recording.read(np.empty((3, *SHAPE), np.uint8)).frames.max() > 100


def test_a_rocking_body_becomes_a_recording_with_a_tilt_of_each_frame(emulated, tmp_path):
    path = tmp_path / "rock.h5"
    words = ("--rock", "--press", "0.5mm", "--tilt", "3deg", "--step", "3deg", "--phase", "90deg")
    ended = capture(emulated, "axial", "-o", path, *words, "--settle", "0s")
    assert ended.code == 0, ended.said
    with io.open_recording(path) as recording:
        assert recording.motion == "axial"
        np.testing.assert_allclose(np.degrees(recording.tilt), [-3, 0, 3], atol=1e-12)
        np.testing.assert_allclose(recording.phase, np.pi / 2)
        assert recording.header.tilt is None
        np.testing.assert_array_equal(
            recording.read(np.empty((2, *SHAPE), np.uint8)).tilt, recording.tilt[:2]
        )
    assert "-3 to 3 deg" in run("info", path).out


def test_of_a_rig_that_rocks_the_slope_is_known_along_that_direction(tmp_path):
    path, folder = tmp_path / "rock.h5", tmp_path / "rig"
    words = ("--rock", "--press", "0.8mm", "--tilt", "3deg", "--step", "1deg", "--settle", "0s")
    with simulated_rig(folder, SHAPE, rate=40.0, delay=0.02, pattern="linear") as served:
        ended = capture(served, "axial", "-o", path, *words)
        truth = served[0].twin(Axial([0.0], np.radians(3), 0.8)).truth
    assert ended.code == 0, ended.said
    done("reconstruct", path, "-o", tmp_path / "slope.h5")
    slope = io.open_result(tmp_path / "slope.h5").slope
    assert np.count_nonzero(np.isfinite(slope)) > 30
    off = slope + np.tan(truth.zenith) * np.cos(truth.azimuth)
    assert np.nanmedian(abs(off)) < 0.05


def test_a_twist_without_a_halt_becomes_a_recording(emulated, tmp_path):
    path = tmp_path / "twist.h5"
    words = ("--press", "0.5mm", "--angle", "-10deg", "--speed", "5deg/s", "--wait", "0s")
    ended = capture(emulated, "twist", "-o", path, *words)
    assert ended.code == 0, ended.said
    with io.open_recording(path) as recording:
        assert recording.motion == "twist"
        assert (recording.twist[0], recording.twist[-1]) == pytest.approx((0, np.radians(-10)), abs=0.01)
        assert np.all(np.diff(recording.twist) <= 0)


def test_a_rotation_without_a_halt_becomes_a_recording(emulated, tmp_path):
    path = tmp_path / "turn.h5"
    ended = capture(emulated, "axial", "-o", path, "--press", "1mm", "--rate", "0.5", "--compression", "lzf")
    assert ended.code == 0, ended.said
    assert "late; frames 20.0 ms after their exposure" in ended.out
    with io.open_recording(path) as recording:
        assert recording.state == "complete"
        assert recording.header.press == 1
        assert np.all(np.diff(recording.phase) >= 0)
        assert (recording.phase[0], recording.phase[-1]) == pytest.approx((0.0, 6.28), abs=0.1)


def test_a_capture_that_is_cut_short_reports_what_it_kept(emulated, tmp_path, monkeypatch):
    path = tmp_path / "short.h5"
    rig, _ = emulated
    appended = io.StreamRecorder.read

    def read(recorder, out=None, /):
        if recorder.count > 10:
            raise io.InputError("the disk is full: make room")
        return appended(recorder, out)

    monkeypatch.setattr(io.StreamRecorder, "read", read)
    ended = capture(emulated, "vertical", "-o", path, "--stop", "2mm", "--speed", "0.5mm/s")
    assert ended.code == 1
    kept = re.fullmatch(rf"mirrorskin: .* full: make room; {path} .* holds (\d+) frames\n", ended.said)
    assert kept is not None, ended.said
    with io.open_recording(path) as recording:
        assert recording.shape[0] == int(kept[1])
        assert recording.state.startswith("cut short")
    assert not rig.machine.moving()


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
@pytest.mark.parametrize("command", ["capture", "live"])
@pytest.mark.parametrize("seconds", [0, 0.15])
def test_a_signal_cuts_a_recording_short(emulated, tmp_path, monkeypatch, name, command, seconds):
    read, halt = io.StreamRecorder.read, GrblStage.stop
    signalled = []

    def stop(stage):
        emulated[0].clock.sleep(seconds)
        halt(stage)
        emulated[0].clock.sleep(seconds)

    def read_and_signal(recorder, out=None, /):
        if recorder.count > 10 and not signalled:
            signalled.append(name)
            signal.raise_signal(getattr(signal, name))
        return read(recorder, out)

    monkeypatch.setattr(GrblStage, "stop", stop)
    monkeypatch.setattr(io.StreamRecorder, "read", read_and_signal)
    path = tmp_path / "short.h5"
    words = "vertical", "--stop", "2mm", "--speed", "0.5mm/s", "--rig", emulated[1]
    ended = run(command, *words, "--record" if command == "live" else "-o", path)
    assert ended.code == 128 + getattr(signal, name)
    assert re.match("cut short: (stopped by the user|the program was ended)$", state_of(path))
    assert not emulated[0].machine.moving()


STEPS = ("--stop", "1mm", "--step", "500um", "--settle", "0s")


def fail_at(monkeypatch, count):
    """Let captures fail when so many frames are there."""
    read = io.StreamRecorder.read

    def fail(recorder, out=None, /):
        if recorder.count >= count:
            raise io.InputError("the camera is lost: plug it in")
        return read(recorder, None if out is None else out[:1])

    monkeypatch.setattr(io.StreamRecorder, "read", fail)


@pytest.fixture
def older(tmp_path):
    """A recording that is to stay, and its bytes."""
    path = record(sphere(), tmp_path / "older.h5")
    return path, path.read_bytes()


def test_a_capture_over_a_recording_is_refused_before_anything_moves(emulated, older, monkeypatch):
    monkeypatch.setattr(rigs, "open_rig", None)
    ended = capture(emulated, "vertical", "-o", older[0], *STEPS)
    assert ended.code == 2
    assert ended.said == (
        f"mirrorskin: {older[0]} exists and is a recording: add --overwrite to replace it, or choose another"
        " name with -o\n"
    )
    assert older[0].read_bytes() == older[1]


def test_a_capture_that_is_complete_replaces_a_recording_where_that_is_asked_for(emulated, older):
    ended = capture(emulated, "vertical", "-o", older[0], *STEPS, "--overwrite")
    assert ended.code == 0, ended.said
    assert ended.out.startswith(f"{older[0]}: 3 frames")
    with io.open_recording(older[0]) as recording:
        assert (recording.shape, recording.state) == ((3, *SHAPE), "complete")
    assert list(older[0].parent.iterdir()) == [older[0]]


def test_a_capture_that_fails_at_its_first_frame_leaves_a_recording(emulated, older, monkeypatch):
    fail_at(monkeypatch, 0)
    ended = capture(emulated, "vertical", "-o", older[0], *STEPS, "--overwrite")
    assert (ended.code, ended.said) == (2, "mirrorskin: the camera is lost: plug it in\n")
    assert older[0].read_bytes() == older[1]
    assert list(older[0].parent.iterdir()) == [older[0]]


def test_a_capture_that_is_cut_short_leaves_a_recording_and_names_its_own(emulated, older, monkeypatch):
    fail_at(monkeypatch, 2)
    ended = capture(emulated, "vertical", "-o", older[0], *STEPS, "--overwrite")
    partial = older[0].with_name("older-partial.h5")
    assert ended.code == 1
    assert ended.said == (
        f"mirrorskin: the camera is lost: plug it in; {partial} was cut short and holds 2 frames;"
        f" the older {older[0]} is unchanged\n"
    )
    assert older[0].read_bytes() == older[1]
    with io.open_recording(partial) as recording:
        assert recording.state == "cut short: the camera is lost: plug it in"


def test_a_file_that_fails_ends_a_capture_in_a_line(emulated, tmp_path):
    words = ("vertical", "--stop", "1mm", "--step", "500um", "--settle", "0s", "-o")
    with failing("read") as calls:
        assert capture(emulated, *words, tmp_path / "sound.h5").code == 0
    for number in range(0, calls.count, 1 + calls.count // 8):
        path = tmp_path / f"{number}.h5"
        with failing("read", number):
            ended = capture(emulated, *words, path)
        where = f"{number} of {calls.count}: {ended}"
        if ended.code:
            assert ended.code in (1, 2), where
            assert re.fullmatch("mirrorskin: .+\n", ended.said), where
        assert re.fullmatch("complete|cut short: .*", state_of(path) or "complete"), where
        assert not list(tmp_path.glob("*.part")), where
        assert not emulated[0].machine.moving(), where


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["vertical", "--stop", "9mm", "--step", "1mm"], "beyond the axis"),
        (["axial", "--press", "1mm", "--tilt", "20deg", "--rate", "1"], "exceeds the maximum"),
        (["vertical", "--stop", "1mm", "--speed", "50mm/s"], "too fast"),
        (["axial", "--press", "1mm", "--rate", "50"], "too fast for pitch and roll"),
        (["axial", "--press", "1mm", "--rate", "1", "--turns", "1e300"], "turns are too many"),
        (["vertical", "--step", "1mm"], "--stop is missing"),
        (["axial", "--rate", "1"], "--press is missing"),
        (["vertical", "--stop", "1mm"], "either a step"),
        (["vertical", "--stop", "1mm", "--step", "1mm", "--speed", "1mm/s"], "either a step"),
        (["vertical", "--stop", "1mm", "--speed", "1mm"], "write e.g. 0.5mm/s"),
        (["vertical", "--stop", "1mm", "--speed", "1mm/s", "--settle", "1s"], "needs a motion with stops"),
        (["vertical", "--stop", "1mm", "--speed", "1mm/s", "--frames", "2"], "needs a motion with stops"),
        (["vertical", "--stop", "1mm", "--step", "1mm", "--settle", "-1s"], "at least 0"),
        (
            ["vertical", "--stop", "1mm", "--step", "1mm", "--press", "1mm"],
            "--press applies to rotations, rocking motions, slides and twists only; this is a press",
        ),
        (["vertical", "--stop", "1mm", "--step", "1mm", "--stroke-depth", "1mm"], "needs --strokes"),
        (
            ["vertical", "--stop", "1mm", "--step", "1mm", "--strokes", "2", "--stroke-depth", "9mm"],
            "beyond the axis",
        ),
        (["vertical", "--stop", "1mm", "--step", "1mm", "--strokes", "99999"], "strokes are not possible"),
        (["horizontal", "--press", "1mm", "--step", "1mm"], "--distance is missing"),
        (["horizontal", "--press", "1mm", "--distance", "5mm", "--step", "1mm"], "5 mm of x is beyond"),
        (["horizontal", "--press", "1mm", "--distance", "1mm", "--speed", "9mm/s"], "too fast"),
        (["twist", "--press", "1mm", "--step", "1deg"], "--angle is missing"),
        (
            ["axial", "--press", "1mm", "--rock", "--rate", "1"],
            "--rate applies to rotations only; this is a rocking motion. Remove it",
        ),
        (["axial", "--press", "1mm", "--rock", "--tilt", "20deg", "--step", "1deg"], "exceeds the maximum"),
        (["twist", "--press", "1mm", "--angle", "60deg", "--step", "1deg"], "60 degrees of twist is beyond"),
        (["twist", "--press", "1mm", "--angle", "9deg", "--speed", "1deg"], "write e.g. 2deg/s"),
        (["twist", "--press", "1mm", "--angle", "9deg", "--step", "1mm"], "--step 1mm"),
        (["twist", "--press", "1mm", "--angle", "9deg", "--step", "1deg", "--wait", "-1s"], "a wait of -1 s"),
    ],
)
def test_a_call_that_cannot_be_opens_nothing(emulated, tmp_path, monkeypatch, words, message):
    monkeypatch.setattr(rigs, "open_rig", None)
    path = tmp_path / "none.h5"
    refused(message, emulated, *words, "-o", path, run=capture)
    assert not path.exists()


def test_a_recording_is_not_written_over_the_rig_file(emulated):
    words = ("vertical", "--stop", "1mm", "--step", "1mm", "-o", emulated[1])
    refused("input", emulated, *words, run=capture)


def test_a_port_that_is_missing_is_one_line(emulated, tmp_path):
    file = tmp_path / "rig.toml"
    text = re.sub(r'port = ".*"', f'port = "{tmp_path}/none"', emulated[1].read_text())
    file.write_text(text.replace('bright = "bright.npy"', ""))
    refused("none", "capture vertical --rig", file, "-o", tmp_path / "a.h5", "--stop", "1mm", "--step", "1mm")


def test_a_stage_that_does_not_home_as_its_file_states_is_refused(emulated, tmp_path):
    rig, file = emulated
    other = file.with_name("home.toml")
    other.write_text(file.read_text().replace("home = false", "home = true"))
    words = ("--rig", other, "-o", tmp_path / "a.h5", "--stop", "1mm", "--step", "1mm")
    refused("set $22=1, or home = false", "capture vertical", *words)
    assert not rig.machine.moving()


def test_contact_is_found_and_the_zero_printed(emulated):
    ended = done("rig probe", emulated[1], "--from", "-1mm", "--step", "0.2mm")
    match = re.search(r"first contact at a travel of (\S+) ± 0.1 mm; .* set zero = (\S+) in", ended.out)
    assert (
        -0.11 <= float(match[1]) <= 0.31
    )  # the sphere's top lies at 0, and its light needs a pixel of contact
    assert float(match[2]) == pytest.approx(emulated[0].settings.stage.travel.coordinate(float(match[1])))


def test_contact_from_the_start_is_refused(emulated):
    ended = run("rig probe", emulated[1], "--from", "2.5mm", "--step", "0.1mm")
    assert ended.code == 1
    assert "no contact between travels of 2.5 and 3 mm" in ended.said
