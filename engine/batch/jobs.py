"""The jobs of a batch (recordings and their results), and the plan of their reconstruction."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import sys
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mirrorskin.engine.base.method import Method
from mirrorskin.engine.base.operation import Operation
from mirrorskin.engine.base.options import plain
from mirrorskin.engine.base.provenance import program_version
from mirrorskin.engine.base.reconstruction import load_operation, method_for
from mirrorskin.engine.base.tiling import MEMORY_LIMIT
from mirrorskin.io import InputError, Motion
from mirrorskin.io.base.own_class import importable_name, name_of
from mirrorskin.io.base.url import Url


@dataclass(frozen=True, slots=True)
class Job:
    """A recording, and the file of its result."""

    source: Path
    target: Path


def make_jobs(paths: Iterable[Path], folder: Path) -> list[Job]:
    """Choose the name of each recording's result in a folder.

    The result of ``NAME.h5`` is ``NAME-result.h5``. Results of recordings with the same name are in
    subfolders, relative to their common folder; recordings that differ in the ending only keep it.

    Examples
    --------
    >>> make_jobs([Path("a.h5")], Path("out"))[0].target
    PosixPath('out/a-result.h5')
    """
    by_location: dict[Path, Path] = {}
    for path in paths:
        by_location.setdefault(_absolute(path), path)
    sources = list(by_location.values())
    names: dict[str, list[Path]] = defaultdict(list)
    for source in sources:
        names[source.stem].append(source)
    targets = {
        source: folder / name
        for same_name in names.values()
        for source, name in zip(same_name, _distinct_names(same_name), strict=True)
    }
    inputs = {os.path.realpath(source) for source in sources}
    outputs: set[str] = set()
    for target in targets.values():
        real = os.path.realpath(target)
        if real in inputs:
            raise InputError(f"{target} is one of the recordings: choose another folder for results with -o")
        if real in outputs:
            raise InputError(f"{target} would be the result of two recordings: rename one of them")
        outputs.add(real)
    return [Job(source, targets[source]) for source in sources]


def _distinct_names(sources: Sequence[Path]) -> list[str]:
    """Return names of results for recordings with the same name, relative to the folder of results."""
    if len(sources) == 1:
        return [f"{sources[0].stem}-result.h5"]
    folders = [_absolute(source).parent for source in sources]
    common = Path(os.path.commonpath(folders))
    shared = Counter(folders)
    names = [
        f"{source.stem if shared[folder] == 1 else source.name}-result.h5"
        for source, folder in zip(sources, folders, strict=True)
    ]
    return [str(folder.relative_to(common) / name) for folder, name in zip(folders, names, strict=True)]


def _absolute(path: Path) -> Path:
    """Return the absolute path without '..'; links are not resolved."""
    return Path(os.path.normpath(f"/{path}" if isinstance(path, Url) else path.absolute()))


_IRRELEVANT = {"source", "memory_limit", "device", "threads"}  # options that do not change results
_OF_MOTION = {"travel": "vertical", "phase": "axial", "tilt": "axial"}  # parameters of one motion only
TABLES: Mapping[Motion, str] = {
    "vertical": "press", "axial": "rotation", "horizontal": "slip", "twist": "slip"
}  # fmt: skip
"""Attribute of a plan with the options of each motion's method."""


@dataclass(frozen=True, slots=True)
class Plan:
    """Settings for every recording of a batch; can be pickled."""

    opening: Mapping[str, Any] = field(default_factory=dict)  # keywords of `io.open_recording`
    press: Mapping[str, Any] = field(default_factory=dict)  # options of `engine.Press`
    rotation: Mapping[str, Any] = field(default_factory=dict)  # options of `engine.Rotation`
    memory_limit: int = MEMORY_LIMIT  # bytes of host memory for frames that are read ahead, per device
    slip: Mapping[str, Any] = field(default_factory=dict)  # options of `engine.Slide`
    operation: str | type = ""  # class of an operation that is run instead of all methods, or MODULE:CLASS
    operation_options: Mapping[str, Any] = field(default_factory=dict)
    strict: bool = False  # whether warnings are errors

    def kind(self, motion: Motion) -> type[Operation | Method]:
        """Return the class that is run over recordings of a motion."""
        return load_operation(self.operation) if self.operation else method_for(motion)

    def options(self, motion: Motion) -> Mapping[str, Any]:
        """Return the options of that class."""
        chosen = self.operation_options if self.operation else getattr(self, TABLES[motion])
        return {**chosen, "memory_limit": self.memory_limit}

    def for_other_processes(self) -> Plan:
        """Return the plan with the name of its operation; InputError if others cannot import the class."""
        operation = self.operation
        name = importable_name(operation) if isinstance(operation, type) else operation
        return dataclasses.replace(self, operation=name)

    def key(self, motion: Motion) -> str:
        """Return everything in the plan that affects the results of a motion, as text.

        Defaults are included, so giving an option its default value does not change the key.
        """
        opening = {
            name: value
            for name, value in self.opening.items()
            if value is not None and name not in _IRRELEVANT and _OF_MOTION.get(name, motion) == motion
        }
        kind = self.kind(motion)
        defaults = {name: declared.default for name, declared in kind.options.items()}
        values = defaults | dict(self.options(motion))
        used = {name: value for name, value in values.items() if name not in _IRRELEVANT}
        operation = name_of(self.operation) if isinstance(self.operation, type) else self.operation
        table = {"operation": operation, "code": _code(kind)} if self.operation else {}
        name = "options" if self.operation else TABLES[motion]
        parts = {"version": program_version(), "opening": opening, name: used, **table}
        return json.dumps(_as_json(parts), sort_keys=True)

    def digest(self, motion: Motion) -> str:
        """Return the SHA-256 of ``key``, in hexadecimal."""
        return hashlib.sha256(self.key(motion).encode()).hexdigest()


def _code(kind: type) -> str:
    """Return the SHA-256 of the file that contains a class, since its results may change with the code."""
    path = getattr(sys.modules[kind.__module__], "__file__", None)
    return "" if path is None else hashlib.sha256(Path(path).read_bytes()).hexdigest()


def _as_json(value: Any) -> Any:
    """Convert a value to JSON types."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {entry.name: _as_json(getattr(value, entry.name)) for entry in dataclasses.fields(value)}
        return {type(value).__name__: fields}
    if isinstance(value, Mapping):
        return {str(name): _as_json(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_as_json(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return _as_json(value.tolist())
    return plain(value)
