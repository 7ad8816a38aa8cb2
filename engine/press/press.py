"""Heights from a vertical press or its release."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.press.changepoint import ChangePointSearch
from mirrorskin.engine.press.holes import fill_holes
from mirrorskin.engine.press.onset import Event, Onset, OnsetSearch
from mirrorskin.engine.provenance import sign, told_level
from mirrorskin.engine.streaming import Progress, feed
from mirrorskin.engine.tiling import MEMORY_LIMIT
from mirrorskin.io import Calibrated, InputError, ProcessValue, Result, Source
from mirrorskin.kernels.device import Device

PressMethod = Literal["threshold", "change-point"]
METHODS: tuple[PressMethod, ...] = get_args(PressMethod)

_LIGHT_AT_START = 3  # of an onset's status
_NO_PIXEL_SIZE = "none: the recording has no pixel size"


def reconstruct_press(
    source: Source,
    *,
    event: Event = "onset",
    method: PressMethod = "threshold",
    threshold: float = 0.5,
    hold: int = 2,
    subframe: bool = True,
    dark: ArrayLike | None = None,
    bright: ArrayLike | None = None,
    noise: float | None = None,
    fill: bool = True,
    memory_limit: int = MEMORY_LIMIT,
    device: str | Device | None = None,
    progress: Progress | None = None,
) -> Result:
    """Reconstruct heights from a press or a release.

    Parameters
    ----------
    source : Source
        Of vertical motion. It is rewound first, if it can be.
    event : {"onset", "release"}
        Whether to look for the light state's begin or its end.
    method : {"threshold", "change-point"}
        The first crossing of the threshold, or the most likely change.
    threshold, hold, subframe
        As for ``find_onset``.
    dark, bright : array_like, scalar or (H, W), optional
        Counts without and with full light, instead of the source's own.
    noise : float, optional
        Standard deviation of a sample, counts; by default told from the first two frames.
    fill : bool
        Whether to fill holes, such as flat tops, which never turn light: their heights are guesses, marked in
        ``filled``; see `mirrorskin.engine.fill_holes`. It takes a known pixel size.
    memory_limit : int
        Bytes of host memory for frames on the move.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.
    progress : callable, optional
        Told the number of frames so far.

    Returns
    -------
    Result
        ``height_sigma`` is NaN where the height was filled.

    Raises
    ------
    mirrorskin.io.InputError
        The input cannot be used.
    """
    if method not in METHODS:
        known = ", ".join(METHODS)
        raise InputError(f"{source.name} is a press, which method {method!r} cannot do: take {known}")
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
    feed(source, search, frames, progress)
    twice = False
    if isinstance(search, ChangePointSearch) and search.passes == 2:
        twice = True
        search.start_second_pass()
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
        "dark": "each pixel's own" if twice else told_level(source, "dark", dark),
        "bright": "each pixel's own" if twice else told_level(source, "bright", bright),
    }
    travel: NDArray[np.float64] | None = getattr(source, "travel", None)
    used = None if travel is None else travel[frames.start : frames.stop]
    result, done = finish_press(onset, source, used, event, threshold, fill)
    return sign(result, source, search.device, process | done)


def finish_press(
    onset: Onset,
    source: Source,
    travel: NDArray[np.float64] | None,
    event: Event,
    threshold: float,
    fill: bool,
) -> tuple[Result, dict[str, ProcessValue]]:
    """Put onsets right for the gel, if a calibration tells of it, and fill holes; say what was done.

    Parameters
    ----------
    onset : Onset
    source : Source
        Which tells the pixels' size, and the calibration.
    travel : ndarray, (T,), or None
        Of the frames that it was made of, mm; None where that is not known.
    event : {"onset", "release"}
    threshold : float
        Share of the way from dark to bright that is light.
    fill : bool
        Whether holes are to be filled.
    """
    result = Result(height=onset.height, height_sigma=onset.sigma, status=onset.status)
    done: dict[str, ProcessValue] = {"fill": "none: not asked"}
    if isinstance(source, Calibrated):
        from mirrorskin.engine.press.elastic import correct_press  # splines, a tenth of a second to load

        result, done["gel"] = correct_press(result, source, travel, threshold, source.calibration.gel)
    if fill:
        result, done["fill"] = _fill_press(result, source, travel, event)
    return result, done


def _fill_press(
    result: Result, source: Source, travel: NDArray[np.float64] | None, event: Event
) -> tuple[Result, str]:
    """Fill the holes of a height map, where it is known how wide they are, and say what was done."""
    assert result.height is not None
    assert result.height_sigma is not None
    pixel_size = source.header.pixel_size
    if pixel_size is None:
        return result, _NO_PIXEL_SIZE
    above = deepest = None
    if travel is not None:
        deepest = -float(np.max(travel))
        if event == "onset":  # what is light at start was touched before
            above = np.where(result.status == _LIGHT_AT_START, -travel[0], np.nan)
    height, filled = fill_holes(result.height, result.height_sigma, pixel_size, above=above, deepest=deepest)
    return replace(result, height=height, filled=filled), "holes"


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
    source: Source, method: PressMethod, subframe: bool, **options: Any
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
