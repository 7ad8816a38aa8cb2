"""What stages tell each other is in ``fitted``: no answer depends on ``process``, which is displayed."""

from __future__ import annotations

import ast
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from stacks import record

import mirrorskin
from mirrorskin import engine, io
from mirrorskin.engine.base.undistort import undistort
from mirrorskin.twin import Axial, Body, Camera, Horizontal, SheetTexture, Sphere, Twin, Vertical

PIXEL, SHAPE = 0.1, (50, 52)
BALL = {"object": "sphere", "shape": SHAPE, "pixel_size": PIXEL}
REGION = io.Region((3, 47), (5, 49))


@cache
def press():
    return Twin(movement=Vertical(0.1 * np.arange(1, 31)), **BALL)


@cache
def turn():
    movement = Axial(np.pi / 4 * np.arange(8), tilt=0.05, press=1.5)
    return Twin(movement=movement, pattern="linear", **BALL)


@cache
def slide():
    path = np.stack([np.linspace(0, 0.3, 7), np.zeros(7)], axis=1)
    return Twin(
        object=Sphere(6.0),
        shape=(80, 80),
        pixel_size=0.07,
        movement=Horizontal(path, 0.7),
        contact="elastic",
        optics="cylinder",
        body=Body(modulus=0.12, friction=0.6),
        camera=Camera(noise=1.0, seed=1),
        texture=SheetTexture(size=0.28),
    )


@cache
def results():
    """Return results of all kinds that other functions take."""
    pressed, turned = engine.reconstruct(press()), engine.reconstruct(turn())
    return {
        "press": pressed,
        "turn": turned,
        "registered": engine.reconstruct(turn(), heights=pressed),
        "fused": engine.fuse(press(), turn()),
        "fused results": engine.fuse(pressed, turned),
        "slide": engine.reconstruct(slide()),
    }


def of_a_region(folder):
    press().rewind()
    with io.open_recording(record(press(), folder / "press.h5"), region=REGION) as source:
        return engine.reconstruct(source)


def without_process(result, folder):
    return result.assign(process={})


def saved(result, folder):
    io.save_result(result.assign(process={}), folder / "saved.h5", overwrite=True)
    return io.open_result(folder / "saved.h5")


def as_dataset(result, folder):
    pytest.importorskip("xarray")
    dataset = result.assign(process={}).to_xarray()
    return io.Result.from_xarray(dataset).assign(calibration=result.calibration)


@pytest.fixture(params=[without_process, saved, as_dataset])
def bare(request, tmp_path):
    """Return a function that empties the process of a result, also after it was saved."""
    return lambda result: request.param(result, tmp_path)


def assert_equal(result, expected):
    assert list(result) == list(expected)
    for name, values in expected.items():
        np.testing.assert_array_equal(result[name], values, err_msg=name)
    assert result.fitted == expected.fitted


def scored_and_measured(name, result):
    truth = {"press": press, "slide": slide}.get(name, turn)().truth
    quantities = None if name == "slide" else engine.measure(result).quantities
    return repr(engine.score(result, truth).parts()), repr(quantities)


@cache
def expected_of(name):
    return scored_and_measured(name, results()[name])


@cache
def fused_with(name):
    return engine.fuse(results()["press"], results()[name])


@pytest.mark.parametrize("name", ["press", "turn", "registered", "fused", "fused results", "slide"])
def test_scores_and_measures_do_not_read_the_process(bare, name):
    result = results()[name]
    assert bare(result).fitted == result.fitted
    assert scored_and_measured(name, bare(result)) == expected_of(name)


def test_registered_maps_are_those_of_the_object_whichever_way_they_are_kept(bare):
    for name, compared in (("turn", True), ("registered", False), ("fused", False)):
        score = engine.score(bare(results()[name]), turn().truth)
        assert (score.contact is not None) == compared


@pytest.mark.parametrize("name", ["turn", "registered", "fused"])
def test_a_fusion_of_results_does_not_read_the_process(bare, name):
    assert_equal(engine.fuse(bare(results()["press"]), bare(results()[name])), fused_with(name))


def test_a_registration_with_heights_does_not_read_the_process(bare):
    result = engine.reconstruct(turn(), heights=bare(results()["press"]))
    assert_equal(result, results()["registered"])


def test_motions_and_stitched_touches_do_not_read_the_process(bare):
    assert results()["fused"].fitted.tilt == 0.05
    first, right = results()["fused"], results()["fused"].assign(x=results()["fused"].x + 0.3)
    actual, expected = (engine.pose.stitch(pair) for pair in ((bare(first), bare(right)), (first, right)))
    assert_equal(actual.result, expected.result)
    actual, expected = ([str(replace(pose, notes=())) for pose in each.poses] for each in (actual, expected))
    assert actual == expected
    pairs = (bare(first), bare(right)), (first, right)
    actual, expected = (replace(engine.pose.estimate_pose(*pair), notes=()) for pair in pairs)
    assert str(actual) == str(expected)


def test_forces_and_slip_do_not_read_the_process(bare):
    pressed = results()["press"].with_fitted(travel=1.5)
    assert_equal(*(engine.force.find_force(touched, modulus=0.1) for touched in (bare(pressed), pressed)))
    contact = io.Result(contact=slide().truth.contact)
    actual, expected = (engine.reconstruct(slide(), contact=touched) for touched in (bare(contact), contact))
    assert_equal(actual, expected)
    for undistorted in (contact.with_fitted(undistorted=True), bare(contact.with_fitted(undistorted=True))):
        with pytest.raises(io.InputError, match="the contact is undistorted"):
            engine.reconstruct(slide(), contact=undistorted)


def test_maps_of_a_region_are_undistorted_without_the_process(bare, tmp_path):
    result = of_a_region(tmp_path)
    camera = np.array([[0.1, 0.001, -2.55], [0.0, -0.1, 2.45], [0.0, 1e-4, 1.0]])
    lens = io.Lens((PIXEL, PIXEL), camera, np.zeros(5), np.eye(3), SHAPE, 0.0)
    actual, expected = undistort(bare(result), lens), undistort(result, lens)
    assert_equal(actual, expected)
    assert result.fitted.region == REGION
    for once in (expected, bare(expected)):
        with pytest.raises(io.InputError, match="which is done once"):
            undistort(once, lens)
        with pytest.raises(io.InputError, match="the result is undistorted"):
            engine.score(once, press().truth)


class Blind(engine.Step):
    """A step that gets no process, except for findings."""

    def __init__(self, step):
        super().__init__()
        self.step = step

    def apply(self, result, context):
        kept = {name: result.process[name] for name in ("warnings", "notes") if name in result.process}
        applied = self.step.apply(result.assign(process=kept), context)
        return applied.assign(process={**result.process, **applied.process})


def blind(method):
    """Return a class of methods whose steps get no process."""

    class Blinded(method):
        def plan(self, source):
            plan = super().plan(source)
            return replace(plan, steps=[Blind(step) for step in plan.steps])

    return Blinded


@pytest.mark.parametrize(
    ("method", "source"), [(engine.Press, press), (engine.Rotation, turn), (engine.slip.Slide, slide)]
)
def test_steps_do_not_read_the_process(method, source):
    assert_equal(blind(method)().run(source()), method().run(source()))


ENGINE = Path(mirrorskin.engine.__file__).parent
DISPLAYED = {"batch/work.py"}  # what a batch has written itself


def is_process(node):
    return getattr(node, "id", getattr(node, "attr", "")) == "process"


def reads_of_process(path):
    """Yield the lines that read a value of a process by its name."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        subscript = isinstance(node, ast.Subscript) and isinstance(node.ctx, ast.Load)
        call = isinstance(node, ast.Attribute) and node.attr == "get"
        inside = isinstance(node, ast.Compare) and isinstance(node.ops[0], ast.In | ast.NotIn)
        if ((subscript or call) and is_process(node.value)) or (inside and is_process(node.comparators[0])):
            yield node.lineno


def test_no_module_of_the_engine_reads_values_of_a_process():
    files = {path.relative_to(ENGINE).as_posix(): path for path in ENGINE.rglob("*.py")}
    assert len(files) > 100
    reads = {name: [*reads_of_process(path)] for name, path in files.items()}
    assert {name for name, lines in reads.items() if lines} == DISPLAYED


def test_what_an_operation_reports_is_in_fitted_and_displayed():
    class Tilted(engine.Operation):
        brightest = io.Map("largest brightness", "counts")

        def start(self, shape, dtype):
            self.most = np.zeros(shape)

        def push(self, frames):
            np.maximum(self.most, frames.max(axis=0), out=self.most)

        def result(self):
            return {"brightest": self.most, "tilt": np.float32(0.5), "registered": True, "turns": 1.5}

    class Doubled(Tilted):
        def result(self):
            result = super().result()
            return io.Result(brightest=2 * result.pop("brightest")).with_fitted(**result | {"turns": 2})

    result = engine.run(np.ones((3, 4, 5)), Tilted)
    assert result.fitted == io.Fitted(frames=3, tilt=0.5, registered=True)
    assert (result.process["tilt"], result.process["registered"], result.process["turns"]) == (0.5, True, 1.5)
    result = engine.run(np.ones((3, 4, 5)), Doubled)
    assert result.fitted == io.Fitted(frames=3, tilt=0.5, registered=True, turns=2)
    assert result.process["turns"] == 2
