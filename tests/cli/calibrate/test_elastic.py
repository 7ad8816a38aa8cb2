"""`mirrorskin calibrate elastic`: from a ball's press to a gel in a file."""

import json
from pathlib import Path

import numpy as np
import pytest
from commands import done, refused, run
from stacks import record

from mirrorskin import io
from mirrorskin.cli.commands.calibrate import inputs
from mirrorskin.engine.calibration import gel as gel_module
from mirrorskin.hw import VerticalPlan
from mirrorskin.twin import Axial, Camera, Sphere, Twin, Vertical


def twin(movement, **options):
    return Twin(
        object=Sphere(4.0),
        shape=(56, 56),
        pixel_size=0.09,
        movement=movement,
        camera=Camera(noise=1.0, seed=2),
        **options,
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("presses")
    press = Vertical(np.arange(0, 1.2, 0.04), compliance=0.02)
    record(twin(press, contact="elastic"), folder / "ball.h5")
    record(twin(Axial(np.arange(8) * np.pi / 4, 0.04, 0.5)), folder / "turn.h5")
    return folder


@pytest.fixture(autouse=True)
def here(folder, tmp_path):
    for path in folder.iterdir():
        (tmp_path / path.name).symlink_to(path)


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """The fit, which has tests of its own, is known beforehand."""

    def fit(presses, sheet):
        assert [press.radius for press in presses] == [2.0]
        assert sheet == 0.05
        sigma = {"threshold": 0.003, "compliance": 0.01, "travel_zero": 0.002}
        gel = io.Gel(0.21, 0.02, travel_zero=0.01, error=0.004, sigma=sigma)
        places = (gel_module.BallPlace(0.0, 0.0, 0.01, len(presses[0].travel)),)
        return gel_module.GelFit(gel, places, ("curvature",))

    monkeypatch.setattr(gel_module, "fit_gel", fit)


def test_a_ball_becomes_a_gel_in_the_file_and_is_printed_in_a_line():
    ended = done("calibrate elastic ball.h5 --ball 4mm -o cal.h5")
    assert ended.out.startswith("cal.h5: bright from ")
    assert len(ended.out.splitlines()) == 1
    assert "curvature: not determined by the presses" in ended.said
    calibration = io.open_calibration("cal.h5")
    assert calibration.gel.threshold == 0.21
    assert calibration.camera.shape == (56, 56)
    assert calibration.process["elastic.ball"] == "4mm"
    assert calibration.process["elastic.sources"] == "ball.h5"
    assert calibration.process["elastic.pixel_size_x"] == pytest.approx(
        calibration.process["elastic.pixel_size_y"]
    )
    again = run("calibrate elastic ball.h5 --ball 4mm -o cal.h5 --json")
    report = json.loads(again.out)
    assert report["gel"]["threshold"] == pytest.approx(calibration.gel.threshold)
    assert report["balls"][0]["pixels"] > 200


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ("", "no recordings"),
        ("ball.h5 --rig rig.toml", "leave one of them out"),
        ("ball.h5 --press 1mm", "--press applies to presses on a rig"),
        ("ball.h5 --sheet -1mm", "--sheet -1mm: a thickness must not be negative"),
        ("turn.h5", "axial motion"),
        ("none.h5", "none.h5"),
    ],
)
def test_what_cannot_be_learned_from_is_refused_in_a_line(words, complaint):
    Path("rig.toml").touch()
    refused(complaint, f"calibrate elastic {words} --ball 4mm -o cal.h5")


def test_a_rig_presses_the_ball_at_each_place(monkeypatch):
    asked = []

    def take(rig, calibration, places, settle, overwrite):
        asked.extend(places)
        raise io.InputError("stop here")

    monkeypatch.setattr(inputs, "take", take)
    Path("rig.toml").touch()
    words = ["--rig", "rig.toml", "--places", "2", "--press", "0.9mm", "--travel-step", "0.05mm"]
    ended = run("calibrate elastic --ball 4mm -o cal.h5", *words)
    assert "stop here" in ended.said
    assert [place.name for place in asked] == ["elastic-1", "elastic-2"]
    assert asked[0].plan == VerticalPlan(0.0, 0.9, step=0.05)
