"""The estimators, called from Python; all names of arguments and answers are in this file."""

from __future__ import annotations

import warnings
from itertools import pairwise
from typing import Any

import numpy as np
from golden import (
    AZIMUTH,
    FITTED,
    HEIGHT,
    KERNEL,
    NORMAL,
    RESIDUAL_SIGMA,
    SIGMA,
    SOLVED,
    WAVE,
    Answer,
    Tolerance,
    case,
)
from scenes import (
    EIGHTHS,
    LEVELS,
    PIXEL,
    TILT,
    UNEVEN,
    counted,
    dome,
    level_maps,
    pick,
    places,
    press,
    ridge,
    turn,
)

from mirrorskin import engine, io
from mirrorskin.engine.base.operation import Plan
from mirrorskin.engine.base.summary import summarise as engine_summarise
from mirrorskin.engine.diagnosis.registration import Registered
from mirrorskin.engine.metrology import Quantity
from mirrorskin.engine.metrology import fit_plane as engine_fit_plane
from mirrorskin.engine.metrology import fit_sphere as engine_fit_sphere
from mirrorskin.engine.metrology import roughness as engine_roughness
from mirrorskin.engine.metrology import section as engine_section
from mirrorskin.engine.metrology import step_height as engine_step_height
from mirrorskin.engine.vibration.lock_in import LockIn

PROCESS = Tolerance(1e-3, 1e-6)  # numbers of solved heights
ONSET = {"height": HEIGHT, "height_sigma": HEIGHT, "process": FITTED}
SMALL = (19, 26)


def result_maps(result: io.Result) -> Answer:
    """Return all maps of a result, its axes, and how it was made."""
    facts = {"process": dict(result.process), "offset_unknown": result.offset_unknown}
    return {**result.maps(), "x": result.x, "y": result.y, **facts}


def named(**parts: Answer) -> dict[str, Any]:
    """Return the answers of several calls as one."""
    return {f"{part}.{name}": value for part, maps in parts.items() for name, value in maps.items()}


def blocks(frames: Any, cuts: list[int], **series: Any) -> list[io.Block]:
    """Cut frames into blocks of these lengths, the last of which takes the rest."""
    ends = [0, *np.cumsum(cuts).tolist(), len(frames)]
    return [
        io.Block(frames[a:b], a, **{name: values[a:b] for name, values in series.items()})
        for a, b in pairwise(ends)
    ]


class Source:
    """A source of given frames, which can be read again."""

    rewindable = True
    name = "made up"

    def __init__(self, frames: Any, header: io.Header, **series: Any) -> None:
        self.frames, self.header, self.motion, self.series = frames, header, header.motion, series
        self.shape, self.dtype, self.next = frames.shape, frames.dtype, 0
        self.__dict__.update(series)

    def rewind(self) -> None:
        self.next = 0

    def read(self, out: Any = None, /) -> io.Block | None:
        part = slice(self.next, min(self.next + (1 if out is None else len(out)), len(self.frames)))
        if part.start == part.stop:
            return None
        self.next = part.stop
        return io.Block(
            self.frames[part], part.start, **{name: values[part] for name, values in self.series.items()}
        )

    def __enter__(self) -> Source:
        return self

    def __exit__(self, *error: object) -> None:
        pass


# A press.


def onset_of(dtype: str, **options: Any) -> Answer:
    """Find the onset with the levels of each pixel."""
    frames, travel = press(dtype)
    dark, bright = level_maps(dtype, frames.shape[1:])
    return result_maps(engine.find_onset(frames, travel, dark=dark, bright=bright, **options))


@case(**ONSET)
def find_onset_uint8() -> Answer:
    return onset_of("uint8")


@case(**ONSET)
def find_onset_uint16() -> Answer:
    return onset_of("uint16")


@case(**ONSET)
def find_onset_float32() -> Answer:
    return onset_of("float32")


@case(**ONSET)
def find_onset_with_one_level_for_all() -> Answer:
    frames, travel = press("uint8", (48, 64), 24)
    dark, bright = LEVELS["uint8"]
    wide = engine.find_onset(frames, travel, dark=dark, bright=bright)
    run = engine.Run(engine.Onset(bright=bright))
    run.push(frames, travel=travel)
    return named(both=result_maps(wide), bright=result_maps(run.result()))


@case(**ONSET)
def find_onset_as_printed() -> Answer:
    return onset_of("uint8", subframe=False)


@case(**ONSET)
def find_onset_options() -> Answer:
    return named(
        hold=onset_of("uint8", hold=4),
        once=onset_of("uint16", hold=1),
        threshold=onset_of("uint8", threshold=0.3, noise=2.5),
    )


@case(**ONSET)
def find_onset_of_a_release() -> Answer:
    answers = {}
    for dtype in LEVELS:
        frames, travel = press(dtype, seed=4)
        low, high = level_maps(dtype, frames.shape[1:])
        back = np.ascontiguousarray(frames[::-1])
        answers[dtype] = result_maps(
            engine.find_onset(back, travel[::-1], dark=low, bright=high, event="release")
        )
    return named(**answers)


@case(**ONSET)
def find_onset_of_missing_samples() -> Answer:
    frames, travel = press("float32", seed=5)
    frames[pick(frames.shape, 0.002, 6)] = np.nan
    dark, bright = LEVELS["float32"]
    return result_maps(engine.find_onset(frames, travel, dark=dark, bright=bright))


@case(**ONSET)
def find_onset_block_by_block() -> Answer:
    frames, travel = press("uint8")
    dark, bright = level_maps("uint8", frames.shape[1:])
    run = engine.Run(engine.Onset(dark=dark, bright=bright))
    for block in blocks(frames, [1, 1, 3, 2, 7], travel=travel):
        run.push(block.frames, travel=block.travel)
    return result_maps(run.result())


def change_of(dtype: str, **options: Any) -> Answer:
    """Find the change-point of a press."""
    frames, travel = press(dtype, seed=8)
    return result_maps(engine.find_change_point(frames, travel, **options))


@case(**ONSET)
def find_change_point_of_known_levels() -> Answer:
    levels_by_type = {
        dtype: dict(zip(("dark", "bright"), level_maps(dtype, (37, 53)), strict=True)) for dtype in LEVELS
    }
    return named(**{dtype: change_of(dtype, **levels) for dtype, levels in levels_by_type.items()})


@case(**ONSET)
def find_change_point_of_unknown_levels() -> Answer:
    return named(**{dtype: change_of(dtype) for dtype in LEVELS})


@case(**ONSET)
def find_change_point_of_a_release() -> Answer:
    frames, travel = press("uint8", seed=9)
    back, up = np.ascontiguousarray(frames[::-1]), travel[::-1]
    dark, bright = LEVELS["uint8"]
    return named(
        known=result_maps(engine.find_change_point(back, up, dark=dark, bright=bright, event="release")),
        unknown=result_maps(engine.find_change_point(back, up, hold=3, event="release")),
    )


@case(**ONSET)
def find_change_point_block_by_block() -> Answer:
    frames, travel = press("uint16", seed=8)
    source = Source(frames, io.Header("vertical"), travel=travel)
    search = engine.ChangePoint(memory_limit=8 * frames[0].nbytes)  # of four frames
    result = engine.Run(Plan(search, checked=False), source).complete()
    return result_maps(result.assign(process={"noise": result.process["noise"]}))


@case(HEIGHT)
def fill_holes() -> Answer:
    height = dome((41, 56))[0]
    x, y = places((41, 56))
    holes = (np.hypot(x - 0.3, y) < 0.25) | (np.hypot(x + 0.6, y + 0.4) < 0.12)
    sigma = np.where(holes, np.nan, 0.003)
    open_height = np.where(holes, np.nan, height)
    filled, where = engine.fill_holes(open_height, sigma, PIXEL)
    deep, deep_where = engine.fill_holes(open_height, sigma, PIXEL, deepest=-0.6, steepest=0.1)
    return {"filled": filled, "where": where, "deep": deep, "deep_where": deep_where}


def press_source(dtype: str = "uint8", **options: Any) -> Source:
    """Return a press as a source with all that a header knows."""
    frames, travel = press(dtype, (48, 64), 24)
    dark, bright = (np.full((48, 64), level, np.float32) for level in LEVELS[dtype])
    header = io.Header("vertical", pixel_size=PIXEL, dark=dark, bright=bright, camera="lab", **options)
    return Source(frames, header, travel=travel)


@case(HEIGHT, process=FITTED)
def reconstruct_a_press() -> Answer:
    return named(
        threshold=result_maps(engine.reconstruct(press_source())),
        change=result_maps(engine.reconstruct(press_source("uint16"), method="change-point", fill=False)),
    )


@case(HEIGHT, process=FITTED)
def reconstruct_a_press_with_a_gel() -> Answer:
    shape, travel = (40, 46), np.arange(0.0, 1.2, 0.05)
    x, y = places(shape, (0.12, 0.12))
    starts = 0.12 * (x**2 + y**2) - 0.02  # a pixel some way off turns light before it is touched
    starts[np.hypot(x, y) < 0.45] = 9.0
    frames = counted(np.clip((travel[:, None, None] - starts) / 0.05 + 0.5, 0, 1), "uint8")
    dark, bright = (np.full(shape, level, np.float32) for level in LEVELS["uint8"])
    header = io.Header("vertical", pixel_size=(0.12, 0.12), dark=dark, bright=bright, camera="lab")
    gel = io.Gel(threshold=0.2, compliance=0.02, curvature=0.05, error=0.004)
    calibration = io.Calibration(io.CameraId("lab", shape, np.dtype("uint8")), gel=gel)
    return result_maps(engine.reconstruct(Source(frames, header, travel=travel), calibration, noise=1.0))


# A rotation.


@case(azimuth=AZIMUTH)
def correlate_even_phases() -> Answer:
    return named(**{d: result_maps(engine.correlate(turn(d)[0], EIGHTHS)) for d in LEVELS})


@case(azimuth=AZIMUTH)
def correlate_uneven_phases() -> Answer:
    return named(**{d: result_maps(engine.correlate(turn(d, phase=UNEVEN)[0], UNEVEN)) for d in LEVELS})


@case(azimuth=AZIMUTH)
def correlate_weights_and_missing_samples() -> Answer:
    frames = turn("float32", phase=UNEVEN)[0]
    frames[pick(frames.shape, 0.002, 3)] = np.nan
    return result_maps(engine.correlate(frames, UNEVEN, frame_weights=[1, 1, 0, 2, 1, 0.5, 1, 1]))


def long_turn(dtype: str) -> tuple[Any, Any]:
    """Return frames of three uneven turns, and their phases."""
    phase = np.arange(24) * np.pi / 4 + np.random.default_rng(5).normal(0, 0.05, 24)
    return turn(dtype, (33, 47), phase)[0], phase


@case(azimuth=AZIMUTH)
def correlate_block_by_block() -> Answer:
    answers = {}
    for dtype in LEVELS:
        frames, phase = long_turn(dtype)
        run = engine.Run(engine.Correlate())
        for block in blocks(frames, [3, 1, 8, 5], phase=phase):
            run.push(block.frames, phase=block.phase)
        answers[dtype] = result_maps(run.result())
    return named(**answers)


@case(azimuth=AZIMUTH)
def correlate_a_sliding_window() -> Answer:
    answers = {}
    for dtype in LEVELS:
        frames, phase = long_turn(dtype)
        run = engine.Run(engine.Correlate(window_frames=10))
        for number, block in enumerate(blocks(frames, [4, 9, 1, 3], phase=phase)):
            run.push(block.frames, phase=block.phase)
            answers[f"{dtype}_{number}"] = result_maps(run.result())
    return named(**answers)


@case(phase=FITTED, phase_sigma=RESIDUAL_SIGMA, process=FITTED)
def fit_fringes() -> Answer:
    return named(
        **{d: result_maps(engine.optical.fit_fringes(turn(d, SMALL, UNEVEN)[0], UNEVEN)) for d in LEVELS}
    )


@case(height=HEIGHT, height_sigma=SIGMA, sharpness=FITTED)
def find_focus() -> Answer:
    travel, texture = np.arange(0.0, 2.4, 0.2), np.random.default_rng(6).random(SMALL)
    sharp = np.exp(-((travel[:, None, None] + 2 * dome(SMALL)[0] - 0.6) ** 2))
    answers = {}
    for dtype in LEVELS:
        result = engine.optical.find_focus(counted(texture * sharp, dtype), travel, noise=0.01)
        answers[dtype] = result_maps(result)
    return named(**answers)


@case(
    normals=NORMAL,
    normals_sigma=SIGMA,
    albedo=FITTED,
    albedo_sigma=SIGMA,
    residual=Tolerance(1e-3),
    process=FITTED,
)
def photometric_stereo() -> Answer:
    _, along_x, along_y = dome(SMALL)
    normal = np.stack([-along_x, -along_y, np.ones(SMALL)]) / np.sqrt(1 + along_x**2 + along_y**2)
    light = np.stack([0.7 * np.cos(EIGHTHS), 0.7 * np.sin(EIGHTHS), np.full(8, 0.714)], axis=1)
    fraction = 0.8 * np.clip(np.einsum("ki,ihw->khw", light, normal), 0, 1)
    fraction += np.random.default_rng(4).normal(0, 0.01, fraction.shape)
    answers = {}
    for dtype, (dark, _) in LEVELS.items():
        result = engine.optical.photometric_stereo(counted(fraction, dtype), light=light, dark=dark)
        answers[dtype] = result_maps(result)
    return named(**answers)


def normals_of(dtype: str = "uint16", phase: Any = EIGHTHS, **options: Any) -> Answer:
    """Estimate the dome's normals."""
    own_options = {name: options.pop(name) for name in ("noise_of", "lost", "shape") if name in options}
    own_options = {"noise": own_options.pop("noise_of", 1.0), **own_options}
    frames, gain, offset = turn(dtype, phase=phase, **own_options)
    calibration = {"tilt": TILT, "zenith_gain": gain, "zenith_offset": offset}
    return result_maps(engine.estimate_normals(frames, phase, **calibration, **options))


# Without contact, normals are noise, whose bends have other last bits on other processors.
SHARP: dict[str, Any] = {"blur": 0.0}
ROTATION = {
    "normals": NORMAL,
    "normals_sigma": RESIDUAL_SIGMA,
    "zenith": NORMAL,
    "azimuth": AZIMUTH,
    "mean": KERNEL,
    **dict.fromkeys(("cosine", "sine", "modulation", "residual"), WAVE),
}


@case(FITTED, **ROTATION)
def estimate_normals_exactly() -> Answer:
    return named(**{dtype: normals_of(dtype) for dtype in LEVELS}, wide=normals_of(shape=(48, 64)))


@case(FITTED, **ROTATION)
def estimate_normals_of_uneven_phases() -> Answer:
    return named(**{dtype: normals_of(dtype, UNEVEN) for dtype in LEVELS})


@case(FITTED, **ROTATION)
def estimate_normals_as_printed() -> Answer:
    return named(
        even=normals_of("uint8", method="paper"), uneven=normals_of("uint16", UNEVEN, method="paper")
    )


@case(FITTED, **ROTATION)
def estimate_normals_of_noise_and_clipped_samples() -> Answer:
    return named(
        noisy=normals_of("uint8", noise_of=4.0, **SHARP),
        told=normals_of("uint8", noise=1.5, **SHARP),
        clipped=normals_of("uint16", dark=400.0, bright=1400.0, **SHARP),
        weighed=normals_of("uint16", frame_weights=[1, 1, 0.5, 1, 1, 0, 1, 1], **SHARP),
    )


@case(FITTED, **ROTATION)
def estimate_normals_where_contact_is_lost() -> Answer:
    return normals_of("uint8", lost=True, shape=(48, 64), **SHARP)


@case(FITTED, **ROTATION, process=Tolerance(1e-4, 1e-7))
def estimate_normals_and_the_tilt() -> Answer:
    frames, gain, offset = turn("uint16")
    calibration = {"tilt": "estimate", "zenith_gain": gain, "zenith_offset": offset}
    return result_maps(engine.estimate_normals(frames, EIGHTHS, **calibration))


@case(FITTED, **ROTATION)
def estimate_normals_block_by_block() -> Answer:
    frames, phase = long_turn("uint16")
    answers = {}
    for per_turn in (False, True):
        normals = engine.Normals(tilt=TILT, zenith_gain=3400.0, zenith_offset=150.0, per_turn=per_turn)
        run = engine.Run(normals)
        for block in blocks(frames, [5, 1, 9, 3], phase=phase):
            run.push(block.frames, phase=block.phase)
        answers["each" if per_turn else "mean"] = result_maps(run.result())
    return named(**answers)


def facets(shape: tuple[int, int]) -> tuple[Any, Any, Any]:
    """Return normals of a roof in a field with a hole, their errors, and contact."""
    along_x, along_y = ridge(shape)
    vectors = np.stack([-along_x, -along_y, np.ones(shape)], axis=-1)
    vectors += np.random.default_rng(2).normal(0, 0.01, vectors.shape)
    vectors /= np.linalg.norm(vectors, axis=-1, keepdims=True)
    x, y = places(shape)
    contact = (np.hypot(x - 0.4, y - 0.3) > 0.3).astype(np.uint8)
    vectors[contact == 0] = np.nan
    sigma = np.where(contact == 1, 0.014, np.nan)
    return vectors.astype(np.float32), sigma.astype(np.float32), contact


@case()
def find_edges() -> Answer:
    return {f"edges_{h}x{w}": engine.find_edges(*facets((h, w))) for h, w in ((48, 64), (71, 53))}


def turn_source(turns: int = 1, dtype: str = "uint16", **options: Any) -> Source:
    """Return a rotation as a source with all that a header knows."""
    phase = np.arange(8 * turns) * np.pi / 4
    frames, gain, offset = turn(dtype, (40, 52), phase, lost=True)
    scale = {"zenith_gain": np.asarray(gain), "zenith_offset": np.asarray(offset)}
    header = io.Header("axial", pixel_size=PIXEL, tilt=TILT, press=1.0, camera="lab", **scale, **options)
    return Source(frames, header, phase=phase)


SURFACE = {"height": SOLVED, "height_sigma": SIGMA, "process": PROCESS}
RECONSTRUCTED = {**ROTATION, **SURFACE}


@case(FITTED, **RECONSTRUCTED)
def reconstruct_a_rotation() -> Answer:
    return result_maps(engine.reconstruct(turn_source(), **SHARP))


@case(FITTED, **RECONSTRUCTED)
def reconstruct_a_rotation_robustly() -> Answer:
    return result_maps(engine.reconstruct(turn_source(), robust=True, **SHARP))


@case(FITTED, **RECONSTRUCTED)
def reconstruct_each_turn() -> Answer:
    return result_maps(engine.reconstruct(turn_source(2), per_turn=True, **SHARP))


@case(FITTED, **RECONSTRUCTED)
def reconstruct_a_rotation_with_other_options() -> Answer:
    return named(
        paper=result_maps(engine.reconstruct(turn_source(), method="paper", **SHARP)),
        tilt=result_maps(engine.reconstruct(turn_source(), tilt="estimate", **SHARP)),
    )


@case(FITTED, **RECONSTRUCTED)
def reconstruct_a_registered_rotation() -> Answer:
    heights = dome((40, 52))[0].astype(np.float32)
    with warnings.catch_warnings():  # the points of these frames do not move
        warnings.simplefilter("ignore", io.MirrorskinWarning)
        return result_maps(engine.reconstruct(turn_source(pivot=(0.4, -0.3, 5.0)), heights=heights))


@case(Tolerance(10 * 3e-7))  # pixels have numbers up to 50, in single precision: 3 units
def registered_frames() -> Answer:
    heights = dome((40, 52))[0].astype(np.float32)
    source = Registered(turn_source(dtype="float32", pivot=(0.4, -0.3, 5.0)), heights)
    out = np.empty(source.shape, source.dtype)
    parts = []
    while (block := source.read(out)) is not None:
        parts.append(block.frames.copy())
    return {"frames": np.concatenate(parts)}


@case(FITTED)
def correlate_a_source() -> Answer:
    return result_maps(LockIn().run(turn_source(2)))


# Surfaces.


def integrated(shape: tuple[int, int], **options: Any) -> Answer:
    """Integrate the dome's slopes, with noise."""
    _, along_x, along_y = dome(shape)
    random = np.random.default_rng(3)
    along_x, along_y = (slope + random.normal(0, 0.01, shape) for slope in (along_x, along_y))
    return result_maps(engine.integrate(along_x, along_y, PIXEL, **options))


def disc(shape: tuple[int, int]) -> Any:
    """Return pixels in two pieces."""
    x, y = places(shape)
    return (np.hypot(x, y) < 0.9) | (x > 1.1)


def cut(shape: tuple[int, int]) -> Any:
    """Return a line of edges that ends in the picture."""
    x, y = places(shape)
    return (np.abs(x + 0.3 * y - 0.2) < 0.03) & (y > -0.6)


def some_heights(shape: tuple[int, int]) -> Any:
    """Return heights that are known here and there."""
    return np.where(pick(shape, 0.05, 11), dome(shape)[0] - 1.0, np.nan)


@case(**SURFACE)
def integrate_rectangles() -> Answer:
    sizes = ((48, 64), (37, 53), (64, 31))
    plain = {f"size_{h}x{w}": integrated((h, w)) for h, w in sizes}
    return named(**plain, bare=integrated((48, 64), sigma=False))


@case(**SURFACE)
def integrate_masks() -> Answer:
    answers = {f"size_{h}x{w}": integrated((h, w), mask=disc((h, w))) for h, w in ((48, 64), (41, 57))}
    return named(**answers, bare=integrated((41, 57), mask=disc((41, 57)), sigma=False))


@case(**SURFACE)
def integrate_weights() -> Answer:
    weights = np.random.default_rng(4).uniform(10, 1000, (41, 57))
    return named(
        alone=integrated((41, 57), slope_weights=weights),
        masked=integrated((41, 57), slope_weights=weights, mask=disc((41, 57))),
    )


@case(**SURFACE)
def integrate_cuts() -> Answer:
    return integrated((43, 58), edges=cut((43, 58)), mask=disc((43, 58)))


@case(**SURFACE)
def integrate_known_heights() -> Answer:
    shape = (40, 54)
    weights = np.where(pick(shape, 0.5, 12), 4e4, 1e4)
    slopes = np.full(shape, 1e4)
    return named(
        alone=integrated(shape, known_heights=some_heights(shape)),
        weighed=integrated(
            shape,
            slope_weights=slopes,
            known_heights=some_heights(shape),
            known_height_weights=weights,
            mask=disc(shape),
        ),
    )


@case(**SURFACE)
def integrate_missing_slopes() -> Answer:
    shape = (39, 50)
    along_x, along_y = dome(shape)[1:]
    along_x = np.where(pick(shape, 0.03, 13), np.nan, along_x)
    return result_maps(engine.integrate(along_x, along_y, PIXEL))


@case(**SURFACE)
def integrate_robustly() -> Answer:
    shape = (44, 60)
    along_x, along_y = ridge(shape)
    x, y = places(shape)
    along_x = along_x + np.where((np.abs(x - 0.5) < 0.03) & (y > 0), 5.0, 0.0)
    return named(
        ridge=result_maps(engine.integrate(along_x, along_y, PIXEL, robust=True)),
        bare=result_maps(
            engine.integrate(along_x, along_y, PIXEL, robust=True, bilateral_sharpness=4.0, sigma=False)
        ),
        dome=integrated((37, 49), robust=True, mask=disc((37, 49))),
    )


@case(**SURFACE)
def integrate_live() -> Answer:
    shape, answers = (42, 55), {}
    integrator = engine.Integrator(shape, PIXEL)
    for number in range(3):
        along_x, along_y = dome(shape, 0.2 + 0.05 * number)[1:]
        mask = disc(shape) if number else np.ones(shape, bool)
        integrator.push(along_x, along_y, mask=mask, tolerance=1e-5)
        answers[f"frame_{number}"] = result_maps(integrator.result())
    return named(**answers)


@case(**SURFACE)
def integrate_several() -> Answer:
    shape = (36, 50)
    slopes = [dome(shape, 0.2 + 0.05 * number)[1:] for number in range(3)]
    random = np.random.default_rng(9)
    along_x, along_y = (
        np.stack(part) + random.normal(0, 0.01, (3, *shape)) for part in zip(*slopes, strict=True)
    )
    return named(
        whole=result_maps(engine.integrate(along_x, along_y, PIXEL)),
        masked=result_maps(engine.integrate(along_x, along_y, PIXEL, mask=disc(shape))),
    )


@case(**SURFACE)
def fuse() -> Answer:
    shape = (40, 52)
    frames, gain, offset = turn("uint16", shape)
    normals = engine.estimate_normals(frames, EIGHTHS, tilt=TILT, zenith_gain=gain, zenith_offset=offset)
    travel = np.arange(0.0, 1.0, 0.05)
    x, y = places(shape)
    starts = np.where(np.hypot(x, y) < 0.3, 9.0, -dome(shape)[0])
    counts = counted((travel[:, None, None] > starts).astype(float), "uint8")
    onset = engine.find_onset(counts, travel, dark=LEVELS["uint8"][0], bright=LEVELS["uint8"][1], noise=1.0)
    return named(
        whole=result_maps(engine.fuse(onset, normals, PIXEL)),
        masked=result_maps(engine.fuse(onset, normals, PIXEL, mask=disc(shape))),
        robust=result_maps(engine.fuse(onset, normals, PIXEL, robust=True)),
    )


@case(FITTED, **{**RECONSTRUCTED, "normals": SOLVED})  # registered by solved heights
def fuse_sources() -> Answer:
    shape, travel = (40, 52), np.arange(0.0, 1.0, 0.05)
    starts = -dome(shape)[0]
    frames = counted(np.clip((travel[:, None, None] - starts) / 0.04 + 0.5, 0, 1), "uint8")
    dark, bright = (np.full(shape, level, np.float32) for level in LEVELS["uint8"])
    header = io.Header("vertical", pixel_size=PIXEL, dark=dark, bright=bright, camera="lab")
    down = Source(frames, header, travel=travel)
    turned = turn_source(pivot=(0.4, -0.3, 5.0))
    with warnings.catch_warnings():  # the press and the rotation are not of one surface
        warnings.simplefilter("ignore", io.MirrorskinWarning)
        return result_maps(engine.fuse(down, turned, press={"noise": 1.0}))


# Measures.


def cap(shape: tuple[int, int] = (48, 64), radius: float = 4.0) -> io.Result:
    """Return a ball's cap with noise, a scratch and a hole, as a result."""
    x, y = places(shape)
    random = np.random.default_rng(21)
    height = np.sqrt(radius**2 - (x - 0.1) ** 2 - (y + 0.2) ** 2) - radius - 0.5
    height = height + random.normal(0, 0.002, shape) + 0.003 * np.sin(20 * x)
    height[5:8, 10:14] = np.nan
    height[30, 20:40] -= 0.05
    sigma = np.full(shape, 0.002, np.float32)
    axis_x, axis_y = io.pixel_axes(shape, PIXEL)
    return io.Result(height=height.astype(np.float32), height_sigma=sigma, x=axis_x, y=axis_y)


def numbers(quantities: dict[str, Quantity]) -> dict[str, list[Any]]:
    """Return measured quantities as JSON."""
    return {
        name: [float(quantity.value), float(quantity.sigma), quantity.unit]
        for name, quantity in quantities.items()
    }


@case(FITTED)
def fit_plane() -> Answer:
    x, y = places((37, 53))
    height = 0.1 * x - 0.05 * y + 0.3 + np.random.default_rng(2).normal(0, 0.003, x.shape)
    height[pick(x.shape, 0.02, 5)] += 0.5
    axis_x, axis_y = io.pixel_axes(x.shape, PIXEL)
    fitted = engine_fit_plane(height, axis_x, axis_y, np.full(x.shape, 0.003))
    bare = engine_fit_plane(height, axis_x, axis_y)
    return {
        "numbers": numbers(fitted.quantities()),
        "residual": fitted.residual,
        "outliers": fitted.outliers,
        "birge": fitted.birge,
        "bare": numbers(bare.quantities()),
    }


@case(FITTED)
def fit_sphere() -> Answer:
    surface = cap()
    fitted = engine_fit_sphere(surface.height, surface.x, surface.y, surface.height_sigma)
    return {
        "numbers": numbers(fitted.quantities()),
        "residual": fitted.residual,
        "outliers": fitted.outliers,
        "hollow": fitted.hollow,
        "birge": fitted.birge,
    }


@case(FITTED)
def roughness() -> Answer:
    x, y = places((45, 61))
    residual = (
        0.004 * np.sin(9 * x) + 0.002 * np.cos(7 * y) + np.random.default_rng(8).normal(0, 1e-3, x.shape)
    )
    residual[10:13, 20:23] = np.nan
    plain = engine_roughness(residual, PIXEL)
    fine = engine_roughness(residual, PIXEL, l_filter=0.8, sigma=np.full(x.shape, 1e-3))
    counts = [[area.pixels, area.left_out, area.uncertain] for area in (plain, fine)]
    return {
        "plain": numbers(plain.parameters),
        "fine": numbers(fine.parameters),
        "counts": np.array(counts),
    }


@case(FITTED)
def section_and_step() -> Answer:
    x, y = places((48, 64))
    height = (
        np.where(x + 0.2 * y > 0.1, 0.3, 0.0) + 0.02 * x + np.random.default_rng(4).normal(0, 0.002, x.shape)
    )
    axis_x, axis_y = io.pixel_axes((48, 64), PIXEL)
    sigma = np.full((48, 64), 0.002, np.float32)
    result = io.Result(height=height.astype(np.float32), height_sigma=sigma, x=axis_x, y=axis_y)
    along = engine_section(result, (-1.2, 0.1), (1.3, -0.2))
    across = engine_section(cap())
    step = engine_step_height(along)
    return {
        "distance": along.distance,
        "height": along.height,
        "sigma": along.sigma,
        "apex_x": across.x,
        "apex_y": across.y,
        "apex_height": across.height,
        "step": numbers({"height": step.height, "place": step.place, "slope": step.slope}),
    }


@case(FITTED)
def measure() -> Answer:
    measured = {
        "all": engine.measure(cap()),
        "sphere": engine.measure(cap(), form="sphere", l_filter=0.5, section=((-1.0, 0.0), (1.0, 0.3))),
        "part": engine.measure(cap(), region=io.Region((10, 40), (5, 50)), form="plane"),
    }
    return {
        name: {**numbers(measured_part.quantities), "notes": measured_part.notes}
        for name, measured_part in measured.items()
    }


@case(FITTED)
def score() -> Answer:
    shape = (40, 52)
    height, along_x, along_y = dome(shape)
    zenith = np.arctan(np.hypot(along_x, along_y)).astype(np.float32)
    azimuth = np.arctan2(-along_y, -along_x).astype(np.float32)
    contact = disc(shape).astype(np.uint8)
    truth = io.Truth(height.astype(np.float32), zenith, azimuth, contact)
    result = engine.reconstruct(turn_source())
    return {"table": engine.score(result, truth).table()}


@case()
def summarise() -> Answer:
    summary = engine_summarise(engine.reconstruct(press_source()))
    return {
        "what": summary.what,
        "counts": np.array([summary.pixels, summary.answered, summary.filled]),
        "range": np.array([summary.lowest, summary.highest]),
        "unit": summary.unit,
    }
