"""Vibrations on the twin: an oscillating press, a body that rocks, and a press that dithers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mirrorskin.cli.demo.presses import lab_camera
from mirrorskin.cli.output import print_table

if TYPE_CHECKING:
    from mirrorskin import hw, io

_BACKLASH = 0.05  # mm: what the press lags behind where it is said to be, when it comes up
_TRAVEL, _TURN = 1.2, 0.388  # mm; radians of the oscillation from frame to frame, so that no stroke repeats
_TILT, _DIRECTION, _ZENITH, _PRESS = math.radians(2.5), 0.6, math.radians(24), 1.2
_ROCK_FRAMES, _ROCK_TURN = 48, 0.385
_DEPTH, _SWING, _DITHER_FRAMES, _DITHER_TURN = 1.0, 0.05, 74, math.tau / 7.3
_FIELD = 6.0  # mm
_FAINT = math.radians(14)  # zenith
_SIDES, _APART = 5, 7  # of the pyramid; pixels, across, that show one of them
_HEAD = ["vibration", "found", "sigma", "truth", "chi2"]
_LEGEND = """\
height: RMS error and RMS of the predicted standard deviation after all strokes, um. hysteresis: mean over
the same pixels; the truth is the backlash of the twin's stage, um. slope: RMS error and RMS of the predicted
standard deviation, of a pyramid, away from its ridges and the contact's border. growth: mm^2 of light for
each mm of travel, of a ball in elastic contact."""


@dataclass(frozen=True)
class Experiment:
    """Strokes down, and pixels of a side."""

    strokes: int = 16
    size: int = 110


EXPERIMENT = Experiment()
Outcomes = Mapping[str, Mapping[str, float]]


def run(experiment: Experiment, folder: Path, device: str | None) -> Outcomes:
    """Oscillate, rock and dither, and draw what comes out."""
    import numpy as np

    from mirrorskin import io, view

    strokes, pressed, height = _oscillate(experiment, device)
    rocked, slope = _rock(experiment, device)
    dithered, growth = _dither(experiment, device)
    for name, result in (("strokes", pressed), ("rocked", rocked), ("dither", dithered)):
        io.save_result(result, folder / f"vibration-{name}-result.h5")
    found = view.Vibration(strokes, pressed, height, _BACKLASH, rocked, slope, dithered, growth)
    view.vibration_figure(found, "Vibration on the twin", folder / "vibration.png")
    chi = {name: float(np.mean(values**2)) for name, values in found.deviations.items()}
    assert pressed.hysteresis is not None
    assert pressed.hysteresis_sigma is not None
    assert rocked.slope is not None
    assert rocked.slope_sigma is not None
    touched = (rocked.contact == 1) & np.isfinite(slope)
    wrong = (rocked.slope - slope)[touched]
    known = np.isfinite(height)
    return {
        "height": {"found": 1e3 * strokes[-1][1], "sigma": 1e3 * strokes[-1][2], "chi2": chi["height"]},
        "hysteresis": {
            "found": 1e3 * float(np.nanmean(pressed.hysteresis[known])),
            "sigma": 1e3 * float(np.sqrt(np.nanmean(pressed.hysteresis_sigma[known] ** 2))),
            "truth": 1e3 * _BACKLASH,
            "chi2": chi["hysteresis"],
        },
        "slope": {
            "found": float(np.sqrt(np.mean(wrong**2))),
            "sigma": float(np.sqrt(np.mean(rocked.slope_sigma[touched] ** 2))),
            "chi2": chi["slope"],
        },
        "growth": {
            "found": float(dithered.process["area_growth"]),
            "sigma": float(dithered.process["area_growth_sigma"]),
            "truth": growth,
        },
    }


def _oscillate(
    experiment: Experiment, device: str | None
) -> tuple[list[tuple[float, float, float]], io.Result, Any]:
    """Press with a stage that has a backlash; return errors by strokes, the result, and true heights."""
    import numpy as np

    from mirrorskin import engine, io
    from mirrorskin.hw.twin import Vertical
    from mirrorskin.io.positions import stroke_starts

    said = _TRAVEL / 2 * (1 - np.cos(_TURN * np.arange(round(experiment.strokes * math.tau / _TURN))))
    true = [0.0]
    for place in said[1:]:
        true.append(float(np.clip(true[-1], place, place + _BACKLASH)))
    twin = _twin(experiment, "sphere", Vertical(np.array(true)), device=device, references="exact")
    header = twin.header
    # What is hardly light when it touches is crossed by noise, and its release is found too early.
    steep = twin.truth.zenith > _FAINT
    truth = np.where(steep, twin.truth.height, np.float32(np.nan))
    search = engine.StrokeSearch(
        twin.shape[1:], twin.dtype, dark=header.dark, bright=header.bright, device=device
    )
    frames = np.empty(twin.shape, twin.dtype)
    twin.read(frames)
    reached = truth > -_TRAVEL + _BACKLASH
    curve: list[tuple[float, float, float]] = []
    ends = stroke_starts(said, 1)[::2].tolist()
    for start, stop in zip([0, *ends], ends, strict=False):
        search.push(frames[start:stop], travel=said[start:stop])
        onset = search.result().onset
        known = reached & np.isfinite(onset.height)
        error = (onset.height - truth)[known]
        rms = [float(np.sqrt(np.mean(one.astype(float) ** 2))) for one in (error, onset.sigma[known])]
        curve.append((len(curve) + 1.0, rms[0], rms[1]))
    search.push(frames[ends[-1] :], travel=said[ends[-1] :])
    found = search.result()
    x, y = io.pixel_axes((twin.shape[1], twin.shape[2]), twin.header.pixel_size or (1.0, 1.0))
    result = io.Result(
        height=found.onset.height,
        height_sigma=found.onset.sigma,
        status=found.onset.status,
        hysteresis=found.hysteresis,
        hysteresis_sigma=found.hysteresis_sigma,
        strokes=found.onsets,
        x=x,
        y=y,
    )
    return curve, result, truth


def _rock(experiment: Experiment, device: str | None) -> tuple[io.Result, Any]:
    """Rock on a pyramid about its tip; return the result, and true slopes, NaN next to ridges and border."""
    import numpy as np
    from scipy import ndimage

    from mirrorskin import engine, io
    from mirrorskin.hw.twin import HeightMap, Leaning

    side = _FIELD * 1.5
    x, y = io.pixel_axes((600, 600), (side / 600, side / 600))
    around = math.tau * np.arange(_SIDES)[:, np.newaxis, np.newaxis] / _SIDES
    sides = x * np.cos(around) + y[:, np.newaxis] * np.sin(around)
    pyramid = HeightMap(-math.tan(_ZENITH) * sides.max(axis=0), (side / 600, side / 600), "pyramid")
    tilt = _TILT * np.sin(_ROCK_TURN * np.arange(_ROCK_FRAMES))
    movement = Leaning(np.full(_ROCK_FRAMES, _DIRECTION), tilt, _PRESS, (0.0, 0.0, _PRESS))
    twin = _twin(experiment, pyramid, movement, device=device, pattern="linear")
    result, truth = engine.reconstruct(twin, device=device), twin.truth
    towards = truth.azimuth - float(result.process["slope_direction"])
    slope = -np.tan(truth.zenith) * np.cos(towards)
    one_side = ndimage.maximum_filter(slope, _APART) - ndimage.minimum_filter(slope, _APART) < 1e-3
    touched = ndimage.binary_erosion(truth.contact == 1, iterations=2)
    return result, np.where(one_side & touched, slope, np.nan)


def _dither(experiment: Experiment, device: str | None) -> tuple[io.Result, float]:
    """Dither on a ball in elastic contact; return the result, and how its light grows without noise."""
    import numpy as np

    from mirrorskin.engine.rotation.rotation import correlate_source
    from mirrorskin.hw.twin import Camera, Vertical

    travel = _DEPTH + _SWING * np.cos(_DITHER_TURN * np.arange(_DITHER_FRAMES))
    known = {"contact": "elastic", "references": "exact", "device": device}
    noisy = _twin(experiment, "sphere", Vertical(travel), **known)
    result = correlate_source(noisy, dither=True, device=device)
    ends = np.array([_DEPTH - _SWING / 2, _DEPTH + _SWING / 2])
    clean = _twin(
        experiment, "sphere", Vertical(ends), **known, camera=Camera(np.dtype(np.uint16), noise=0.0)
    )
    frames = np.empty(clean.shape, clean.dtype)
    clean.read(frames)
    header = clean.header
    assert header.dark is not None
    assert header.bright is not None
    share = (frames - header.dark.astype(float)) / (header.bright - header.dark)
    pixel = (_FIELD / experiment.size) ** 2
    return result, float(np.sum(share[1] - share[0])) * pixel / _SWING


def _twin(
    experiment: Experiment, thing: Any, movement: hw.twin.Movement, device: str | None, **others: Any
) -> hw.Twin:
    from mirrorskin import hw

    return hw.Twin(
        object=thing,
        shape=(experiment.size, experiment.size),
        pixel_size=_FIELD / experiment.size,
        movement=movement,
        device=device,
        **({"camera": lab_camera()} | others),
    )


def print_outcomes(outcomes: Outcomes) -> None:
    """Print what was found, and what the rows are."""
    rows = [
        [name, *(f"{found[key]:.4g}" if key in found else "-" for key in _HEAD[1:])]
        for name, found in outcomes.items()
    ]
    print_table(_HEAD, rows)
    click.echo(_LEGEND)
