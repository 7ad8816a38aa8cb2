"""Rules for every operation; a test fails if an operation of the engine has no case."""

from __future__ import annotations

import ctypes
import functools
import mmap
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from bare import Parts
from operations import CASES, CUTS, LEVELS, assert_same, engine_classes

from mirrorskin import engine, io
from mirrorskin.engine.base.options import Configured
from mirrorskin.engine.live import LiveRun
from mirrorskin.kernels import memory
from mirrorskin.kernels.errors import DeviceError

pytestmark = pytest.mark.filterwarnings("ignore::mirrorskin.io.MirrorskinWarning")
EACH = pytest.mark.parametrize("name", CASES)
ONCE = pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.make().passes == 1])


def of_type(name, dtype=None):
    case = CASES[name]
    options = (
        {**LEVELS, **case.options} if dtype == "float32" and hasattr(case.kind, "dark") else case.options
    )
    return replace(case, frames=case.frames.astype(dtype or case.frames.dtype), options=options)


@functools.cache
def whole(name, device=None, dtype=None):
    return of_type(name, dtype).whole(device=device)


def reversed_positions(case):
    """Return positions that fit frames in the reverse order."""
    return {name: values[::-1].copy() if name != "travel" else values for name, values in case.given.items()}


def answer(run):
    """Return the result, or None if there are too few frames."""
    try:
        return run.result()
    except io.InputError:
        return None


def content(result):
    """Return all values of a result as bytes."""
    return result and tuple((name, np.asarray(values).tobytes()) for name, values in result.items())


@EACH
def test_maps_are_as_declared_and_each_has_its_standard_deviation_by_name(name):
    case, result = CASES[name], whole(name)
    for label, values in result.items():
        declared = result.declaration(label)
        assert declared is not io.model.maps.UNDECLARED, label
        assert np.asarray(values).dtype == declared.dtype, label
        if declared.axes == "pixels":
            shape = case.frames.shape[1:] + (len(declared.components),) * bool(declared.components)
            assert np.shape(values)[-len(shape) :] == shape, label
            assert np.ndim(values) - len(shape) in (0, 1), label  # 1: of each frame or turn
    assert {label.removesuffix("_sigma") for label in result if label.endswith("_sigma")} <= set(result)


@EACH
@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
def test_the_result_does_not_depend_on_how_frames_are_divided_nor_on_memory(device, name, dtype):
    case = of_type(name, dtype)
    for cuts in CUTS.values():
        ends = [part.stop for part in cuts(len(case.frames))]
        assert_same(case.whole(ends, device=device), whole(name, device, dtype))
    assert_same(case.whole(device=device, memory_limit=1), whole(name, device, dtype))


@ONCE
def test_an_intermediate_result_is_that_of_the_frames_so_far_and_stays(device, name):
    case, earlier = CASES[name], []
    run = case.loop(device=device)
    for part in CUTS["unevenly"](len(case.frames)):
        case.push(run, part)
        result = answer(run)
        assert content(answer(run)) == content(result)
        so_far = case.loop(device=device)
        case.push(so_far, slice(part.stop))
        assert content(answer(so_far)) == content(result)
        earlier.append((result, content(result)))
    assert all(content(result) == before for result, before in earlier)
    assert len({before for _, before in earlier}) > 1


@EACH
def test_an_operation_keeps_nothing_of_a_run(device, name):
    case = CASES[name]
    operation = case.make(device=device)
    before = dict(vars(operation))
    engine.run(case.frames[::-1].copy(), operation, **reversed_positions(case))
    assert {option: vars(operation)[option] for option in before} == before
    assert_same(engine.run(case.frames, operation, **case.given), whole(name, device))


def at(offset, frames):
    """Copy frames to so many bytes behind the begin of a page."""
    buffer = np.zeros(frames.nbytes + 2 * mmap.PAGESIZE, np.uint8)
    placed = np.ndarray(frames.shape, frames.dtype, buffer.data, -buffer.ctypes.data % mmap.PAGESIZE + offset)
    placed[:] = frames
    return placed


def read_only(frames):
    placed = frames.copy()
    placed.flags.writeable = False
    return placed


def before_a_forbidden_page(frames, gap):
    """Copy frames so that so many bytes lie between them and a page that cannot be read."""
    size = -(-(frames.nbytes + gap) // mmap.PAGESIZE) * mmap.PAGESIZE
    pages = mmap.mmap(-1, size + mmap.PAGESIZE)
    address = ctypes.addressof(ctypes.c_char.from_buffer(pages))
    libc = ctypes.CDLL(None, use_errno=True)
    assert libc.mprotect(ctypes.c_void_p(address + size), ctypes.c_size_t(mmap.PAGESIZE), 0) == 0
    placed = np.frombuffer(pages, frames.dtype, frames.size, size - gap - frames.nbytes).reshape(frames.shape)
    placed[:] = frames
    return placed


PLACES = {
    "one byte behind a page": lambda frames: at(1, frames),
    "two bytes behind a page": lambda frames: at(2, frames),
    "read-only": read_only,
    "Fortran order": np.asfortranarray,
    "backwards": lambda frames: frames[::-1].copy()[::-1],
    "every other": lambda frames: np.repeat(frames, 2, axis=0)[::2],
    "a part of each row": lambda frames: np.pad(frames, ((0, 0), (0, 0), (3, 5)))[:, :, 3:-5],
    "the end of memory": lambda frames: before_a_forbidden_page(frames, 0),
    "a word before the end of memory": lambda frames: before_a_forbidden_page(frames, 32),
}


@EACH
@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
def test_it_does_not_matter_where_frames_are_and_they_do_not_change(device, name, dtype):
    case = of_type(name, dtype)
    for place, put in PLACES.items():
        placed = replace(case, frames=put(case.frames))
        assert_same(placed.whole(device=device), whole(name, device, dtype))
        np.testing.assert_array_equal(placed.frames, case.frames, err_msg=place)
    buffer = np.zeros(case.frames.nbytes + 64, np.uint8)  # the bytes behind borrowed frames can be read
    borrowed = replace(case, frames=np.ndarray(case.frames.shape, dtype, buffer.data))
    borrowed.frames[:] = case.frames
    assert_same(borrowed.whole(device=device), whole(name, device, dtype))


@EACH
def test_what_memory_held_before_and_what_comes_after_changes_nothing(device, name, monkeypatch):
    def soiled(nbytes, zeroed):
        maps = take(nbytes, zeroed)
        if not zeroed:
            maps[:] = 0x7F
        return maps

    take, case = memory.take, CASES[name]
    monkeypatch.setattr(memory, "take", soiled)
    maps = case.whole(device=device)
    replace(case, frames=255 - case.frames).whole(device=device)
    engine.free_memory()
    assert_same(maps, whole(name, device))
    for values in maps.values():
        np.asarray(values)[...] = 1  # it is the caller's


@pytest.mark.parametrize(
    "name", [name for name in CASES if not name.startswith(("LastTurn", "MovingNormals", "Slip"))]
)
def test_a_picture_in_bands_has_the_maps_of_the_whole(small_device, name):
    case, limit, bands = CASES[name], 1 << 17, set()
    expected = whole(name, small_device)
    while len(bands) < 3:
        small_device.max_allocation = limit = limit * 2 // 3
        operation = case.make(device=small_device)
        source = Parts(case.frames, operation, case.given, [5])
        run = engine.Run(operation.plan(source), source)
        assert_same(run.complete(), expected)
        assert_same(run.result(), expected)
        bands.add(len(run.operation._picture.bands))
    small_device.max_allocation = 64
    with pytest.raises(DeviceError, match=r"one row of 31 pixels does not fit|has no memory for"):
        case.whole(device=small_device)


@EACH
def test_running_it_over_a_recording_gives_the_same(name):
    case = replace(CASES[name], weights={})
    result = engine.run(case.source(), case.make())
    assert_same(result, case.whole())
    assert result.process["operation"] == case.kind.__name__
    numbers = {key: value for key, value in case.options.items() if isinstance(value, bool | int | float)}
    chosen = {key: value for key, value in numbers.items() if key not in ("tilt", "noise")}  # estimated
    assert {key: result.process[key] for key in chosen} == chosen


@EACH
def test_the_function_on_arrays_gives_the_same(name):
    case = CASES[name]
    if case.function is None:
        assert case.kind.__name__ in {
            "Levels",
            "Strokes",
            "Normals",
            "LastTurn",
            "MovingNormals",
            "SlipOnset",
        }
        return
    assert_same(case.function(case.frames, **case.given, **case.options), whole(name))


# For values that float32 cannot hold, by unit: what is added to that of a case, and the value if it has none.
UNEVEN = {
    "share": (-1 / 6, 1 / 3),
    "": (0.1, 0.1),
    "counts": (1 / 3, 1.04),
    "mm": (0.1, 0.1),
    "rad": (0.01, 0.1),
    "counts/rad": (0.1, 180.1),
}
ABOUT_FRAMES = ("line_time", "light", "pixel_size", "centre")
LEVEL = {"dark": 16.1, "bright": 240.1}


def uneven(option, value):
    """Return a value of an option that float32 cannot hold."""
    added, alone = UNEVEN[option.unit]
    if isinstance(value, list | tuple):
        return [entry + added / 10 for entry in value]
    number = (
        LEVEL.get(option.name, alone) if value is None or isinstance(value, str) else float(value) + added
    )
    assert option.check(number) == number != float(np.float32(number))
    return number


def uneven_options():
    """Yield each case with each option of a number."""
    for name, case in CASES.items():
        operation = case.make()
        for option in operation.options.values():
            value = option.stored(operation)
            if option.kind in ("number", "numbers", "map") and option.name not in ABOUT_FRAMES:
                yield pytest.param(name, option.name, uneven(option, value), id=f"{name}, {option.name}")


def impossible_values():
    """Yield each option of the engine's classes with values outside of its range, and what is needed."""
    for kind in engine_classes():
        for option in kind.options.values() if issubclass(kind, Configured) else ():
            low, high = option.within
            wrong = [None if low is None else low - 1, None if high is None else high + 1, option.above]
            wrong += [np.nan] if option.kind in ("number", "map") else []
            if option.kind == "choice":
                yield pytest.param(kind, option, "nonsense", id=f"{kind.__name__}, {option.name}")
            elif option.kind in ("number", "integer", "numbers", "integers", "map"):
                for number in (number for number in wrong if number is not None):
                    yield pytest.param(kind, option, number, id=f"{kind.__name__}, {option.name} {number:g}")


@pytest.mark.parametrize(("kind", "option", "value"), list(impossible_values()))
def test_a_value_outside_of_the_declared_range_is_refused_in_a_line(kind, option, value):
    several = option.kind in ("numbers", "integers")
    with pytest.raises(io.InputError, match=f"{option.name} .*{value}.*(is needed|Use )") as caught:
        kind(**{option.name: [value] * (option.count or 1) if several else value})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("name", "option", "value"), list(uneven_options()))
def test_a_value_that_float32_cannot_hold_is_kept(name, option, value):
    case = CASES[name]
    options = {**case.options, option: value}
    answers = [engine.run(replace(case, weights={}).source(), case.kind(**options))]
    if case.function:
        answers.append(case.function(case.frames, **case.given, **options))
    kept = str(list(value)) if isinstance(value, list | tuple) else value
    assert [result.process.get(option, kept) for result in answers] == [kept] * len(answers)


@EACH
def test_live_gives_the_same_or_refuses_before_anything_moves(name):
    case = replace(CASES[name], weights={})
    operation, source = case.make(), case.source()
    if operation.configured_for(source).passes == 2:
        with pytest.raises(io.InputError, match="twice"):
            LiveRun(source, operation)
        return
    live = LiveRun(source, operation)
    live.precompile()
    while (block := source.read(live.staging_buffer[:5])) is not None:
        live.push_block(block)
        live.maps(0.0)
    result = live.result()
    assert result.process["live"] is True
    assert_same(result, case.whole())


@ONCE
@pytest.mark.parametrize("wrong", ["shape", "type", "byte order", "none", "positions"])
def test_frames_that_do_not_fit_are_refused_and_change_nothing(name, wrong):
    case = CASES[name]
    run, part = case.loop(), slice(0, 6)
    case.push(run, part)
    frames = {name: case.frames[part].astype(kind) for name, kind in (("type", "i4"), ("byte order", ">u2"))}
    frames |= {"shape": case.frames[part, 1:], "none": case.frames[:0], "positions": case.frames[:7]}
    where = {position: values[part] for position, values in case.given.items()}
    if wrong == "positions" and not where:
        return
    with pytest.raises(io.InputError):
        run.push(frames[wrong], **where)
    assert run.operation.count == 6
    case.push(run, slice(6, None))
    assert_same(run.result(), whole(name))


LIVE = ["live Strokes", "live LastTurn", "live MovingNormals", "live Slip"]


@pytest.mark.parametrize("name", [*ONCE.args[1], *LIVE])
def test_each_answer_next_to_pushes_is_that_of_a_single_thread(name):
    case = CASES[name.removeprefix("live ")]
    slow = case.kind.__name__ in ("SlipOnset", "LastTurn")

    def make():
        return LiveRun(case.source(), case.make()) if name in LIVE else case.loop()

    parts = [slice(start, start + 2) for start in range(0, len(case.frames), 2)]
    alone, shared, start, finished = make(), make(), threading.Barrier(3), threading.Event()
    expected = {None}
    for part in parts:
        case.push(alone, part)
        expected |= set() if slow else {content(answer(alone))}

    def push():
        start.wait()
        try:
            for part in parts:
                case.push(shared, part)
        finally:
            finished.set()

    def look_on():
        earlier = []
        start.wait()
        for _ in range(10 if slow else 10**6):
            if finished.is_set():
                break
            result = answer(shared)
            earlier = [*earlier[:2], *earlier[-2:], (result, content(result))]
            assert slow or earlier[-1][1] in expected
            if result:
                assert (shared.preview(0.0) if name in LIVE else shared.staging_buffer) is not None
        return earlier

    with ThreadPoolExecutor(3) as pool:
        pushing, *looking = pool.submit(push), pool.submit(look_on), pool.submit(look_on)
        pushing.result()
        earlier = [pair for each in looking for pair in each.result()]
    assert content(shared.result()) == content(alone.result())
    assert all(content(result) == before for result, before in earlier)  # nothing wrote to them later


def test_every_operation_has_a_case():
    operations = (entry for entry in engine_classes() if issubclass(entry, engine.Operation) and entry.maps)
    kinds = {entry for entry in operations if entry.push is not engine.Operation.push}
    bases = {base for kind in kinds for base in kind.__mro__[1:]}
    assert kinds - bases <= {case.kind for case in CASES.values()}
