"""The twin's recommendations for building a sensor and its rig: tables and figures of ``docs/sensor.md``.

``python evaluation/sensor/report.py [--only NAME,...] [--figures DIR]`` prints the tables as Markdown, and
draws them with ``--figures``. All numbers are of the paper's body and of a ball of 10 mm, unless the table
says otherwise.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, sparse
from scipy.sparse.linalg import spsolve

from mirrorskin import engine, io
from mirrorskin.engine.metrology.scoring import true_normals
from mirrorskin.evaluation.base.tables import Table
from mirrorskin.evaluation.scenes import rotations, surfaces
from mirrorskin.evaluation.sensor import figures as sensor_figures
from mirrorskin.twin import Axial, Body, Camera, Sphere, Twin, Vertical, visible_zenith
from mirrorskin.twin.view import View

PIXEL = 0.05
SHAPE = (160, 160)
TILT = math.radians(2.5)
PRESS = 1.25
STEEP = (20.0, 35.0)  # zeniths in degrees that every rotation here shows whole
FULL = (13.5, 43.0)  # and those whose light is full
Map = NDArray[np.floating[Any]]


# --- what is seen from where --------------------------------------------------------------------------------


def dimensions() -> Table:
    """Tell the least zenith that shows the wall, of bodies of other sizes."""
    rows = []
    for diameter, height in ((35, 20), (35, 30), (35, 40), (35, 60), (20, 40), (50, 40), (25, 25)):
        body = Body(diameter=diameter, height=height)
        at = [
            _least(body, 0.0, 0.0),
            *(_least(body, diameter / 4, azimuth) for azimuth in (math.pi, math.pi / 2, 0)),
        ]
        rows.append((f"{diameter}", f"{height}", *(f"{value:.1f}" for value in at)))
    places = ("half-way: inward", "sideways", "outward")
    return Table("Least zenith that shows the wall, degrees", ("diameter", "height", "centre", *places), rows)


def gap() -> Table:
    """Tell what air between body and wall hides, by the index of the silicone."""
    rows = []
    for index in (1.38, 1.41, 1.45, 1.5):
        body = Body(index=index, air_gap=0.5)
        centre, inward, sideways = (
            _least(body, *place) for place in ((0.0, 0.0), (10.0, math.pi), (10.0, math.pi / 2))
        )
        rows.append(
            (
                f"{index}",
                f"{centre:.1f}",
                f"{inward:.1f}",
                f"{sideways:.1f}" if sideways == sideways else "never",
                f"{body.radius / index:.1f}",
            )
        )
    head = ("index", "centre", "10 mm off, inward", "10 mm off, sideways", "sideways dark beyond, mm")
    return Table("With 0.5 mm of air between body and wall: least zenith, degrees", head, rows)


def _least(body: Body, away: float, azimuth: float) -> float:
    """Return the least zenith seen at (away, 0) in a mirror that faces an azimuth, degrees."""
    return math.degrees(float(visible_zenith(body, away, 0.0, azimuth)[0]))


def distance() -> Table:
    """Tell how much a line of sight leans inside the body, under a pinhole."""
    rows = []
    for above in (60.0, 100.0, 150.0, 300.0):
        view = View((1, 21), (1.0, 1.0), Body(), above)
        lean = np.degrees(np.arctan(np.hypot(view.slope_x, view.slope_y)))[0]
        rows.append((f"{above:.0f}", *(f"{lean[10 + away] / 2:.2f}" for away in (2, 5, 10))))
    head = ("pinhole above the sheet, mm", "2 mm off", "5 mm off", "10 mm off")
    return Table("By how much zeniths seem off where the line of sight leans, degrees", head, rows)


# --- presses ------------------------------------------------------------------------------------------------


def steps() -> Table:
    """Tell the error of heights by the step of the travel."""
    rows = []
    for step in (0.2, 0.1, 0.05, 0.02, 0.01):
        travel = np.arange(0.0, 1.5 + step / 2, step)
        twin = _twin(Sphere(), Vertical(travel), pattern="uniform")
        plain, fine = (engine.reconstruct(twin, subframe=subframe) for subframe in (False, True))
        eq4, interpolated = (_errors(result, twin.truth, FULL) for result in (plain, fine))
        centre = tuple(size // 2 for size in SHAPE)
        apex = fine.height[centre] - twin.truth.height[centre]
        parts = _rms(eq4), eq4.mean(), _rms(interpolated), interpolated.mean(), step / math.sqrt(12)
        rows.append((f"{step}", *(f"{1000 * part:.1f}" for part in (*parts, apex))))
    head = ("step, mm", "eq. 4: RMS", "mean", "sub-frame: RMS", "mean", "step/sqrt(12)", "apex, filled")
    return Table("Heights of a press by its step, errors in micrometres", head, rows)


def gel() -> Table:
    """Tell by how much eq. 3 is wrong on an elastic body, by the ball and by how far the stage gives way."""
    rows = []
    for diameter, compliance, modulus in (
        *((4.0, 0.0, 1.0), (6.0, 0.0, 1.0), (10.0, 0.0, 1.0), (16.0, 0.0, 1.0)),
        *((10.0, 0.0, 0.3), (10.0, 0.01, 1.0), (10.0, 0.05, 1.0), (10.0, 0.05, 0.3)),
    ):
        travel = np.arange(0.0, 1.21, 0.06)
        twin = _twin(
            Sphere(diameter),
            Vertical(travel, compliance=compliance),
            shape=(96, 96),
            pixel_size=0.08,
            contact="elastic",
            pattern="uniform",
            body=Body(modulus=modulus),
        )
        result = engine.reconstruct(twin, fill=False)
        truth = twin.truth
        lit = np.isfinite(result.height) & np.isfinite(truth.height)
        error = (result.height - truth.height)[lit & (truth.contact != 0)]
        alone = np.count_nonzero(lit & (truth.contact == 0)) / np.count_nonzero(lit)
        rows.append(
            (
                f"{diameter:g}",
                f"{modulus:g}",
                f"{compliance:g}",
                f"{error.mean():+.3f}",
                f"{_rms(error):.3f}",
                f"{100 * alone:.0f}",
            )
        )
    head = ("ball, mm", "modulus, N/mm^2", "stage, mm/N", "mean, mm", "RMS, mm", "lit untouched, %")
    return Table("f = -s on an elastic body, pressed 1.2 mm: error where it touches", head, rows)


def skin() -> Table:
    """Tell how much of ridges reaches a mirror that lies deeper: of the surface's waves, and of ridges."""
    rows = []
    for thickness in (0.02, 0.05, 0.1, 0.2, 0.5):
        kept = [_passed(thickness, length) for length in (0.5, 1.0, 2.0, 4.0)]
        rows.append((f"{thickness}", *(f"{100 * fraction:.0f}" for fraction in kept)))
    head = ("sheet, mm", "ridges every 0.5 mm", "1 mm", "2 mm", "4 mm")
    return Table("What a mirror under the sheet sees of the height of ridges, %", head, rows)


def _passed(thickness: float, length: float) -> float:
    """Return the share of a wave that an incompressible half-space shows so deep."""
    deep = 2 * math.pi / length * thickness
    return (1 + deep) * math.exp(-deep)


# --- rotations ----------------------------------------------------------------------------------------------


def tilts() -> Table:
    """Tell what the half-angle of the precession does."""
    rows = []
    for degrees in (0.5, 1.0, 2.5, 5.0, 8.0):
        twin = _turn(tilt=math.radians(degrees))
        touched = np.stack([twin.sheet(frame).contact for frame in range(twin.shape[0])])
        lost = 1 - np.count_nonzero(touched.all(axis=0)) / np.count_nonzero(touched.any(axis=0))
        result = engine.reconstruct(twin, heights=twin.truth.height)
        sides = _angles(result, twin.truth)
        shift = PRESS * math.sin(math.radians(degrees))
        rows.append(
            (
                f"{degrees:g}",
                *(f"{_rms(side):.2f}" for side in sides),
                _micro(result, twin.truth),
                f"{_answered(result, twin.truth):.0f}",
                f"{100 * lost:.1f}",
                f"{shift:.2f}",
            )
        )
    head = ("half-angle", "zenith, RMS deg", "across, RMS deg", "height, RMS um")
    return Table(
        "Half-angle of the precession, degrees",
        (*head, "answered, %", "lost contact, %", "shift, mm"),
        rows,
    )


def phases() -> Table:
    """Tell what more frames in a turn bring."""
    rows = []
    for count in (4, 6, 8, 12, 16, 32, 64):
        twin = _turn(phase=tuple(2 * math.pi * np.arange(count) / count))
        result = engine.reconstruct(twin, heights=twin.truth.height)
        zenith, across = (_rms(side) for side in _angles(result, twin.truth))
        both = math.hypot(zenith, across)
        rows.append((f"{count}", f"{both:.2f}", f"{both * math.sqrt(count):.2f}", _micro(result, twin.truth)))
    head = ("frames a turn", "normal, RMS deg", "times sqrt(frames)", "height, RMS um")
    return Table("Frames in a turn", head, rows)


def cameras() -> Table:
    """Tell what the camera's noise, bits and lens do to normals, heights of a rotation, and of a press."""
    kinds: Mapping[str, dict[str, Any]] = {
        "8 bits, noise 0.5": {"noise": 0.5},
        "8 bits, noise 1.5": {"noise": 1.5},
        "8 bits, noise 3": {"noise": 3.0},
        "8 bits, 40 electrons a count": {"noise": 0.5, "electrons": 40.0},
        "8 bits, 10 electrons a count": {"noise": 0.5, "electrons": 10.0},
        "12 bits, noise 8 (0.5 of 8 bits)": {"dtype": np.dtype(np.uint16), "noise": 8.0},
        "8 bits, noise 1.5, gains 5 % apart": {"noise": 1.5, "gain_deviation": 0.05},
        "8 bits, noise 1.5, blur of 1 pixel": {"noise": 1.5, "point_spread": 1.0},
    }
    rows = []
    for name, options in kinds.items():
        twin = _turn(camera=Camera(seed=1, **options))
        result = engine.reconstruct(twin, heights=twin.truth.height)
        press = _twin(
            Sphere(),
            Vertical(np.arange(0.0, 1.5, 0.1)),
            pattern="uniform",
            camera=Camera(seed=1, **options),
        )
        height = 1000 * _rms(_errors(engine.reconstruct(press), press.truth, FULL))
        sides = [f"{_rms(side):.2f}" for side in _angles(result, twin.truth)]
        rows.append((name, *sides, _micro(result, twin.truth), f"{height:.1f}"))
    head = ("camera", "zenith, RMS deg", "across, RMS deg", "height, RMS um", "press, RMS um")
    return Table("The camera", head, rows)


def pivots() -> Table:
    """Tell what the pivot's place does, and what its height being wrong does once frames are registered."""
    rows = []
    for high in (0.0, 5.0, 10.0, 40.0):
        twin = _turn(pivot=(0.0, 0.0, high), camera=Camera(dtype=np.dtype(np.float32), noise=0.0))
        truth = twin.truth
        results = [
            engine.reconstruct(twin),
            engine.reconstruct(twin, heights=truth.height),
            *(_reconstruct_about(twin, (0.0, 0.0, high + off)) for off in (1.0, 2.0)),
        ]
        shift = abs(PRESS - high) * math.sin(TILT)
        each = (_angles(result, truth, (15.0, 35.0), marked_only=False) for result in results)
        cells = [f"{math.hypot(*map(_rms, sides)):.2f}".replace("nan", "none") for sides in each]
        rows.append((f"{high:g}", f"{shift:.2f}", *cells))
    head = (
        "pivot above the sheet, mm",
        "shift, mm",
        "as seen",
        "registered",
        "pivot 1 mm wrong",
        "2 mm wrong",
    )
    return Table("The pivot: RMS angle of normals without noise, degrees", head, rows)


def _reconstruct_about(twin: Twin, pivot: tuple[float, float, float]) -> io.Result:
    """Reconstruct a turn whose frames are registered about another pivot."""
    wrong = _Header(twin, replace(twin.header, pivot=pivot))
    return engine.reconstruct(wrong, heights=twin.truth.height)


class _Header:
    """A twin that says something else of itself."""

    def __init__(self, twin: Twin, header: io.Header) -> None:
        self._twin, self.header = twin, header

    def __getattr__(self, name: str) -> Any:
        return getattr(self._twin, name)


def mistakes() -> Table:
    """Tell what each number of a rotation being wrong does to normals of eq. 10 without noise."""
    setup = rotations.Setup(noise=0.0, dtype="float32", gain=6.0, offset=0.0)
    normals = rotations.random_normals(4000, seed=3, bins=((5, 10), STEEP))
    frames = rotations.levels(normals, setup).astype(np.float32)
    right = (np.array(setup.phase), setup.tilt, setup.slope, setup.offset)
    wrong: Mapping[str, tuple[Any, ...]] = {
        "half-angle, by 2 %": (right[0], 1.02 * right[1], *right[2:]),
        "phase, by 1 degree": (right[0] + math.radians(1.0), *right[1:]),
        "zenith gain, by 1 %": (*right[:2], 1.01 * right[2], right[3]),
        "zenith offset, by 1 count of 6 a degree": (*right[:3], 1.0),
    }
    rows = []
    for name, numbers in wrong.items():
        phase, tilt, gain, offset = numbers
        options = {"tilt": tilt, "zenith_gain": gain, "zenith_offset": offset, "noise": 0.1}
        result = engine.estimate_normals(frames, phase, **options)
        zenith, azimuth = rotations.angles(normals)
        other_zenith, other_azimuth = rotations.angles(result.normals.astype(float))
        turned = np.angle(np.exp(1j * (other_azimuth - azimuth)))
        means = (np.degrees(np.nanmean(part, axis=-1)) for part in (other_zenith - zenith, turned))
        rows.append((name, *(f"{value:+.2f}" for pair in zip(*means, strict=True) for value in pair)))
    head = ("wrong", "zenith, at 5 to 10", "azimuth", "zenith, at 20 to 35", "azimuth")
    return Table("What a wrong number does: mean error, degrees", head, rows)


# --- pixels -------------------------------------------------------------------------------------------------


def pixels() -> Table:
    """Tell what the size of a pixel does to the heights of a rotation, on one field of 8 mm."""
    rows = []
    for pixel in (0.2, 0.1, 0.05, 0.025):
        count = round(SHAPE[0] * PIXEL / pixel)
        twin = _turn(shape=(count, count), pixel_size=pixel)
        result = engine.reconstruct(twin, heights=twin.truth.height)
        radius = _ball_radius(result)
        both = math.hypot(*(_rms(side) for side in _angles(result, twin.truth)))
        rows.append((f"{pixel}", f"{both:.2f}", _micro(result, twin.truth), f"{radius:.4f}"))
    head = ("pixel, mm", "normal, RMS deg", "height, RMS um", "radius of the ball, mm")
    return Table("Size of a pixel: a ball of 5 mm radius from a rotation", head, rows)


def bumps() -> Table:
    """Tell how much of a small bump's height integration finds, by its width in pixels."""
    rows = []
    for sigma in (1.5, 2.0, 3.0, 4.0, 6.0):
        bump = surfaces.sample(surfaces.bump(sigma, 0.6 * sigma), (96, 96))
        wide = engine.integrate(bump.dz_dx, bump.dz_dy, 1.0, sigma=False).height
        lost = (1 - np.ptp(height) / np.ptp(bump.height) for height in (wide, _by_means(bump)))
        rows.append((f"{sigma:g}", *(f"{100 * fraction:.2f}" for fraction in lost)))
    head = ("sigma of the bump, pixels", "lost, %", "lost with the mean of two slopes, %")
    return Table("Bumps of a few pixels: height that is lost", head, rows)


def _by_means(view: surfaces.Sample) -> Map:
    """Return the heights whose differences fit the means of neighbours' slopes best, in pixels."""
    rows, columns = view.height.shape
    down, across = (
        sparse.diags_array([-1.0, 1.0], offsets=[0, 1], shape=(n - 1, n)) for n in (rows, columns)
    )
    each = sparse.eye_array(rows), sparse.eye_array(columns)
    links = sparse.vstack([sparse.kron(each[0], across), sparse.kron(down, each[1])])
    rises = [(view.dz_dx[:, 1:] + view.dz_dx[:, :-1]) / 2, -(view.dz_dy[1:] + view.dz_dy[:-1]) / 2]
    matrix = sparse.csc_array(links.T @ links + 1e-9 * sparse.eye_array(rows * columns))
    return np.reshape(
        spsolve(matrix, links.T @ np.concatenate([rise.ravel() for rise in rises])), (rows, columns)
    )


def _ball_radius(result: io.Result) -> float:
    """Return the radius of the sphere that fits heights best, mm."""
    assert result.height is not None
    assert result.x is not None
    assert result.y is not None
    finite = np.isfinite(result.height)
    x, y = (axis[finite] for axis in np.meshgrid(result.x, result.y))
    z = result.height[finite].astype(np.float64)

    def left(ball: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.sqrt((x - ball[0]) ** 2 + (y - ball[1]) ** 2 + (z - ball[2]) ** 2) - ball[3])

    return float(optimize.least_squares(left, [0.0, 0.0, -5.0, 5.0]).x[3])


# --- the twin, and how far results are from it --------------------------------------------------------------


def _twin(thing: Any, movement: Any, **options: Any) -> Twin:
    settings = {"shape": SHAPE, "pixel_size": PIXEL, "camera": Camera(seed=1), **options}
    return Twin(object=thing, movement=movement, **settings)


def _turn(
    phase: tuple[float, ...] = rotations.EIGHTHS,
    tilt: float = TILT,
    pivot: tuple[float, float, float] = (0.0, 0.0, 0.0),
    **options: Any,
) -> Twin:
    return _twin(Sphere(), Axial(phase, tilt, PRESS, pivot), pattern="linear", **options)


def _errors(result: io.Result, truth: io.Truth, between: tuple[float, float] = (0.0, 90.0)) -> Map:
    """Return the errors of measured heights, mm, where the zenith is between two, degrees."""
    assert result.height is not None
    filled = np.zeros(truth.height.shape, bool) if result.filled is None else result.filled != 0
    valid = np.isfinite(result.height) & np.isfinite(truth.height) & ~filled
    valid &= (np.degrees(truth.zenith) > between[0]) & (np.degrees(truth.zenith) < between[1])
    return np.asarray((result.height - truth.height)[valid], np.float64)


def _micro(result: io.Result, truth: io.Truth) -> str:
    """Return the RMS of the heights of a rotation in contact about their mean, micrometres."""
    score = engine.score(result, truth).height
    return "-" if score is None else f"{1000 * score.rms:.1f}"


def _angles(
    result: io.Result, truth: io.Truth, between: tuple[float, float] = STEEP, marked_only: bool = True
) -> tuple[Map, Map]:
    """Return errors of normals along the meridian and across it, degrees, where the zenith is between two.

    Pixels count that are in contact in every frame, by default if the result says so, too.
    """
    assert result.normals is not None
    true = true_normals(truth)
    away = true[..., :2] / np.linalg.norm(true[..., :2], axis=-1, keepdims=True)
    meridian = np.concatenate([true[..., 2:] * away, -np.hypot(true[..., :1], true[..., 1:2])], axis=-1)
    error = result.normals - true
    across = error[..., 1] * away[..., 0] - error[..., 0] * away[..., 1]
    zenith = np.degrees(truth.zenith)
    valid = (truth.contact != 0) & (zenith > between[0]) & (zenith < between[1])
    valid &= np.isfinite(error[..., 0]) & (not marked_only or result.contact != 0)
    return np.degrees(np.sum(error * meridian, axis=-1)[valid]), np.degrees(across[valid])


def _answered(result: io.Result, truth: io.Truth) -> float:
    """Return which share of the pixels in lasting contact has a normal, %."""
    assert result.contact is not None
    touched = truth.contact != 0
    return 100 * np.count_nonzero(touched & (result.contact != 0)) / np.count_nonzero(touched)


def _rms(values: Map) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else math.nan


TABLES: Mapping[str, Callable[[], Table]] = {
    measure.__name__: measure
    for measure in (
        *(dimensions, gap, distance, steps, gel, skin),
        *(tilts, phases, cameras, pivots, mistakes, pixels, bumps),
    )
}


def main() -> None:
    """Print the tables that are asked for, and draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", help="names of tables, with commas between them")
    parser.add_argument("--figures", type=Path, help="folder for the figures; needs all of their tables")
    options = parser.parse_args()
    tables: dict[str, Table] = {}
    for name in options.only.split(",") if options.only else TABLES:
        tables[name] = TABLES[name]()
        print(tables[name], flush=True)
    if options.figures:
        sensor_figures.draw_section(options.figures / "sensor.png")
        sensor_figures.draw_trades(options.figures / "sensor-trade-offs.png", tables)


if __name__ == "__main__":
    main()
