"""Targets of a calibration from touches of unknown objects, next to that with five presses of a ball.

``python evaluation/calibration/touches.py [--cache DIR] [--only ball,touches,sensors,prior]`` prints what was
measured. The sensor is the twin with a wall, uneven lamps and perspective; the further touch is of an object
that no calibration has seen. The least possible errors are those of ``fisher.py``.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mirrorskin import engine, io
from mirrorskin.evaluation.base.sources import Frames
from mirrorskin.evaluation.base.tables import Table
from mirrorskin.evaluation.calibration import scorer
from mirrorskin.evaluation.calibration.scenes import BALL, Lab, held_out, nine_balls, press_for
from mirrorskin.evaluation.calibration.scorer import Surface

PHASE = tuple(float(phase) for phase in np.arange(12) * np.pi / 6)
LAB = Lab(shape=(96, 96), pixel_size=0.1, phase=PHASE, distance=150.0)
REACH, APART = 6.0, 3.0  # mm: of objects, and between the calibration's balls
FURTHER = scorer.waves(0.18, 2.1, 0.8, REACH)
BOUND = 1.2  # times the errors with a ball
SENSORS, THINGS = 6, 3  # with which errors are compared with standard errors, and touches of each
WRONG = math.radians(2.5), math.radians(0.1)  # a stated half-angle, and its standard deviation
TRUE = math.radians(3.0)


def mixed_objects() -> list[tuple[Surface, float]]:
    """Return ten objects, and how far to press them: waves, facets and cones."""
    things = [thing for thing, _ in held_out(REACH)]
    things += [scorer.waves(0.15, 1.6, turned, REACH) for turned in (0.1, 0.7)]
    things += [scorer.cone(math.radians(zenith), 4.0, (0.3, -0.2)) for zenith in (20, 28)]
    return [(thing, press_for(thing)) for thing in things]


def references_of(lab: Lab) -> io.References:
    """Return the references of a sensor."""
    levels = [lab.flat(light, 64, take) for light, take in ((0.0, 900), (1.0, 901))]
    return engine.calibration.measure_references(levels[:1], levels[1:]).references


def camera_of(lab: Lab) -> io.CameraId:
    """Return the camera of a sensor."""
    return io.CameraId("", lab.shape, np.dtype("uint8"))


def as_designed(lab: Lab, taken: io.References) -> dict[str, Any]:
    """Return the approximate response that is known without any calibration: that of the wall's centre."""
    low, high = lab.rig.dark_zenith, lab.rig.light_zenith
    gain = float(np.nanmedian(taken.bright - taken.dark)) / (high - low)
    return {"zenith_gain": gain, "zenith_offset": float(np.nanmedian(taken.dark)) - low * gain}


def by_balls(lab: Lab, taken: io.References) -> io.Calibration:
    """Return the calibration with five presses of a ball."""
    balls = nine_balls(lab, APART, 1)[::2]
    response = engine.calibration.fit_zenith(balls, BALL / 2, references=taken)
    pixel = lab.pixel_size, lab.pixel_size
    light = engine.calibration.WallBrightness.of_pixels(response, taken.dark, taken.bright, lab.shape, pixel)
    tracks = []
    for ball in balls:
        ball.rewind()
        tracks.append(engine.calibration.track_ball(ball, BALL / 2, light))
    movement = engine.calibration.fit_precession(tracks, depth_sigma=light.depth_sigma).precession
    return io.Calibration(camera_of(lab), taken, zenith=response, precession=movement)


def touch(lab: Lab, surface: Surface, press: float, take: int, taken: io.References) -> tuple[Frames, Frames]:
    """Return a press of an object with uniform light, and a turn with the graded wall."""
    travel = np.round(np.arange(0.0, press + 1e-9, 0.02), 3)
    pressed = replace(lab, uniform=True).lowered(surface, travel, 1000 + take)
    turned = lab.turned(surface, press, take)
    pressed.header = replace(pressed.header, dark=taken.dark, bright=taken.bright)
    turned.header = replace(turned.header, dark=taken.dark, bright=taken.bright)
    return pressed, turned


def from_touches(lab: Lab, taken: io.References, objects: int, stated: Mapping[str, Any]) -> Any:
    """Return the fit of a calibration to touches of mixed objects."""
    touches = [
        touch(lab, surface, press, 30 + number, taken)
        for number, (surface, press) in enumerate(mixed_objects()[:objects])
    ]
    return engine.calibration.from_touches(touches, stated=stated, body=(lab.body.radius, lab.body.height))


def height_error(lab: Lab, source: Frames, calibration: io.Calibration, **options: Any) -> float:
    """Return the RMS error of the heights of a turn of the further object, without their mean, µm."""
    source.rewind()
    result = engine.reconstruct(source, calibration=calibration, **options)
    x, y = scorer.pixel_grid(lab.shape, lab.pixel_size)
    view = scorer.see(lab.rig, FURTHER, x, y, press_for(FURTHER))
    bound = scorer.bounds(lab.rig, view, 3 * lab.pixel_size, lab.half)
    error = np.where(np.isfinite(bound.zenith), result.height - view.z, np.nan)
    return float(1e3 * np.nanstd(error))


def rows(lab: Lab, parts: Sequence[str]) -> Iterator[tuple[str, str, str]]:
    """Yield lines of the table: what, target, measured."""
    taken = references_of(lab)
    further = lab.turned(FURTHER, press_for(FURTHER), 20)
    plain = io.Calibration(camera_of(lab), taken)
    yield (
        "heights as designed",
        "",
        f"{height_error(lab, further, plain, **as_designed(lab, taken)):.3g} µm",
    )
    with_ball = math.nan
    if "ball" in parts or "touches" in parts:
        with_ball = height_error(lab, further, by_balls(lab, taken))
        yield "heights with five presses of a ball", "", f"{with_ball:.3g} µm"
    stated = {"tilt": (lab.tilt, math.radians(0.2))}
    if "touches" in parts:
        yield from _rows_of_touches(lab, plain, further, with_ball, stated)
    if "sensors" in parts:
        yield from _rows_of_sensors(lab)
    if "prior" in parts:
        try:
            notes = from_touches(replace(lab, tilt=TRUE), taken, 3, {"tilt": WRONG}).notes
        except io.InputError as error:
            notes = (f"refused: {error}",)
        told = next((note for note in notes if "tilt" in note or "half-angle" in note), "not reported")
        yield "a half-angle of 3.0 degrees, stated as 2.5 ± 0.1", "reported", told


def _rows_of_touches(
    lab: Lab, plain: io.Calibration, further: Frames, with_ball: float, stated: Mapping[str, Any]
) -> Iterator[tuple[str, str, str]]:
    what, target = "heights with ten touches", f"at most {BOUND} x"
    assert plain.references is not None
    try:
        fit = from_touches(lab, plain.references, 10, stated)
    except io.InputError as error:
        yield what, target, f"missed, refused: {error}"
        return
    learned = replace(plain, zenith=fit.response, precession=fit.precession)
    error_of_touches = height_error(lab, further, learned)
    yield what, target, f"{error_of_touches:.3g} µm, {error_of_touches / with_ball:.2f} x"
    for each in fit.estimates:
        yield f"{each.name}, {each.unit}", "", f"{each.value:.5g} ± {each.sigma:.2g}"


def _rows_of_sensors(lab: Lab) -> Iterator[tuple[str, str, str]]:
    """Yield how errors compare with standard errors, and errors of heights, over sensors with other noise."""
    truth = {"radius": lab.body.radius, "rim": lab.body.height, "tilt": lab.tilt, "pivot_z": lab.pivot[2]}
    truth |= dict.fromkeys(("axis_x", "axis_y", "phase_offset", "oval_x", "oval_y"), 0.0)
    deviations, errors = [], []
    for seed in range(SENSORS):
        sensor, random = replace(lab, seed=100 + seed), np.random.default_rng(seed)
        taken = references_of(sensor)
        things = [
            scorer.waves(random.uniform(0.12, 0.24), random.uniform(1.9, 3.2), random.uniform(0, 1.5), REACH)
            for _ in range(THINGS - 1)
        ]
        steepness, aside = math.radians(random.uniform(20, 30)), random.uniform(-0.5, 0.5)
        things.append(scorer.cone(steepness, 4.0, (aside, 0.2)))
        touches = [
            touch(sensor, thing, press_for(thing), 30 + number, taken) for number, thing in enumerate(things)
        ]
        fit = engine.calibration.from_touches(touches, body=(lab.body.radius, lab.body.height))
        found = {each.name: each for each in fit.estimates}
        deviations.append([(found[name].value - value) / found[name].sigma for name, value in truth.items()])
        assert isinstance(fit.response, io.WallResponse)
        learned = io.Calibration(camera_of(sensor), taken, zenith=fit.response, precession=fit.precession)
        further = sensor.turned(FURTHER, press_for(FURTHER), 20)
        errors.append(height_error(sensor, further, learned))
    what = f"heights with {THINGS} touches, {SENSORS} sensors"
    yield what, "", f"{min(errors):.2g} to {max(errors):.2g} µm"
    for name, each in zip(truth, np.sqrt(np.mean(np.square(deviations), axis=0)), strict=True):
        yield f"RMS deviation of {name}, standard errors", "", f"{each:.2g}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Targets of a calibration from touches.")
    parser.add_argument("--cache", type=Path, help="folder that keeps light")
    parser.add_argument(
        "--only", default="ball,touches,sensors,prior", help="parts, with commas between them"
    )
    options = parser.parse_args()
    if options.cache is not None:
        options.cache.mkdir(exist_ok=True)
    lines = list(rows(replace(LAB, cache=options.cache), options.only.split(",")))
    print(Table("Calibration from touches", ("what", "target", "measured"), lines))


if __name__ == "__main__":
    main()
