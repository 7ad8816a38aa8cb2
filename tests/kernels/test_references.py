"""Each kernel, compared with its reference: a function per kernel returns both results."""

import math
import re
from pathlib import Path

import numpy as np
import pytest
from references import CASES, KERNELS, agree, case, named, near
from scipy.spatial.transform import Rotation
from speckle import Speckle

from mirrorskin.cli.commands.bench.limits import CHAINS, CORES, LANES
from mirrorskin.kernels.device import C_TYPES
from mirrorskin.kernels.integration.breaks import DOWN, RIGHT
from mirrorskin.kernels.optical import focus, lambert
from mirrorskin.kernels.rotation import correlation, registration
from mirrorskin.kernels.skin import displacement, pose, pose_maps, slip, turn_pose
from mirrorskin.kernels.twin.skin import FLAKES

DTYPES, WHOLE = {"dtype": ("uint8", "uint16", "float32")}, {"dtype": ("uint8", "uint16")}

# --- Links that let go

SHAPES = {"shape": ((1, 1), (1, 9), (9, 1), (37, 53), (5, 700))}
BREAKS, SIZE = {"axes": SHAPES, "per": "row", "atol": 2e-6}, {"width": 0.4, "height": 0.7}
SUMS = {"axes": SHAPES | {"reach": (1, 5), "wide": (0, 1)}, "per": "row", "atol": 2e-6}


def linked(shape, normal="", **others):
    """Return flags and links to the right and down, and normal numbers."""
    rng = np.random.default_rng(shape[0] * 1000 + shape[1])
    flags = ((rng.random(shape) < 0.85) * RIGHT + (rng.random(shape) < 0.85) * DOWN).astype(np.uint8)
    flags[:, -1] &= DOWN
    flags[-1] &= RIGHT
    links = [np.where(flags & bit, rng.uniform(0.1, 2, shape), 0) for bit in (RIGHT, DOWN)]
    maps = {name: rng.normal(0, 0.5, shape) for name in normal.split()} | {"shape": shape} | others
    return flags, *links, rng.uniform(0.05, 1, shape), maps


@case("breaks_curl", **BREAKS)
def _(shape):
    flags, *_, maps = linked(shape, "slope_x slope_y", **SIZE)
    return maps | {"flags": flags}


@case("breaks_sum", **SUMS)
def _(shape, reach, wide):
    return linked(shape, "values", reach=reach, downwards=wide)[-1]


@case("breaks_spread", **SUMS)
def _(shape, **chosen):
    return linked(shape, "curl sums", noise=0.05, **chosen)[-1]


RIGHTWARDS, DOWNWARDS = near(1e-5, 1e-6, of="right"), near(1e-5, 1e-6, of="down")


@case("breaks_trust", **BREAKS, checks=named("weight_x weight_y rise_x rise_y", *[RIGHTWARDS, DOWNWARDS] * 2))
def _(shape):
    numbers = {"noise": 0.01, "bend": 0.5, "tear": 2.0, "min_trust": 1e-3}
    _, *links, facing, maps = linked(shape, "slope_x slope_y tears", **numbers)
    tears = np.pad(np.abs(maps["tears"])[:-1, :-1], (0, 1))
    return maps | named("right down facing tears", *links, facing, tears)


# A square of 6 is cut, or not, by its last digit.
@case(
    "breaks_links", **BREAKS, checks=dict.fromkeys(("right", "down", "source"), near(0, 2e-5, fraction=0.002))
)
def _(shape):
    numbers = SIZE | {"slack": 0.25, "sharpness": 4.0, "max_square": 6.0}
    _, *links, held, maps = linked(shape, "slope_x slope_y rise_x rise_y heights", **numbers)
    return maps | named("weight_x weight_y held", *links, held)


# --- Correlation

PHASES = np.array([0.1, 1.0, 1.7, 2.9, 3.3, 4.4, 5.2, 6.1, 7.0, 8.8, 9.1])
ROWS = np.stack([np.ones_like(PHASES), np.cos(PHASES), np.sin(PHASES)], axis=1)
PIXELS, STEPS = {"shape": ((1, 1), (1, 1300))}, {"uint8": 2**17, "uint16": 2**23}
TOTALS, FIT = "total cosine sine square", {"rtol": 3e-7, "atol": 1e-7}
ORDER = np.arange(len(PHASES), dtype=np.int32)


class Fit:
    """Frames of a full swing with the extreme counts among them, their sums, and the table of their fit."""

    def __init__(self, shape, dtype, whole=False, turns=1):
        rng, size, top = np.random.default_rng(0), (len(PHASES), shape[1]), STEPS.get(dtype, 1)
        self.frames = rng.normal(1000, 3, size).astype(dtype)
        if dtype != "float32":
            largest = np.iinfo(dtype).max
            self.frames = rng.integers(0, largest, size, endpoint=True).astype(dtype)
            self.frames[:, 0] = largest
        self.rows = np.rint(ROWS * [1, top, top]).astype(np.int32) if whole else ROWS.astype(np.float32)
        upper = np.linalg.cholesky(ROWS.T @ ROWS).T
        project = (upper @ np.linalg.inv(self.rows.T.astype(np.float64) @ ROWS)).ravel()
        high = project.astype(np.float32)
        table = [high, project - high, np.linalg.inv(upper).ravel(), [1 / (len(PHASES) - 3)]]
        macros = {"FRAME": C_TYPES[dtype], "BITS": 8 * np.dtype(dtype).itemsize}
        self.fit = {"fit": np.concatenate(table).astype(np.float32), "shape": shape, "macros": macros}
        self.stack = {"frames": self.frames, "place": ORDER, "basis": self.rows}
        self.used = named("used cosines sines", *(turns * self.rows.sum(axis=0, dtype=np.int64)).tolist())
        totals = np.zeros((4 if whole else 5, shape[1]), np.int64 if whole else float)
        add = correlation.correlation_add if whole else correlation.correlation_sum
        add(self.frames, ORDER, self.rows, 0, *totals)
        self.totals = named(TOTALS if whole else f"reference {TOTALS}", *turns * totals)


@case("correlation_add", PIXELS | WHOLE | {"count": (1, 11, 150), "first": (0, 1)})
def _(shape, dtype, count, first):
    fit, place = Fit(shape, dtype, whole=True), np.arange(count, dtype=np.int32) * 5 % len(PHASES)
    totals = named(TOTALS, *np.random.default_rng(1).integers(-(10**6), 10**6, (4, shape[1])))
    some = {"frames": fit.frames, "place": place, "basis": fit.rows[place], "first": first}
    return totals | some | {"shape": shape, "macros": fit.fit["macros"]}


@case("correlation_solve_counts", PIXELS | WHOLE, **FIT)
def _(shape, dtype):
    fit = Fit(shape, dtype, whole=True)
    return fit.used | fit.totals | fit.fit


@case("correlation_window", PIXELS | WHOLE | {"largest": (0, 1)}, **FIT)
def _(shape, dtype, largest):
    fit = Fit(shape, dtype, whole=True)
    if not largest:
        return fit.stack | fit.used | fit.fit
    # The largest sums there can be: saturated samples where all cosines are 1.
    basis = np.tile(np.array([1, STEPS[dtype], -STEPS[dtype]], np.int32), (correlation.WINDOW, 1))
    basis[::9, 1:] = 0
    frames = np.full((correlation.WINDOW, shape[1]), np.iinfo(dtype).max, dtype)
    used = named("used cosines sines", *basis.sum(axis=0, dtype=np.int64).tolist())
    stack = {"frames": frames, "place": np.arange(correlation.WINDOW, dtype=np.int32), "basis": basis}
    return stack | used | fit.fit | {"fit": np.full(28, 0.001, np.float32)}


def as_pairs(actual, expected, values):
    """Compare sums of samples less a whole number next to their mean; one next to a half may be either."""
    clear = np.abs(values["total"] / values["used"] % 1 - 0.5) > 1e-3
    assert clear.mean() > 0.9
    held = actual.view(np.float32).reshape(len(actual), -1).sum(axis=1, dtype=np.float64)
    np.testing.assert_allclose(held[clear], expected[clear], rtol=1e-13)


LESS = f"reference {TOTALS}"


@case(
    "correlation_convert",
    PIXELS | WHOLE | {"turns": (1, 50_000)},
    returns=LESS,
    checks=dict.fromkeys(LESS.split(), as_pairs),
)
def _(shape, dtype, turns):
    fit = Fit(shape, dtype, True, turns)
    return fit.used | fit.totals | fit.fit | {"unit": 1 / STEPS[dtype], "fit": None}


@case("correlation_sum", PIXELS | DTYPES | {"first": (0, 1)}, pairs=TOTALS, rtol=1e-13, atol=1e-13)
def _(shape, dtype, first):
    fit, place = Fit(shape, dtype), np.array([0, 9] if first else [3, 1, 4], np.int32)
    basis = np.random.default_rng(2).normal(1, 3, (len(place), 3)).astype(np.float32)
    return fit.totals | fit.fit | {"frames": fit.frames, "place": place, "basis": basis, "first": first}


@case("correlation_window_pairs", PIXELS | DTYPES, **FIT)
def _(shape, dtype):
    fit, order = Fit(shape, dtype), (ORDER + 3) % len(PHASES)
    return fit.fit | {"frames": fit.frames[np.argsort(order)], "place": order, "basis": fit.rows}


@case("correlation_solve_pairs", PIXELS | DTYPES, **FIT, pairs=TOTALS)
def _(shape, dtype):
    fit = Fit(shape, dtype)
    return fit.totals | fit.fit


# --- Displacement of a texture

PICTURE, STEP, WINDOW, GRID = (34, 45), 4, 11, (9, 12)
FIRST, HALO, MARGIN = (STEP - WINDOW) // 2, 2 * WINDOW + 8, displacement.MARGIN
GRID_SIZE = {"node_rows": GRID[0], "node_columns": GRID[1], "step": STEP}
SIZES, ITEMS = GRID_SIZE | {"halo": HALO, "shape": PICTURE}, {"nodes": (1, 8, 16)}
TEXTURE, CLOSE = Speckle(3), {"rtol": 1e-4, "atol": 3e-6}


def spline(frame):
    """Return the coefficients of a frame."""
    coefficients = np.zeros([size + 2 * MARGIN for size in frame.shape], np.float32)
    displacement.displacement_spline(0, len(coefficients), 0, coefficients.shape[1], frame, coefficients)
    return coefficients


def textures(dtype="float32"):
    """Return a moved frame, its coefficients, and planes of a reference that lacks a pixel."""
    first = TEXTURE.frame(PICTURE, 0, 0).astype(dtype).astype(float)
    frame = TEXTURE.frame(PICTURE, 2.3, -1.4, noise=1).astype(dtype)
    coefficients = spline(frame)
    down, right = np.gradient(first)
    lost = np.arange(first.size).reshape(first.shape) == 20 * PICTURE[1] + 20
    rest = [np.pad(np.where(lost, 0, part), HALO) for part in (right, down, first - first.mean())]
    planes = np.stack([np.pad(np.where(lost, np.nan, first), HALO, constant_values=np.nan), *rest])
    field = np.array([2.0, -1.0])[:, None, None] + np.random.default_rng(1).normal(0, 0.4, (2, *GRID))
    return frame, coefficients, {"planes": planes, "field": field, "macros": displaced()}


def displaced(nodes=16, frame="float"):
    """Return the macros of the kernels, for work-items of some nodes."""
    return {"FRAME": frame, "WINDOW": WINDOW, "STEP": STEP, "NODES": nodes}


def packed(matrices, nodes):
    """Return matrices, (rows, columns, 10, 10), as work-items of some nodes use them."""
    rows, columns = matrices.shape[:2]
    items = np.zeros((rows * -(-columns // nodes), displacement.PACKED, nodes))
    displacement.pack(matrices, items)
    return items


def node_items(device, values):
    return len(values["inverse"])


def spline_rows(device, values):
    return (values["bottom"] - values["top"]) * -(-(values["right"] - values["left"]) // device.layout.tile)


@case(
    "displacement_spline", DTYPES | {"shape": (PICTURE, (6, 9), (9, 700)), "whole": (0, 1)}, per=spline_rows,
    checks={"coefficients": near(1e-4, 1e-3)},
)  # fmt: skip
def _(dtype, shape, whole):
    frame = np.resize(textures(dtype)[0], shape)
    rows, columns = (size + 2 * MARGIN for size in shape)
    part = (0, rows, 0, columns) if whole else (3, rows - 5, 2, columns - 3)
    arrays = {"frame": frame, "coefficients": np.zeros((rows, columns)), "shape": shape}
    return arrays | named("top bottom left right", *part) | {"macros": displaced(frame=C_TYPES[dtype])}


@case("displacement_warp", {"nodes": (1, 16), "smooth": (0, 1)}, per="whole row", **CLOSE)
def _(nodes, smooth):
    _, coefficients, values = textures()
    if smooth:  # neighbours of a pixel are displaced to neighbours
        values["field"][:] = np.linspace([2.2, -1.6], [2.6, -1.3], GRID[1]).T[:, np.newaxis]
    difference, start = np.zeros((2, *values["planes"].shape[1:])), FIRST + (WINDOW - 1) / 2
    arrays = {"start": start, "coefficients": coefficients, "difference": difference}
    return SIZES | values | arrays | {"macros": displaced(nodes)}


@case("displacement_solve", ITEMS, per=node_items, **CLOSE)
def _(nodes):
    (_, coefficients, texture), count = textures(), math.prod(GRID)
    inverse = packed(np.zeros((*GRID, displacement.PARAMETERS, displacement.PARAMETERS)), nodes)
    displacement.displacement_normals(
        STEP, FIRST + HALO, WINDOW, texture["planes"], inverse, np.zeros((4, *GRID))
    )
    arrays = {"difference": np.zeros((2, *texture["planes"].shape[1:])), "answer": np.zeros((9, count))}
    start = FIRST + (WINDOW - 1) / 2
    maps = texture["planes"], texture["field"], arrays["difference"]
    displacement.displacement_warp(STEP, start, HALO, coefficients, *maps)
    values = {"first": FIRST + HALO, "window": WINDOW, "macros": displaced(nodes)}
    return SIZES | texture | arrays | values | {"inverse": inverse}


@case(
    "displacement_follow", ITEMS | {"iterations": (1, 3), "bent": (0.02, 0.2)},
    per=lambda *_: (GRID[0] - 2) * GRID[1], **CLOSE,
)  # fmt: skip
def _(nodes, iterations, bent):
    _, coefficients, texture = textures()
    inverse, summary = (
        packed(np.zeros((*GRID, displacement.PARAMETERS, displacement.PARAMETERS)), nodes),
        np.zeros((4, *GRID)),
    )
    displacement.displacement_normals(STEP, FIRST + HALO, WINDOW, texture["planes"], inverse, summary)
    texture["field"] = np.concatenate(
        [texture["field"], np.random.default_rng(2).normal(0, bent, (4, *GRID))]
    )
    values = {"first": FIRST + HALO, "window": WINDOW, "iterations": iterations, "settled": 0.0}
    values |= named("top bottom left right", 1, GRID[0] - 1, 0, GRID[1])
    arrays = named(
        "coefficients inverse summary answer", coefficients, inverse, summary, np.zeros((9, *GRID))
    )
    return SIZES | texture | values | arrays | {"macros": displaced(nodes)}


@case("displacement_field", {"grid": (GRID, (1, 3), (40, 300))}, per="whole row", **CLOSE)
def _(grid):
    rng = np.random.default_rng(4)
    answer = rng.normal(0, 1, (9, *grid))
    answer[:, grid[0] // 2, grid[1] // 2] = np.nan
    field, trust = answer[:2] + rng.normal(0, 1, (2, *grid)), rng.uniform(0, 1, grid)
    values = {"hold": 0.01, "window": WINDOW, "step": STEP, "node_rows": grid[0], "node_columns": grid[1]}
    arrays = {
        "trust": trust,
        "answer": answer,
        "field": np.nan_to_num(field),
        "next_field": np.zeros((2, *grid)),
    }
    return values | arrays | {"shape": grid, "macros": displaced()}


def same_state(actual, expected, values):
    """Check the planes of a state of windows, of which some are numbers."""
    for plane in range(slip.STATES):
        kind = np.int32 if plane in (slip.FLAGS, slip.FITTED, slip.ONSET) else np.float32
        np.testing.assert_allclose(actual[plane].view(kind), expected[plane].view(kind), 1e-4, 1e-6)


def same_slip(actual, expected, values):
    """Check what windows show, of which some are numbers and some are counts."""
    numbers, windows = slip.NUMBERS, values["state"][0].size
    counts, maps = [0, *range(5, 11)], slice(numbers, numbers + 7 * windows)
    np.testing.assert_array_equal(actual[counts], expected[counts])
    if actual[0] < values["least"]:
        return
    range_of_start, motion = slice(1, 5), slice(11, 19)
    for part in (range_of_start, motion, maps):
        np.testing.assert_allclose(actual[part].view(np.float32), expected[part].view(np.float32), 1e-4, 1e-6)
    np.testing.assert_array_equal(actual[maps.stop :], expected[maps.stop :])


def measured_before(actual, expected, values):
    """Check the measured displacements in the scratch."""
    np.testing.assert_allclose(actual[:7], expected[:7], 1e-4, 1e-7)


@case(
    "slip_windows",
    {"moment": ("lost", "first", "second", "starts", "moves", "slips", "enters"), "apart": (1, 3)},
    per=lambda device, values: device.layout.group,
    checks={
        "state": same_state,
        "found": same_slip,
        "scratch": measured_before,
        "sums": lambda *_: None,
        "field": near(1e-5, 1e-6),
    },
)
def _(moment, apart):
    grid, rng = (7, 11), np.random.default_rng(3)
    row, column = np.indices(grid)
    right, down = 0.3 + 0.02 * row, -0.2 - 0.02 * column
    if moment == "slips":
        right[3:5, 6] -= 0.15
    answer = np.concatenate(
        [[right, down], np.zeros((4, *grid)), np.ones((2, *grid)), np.full((1, *grid), 0.01)]
    )
    answer[:8] += rng.normal(0, 0.002, (8, *grid))
    answer[7, 2, 7], answer[8, 4, 4], answer[8, 1, 2] = 30, 2, np.nan
    field = np.concatenate([[right + 0.05, down], np.zeros((4, *grid))])
    state = np.zeros((slip.STATES, *grid), np.int32)
    numbers = state.view(np.float32)
    numbers[slip.LAST : slip.LAST + 2] = right - 0.1, down + rng.normal(0, 0.1, grid)
    numbers[slip.LEARNED] = np.nan if moment == "second" else 0.9
    flags = state[slip.FLAGS]
    flags[...] = slip.FOLLOWED
    flags[2:-1, 2:-2] |= slip.TOUCHED
    flags[2:-1, 2] |= slip.PARTIAL
    flags[3, 5] &= ~slip.FOLLOWED
    is_later = moment in ("moves", "slips", "enters", "lost")
    state[slip.ONSET], state[slip.FITTED] = -1, 5
    numbers[slip.FIXED : slip.FIXED + 2] = np.nan
    if is_later:
        flags[2:-1, 3:-2] |= slip.SETTLED
        numbers[slip.FIXED : slip.FIXED + 2, 2:-1, 2:-2] = 0.002
        numbers[slip.DRIFT], numbers[slip.TURNED] = 1e-9, 1e-9
        if moment == "enters":
            flags[2:-1, -3] &= ~slip.SETTLED
            numbers[slip.FIXED : slip.FIXED + 2, 2:-1, -3] = np.nan
    known = np.concatenate([np.ones((1, *grid)), np.full((2, *grid), 4e-8), np.full((1, *grid), 5e-9)])
    known = np.concatenate([known, rng.normal(0, 0.01, (2, *grid)), np.full((3, *grid), 1e-9)])
    since = {"first": 0, "second": 1}.get(moment, 9)
    works = {"first": slip.MEASURE | slip.FIND_SLIP, "second": slip.LEARN}
    work = works.get(moment, slip.LEARN | slip.MEASURE | slip.FIND_SLIP)
    values = named("top bottom left right", 1, grid[0], 1, grid[1] - 1)
    values |= {"rows": grid[0], "columns": grid[1], "work": work, "least": 1000 if moment == "lost" else 0}
    values |= {"frame": 9, "since_key": since, "started": int(is_later), "apart": apart}
    values |= {"bend_scale": 0.04, "chance": 1.2, "grid": (-0.5, 0.4, 0.1, 0.12), "size": (0.02, 0.024)}
    found = np.zeros(slip.NUMBERS + slip.MAPS * row.size, np.int32)
    scratch, sums = np.zeros((slip.SCRATCH, *grid)), np.zeros((128, slip.SUMS))
    return values | named(
        "answer known field state scratch sums found", answer, known, field, state, scratch, sums, found
    )


def measured(dtype):
    """Return a reference that lacks texture in a corner and has a saturated pixel, and empty planes of it."""
    frame = TEXTURE.frame(PICTURE, 0, 0)
    frame = (frame * (200 / frame.max())).astype(dtype)
    frame[20:, 20:] = 7
    top = {} if dtype == "float32" else {"TOP": np.iinfo(dtype).max}
    frame[3, 5] = top.get("TOP", 90)
    coefficients = spline(frame)
    wide = PICTURE[0] + 2 * HALO, PICTURE[1] + 2 * HALO
    values = named("frame coefficients sums counts", frame, coefficients, *np.full((2, *PICTURE), np.nan))
    values |= named("planes difference", np.full((4, *wide), np.nan), np.full((2, *wide), np.nan))
    return values | {
        "window": WINDOW,
        "halo": HALO,
        "shape": PICTURE,
        "macros": displaced(frame=C_TYPES[dtype]) | top,
    }


def by_plane(atol, correlations=False):
    """Return a check relative to the largest value of each plane, or of matrices to their diagonal."""

    def check(actual, expected, values):
        if correlations:  # those of windows with hardly any texture lose digits in float32
            actual, expected = (displacement.unpack(packed, *GRID) for packed in (actual, expected))
            diagonal = np.sqrt(np.einsum("...kk->...k", expected))
            scale = diagonal[..., np.newaxis] * diagonal[..., np.newaxis, :]
        else:
            scale = np.maximum(np.nanmax(np.abs(expected), axis=(-2, -1), keepdims=True), 1e-9)
        np.testing.assert_allclose(actual / scale, expected / scale, rtol=2e-3, atol=atol)

    return check


MEASURED = named("sums counts planes difference summary", *[by_plane(2e-5)] * 5)


@case("displacement_across", DTYPES, per="whole row", checks=MEASURED)
def _(dtype):
    values = measured(dtype)
    return {name: values[name] for name in ("frame", "window", "sums", "counts", "shape", "macros")}


def wide_rows(device, values):
    rows, columns = values["difference"].shape[1:]
    return rows * -(-columns // device.layout.tile)


@case("displacement_planes", DTYPES, per=wide_rows, checks=MEASURED)
def _(dtype):
    values = measured(dtype)
    displacement.displacement_across(WINDOW, values["frame"], values["sums"], values["counts"])
    return values


@case(
    "displacement_normals", DTYPES | ITEMS, per=node_items,
    checks=MEASURED | {"inverse": by_plane(3e-4, correlations=True)},
)  # fmt: skip
def _(dtype, nodes):
    values = measured(dtype)
    displacement.displacement_across(WINDOW, values["frame"], values["sums"], values["counts"])
    arrays = (values[name] for name in ("frame", "coefficients", "sums", "counts", "planes", "difference"))
    displacement.displacement_planes(HALO, WINDOW, *arrays)
    size = displacement.PARAMETERS
    answers = {"inverse": packed(np.zeros((*GRID, size, size)), nodes), "summary": np.zeros((4, *GRID))}
    given = {"planes": values["planes"], "first": FIRST + HALO, "window": WINDOW, "macros": displaced(nodes)}
    return SIZES | answers | given


PIXELWISE = {"grid": (GRID, (1, 12), (9, 2)), "logarithms": (0, 1), "parts": (1, 2)}


@case(
    "displacement_pixels", PIXELWISE, rtol=2e-5, atol=1e-6,
    per=lambda device, values: 3 * PICTURE[0] * -(-PICTURE[1] // device.layout.tile),
)  # fmt: skip
def _(grid, logarithms, parts):
    nodes = np.random.default_rng(3).normal(0, 1, (3, parts, *grid)).astype(np.float32)
    nodes[1, :, 0, 1] = np.nan
    sizes = {"node_rows": grid[0], "node_columns": grid[1], "step": STEP, "start": FIRST + (WINDOW - 1) / 2}
    arrays = {"nodes": nodes, "pixels": np.zeros((3, *PICTURE, parts), np.float32), "shape": PICTURE}
    return sizes | arrays | {"count": 3, "parts": parts, "logarithms": logarithms, "macros": displaced()}


# --- Exposure

SENSORS = [("uint8", 8, 1.5, 0.0), ("uint8", 8, 0.0, 1.0), ("float32", 8, 1.5, 1.0)]
SENSORS += [("uint16", 10, 1.5, 0.02), ("uint16", 16, 1.5, 0.02)]
KEYS = {"key": ((0, 0), (2**32 + 5, 2**40 + 3), (2**64 - 1, 2**64 - 1)), "quarter": (1, 7, 1025)}


def exposed(dtype, *maps, read=0.0, grain=0.0, top=255.0, key=(0, 0)):
    macros = {"FRAME": C_TYPES[dtype], "WHOLE": int(dtype != "float32"), "SHOT": int(grain > 0)}
    values = named("light offset span", *maps) | {"read": read, "grain": grain, "top": top, "macros": macros}
    pixels = len(maps[0])
    values |= {"shape": (1, pixels // 4), "quarter": pixels // 4, "counts": np.zeros(pixels, dtype)}
    return values | named("frame seed", *key)


def ties(actual, expected, values):
    """A float32 errs by some 1e-7 of its value; counts that fall so near to a half may go either way."""
    difference, whole = np.abs(actual.astype(np.float64) - expected), actual.dtype.kind == "u"
    assert difference.max() <= (1 if whole else 2e-6 * values["top"])
    assert difference.sum() <= 3 + 5e-8 * values["top"] * len(actual) or not whole


@case("expose", {"sensor": SENSORS, "quarter": (1, 7, 4099)}, checks={"counts": ties})
def _(sensor, quarter):
    dtype, bits, read, grain = sensor
    rng, scale = np.random.default_rng(quarter), 2.0 ** (bits - 8)
    maps = [rng.uniform(0, end, 4 * quarter) * by for end, by in ((1, 1), (20, scale), (230, scale))]
    return exposed(dtype, *maps, read=read * scale, grain=grain * scale, top=2.0**bits - 1, key=(5, 9))


@case("expose", KEYS, checks={"counts": near(0, 3e-6)})
def _(key, quarter):  # noise of one count, without any light
    return exposed("float32", *[np.zeros(4 * quarter)] * 3, read=1.0, key=key)


ENDS = np.array([-1e9, -70000, -257, -1, -0.4, 0.5, 1.5, 2.5])


@case("expose", {"bits": (8, 10, 12, 16)})
def _(bits):  # counts end where the bits do
    top = 2.0**bits - 1
    offset = np.array([*ENDS, 8, top - 1, top - 0.4, top, top + 1, top + 257, top + 70000, 1e9])
    return exposed("uint8" if bits == 8 else "uint16", 0 * offset, offset, 0 * offset, top=top)


# --- Focus and lamps

WHOLE_ROWS = {"shape": (11, 130), "stride": 11 * 130}


SCANS = {"radius": (1, 3), "reach": (1, 2), "first": (0, 4), "every": (1, 2)}


@case("focus_scan", DTYPES | SCANS, rtol=2e-5)
def _(dtype, radius, reach, first, every):
    frames = np.random.default_rng(0).integers(0, 250, (9, 11, 130)).astype(dtype)
    if dtype == "float32":
        frames[4, 5, 20] = frames[0, 9, 50] = np.nan
    planes = [np.zeros((count, 11, 130)) for count in (reach, *3 * (2 * reach + 1,))]
    state = named("best recent peak detail last", np.zeros((11, 130), np.int32), *planes)
    if first:
        focus.focus_scan(frames[:first], 0, radius, reach, 5, every, **state)
    values = named("first radius reach above every", first, radius, reach, 5, every)
    return values | {"frames": frames[first:]} | state | WHOLE_ROWS


def sound(rtol, atol=0.0):
    """Return a check of pixels whose peak is sound, but for those where float32 decides of a limit."""

    def check(actual, expected, values):
        part = (values["status"] == 1) & np.isfinite(expected)
        largest = np.max(np.abs(expected[part]), initial=0.0)
        assert (
            np.mean(~np.isclose(actual[part], expected[part], rtol, atol * largest)) < 1e-3
            if part.any()
            else True
        )

    return check


FITTED = named("height spread gain", sound(1e-5), sound(1e-3), sound(1e-3))
FITTED |= named("misfit sharpness status", sound(2e-2, 1e-3), near(1e-4, 0.0), near(0.0, 0.0, fraction=1e-3))
OWN = "shifted", "shifted_noise", "texture", "texture_noise", "left"
FITTED |= dict.fromkeys(OWN, sound(1e-2, 1e-4))


@case("focus_fit", {"reach": (1, 2, 4), "variance": (0.0, 2.25), "every": (1, 3)}, checks=FITTED)
def _(reach, variance, every):
    rng, size = np.random.default_rng(1), (11, 130)
    travel, best = np.cumsum(rng.uniform(0.01, 0.03, 12)), rng.integers(0, 12, size).astype(np.int32)
    frame, steps = best + np.arange(-reach, reach + 1)[:, None, None], np.arange(-reach, reach + 1)
    around = np.clip(np.arange(12)[:, None] + steps, 0, 11)
    places = ((travel[around] - travel[:, None]) / 0.02).astype(np.float32)
    peak = 4000 * np.exp(-((np.moveaxis(places[best], -1, 0) - rng.uniform(-0.4, 0.4, size)) ** 2) / 8)
    peak = peak * rng.uniform(0.98, 1.02, peak.shape)
    peak[(frame < 0) | (frame > 11)] = np.nan
    peak[:, 3, 7], peak[1:, 4, 9], peak[:, 5, 5] = np.nan, np.nan, 3.0
    detail = rng.normal(0, 20, size) * (peak / 4000) ** 0.5 + rng.normal(0, 1, peak.shape)
    arrays = named("places travel best peak detail", places, travel, best, peak, detail)
    arrays |= {name: np.zeros(size) for name in ("height", "spread", "gain", "misfit", "sharpness", *OWN)}
    numbers = named("radius least_contrast least_curvature unit count above", 2, 5.0, 3.0, 0.02, 12, 1)
    arrays |= {"status": np.zeros(size, np.uint8), "macros": {"FRAME": "uchar"}, **WHOLE_ROWS}
    return arrays | numbers | {"reach": reach, "variance": variance, "every": every}


def triangles(actual, expected, values):
    scale = np.abs(expected[:10]).max(axis=1, keepdims=True)
    np.testing.assert_allclose(actual[:10] / scale, expected[:10] / scale, atol=2e-6)
    np.testing.assert_array_equal(actual[10], expected[10])


@case("lambert_add", DTYPES | {"first": (0, 2)}, checks={"triangle": triangles})
def _(dtype, first):
    rng, pixels = np.random.default_rng(0), 1100
    frames = (rng.integers(0, 256, (9, pixels)) * (200 if dtype == "uint16" else 1)).astype(dtype)
    if dtype == "float32":
        frames[3, 8] = np.nan
    darks = rng.uniform(0, 9, pixels).astype(np.float32)
    values = {"darks": darks, "shadow": 10.0, "bright": float(frames[0].max())}
    triangle, lights = np.full((11, pixels), np.nan), rng.normal(size=(9, 3))
    if first:
        lambert.lambert_add(frames[:first], lights[:first], **values, first=0, triangle=triangle)
    values |= {"frames": frames[first:], "lights": lights[first:], "first": first, "triangle": triangle}
    return values | {"shape": (1, pixels), "stride": pixels}


def solved(actual, expected, values):
    np.testing.assert_allclose(actual, np.where(np.isfinite(expected), expected, np.nan), rtol=2e-3)
    assert np.isfinite(expected).mean() > 0.9


SOLVED = dict.fromkeys(("normals", "normals_sigma", "albedo", "albedo_sigma", "residual"), solved)


@case("lambert_normals", checks=SOLVED)
def _():
    rng, pixels = np.random.default_rng(0), 1100
    lights, normals = rng.normal(size=(9, 3)), rng.normal(size=(3, pixels))
    lit = (rng.random((9, pixels)) < 0.85) & (np.arange(pixels) % 7 > np.arange(9)[:, None] - 5)
    frames = np.where(lit, lights @ normals * 50 + 300 + rng.normal(size=lit.shape), 0)
    triangle = np.zeros((11, pixels))
    lambert.lambert_add(frames, lights, np.array([0.0]), 0, 10.0, 1e6, triangle)
    triangle[:, 0], triangle[7, 1] = 0, 0  # without any lamp, and with two
    answers = {name: np.zeros(pixels) for name in SOLVED} | {"normals": np.zeros((pixels, 3))}
    answers |= {"samples": np.zeros(pixels, np.int32), "triangle": triangle}
    return answers | {"shape": (1, pixels), "stride": pixels, "macros": {"FRAME": "uchar"}}


@case("lambert_scale", {"noise": (1, 1100)}, rtol=2e-6)
def _(noise):
    rng, pixels = np.random.default_rng(0), 1100
    values = {"samples": rng.integers(0, 9, pixels).astype(np.int32), "residual": rng.uniform(0, 9, pixels)}
    values["residual"][values["samples"] < 4] = np.nan
    values |= {
        "noise": rng.uniform(1, 3, noise),
        "noise_step": int(noise > 1),
        "limits": np.linspace(3, 2, 7),
    }
    values |= {name: rng.uniform(0, 1, pixels) for name in ("normals_sigma", "albedo_sigma")}
    return values | {"shape": (1, pixels), "macros": {"FRAME": "uchar"}}


@case("lambert_widen", rtol=3e-6)
def _():
    rng, pixels, cells = np.random.default_rng(0), 1100, 8
    normals = rng.normal(size=(pixels, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    values = {"normals": normals, "albedo": rng.uniform(50, 100, pixels)}
    values |= {name: rng.uniform(0, 1, pixels) for name in ("normals_sigma", "albedo_sigma")}
    tables = rng.uniform(-0.1, 1, (7, (cells + 1) ** 2))
    values["albedo"][:3], values["normals"][:3] = np.nan, np.nan
    values |= {"tables": tables, "cells": cells, "noise": 1.2, "usual": 1.4}
    return values | {"shape": (1, pixels), "macros": {"FRAME": "uchar"}}


@case("fringes_phase", {"noise": (1, 1100), "residual_noise": (2.5, np.nan)}, rtol=3e-6, atol=1e-7)
def _(noise, residual_noise):
    rng, pixels = np.random.default_rng(0), 1100
    values = {name: rng.normal(0, 50, pixels) for name in ("cosine_part", "sine_part")}
    values |= {"residual": rng.uniform(0, 15, pixels), "noise": rng.uniform(1, 3, noise)}
    values["cosine_part"][:5], values["sine_part"][:5] = [0, 7, -7, 0, np.nan], [0, 0, 0, -7, 3]
    numbers = {"noise_step": int(noise > 1), "residual_noise": residual_noise, "misfit": 4.0}
    numbers |= {"cosine_variance": 0.2, "covariance": 0.05, "sine_variance": 0.3}
    return values | numbers | {"shape": (1, pixels)}


@case("blur_bend", {"parts": (2, 3), "reach": (1, 3)}, rtol=1e-4, atol=1e-6)
def _(parts, reach):
    rng, shape = np.random.default_rng(0), (11, 130)
    vectors = [rng.normal(size=shape + (() if parts == 2 else (3,))) for _ in range(2)]
    vectors[0][4, 9] = np.nan
    return {
        "first": vectors[0],
        "second": vectors[1],
        "reach": reach,
        "shape": shape,
        "macros": {"PARTS": parts},
    }


@case("blur_add", {"parts": (2, 3), "reach": (1, 3), "noise": (0.0, 0.5)}, rtol=2e-6)
def _(parts, reach, noise):
    bend, sigma, *vectors = np.random.default_rng(0).uniform(0, 1, (5, 11, 130))
    bend[3, 7] = bend[0, 0] = np.nan
    return {
        "first": vectors[0] if parts == 2 else np.stack(vectors, axis=-1),
        "bend": bend,
        "reach": reach,
        "factor": 0.8,
        "noise": noise,
        "base": 0.1,
        "rise": 0.2,
        "sigma": sigma,
        "shape": bend.shape,
        "macros": {"PARTS": parts},
    }


# --- Slopes and samples of arrays on a device


@case("facing_slopes", SHAPES, per="picture", rtol=2e-6)
def _(shape):
    rng = np.random.default_rng(shape[1])
    normals = rng.normal(size=(*shape, 3)) * 3 + [0, 0, 2]
    normals[0, 0] = rng.choice([0, np.nan, np.inf])
    return {"normals": normals, "edge_on": 1e-4, "unit": 2.5, "shape": shape}


@case("facing_weigh", SHAPES | {"masked": (0, 1)}, per="row", rtol=1e-5, atol=1e-6)
def _(shape, masked):
    rng = np.random.default_rng(shape[1])
    dz_dx, dz_dy = rng.normal(size=(2, *shape))
    dz_dx[rng.random(shape) < 0.2] = np.nan
    mask = {"mask": (rng.random(shape) < 0.7).astype(np.uint8)} if masked else {}
    slopes = {"dz_dx": dz_dx, "dz_dy": dz_dy, "variance": 0.01, "unit": 100.0, "shape": shape}
    return slopes | mask | {"macros": {"MASK": masked}}


@case("facing_clip", SHAPES, returns="weight")
def _(shape):
    weight = np.random.default_rng(shape[1]).normal(1, 2, shape)
    return {"weight": weight, "lowest": 0.5, "highest": 3.0, "shape": shape}


@case(
    "samples_take",
    DTYPES,
    per=lambda _, values: math.prod(values[key] for key in ("places", "lines", "rows", "count")),
)
def _(dtype):
    values = np.random.default_rng(0).normal(100, 20, (40, 50)).astype(dtype)
    macros = {"VALUE": C_TYPES[dtype]}
    return {"values": values, "macros": macros} | named(
        "places lines rows count first between apart down step", 2, 4, 3, 12, 252, -103, 400, 100, 4
    )


# --- Limits of memory and arithmetic


def words(limits, count, length, **others):
    """Return random words in the shape of a limit."""
    random = np.random.default_rng(count).integers(0, 2**32, (length, limits.lanes), np.uint32)
    return {"words": random, "count": count, "macros": limits.macros} | others


def per_limit(device, values):
    block = values["macros"]["WORDS"] * values["macros"]["STRIDE"]
    return -(-values["count"] // block) * values["macros"]["STRIDE"]


MEMORY = {"limits": (*CORES, *LANES), "count": (1, 127, 9001)}


@case("read_all", MEMORY, per=per_limit, returns="sums")
def _(limits, count):
    sums = np.zeros((limits.items(count), limits.lanes), np.uint32)
    return words(limits, count, count, each=limits.words, stride=limits.stride, sums=sums)


@case("copy_all", MEMORY, per=per_limit)
def _(limits, count):
    return words(limits, count, 3 * count + 5)


@case("triad_all", MEMORY, per=per_limit)
def _(limits, count):
    return words(limits, count, 3 * count + 5, scale=2**31 + 3)


@case(
    "multiply_all", {"limits": (*CHAINS[0], *CHAINS[1]), "count": (1, 8, 500, 2049)}, per=per_limit, rtol=0.0
)
def _(limits, count):
    numbers = np.arange(count * limits.lanes, dtype=np.float32).reshape(count, limits.lanes) % 97
    values = {"numbers": numbers, "count": count, "macros": limits.macros, "stride": limits.stride}
    return values | {"steps": 7, "factor": -2.0, "summand": 3.0}


# --- Poses


def waves(shape, tilt, seed=0):
    """Return records of a wavy surface, some of them unknown, and some with heights that are not compared."""
    rng, (row, column) = np.random.default_rng(seed), np.indices(shape)
    x, y = (column - (shape[1] - 1) / 2) * 0.05, ((shape[0] - 1) / 2 - row) * 0.06
    height = 0.1 * np.sin(1.3 * x + tilt) * np.cos(0.9 * y) + 0.05 * x
    p = 0.13 * np.cos(1.3 * x + tilt) * np.cos(0.9 * y) + 0.05
    q = -0.09 * np.sin(1.3 * x + tilt) * np.sin(0.9 * y)
    length = np.sqrt(1 + p * p + q * q)
    parts = [-p / length, -q / length, rng.uniform(1e-4, 2e-4, shape), height, rng.uniform(1e-6, 2e-6, shape)]
    records = np.stack([*parts, *rng.uniform(-1, 1, (3, *shape))], axis=-1)
    for index, value in ((slice(None), np.nan), (4, pose.FAR), (2, 1e6)):
        records[rng.random(shape) < 0.02, index] = value
    return records


def summed(actual, expected, values):
    scale = np.abs(expected).max(axis=(0, 1)) + 1e-9
    assert expected[..., pose.PARTS[5]].any()
    np.testing.assert_allclose(actual / scale, expected / scale, atol=1e-4)


def zeniths_summed(actual, expected, values):
    scale = np.abs(expected).max(axis=0) + 1e-6 * np.abs(expected).max()
    assert expected[:, pose.PARTS[5]].any()
    np.testing.assert_allclose(
        actual / scale, expected / scale, atol=3e-4
    )  # without FMA, one sum differs by 1.3e-4


def blocks_of(shape):
    return math.prod(-(-size // pose.BLOCK) for size in shape)


POSES = {"shape": ((24, 33), (3, 2), (40, 30)), "least": (1.0, 0.002), "beside": (0, 1)}
LIMITS = (1e30, 1000.0)  # of the chi square of a pixel


@case(
    "pose_equations",
    POSES | {"limit": LIMITS},
    per=lambda device, values: math.prod(values["sums"].shape[:2]),
    checks={"sums": summed},
)
def _(shape, least, beside, limit):
    grid = -(shape[1] - 1) / 2 * 0.05, (shape[0] - 1) / 2 * 0.06, 0.05, 0.06
    turns = (Rotation.from_rotvec((0.02, -0.05, turn)).as_matrix().ravel() for turn in (0.3, -0.1, 0.0))
    poses = [[*turn, 0.03, -0.04, 0.01, 0.1, -0.2, 0.05, *grid, *grid, least, least, limit] for turn in turns]
    sums = np.zeros((3, blocks_of(shape), pose.PARTS[-1 if beside else -2]))
    maps = named(
        "first second poses sums", waves(shape, 0.0), waves(shape, 0.1, seed=1), np.array(poses), sums
    )
    sizes = {"count": 3, "other_rows": shape[0], "other_columns": shape[1], "shape": shape}
    return maps | sizes | {"macros": {"BESIDE": beside}}


@case(
    "turn_pose_equations",
    {"size": (((24, 33), 1), ((7, 6), 1), ((40, 30), 2)), "beside": (0, 1), "limit": LIMITS},
    per=lambda device, values: len(values["sums"]),
    checks={"sums": zeniths_summed},
)
def _(size, beside, limit):
    shape, step = size
    grid = -(shape[1] - 1) / 2 * 0.05, (shape[0] - 1) / 2 * 0.06, 0.05, 0.06
    matrix, axis = Rotation.from_rotvec((0.02, -0.05, 0.3)).as_matrix().ravel(), (0.024, -0.032, 0.9984**0.5)
    turn, rng = waves(shape, 0.0), np.random.default_rng(1)
    frame = np.hypot(turn[..., 0], turn[..., 1]) + rng.normal(0, 0.02, shape)
    numbers = [*matrix, 0.03, -0.04, 0.01, 0.1, -0.2, 0.05, *grid, *grid, 0.002, *axis, 16, limit, 1]
    sums = np.zeros(
        (
            math.prod(-(-size // (pose.BLOCK * step)) for size in shape),
            turn_pose.LIGHT[-1 if beside else 3],
        )
    )
    maps = named("turn zeniths pose sums", turn, frame, np.array(numbers), sums)
    sizes = {"other_rows": shape[0], "other_columns": shape[1], "step": step, "shape": shape, "base": 0.1}
    return maps | sizes | {"macros": {"BESIDE": beside}}


def is_followed(actual, expected, values):
    assert (actual[0] > 0) == values["is_near"]
    if values["is_near"]:
        np.testing.assert_allclose(actual[2:14], expected[2:14], atol=1e-5)
        np.testing.assert_allclose(actual[:2], expected[:2], rtol=0.1)  # the second is of a short step
        np.testing.assert_allclose(actual[14:16], expected[14:16], rtol=5e-3)
        covariance, reference = actual[pose.COVARIANCE_AT :], expected[pose.COVARIANCE_AT :]
        np.testing.assert_allclose(covariance, reference, atol=5e-3 * np.abs(reference).max())


@case(
    "pose_follow",
    {"free": (0, 2), "start": (0.0, 0.05, 30.0)},
    per=lambda device, values: device.layout.group,
    checks={"found": is_followed, "sums": lambda *_: None},
)
def _(free, start):
    shape = 60, 70
    grid = -(shape[1] - 1) / 2 * 0.05, (shape[0] - 1) / 2 * 0.06, 0.05, 0.06
    directions = np.linalg.qr(np.random.default_rng(5).normal(size=(6, 6)))[0][:, free:]
    other = grid[0] + 0.013, grid[1] + 0.017, *grid[2:]  # so that no border falls on a pixel
    key = [0.1, -0.2, 0.05, *grid, *other, 1.0, 1.0, 1.5, 10.0, *(directions @ directions.T).ravel()]
    motion = np.column_stack([Rotation.from_rotvec((0, 0, start / 10)).as_matrix(), (start, 0, 0)])
    first, second = waves(shape, 0.0), waves(shape, 0.05, seed=1)
    second[..., 5:] = np.moveaxis([-1.69 * second[..., 3], 0 * second[..., 3], -0.81 * second[..., 3]], 0, -1)
    values = named("key first second", np.array(key), first, second)
    values |= named("expected_x expected_y expected_z", *map(tuple, motion.tolist()))
    values |= {"expected_bend": pose.NO_LIMIT}
    values |= {"sums": np.zeros((blocks_of(shape), pose.PARTS[-2])), "found": np.zeros(pose.FOUND)}
    values |= {"other_rows": shape[0], "other_columns": shape[1], "shape": shape, "is_near": start < 1}
    return values | {"macros": {"BESIDE": 0}}


@case("pose_gradient", {"shape": ((1, 1), (3, 50), (40, 37))}, atol=1e-4)
def _(shape):
    maps = {"values": waves(shape, 0.2)[..., 3], "gradient": np.zeros((*shape, 2)), "shape": shape}
    return maps | {"step_x": 0.05, "step_y": 0.06}


MAPS = {"shape": ((1, 1), (3, 50), (40, 37))}
NONE_BUT_HEIGHTS = dict.fromkeys(
    ("height_sigma", "component", "offset_unknown", "normals", "normals_sigma", "filled", "contact", "edges")
)


@case("pose_spikes", MAPS)
def _(shape):
    rng, height = np.random.default_rng(3), waves(shape, 0.2)[..., 3]
    height = height + (rng.random(shape) < 0.1) * rng.uniform(0.1, 1, shape)
    return {"height": height, "height_sigma": np.full(shape, 0.01), "clean": np.zeros(shape), "shape": shape}


@case("pose_means", MAPS | {"size": (1, 2, 3), "with_sigma": (True, False)})
def _(shape, size, with_sigma):
    fine = waves((size * shape[0] + size - 1, size * shape[1] + size - 1), 0.2)
    sigma = np.where(fine[..., 4] < 1.5e-6, np.sqrt(fine[..., 4]), 0.0) if with_sigma else None
    means = np.zeros(shape), np.zeros(shape) if with_sigma else None
    values = named("height height_sigma mean mean_sigma", fine[..., 3], sigma, *means)
    return values | {"size": size, "macros": {"SIZE": size}, "wide": fine.shape[1], "shape": shape}


@case("pose_records", MAPS | {"maps": ("heights", "normals", "all"), "size": (1, 2)}, atol=1e-6)
def _(shape, maps, size):
    rng, height = np.random.default_rng(3), waves(shape, 0.2)
    fine = size * shape[0] + size - 1, size * shape[1] + size - 1
    records = waves(fine, 0.2)
    values = NONE_BUT_HEIGHTS | {"height": height[..., 3], "gradient": None, "shape": shape}
    values |= named("size macros high wide spiky", size, {"SIZE": size}, *fine, 0)
    values |= named("records slopes", np.zeros((*shape, 8)), np.zeros((2, *shape)))
    if maps == "heights":
        x, y, _, _, variance, *_ = height.T.swapaxes(1, 2)
        return values | {"gradient": np.stack([-x, -y], axis=-1), "height_sigma": np.sqrt(variance)}
    x, y = records[..., 0], records[..., 1]
    values |= {"height": records[..., 3], "normals": np.dstack([x, y, np.sqrt(1 - x * x - y * y)])}
    values |= {"normals_sigma": np.where(rng.random(fine) < 0.1, 0.0, 0.01)}
    if maps == "normals":
        return values | {"slopes": None}
    flags = ((rng.random(fine) < density).astype(np.uint8) for density in (0.1, 0.98, 0.02))
    values |= named("filled contact edges", *flags)
    apart = {"component": rng.integers(-1, 3, fine, dtype=np.int32)}
    return (
        values
        | apart
        | {"spiky": 1, "height_sigma": records[..., 0] ** 2, "offset_unknown": np.array([0, 1, 0], np.uint8)}
    )


@case("pose_curvature", MAPS, checks={"records": near(1e-4, 1e-4)})
def _(shape):
    records = waves(shape, 0.2)
    slopes = -np.moveaxis(records[..., :2], -1, 0)
    return named("slopes records step_x step_y shape", slopes, records, 0.05, 0.06, shape)


@case("pose_halve", MAPS | {"odd": (0, 1)}, checks={"records": near(1e-5, 1e-7)})
def _(shape, odd):
    fine = waves((2 * shape[0] + odd, 2 * shape[1] + odd), 0.2)
    return {"fine": fine, "wide": fine.shape[1], "records": np.zeros((*shape, 8)), "shape": shape}


@case(
    "pose_summary",
    MAPS | {"with_records": (True, False)},
    per=lambda device, values: len(values["summary"]),
    checks={"summary": near(1e-5, 1e-5)},
)
def _(shape, with_records):
    records = waves(shape, 0.2) if with_records else np.full((*shape, 8), np.nan)
    strips = shape[0] * math.ceil(shape[1] / pose_maps.STRIP)
    grid = named("x0 y0 step_x step_y", 100.0, -50.0, 0.05, 0.06)
    return {"records": records, "summary": np.zeros((strips, pose_maps.SUMMARY)), "shape": shape, **grid}


# --- Registration

FRAMES = DTYPES | {"shape": ((1, 1), (1, 9), (9, 1), (5, 6), (33, 1100))}
TURNED = {"per": "whole row", "rtol": 2e-5, "atol": 2e-6}
# Pixels to the right and down: a number, and what a column, a row and a millimetre of height add.
SHIFT = np.array([[1.3, 0.011, -0.017, 2.1], [-0.6, -0.021, 0.013, -1.4]])


def clipped(dtype, shape):
    """Return a frame with clipped and missing samples, with levels of each pixel where it is uint16."""
    rng, kind, each = np.random.default_rng(shape[1]), np.dtype(dtype), dtype == "uint16"
    ends = (np.inf, np.nan) if kind.kind == "f" else (np.iinfo(kind).max, 0)
    frame, some = rng.normal(100, 30, shape).astype(kind), rng.random(shape)
    frame[some < 0.01], frame[some > 0.99] = ends
    macros = {"LEVELS": int(each), "FRAME": C_TYPES[dtype]} | (
        {} if kind.kind == "f" else {"TOP": int(ends[0])}
    )
    levels = [
        rng.uniform(*at, shape) if each else np.full((1, 1), at[0] / 200) for at in ((0, 20), (200, 260))
    ]
    padded = np.full([size + 2 * registration.BORDER for size in shape], np.nan)
    return frame, named("offset gain", *levels) | {"padded": padded, "shape": shape, "macros": macros}


@case("registration_admit", FRAMES, **TURNED)
def _(dtype, shape):
    frame, maps = clipped(dtype, shape)
    return maps | {"frame": frame}


def resampled(dtype, shape, shift=SHIFT):
    """Return heights with gaps, and shifts that leave the picture."""
    rng, (frame, maps) = np.random.default_rng(shape[0]), clipped(dtype, shape)
    registration.registration_admit(frame, *(maps[name] for name in ("offset", "gain", "padded")))
    height = np.where(rng.random(shape) < 0.05, np.nan, rng.uniform(-1, 0, shape))
    arrays = named("height shift registered noise", height, shift, np.zeros(shape), np.zeros((2, *shape)))
    return maps | arrays


case("registration_resample", FRAMES, **TURNED)(resampled)


def nothing(actual, expected, values):
    for answer in (actual, expected):
        assert not np.any(answer) or np.isnan(answer).all()


FAR = {"far": (1e4, -1e4, 3e9, np.inf, -np.inf, np.nan), "axis": (0, 1)}


@case("registration_resample", FAR, per="whole row", checks=dict.fromkeys(("registered", "noise"), nothing))
def _(far, axis):
    shift = np.zeros((2, 4))
    shift[axis, 0] = far
    return resampled("uint8", (6, 8), shift)


@case("registration_mend", {"count": (1, 3, 200)})
def _(count):
    rng = np.random.default_rng(count)
    order = rng.permutation(1200)
    places = np.column_stack([order[:count], rng.choice(order[count:], (count, 4))]).astype(np.int32)
    macros = {"FRAME": "uchar", "LEVELS": 1, "TOP": 255}
    return {
        "places": places,
        "padded": rng.normal(size=(40, 30)),
        "count": count,
        "shape": (1, count),
        "macros": macros,
    }


# --- Skin that friction drags

DRAGGED = {"axes": {"twist": (0, 1), "grid": ((40, 50), (20, 31), (1, 1))}}


def dragged(twist, grid):
    """Return a smooth shift, over more than the picture of 30 x 40 and over less."""
    y, x = np.mgrid[: grid[0], : grid[1]]
    shift = 0.3 * np.stack([np.cos(0.11 * x + 0.07 * y), np.sin(0.06 * x - 0.12 * y)])
    numbers = named("place_x place_y along_x along_y", 0.23, 0.0 if twist else -0.11, 0.1, 0.08)
    sizes = named("grid_rows grid_columns shape twist", *grid, (30, 40), twist)
    return numbers | sizes | {"shift": shift, "macros": {"TWIST": twist}}


@case("skin_displacement", **DRAGGED, checks={"displacement": near(1e-5, 6e-6)})  # CLOSE of a pixel
def _(**chosen):
    displacement = np.random.default_rng(5).normal(0, 0.01, (2, 30, 40))
    displacement[:, 3, 4] = np.nan
    return dragged(**chosen) | {"displacement": displacement}


@case("skin_flakes", **DRAGGED, checks={"fraction": near(0, 1e-5)})
def _(**chosen):
    rng = np.random.default_rng(6)
    flakes = (rng.random((FLAKES, FLAKES)) < 0.5).astype(np.uint8)
    cells = [rng.integers(-99, 99, size).astype(np.int32) for size in (40, 30)]
    maps = named("flakes cell_x cell_y part_x part_y", flakes, *cells, rng.random(40), rng.random(30))
    return dragged(**chosen) | maps | {"visible": rng.normal(0, 0.05, (2, 30, 40)), "spacing": 0.15}


# --- The wall in the mirror

LAMPS, NONE = ((0.3, -0.2), (0.1, 0.2)), (0.0, 0.0)
WALLS = [(0, 0.0, NONE, 0), (1, 0.0, LAMPS[0], 1), (2, 0.0, NONE, 0), (0, 2.0, NONE, 1), (1, 0.6, NONE, 0)]
WALLS += [(2, 0.6, LAMPS[1], 1), (3, 0.0, NONE, 0)]  # the last one without scatter


def lit(actual, expected, values):
    """Light grows as a root from the angle of total reflection on; hard by the side the way is uncertain."""
    difference = np.abs(actual - expected)
    if values["scatter"] == 0:  # only rays at an edge may differ
        assert set(np.unique(expected)) == {0.0, 1.0}
        assert np.count_nonzero(difference) <= 1
        return
    assert 0.1 < (expected > 0.01).mean() < 0.9
    assert difference.max() < 1e-3
    assert np.median(difference) < 1e-6
    if values["gap"] == 0:
        assert difference[17.5 - np.hypot(*values["places"][:2]) > 0.2].max() < 2e-5


@case("wall_light", {"wall": WALLS}, checks={"light": lit})
def _(wall):
    """Return mirrors of any zenith and azimuth, many of them flat, at places some of which are outside."""
    (kind, gap, lamps, oblique), rng, pixels = (wall, np.random.default_rng(1), 1500)  # more than a tile
    rows, both = np.repeat(rng.random((12, 1)), 5, axis=1), rng.random((9, 14))
    both = np.pad(np.pad(both, ((1, 1), (0, 0)), "edge"), ((0, 0), (1, 1)), "wrap")
    table = np.full((3, 3), 0.75), rows, both, np.ones((3, 3))
    zenith = np.radians(60) * rng.random(pixels) * (rng.random(pixels) > 0.3)
    azimuth, turn = 2 * np.pi * rng.random((2, pixels))
    slopes = -np.tan(zenith) * np.array([np.cos(azimuth), np.sin(azimuth)])
    places = 18.5 * np.sqrt(rng.random(pixels)) * np.array([np.cos(turn), np.sin(turn)])
    places = np.concatenate([places, -places / 90]) if oblique else places
    scatter = np.radians(3) * (kind < 3)
    off, turn = scatter * rng.random(24) * (np.arange(24) > 0), 2 * np.pi * rng.random(24)
    rays = np.stack([np.cos(off), np.sin(off) * np.cos(turn), np.sin(off) * np.sin(turn)], axis=1)
    rays = rays[: 24 if scatter else 1]
    sheet = np.stack([3 * rng.random(pixels) * (zenith > 0), *slopes])
    maps = named("sheet places rays table", sheet, places, rays, table[kind])
    numbers = named(
        "gap scatter fade radius rim index asymmetry_x asymmetry_y",
        gap,
        scatter,
        scatter / 12,
        17.5,
        40.0,
        1.41,
        *lamps,
    )
    sizes = named(
        "rows columns samples shape",
        table[kind].shape[0] - 2,
        table[kind].shape[1] - 2,
        len(rays),
        (1, pixels),
    )
    macros = {"TABLE": kind % 3, "GAP": int(gap > 0), "LAMPS": int(lamps != NONE), "OBLIQUE": oblique}
    return maps | numbers | sizes | {"macros": macros}


FACTORS = {"across": 0.02, "along": 0.01, "shape_factor": 0.004, "twice": 0.01, "reach": 2.0}


@case("relief_sigma", axes=SHAPES | {"missing": (0.0, 0.2)}, per="row", rtol=2e-5)
def _(shape, missing):
    rng = np.random.default_rng(shape[1])
    height, sigma = rng.normal(0, 0.1, shape), rng.uniform(0.001, 0.01, shape)
    height[rng.random(shape) < missing] = np.nan
    maps = {"height": height, "sigma": sigma, "shape": shape}
    return maps | FACTORS | {"per_slope": 1e-3, "offset": 1e-5}


@pytest.mark.parametrize(("name", "function", "chosen", "options"), CASES)
def test_a_kernel_computes_its_reference(device, name, function, chosen, options):
    with np.errstate(invalid="ignore"):
        agree(device, name, function(**chosen), **options)


ELSEWHERE = {
    "changepoint": "support/changes.py",
    "components": "kernels/integration/test_components.py",
    "contact": "engine/force/test_following.py",
    "edges": "kernels/rotation/test_edges.py",
    "links": "kernels/integration/test_links.py",
    "multigrid": "kernels/integration/test_multigrid.py",
    "normals": "kernels/rotation/test_normals.py",
    "normals_pose": "kernels/rotation/test_normals_pose.py",
    "normals_wall": "kernels/rotation/test_normals_wall.py",
    "onset": "engine/press/test_onset.py",
    "rectangle": "kernels/integration/test_rectangle.py",
    "slopes": "kernels/integration/test_slopes.py",
}
"""Where kernels that work on what the engine prepares, such as a graph, are compared with their reference."""


def test_every_kernel_is_compared_with_its_reference():
    here = {parameters.values[0] for parameters in CASES}
    assert {file for name, file in KERNELS.items() if name not in here} == ELSEWHERE.keys()
    for file, test in ELSEWHERE.items():
        text = (Path(__file__).parents[1] / test).read_text(encoding="utf-8")
        assert re.search(rf"kernels\.\w+(\.| import .*\b){file}\b", text), test
