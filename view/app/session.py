"""What the application works on: a recording with options and its results, or a stored result."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from mirrorskin import engine, io
from mirrorskin.engine.base.options import Option, plain
from mirrorskin.engine.base.reconstruction import calibrated, load_operation, method_for, run_class
from mirrorskin.engine.base.summary import summarise
from mirrorskin.engine.metrology import Measures
from mirrorskin.engine.metrology.masks import inside_polygon
from mirrorskin.io.files.opening import is_result
from mirrorskin.io.formats.registry import is_of_others
from mirrorskin.io.model.result import map_shape
from mirrorskin.view.result.sheet import Sheet, sheet_of

T = TypeVar("T")

Ends = tuple[tuple[float, float], tuple[float, float]]
"""Ends of a section, x and y, mm; pixels where the pixel size is unknown."""

Polygon = tuple[tuple[float, float], ...]
"""Corners, x and y, as those ends."""

_MODULE = "mirrorskin.engine"
_KEPT = 400_000_000  # bytes of results that are kept, so that options can be changed back at once


@dataclass(frozen=True)
class Opening:
    """How a recording is opened: what the command line says about it.

    Attributes
    ----------
    keywords : mapping
        Keywords of `mirrorskin.io.open_recording`, except for region and frames.
    words : sequence of str
        The same as words of a command.
    calibration : Path, optional
    device : str, optional
    operation : str
        ``MODULE:CLASS``; by default the method for the motion.
    region, frames
        As for `mirrorskin.io.open_recording`.
    """

    keywords: Mapping[str, Any] = field(default_factory=dict)
    words: Sequence[str] = ()
    calibration: Path | None = None
    device: str | None = None
    operation: str = ""
    region: io.Region | None = None
    frames: tuple[int, int | None] | None = None


@dataclass(frozen=True)
class Computed:
    """A result, what it was computed with, and its measures by what was measured."""

    result: io.Result
    label: str
    seconds: float = 0.0
    measures: dict[Hashable, Measures | io.InputError] = field(default_factory=dict, compare=False)

    @cached_property
    def summary(self) -> str:
        """The result in one line."""
        return str(summarise(self.result))

    @property
    def size(self) -> int:
        """Bytes of the maps."""
        return sum(values.nbytes for values in self.result.values())


@dataclass(frozen=True)
class Choice:
    """What a result is computed with, which can be undone."""

    kind: type[Any]
    changed: dict[str, Any]
    region: io.Region | None
    frames: tuple[int, int | None] | None

    @property
    def key(self) -> Hashable | None:
        """What is equal for equal results; None if it depends on files that may change."""
        options = self.kind.options
        if any(_is_file(options[name], value) for name, value in self.changed.items()):
            return None
        values = sorted((name, repr(plain(value))) for name, value in self.changed.items())
        return self.kind, tuple(values), self.region, self.frames


class Run(Protocol):
    """Calls a function, perhaps in another thread, and then another one with what it returned."""

    def __call__(self, work: Callable[[], T], then: Callable[[T], object], /) -> None:
        """Call ``work``, and ``then`` with its result."""


def run_now(work: Callable[[], T], then: Callable[[T], object], /) -> None:
    """Call both functions at once; the page shows the warnings."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", io.MirrorskinWarning)
        result = work()
    then(result)


class _OutdatedError(Exception):
    """A result is being computed with options that have changed since, or that nobody needs."""


class Session:
    """A recording with an operation, its options and results, or a stored result.

    Callbacks given to `watch` are called after a change.

    Parameters
    ----------
    source : path, Recording or Result
        What is shown.
    opening : Opening
    run : Run
        How results are computed and drawings prepared, one after the other.
    run_aside : Run, optional
        How results are measured, which takes longer, one after the other.

    Raises
    ------
    mirrorskin.io.InputError
        The file cannot be read.
    """

    def __init__(
        self,
        source: str | Path | io.Recording | io.Result,
        opening: Opening | None = None,
        run: Run = run_now,
        run_aside: Run | None = None,
    ) -> None:
        self.run, self.run_aside = run, run_aside or run
        self.computing = self._closed = False
        self._version = 0  # of what is to be computed
        self._watchers: dict[str, list[Callable[[], None]]] = {}
        self.opening = opening = opening or Opening()
        self.path: Path | None = Path(source) if isinstance(source, str | Path) else None
        self.whole: io.Recording | None = None  # all frames of the whole picture
        self._part: io.Recording | None = None
        self.region, self.frames = opening.region, opening.frames
        self.now: Computed | None = None
        self.before: Computed | None = None
        self.problem = ""
        self.failed = False  # whether the result is older than the options, which cannot be used
        self._samples: tuple[int, int, NDArray[Any]] | None = None
        self.pixel: tuple[int, int] | None = None  # row and column in the whole picture
        self.measured: io.Region | None = None  # pixels of the maps
        self.sections: list[Ends] = []
        self.masks: list[Polygon] = []
        self.turn: int | None = None
        self.changed: dict[str, Any] = {}  # options that differ from their defaults
        self.refused: dict[str, str] = {}  # why the text in the field of an option is not used
        self.other: Computed | None = None  # what is compared with the result instead of the previous one
        self._done: list[Choice] = []
        self._undone: list[Choice] = []
        self._kept: dict[Hashable, Computed] = {}  # the least recently used one first
        if isinstance(source, io.Result):
            self.name = str(source.process.get("source", "result"))
            self._keep(Computed(source, "stored result"))
        elif isinstance(source, io.Recording):
            self.name, self.whole, self._part = source.name, source, source
        elif holds_result(Path(source)):
            self.name = Path(source).name
            self._keep(Computed(io.open_result(source), "stored result"))
        else:
            self.name = Path(source).name
            self.whole = io.open_recording(source, **opening.keywords)
        if self.whole is not None:
            kind = load_operation(opening.operation) if opening.operation else method_for(self.whole.motion)
            self.kind: type[Any] = kind
            self._first_kind = kind
            self.compute()

    @property
    def can_cut(self) -> bool:
        """Whether a region and frames can be chosen: the recording can be opened again."""
        return self.whole is not None and self.path is not None

    @property
    def is_method(self) -> bool:
        """Whether the operation is the method of the motion, as that of ``mirrorskin reconstruct``."""
        return self.whole is not None and self.kind is method_for(self.whole.motion)

    @property
    def kind_name(self) -> str:
        """``MODULE:CLASS`` of the operation."""
        named = self.opening.operation
        return named if named and self.kind is self._first_kind else _name_of(self.kind)

    def operations(self) -> dict[str, str]:
        """Return the operations that apply to the motion: names as in `load_operation`, by label."""
        if self.whole is None:
            return {}
        motion, names = self.whole.motion, {}
        for name in engine.__all__:
            kind = getattr(engine, name)
            if not isinstance(kind, type) or not issubclass(kind, engine.Operation | engine.Method):
                continue
            where = getattr(kind, "motions", ())
            needed = [position for position, must in getattr(kind, "positions", {}).items() if must]
            has = all(getattr(self.whole, position, None) is not None for position in needed)
            if kind not in (engine.Operation, engine.Method) and has and (not where or motion in where):
                method = kind is method_for(motion)
                names[f"{name} (all steps)" if method else name] = f"{_MODULE}:{name}"
        if self.opening.operation:
            names[self.opening.operation.rpartition(":")[2]] = self.opening.operation
        return dict(sorted(names.items(), key=lambda item: not item[0].endswith("(all steps)")))

    def options(self) -> dict[str, Option]:
        """Return the options that can be chosen, by name."""
        kind = getattr(self, "kind", None)
        return {} if kind is None else {n: o for n, o in kind.options.items() if not o.python_only}

    def value(self, name: str) -> Any:
        """Return the value of an option."""
        return self.changed.get(name, self.kind.options[name].default)

    def watch(self, *names: str, callback: Callable[[], None]) -> None:
        """Call back after a change, such as of "result", "problem", "pixel", "measured", "ends" or "part"."""
        for name in names:
            self._watchers.setdefault(name, []).append(callback)

    def _tell(self, *names: str) -> None:
        for callback in dict.fromkeys(
            callback for name in names for callback in self._watchers.get(name, [])
        ):
            callback()

    @property
    def choice(self) -> Choice:
        """What the result is computed with."""
        return Choice(self.kind, dict(self.changed), self.region, self.frames)

    @property
    def can_undo(self) -> bool:
        """Whether `undo` has something to do."""
        return bool(self._done)

    @property
    def can_redo(self) -> bool:
        """Whether `redo` has something to do."""
        return bool(self._undone)

    def undo(self) -> None:
        """Return to the operation, options and part before the last change."""
        if self._done:
            self._undone.append(self.choice)
            self._return_to(self._done.pop())

    def redo(self) -> None:
        """Repeat the last change that was undone."""
        if self._undone:
            self._done.append(self.choice)
            self._return_to(self._undone.pop())

    def _return_to(self, choice: Choice) -> None:
        self.kind, self.changed, self.refused = choice.kind, dict(choice.changed), {}
        self._use_part(choice.region, choice.frames)
        self._tell("operation")
        self.compute()

    def _remember(self) -> None:
        self._done.append(self.choice)
        self._undone.clear()

    def choose_operation(self, name: str) -> None:
        """Choose another operation; its options have their defaults."""
        kind = load_operation(name)
        same = kind is self.kind and not self.changed  # there is nothing to undo, and nothing to compute
        if not same:
            self._remember()
        self.kind, self.changed, self.refused = kind, {}, {}
        self._tell("operation", "problem")
        if not same:
            self.compute()

    def choose(self, name: str, value: Any) -> None:
        """Set an option, and compute the result again; a value that is refused leaves the reason only."""
        declared = self.kind.options[name]
        try:
            checked = declared.check(value)
        except io.InputError as error:
            self.refuse(name, str(error))
            return
        if self.refused.pop(name, None):
            self._tell("problem")
        kept = value if isinstance(value, str) else checked  # of a file its name, not what it contains
        if _same(kept, self.value(name)):
            return
        self._remember()
        self.changed.pop(name, None)
        if not _same(kept, declared.default):
            self.changed[name] = kept
        self.compute()

    def refuse(self, name: str, why: str) -> None:
        """Keep the result, which does not belong to the text in the field of an option."""
        self.refused[name] = why
        self._tell("problem")

    def choose_part(self, region: io.Region | None, frames: tuple[int, int | None] | None) -> None:
        """Use a part of the recording, and compute the result again."""
        if (region, frames) != (self.region, self.frames):
            self._remember()
            self._use_part(region, frames)
            self.compute()

    def _use_part(self, region: io.Region | None, frames: tuple[int, int | None] | None) -> None:
        if (region, frames) == (self.region, self.frames):
            return
        self.region, self.frames = region, frames
        if self._part is not None:
            self.run(self._part.close, _ignore)  # it may be in use
            self._part = self._samples = None
        self.measured, self.sections, self.masks = None, [], []
        self._tell("part")

    def point_at(self, row: int, column: int) -> None:
        """Choose a pixel of the whole picture."""
        assert self.whole is not None
        rows, columns = self.whole.shape[1:]
        if 0 <= row < rows and 0 <= column < columns:
            self.pixel = row, column
            self._tell("pixel")

    def measure_in(self, region: io.Region | None) -> None:
        """Choose the region of the maps that is measured; None for all."""
        self.measured = region
        self._tell("measured")

    def mask(self, polygons: Sequence[Polygon]) -> None:
        """Leave out what is inside of polygons, such as dust, from the measures."""
        self.masks = [*polygons]
        self._tell("measured")

    def cut(self, *sections: Ends) -> None:
        """Choose the ends of the sections; none for the row through the highest point."""
        self.sections = [*sections]
        self._tell("ends")

    @property
    def ends(self) -> Ends | None:
        """Ends of the first section; None for the row through the highest point."""
        return self.sections[0] if self.sections else None

    @property
    def compared(self) -> Computed | None:
        """What the result is compared with: another file's result, or the previous one."""
        return self.other or self.before

    def compare(self, other: Computed | None) -> None:
        """Compare with another result; None for the previous one."""
        self.other = other
        self._tell("compared")

    def measures(
        self,
    ) -> tuple[Measures | io.InputError | None, Callable[[], Measures | io.InputError | None]]:
        """Return the measures of the shown result, if they are known, and a function that measures.

        It returns None if another result is shown when it is called.
        """
        now, region, masks = self.now, self.measured, [*self.masks]
        sheet = self.sheet(now)  # of the turn that is chosen now
        assert now is not None
        assert sheet is not None
        key = region, repr(masks), self.turn

        def measure() -> Measures | io.InputError | None:
            if self._closed or self.now is not now:
                return None
            if key not in now.measures:
                try:
                    dust = [inside_polygon(sheet.x, sheet.y, corners) for corners in masks]
                    mask = ~np.any(dust, axis=0) if dust else None
                    now.measures[key] = engine.measure(sheet.result, region=region, mask=mask)
                except io.InputError as error:
                    now.measures[key] = error
            return now.measures[key]

        return now.measures.get(key), measure

    def choose_turn(self, turn: int) -> None:
        """Choose the turn whose maps are shown."""
        self.turn = turn
        self._tell("result")

    @property
    def turns(self) -> int:
        """Number of turns that the maps have; 0 for maps of all turns together."""
        size = () if self.now is None else map_shape(self.now.result)
        return size[0] if len(size) == 3 else 0

    def sheet(self, computed: Computed | None) -> Sheet | None:
        """Return the maps of a result with their coordinates, of the chosen turn."""
        if computed is None or not computed.result.maps():
            return None
        size = map_shape(computed.result)
        turn = min(self.turn or 0, size[0] - 1) if len(size) == 3 else None
        return sheet_of(io.select_turn(computed.result, turn))

    def part(self) -> io.Recording:
        """Return the recording with the chosen frames and region."""
        if self._part is None:
            assert self.path is not None
            self._part = io.open_recording(
                self.path, **self.opening.keywords, region=self.region, frames=self.frames
            )
        return self._part

    def brightness(self, row: int, column: int) -> NDArray[Any]:
        """Return the samples of a pixel of the part, (T,)."""
        part, whole = self.part(), self.whole
        assert whole is not None
        if self._samples is None or self._samples[:2] != (row, column):
            # Of the whole recording: the part may be in use.
            down, right = (at - start for at, start in zip(part.origin, whole.origin, strict=True))
            first = 0 if part is whole or self.frames is None else self.frames[0]
            numbers = range(first, first + part.shape[0])
            samples = [whole.frame(number)[row + down, column + right] for number in numbers]
            self._samples = row, column, np.array(samples, part.dtype)
        return self._samples[2]

    def source(self) -> io.Source:
        """Return the part with its calibration."""
        return calibrated(self.part(), self.opening.calibration)

    def compute(self) -> None:
        """Compute the result with the current options; the last one is kept next to it."""
        self._version += 1
        version, kind, changed, label = self._version, self.kind, dict(self.changed), self.label()
        key = self.choice.key
        if (computed := self._kept.get(key)) is not None:
            self.problem, self.computing = "", False
            self._end(version, computed, key)
            return
        self.problem, self.computing = "", True
        self._tell("problem")
        try:
            source = self.source()
        except Exception as error:
            self._end(version, error)
            return

        def check(_: int) -> None:
            if version != self._version:
                raise _OutdatedError

        def work() -> Computed | Exception:
            started = time.perf_counter()
            try:
                check(0)
                source.rewind()
                result = run_class(kind, source, check, device=self.opening.device, **changed)
            except Exception as error:
                return error
            computed = Computed(result, label, time.perf_counter() - started)
            _ = computed.summary  # here, not in the thread that answers pages
            return computed

        self.run(work, lambda computed: self._end(version, computed, key))

    def _end(self, version: int, computed: Computed | Exception, key: Hashable | None = None) -> None:
        """Keep a result, or report why there is none, unless it is outdated."""
        if version != self._version:
            return
        self.computing = False
        self.failed = isinstance(computed, Exception)
        if isinstance(computed, Computed):
            if key is not None:
                keep_recent(self._kept, key, computed, _KEPT)
            self._keep(computed)
            return
        self.problem = str(computed)
        self._tell("problem")
        if not hasattr(computed, "exit_code"):  # not one of the project's own
            raise computed

    def label(self) -> str:
        """Return the options that were changed, in words."""
        parts = [f"{name.replace('_', ' ')} {shown(value)}" for name, value in self.changed.items()]
        if self.frames is not None:
            parts.append(f"frames {self.frames[0]}:{'' if self.frames[1] is None else self.frames[1]}")
        if self.region is not None:
            parts.append(f"region {self.region.text}")
        return ", ".join(parts) or "default options"

    def _keep(self, computed: Computed) -> None:
        _ = computed.summary
        self.before, self.now = self.now, computed
        self._tell("result", "problem")

    def close(self) -> None:
        """Close the recording; what is being computed is given up."""
        self._version += 1
        self._closed = True
        for recording in (self.whole, self._part):
            if recording is not None and self.path is not None:
                self.run(recording.close, _ignore)


def holds_result(path: Path) -> bool:
    """Return whether a file is a result, not frames."""
    return not is_of_others(path) and is_result(path)


def keep_recent(kept: dict[Any, Computed], key: Hashable, computed: Computed, limit: int) -> None:
    """Keep a result as the one that was used last, and not more than fit into a number of bytes."""
    kept.pop(key, None)
    kept[key] = computed
    while len(kept) > 1 and sum(one.size for one in kept.values()) > limit:
        kept.pop(next(iter(kept)))


def _is_file(option: Option, value: Any) -> bool:
    return option.kind in ("file", "path") or (option.kind == "map" and isinstance(value, str))


def shown(value: Any) -> str:
    """Return the value of an option for a label."""
    if isinstance(value, bool):
        return "on" if value else "off"
    if isinstance(value, float):
        return f"{value:.6g}"
    return ", ".join(map(shown, value)) if isinstance(value, list) else str(value)


def _ignore(_: object) -> None:
    """Do nothing with what a function returned."""


def _same(first: Any, other: Any) -> bool:
    first, other = plain(first), plain(other)
    return type(first) is type(other) and bool(first == other)


def _name_of(kind: type[Any]) -> str:
    public = getattr(engine, kind.__name__, None) is kind
    return f"{_MODULE if public else kind.__module__}:{kind.__name__}"
