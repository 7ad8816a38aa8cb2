"""Heights from a press or its release: onsets, corrected for the elastomer, with holes filled."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin import io
from mirrorskin.engine.errors import NotConverged
from mirrorskin.engine.press.changepoint import ChangePointSearch
from mirrorskin.engine.press.estimated_levels import EstimatedLevels, EstimatedLevelSearch, estimate_levels
from mirrorskin.engine.press.levels import Levels, LevelSearch, check_levels
from mirrorskin.engine.press.onset import Event, Onset, OnsetSearch, check_event
from mirrorskin.engine.press.strokes import Strokes, StrokeSearch
from mirrorskin.engine.provenance import attach_provenance, estimated_level, level_origin
from mirrorskin.engine.streaming import Progress, feed
from mirrorskin.engine.tiling import MEMORY_LIMIT
from mirrorskin.io import InputError, Result
from mirrorskin.io.maps import PressStatus, ReleaseStatus, status_of
from mirrorskin.io.positions import stroke_starts

if TYPE_CHECKING:
    from mirrorskin.engine.press.elastic import PressFit
    from mirrorskin.io import Calibration, Source
    from mirrorskin.io.types import ProcessValue
    from mirrorskin.kernels.device import Device

PressMethod = Literal["threshold", "change-point"]
METHODS: tuple[PressMethod, ...] = get_args(PressMethod)


def reconstruct_press(
    source: Source,
    *,
    event: Event = "onset",
    method: PressMethod = "threshold",
    threshold: float | Sequence[float] = 0.5,
    inclinations: Sequence[float] | None = None,
    hold: int = 2,
    subframe: bool = True,
    dark: ArrayLike | None = None,
    bright: ArrayLike | None = None,
    noise: float | None = None,
    fill: bool = True,
    modulus: float | None = None,
    memory_limit: int = MEMORY_LIMIT,
    device: str | Device | None = None,
    progress: Progress | None = None,
) -> Result:
    """Reconstruct heights from a press or a release; of one that oscillates also the hysteresis.

    Where travel turns more than once, from a press to its release, all strokes are used: see `StrokeSearch`.

    Parameters
    ----------
    source : Source
        Of vertical motion. It is rewound first, if it can be.
    event : {"onset", "release"}
        Whether heights are those of the light state's begin or of its end.
    method : {"threshold", "change-point"}
        The first crossing of the threshold, or the most likely change.
    threshold, hold, subframe
        As for ``find_onset``. Several thresholds, of a wall with levels, tell between which inclinations the
        sheet lies; heights are by the lowest.
    inclinations : sequence of float, optional
        The sheet's inclinations at which thresholds are passed, radians, for ``slope_min`` and ``slope_max``;
        one for each threshold.
    dark, bright : array_like, scalar or (H, W), optional
        Counts without and with full light, instead of the source's own. What neither gives is estimated from
        the frames, and its uncertainty added to ``height_sigma``; where they do not tell, it is the end of
        the range of their type. ``process`` says which.
    noise : float, optional
        Standard deviation of a sample, counts; by default estimated from the first two frames.
    fill : bool
        Whether to fill holes, such as flat tops, which never turn light: their heights are guesses, marked in
        ``filled``; see `mirrorskin.engine.fill_holes`. It takes a known pixel size.
    modulus : float, optional
        Young's, MPa, for ``pressure`` and ``force``; by default that of the calibration. Forces also take the
        calibration's gel, by which the contact is found.
    memory_limit : int
        Bytes of host memory for frames on the move.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.
    progress : callable, optional
        Called with the number of frames so far.

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
    check_event(event)
    levels = None
    if inclinations is not None or not isinstance(threshold, float | int):
        shares = [threshold] if isinstance(threshold, float | int) else threshold
        levels = check_levels(shares, inclinations)
        threshold = levels[0][0]
    oscillates = _oscillates(source)
    frames = range(source.shape[0]) if oscillates else _frames_of(source, event)
    size = len(frames) * math.prod(source.shape[1:]) * source.dtype.itemsize
    low = source.header.dark if dark is None else dark
    high = source.header.bright if bright is None else bright
    guess = None
    if (low is None or high is None) and method == "threshold":
        guess = estimate_levels(source, frames, low, high)
    search = _search(
        source,
        method,
        subframe,
        oscillates,
        levels and levels[0],
        guess,
        dark=guess.dark if guess and low is None else low,
        bright=guess.bright if guess and high is None else high,
        threshold=threshold,
        hold=hold,
        noise=noise,
        event=event,
        device=device,
        memory_limit=min(memory_limit, 2 * size),
    )
    feed(source, search, frames, progress, long=True)
    twice = isinstance(search, ChangePointSearch) and search.passes == 2
    if isinstance(search, ChangePointSearch) and twice:
        search.start_second_pass()
        feed(source, search, frames, progress)
    found = search.result()
    onset = found.onset if isinstance(found, Levels) else found
    onset = choose_event(onset, event) if isinstance(onset, Strokes) else onset
    process: dict[str, ProcessValue] = {
        "first_frame": frames.start,
        "frames": len(frames),
        "event": event,
        "method": method,
        "threshold": threshold,
        "hold": hold,
        "subframe": subframe,
        "noise": onset.noise,
        "dark": "each pixel's own" if twice else level_origin(source, "dark", dark),
        "bright": "each pixel's own" if twice else level_origin(source, "bright", bright),
    }
    if guess is not None:
        process |= {"dark": estimated_level(guess.dark)} if low is None else {}
        process |= {"bright": estimated_level(guess.bright)} if high is None else {}
    result, done = finish_press(onset, source, search.travel, event, threshold, fill, modulus)
    if isinstance(found, Strokes):
        result, done = add_hysteresis(result, found, event), done | {"strokes": found.strokes}
    if isinstance(found, Levels) and levels is not None:
        lower, upper = found.bounds(levels[1])
        result = result.assign(slope_min=lower, slope_max=upper)
        done |= {"thresholds": str(levels[0]), "inclinations": str(levels[1])}
    return attach_provenance(result, source, search.device, process | done)


def choose_event(strokes: Strokes, event: Event) -> Onset:
    """Return the onsets of all strokes, or the releases."""
    return strokes.onset if event == "onset" else strokes.release


def add_hysteresis(result: Result, strokes: Strokes, event: Event) -> Result:
    """Add to a press's maps what only strokes tell: hysteresis, and in how many there was the event."""
    return result.assign(
        hysteresis=strokes.hysteresis,
        hysteresis_sigma=strokes.hysteresis_sigma,
        strokes=strokes.onsets if event == "onset" else strokes.releases,
    )


def finish_press(
    onset: Onset,
    source: Source,
    travel: NDArray[np.float64],
    event: Event,
    threshold: float,
    fill: bool,
    modulus: float | None = None,
) -> tuple[Result, dict[str, ProcessValue]]:
    """Correct onsets for the elastomer, and find the force, if a calibration describes it, and fill holes.

    Travel, (T,), mm, is that of the frames that the onsets were made of. What was done is for the process.
    """
    result = Result(
        height=onset.height,
        height_sigma=onset.sigma,
        status=onset.status,
        declarations={"status": status_of(PressStatus if event == "onset" else ReleaseStatus)},
    )
    done: dict[str, ProcessValue] = {"fill": "none: not asked"}
    if isinstance(source, io.Calibrated):
        from mirrorskin.engine.press.elastic import correct_press  # splines, a tenth of a second to load

        gel = source.calibration.gel
        result, done["gel"], fit = correct_press(result, source, float(np.max(travel)), threshold, gel)
        result, said = _with_force(result, fit, source.calibration, modulus)
        done |= said
    elif modulus is not None:
        raise InputError(f"{source.name}: a force takes a calibration with a gel: calibrate elastic first")
    pixel_size = source.header.pixel_size
    if fill and pixel_size is None:
        done["fill"] = "none: the recording has no pixel size"
    elif fill and pixel_size is not None:
        from mirrorskin.engine.press.holes import fill_holes

        assert result.height is not None
        assert result.height_sigma is not None
        above = None
        if event == "onset":  # what is light at start was touched before
            above = np.where(result.status == PressStatus.LIGHT_AT_START, -travel[0], np.nan)
        height, filled = fill_holes(
            result.height,
            result.height_sigma,
            pixel_size,
            above=above,
            deepest=-float(np.max(travel)),
        )
        result, done["fill"] = result.assign(height=height, filled=filled), "holes"
    return result, done


def _oscillates(source: Source) -> bool:
    """Tell whether a source's travel does more than go down, and then up, once; as far as it is known."""
    travel: NDArray[np.float64] | None = getattr(source, "travel", None)
    return travel is not None and len(stroke_starts(travel, 1)) > 1


def _with_force(
    result: Result, fit: PressFit | None, calibration: Calibration, modulus: float | None
) -> tuple[Result, dict[str, ProcessValue]]:
    """Add pressure and force, where the modulus is known; what was done is for the process."""
    from mirrorskin.engine.force.normal import check_modulus, force_of_press

    stiffness = calibration.stiffness
    known = stiffness if modulus is None else check_modulus(float(modulus))
    if known is None:
        return result, {}
    if fit is None:
        return result, {"force": "none: the heights are not corrected for the gel"}
    if modulus is None and stiffness is not None and stiffness.gel_threshold != fit.scene.gel.threshold:
        return result, {"force": "none: the modulus was learned with another gel: calibrate force again"}
    try:
        found = force_of_press(fit, known)
    except NotConverged as error:
        return result, {"force": f"none: {error}"}
    made = result.assign(pressure=found.pressure, force=found.force, force_sigma=found.sigma)
    if isinstance(known, float):
        return made, {"modulus": f"{known:g} MPa, given"}
    return made, {"modulus": f"{known.modulus:.4g} MPa of the calibration"}


def _frames_of(source: Source, event: Event) -> range:
    """Return the frames in which a source was pressed, or lifted; all, where it does not know beforehand."""
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
    source: Source,
    method: PressMethod,
    subframe: bool,
    oscillates: bool,
    levels: list[float] | None,
    guess: EstimatedLevels | None,
    **options: Any,
) -> OnsetSearch | ChangePointSearch | StrokeSearch | LevelSearch | EstimatedLevelSearch:
    """Return the estimator of a method, if the source can feed it."""
    shape, dtype = source.shape[1:], source.dtype
    if levels is not None and (oscillates or method != "threshold"):
        raise InputError(
            f"{source.name}: inclinations take method 'threshold' and a press that goes down once"
        )
    if levels is not None:
        del options["threshold"]
        return LevelSearch(shape, dtype, levels, subframe=subframe, **options)
    if oscillates and method != "threshold":
        raise InputError(f"{source.name}: travel oscillates, for which method 'threshold' is needed")
    if oscillates:
        del options["event"]  # it finds both
        return StrokeSearch(shape, dtype, subframe=subframe, **options)
    if guess is not None:
        return EstimatedLevelSearch(shape, dtype, guess, subframe=subframe, **options)
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
