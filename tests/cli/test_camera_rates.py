"""Whole runs of ``live`` and ``capture`` with slow and fast cameras: an emulated rig on simulated time."""

import re

import numpy as np
import pytest
from commands import done
from simulated import simulated_rig

from mirrorskin import io

DELAY = 0.02  # seconds
RATES = 20.0, 200.0, 300.0, 1000.0  # frames per second
PRESS = "vertical", "--stop", "1mm", "--speed", "1mm/s"
STEPS = "vertical", "--stop", "1mm", "--step", "500um", "--settle", "0s", "--frames", "3"
TURN = "axial", "--press", "1mm", "--rate", "1"
SLIDE = "horizontal", "--press", "1mm", "--distance", "0.5mm", "--speed", "0.5mm/s", "--wait", "0s"
RIGS = [pytest.param(rate, marks=[pytest.mark.slow] if rate in (200.0, 1000.0) else []) for rate in RATES]


@pytest.fixture
def rig_file(request, tmp_path):
    """The file of a rig whose camera has this rate, and a delay that the file does not give."""
    with simulated_rig(tmp_path / "rig", (24, 32), request.param, DELAY) as (_, file):
        file.write_text(file.read_text().replace(f"\ndelay = {DELAY}\n", "\n"))
        yield file


def recorded(path, series):
    """Return the positions in a complete recording."""
    with io.open_recording(path) as recording:
        assert recording.state == "complete"
        return getattr(recording, series)


@pytest.mark.parametrize("rig_file", RIGS, indirect=True)
def test_a_live_press_is_recorded_and_reconstructed(rig_file, tmp_path, request):
    record, output = tmp_path / "rec.h5", tmp_path / "res.h5"
    done("live", *PRESS, "--latency", "60s", "--rig", rig_file, "--record", record, "-o", output)
    travel = recorded(record, "travel")
    assert len(travel) == pytest.approx(request.node.callspec.params["rig_file"], rel=0.15)
    assert (travel[0], travel[-1]) == pytest.approx((0, 1), abs=0.03)
    assert np.isfinite(io.open_result(output).height).sum() > 100


@pytest.mark.parametrize("rig_file", RIGS, indirect=True)
def test_the_delay_of_the_camera_is_measured(rig_file, tmp_path):
    ended = done("capture", *PRESS, "--rig", rig_file, "-o", tmp_path / "rec.h5")
    delay, error = map(float, re.search(r"; frames (\S+) ms .* \(± (\S+) ms, measured\)", ended.out).groups())
    assert delay == pytest.approx(1e3 * DELAY, abs=0.5 + 3 * error)
    assert 0 < error < 5


@pytest.mark.parametrize("words", [TURN, SLIDE], ids=["turn", "slide"])
@pytest.mark.parametrize(
    "rig_file",
    [pytest.param(rate, marks=[pytest.mark.slow] if rate > min(RATES) else []) for rate in RATES],
    indirect=True,
)
def test_a_rotation_and_a_slide_are_recorded(rig_file, words, tmp_path):
    done("capture", *words, "--rig", rig_file, "-o", tmp_path / "rec.h5")
    end = recorded(tmp_path / "rec.h5", "phase" if words is TURN else "displacement")[-1]
    assert np.linalg.norm(end) == pytest.approx(2 * np.pi if words is TURN else 0.5, rel=0.06)


@pytest.mark.parametrize("rig_file", RIGS, indirect=True)
def test_steps_are_recorded(rig_file, tmp_path):
    done("capture", *STEPS, "--rig", rig_file, "-o", tmp_path / "rec.h5")
    np.testing.assert_allclose(recorded(tmp_path / "rec.h5", "travel"), np.repeat([0, 0.5, 1], 3))
