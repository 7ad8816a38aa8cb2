import random
import signal
import time

import mishaps
import pytest
import soak

ATTEMPTS = 5  # a machine that is busy with other things may be too late for the emulators


@pytest.mark.parametrize("seed", soak.seeds())
@pytest.mark.parametrize("what", mishaps.INSIDE)
def test_the_stage_stops_and_what_was_taken_is_kept(what, seed, tmp_path):
    start = time.monotonic()
    path = tmp_path / "cut.h5"
    outcome = mishaps.capture_with(what, seed, path)
    state = mishaps.state_of(path)
    assert not outcome.moved_at
    if outcome.happened:
        assert outcome.seconds < mishaps.PATIENCE
        assert state is None or state.startswith("cut short: ")
    else:  # all was done before
        assert state == "complete"
    if what == "Ctrl-C":
        assert not outcome.happened or isinstance(outcome.error, KeyboardInterrupt)
    frames = 0 if state is None else len(mishaps.frames_of(path))
    soak.ROUNDS.append(soak.Round(what, seed, frames, 0, time.monotonic() - start))


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    """An emulated rig that stays, and its rig file."""
    with mishaps.make_rig(0, rate=20.0) as rig, rig.serve() as server:
        rig.camera.take(1, 30)
        file = rig.write(tmp_path_factory.mktemp("rig"), server.url)
        file.write_text(file.read_text() + "delay = 0.0\n")  # not to be measured each time; see mishaps.Child
        yield rig, file


@pytest.mark.real_time
@pytest.mark.parametrize("seed", soak.seeds())
@pytest.mark.parametrize("what", ["SIGKILL", "SIGTERM", "disk full"])
def test_a_capture_that_ends_leaves_a_recording_that_opens(what, seed, served, tmp_path):
    chance, start, (rig, file) = random.Random(seed), time.monotonic(), served
    for attempt in range(ATTEMPTS):
        folder = tmp_path / str(attempt)
        folder.mkdir()
        child = mishaps.Child(
            folder, file, mishaps.words(chance), mishaps.FULL if what == "disk full" else None
        )
        sent = end(child, what, chance)
        text = child.wait()
        if not mishaps.starved(text):
            break

    state = mishaps.state_of(child.recording)
    if what == "SIGKILL":
        assert child.process.returncode == -signal.SIGKILL
        assert state == "cut short: its writer was killed"
    elif what == "SIGTERM":
        assert child.process.returncode == 128 + signal.SIGTERM, text
        assert state == "cut short: the program was ended"
        assert not rig.machine.moving(sent + mishaps.SOON)
    else:
        assert not rig.machine.moving()
        assert child.process.returncode == 1, text
        assert "disk is full" in text
        assert "Traceback" not in text
        assert state.startswith("cut short: ")
    mishaps.rest(rig)
    frames = len(mishaps.frames_of(child.recording))
    soak.ROUNDS.append(soak.Round(what, seed, frames, 0, time.monotonic() - start))


def end(child, what, chance):
    """Send a signal at some moment, or none where the disk is full; return when that was."""
    if what != "disk full" and mishaps.has_frames(child):
        time.sleep(chance.uniform(0, 1))
        child.process.send_signal(getattr(signal, what))
    return time.monotonic()
