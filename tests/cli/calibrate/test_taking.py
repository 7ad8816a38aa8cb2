"""Recordings for a calibration, captured on an emulated rig whose user follows the prompts."""

import dataclasses
import io as texts
import json

import numpy as np
import pytest
from commands import done, run
from reference_frames import expose, source
from simulated import simulated_rig
from stacks import record

from mirrorskin import io
from mirrorskin.cli.commands.calibrate import inputs
from mirrorskin.hw import AxialPlan, VerticalPlan
from mirrorskin.hw.rig import rig as rigs

SHAPE = (12, 16)


@pytest.fixture(scope="module")
def rig_file(tmp_path_factory):
    """The rig's file; its emulators run as long as the tests of this module."""
    with simulated_rig(tmp_path_factory.mktemp("rig"), SHAPE, rate=60.0, delay=0.01) as served:
        yield served[1]


@pytest.fixture
def enter(monkeypatch):
    """Let the user press Enter so many times, and then go home."""
    return lambda times: monkeypatch.setattr("sys.stdin", texts.StringIO(times * "\n"))


def test_each_place_is_asked_for_and_becomes_a_recording_next_to_the_calibration(
    rig_file, tmp_path, enter, capsys
):
    enter(2)
    places = [
        inputs.Place("dark", "take everything off", inputs.still_plan(rig_file), frames=3),
        inputs.Place("ball-1", "put the ball at place 1 of 1", AxialPlan(0.5, 0.04, 1.0, np.pi / 2)),
    ]
    dark, ball = inputs.take(rig_file, tmp_path / "cal.h5", places, settle="0s")
    text = capsys.readouterr().err
    assert text.splitlines() == [
        "take everything off, then press Enter",
        "put the ball at place 1 of 1, then press Enter",
    ]
    assert (dark, ball) == (tmp_path / "cal-dark.h5", tmp_path / "cal-ball-1.h5")
    with io.open_recording(dark) as recording:
        assert recording.state == "complete"
        assert recording.shape == (6, *SHAPE)
        assert np.ptp(recording.travel) == pytest.approx(0.05)
    with io.open_recording(ball) as recording:
        assert recording.motion == "axial"
        assert recording.shape[0] == 4


def test_who_does_not_press_enter_takes_nothing(rig_file, tmp_path, enter):
    enter(0)
    words = ("--rig", rig_file, "-o", tmp_path / "cal.h5", "--frames", "2")
    ended = run("calibrate references", *words)
    assert ended.code == 130
    assert not list(tmp_path.iterdir())


def test_a_recording_is_taken_in_the_place_of_another_only_where_that_is_asked_for(
    rig_file, tmp_path, enter, monkeypatch
):
    enter(1)
    older = tmp_path / "cal-dark.h5"
    _record_flat_field(older)
    before = older.read_bytes()
    places = [inputs.Place("dark", "take everything off", inputs.still_plan(rig_file), frames=3)]
    with monkeypatch.context() as patch:
        patch.setattr(rigs, "open_rig", None)
        with pytest.raises(io.InputError, match="exists and is a recording: add"):
            inputs.take(rig_file, tmp_path / "cal.h5", places, settle="0s")
    assert older.read_bytes() == before
    inputs.take(rig_file, tmp_path / "cal.h5", places, settle="0s", overwrite=True)
    with io.open_recording(older) as recording:
        assert recording.shape == (6, *SHAPE)


def test_references_are_taken_until_their_noise_is_as_stated(rig_file, tmp_path, enter):
    enter(9)
    bright = tmp_path / "bright.h5"
    _record_flat_field(bright)
    path = tmp_path / "cal.h5"
    words = ("--rig", rig_file, "--bright", bright, "-o", path, "--noise", "0.45", "--frames", "4", "--json")
    ended = done("calibrate references", *words)
    report = json.loads(ended.out)
    assert report["dark"]["frames"] > 4
    assert report["dark"]["sigma"] <= 0.45
    assert ended.said.count("press Enter") >= 2
    calibration = io.open_calibration(path)
    np.testing.assert_allclose(np.nanmedian(calibration.references.dark), 16, atol=0.3)
    assert (tmp_path / "cal-dark.h5").exists()
    assert (tmp_path / "cal-dark-2.h5").exists()


def test_nothing_moves_for_a_plan_beyond_the_rig(rig_file, tmp_path, enter, monkeypatch):
    monkeypatch.setattr(rigs, "open_rig", None)
    enter(1)
    places = [inputs.Place("ball", "put the ball in place", VerticalPlan(8.0, 9.0, 1.0))]
    with pytest.raises(io.InputError, match="beyond the axis"):
        inputs.take(rig_file, tmp_path / "cal.h5", places)


def _record_flat_field(path):
    flat = source(expose(np.full(SHAPE, 220.0), 1.5, 32))
    flat.header = dataclasses.replace(flat.header, camera="")
    record(flat, path)
