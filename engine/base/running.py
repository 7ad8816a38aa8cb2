"""One run of a plan over a source of frames: the only loop, offline and live."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from mirrorskin.engine.base.device_arrays import device_of, on_host
from mirrorskin.engine.base.frames import take_grid
from mirrorskin.engine.base.operation import Operation, Plan
from mirrorskin.engine.base.options import RESERVED
from mirrorskin.engine.base.provenance import attach_provenance, describe, naming
from mirrorskin.engine.base.sources import (
    ENDLESS,
    CorrectedSource,
    PushedSource,
    as_frames,
    block_of,
    blocks_of,
)
from mirrorskin.engine.base.steps import Context, Step
from mirrorskin.io import Block, InputError, Map, Result
from mirrorskin.io.base.arguments import nearest, unknown_argument
from mirrorskin.io.base.findings import Finding, merged, warn, with_findings
from mirrorskin.io.base.threads import ThreadSafe, computation
from mirrorskin.io.base.types import exclusive_use
from mirrorskin.io.model.maps import SIGMA, UNDECLARED, declaration_of
from mirrorskin.io.model.result import result_of
from mirrorskin.io.storage.layout import as_series
from mirrorskin.io.watch.watch import FrameChecker
from mirrorskin.kernels.array import Array

if TYPE_CHECKING:
    from mirrorskin.engine.base.method import Method
    from mirrorskin.io import Source
    from mirrorskin.io.base.types import ProcessValue

Progress = Callable[[int], None]

_SCALARS = str | int | float | np.generic
_ONE_READING = Finding(
    "one reading",
    "all frames contradict what was assumed from the first ones, but they cannot be read again, so standard"
    " deviations may be wrong: record the frames, and reconstruct the recording",
)


class Run(ThreadSafe):
    """One run of an operation, with its own state: frames in, maps out.

    Everything that computes maps from frames is such a run: functions on arrays, `mirrorskin.engine.run`,
    `mirrorskin.engine.reconstruct`, live runs and commands. Use it for a loop of your own.

    Parameters
    ----------
    plan : Plan, Operation or class of operations
        Options of an operation that are not given are taken from the source, if there is one.
    source : Source, optional
        Where the frames come from; by default they are those that are pushed.

    Raises
    ------
    mirrorskin.io.InputError
        The operation does not take frames of this type, or needs something that is missing.

    Attributes
    ----------
    operation : Operation
        The copy that computes.

    Examples
    --------
    >>> from mirrorskin import engine
    >>> run = engine.Run(engine.Onset(dark=0, bright=255, noise=1.0))
    >>> for travel in (0.0, 0.1, 0.2, 0.3, 0.4):
    ...     run.push(np.full((1, 1, 2), 255 * (travel > 0.25), np.uint8), travel=[travel])
    >>> run.result().height.tolist()
    [[-0.25, -0.25]]
    """

    def __init__(self, plan: Plan | Operation | type[Operation], source: Source | None = None) -> None:
        if isinstance(plan, type):
            plan = plan()
        if isinstance(plan, Operation):
            plan = Plan(plan, process=describe(plan)) if source is None else plan_of(plan, source)
        self._plan: Plan = plan
        self._source, self._stream = source, self._plan.stream or source
        self.operation: Operation = self._plan.operation._copy_for_run()
        self._final: Result | None = None
        self._read_once: bool | None = None  # whether frames should be read again, but cannot; None: unknown
        if self._stream is not None:
            self._begin(self._stream.shape, self._stream.dtype)

    def _begin(self, shape: tuple[int, int, int], dtype: np.dtype[Any]) -> None:
        source, frames = self._stream, self._plan.frames
        if source is not None and shape[0] < ENDLESS:
            count = len(frames) if frames is not None else shape[0]
            required = 2 * count * math.prod(shape[1:]) * dtype.itemsize
            vars(self.operation)["memory_limit"] = max(1, min(self.operation.memory_limit, required))
        on_device = getattr(source, "on_device", None)
        if on_device is not None:
            self._use_device_of(on_device)
        self.operation._begin(shape[1:], dtype)
        self._watch: FrameChecker | None = None
        if self._plan.checked and source is not None:
            self._watch = FrameChecker(
                source,
                moved=bool(self.operation.motions),
                phased="phase" in self.operation.positions,
            )

    def _use_device_of(self, frames: Array) -> None:
        """Compute on the device of frames, if none was chosen; InputError if they are on another one."""
        operation = self.operation
        choice = operation.opened_devices or vars(operation)["_device"]
        vars(operation)["_device"] = device_of(choice, frames)
        operation._on_device = True

    # Offline: all frames of the source.

    def complete(self, progress: Progress | None = None) -> Result:
        """Read all frames of the source, and return the maps, with findings and provenance.

        Parameters
        ----------
        progress : callable, optional
            Called with the number of frames read so far.

        Raises
        ------
        mirrorskin.io.InputError
            The operation needs all frames twice, and the source can only be read once; or what the operation
            and the steps refuse.
        """
        source = self._source
        if source is None:
            raise InputError("this run has no source: give it one, or push frames")
        if self._final is not None:
            return self._final
        with exclusive_use(source), naming(source), ThreadPoolExecutor(1, "mirrorskin-fingerprint") as worker:
            # The result needs it, and it takes about as long as the frames.
            fingerprint = worker.submit(source.fingerprint) if hasattr(source, "fingerprint") else None
            self._feed(progress)
            if fingerprint is not None:
                fingerprint.result()
            return self.result(ended=True)

    def _feed(self, progress: Progress | None) -> None:
        """Push all frames, once or twice; and again, if an assumption about them was wrong."""
        stream = self._stream
        assert stream is not None
        if self.operation.passes == 2 and not stream.rewindable:
            raise InputError(
                f"{stream.name} can be read only once, but {type(self.operation).__name__} needs all frames"
                " twice"
            )
        self._feed_passes(stream, progress)
        better = self._better_operation()
        # Frames that a live run used give what they gave live.
        self._read_once = better is not None and (
            not stream.rewindable or getattr(stream, "used_live", False)
        )
        if better is None or self._read_once:
            return
        watch, self.operation = self._watch, better._copy_for_run()
        if better.corrected_kinds:
            start = 0 if self._plan.frames is None else self._plan.frames.start
            stream = CorrectedSource(stream, better, start)
        self._begin(stream.shape, stream.dtype)
        self._watch = None
        self._feed_passes(stream, progress)
        self._watch = watch

    def _better_operation(self) -> Operation | None:
        watch = self._watch
        if watch is None or watch.samples.count == 0:
            return None
        return self.operation.after_last_frame(watch.samples)

    def _feed_passes(self, stream: Source, progress: Progress | None) -> None:
        for number in range(self.operation.passes):
            if number:
                self._check_count()
                self._expected = self.operation.count
                self.operation._begin_second_pass()
            if stream.rewindable:
                stream.rewind()
            watch = None if number else self._watch
            for processed, block in blocks_of(stream, self.operation, self._plan.frames):
                if block is not None:
                    with computation():  # a daemon thread ends between two blocks
                        self._take(block, watch)
                if progress:
                    progress(processed)

    # Live, or a loop of one's own: frames as they come.

    def push(self, frames: Any, **positions: Any) -> None:
        """Process the next frames of a loop of your own.

        Parameters
        ----------
        frames : array_like or device array, (n, H, W)
            They are not used any more when this returns.
        **positions : array_like, (n, ...)
            What the operation needs of each frame, such as ``travel``, mm.

        Raises
        ------
        mirrorskin.io.InputError
            Frames of another size or type than earlier ones, or positions that are missing or impossible:
            then nothing is pushed.
        """
        operation = self.operation
        if operation.passes == 2:
            raise InputError(f"{type(operation).__name__} needs all frames twice: give them to engine.run")
        array = as_frames(frames, operation, operation.count)
        if self._stream is None:
            self._source = self._stream = source = PushedSource(array, operation, positions)
            try:
                self._begin(source.shape, source.dtype)
            except InputError:
                self._source = self._stream = None
                raise
        if array.dtype != operation.dtype or array.shape[1:] != operation.shape or len(array) == 0:
            expected = f"{operation.dtype} (n, {operation.shape[0]}, {operation.shape[1]})"
            raise InputError(f"frames are {array.dtype} {array.shape}: {expected} is needed")
        series = {name: as_series(name, values) for name, values in positions.items() if values is not None}
        check_taken(operation, series)
        self._take(block_of(array, operation.count, series, stays_valid=False), self._watch)

    def push_block(self, block: Block, part: slice = slice(None)) -> None:
        """Process a block of the source, or a part of it."""
        self._check_begun()
        if part != slice(None):
            block = part_of(block, part)
        with naming(cast("Source", self._source)):
            self._take(block, self._watch)

    def _take(self, block: Block, watch: FrameChecker | None) -> None:
        operation = self.operation
        if self._final is not None:
            raise InputError(f"the run of {type(operation).__name__} has ended: push frames into a new one")
        names = (*operation.positions, "frame_weights") if operation._weighted else operation.positions
        series = {name: getattr(block, name, None) for name in names}
        frames = block.frames if operation.for_device else on_host(block.frames)
        # Frames may be moved, unless they stay valid: then they are looked at while the device computes.
        later = block.stays_valid and not isinstance(frames, Array)
        samples = None if watch is None or later else take_grid(frames, watch.samples)
        self._push(frames, {k: v for k, v in series.items() if v is not None}, block.stays_valid)
        if watch is not None:
            watch.push(block, take_grid(frames, watch.samples) if samples is None else samples)

    def _push(self, frames: Any, series: Mapping[str, Any], stay_valid: bool) -> None:
        operation = self.operation
        for name, needed in operation.positions.items():
            if needed and name not in series:
                raise InputError(f"{name} is missing: {type(operation).__name__} needs it of each frame")
        operation._stay_valid, operation._on_device = stay_valid, isinstance(frames, Array)
        operation.push(frames, **series)
        operation.count += len(frames)
        for name, values in series.items():
            if name in operation.positions:
                operation._positions_so_far.setdefault(name, []).append(np.array(values, np.float64))

    @property
    def staging_buffer(self) -> Any:
        """Array in which the next frames may be written before they are pushed, (n, H, W)."""
        self._check_begun()
        return self.operation.staging_buffer

    def precompile(self) -> None:
        """Compile and run all kernels with a copy, so that the first frames are not delayed."""
        self._check_begun()
        trial = self._plan.operation._copy_for_run()
        trial._begin(self.operation.shape, self.operation.dtype)
        trial.precompile()

    def preview(self, seconds: float) -> Result:
        """Return the maps of the frames so far for a display; none before they are determined."""
        operation = self.operation
        if self._final is not None:
            return self._final
        has_preview = type(operation).preview is not Operation.preview
        if operation.count < (1 if has_preview else operation.least_frames):
            return Result()
        operation.ended = False
        try:
            maps = operation.preview(seconds)
        except InputError:
            return Result()
        return as_preview(operation, maps) if has_preview else as_result(operation, maps, copied=True)

    def idle_work(self, seconds: float) -> None:
        """Do postponed work, for some seconds at most."""
        self.operation.idle_work(seconds)

    def result(self, *, ended: bool = False, process: Mapping[str, ProcessValue] | None = None) -> Result:
        """Return all maps of the frames so far, after all steps, with findings and provenance.

        Parameters
        ----------
        ended : bool
            Whether no frames follow, so that maps need not be copied. Later calls return the same result.
        process : mapping, optional
            More values for the process of the result.

        Raises
        ------
        mirrorskin.io.InputError
            The frames do not determine them.
        """
        plan, operation = self._plan, self.operation
        if self._final is not None:
            return self._final
        if operation.ended:  # its state is used up
            raise InputError(f"the run of {type(operation).__name__} ended with an error: start a new one")
        self._check_count()
        if operation.passes == 2 and (not operation._second_pass or operation.count != self._expected):
            raise InputError(f"{type(operation).__name__} needs the same frames twice")
        one_reading = self._better_operation() is not None if self._read_once is None else self._read_once
        watch, operation.ended = self._watch, ended
        findings = () if watch is None else watch.findings()  # while the device computes
        computed = as_result(operation, operation.result(), copied=not ended)
        if ended:  # the steps need the memory of frames for maps
            vars(operation).pop("_staging_buffer", None)
            if operation._picture is not None:
                operation._picture.release_frames()
        source = cast("Source", self._source)
        samples, time = (None, None) if watch is None else (watch.samples, watch.series.get("time"))
        first = 0 if plan.frames is None else plan.frames.start
        context = Context(source, operation, cast("Source", self._stream), first, samples, time, computed)
        result = computed.assign(dict.fromkeys(plan.omit)) if plan.omit else computed
        used = {"frames": operation.count} | ({"first_frame": first} if plan.frames is not None else {})
        result = result.with_process(merged(used, plan.process, result.process, process or {}))
        result = attach_provenance(result, source, operation.opened_devices, dict(result.process))
        checks = [kind(**operation.shared_options(kind)) for kind in operation.checks] if plan.checked else []
        for step in (*checks, *plan.steps):
            context.earlier[type(step)] = result
            if all(result.name_of(quantity) for quantity in step.needs):
                result = step.apply(result, context)
        kinds, usual = operation.corrected_kinds, operation.usual_findings
        reported = (_as_corrected(finding, kinds) for finding in findings if finding.kind not in usual)
        result = with_findings(result, *([_ONE_READING] if one_reading else []), *reported)
        self._final = result if ended else None
        return result

    def _check_begun(self) -> None:
        """Raise InputError if the size of the frames is unknown."""
        if self._stream is None:
            raise InputError("this run has no frames yet: give it a source, or push some")

    def _check_count(self) -> None:
        """Raise InputError if fewer frames have been pushed than a result needs."""
        operation = self.operation
        if operation.count < operation.least_frames:
            minimum, count = operation.least_frames, operation.count
            frames = "1 frame" if minimum == 1 else f"{minimum} frames"
            pushed = f"{count} has been" if count == 1 else f"{count or 'none'} have been"
            raise InputError(f"{type(operation).__name__} needs at least {frames}; {pushed} pushed so far")


def run_over(
    source: Source, computed: Operation | Method, progress: Progress | None = None, steps: Sequence[Step] = ()
) -> Result:
    """Return the result of an operation or a method over all frames of a source, and issue its warnings.

    ``steps`` follow those of the plan.
    """
    with exclusive_use(source), naming(source):
        plan = plan_of(computed, source)
        result = Run(replace(plan, steps=[*plan.steps, *steps]), source).complete(progress)
    warn(source.name, result.process)
    return result


def plan_of(computed: Operation | Method, source: Source) -> Plan:
    """Return the plan for a source; InputError if it has another motion, or cannot be used."""
    check_motion(source, computed)
    with exclusive_use(source), naming(source):
        return computed.plan(source)


def check_motion(source: Source, computed: Operation | Method) -> None:
    """Raise InputError if an operation or a method does not apply to a source's motion."""
    if computed.motions and source.motion not in computed.motions:
        motions = " or ".join(computed.motions)
        raise InputError(
            f"{source.name} has {source.motion} motion, but {type(computed).__name__} needs {motions} motion"
        )


def part_of(block: Block, part: slice) -> Block:
    """Return a part of a block."""
    names = ("frames", "time", "travel", "phase", "displacement", "twist", "tilt", "axes", "frame_weights")
    values = {name: getattr(block, name) for name in names}
    parts: dict[str, Any] = {
        name: series if series is None else series[part] for name, series in values.items()
    }
    return replace(block, index=block.index + part.indices(len(block.frames))[0], **parts)


def _as_corrected(finding: Finding, corrected: Sequence[str]) -> Finding:
    """Return a finding, as a note if it is of a kind that was corrected."""
    if finding.kind not in corrected:
        return finding
    return replace(finding, text=f"{finding.text.split(':')[0]}, which is corrected", warning=False)


def check_taken(operation: Operation, series: Mapping[str, Any]) -> None:
    """Raise InputError if an operation does not take some positions."""
    taken = {*operation.positions, "time"} | ({"frame_weights"} if operation._weighted else set())
    if foreign := series.keys() - taken:
        kind = type(operation).__name__
        raise InputError(unknown_argument(kind, min(foreign), [*operation.positions], "position"))


def as_result(operation: Operation, returned: Any, copied: bool) -> Result:
    """Return what a method ``result`` returned by name: maps, and numbers and texts for the process."""
    kind, declared = type(operation).__name__, operation.declarations
    if not isinstance(returned, Mapping):
        raise InputError(f"{kind}.result() returns a {type(returned).__name__}. Return maps by name")
    _check_names(operation, returned)
    if isinstance(returned, Result):
        return (_copied(returned) if copied else returned).with_process(returned.process)
    process, maps = dict[str, Any](), dict[str, Any]()
    for name, value in returned.items():
        option_value = operation.options[name].stored(operation) if name in operation.options else None
        if name in RESERVED or (option_value is not None and not _is_rounded(value, option_value)):
            raise InputError(f"{kind}.result() returns {name}, which has a meaning already. Rename it")
        if not isinstance(value, _SCALARS) or declaration_of(name, declared).axes == "none":
            maps[name] = value.copy() if copied and isinstance(value, np.ndarray) else value
        elif option_value is not None:
            process[name] = option_value
        else:
            process[name] = value.item() if isinstance(value, np.generic) else value
    if not maps:
        raise InputError(f"{kind}.result() returns no map: return at least one, (H, W)")
    try:
        return result_of(maps, operation.shape, process, declared).with_process(process)
    except InputError as error:
        raise InputError(f"{kind}.result(): {error}") from None


def _copied(result: Result) -> Result:
    """Return a result whose maps share no memory with an operation."""
    arrays = {name: values for name, values in result._maps.items() if isinstance(values, np.ndarray)}
    return result.assign({name: values.copy() for name, values in arrays.items()})


def as_preview(operation: Operation, shown: Mapping[str, Any]) -> Result:
    """Return copies of the maps, and the declared numbers, that a method ``preview`` returned by name.

    A `Result` is returned as it is.
    """
    if isinstance(shown, Result):
        return shown
    declared = operation.declarations
    arrays = {name: value.copy() for name, value in shown.items() if isinstance(value, np.ndarray)}
    declared_values = {
        name: arrays.get(name, value) for name, value in shown.items() if name in declared or name in arrays
    }
    try:
        return result_of(declared_values, operation.shape, {}, declared)
    except InputError as error:
        raise InputError(f"{type(operation).__name__}.preview(): {error}") from None


def _is_rounded(value: Any, option_value: Any) -> bool:
    """Return whether a value equals that of an option, or its rounding to float32."""
    first, second = np.asarray(value), np.asarray(option_value)
    if first.dtype.kind in "uif" and second.dtype.kind in "uif":
        first, second = first.astype(np.float32), second.astype(np.float32)
    return (second.ndim == 0 or second.shape == first.shape) and bool(np.all(first == second))


def _check_names(operation: Operation, returned: Mapping[str, Any]) -> None:
    """Raise InputError if a declared map is missing, or a name looks like that of a missing one.

    A ``result`` that overrides another one may return fewer maps than those declared for the other.
    """
    kind, declared = type(operation), operation.declarations
    names = set(returned)  # to look for a name in the result would copy the map from its device
    where = f"{kind.__name__}.result()"
    owner, overridden = [base for base in kind.__mro__ if "result" in vars(base)][:2]
    last = overridden if overridden is Operation else owner
    classes = kind.__mro__[: kind.__mro__.index(last) + 1]
    promised = {name for base in classes for name, value in vars(base).items() if isinstance(value, Map)}
    missing = [name for name in declared if name not in names]
    required = [name for name in missing if name in promised and name not in kind.optional_maps]
    for name in returned:
        quantity = name.removesuffix(SIGMA)
        deviates = quantity != name
        if declaration_of(name, declared) is not UNDECLARED or (deviates and quantity in names):
            continue
        possible = [f"{other}{SIGMA}" for other in declared] if deviates else missing
        if not isinstance(returned, Result) and isinstance(returned[name], _SCALARS):
            possible = required
        if close := nearest(name, possible):
            raise InputError(f"{where} returns {name}, which is not declared: did you mean {close}?")
    if required:
        raise InputError(
            f"{where} does not return {' and '.join(required)}, which its class declares. Return each"
            " declared map, or list those that may be missing in optional_maps"
        )
