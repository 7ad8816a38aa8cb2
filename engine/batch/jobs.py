"""Which recording becomes which result."""

from __future__ import annotations

import os
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from mirrorskin.io import InputError


@dataclass(frozen=True, slots=True)
class Job:
    """A recording, and the result to make of it.

    Attributes
    ----------
    source, target : Path
    """

    source: Path
    target: Path


def make_jobs(paths: Iterable[Path], folder: Path) -> list[Job]:
    """Name a result in a folder for each recording.

    ``NAME.h5`` becomes ``NAME-result.h5``. Recordings of one name keep their folders below the one that they
    have in common, and their endings where those alone tell them apart.

    Parameters
    ----------
    paths : iterable of Path
        Recordings; one that is named twice is one job.
    folder : Path
        Where the results go. It need not exist yet.

    Returns
    -------
    list of Job
        In the order of the paths.

    Raises
    ------
    InputError
        A result would overwrite a recording, or another result.
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
        for source, name in zip(alike, _tell_apart(alike), strict=True)
    }
    _check(sources, targets.values())
    return [Job(source, targets[source]) for source in sources]


def _tell_apart(sources: Sequence[Path]) -> list[str]:
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
    return Path(os.path.normpath(path.absolute()))


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
