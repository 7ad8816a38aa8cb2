"""Every door gives the same answer: maps, standard deviations, findings and fitted values, bit by bit.

A door is a way to start a computation: a function on arrays, `engine.run`, a command, a batch, a live run,
the application. One frame of each recording is repeated, which is a finding.
"""

from __future__ import annotations

import dataclasses
import functools
import multiprocessing
import re
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import done
from numpy.typing import NDArray
from operations import (
    CASES,
    COUNT,
    LEAN,
    LEVELS,
    ON_PHASE,
    ON_TRAVEL,
    PIXEL,
    PRESS,
    ROTATION,
    SENSOR,
    SKIN,
    SLIDE,
    TILT,
    TURNS,
    Case,
    Readable,
)
from own_operations import Covariance, Depth, Total, run_elsewhere
from stacks import MadeUp, record

from mirrorskin import engine, io
from mirrorskin.engine.batch.jobs import TABLES, Job, Plan
from mirrorskin.engine.batch.local import default_devices, run_local
from mirrorskin.engine.batch.work import Outcome, run_job
from mirrorskin.engine.live import LiveRun, Loop, Stream
from mirrorskin.io.files.arrays import ArrayRecording
from mirrorskin.io.files.zarr_export import save_zarr
from mirrorskin.io.model.result import FIELDS
from mirrorskin.io.storage.layout import POSITIONS
from mirrorskin.kernels.device import open_device
from mirrorskin.twin import Axial, Twin, Vertical
from mirrorskin.view.app import Opening
from mirrorskin.view.app.session import Session, run_now

pytestmark = pytest.mark.filterwarnings("ignore::mirrorskin.io.MirrorskinWarning")

ALL_FRAMES = 10**6
AT_ONCE = 1, 3, ALL_FRAMES  # frames that are pushed together
SPLIT = {"array", "own loop", "HDF5", "live"}  # doors that are tried with each of these
UNITS = {"mm": "mm", "rad": "rad", "counts/rad": "/rad"}  # of options on the command line


# --- What is computed ----------------------------------------------------------------------------------


def with_fewer_frames(case: Case) -> Case:
    """Return a case with about 24 frames, one of which is repeated."""
    every = 2 if case.motion == "vertical" else 1
    count = len(case.frames) if "light" in case.options else 24 * every
    frames, *series = (
        {name: values[:count:every] for name, values in arrays.items()}
        for arrays in ({"frames": case.frames}, case.positions, case.weights)
    )
    few = frames["frames"].copy()
    few[len(few) // 2] = few[len(few) // 2 - 1]
    return replace(case, frames=few, positions=series[0], weights=series[1])


RANDOM = np.random.default_rng(5)
NOISY = PRESS + RANDOM.normal(0, np.where(np.arange(COUNT) < 2, 8, 0.5)[:, None, None], PRESS.shape)
FLICKERING = TURNS * (1 + 0.06 * RANDOM.normal(size=(COUNT, 1, 1)))
TWICE = {  # all frames show that an assumption about them was wrong
    "Onset after two noisy frames": Case(
        engine.Onset, NOISY.clip(0, 255).astype(np.uint8), ON_TRAVEL, LEVELS, engine.find_onset
    ),
    "Normals in flickering light": Case(
        engine.Normals, FLICKERING.clip(0, 255).astype(np.uint8), ON_PHASE, {"tilt": TILT, **SENSOR},
        engine.estimate_normals, **ROTATION,
    ),
}  # fmt: skip
OWN = {
    "own": Case(Total, PRESS, {}, {"least": 900.0}),
    "own of two passes": Case(Covariance, PRESS, ON_TRAVEL),
    "own result of a subclass": Case(Depth, PRESS, ON_TRAVEL, {"dark": 0, "bright": 255}),
}
METHODS: dict[str, Any] = {
    "Press": Case(engine.Press, PRESS, ON_TRAVEL, LEVELS),
    "Press by change-points": Case(engine.Press, PRESS, ON_TRAVEL, {"method": "change-point", **LEVELS}),
    "Press without levels": Case(engine.Press, PRESS, ON_TRAVEL),
    "Rotation": Case(engine.Rotation, TURNS, ON_PHASE, {"tilt": TILT, **SENSOR}, **ROTATION),
    "Rotation of the last turn": Case(
        engine.Rotation, TURNS, ON_PHASE, {"tilt": TILT, "window_frames": 8, **SENSOR}, **ROTATION
    ),
    "Slide": Case(engine.slip.Slide, SKIN, {"displacement": SLIDE}, motion="horizontal"),
}
EVERYTHING = {name: with_fewer_frames(case) for name, case in {**CASES, **TWICE, **OWN, **METHODS}.items()}


class Coming(MadeUp):
    """A live source, which gives so many frames at once."""

    def __init__(self, at_once: int, *args: Any, **series: Any) -> None:
        super().__init__(*args, **series)
        self._at_once = at_once

    def now(self) -> float:
        return 0.01 * self.frames_read

    def positions(self) -> dict[str, Any]:
        return {}

    def read(self, out: Any = None, /) -> Any:
        return super().read(None if out is None else out[: self._at_once])


@dataclass(frozen=True, eq=False)
class Task:
    """An operation or a method, its frames, and how many of them are pushed together."""

    case: Case
    at_once: int
    folder: Path

    @property
    def is_method(self) -> bool:
        return not issubclass(self.case.kind, engine.Operation)

    @property
    def memory_limit(self) -> int:
        return int(2 * self.at_once * self.case.frames[0].nbytes)

    @property
    def header(self) -> io.Header:
        return io.Header(self.case.motion, pixel_size=(PIXEL, PIXEL) if self.is_method else None)

    @property
    def series(self) -> dict[str, Any]:
        """Positions of a recording."""
        count, position = len(self.case.frames), POSITIONS[self.case.motion]
        if "pose" in self.case.positions:
            return {"tilt": LEAN[:count], "phase": np.zeros(count)}
        return dict(self.case.positions) or {position: {**ON_TRAVEL, **ON_PHASE}[position][:count]}

    def source(self) -> Readable:
        return Readable(self.case.frames, self.header, **self.series)

    def configured(self) -> Any:
        return self.case.make(memory_limit=self.memory_limit)

    def run(self, source: Any, configured: Any = None) -> io.Result:
        """Return the result of a recording."""
        configured = configured or self.configured()
        return configured.run(source) if self.is_method else engine.run(source, configured)

    def recording(self) -> Path:
        path = self.folder / "recording.h5"
        return path if path.exists() else record(self.source(), path)

    def parts(self, positions: Any, at_once: int) -> Iterator[tuple[Any, dict[str, Any]]]:
        """Yield frames and their positions, at most so many together."""
        for start in range(0, len(self.case.frames), at_once):
            part = slice(start, start + at_once)
            yield self.case.frames[part], {name: values[part] for name, values in positions.items()}


# --- Doors ---------------------------------------------------------------------------------------------


def function(task: Task) -> io.Result:
    case = task.case
    if task.is_method:
        arguments = {**case.positions, **case.options, "pixel_size": PIXEL, "memory_limit": task.memory_limit}
        return engine.reconstruct(case.frames, **arguments)
    if case.function is None:
        pytest.skip("there is no such function")
    return case.function(case.frames, **case.given, **case.options)


def array(task: Task) -> io.Result:
    return engine.run(task.case.frames, task.configured(), **task.case.given)


def iterator(task: Task) -> io.Result:
    return engine.run(iter(task.case.frames), task.configured(), **task.case.given)


def device_array(task: Task) -> io.Result:
    frames = open_device().from_host("frames", task.case.frames, task.case.frames.dtype)
    return engine.run(frames, task.configured(), **task.case.given)


def own_loop(task: Task) -> io.Result:
    operation = task.configured()
    if operation.passes == 2:
        pytest.skip("it needs all frames twice")
    run = engine.Run(operation)
    for frames, positions in task.parts(task.case.given, task.at_once):
        run.push(frames, **positions)
    return run.result()


@functools.cache
def spawned() -> ProcessPoolExecutor:
    return ProcessPoolExecutor(1, multiprocessing.get_context("spawn"))


def elsewhere(task: Task) -> io.Result:
    task_inputs = task.configured(), task.case.frames, dict(task.case.given)
    maps, process, fitted = spawned().submit(run_elsewhere, *task_inputs).result(60)
    result = io.Result(maps, process=process)
    if fitted is not None:
        object.__setattr__(result, "fitted", fitted)
    return result


def source(task: Task) -> io.Result:
    return task.run(task.source())


def array_recording(task: Task) -> io.Result:
    if "pose" in task.case.positions:
        pytest.skip("an array has no tilt of each frame")
    header = {"pixel_size": task.header.pixel_size}
    return task.run(ArrayRecording(task.case.frames, task.series, header, task.case.motion))


def hdf5(task: Task) -> io.Result:
    with io.open_recording(task.recording()) as recording:
        return task.run(recording)


def zarr(task: Task) -> io.Result:
    path = task.folder / "recording.zarr"
    save_zarr(task.recording(), path)
    with io.open_recording(path) as recording:
        return task.run(recording)


def job_of(task: Task, name: str) -> tuple[Job, Plan]:
    case = task.case
    options: dict[str, Any] = {TABLES[case.motion]: case.options}
    if not task.is_method:
        options = {"operation": name_of(case.kind), "operation_options": case.options}
    plan = Plan(memory_limit=task.memory_limit, **options)
    return Job(task.recording(), task.folder / f"{name}.h5"), plan


def opened(outcome: Outcome) -> io.Result:
    assert outcome.state == "done", outcome.message
    return io.open_result(outcome.job.target)


def batch(task: Task) -> io.Result:
    job, plan = job_of(task, "batch")
    (outcome,) = run_local([job], plan, default_devices())
    return opened(outcome)


def worker(task: Task) -> io.Result:
    return opened(run_job(*job_of(task, "worker")))


def name_of(kind: type) -> str:
    return f"{kind.__module__}:{kind.__name__}"


def command(task: Task) -> io.Result:
    output, kind = task.folder / "command.h5", task.case.kind
    words = words_of(kind, task.case.options)
    start = ["reconstruct"] if task.is_method else ["run", name_of(kind)]
    done(start[0], *start[1:], task.recording(), "-o", output, "--overwrite", *words)
    return io.open_result(output)


def words_of(kind: Any, options: Any) -> list[str]:
    """Return options of a class as words of a command."""
    words = []
    for name, value in options.items():
        declared, flag = kind.options[name], f"--{name.replace('_', '-')}"
        if declared.python_only or declared.kind in ("object", "file"):
            pytest.skip(f"a command has no {name}")
        if declared.kind == "flag":
            words.append(flag if value else f"--no-{flag[2:]}")
            continue
        values = value if isinstance(value, list) else [value]
        texts = [
            option if isinstance(option, str) else f"{option!r}{UNITS.get(declared.unit, '')}"
            for option in values
        ]
        words.append(f"{flag}={','.join(texts)}")
    return words


def application(task: Task) -> io.Result:
    operation = "" if task.is_method else name_of(task.case.kind)
    computations: list[Any] = []
    session = Session(task.recording(), Opening(operation=operation), lambda *work: computations.append(work))
    for name, value in task.case.options.items():
        session.choose(name, value)
    session.run = run_now
    run_now(*computations[-1])
    session.close()
    assert session.now is not None, session.problem
    return session.now.result


def stream(task: Task) -> io.Result:
    check_live(task)
    frames = task.case.frames
    how: dict[str, Any] = {"header": task.header, "latency": np.inf}
    with Stream(task.configured(), frames.shape[1:], frames.dtype, **how) as pushed:
        for part, positions in task.parts(task.series, min(task.at_once, 8)):
            pushed.push(part, **positions)
        return pushed.result()


def live(task: Task) -> io.Result:
    return live_and_recorded(task)[0]


def live_again(task: Task) -> io.Result:
    with io.open_recording(live_and_recorded(task)[1], live=True) as recording:
        return task.run(recording)


@functools.cache
def live_and_recorded(task: Task) -> tuple[io.Result, Path]:
    """Return the result of a live run, and the file that it recorded."""
    check_live(task)
    case, path = task.case, task.folder / f"live-{task.at_once}.h5"
    time = 0.01 * np.arange(len(case.frames))
    coming = Coming(task.at_once, case.frames, task.header, time=time, **task.series)
    with io.StreamRecorder(coming, path) as recorder:
        run = LiveRun(recorder, task.configured())
        Loop(recorder, run, latency=np.inf, mark=recorder.mark).run()
        return run.result(), path


def check_live(task: Task) -> None:
    try:
        LiveRun(task.source(), task.configured())
    except io.InputError as error:
        if not re.search("twice|window_frames is missing", str(error)):
            raise
        pytest.skip(f"it is refused: {error}")


Door = Callable[[Task], io.Result]
ARRAYS: dict[str, Door] = {
    "function": function,
    "array": array,
    "iterator": iterator,
    "device array": device_array,
    "own loop": own_loop,
    "spawned process": elsewhere,
}
RECORDINGS: dict[str, Door] = {
    "source": source,
    "ArrayRecording": array_recording,
    "HDF5": hdf5,
    "Zarr": zarr,
    "batch": batch,
    "worker": worker,
    "command": command,
    "application": application,
}
LIVE: dict[str, Door] = {"live, again": live_again, "live": live, "Stream": stream}
DOORS = {**ARRAYS, **RECORDINGS, **LIVE}


def doors_of(name: str) -> dict[str, Door]:
    if name in METHODS:
        return {"function": function, **RECORDINGS, **LIVE}
    if EVERYTHING[name].weights:  # recordings have none
        return ARRAYS
    # Every format is read by the same loop, and batches call the function of workers.
    of_user = name in TWICE or name in OWN
    left_out = {"worker"} if of_user else {"worker", "Zarr", "application"}
    return {door: run for door, run in DOORS.items() if door not in left_out}


def reference_of(name: str, door: str) -> str:
    """Return the door whose answer is the right one."""
    if EVERYTHING[name].weights:
        return "array"
    if (name, door) == ("Press without levels", "live, again"):  # they are not estimated while frames come
        return door
    first_pass_only = name in TWICE and door in ("iterator", "own loop", "live, again")
    return "live, again" if door in ("live", "Stream") or first_pass_only else "HDF5"


# --- Tests ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def answers(tmp_path_factory):
    """Return the answers of a door, one for each split of the frames; they are computed once."""
    folders = functools.cache(lambda name: tmp_path_factory.mktemp(name.replace(" ", "-")))
    task_of = functools.cache(lambda name, at_once: Task(EVERYTHING[name], at_once, folders(name)))

    @functools.cache
    def compute(name, door):
        splits = AT_ONCE if door in SPLIT else AT_ONCE[1:2]
        return [DOORS[door](task_of(name, at_once)) for at_once in splits]

    yield compute
    live_and_recorded.cache_clear()
    if spawned.cache_info().currsize:
        spawned().shutdown()
        spawned.cache_clear()


def findings(result: io.Result) -> dict[str, Any]:
    return {name: text for name, text in result.process.items() if name.endswith(("warnings", "notes"))}


def fitted(result: io.Result) -> Any:
    """Return what is known of the maps, without the place of their pixels and frames in a file."""
    return dataclasses.replace(result.fitted, source_region=None, source_frames=None)


OTHER_PLAN = {  # while frames come, another operation computes
    ("Rotation of the last turn", "live"),
    ("Rotation of the last turn", "Stream"),
    ("Press by change-points", "live"),
    ("Press by change-points", "Stream"),
    ("Press by change-points", "live, again"),
}


def pairs() -> list[Any]:
    """Return all operations and methods with all doors."""
    combinations = ((name, door) for name in EVERYTHING for door in doors_of(name))
    return [pytest.param(*both, id=", ".join(both)) for both in combinations if both not in OTHER_PLAN]


def assert_same(actual: io.Result, expected: io.Result) -> None:
    assert sorted(actual) == sorted(expected)
    for field, values in expected.items():
        np.testing.assert_array_equal(actual[field], values, err_msg=field, strict=True)
    np.testing.assert_equal(fitted(actual), fitted(expected))


@pytest.mark.parametrize(("name", "door"), pairs())
def test_answers_are_the_same_through_every_door(answers, name, door):
    expected = answers(name, reference_of(name, door))[-1]
    for result in answers(name, door):
        assert_same(result, expected)
        assert findings(result) == findings(expected)


@pytest.mark.parametrize("name", [name for name in EVERYTHING if "HDF5" in doors_of(name)])
def test_the_repeated_frame_is_found(answers, name):
    assert "identical to the one before" in findings(answers(name, "HDF5")[-1])["warnings"]


# --- Heights of normals, and surfaces of a press and a rotation ------------------------------------------

UNEVEN = (TURNS * np.linspace(0.9, 1.1, TURNS.shape[2])).clip(0, 255).astype(np.uint8)
NORMALS = {name: EVERYTHING[name] for name in ("Normals", "Normals in flickering light")}
NORMALS["Normals in uneven light"] = with_fewer_frames(replace(CASES["Normals"], frames=UNEVEN))


@pytest.mark.parametrize("name", NORMALS)
def test_heights_of_normals_are_those_of_a_rotation(name):
    case = NORMALS[name]
    arguments = {**case.given, **case.options}
    surface = engine.integrate(engine.estimate_normals(case.frames, **arguments), pixel_size=PIXEL)
    expected = engine.reconstruct(case.frames, pixel_size=PIXEL, **arguments)
    assert_same(surface, io.Result({field: expected[field] for field in surface}, fitted=expected.fitted))


def kept(result: io.Result, folder: Path, name: str) -> Path:
    path = folder / f"{name}.h5"
    io.save_result(result, path, overwrite=True)
    return path


MAPS: dict[str, Callable[[io.Result, Path, str], Any]] = {
    "result": lambda result, folder, name: result,
    "mapping": lambda result, folder, name: {**result, **{field: getattr(result, field) for field in FIELDS}},
    "dataset": lambda result, folder, name: result.to_xarray(),
    "file": kept,
}


BOTH = "vertical", "axial"


@functools.cache
def repeating(motion: str) -> tuple[NDArray[Any], io.Header, dict[str, Any]]:
    """Return frames of a press or a rotation, one of which is repeated, with their header and positions."""
    movement, series = Vertical(0.1 * np.arange(1, 26)), {"travel": 0.1 * np.arange(1, 26)}
    if motion == "axial":
        series = {"phase": np.pi / 4 * np.arange(16)}
        movement = Axial(series["phase"], tilt=0.05, press=1.5)
    pattern = "linear" if motion == "axial" else "uniform"
    twin = Twin(object="sphere", shape=(40, 44), pixel_size=0.1, movement=movement, pattern=pattern)
    frames = np.empty(twin.shape, twin.dtype)
    twin.read(frames)
    frames[12] = frames[11]
    return frames, twin.header, series


def as_source(motion: str) -> Readable:
    frames, header, series = repeating(motion)
    return Readable(frames, header, **series)


def in_array(motion: str) -> ArrayRecording:
    frames, header, series = repeating(motion)
    names = [entry.name for entry in dataclasses.fields(header) if entry.name != "motion"]
    return ArrayRecording(frames, series, {name: getattr(header, name) for name in names}, motion)


@dataclass(frozen=True)
class Pair:
    """Recordings of both, and their results."""

    folder: Path

    @functools.cached_property
    def recordings(self) -> list[Path]:
        return [record(as_source(motion), self.folder / f"{motion}.h5") for motion in BOTH]

    @functools.cached_property
    def results(self) -> list[io.Result]:
        press, turn = map(as_source, BOTH)
        return [engine.reconstruct(press, fill=False), engine.reconstruct(turn)]

    @functools.cached_property
    def fused(self) -> dict[str, io.Result]:
        return {door: fuse(self) for door, fuse in FUSIONS.items()}


def fused_by_command(pair: Pair) -> io.Result:
    output = pair.folder / "fused.h5"
    done("fuse", *pair.recordings, "-o", output, "--overwrite")
    return io.open_result(output)


def fused_in_zarr(pair: Pair) -> io.Result:
    paths = [path.with_suffix(".zarr") for path in pair.recordings]
    for recording, path in zip(pair.recordings, paths, strict=True):
        save_zarr(recording, path)
    return engine.fuse(*paths)


FUSIONS: dict[str, Callable[[Pair], io.Result]] = {
    "HDF5": lambda pair: engine.fuse(*pair.recordings),
    "source": lambda pair: engine.fuse(*map(as_source, BOTH)),
    "ArrayRecording": lambda pair: engine.fuse(*map(in_array, BOTH)),
    "Zarr": fused_in_zarr,
    "command": fused_by_command,
}


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    return Pair(tmp_path_factory.mktemp("pair"))


@pytest.mark.parametrize("door", FUSIONS)
def test_a_fused_surface_is_the_same_through_every_door(pair, door):
    assert_same(pair.fused[door], pair.fused["HDF5"])
    assert findings(pair.fused[door]) == findings(pair.fused["HDF5"])


@pytest.mark.parametrize("kind", MAPS)
def test_a_surface_of_results_does_not_depend_on_how_they_are_kept(pair, kind):
    sources = [MAPS[kind](result, pair.folder, f"{place}") for place, result in enumerate(pair.results)]
    assert_same(engine.fuse(*sources), engine.fuse(*pair.results))


@pytest.mark.parametrize("kind", MAPS)
def test_heights_of_normals_do_not_depend_on_how_they_are_kept(pair, kind):
    turned = pair.results[1]
    assert_same(engine.integrate(MAPS[kind](turned, pair.folder, "turned")), engine.integrate(turned))


def test_heights_of_normals_have_the_findings_of_their_input(pair):
    warnings = engine.integrate(pair.results[1]).process["warnings"]
    assert re.match("normals: .*identical to the one before", warnings)


def test_a_surface_of_results_has_the_findings_of_both(pair):
    warnings = engine.fuse(*pair.results).process["warnings"]
    assert warnings.count("identical to the one before") == 2
