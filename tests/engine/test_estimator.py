"""Estimators of users' own: the answer is NumPy's, whatever frames come from and however they are cut."""

import re
from pathlib import Path

import numpy as np
import pytest
from live_frames import PIXEL, paced, press_header
from stacks import TRAVEL, MadeUp, random_stack, record, sphere

from mirrorskin import engine, io
from mirrorskin.engine.live import LiveOwn, Loop

FRAMES = random_stack("uint16", (8, 5, 7))
HEADER = io.Header("vertical", pixel_size=(0.5, 0.6))
FRAME = FRAMES[0].nbytes


class Moments:
    """The sum of the frames, and of each times its travel, in floats of the order of the frames."""

    def __init__(self, shape, dtype, factor=1.0):
        self.total, self.moment = np.zeros(shape, np.uint64), np.zeros(shape, np.float32)
        self.factor, self.pushes = np.float32(factor), []

    def reset(self):
        self.total[:], self.moment[:], self.pushes = 0, 0, []

    def push(self, frames, *, travel):
        self.total += frames.sum(axis=0, dtype=np.uint64)
        for frame, at in zip(frames, travel, strict=True):
            self.moment += self.factor * np.float32(at) * frame
        self.pushes.append(len(frames))

    def result(self):
        return {"total": self.total, "moment": self.moment}


def stack():
    return MadeUp(FRAMES, HEADER, travel=TRAVEL)


def same(found, expected):
    assert {name: values.dtype for name, values in found.items()} == {
        name: values.dtype for name, values in expected.items()
    }
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name], values)


@pytest.fixture(scope="module")
def whole():
    return engine.run(FRAMES, Moments, travel=TRAVEL)


def test_the_answer_is_that_of_numpy(whole):
    np.testing.assert_array_equal(whole["total"], FRAMES.sum(axis=0))
    moment = np.tensordot(TRAVEL, FRAMES.astype(float), 1)
    np.testing.assert_allclose(whole["moment"], moment, rtol=1e-6)


@pytest.mark.parametrize("compression", ["raw", "gzip"])
@pytest.mark.parametrize("at_once", [1, 3, 100])
def test_a_recording_gives_the_same_bits_however_it_is_cut(tmp_path, whole, compression, at_once):
    record(stack(), tmp_path / "rec.h5", compression)
    estimator = Moments((5, 7), np.uint16)
    with io.open_recording(tmp_path / "rec.h5") as recording:
        found = engine.run(recording, estimator, memory_limit=2 * at_once * FRAME)
    assert max(estimator.pushes) == min(at_once, 8)
    same(found, whole)


def test_frames_that_come_one_by_one_give_the_same_bits(whole):
    same(engine.run((frame for frame in FRAMES), Moments, travel=TRAVEL), whole)


def test_a_second_run_begins_anew_and_leaves_the_first_result_alone(whole):
    estimator = Moments((5, 7), np.uint16)
    first = engine.run(FRAMES, estimator, travel=TRAVEL)
    engine.run(FRAMES[:3], estimator, travel=TRAVEL[:3])
    same(first, whole)
    same(engine.run(stack(), estimator), whole)


def test_maps_numbers_and_provenance_are_kept_in_a_file(tmp_path):
    class Mixed(Moments):
        def result(self):
            count = sum(self.pushes)
            normals = np.ones((5, 7, 3))
            return {
                "height": self.moment,
                "normals": normals,
                "light": self.total > 9,
                "count": np.int64(count),
            }

    record(stack(), tmp_path / "rec.h5")
    with io.open_recording(tmp_path / "rec.h5") as recording:
        made = engine.run(recording, Mixed)
    io.save_result(made, tmp_path / "res.h5")
    found = io.open_result(tmp_path / "res.h5")
    assert found.process == made.process
    assert (found.process["estimator"], found.process["count"]) == ("Mixed", 8)
    assert {"source_fingerprint", "date", "version"} < set(found.process)
    assert found.height.dtype == found.normals.dtype == np.float32
    same(found, made)
    assert list(found) == ["height", "normals", "light"]
    np.testing.assert_array_equal(found.x, made.x)


def test_maps_that_are_not_built_in_are_exported_and_displayed(tmp_path):
    made = engine.run(FRAMES, Moments, travel=TRAVEL)
    io.export_result(made, tmp_path / "maps.npz")
    with np.load(tmp_path / "maps.npz") as arrays:
        same({name: arrays[name] for name in made}, made)
    assert made.to_xarray().total.dims == ("y", "x")
    assert "total" in repr(made)


def test_select_turn_includes_maps_that_are_not_built_in():
    turns = io.Result(zenith=np.zeros((2, 5, 7), np.float32), total=FRAMES[:2])
    np.testing.assert_array_equal(io.select_turn(turns, 1)["total"], FRAMES[1])


def test_ours_are_run_as_well(device):
    press = sphere()
    frames = press.read(np.empty(press.shape, press.dtype)).frames.copy()
    onset = engine.find_onset(frames, TRAVEL, device=device)
    found = engine.run(press, engine.OnsetSearch(press.shape[1:], press.dtype, device=device), memory_limit=1)
    np.testing.assert_array_equal(found.height, onset.height)
    np.testing.assert_array_equal(found["frame"], onset.frame)
    assert found.process["noise"] == onset.noise
    assert found.process["device"] == device.info.title


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
def test_a_kernel_of_the_user_s_gives_the_same_as_numpy(device, tmp_path, dtype):
    page = (Path(__file__).parents[2] / "docs" / "estimators.md").read_text(encoding="utf-8")
    exec(re.findall(r"^```python\n(.*?)^```", page, re.DOTALL | re.MULTILINE)[-1], known := {})
    frames = random_stack(dtype)
    record(MadeUp(frames, HEADER, travel=TRAVEL), tmp_path / "rec.h5")
    estimator = known["LightOnDevice"](frames.shape[1:], frames.dtype, device=device)
    light = (frames > 100).sum(axis=0)
    for at_once in (1, 3, 100):
        with io.open_recording(tmp_path / "rec.h5") as recording:
            found = engine.run(recording, estimator, memory_limit=2 * at_once * frames[0].nbytes)
        np.testing.assert_array_equal(found["light"], light)
    assert found.process["device"] == device.info.title


def test_live_updates_hold_the_heights_so_far_and_the_result_all_of_them():
    class Heights(Moments):
        def result(self):
            return {"height": self.moment, "contact": self.total > 0}

    source, updates = paced(FRAMES, press_header(), TRAVEL), []
    live = LiveOwn(source, Heights)
    live.warm()
    Loop(source, live, updates=1e3, on_update=lambda update, status: updates.append(update)).run()
    assert [update.frames for update in updates] == [*range(1, 9)]
    for update in updates:
        so_far = engine.run(FRAMES[: update.frames], Heights, travel=TRAVEL[: update.frames])
        np.testing.assert_array_equal(update.height, so_far.height)
        assert update.contact_area == pytest.approx(np.count_nonzero(so_far.contact) * PIXEL**2)
    np.testing.assert_array_equal(live.result().height, so_far.height)


def test_a_result_that_is_one_already_is_left_as_it_is():
    made = io.Result(height=np.zeros((5, 7), np.float32), process={"mine": 1})
    assert engine.run(stack(), returning(made)) is made


class Bare:
    """Nothing but what an estimator has."""

    def __init__(self, shape=None, dtype=None):
        pass

    def reset(self): ...
    def push(self, frames): ...
    def result(self):
        return {}


def returning(value):
    return type("Odd", (Bare,), {"result": lambda self: value})


def pushing(push):
    return type("Turned", (Bare,), {"push": push})


def without(name):
    return type("Lacking", (Bare,), {name: None})


@pytest.mark.parametrize(
    ("estimator", "line"),
    [
        (without("push"), r"Lacking has no push: an estimator has push\(frames\), result\(\) and reset\(\)"),
        (without("result"), r"Lacking has no result: "),
        (without("reset"), r"Lacking has no reset: "),
        (lambda: None, r"cannot be made: too many positional"),
        (pushing(lambda self, frames, *, phase: None), "Turned.push needs phase: .*travel"),
        (returning(None), r"Odd.result\(\) returns a NoneType: maps by name are needed"),
        (returning({"a": np.zeros(3)}), r"Odd.result\(\): map a is float64 \(3,\): numbers \(5, 7\)"),
        (returning({"a": np.full((5, 7), "x")}), r"map a is <U1"),
        (returning({"a/b": FRAMES[0]}), "a map cannot be called 'a/b'"),
        (returning({"x": FRAMES[0]}), "a map cannot be called 'x'"),
        (returning({"source": "mine"}), "source is said of every result: rename it"),
    ],
)
def test_what_is_no_estimator_is_refused_in_a_line(estimator, line):
    with pytest.raises(io.InputError, match=line) as refusal:
        engine.run(stack(), estimator)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("frames", "known", "line"),
    [
        ([], {}, "there is none"),
        ("press.h5", {}, "frames are a str: open a path with io.open_recording"),
        (None, {}, "frames are a NoneType"),
        (FRAMES, {}, "push needs travel: the frames given has nothing"),
        (FRAMES, {"travel": TRAVEL[:7]}, r"travel has shape \(7,\): one is needed for each of 8"),
        (
            iter(FRAMES),
            {"travel": TRAVEL[:7]},
            r"travel has shape \(7,\): one is needed for each of 8",
        ),
        (FRAMES, {"travel": TRAVEL, "phase": TRAVEL}, "Moments.push takes no phase"),
        (FRAMES[0], {"travel": TRAVEL}, r"frames are uint16 \(5, 7\)"),
        (["text"], {"travel": TRAVEL}, "frames are <U4"),
        ([FRAMES[0], FRAMES[0, 1:]], {"travel": TRAVEL}, r"frames are uint16 \(4, 7\)"),
    ],
)
def test_frames_that_cannot_be_pushed_are_refused_in_a_line(frames, known, line):
    with pytest.raises(io.InputError, match=line):
        engine.run(frames, Moments, **known)
