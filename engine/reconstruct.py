"""From a source to a result: the right method for the motion, and the one loop that feeds it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.onset import MEMORY_LIMIT, OnsetSearch
from mirrorskin.io import Block, InputError, ProcessValue, Recording, Result, Source, pixel_axes
from mirrorskin.kernels.device import Device

Progress = Callable[[int], None]


class Estimator(Protocol):
    """What the loop feeds: it takes in blocks, and offers room to read them into."""

    @property
    def room(self) -> NDArray[np.generic]:
        """Where the next frames may be written, (n, H, W)."""

    def push(self, block: Block) -> None:
        """Take in the next frames."""


def feed(source: Source, estimator: Estimator, progress: Progress | None = None) -> None:
    """Push all frames of a source into an estimator.

    Parameters
    ----------
    source : Source
    estimator : Estimator
    progress : callable, optional
        Told the number of frames so far.
    """
    done = 0
    while (block := source.read(estimator.room)) is not None:
        estimator.push(block)
        done += len(block.frames)
        if progress:
            progress(done)


def reconstruct(
    source: Source,
    *,
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
        An open recording, or anything else that frames come from.
    threshold, hold, subframe, noise
        See ``find_onset``.
    dark, bright : array_like, scalar or (H, W), optional
        Counts to use instead of the source's own references.
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
        The motion is not one that can be reconstructed, or the input cannot be used.
    """
    if source.motion != "vertical":
        raise InputError(
            f"{source.name} is of {source.motion} motion: only vertical ones can be reconstructed yet"
        )
    header = source.header
    search = OnsetSearch(
        source.shape[1:],
        source.dtype,
        dark=header.dark if dark is None else dark,
        bright=header.bright if bright is None else bright,
        threshold=threshold,
        hold=hold,
        subframe=subframe,
        noise=noise,
        device=device,
        memory_limit=min(memory_limit, 2 * math.prod(source.shape) * source.dtype.itemsize),
    )
    feed(source, search, progress)
    onset = search.result()
    process: dict[str, ProcessValue] = {
        "method": "onset",
        "threshold": threshold,
        "hold": hold,
        "subframe": subframe,
        "noise": onset.noise,
        "dark": _told(dark, header.dark),
        "bright": _told(bright, header.bright),
    }
    result = Result(height=onset.height, height_sigma=onset.sigma, status=onset.status)
    return _signed(result, source, search.device, process)


def _signed(result: Result, source: Source, device: Device, process: dict[str, ProcessValue]) -> Result:
    """Add where the pixels are, and how the maps came about."""
    x = y = None
    if source.header.pixel_size is not None:
        x, y = pixel_axes(source.shape[1:], source.header.pixel_size)
    origin: dict[str, ProcessValue] = {"source": source.name, "frames": source.shape[0]}
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
