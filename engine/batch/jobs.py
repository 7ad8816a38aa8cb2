"""What a batch does: which recording becomes which result, and how each is reconstructed."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import inspect
import json
import os
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mirrorskin.engine.press.press import reconstruct_press
from mirrorskin.engine.provenance import program_version
from mirrorskin.engine.rotation.rotation import reconstruct_rotation
from mirrorskin.engine.slip.search import MOTIONS as SLIP_MOTIONS
from mirrorskin.engine.slip.slip import reconstruct_slip
from mirrorskin.engine.tiling import MEMORY_LIMIT
from mirrorskin.io import InputError, Motion, Result
from mirrorskin.io.url import Url


@dataclass(frozen=True, slots=True)
class Job:
    """A recording, and the result to make of it."""

    source: Path
    target: Path


def make_jobs(paths: Iterable[Path], folder: Path) -> list[Job]:
    """Name a result in a folder for each recording.

    ``NAME.h5`` becomes ``NAME-result.h5``. Recordings of one name keep their folders below the one that they
    have in common, and their endings where only those differ.

    Examples
    --------
    >>> make_jobs([Path("a.h5")], Path("out"))[0].target
    PosixPath('out/a-result.h5')
    """
    once: dict[Path, Path] = {}
    for path in paths:
        once.setdefault(_absolute(path), path)
    sources = list(once.values())
    names: dict[str, list[Path]] = defaultdict(list)
    for source in sources:
        names[source.stem].append(source)
    targets = {
        source: folder / name
        for alike in names.values()
        for source, name in zip(alike, _distinct_names(alike), strict=True)
    }
    _check(sources, targets.values())
    return [Job(source, targets[source]) for source in sources]


def _distinct_names(sources: Sequence[Path]) -> list[str]:
    """Name the results of recordings of one name, below the results' folder."""
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
    """Return the whole path, without '..', but with the links that lead there."""
    return Path(os.path.normpath(f"/{path}" if isinstance(path, Url) else path.absolute()))


def _check(sources: Sequence[Path], targets: Iterable[Path]) -> None:
    """Refuse results that would overwrite a recording, or each other."""
    inputs = {os.path.realpath(source) for source in sources}
    taken: set[str] = set()
    for target in targets:
        real = os.path.realpath(target)
        if real in inputs:
            raise InputError(f"{target} is one of the recordings: choose another folder for results with -o")
        if real in taken:
            raise InputError(f"{target} would be the result of two recordings: rename one of them")
        taken.add(real)


# These change how a result is made, not what is in it.
_NO_MATTER = {"source", "memory_limit", "device", "progress", "threads"}
# Parameters of a stack that only one motion uses.
_OF_MOTION = {"travel": "vertical", "phase": "axial", "tilt": "axial"}


@dataclass(frozen=True, slots=True)
class Plan:
    """What is done with every recording of a batch. It can be pickled."""

    opening: Mapping[str, Any] = field(default_factory=dict)  # keywords of `io.open_recording`
    press: Mapping[str, Any] = field(default_factory=dict)  # of `engine.reconstruct`, for vertical motion
    rotation: Mapping[str, Any] = field(default_factory=dict)  # and for axial motion
    memory_limit: int = MEMORY_LIMIT  # bytes of host memory for frames on the move, of each device
    slip: Mapping[str, Any] = field(default_factory=dict)  # and for slides and twists

    def options(self, motion: Motion) -> Mapping[str, Any]:
        """Return the keywords of `mirrorskin.engine.reconstruct` for a motion."""
        chosen = {"vertical": self.press, "axial": self.rotation}.get(motion, self.slip)
        return {**chosen, "memory_limit": self.memory_limit}

    def key(self, motion: Motion) -> str:
        """Write down, always in the same words, everything of the plan that changes a motion's results.

        Defaults are included: a parameter that is given with its default's value changes nothing.
        """
        opening = {
            name: value
            for name, value in self.opening.items()
            if value is not None and name not in _NO_MATTER and _OF_MOTION.get(name, motion) == motion
        }
        used: dict[str, Any] = {"version": program_version(), "opening": opening}
        if motion == "vertical":
            used["press"] = {**_defaults(reconstruct_press), **self.press}
        if motion == "axial":
            used["rotation"] = {**_defaults(reconstruct_rotation), **self.rotation}
        if motion in SLIP_MOTIONS:
            used["slip"] = {**_defaults(reconstruct_slip), **self.slip}
        return json.dumps(_as_json(used), sort_keys=True)

    def digest(self, motion: Motion) -> str:
        """Return the SHA-256 of ``key``, in hexadecimal."""
        return hashlib.sha256(self.key(motion).encode()).hexdigest()


@functools.cache
def _defaults(function: Callable[..., Result]) -> Mapping[str, Any]:
    parameters = inspect.signature(function).parameters.items()
    return {name: parameter.default for name, parameter in parameters if name not in _NO_MATTER}


def _as_json(value: Any) -> Any:
    """Convert a value to what JSON can hold."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {one.name: _as_json(getattr(value, one.name)) for one in dataclasses.fields(value)}
        return {type(value).__name__: fields}
    if isinstance(value, Mapping):
        return {str(name): _as_json(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_as_json(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return _as_json(value.tolist())
    return str(value) if isinstance(value, Path) else value
