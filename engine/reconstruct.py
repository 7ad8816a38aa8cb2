"""From a source to a result: the right method for the motion, and the one loop that feeds it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Any, Literal, Protocol, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.changepoint import ChangePointSearch
from mirrorskin.engine.onset import OnsetSearch
from mirrorskin.engine.search import MEMORY_LIMIT, Event
from mirrorskin.io import Block, InputError, ProcessValue, Recording, Result, Source, pixel_axes
from mirrorskin.kernels.device import Device

Progress = Callable[[int], None]
Method = Literal["threshold", "change-point"]
METHODS: tuple[Method, ...] = get_args(Method)


class Estimator(Protocol):
    """What the loop feeds: it takes in blocks, and offers room to read them into."""

    @property
    def room(self) -> NDArray[np.generic]:
        """Where the next frames may be written, (n, H, W)."""

    def push(self, block: Block) -> None:
        """Take in the next frames."""


def feed(source: Source, estimator: Estimator, frames: range, progress: Progress | None = None) -> None:
    """Push frames of a source into an estimator.

    Parameters
    ----------
    source : Source
        Before its first frame.
    estimator : Estimator
    frames : range
        Which of them, in steps of 1; those before are read and dropped.
    progress : callable, optional
        Told the number of frames so far.
    """
    done = 0
    while done < frames.stop:
        wanted = done >= frames.start
        block = source.read(estimator.room[: (frames.stop if wanted else frames.start) - done])
        if block is None:
            return
        if wanted:
            estimator.push(block)
        done += len(block.frames)
        if progress:
            progress(done)


def reconstruct(
    source: Source,
    *,
    event: Event = "onset",
    method: Method = "threshold",
    threshold: float = 0.5,
    hold: int = 2,
    subframe: bool = True,
    dark: ArrayLike | None = None,
    bright: ArrayLike | None = None,
    noise: float | None = None,
    memory_limit: int = MEMORY_LIMIT,
    device: str | Device | None = None,
    progress: Progress | None = None,
) -> Result:
    """Reconstruct what was touched, by the method that fits the source's motion.

    Parameters
    ----------
    source : Source
        An open recording, or anything else that frames come from. It is rewound first, if it can be.
    event : {"onset", "release"}
        Whether to look for the light state's begin or its end. A source that knows its travel beforehand, as
        a recording does, may hold a press and its release: the frames up to the greatest travel are the
        press, those from it on the release, and those at it belong to both.
    method : {"threshold", "change-point"}
        Whether the first crossing of the threshold tells the height, or all samples around the change do.
    threshold, hold, subframe, noise
        See ``find_onset`` and ``find_change_point``, which always looks between the frames.
    dark, bright : array_like, scalar or (H, W), optional
        Counts to use instead of the source's own references. A change-point without both of them reads the
        source twice.
    memory_limit : int
        Bytes of host memory for frames on the move.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.
    progress : callable, optional
        Told the number of frames so far.

    Returns
    -------
    Result

    Raises
    ------
    mirrorskin.io.InputError
        The motion is not one that can be reconstructed, the event is not in the travel, the input cannot be
        used, or the source would have to be read twice and cannot be.
    """
    if source.motion != "vertical":
        raise InputError(
            f"{source.name} is of {source.motion} motion: only vertical ones can be reconstructed yet"
        )
    if method not in METHODS:
        raise InputError(f"unknown method {method!r}; known are {', '.join(METHODS)}")
    header = source.header
    frames = _frames_of(source, event)
    size = len(frames) * math.prod(source.shape[1:]) * source.dtype.itemsize
    search = _search(
        source,
        method,
        subframe,
        dark=header.dark if dark is None else dark,
        bright=header.bright if bright is None else bright,
        threshold=threshold,
        hold=hold,
        noise=noise,
        event=event,
        device=device,
        memory_limit=min(memory_limit, 2 * size),
    )
    if source.rewindable:
        source.rewind()
    feed(source, search, frames, progress)
    twice = False
    if isinstance(search, ChangePointSearch) and search.passes == 2:
        twice = True
        source.rewind()
        search.rewind()
        feed(source, search, frames, progress)
    onset = search.result()
    process: dict[str, ProcessValue] = {
        "first_frame": frames.start,
        "frames": len(frames),
        "event": event,
        "method": method,
        "threshold": threshold,
        "hold": hold,
        "subframe": subframe,
        "noise": onset.noise,
        "dark": "each pixel's own" if twice else _told(dark, header.dark),
        "bright": "each pixel's own" if twice else _told(bright, header.bright),
    }
    result = Result(height=onset.height, height_sigma=onset.sigma, status=onset.status)
    return _signed(result, source, search.device, process)


def _frames_of(source: Source, event: Event) -> range:
    """Tell in which frames a source was pressed, or lifted; all, where it does not know beforehand."""
    travel: NDArray[np.float64] | None = getattr(source, "travel", None)
    if travel is None:
        return range(source.shape[0])
    deepest = np.flatnonzero(travel == travel.max())
    rises, falls = travel[0] < travel[deepest[0]], travel[-1] < travel[deepest[0]]
    if event == "release":
        if rises and not falls:
            raise InputError(f"{source.name}: travel only rises: that is a press; give event onset")
        return range(int(deepest[0]), source.shape[0])
    if falls and not rises:
        raise InputError(f"{source.name}: travel only falls: that is a release; give event release")
    return range(int(deepest[-1]) + 1)


def _search(
    source: Source, method: Method, subframe: bool, **options: Any
) -> OnsetSearch | ChangePointSearch:
    """Make the search that was asked for, if the source can feed it."""
    shape, dtype = source.shape[1:], source.dtype
    if method == "threshold":
        return OnsetSearch(shape, dtype, subframe=subframe, **options)
    if not subframe:
        raise InputError("a change-point lies between frames: equation 4 as printed needs method 'threshold'")
    if not source.rewindable and (options["dark"] is None or options["bright"] is None):
        raise InputError(
            f"{source.name} cannot be read twice, as a change between unknown levels needs: "
            "give dark and bright"
        )
    return ChangePointSearch(shape, dtype, **options)


def _signed(result: Result, source: Source, device: Device, process: dict[str, ProcessValue]) -> Result:
    """Add where the pixels are, and how the maps came about."""
    x = y = None
    if source.header.pixel_size is not None:
        x, y = pixel_axes(source.shape[1:], source.header.pixel_size)
    origin: dict[str, ProcessValue] = {"source": source.name}
    if isinstance(source, Recording):
        origin |= {"dataset": source.dataset, "source_sha256": source.sha256()}
    made: dict[str, ProcessValue] = {
        "program": "mirrorskin",
        "version": version("mirrorskin"),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "device": device.info.title,
        "driver": device.info.driver,
    }
    return replace(result, x=x, y=y, process=made | origin | process)


def _told(given: ArrayLike | None, own: NDArray[np.float32] | None) -> ProcessValue:
    """Say in a word what served as a reference."""
    if given is not None:
        return float(given) if np.ndim(given) == 0 else "map given"  # type: ignore[arg-type]
    return "range of the type" if own is None else "map of the recording"
