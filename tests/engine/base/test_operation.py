"""Operations of users: NumPy's answer, for any source of frames and any division into blocks."""

import inspect
import re
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from live_frames import PIXEL, paced, press_header
from stacks import TRAVEL, MadeUp, random_stack, record

from mirrorskin import engine, io
from mirrorskin.engine.base.options import Option
from mirrorskin.engine.live import LiveRun, Loop

FRAMES = random_stack("uint16", (8, 5, 7))
HEADER = io.Header("vertical", pixel_size=(0.5, 0.6))
FRAME = FRAMES[0].nbytes


class Moments(engine.Operation):
    """The sum of the frames, and of each times its travel, in floats in the order of the frames."""

    factor: float = engine.option(
        default=1.0, unit="mm", within=(0, 10), help="what each travel is multiplied by"
    )

    def start(self, shape, dtype):
        self.total, self.moment = np.zeros(shape, np.uint64), np.zeros(shape, np.float32)
        self.pushes = []

    def push(self, frames, *, travel):
        self.total += frames.sum(axis=0, dtype=np.uint64)
        for frame, at in zip(frames, travel, strict=True):
            self.moment += np.float32(self.factor) * np.float32(at) * frame
        self.pushes.append(len(frames))

    def result(self):
        return {"total": self.total, "moment": self.moment, "longest": max(self.pushes)}


def stack():
    return MadeUp(FRAMES, HEADER, travel=TRAVEL)


def same(actual, expected):
    assert {name: values.dtype for name, values in actual.items()} == {
        name: values.dtype for name, values in expected.items()
    }
    for name, values in expected.items():
        np.testing.assert_array_equal(actual[name], values)


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
    moments = Moments(memory_limit=2 * at_once * FRAME)
    with io.open_recording(tmp_path / "rec.h5") as recording:
        result = engine.run(recording, moments)
    assert result.process["longest"] == min(at_once, 8)
    same(result, whole)


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
        result = engine.run(recording, Mixed)
    io.save_result(result, tmp_path / "res.h5")
    stored = io.open_result(tmp_path / "res.h5")
    assert stored.process == result.process
    assert (stored.process["operation"], stored.process["count"]) == ("Mixed", 8)
    assert stored.process["factor"] == 1.0
    assert {"source_fingerprint", "date", "version"} < set(stored.process)
    assert stored.height.dtype == stored.normals.dtype == np.float32
    same(stored, result)
    assert list(stored) == ["height", "normals", "light"]
    np.testing.assert_array_equal(stored.x, result.x)


def test_maps_that_are_not_built_in_are_exported_and_displayed(tmp_path):
    result = engine.run(FRAMES, Moments, travel=TRAVEL)
    io.export_result(result, tmp_path / "maps.npz")
    with np.load(tmp_path / "maps.npz") as arrays:
        same({name: arrays[name] for name in result}, result)
    assert result.to_xarray().total.dims == ("y", "x")
    assert "total" in repr(result)


def test_select_turn_includes_maps_that_are_not_built_in():
    turns = io.Result(zenith=np.zeros((2, 5, 7), np.float32), total=FRAMES[:2])
    np.testing.assert_array_equal(io.select_turn(turns, 1)["total"], FRAMES[1])


def test_levels_that_are_not_given_are_those_of_the_recording(tmp_path):
    frames = np.full((6, 1, 2), 10, np.uint8)
    frames[3:] = 30  # light, if the recording's levels are used
    header = io.Header("vertical", dark=np.float32(10), bright=np.float32(40))
    result = engine.run(MadeUp(frames, header, travel=0.1 * np.arange(6)), engine.Onset(noise=1.0))
    assert result.status.tolist() == [[1, 1]]
    assert result.process["bright"] == 40.0


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
def test_a_kernel_of_the_user_s_gives_the_same_as_numpy(device, tmp_path, dtype):
    page = (Path(__file__).parents[3] / "docs" / "operations.md").read_text(encoding="utf-8")
    exec(re.findall(r"^```python\n(.*?)^```", page, re.DOTALL | re.MULTILINE)[-1], namespace := {})
    frames = random_stack(dtype)
    record(MadeUp(frames, HEADER, travel=TRAVEL), tmp_path / "rec.h5")
    sums = np.add.accumulate(frames, axis=0, dtype=np.float32)[-1]
    above = (frames.astype(np.float32) - 5) * np.float32(len(frames)) > sums
    height = np.where(above.any(axis=0), -TRAVEL[above.argmax(axis=0)], np.nan).astype(np.float32)
    assert np.isfinite(height).any()
    for at_once in (1, 3, 100):
        with io.open_recording(tmp_path / "rec.h5") as recording:
            limit = 2 * at_once * frames[0].nbytes
            result = engine.run(recording, namespace["FirstLight"](device=device, memory_limit=limit))
        np.testing.assert_array_equal(result.height, height)
    assert result.process["device"] == device.info.title


def test_live_updates_hold_the_heights_so_far_and_the_result_all_of_them():
    class Heights(Moments):
        def result(self):
            return {"height": self.moment, "contact": self.total > 0}

    source, updates = paced(FRAMES, press_header(), TRAVEL), []
    live = LiveRun(source, Heights())
    live.precompile()
    Loop(source, live, updates=1e3, on_update=lambda update, status: updates.append(update)).run()
    assert [update.frames for update in updates] == [*range(1, 9)]
    for update in updates:
        so_far = engine.run(FRAMES[: update.frames], Heights, travel=TRAVEL[: update.frames])
        np.testing.assert_array_equal(update.height, so_far.height)
        assert update.contact_area == pytest.approx(np.count_nonzero(so_far.contact) * PIXEL**2)
    np.testing.assert_array_equal(live.result().height, so_far.height)


class Shown(Moments):
    """An operation with a display of its own."""

    optional_maps = ("gloss",)
    gloss = io.Map("gloss of the surface", "1/mm", title="Gloss")
    moment = io.Map("sum of frames times travel", "mm")
    steps = io.Map("number of frames", axes="none", dtype="int64")

    def preview(self, seconds):
        return {"gloss": self.moment, "moment": self.total, "steps": self.count, "note": "so far"}

    def result(self):
        return {**super().result(), "steps": self.count}


def updates_of(operation):
    source, updates = paced(FRAMES, press_header(), TRAVEL), []
    live = LiveRun(source, operation)
    live.precompile()
    Loop(source, live, updates=1e3, on_update=lambda update, status: updates.append(update)).run()
    return updates


def test_live_updates_hold_maps_of_any_name_with_their_declarations():
    for update in updates_of(Shown()):
        assert list(update.maps) == ["gloss", "moment", "steps"]
        assert update.first == "gloss"
        assert update.maps.declaration("gloss").unit == "1/mm"
        assert update.maps.numbers() == {"steps": update.frames}
        total = FRAMES[: update.frames].sum(axis=0).astype(np.float32)
        np.testing.assert_array_equal(update.moment, total)  # later frames have not changed it
        assert update.height is None
        assert update.contact_area is None
        with pytest.raises(AttributeError, match="the result has no map wear: it has gloss, moment, steps"):
            _ = update.wear


def test_without_a_preview_live_updates_hold_the_maps_of_the_result():
    last = updates_of(Moments())[-1]
    same(last.maps, engine.run(FRAMES, Moments, travel=TRAVEL))


def test_a_preview_that_contradicts_a_declaration_is_refused():
    class Odd(Shown):
        def preview(self, seconds):
            return {"gloss": np.zeros(3)}

    with pytest.raises(
        io.InputError, match=r"Odd.preview\(\): map gloss is float64 \(3,\): numbers \(5, 7\)"
    ):
        updates_of(Odd())


def test_the_function_of_an_operation_has_its_name_docstring_positions_and_options():
    class SumOfAll(Moments):
        """Sum of all frames.

        See `Moments`.
        """

        def push(self, frames, *, travel, pose=None):
            super().push(frames, travel=travel)

    sum_of_all = engine.function_of(SumOfAll)
    assert sum_of_all.__name__ == "sum_of_all"
    assert str(inspect.signature(sum_of_all)).startswith("(frames, travel, pose=None, *, factor=1.0, ")
    assert sum_of_all.__doc__.startswith("Sum of all frames.\n\nSee `Moments`.\n\nParameters\n")
    assert "pose : array_like, (T, 4), optional\n" in sum_of_all.__doc__
    same(sum_of_all(FRAMES, TRAVEL), engine.run(FRAMES, Moments, travel=TRAVEL))
    doubled = sum_of_all(FRAMES, TRAVEL, factor=2.0)
    np.testing.assert_array_equal(doubled.moment, engine.run(FRAMES, Moments(factor=2), travel=TRAVEL).moment)


@pytest.mark.parametrize(
    ("call", "error", "line"),
    [
        (lambda: engine.function_of(Moments)(FRAMES), TypeError, "travel"),
        (lambda: engine.function_of(Moments)(FRAMES, TRAVEL, factr=2), TypeError, "did you mean factor?"),
        (lambda: engine.function_of(engine.Press), io.InputError, "Press is not a class of operations"),
        (lambda: engine.function_of(Moments()), io.InputError, "Moments is not a class of operations"),
    ],
)
def test_what_a_function_of_an_operation_cannot_use_is_refused(call, error, line):
    with pytest.raises(error, match=re.escape(line)):
        call()


class Bare(engine.Operation):
    """Nothing but what an operation must have."""

    def push(self, frames):
        pass

    def result(self):
        return {}


def returning(value):
    return type("Odd", (Bare,), {"result": lambda self: value})


def pushing(push):
    return type("Turned", (Bare,), {"push": push})


@pytest.mark.parametrize(
    ("operation", "line"),
    [
        (print, "print is not an operation: derive the class from mirrorskin.engine.Operation"),
        (object(), "object is not an operation"),
        (pushing(lambda self, frames, *, phase: None), "made up: phase is missing: Turned needs it"),
        (returning(None), r"Odd.result\(\) returns a NoneType. Return maps by name"),
        (returning({"a": np.zeros(3)}), r"Odd.result\(\): map a is float64 \(3,\): numbers \(5, 7\)"),
        (returning({"a": np.full((5, 7), "x")}), r"map a is <U1"),
        (returning({"a/b": FRAMES[0]}), "a map cannot be called 'a/b'"),
        (returning({"x": FRAMES[0]}), "a map cannot be called 'x'"),
        (
            type("Turning", (Bare,), {"motions": ("axial",)}),
            "vertical motion, but Turning needs axial motion",
        ),
    ],
)
def test_what_is_not_an_operation_is_refused_in_a_line(operation, line):
    with pytest.raises(io.InputError, match=line) as refusal:
        engine.run(stack(), operation)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({"factr": 2.0}, "Moments has no option factr: did you mean factor?"),
        ({"factor": "2"}, "factor is '2': a number is needed"),
        ({"factor": 11.0}, "factor 11.0: a number in mm from 0 to 10 is needed"),
        ({"factor": np.nan}, "factor nan: a number in mm"),
    ],
)
def test_impossible_options_are_refused_in_a_line(options, line):
    with pytest.raises(io.InputError, match=line):
        Moments(**options)


@pytest.mark.parametrize(
    ("frames", "positions", "line"),
    [
        (iter([]), {}, "there are no frames"),
        ("press.h5", {}, "frames are a str: open a path with io.open_recording"),
        (None, {}, "frames are a NoneType"),
        (FRAMES, {}, "travel is missing: Moments needs it of each frame"),
        (FRAMES, {"travel": TRAVEL[:7]}, r"travel has shape \(7,\) for 8 frames: give one of each frame"),
        (iter(FRAMES), {"travel": TRAVEL[:7]}, r"travel has shape \(7,\) for 8 frames or more: give one"),
        (iter(FRAMES), {"travel": [*TRAVEL, 1.0]}, r"travel has shape \(9,\) for 8 frames: give one"),
        (FRAMES, {"travel": TRAVEL, "phase": TRAVEL}, "Moments has no position phase: it has travel"),
        (FRAMES, {"travl": TRAVEL}, r"Moments has no position travl: did you mean travel\?"),
        (FRAMES[0], {"travel": TRAVEL}, r"frames are uint16 \(5, 7\)"),
        (["text"], {"travel": TRAVEL}, "frames is a list: numbers are needed"),
        (iter([FRAMES[0], FRAMES[0, 1:]]), {"travel": TRAVEL}, r"frames are uint16 \(1, 4, 7\)"),
        ([FRAMES[0], FRAMES[0, 1:]], {"travel": TRAVEL}, "frames is not an array"),
    ],
)
def test_frames_that_cannot_be_pushed_are_refused_in_a_line(frames, positions, line):
    with pytest.raises(io.InputError, match=line):
        engine.run(frames, Moments, **positions)


class Twice(engine.Operation):
    """How often a pixel is above its mean, which takes two passes."""

    @property
    def passes(self):
        return 2

    def start(self, shape, dtype):
        self.total, self.above, self.mean = np.zeros(shape), np.zeros(shape, np.int32), None

    def start_second_pass(self):
        self.mean = self.total / self.count

    def push(self, frames):
        if self.mean is None:
            self.total += frames.sum(axis=0)
        else:
            self.above += (frames > self.mean).sum(axis=0, dtype=np.int32)

    def result(self):
        return {"above": self.above}


@pytest.mark.parametrize("at_once", [1, 3, 100])
def test_an_operation_of_two_passes_reads_a_recording_twice(tmp_path, at_once):
    record(stack(), tmp_path / "rec.h5")
    with io.open_recording(tmp_path / "rec.h5") as recording:
        result = engine.run(recording, Twice(memory_limit=2 * at_once * FRAME))
    np.testing.assert_array_equal(result["above"], np.sum(np.mean(FRAMES, axis=0) < FRAMES, axis=0))
    same(engine.run(FRAMES, Twice), result)
    same(engine.run(iter(FRAMES), Twice), result)


def test_two_passes_are_refused_by_what_is_read_once_and_live():
    source = stack()
    source.rewindable = False
    with pytest.raises(io.InputError, match="can be read only once, but Twice needs all frames twice"):
        engine.run(source, Twice)
    with pytest.raises(io.InputError, match="Twice needs all frames twice, so it cannot run live"):
        LiveRun(paced(FRAMES, press_header(), TRAVEL), Twice())


def test_live_what_an_operation_needs_is_checked_before_anything_moves():
    class Turned(Moments):
        def push(self, frames, *, phase):
            pass

    with pytest.raises(io.InputError, match=r"Turned needs phase. While the body moves, .* has time, travel"):
        LiveRun(paced(FRAMES, press_header(), TRAVEL), Turned())


def test_a_map_declared_in_the_class_is_written_with_its_unit_and_legend(tmp_path):
    class Wear(Moments):
        wear = io.Map("depth of the wear", "mm", quantity="height", displayed="µm")
        material = io.Map("material", codes={0: "unknown", 1: "steel"}, undefined=0)

        def result(self):
            return {"wear": self.moment, "wear_sigma": self.moment / 10, "material": self.total > 9}

    result = engine.run(FRAMES, Wear, travel=TRAVEL)
    io.save_result(result, tmp_path / "wear.h5")
    read = io.open_result(tmp_path / "wear.h5")
    np.testing.assert_array_equal(read.height_sigma, result.wear_sigma)
    assert read.declaration("wear_sigma").unit == "mm"
    assert read.declaration("material").codes == {0: "unknown", 1: "steel"}


def declared(**attributes):
    """Return a class of operations with some attributes; annotations are those of numbers."""
    kinds = {name: float for name, value in attributes.items() if isinstance(value, Option)}
    body = {"push": lambda self, frames: None, "result": lambda self: {}, "__annotations__": kinds}
    body["__module__"] = __name__
    return type("Own", (engine.Operation,), body | attributes)


def number(default=1.0, **settings):
    return engine.option(default=default, **{"help": "a number"} | settings)


@pytest.mark.parametrize(
    ("attributes", "line"),
    [
        (lambda: {"count": number(unit="mm")}, "an option cannot have the name count"),
        (lambda: {"shape": number()}, "an option cannot have the name shape"),
        (lambda: {"passes": number()}, "an option cannot have the name passes"),
        (lambda: {"option_values": number()}, "an option cannot have the name option_values"),
        (lambda: {"version": number()}, "an option cannot have the name version"),
        (lambda: {"least": number(5.0, within=(0, 1))}, "least 5.0: a number from 0 to 1 is needed"),
        (lambda: {"least": number(within=(5, 1))}, "least: no value is within 5 and 1"),
        (lambda: {"least": number(help=" ")}, "least has no help"),
        (lambda: {"least": number(unit="furlong")}, "least has the unit 'furlong'. Use one of share"),
        (
            lambda: {"kind": number("c"), "__annotations__": {"kind": Literal["a", "b"]}},
            "Own: unknown kind 'c'. Use a or b",
        ),
        (lambda: {"passes": 3}, "passes is 3"),
        (lambda: {"motions": ("up",)}, r"motions is \('up',\). Use a tuple of vertical"),
        (lambda: {"motions": "vertical"}, "motions is 'vertical'. Use a tuple"),
        (
            lambda: {"rise": io.Map("rise", "mm"), "__annotations__": {"rise": float}},
            "rise is an option and a map",
        ),
    ],
)
def test_an_impossible_class_is_refused_where_it_is_defined(attributes, line):
    with pytest.raises(io.InputError, match=line) as caught:
        declared(**attributes())
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("annotation", [float, "float"])
def test_a_whole_number_as_the_default_of_a_float_is_a_number(annotation):
    operation = declared(level=number(5), __annotations__={"level": annotation})
    assert operation(level=2.5).level == 2.5


def test_options_are_read_only():
    moments = Moments(factor=2)
    with pytest.raises(AttributeError, match="factor is an option of Moments, which is read-only"):
        moments.factor = 3
    assert moments.factor == 2


def test_it_is_shown_with_the_options_that_are_given():
    assert repr(Moments(factor=2)) == "Moments(factor=2.0)"
    assert repr(Moments()) == "Moments()"


@pytest.mark.parametrize(
    ("returned", "line"),
    [
        ({}, "returns no map"),
        ({"note": "none"}, "returns no map"),
        ({"light": np.zeros((5, 7)), "level": 99.0}, "returns level, which has a meaning already"),
        ({"light": np.zeros((5, 7)), "program": "mine"}, "returns program, which has a meaning already"),
    ],
)
def test_impossible_results_are_refused_in_a_line(returned, line):
    operation = declared(result=lambda self: returned, level=number())
    with pytest.raises(io.InputError, match=line) as caught:
        engine.run(FRAMES, operation)
    assert "\n" not in str(caught.value)


def test_arrays_have_the_pixel_size_that_is_given():
    result = engine.run(FRAMES, Moments, travel=TRAVEL, pixel_size=(0.5, 0.6))
    x, y = io.pixel_axes((5, 7), (0.5, 0.6))
    np.testing.assert_array_equal(result.x, x)
    np.testing.assert_array_equal(result.y, y)


@pytest.mark.parametrize(
    ("positions", "line"),
    [
        (
            {"travel": TRAVEL, "factor": 2.0},
            r"factor is an option: give it to the class, Moments\(factor=...\)",
        ),
        ({"pixel_size": 0.5}, "is a recording: give pixel_size to io.open_recording"),
    ],
)
def test_what_is_not_of_each_frame_is_refused_with_its_place(tmp_path, positions, line):
    with io.open_recording(record(stack(), tmp_path / "own.h5")) as recording:
        frames = recording if "pixel_size" in positions else FRAMES
        with pytest.raises(io.InputError, match=line):
            engine.run(frames, Moments, **positions)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: engine.find_onset(np.zeros((3, 2, 2), np.uint8), [0, 1, 2], zenith_gain=200.0),
            r"find_onset\(\) has no argument zenith_gain: it is an option of rotations: engine.reconstruct",
        ),
        (lambda: engine.Onset(treshold=0.5), "Onset has no option treshold: did you mean threshold?"),
        (lambda: io.open_recording("a.h5", dark=3), "it is an option of presses: .*; or part of a recording"),
        (lambda: io.open_recording("a.h5", pixelsize=3), "did you mean pixel_size?"),
    ],
)
def test_an_argument_of_something_else_names_where_it_belongs(call, message):
    with pytest.raises((TypeError, io.InputError), match=message):
        call()
