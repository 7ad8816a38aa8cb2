"""Classes derived from built-in ones: what they override, and defaults that they change, count everywhere."""

from __future__ import annotations

import inspect
import math

import numpy as np
import pytest
from bare import Parts
from commands import done
from live_frames import press_header
from operations import CASES, PRESS, TRAVEL, Readable
from stacks import record

from mirrorskin import engine, io
from mirrorskin.engine.base.operation import Plan
from mirrorskin.engine.live import LiveRun, Stream
from mirrorskin.engine.press.press import HoleFilling

pytestmark = pytest.mark.filterwarnings("ignore::mirrorskin.io.MirrorskinWarning")
EACH = pytest.mark.parametrize("name", CASES)
ONCE = pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.make().passes == 1])
WITH_PREVIEW = pytest.mark.parametrize("name", ["Strokes", "LastTurn", "MovingNormals", "Slip"])


def with_own_result(kind):
    """Return a class whose result is marked."""

    class Own(kind):
        def result(self):
            result = super().result()
            if isinstance(result, io.Result):
                return result.assign(process={**result.process, "own": True})
            return {**result, "own": True}

    return Own


def with_own_height(kind):
    """Return a class whose result is one map of sevens."""

    class Sevens(kind):
        def result(self):
            return {"height": np.full(self.shape, 7.0)}

    return Sevens


def counting(kind):
    """Return a class that counts the frames since it was started."""

    class Counting(kind):
        def start(self, shape, dtype):
            super().start(shape, dtype)
            self.total = 0

        def push(self, frames, **options):
            super().push(frames, **options)
            self.total += len(frames)

    return Counting


def source():
    return Readable(PRESS, press_header(), travel=TRAVEL)


@EACH
def test_runs_return_the_result_of_a_subclass(name):
    case = CASES[name]
    operation = with_own_result(case.kind)(**case.options)
    assert engine.run(case.source(), operation).process["own"] is True
    assert engine.run(case.frames, operation, **case.positions).process["own"] is True
    if operation.passes == 1:
        live = LiveRun(case.source(), operation)
        case.push(live, slice(None))
        assert live.result().process["own"] is True


@WITH_PREVIEW
def test_a_display_shows_the_result_of_a_subclass(name):
    case = CASES[name]
    live = LiveRun(case.source(), with_own_height(case.kind)(**case.options))
    case.push(live, slice(None))
    assert np.all(live.maps()["height"] == 7)


def test_a_command_writes_the_result_of_a_subclass(tmp_path, monkeypatch):
    text = """
        import numpy as np
        from mirrorskin import engine

        class Sevens(engine.Onset):
            def result(self):
                return {"height": np.full(self.shape, 7.0)}
    """
    (tmp_path / "sevens.py").write_text(inspect.cleandoc(text), encoding="utf-8")
    record(source(), tmp_path / "press.h5")
    monkeypatch.chdir(tmp_path)
    done("run sevens.py:Sevens press.h5 -o sevens.h5")
    assert np.all(io.open_result(tmp_path / "sevens.h5").height == 7)


def test_the_result_of_a_base_that_is_no_operation_counts_if_it_comes_first():
    class Sevens:
        def result(self):
            return {"height": np.full(self.shape, 7.0)}

    class Own(Sevens, engine.Onset):
        pass

    assert np.all(engine.run(source(), Own).height == 7)


def test_the_result_of_the_last_of_several_subclasses_counts():
    class Own(with_own_height(engine.Onset)):
        def result(self):
            return {"height": np.full(self.shape, 8.0)}

    class Last(Own):
        def result(self):
            return {"height": np.full(self.shape, 9.0)}

    assert np.all(engine.run(source(), Last).height == 9)


@EACH
def test_each_run_starts_a_subclass_anew(name):
    case = CASES[name]
    operation = counting(case.kind)(**case.options)
    source = Parts(case.frames, operation, case.positions, ())
    for _ in range(2):
        run = engine.Run(operation.plan(source), source)
        run.complete()
        assert run.operation.total == run.operation.passes * len(case.frames)


@ONCE
def test_the_frames_of_warming_are_forgotten_by_a_subclass(name):
    case = CASES[name]
    live = LiveRun(case.source(), counting(case.kind)(**case.options))
    live.precompile()
    case.push(live, slice(0, 4))
    assert live.operation.total == 4


class Halved(engine.Press):
    """A press whose heights are halved."""

    def plan(self, source):
        plan = super().plan(source)
        return Plan(plan.operation, [*plan.steps, Half()], plan.process, plan.frames)


class Half(engine.Step):
    def apply(self, result, context):
        return result.assign(height=result.height / 2)


def test_a_live_run_follows_the_plan_of_a_subclass():
    options = {"dark": 16.0, "bright": 224.0, "noise": 1.0}
    with Stream(Halved(**options), PRESS.shape[1:], latency=math.inf) as stream:
        stream.push(PRESS, travel=TRAVEL)
        result = stream.result()
    expected = engine.find_onset(PRESS, TRAVEL, **options)
    np.testing.assert_array_equal(result.height, expected.height / 2)
    assert result.process["frames"] == len(PRESS)


# Defaults


class Early(engine.Onset):
    threshold = 0.3


class EarlyPress(engine.Press):
    threshold = 0.3


def test_an_assigned_value_is_the_default_of_an_option():
    assert (Early().threshold, Early(threshold=0.4).threshold, engine.Onset().threshold) == (0.3, 0.4, 0.5)


def test_a_changed_default_is_computed_with():
    expected = engine.run(source(), engine.Onset(threshold=0.3))
    np.testing.assert_array_equal(engine.run(source(), Early).height, expected.height)


def test_a_changed_default_of_a_method_is_computed_with():
    expected = engine.Press(threshold=0.3).run(source())
    np.testing.assert_array_equal(EarlyPress().run(source()).height, expected.height)


@pytest.mark.parametrize("run", [lambda: engine.run(source(), Early), lambda: EarlyPress().run(source())])
def test_a_changed_default_is_written_to_the_process(run):
    assert run().process["threshold"] == 0.3


@pytest.mark.parametrize("kind", [Early, EarlyPress])
def test_help_shows_a_changed_default(kind):
    assert inspect.signature(kind).parameters["threshold"].default == 0.3
    assert "threshold : float, share, default 0.3" in inspect.getdoc(kind)


def test_a_command_computes_with_changed_defaults_and_shows_them(tmp_path, monkeypatch):
    text = """
        from mirrorskin import engine

        class Early(engine.Onset):
            threshold, dark = 0.3, 17
    """
    (tmp_path / "early.py").write_text(inspect.cleandoc(text), encoding="utf-8")
    record(source(), tmp_path / "press.h5")
    monkeypatch.chdir(tmp_path)
    done("run early.py:Early press.h5 -o early.h5")
    process = io.open_result(tmp_path / "early.h5").process
    assert (process["threshold"], process["dark"]) == (0.3, 17.0)
    assert "0.3" in done("run early.py:Early --help").out


def test_a_value_is_converted_as_one_that_is_given():
    class Whole(engine.Onset):
        threshold = 1
        noise: float | None = 2

    assert [type(value) for value in (Whole().threshold, Whole().noise)] == [float, float]


def test_a_changed_default_may_be_set_to_none_where_the_option_may_be():
    class Leaning(engine.Normals):
        tilt = 0.05

    assert (Leaning().tilt, Leaning(tilt=None).tilt) == (0.05, None)


@pytest.mark.parametrize(
    ("base", "changes", "line"),
    [
        (engine.Onset, {"threshold": 2}, r"Own: threshold 2: a share from 0 to 1 is needed, such as 0\.5$"),
        (engine.Onset, {"threshold": "0.3"}, r"Own: threshold is '0\.3': a number is needed$"),
        (engine.Onset, {"threshold": None}, "Own: threshold is None: a number is needed$"),
        (engine.Onset, {"hold": 2.5}, r"Own: hold is 2\.5: a whole number is needed$"),
        (engine.Onset, {"event": "both"}, "Own: unknown event 'both'. Use onset or release$"),
        (engine.Press, {"fill": 1}, "Own: fill is 1: use True or False$"),
        (HoleFilling, {"fill": "no"}, "Own: fill is 'no': use True or False$"),
        (engine.Onset, {"threshold": lambda self: 0.3}, "Own: threshold is an option. Assign a value"),
        (engine.slip.SlipOnset, {"contact": property(len)}, "Own: contact is an option. Assign a value"),
        (engine.Onset, {"hold": io.Map("hold", "mm")}, "Own: hold is an option and a map. Rename one"),
    ],
)
def test_an_impossible_default_is_refused_where_the_class_is_defined(base, changes, line):
    with pytest.raises(io.InputError, match=line) as caught:
        type("Own", (base,), changes)
    assert "\n" not in str(caught.value)


def test_a_step_has_the_default_that_a_subclass_assigns():
    class Open(HoleFilling):
        fill = False

    assert Open().fill is False


def test_a_changed_default_is_inherited():
    class Later(Early):
        hold = 3

    assert (Later().threshold, Later().hold) == (0.3, 3)


@pytest.mark.parametrize("plain", [True, False], ids=["a plain class", "an operation"])
def test_with_several_bases_the_first_in_the_order_of_python_decides(plain):
    first = type("First", () if plain else (engine.Onset,), {"threshold": 0.2})
    subclass = type("Own", (first, Early), {})
    assert (subclass().threshold, subclass.options["threshold"].default) == (0.2, 0.2)


def test_a_base_without_a_changed_default_does_not_hide_that_of_the_next():
    subclass = type("Own", (type("Plain", (engine.Onset,), {}), Early), {})
    assert (subclass().threshold, subclass.options["threshold"].default) == (0.3, 0.3)
