"""A user's own estimator, run over a recording, an array, or frames that come one by one."""

from __future__ import annotations

import inspect
import itertools
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.provenance import attach_provenance, signature
from mirrorskin.engine.streaming import Estimator, Progress
from mirrorskin.engine.tiling import MEMORY_LIMIT
from mirrorskin.io import InputError, Result
from mirrorskin.io.maps import declaration_of
from mirrorskin.io.result import result_of

if TYPE_CHECKING:
    from mirrorskin.io import Source

Maker = Callable[[tuple[int, int], np.dtype[Any]], Estimator]
Piece = tuple[NDArray[Any], dict[str, Any]]

_KNOWN = ("time", "travel", "phase", "displacement", "twist", "tilt", "pose", "lent")  # of a block's frames
_NAMED = (inspect.Parameter.KEYWORD_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)


def run(
    source: Source | Iterable[ArrayLike],
    estimator: Estimator | Maker,
    *,
    memory_limit: int = MEMORY_LIMIT,
    progress: Progress | None = None,
    **known: ArrayLike,
) -> Result:
    """Push all frames into an estimator of your own, and return its maps.

    Parameters
    ----------
    source : Source, array_like (T, H, W), or iterable of array_like (H, W)
        An open recording, or anything else that frames come from; it is rewound first, if it can be. An array
        is pushed as a whole, frames of an iterable one by one.
    estimator : Estimator, or callable
        It is reset first. A class, or another callable, is called with a frame's shape, (H, W), and dtype.
    memory_limit : int
        Bytes of host memory for frames on the move; half of it holds what is pushed at once.
    progress : callable, optional
        Called with the number of frames so far.
    **known : array_like, (T, ...)
        Of an array's or iterable's frames: what ``push`` needs to know of each, such as ``travel=``, mm.

    Returns
    -------
    Result
        The maps by name, with the declarations in the estimator's attribute ``maps``, a mapping from names to
        `mirrorskin.io.Map`. Numbers and texts that are not declared are in ``process``.

    Raises
    ------
    mirrorskin.io.InputError
        The estimator lacks a method, needs what is not known of the frames, or returns no maps (H, W).

    Examples
    --------
    >>> class Brightest:
    ...     def __init__(self, shape, dtype):
    ...         self.most = np.zeros(shape, dtype)
    ...     def reset(self):
    ...         self.most[:] = 0
    ...     def push(self, frames):
    ...         np.maximum(self.most, frames.max(axis=0), out=self.most)
    ...     def result(self):
    ...         return {"brightest": self.most}
    >>> run(np.arange(12).reshape(3, 2, 2), Brightest)["brightest"].tolist()
    [[8, 9], [10, 11]]
    """
    own = cast("Source", source) if hasattr(source, "read") and hasattr(source, "header") else None
    if own is not None and known:
        raise InputError(f"{own.name} says itself what is known of its frames: leave {', '.join(known)} out")
    if own is None and (isinstance(source, str | os.PathLike) or not isinstance(source, Iterable)):
        what = "open a path with io.open_recording, or give an array"
        raise InputError(f"frames are a {type(source).__name__}: {what}")
    name = "the frames given" if own is None else own.name
    pieces = _cut(cast("Iterable[ArrayLike]", source), known) if own is None else _read(own, memory_limit)
    first = next(pieces, None)
    if first is None:
        raise InputError(f"{name}: there is none, and at least one is needed")
    made, done = prepare(estimator, first[0].shape[1:], first[0].dtype), 0
    told = wanted(made, first[1], name)
    if unused := known.keys() - set(told):
        raise InputError(f"{_name(made)}.push takes no {', '.join(sorted(unused))}: leave that out")
    for frames, there in itertools.chain([first], pieces):
        made.push(frames, **{one: there[one] for one in told})
        done += len(frames)
        if progress:
            progress(done)
    return finish(made, first[0].shape[1:], own)


def finish(estimator: Estimator, shape: tuple[int, ...], source: Source | None) -> Result:
    """Return an estimator's maps as a result that tells where they come from."""
    found, name = estimator.result(), _name(estimator)
    if isinstance(found, Result):
        return found
    if is_dataclass(found):
        found = {field.name: getattr(found, field.name) for field in fields(found)}
    if not isinstance(found, Mapping):
        raise InputError(f"{name}.result() returns a {type(found).__name__}: maps by name are needed")
    declarations = getattr(estimator, "maps", {})
    numbers = {
        one: value
        for one, value in found.items()
        if isinstance(value, str | int | float | np.generic)
        and declaration_of(one, declarations).axes != "none"
    }
    try:
        maps = {one: value for one, value in found.items() if one not in numbers}
        result = result_of(maps, (shape[0], shape[1]), signature() | {"estimator": name}, declarations)
    except InputError as error:
        raise InputError(f"{name}.result(): {error}") from error
    if source is not None:
        device = getattr(estimator, "device", None)
        result = attach_provenance(result, source, device, {"estimator": name})
    if twice := numbers.keys() & result.process.keys():
        raise InputError(f"{name}.result(): {', '.join(sorted(twice))} is said of every result: rename it")
    told = {one: value.item() if isinstance(value, np.generic) else value for one, value in numbers.items()}
    return result.assign(process={**result.process, **told})


def prepare(estimator: Estimator | Maker, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Estimator:
    """Return an estimator for frames of a shape and type, made if need be, that has seen none."""
    made, arguments = estimator, ((shape[0], shape[1]), dtype)
    if isinstance(estimator, type) or not hasattr(estimator, "push"):
        try:
            called, settings = getattr(estimator, "func", estimator), getattr(estimator, "keywords", {})
            inspect.signature(called).bind(*arguments, **settings)
        except (TypeError, ValueError) as error:
            raise InputError(f"{_name(estimator)}(shape, dtype) cannot be made: {error}") from error
        made = cast(Maker, estimator)(*arguments)
    lacking = [name for name in ("push", "result", "reset") if not callable(getattr(made, name, None))]
    if lacking:
        what = "an estimator has push(frames), result() and reset()"
        raise InputError(f"{_name(made)} has no {' and no '.join(lacking)}: {what}")
    made = cast(Estimator, made)
    made.reset()
    return made


def wanted(estimator: Estimator, there: Mapping[str, Any], name: str) -> list[str]:
    """Return which of the things that are known of frames ``push`` takes."""
    parameters = [*inspect.signature(estimator.push).parameters.values()][1:]
    needed = [one.name for one in parameters if one.default is one.empty and one.kind in _NAMED]
    if lacking := [one for one in needed if one not in there]:
        has = ", ".join(one for one in there if one != "lent") or "nothing"
        raise InputError(
            f"{_name(estimator)}.push needs {', '.join(lacking)}: {name} has {has} of each frame"
        )
    return [one.name for one in parameters if one.name in there]


def _read(source: Source, memory_limit: int) -> Iterator[Piece]:
    """Yield the frames of a source, as many at once as half the memory holds, and what is known of each."""
    count, rows, columns = source.shape
    at_once = max(1, memory_limit // (2 * rows * columns * source.dtype.itemsize))
    room = np.empty((max(1, min(at_once, count)), rows, columns), source.dtype)
    if source.rewindable:
        source.rewind()
    while (block := source.read(room)) is not None:
        known = {name: getattr(block, name) for name in _KNOWN}
        yield block.frames, {name: values for name, values in known.items() if values is not None}


def _cut(frames: Iterable[ArrayLike], known: Mapping[str, ArrayLike]) -> Iterator[Piece]:
    """Yield an array as a whole, or frames one by one, and what is known of each."""
    given = {name: np.asarray(values) for name, values in known.items()}
    whole, done, shape = isinstance(frames, np.ndarray), 0, None
    pieces = [np.asarray(frames)] if whole else (np.asarray(frame)[None] for frame in frames)
    for piece in pieces:
        shape = shape or piece.shape[1:]
        if piece.ndim != 3 or 0 in piece.shape or piece.dtype.kind not in "uif" or piece.shape[1:] != shape:
            raise InputError(
                f"frames are {piece.dtype} {piece.shape[not whole :]}: numbers (H, W) of one size are needed"
            )
        stop = done + len(piece)
        for name, values in given.items():
            if values.ndim == 0 or len(values) < stop or (whole and len(values) != stop):
                raise InputError(f"{name} has shape {values.shape}: one is needed for each of {stop} frames")
        yield piece, {name: values[done:stop] for name, values in given.items()}
        done = stop


def _name(estimator: object) -> str:
    """Return what to call an estimator, its class, or another that makes it."""
    made = getattr(estimator, "func", estimator)  # of functools.partial
    return str(getattr(made, "__name__", type(made).__name__))
