"""``mirrorskin live`` on a rig of fakes, on simulated time."""

import math
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from growing import Feed, stream
from injected_faults import failing
from mcap.reader import make_reader
from mishaps import state_of
from rig_fakes import fake_rig, settings, spreading
from speckle import Speckle

from mirrorskin import engine, io
from mirrorskin.cli.commands import live
from mirrorskin.cli.commands.status import Board, Newest, summary
from mirrorskin.engine.base.reconstruction import load_operation
from mirrorskin.engine.live import SHOWN, Latency, Status
from mirrorskin.hw import HardwareError, Position
from mirrorskin.hw.base import rig_file as file
from mirrorskin.hw.rig import rig
from mirrorskin.kernels.errors import DeviceError

SHAPE, SHAPED = (24, 32), (48, 56)
OFFSET, GAIN = 20.0, 200.0
ALL = ["--latency", "60s"]  # no frame is skipped, even on a busy machine
PRESS = ["vertical", "--stop", "1mm", "--speed", "2mm/s", *ALL]
TURN = ["axial", "--press", "1mm", "--tilt", "2.5deg", "--rate", "2.5", "--turns", "2", *ALL]

app = live.app


def slanted(shape=SHAPE):
    """Return a picture of a plane of zenith 0.3, by eq. 10 to the first order, dark without contact."""
    noise = np.random.default_rng(0).normal(0, 1.0, (16, *shape))

    def picture(place):
        if place.travel < 0.5:
            return np.zeros(shape, np.uint8)
        counts = OFFSET + GAIN * (0.3 + place.pitch)
        return np.clip(np.rint(counts + noise[int(1e6 * abs(place.roll)) % 16]), 1, 254).astype(np.uint8)

    return picture


@pytest.fixture
def fake(clock, monkeypatch, tmp_path):
    """A rig whose file is read and which is opened without hardware; its stage and camera."""

    class Fake:
        def __init__(self):
            self.picture = spreading(SHAPE)
            self.camera_settings = {"pixel_size": (0.05, 0.05), "delay": 0.0, "rate": 60.0}
            self.path = tmp_path / "rig.toml"

        def open(self, message):
            opened = fake_rig(self.picture, clock, rate=60.0)
            opened.settings, self.stage, self.camera = message, opened.stage, opened.camera
            return opened

        def run(self, *words):
            return CliRunner().invoke(app, [*words, "--rig", str(self.path)])

    prepared = Fake()
    prepared.path.touch()
    monkeypatch.setattr(
        file,
        "load_rig",
        lambda path: settings(prepared.picture(Position()).shape, **prepared.camera_settings),
    )
    monkeypatch.setattr(rig, "open_rig", prepared.open)
    return prepared


def counted(text):
    match = re.search(r"(\d+) frames at .* (\d+) used, (\d+) skipped, (\d+) dropped; (\d+) updates", text)
    assert match is not None, text
    return [int(number) for number in match.groups()]


def test_a_press_is_reported_recorded_and_kept(fake, tmp_path):
    record, output = tmp_path / "rec.h5", tmp_path / "res.h5"
    ended = fake.run(*PRESS, "--record", str(record), "-o", str(output))
    assert ended.exit_code == 0, ended.output
    frames, used, skipped, _, updates = counted(ended.output)
    assert used + skipped == frames > 10
    assert updates > 1
    result = io.open_result(output)
    assert np.isfinite(result.height).sum() > 20
    assert result.process["frames"] == used
    with io.open_recording(record, live=True) as recording:
        assert recording.shape[0] == used
    assert fake.stage.closed
    assert fake.camera.closed


def test_frames_and_heights_go_into_an_mcap_file(fake, tmp_path):
    record = tmp_path / "rec.mcap"
    ended = fake.run(*PRESS, "--record", str(record))
    assert ended.exit_code == 0, ended.output
    _, used, skipped, _, updates = counted(ended.output)
    with record.open("rb") as file:
        topics = [message[1].topic for message in make_reader(file).iter_messages()]
    assert topics.count("/camera/image") == used + skipped
    assert 1 <= topics.count("/height") <= updates  # while one is written, others may be missed


def test_strokes_are_joined_and_their_hysteresis_is_reported(fake, tmp_path):
    output = tmp_path / "res.h5"
    words = ["--stop", "1mm", "--stroke-depth", "0.8mm", "--strokes", "4", "--speed", "2.5mm/s", *ALL]
    ended = fake.run("vertical", *words, "-o", str(output))
    assert ended.exit_code == 0, ended.output
    result = io.open_result(output)
    assert result.process["strokes"] == 4
    assert np.isfinite(result.hysteresis).sum() > 20
    assert abs(np.nanmedian(result.hysteresis)) < 0.15, "a light that spreads with travel alone has none"


def test_the_recording_replayed_gives_the_same_onset(fake, tmp_path):
    from mirrorskin.engine import Onset, Run

    record, output = tmp_path / "rec.h5", tmp_path / "res.h5"
    fake.run(*PRESS, "--record", str(record), "-o", str(output))
    with io.open_recording(record, live=True) as recording:
        header = recording.header
        search = Run(Onset(dark=header.dark, bright=header.bright), recording)
        while (block := recording.read(np.empty((7, *SHAPE), np.uint8))) is not None:
            search.push_block(block)
        again = search.result()
    result = io.open_result(output)
    measured = result.filled == 0
    assert measured.sum() > 20
    np.testing.assert_array_equal(again.status, result.status)
    np.testing.assert_array_equal(again.height[measured], result.height[measured])


def test_a_rotation_is_reported_and_kept(fake, tmp_path):
    fake.picture = slanted()
    fake.camera_settings |= {"zenith_gain": math.radians(GAIN), "zenith_offset": OFFSET}
    output = tmp_path / "res.h5"
    ended = fake.run(*TURN, "-o", str(output))
    assert ended.exit_code == 0, ended.output
    result = io.open_result(output)
    assert result.process["window_frames"] == 24
    assert np.degrees(np.median(result.zenith)) == pytest.approx(math.degrees(0.3), abs=1.0)
    assert result.height is not None


def test_rocking_is_reported_recorded_and_kept_and_repeated(fake, tmp_path):
    fake.picture = slanted()
    fake.camera_settings |= {"zenith_gain": math.radians(GAIN), "zenith_offset": OFFSET}
    record, output = tmp_path / "rec.h5", tmp_path / "res.h5"
    words = ["axial", "--rock", "--press", "1mm", "--tilt", "3deg", "--speed", "10deg/s", *ALL]
    ended = fake.run(*words, "--record", str(record), "-o", str(output))
    assert ended.exit_code == 0, ended.output
    assert counted(ended.output)[1] > 20
    result = io.open_result(output)
    assert set(np.unique(result.status)) == {4}
    assert result.height is None
    assert abs(np.median(result.slope)) == pytest.approx(math.tan(0.3), rel=0.03)
    with io.open_recording(record, live=True) as recording:
        again = engine.reconstruct(recording)
    np.testing.assert_array_equal(again.slope, result.slope)
    np.testing.assert_array_equal(again.slope_sigma, result.slope_sigma)


def test_ctrl_c_stops_the_stage_and_keeps_what_there_is(fake, clock, tmp_path):
    record, output = tmp_path / "rec.h5", tmp_path / "res.h5"

    def interrupt():
        while not (hasattr(fake, "stage") and fake.stage.position().travel >= 0.1):
            clock.sleep(0.005)
        clock.interrupt()

    thread = clock.thread(interrupt, "interrupts")
    thread.start()
    words = ["vertical", "--stop", "1.5mm", "--speed", "0.1mm/s", "--record", str(record), "-o", str(output)]
    ended = fake.run(*words)
    thread.join()
    assert ended.exit_code != 0
    assert "cut short" in ended.output
    assert 0.1 <= fake.stage.position().travel < 0.11, "it was stopped on its way"
    assert 0 < io.open_result(output).process["frames"] == counted(ended.output)[1]
    with io.open_recording(record) as recording:
        assert recording.state.startswith("cut short")


def test_a_run_that_is_cut_short_leaves_an_older_recording(fake, tmp_path):
    record = tmp_path / "rec.h5"
    stream(Feed(3), record)
    before = record.read_bytes()
    picture = fake.picture

    def lost(place):
        if place.travel > 0.5:
            fake.camera.lose()
        return picture(place)

    refused = fake.run(*PRESS, "--record", str(record))
    assert isinstance(refused.exception, io.InputError)
    assert not hasattr(fake, "stage")
    fake.picture = lost
    ended = fake.run(*PRESS, "--record", str(record), "--overwrite")
    assert isinstance(ended.exception, HardwareError)
    assert re.search(
        r"rec-partial\.h5 was cut short and holds \d+ frames; the older .*rec\.h5 is unchanged$",
        str(ended.exception),
    )
    assert record.read_bytes() == before
    with io.open_recording(tmp_path / "rec-partial.h5") as recording:
        assert recording.state.startswith("cut short")
    fake.picture = picture
    assert fake.run(*PRESS, "--record", str(record), "--overwrite").exit_code == 0
    with io.open_recording(record) as recording:
        assert recording.state == "complete"


def test_a_camera_that_is_lost_ends_it_with_its_own_complaint(fake, tmp_path):
    output = tmp_path / "res.h5"
    picture = fake.picture

    def lost(place):
        if place.travel > 0.5:
            fake.camera.lose()
        return picture(place)

    fake.picture = lost
    ended = fake.run(*PRESS, "-o", str(output))
    assert isinstance(ended.exception, HardwareError)
    assert fake.stage.stops
    assert "cut short" in ended.output
    assert output.exists()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["device lost", "no resources", "allocation", "read"])
def test_a_call_that_fails_stops_the_stage_and_keeps_what_there_is(fake, tmp_path, kind):
    words = [*PRESS, "--record"]
    with failing(kind) as calls:
        assert fake.run(*words, str(tmp_path / "rec.h5"), "-o", str(tmp_path / "res.h5")).exit_code == 0
    for fraction in (0.1, 0.3, 0.5, 0.7, 0.9):
        record, output = tmp_path / f"rec-{fraction}.h5", tmp_path / f"res-{fraction}.h5"
        with failing(kind, int(fraction * calls.count)):
            ended = fake.run(*words, str(record), "-o", str(output))
        if ended.exit_code:
            expected_errors = (DeviceError, MemoryError, io.InputError, HardwareError)
            assert isinstance(ended.exception, expected_errors), (fraction, ended.exception)
        assert fake.stage.closed
        assert not fake.stage.moving()
        if output.exists():
            io.open_result(output)
        assert re.fullmatch("complete|cut short: .*", state_of(record) or "complete")
        assert not list(tmp_path.glob("*.part"))


def test_a_turn_that_is_cut_short_reports_that_there_is_no_result(fake, tmp_path):
    fake.picture = slanted()
    fake.camera_settings |= {"zenith_gain": math.radians(GAIN), "zenith_offset": OFFSET}
    picture = fake.picture

    def lost(place):
        if place.roll > 0.03:
            fake.camera.lose()
        return picture(place)

    fake.picture = lost
    ended = fake.run(*TURN, "-o", str(tmp_path / "res.h5"))
    assert isinstance(ended.exception, HardwareError)
    assert "no result: " in ended.output
    assert not (tmp_path / "res.h5").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([*PRESS, "--latency", "5mm"], "--latency"),
        ([*TURN, "--window-frames", "60"], "window_frames 60"),
        (["vertical", "--stop", "9mm", "--speed", "1mm/s"], "9"),
        ([*PRESS, "-o", "rig.toml"], "rig.toml"),
        (["axial", "--press", "1mm", "--rate", "40"], "frames a turn"),
        (["axial", "--rock", "--press", "1mm", "--speed", "5deg/s"], "zenith_gain"),
    ],
)
def test_impossible_input_is_one_clear_line(fake, words, message):
    ended = fake.run(*words)
    assert isinstance(ended.exception, io.InputError)
    assert message in str(ended.exception)
    assert "\n" not in str(ended.exception)


class Slow:
    """A viewer that takes its time, or fails."""

    def __init__(self, error=None):
        self.shown, self.closed, self.error = [], False, error
        self.was_let_go = True
        self.go = threading.Event()

    def show(self, update, status):
        self.was_let_go &= self.go.wait(60)
        if self.error:
            raise self.error
        self.shown.append(update)

    def close(self):
        self.closed = True


def test_a_slow_viewer_misses_updates_but_not_the_last_and_delays_nothing():
    viewer = Slow()
    newest = Newest(viewer)
    for number in range(1000):
        newest.show(number, Status())
    viewer.go.set()
    newest.close()
    assert viewer.was_let_go  # nothing waited for it in vain
    assert viewer.closed
    assert viewer.shown[-1] == 999
    assert len(viewer.shown) < 1000


def test_a_viewer_that_fails_does_not_end_the_run():
    viewer = Slow(RuntimeError("no window"))
    viewer.go.set()
    newest = Newest(viewer)
    newest.show(1, Status())
    newest.close()
    newest.show(2, Status())
    assert str(newest.error) == "no window"
    assert viewer.closed


def test_the_status_is_a_table_and_a_line():
    from rich.console import Console

    latency = {SHOWN: Latency(0.0123, 0.0234), "push": Latency(math.nan, math.nan)}
    status = Status(101, 90, 11, 3, 50, 2.0, 49.9, latency)
    board, console = Board(), Console(record=True, width=80, quiet=True)
    console.print(board.render())
    board.tell(status)
    console.print(board.render())
    assert "12.3 ms from frame to map (99 % below 23.4 ms)" in summary(status)
    assert "101 frames at 50 Hz: 90 used, 11 skipped, 3 dropped; 50 updates" in summary(status)
    assert summary(Status()).startswith("0 frames")


def test_ctrl_c_while_frames_are_pushed_comes_after_them():
    guard, pushed, before = live._Guard(), [], signal.getsignal(signal.SIGINT)

    def push():
        with guard.installed():
            with guard():
                signal.raise_signal(signal.SIGINT)
                pushed.append(1)
            pushed.append(2)

    with pytest.raises(KeyboardInterrupt):
        push()
    assert pushed == [1]
    assert signal.getsignal(signal.SIGINT) is before


def test_a_slide_is_reported_recorded_and_kept_and_repeated(fake, tmp_path):
    texture = Speckle(4)

    def picture(place):
        noise = np.random.default_rng(int(1e6 * abs(place.x))).normal(0, 1.0, SHAPED)
        return np.clip(np.rint(texture.frame(SHAPED, -place.x / 0.05, 0.0) + noise), 0, 255).astype(np.uint8)

    fake.picture = picture
    record, output, press = (tmp_path / name for name in ("rec.h5", "res.h5", "press.h5"))
    io.save_result(io.Result(contact=np.ones(SHAPED, np.uint8)), press)
    words = ["horizontal", "--press", "1mm", "--distance", "0.3mm", "--speed", "0.3mm/s", "--wait", "0s"]
    words += ["--contact", str(press), *ALL]
    ended = fake.run(*words, "--record", str(record), "-o", str(output))
    assert ended.exit_code == 0, ended.output
    result = io.open_result(output)
    assert result.process["frames"] == counted(ended.output)[1] > 10
    assert np.nanmedian(result.displacement[..., 0]) == pytest.approx(-0.3, abs=0.02)
    with io.open_recording(record, live=True) as recording:
        again = engine.reconstruct(recording, contact=np.ones(SHAPED, np.uint8))
    np.testing.assert_array_equal(again.displacement, result.displacement)
    np.testing.assert_array_equal(again.slip_onset, result.slip_onset)


OWN = str(Path(__file__).parents[2] / "examples" / "steepest_rise.py") + ":SteepestRise"


@pytest.mark.parametrize(
    ("words", "where", "flags", "options"),
    [
        (PRESS, "engine:Onset", "--dark 0 --bright 255", {"dark": 0, "bright": 255}),
        (
            PRESS,
            "engine:ChangePoint",
            "--dark 0 --bright 200 --noise 1",
            {"dark": 0, "bright": 200, "noise": 1},
        ),
        (
            PRESS,
            "engine.press:Levels",
            "--thresholds 0.2,0.7 --inclinations 0.2rad,0.5rad --dark 0 --bright 255",
            {"thresholds": [0.2, 0.7], "inclinations": [0.2, 0.5], "dark": 0, "bright": 255},
        ),
        (PRESS, "engine.optical:Focus", "--noise 1", {"noise": 1}),
        (TURN, "engine:Correlate", "", {}),
        (TURN, "engine:Normals", "", {"tilt": math.radians(2.5)}),
        (TURN, "engine.optical:Fringes", "--noise 1", {"noise": 1}),
    ],
)
def test_a_built_in_operation_gives_the_same_live_as_over_the_recording(
    fake, tmp_path, words, where, flags, options
):
    if words is TURN:
        fake.picture = slanted()
        fake.camera_settings |= {"zenith_gain": math.radians(GAIN), "zenith_offset": OFFSET}
    record, output = tmp_path / "rec.h5", tmp_path / "res.h5"
    chosen = "--operation", f"mirrorskin.{where}", *flags.split()
    ended = fake.run(*words, *chosen, "--record", str(record), "-o", str(output))
    assert ended.exit_code == 0, ended.stderr
    with io.open_recording(record, live=True) as recording:
        again = engine.run(recording, load_operation(f"mirrorskin.{where}")(**options))
    result = io.open_result(output)
    assert [*result] == [*again]
    for name in again:
        np.testing.assert_array_equal(result[name], again[name], err_msg=name)


def test_an_operation_of_the_user_s_gives_the_same_live_as_over_the_recording(fake, tmp_path):
    record, output = tmp_path / "rec.h5", tmp_path / "res.h5"
    ended = fake.run(*PRESS, "--operation", OWN, "--least", "1", "--record", str(record), "-o", str(output))
    assert ended.exit_code == 0, ended.output
    assert counted(ended.output)[4] > 1
    with io.open_recording(record, live=True) as recording:
        operation = load_operation(OWN)(least=1.0, memory_limit=2 * 7 * int(np.prod(SHAPE)))
        again = engine.run(recording, operation)
    result = io.open_result(output)
    assert np.isfinite(result.height).sum() > 20
    assert result.process["live"]
    assert result.process["least"] == 1.0
    assert result.maps().keys() == {"height", "rise"} == again.maps().keys()
    for name, values in again.maps().items():
        np.testing.assert_array_equal(result.maps()[name], values)


def test_an_operation_of_the_user_s_is_calibrated_and_its_maps_are_pictures(fake, tmp_path):
    calibration, view, output = (tmp_path / name for name in ("cal.h5", "run.rrd", "res.h5"))
    dark, sure = np.full(SHAPE, 10, np.float32), np.full(SHAPE, 0.1, np.float32)
    references = io.References(dark, dark + 200, sure, sure, np.zeros(dark.shape, np.uint8))
    io.save_calibration(
        io.Calibration(io.CameraId("", dark.shape, np.dtype("uint8")), references=references), calibration
    )
    ended = fake.run(
        *PRESS, "--operation", OWN, "--calibration", calibration, "--view", view, "-o", str(output)
    )
    assert ended.exit_code == 0, ended.output
    assert io.open_result(output).process["calibration_parts"] == "references"
    command = [sys.executable, "-m", "rerun_cli", "rrd", "print", str(view)]
    text = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert "/maps/rise" in text
    assert "/maps/height" in text


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([*PRESS, "--operation", OWN, "--hold", "3"], "has no option --hold: it has --least"),
        ([*PRESS, "--operation", f"{OWN}r"], "has no class SteepestRiser: did you mean SteepestRise?"),
        ([*TURN, "--operation", OWN], "but SteepestRise needs vertical motion"),
    ],
)
def test_an_impossible_operation_is_one_clear_line(fake, words, message):
    ended = fake.run(*words)
    assert message in f"{ended.exception} {ended.output}"
    assert ended.exit_code != 0
