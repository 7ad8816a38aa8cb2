"""What holds for every operation: the same maps offline and live, and however frames are divided."""

from __future__ import annotations

import numpy as np
import pytest
from operations import CASES, CUTS, Case, engine_classes

from mirrorskin import engine, io
from mirrorskin.engine.live import LiveOperation

EACH = pytest.mark.parametrize("name", CASES)


def whole(case: Case) -> io.Result:
    operation = case.make()
    for number in range(operation.passes):
        if number:
            operation.next_pass()
        case.push(operation, slice(None))
    return operation.result()


def assert_same(found, expected):
    """Hold maps and numbers equal bit by bit."""
    assert list(found) == list(expected)
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name], values, err_msg=name, strict=True)
    numbers = {name: value for name, value in expected.process.items() if isinstance(value, float)}
    assert {name: found.process[name] for name in numbers} == pytest.approx(numbers, nan_ok=True, rel=0)


@EACH
def test_each_map_is_declared_and_each_has_its_standard_deviation_by_name(name):
    found = whole(CASES[name])
    for one in found:
        assert found.declaration(one) is not io.maps.UNDECLARED, one
    deviations = [one.removesuffix("_sigma") for one in found if one.endswith("_sigma")]
    assert set(deviations) <= set(found)


@EACH
@pytest.mark.parametrize("cut", CUTS)
def test_the_result_does_not_depend_on_how_frames_are_divided(name, cut):
    case = CASES[name]
    operation = case.make()
    for number in range(operation.passes):
        if number:
            operation.next_pass()
        for part in CUTS[cut](len(case.frames)):
            case.push(operation, part)
    assert_same(operation.result(), whole(case))


@EACH
def test_result_has_no_side_effects_and_reset_forgets_everything(name):
    case = CASES[name]
    operation, count = case.make(), len(case.frames)
    for part in (slice(0, count // 2), slice(count // 2, count)):
        case.push(operation, part)
        if operation.passes == 1:
            first = operation.result()
            kept = {one: np.copy(values) for one, values in first.items()}
            assert_same(operation.result(), first)
    if operation.passes == 1:
        assert_same(first, first.assign(kept))
    operation.reset()
    for number in range(operation.passes):
        if number:
            operation.next_pass()
        case.push(operation, slice(None))
    assert_same(operation.result(), whole(case))


@EACH
def test_running_it_over_a_recording_gives_the_same(name):
    case = CASES[name]
    found = engine.run(case.source(), case.make())
    assert_same(found, whole(case))
    assert found.process["operation"] == case.kind.__name__
    numbers = {one: value for one, value in case.options.items() if isinstance(value, bool | int | float)}
    chosen = {one: value for one, value in numbers.items() if one not in ("tilt", "noise")}  # estimated
    assert {one: found.process[one] for one in chosen} == chosen


@EACH
def test_the_function_on_arrays_gives_the_same(name):
    case = CASES[name]
    if case.function is None:
        assert case.kind.__name__ in {"Levels", "Strokes", "Normals", "LastTurn", "MovingNormals", "Slip"}
        return
    assert_same(case.function(case.frames, **case.positions, **case.options), whole(case))


@EACH
def test_live_gives_the_same_or_refuses_before_anything_moves(name):
    case, source = CASES[name], CASES[name].source()
    operation = case.make()
    if operation.configured_for(source).passes == 2:
        with pytest.raises(io.InputError, match="twice"):
            LiveOperation(source, operation)
        return
    live = LiveOperation(source, operation)
    live.warm()
    while (block := source.read(live.room[:5])) is not None:
        where = {one: getattr(block, one) for one in live.positions if getattr(block, one) is not None}
        live.push(block.frames, **where)
        live.maps(0.0)
    found = live.result()
    assert found.process["live"] is True
    assert_same(found, whole(case))


@EACH
@pytest.mark.parametrize("wrong", ["shape", "type", "none", "positions"])
def test_frames_that_do_not_fit_are_refused_and_change_nothing(name, wrong):
    case = CASES[name]
    operation, part = case.make(), slice(0, 6)
    case.push(operation, part)
    frames = {"shape": case.frames[part, 1:], "type": case.frames[part].astype(np.int32)}
    frames |= {"none": case.frames[:0], "positions": case.frames[:7]}
    where = {one: values[part] for one, values in case.positions.items()}
    if wrong == "positions" and not where:
        return
    with pytest.raises(io.InputError):
        operation.push(frames[wrong], **where)
    assert operation.count == 6


def test_every_operation_has_a_case():
    operations = (one for one in engine_classes() if issubclass(one, engine.Operation) and one.maps)
    kinds = {one for one in operations if one.push is not engine.Operation.push}
    bases = {base for kind in kinds for base in kind.__mro__[1:]}
    assert kinds - bases <= {case.kind for case in CASES.values()}
