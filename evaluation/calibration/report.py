"""The accuracy of a calibration: from flat fields and balls to objects outside the calibration.

``python evaluation/calibration/report.py [--quick] [--cache DIR] [--only zenith,tilt,...]`` prints the
targets and what was measured, before the calibration and after it. Light that was traced is kept in the
folder. The judge is `calibration_scorer`, which shares no code with mirrorskin.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mirrorskin import engine, io
from mirrorskin.engine.calibration import brightness, gel, references, tilt, tilt_tracks, wall
from mirrorskin.engine.calibration.gel import ball_onset
from mirrorskin.engine.rotation.rotation import Rotation
from mirrorskin.evaluation.base.sources import Frames
from mirrorskin.evaluation.base.tables import Table
from mirrorskin.evaluation.calibration import scorer
from mirrorskin.evaluation.calibration.scenes import BALL, Lab, balls, held_out, nine_balls
from mirrorskin.evaluation.calibration.scorer import Judge, Score, Surface

APART = 3.9  # mm between the calibration's balls
REACH = 10.0  # mm, that held-out objects go from the middle
FLATS = 64  # frames of a flat field
CREASE = 3.2  # pixels from a crease from which on a pixel is judged: samples are made of 4 x 4


@dataclass(frozen=True)
class Row:
    """A line of the table."""

    what: str
    target: str
    measured: str
    before: str
    good: bool


ONE = Lab(tilt_error=math.radians(0.05), phase_error=math.radians(25), pivot_error=1.0)
ANOTHER = Lab(
    shape=(240, 330),
    pixel_size=0.04,
    pivot=(0.0, 0.0, 0.0),
    lamp_azimuth=-2.2,
    distance=120.0,
    scatter=math.radians(2.0),
    seed=5,
    tilt=math.radians(2.4),
)
PRINTED = Lab(gamma=2.2, lamp_azimuth=2.6, distance=160.0, seed=23, pivot=(-0.2, 0.3, 1.0))

SOFT = Lab(shape=(160, 160), pixel_size=0.06, uniform=True, seed=31)
TRAVEL = np.round(np.arange(0, 1.0, 0.02), 3)
COMPLIANCE = 0.01  # mm/N, of the stage


# --- the whole way ------------------------------------------------------------------------------------------


def calibrate(lab: Lab, apart: float = APART, every: int = 1) -> io.Calibration:
    """Find out all that a rotation needs, as the commands do it: flat fields, then balls at nine places.

    The movement is found by every so manieth of them.
    """
    taken = references.measure_references([lab.flat(0.0, FLATS, 900)], [lab.flat(1.0, FLATS, 901)]).references
    presses = nine_balls(lab, apart, 1)
    response = wall.fit_zenith(presses, BALL / 2, references=taken)
    pixel = lab.pixel_size, lab.pixel_size
    light = brightness.WallBrightness.of_pixels(response, taken.dark, taken.bright, lab.shape, pixel)
    tracks = []
    for press in presses[::every]:
        press.rewind()
        tracks.append(tilt_tracks.track_ball(press, BALL / 2, light))
    precession = tilt.fit_precession(tracks, depth_sigma=light.depth_sigma).precession
    camera = io.CameraId("", lab.shape, np.dtype("uint8"))
    return io.Calibration(camera, taken, None, response, precession)


def as_designed(lab: Lab, calibration: io.Calibration) -> tuple[io.Calibration, dict[str, Any]]:
    """Return what one had before: references, and the scale of a wall whose every pixel is its centre."""
    taken = calibration.references
    assert taken is not None
    low, high = lab.rig.dark_zenith, lab.rig.light_zenith
    gain = (taken.bright.astype(float) - taken.dark) / (high - low)
    scale = {"zenith_gain": gain, "zenith_offset": taken.dark - low * gain}
    return replace(calibration, zenith=None), scale


def normals_of(frames: Frames, calibration: io.Calibration, **options: Any) -> io.Result:
    """Return the normals of an object that was turned about, without the heights that fit them."""
    frames.rewind()
    source = io.Calibrated(frames, calibration)
    plan = Rotation(**options).plan(source)
    return engine.Run(replace(plan, steps=[]), source).complete()


def field_scores(
    lab: Lab, calibration: io.Calibration, things: Sequence[tuple[Surface, float]], cells: int = 8
) -> tuple[Score, Score]:
    """Return the scores over the field before and after, of all objects together."""
    x, y = scorer.pixel_grid(lab.shape, lab.pixel_size)
    before, after = Judge(cells), Judge(cells)
    plain, scale = as_designed(lab, calibration)
    for number, (surface, press) in enumerate(things):
        view = scorer.see(lab.rig, surface, x, y, press)
        bound = scorer.bounds(lab.rig, view, CREASE * lab.pixel_size, lab.half)
        frames = lab.turned(surface, press, 20 + number)
        normals = normals_of(frames, plain, **scale)
        before.add(normals.zenith, normals.azimuth, view, bound, normals.normals_sigma)
        normals = normals_of(frames, calibration)
        after.add(normals.zenith, normals.azimuth, view, bound, normals.normals_sigma)
    return before.score(), after.score()


# --- rows of the table --------------------------------------------------------------------------------------


def rows_of_the_field(name: str, lab: Lab, calibration: io.Calibration, number: int) -> Iterator[Row]:
    """Judge the normals of held-out objects."""
    before, after = field_scores(lab, calibration, [*held_out(REACH)[:number], *balls()])
    for angle in ("zenith", "azimuth"):
        within, old = getattr(after, f"{angle}_share"), getattr(before, f"{angle}_share")
        part, was = (getattr(score.cells, angle) for score in (after, before))
        yield Row(
            f"{name}: {angle}, cells within 1.2 x bound",
            "90 %",
            f"{100 * within:.0f} % (ratio {np.nanmedian(part.ratio):.2f}, worst {np.nanmax(part.ratio):.2f})",
            f"{100 * old:.0f} % (ratio {np.nanmedian(was.ratio):.1f}, RMS {np.nanmedian(was.rms):.2f} deg)",
            within >= 0.9,
        )
    worst, old = (np.nanmax(np.abs(score.bins.zenith.bias)) for score in (after, before))
    printed = lab.gamma != 1  # the others' bias counts in the bound already
    cells = f"{worst:.3f} deg", f"{old:.2f} deg", worst <= 0.1 or not printed
    yield Row(f"{name}: zenith bias, worst bin", "0.1 deg" if printed else "", *cells)
    yield Row(
        f"{name}: zenith bias, all",
        "",
        f"{after.zenith_bias:+.3f} deg",
        f"{before.zenith_bias:+.2f} deg",
        True,
    )


def rows_of_the_movement(name: str, lab: Lab, calibration: io.Calibration) -> Iterator[Row]:
    """Judge the precession: the recordings told another one."""
    precession = calibration.precession
    assert precession is not None
    turned = math.degrees(math.remainder(precession.phase_offset - lab.phase_error, math.tau))
    errors = {
        "d": (math.degrees(precession.tilt - lab.tilt), math.degrees(precession.sigma["tilt"]), 0.02, "deg"),
        "phase": (turned, math.degrees(precession.sigma["phase_offset"]), 0.1, "deg"),
        "pivot height": (precession.pivot[2] - lab.pivot[2], precession.sigma["pivot_z"], 1.0, "mm"),
    }
    stated = (math.degrees(-lab.tilt_error), math.degrees(-lab.phase_error), -lab.pivot_error)
    for (what, (error, sigma, bound, unit)), was in zip(errors.items(), stated, strict=True):
        measured = f"{error:+.4f} {unit} (sigma {sigma:.4f})"
        yield Row(f"{name}: {what}", f"{bound:g} {unit}", measured, f"{was:+.2f} {unit}", abs(error) <= bound)


def row_of_the_print(lab: Lab, calibration: io.Calibration) -> Row:
    """Compare the curve that was found with the print, as the middle of the field sees it."""
    response = calibration.zenith
    assert response is not None
    q = np.linspace(max(response.reach[0], 0.05), min(response.reach[1], 0.6), 200)
    angle = np.pi / 4 - np.arctan(q)
    low, high = lab.rig.dark_zenith, lab.rig.light_zenith
    true = np.clip((angle - low) / (high - low), 0, 1) ** lab.gamma / (1 + lab.asymmetry)
    error = np.abs(np.polynomial.polynomial.polyval(q, response.curve) - true).max()
    return Row(
        f"gamma of {lab.gamma:g}: the print",
        "recovered",
        f"off by {error:.4f} of full light at most",
        "",
        error < 0.01,
    )


def rows_of_the_gel(cache: Path) -> Iterator[Row]:
    """Learn a gel on the ball, and judge the heights of other balls, where both ways have an answer."""
    lab = replace(SOFT, cache=cache)
    taken = references.measure_references([lab.flat(0.0, FLATS, 900)], [lab.flat(1.0, FLATS, 901)]).references
    plain = io.Calibration(io.CameraId("", lab.shape, np.dtype("uint8")), taken)
    learned = lab.pressed(scorer.ball(BALL), TRAVEL, 1, COMPLIANCE)
    onset = engine.reconstruct(learned, calibration=plain, fill=False)
    compliance = gel.fit_gel([ball_onset(onset, learned, BALL / 2)]).gel
    x, y = scorer.pixel_grid(lab.shape, lab.pixel_size)
    for take, size in enumerate((6.0, 10.0), 2):
        press = lab.pressed(scorer.ball(size), TRAVEL, take, COMPLIANCE)
        true = scorer.ball(size).height(x, y)
        maps = []
        for calibration in (plain, replace(plain, gel=compliance)):
            press.rewind()
            maps.append(engine.reconstruct(press, calibration=calibration, fill=False).height)
        where = np.isfinite(true) & np.isfinite(maps).all(axis=0)
        before, after = (scorer.score_heights(heights, true, where) for heights in maps)
        measured, was = (f"{1e3 * part.bias:+.1f} um (RMS {1e3 * part.rms:.1f})" for part in (after, before))
        good = 5 * abs(after.bias) <= abs(before.bias)
        yield Row(f"elastic: height bias, ball of {size:g} mm", "a fifth", measured, was, good)


PARTS = ("one", "another", "gamma", "elastic")


def all_rows(cache: Path, parts: Sequence[str], objects: int) -> Iterator[Row]:
    """Go through the parts that are asked for."""
    labs = {"one": ONE, "another": ANOTHER, "gamma": PRINTED}
    for name, lab in labs.items():
        if name in parts:
            kept = replace(lab, cache=cache)
            calibration = calibrate(kept)
            yield from rows_of_the_field(name, kept, calibration, objects)
            yield from rows_of_the_movement(name, kept, calibration)
            yield row_of_the_print(kept, calibration)
    if "elastic" in parts:
        yield from rows_of_the_gel(cache)


def measure(cache: Path | None = None, parts: Sequence[str] = PARTS, objects: int = 6) -> Table:
    """Return the table; the folder keeps traced light."""
    with tempfile.TemporaryDirectory() as folder:
        cache = cache or Path(folder)
        cache.mkdir(exist_ok=True)
        rows = list(all_rows(cache, parts, objects))
    cells = [(row.what, row.target, row.measured + " (missed)" * (not row.good), row.before) for row in rows]
    return Table("Errors of a calibrated sensor", ("error", "target", "calibrated", "before"), cells)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cache", type=Path, help="folder that keeps light")
    parser.add_argument("--quick", action="store_true", help="fewer objects")
    parser.add_argument("--only", default=",".join(PARTS), help="parts, with commas between them")
    options = parser.parse_args()
    print(measure(options.cache, options.only.split(","), 2 if options.quick else 6))


if __name__ == "__main__":
    main()
