"""What a rotation goes through: correlation, normals, edges, slopes and registration."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.normals import NormalsCase
from mirrorskin.bench.peers.normals.odd import answer
from mirrorskin.bench.sweep.sweep import FRAME_TYPES, MAPS_ONLY, Family, Job, Shape, agree, run_kernel
from mirrorskin.bench.turns import STEPS, TILT, fill, phases
from mirrorskin.engine import Correlator, NormalEstimator, find_edges
from mirrorskin.engine.rotation.design_matrix import basis
from mirrorskin.engine.rotation.edges import LIMITS
from mirrorskin.engine.rotation.normals_to_height import SlopeKernels
from mirrorskin.engine.streaming import push_block
from mirrorskin.io import Block
from mirrorskin.kernels import correlation, edges, registration, slopes
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.device import C_TYPES, Device
from mirrorskin.kernels.edges import COARSE, PASSES, WAYS
from mirrorskin.kernels.registration import BORDER

_WAVE = 4  # operations of a sample: the sum, its products with cosine and sine, its square
_NORMAL = 21  # bytes of a pixel: normal, sigma, contact and mean
_LOOKS, _LOOK, _START = 3, 37, 12  # looks at all samples; multiply-adds of a sample in each, and at first
_PAIRS = 9 + 9 + 6  # of places, in each direction, over the three passes
_PAIR = 14  # multiply-adds of a pair
_SLOPE_BYTES = 12 + 4 + 1 + 4 * 4 + 2 * 4 * 2 + 4 + 4  # of a pixel
_SLOPE = 90  # operations of a pixel
_TAPS = 4 * 4 + 4 + 3 * 8 + 16  # multiply-adds of a resampled pixel: sums, weights, place, noise


def _make_correlation(device: Device, shape: Shape, kind: str, count: int) -> dict[str, Job]:
    """Return the sums over a stack, and those over a window of one turn that moves on frame by frame."""
    dtype, pixels = np.dtype(kind), shape[0] * shape[1]
    limit = 2 * count * pixels * dtype.itemsize
    whole = Correlator(shape, dtype, device=device, memory_limit=limit)
    window = Correlator(shape, dtype, window=STEPS, device=device, memory_limit=limit)
    frames = whole.room[:count]
    fill(frames)
    window.room[:count] = frames
    blocks = [Block(one.room[:count], 0, phase=phases(count)) for one in (whole, window)]

    def add() -> None:
        whole.reset()
        push_block(whole, blocks[0])

    def check() -> None:
        add()
        expected = _refer_correlation(frames, phases(count))
        _compare_waves("correlation_add", whole.result(), expected)
        push_block(window, blocks[1])
        last = _refer_correlation(frames[-STEPS:], phases(count)[-STEPS:])
        _compare_waves("correlation_slide", window.result(), last)

    size = frames.nbytes
    moved = min(count, STEPS) * pixels * (3 if dtype.kind == "u" else 2) * dtype.itemsize
    state = 8 * {1: 4, 2: 8}.get(dtype.itemsize, 0) * pixels
    name = "correlation_add" if dtype.kind == "u" else "correlation_sum"
    slide = "correlation_slide" if dtype.kind == "u" else "correlation_keep"
    one_turn = Block(window.room[:STEPS], 0, phase=phases(STEPS))
    move = run_kernel(device, lambda: push_block(window, one_turn))
    operations = 2 * _WAVE * STEPS * pixels if dtype.kind == "u" else 0  # floats are only kept here
    return {
        name: Job(run_kernel(device, add), size, check, count, _WAVE * frames.size),
        slide: Job(move, moved + state, lambda: None, STEPS, operations),
    }


def _refer_correlation(frames: NDArray[Any], phase: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Return mean, cosine, sine and residual of a stack by the reference, (H, W) each."""
    exact = basis(phase)
    rows = exact.astype(np.float32).astype(np.float64)
    root = np.asarray(np.linalg.cholesky(exact.T @ exact).T)
    project = (root @ np.linalg.inv(rows.T @ exact)).ravel()
    high = project.astype(np.float32)
    parts = high, project - high, np.linalg.inv(root).ravel(), [1 / (len(frames) - 3)]
    fit, ring = np.concatenate(parts).astype(np.float32), frames.reshape(len(frames), -1)
    place = np.arange(len(frames), dtype=np.int32)
    found = correlation.correlation_window(ring, place, rows.astype(np.float32), fit)
    return tuple(one.reshape(frames.shape[1:]) for one in found)


def _compare_waves(what: str, found: Any, expected: tuple[NDArray[np.float64], ...]) -> None:
    for word, exact in zip(("mean", "cosine", "sine", "residual"), expected, strict=True):
        agree(f"{what}, {word}", getattr(found, word), exact, 1e-5 * np.nanmax(np.abs(expected[0])))


def _make_normals(device: Device, shape: Shape, kind: str, _: int) -> dict[str, Job]:
    """Return the exact normals of one turn."""
    case = NormalsCase("sweep-normals", shape, np.dtype(kind))
    turn = case.turn
    estimator = NormalEstimator(
        shape,
        kind,
        tilt=turn.tilt,
        gain=turn.gain,
        offset=turn.offset,
        noise=turn.noise,
        longest=STEPS,
        device=device,
        memory_limit=0,
    )
    frames = estimator.room[:STEPS]
    fill(frames)
    # A turn is over when the next one begins, with a frame that stays in the room then.
    estimator.room[STEPS] = frames[0]
    block = Block(estimator.room[: STEPS + 1], 0, phase=np.append(turn.phase, turn.phase[0] + 2 * np.pi))

    def push() -> None:
        estimator.reset()
        push_block(estimator, block)

    def check() -> None:
        estimator.reset()
        push_block(estimator, Block(frames, 0, phase=turn.phase))
        found = estimator.result()
        expected = answer(frames, turn, np.arange(shape[0] * shape[1]))
        sigma, spared = expected.sigma.reshape(shape), shape[0] * shape[1] // 1000
        near = np.where(found.contact == 1, 0.01 * sigma, 1e-3)[..., np.newaxis]
        agree("normals_exact, vectors", found.vectors, expected.vectors.reshape(*shape, 3), near, 3 * spared)
        agree("normals_exact, sigma", found.sigma, sigma, 1e-3 * sigma, spared)
        agree("normals_exact, contact", found.contact, expected.contact.reshape(shape), 0, spared)
        agree(
            "normals_exact, mean", found.mean, expected.mean.reshape(shape), 1e-5 * np.nanmax(expected.mean)
        )

    operations = case.pixels * STEPS * (_LOOKS * _LOOK + _START)
    moved = case.pixels * (STEPS * case.dtype.itemsize + _NORMAL)
    return {"normals_exact": Job(run_kernel(device, push), moved, check, STEPS, operations)}


def _make_edges(device: Device, shape: Shape, kind: str, _: int) -> dict[str, Job]:
    """Return the edges of a roof with noise: three passes, of which most pixels need two."""
    vectors, sigma, contact = _roof(shape)
    pixels = shape[0] * shape[1]

    def draw() -> NDArray[np.uint8]:
        return find_edges(vectors, sigma, contact, device=device)

    def check() -> None:
        agree("edges", draw(), _refer_edges(vectors, sigma, contact), 0, pixels // 500)

    moved, operations = pixels * (12 + 4 + 1 + 1), pixels * WAYS * _PAIRS * _PAIR
    return {"edges": Job(draw, moved, check, 0, operations)}


def _make_slopes(device: Device, shape: Shape, kind: str, _: int) -> dict[str, Job]:
    """Return the slopes of a roof's normals, and their weights."""
    vectors, sigma, contact = _roof(shape)
    given: dict[str, NDArray[Any]] = {"vectors": vectors, "sigma": sigma, "contact": contact}
    normals = {name: device.given(name, values, values.dtype) for name, values in given.items()}
    to = {name: device.array(name, shape, np.float32) for name in ("dz_dx", "dz_dy", "weight_x", "weight_y")}
    for array in to.values():
        array.upload()
    maps = SlopeKernels(device, shape)
    maps.find(TILT, normals, to)  # which finds the typical weight

    def check() -> None:
        maps.find(TILT, normals, to)
        least = np.sin(TILT) ** 2
        dz_dx, dz_dy, *squares = slopes.slopes_find(least, vectors, sigma, contact)
        bounds = 1e-4 * maps.typical, 1e3 * maps.typical
        weights = slopes.slopes_weigh(least, *bounds, sigma, dz_dx, *squares)
        for (name, array), exact in zip(to.items(), (dz_dx, dz_dy, *weights), strict=True):
            agree(f"slopes, {name}", array.download(), exact, 1e-4 * np.nanmax(np.abs(exact)))

    pixels = shape[0] * shape[1]
    work = run_kernel(device, lambda: maps.find(TILT, normals, to))
    return {"slopes_find and slopes_weigh": Job(work, pixels * _SLOPE_BYTES, check, 0, pixels * _SLOPE)}


def _roof(shape: Shape) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]]:
    """Return normals, sigma and contact of a roof; its lower half is noisy, and a disc is out of contact."""
    generator = np.random.default_rng(0)
    row, column = np.indices(shape, np.float32, sparse=True)
    slope = np.where(column + 0.4 * row < shape[1] / 2, np.float32(0.1), np.float32(0.5))
    across = 0.1 * np.sin(row / 9) + 0 * column
    vectors = np.stack([slope, across, np.ones_like(slope)], axis=-1)
    sigma = np.where(row + 0 * column < shape[0] / 2, 0.005, 0.04).astype(np.float32)
    vectors += 0.7 * sigma[..., np.newaxis] * generator.standard_normal(vectors.shape, np.float32)
    vectors /= np.sqrt(np.sum(np.square(vectors), axis=-1, keepdims=True))
    contact = np.hypot(row - shape[0] / 4, column - shape[1] / 4) > shape[0] / 8
    return vectors, sigma, contact.astype(np.uint8)


def _refer_edges(
    vectors: NDArray[np.float32], sigma: NDArray[np.float32], contact: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """Return the edges by the reference."""
    clean = edges.edges_clean(contact)
    cells = edges.edges_cells(vectors, sigma, contact, clean)
    doubt, lines = np.ones_like(contact), np.zeros_like(contact)
    for chosen in PASSES:
        looked = edges.edges_join(cells, lines) if chosen is COARSE else cells
        strength, way = edges.edges_jumps(looked, chosen, LIMITS, doubt)
        lines = edges.edges_thin(strength, way, chosen, lines)
    return edges.edges_bound(clean, lines)


_SHIFT = np.array([[1.3, 1e-4, -2e-4, 2.1], [-0.6, -2e-4, 1e-4, -1.4]], np.float32)


def _make_registration(device: Device, shape: Shape, kind: str, _: int) -> dict[str, Job]:
    """Return the resampling of one frame, and OpenCV's with weights of its own."""
    frame, height = _ridges(shape, kind)
    rows, columns = shape
    padded = np.full((rows + 2 * BORDER, columns + 2 * BORDER), np.nan, np.float32)
    maps = {
        "frame": device.given("frame", frame, frame.dtype),
        "height": device.given("height", height),
        "shift": device.given("shift", _SHIFT),
        "offset": device.given("offset", np.zeros((1, 1))),
        "gain": device.given("gain", np.ones((1, 1))),
        "padded": device.given("padded", padded),
        "registered": device.given("registered", np.zeros(shape)),
        "noise": device.given("noise", np.zeros((2, *shape))),
    }
    ours = run_kernel(device, lambda: _resample(device, maps, frame))
    across, down = _places(height)
    theirs = np.empty(shape, frame.dtype)

    def peer() -> NDArray[Any]:
        cv2.remap(frame, across, down, cv2.INTER_CUBIC, theirs, cv2.BORDER_REPLICATE)
        return theirs

    def check() -> None:
        ours()
        found, sums = (maps[name].download().copy() for name in ("registered", "noise"))
        expected, noise = np.zeros(shape, np.float32), np.zeros((2, *shape), np.float32)
        zero, one = np.zeros((1, 1), np.float32), np.ones((1, 1), np.float32)
        registration.registration_admit(frame, zero, one, padded)
        registration.registration_resample(padded, height, _SHIFT, zero, one, expected, noise)
        agree("registration_resample, frame", found, expected, 1e-4 * np.nanmax(expected))
        agree("registration_resample, noise", sums, noise, 1e-4)
        close = np.where(np.isfinite(found), peer(), np.nan)
        agree("OpenCV, another cubic", close, found, 0.05 * np.nanmax(expected), found.size // 20)

    size = rows * columns
    moved, plain = size * (frame.itemsize + 4 + 4 + 16), size * (2 * frame.itemsize + 8)
    return {
        "registration_admit and registration_resample": Job(ours, moved, check, 1, size * _TAPS),
        "OpenCV": Job(peer, plain, lambda: None, 1),
    }


def _resample(device: Device, maps: dict[str, Array], frame: NDArray[Any]) -> None:
    """Launch both kernels on a frame that the device has."""
    rows, columns = frame.shape
    top = {"TOP": int(np.iinfo(frame.dtype).max)} if frame.dtype.kind == "u" else {}
    macros: dict[str, str | int] = {"FRAME": C_TYPES[frame.dtype.name], "LEVELS": 0, **top}
    items = rows * -(-columns // device.layout.tile)
    for name, wanted, each in (
        ("registration_admit", "frame offset gain padded", frame.itemsize + 4),
        ("registration_resample", "padded height shift offset gain registered noise", 28),
    ):
        arguments: dict[str, Any] = {one: maps[one] for one in wanted.split()}
        kernel = device.kernel("registration", name, **macros)
        kernel(items, rows=rows, columns=columns, **arguments, moved=each * frame.size)


def _ridges(shape: Shape, kind: str) -> tuple[NDArray[Any], NDArray[np.float32]]:
    """Return a frame of ridges with noise, and heights in mm."""
    generator = np.random.default_rng(0)
    row, column = (np.arange(size, dtype=np.float32) for size in shape)
    smooth = 100 + 40 * np.sin(column / 9) * np.cos(row / 7)[:, np.newaxis]
    counts = smooth + generator.standard_normal(shape, np.float32)
    height = -0.5 + 0.4 * np.cos(column / 31) * np.cos(row / 37)[:, np.newaxis]
    return counts.astype(kind), height.astype(np.float32)


def _places(height: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    """Return columns and rows at which the samples are found."""
    row, column = np.indices(height.shape, np.float32)
    found = []
    for start, shift in zip((column, row), _SHIFT, strict=True):
        place = start + shift[0] + shift[1] * column + shift[2] * row + shift[3] * height
        found.append(place.astype(np.float32))
    return found


CORRELATION = Family(
    "sweep-correlation",
    f"correlation.cl: sums over a stack, and over a window of {STEPS}",
    _make_correlation,
    FRAME_TYPES,
    "read",
    140,
    "bytes are those of the frames, each once; of a window those of new and old frames, of the ring, and of "
    f"its sums, once read and once written; operations: {_WAVE} a sample, old ones included",
)
NORMALS = Family(
    "sweep-normals",
    f"normals.cl: exact normals of {STEPS} frames",
    _make_normals,
    FRAME_TYPES,
    "triad",
    80,
    f"bytes are those of the frames and of normal, sigma, contact and mean; multiply-adds: {_LOOKS} looks at "
    f"each sample of {_LOOK}, and {_START} before, roots and polynomials included",
)
EDGES = Family(
    "sweep-edges",
    "edges.cl: edges of a roof, half of it noisy",
    _make_edges,
    MAPS_ONLY,
    "triad",
    110,
    f"bytes are those of normals, sigma and contact, and of the edges; multiply-adds: {_PAIRS} pairs of "
    f"places in {WAYS} directions, {_PAIR} each, where no pass is spared; the maps go to the device in each "
    "turn",
)
SLOPES = Family(
    "sweep-slopes",
    "slopes.cl: slopes and weights of a roof's normals",
    _make_slopes,
    MAPS_ONLY,
    "triad",
    110,
    "bytes are those of normals, sigma and contact, of slopes, weights and two maps between, which are "
    "written and read; operations a pixel: 40 for slopes with an exponential, 10 for the sums of two maps, "
    "40 for weights with another",
)
REGISTRATION = Family(
    "sweep-registration",
    "registration.cl: one frame resampled after its heights",
    _make_registration,
    FRAME_TYPES,
    "triad",
    60,
    f"bytes are those of frame, heights and resampled frame, and of two sums, read and written; {_TAPS} "
    "multiply-adds a pixel: 16 samples, their weights, the place and the noise; OpenCV takes another cubic, "
    "is told the places and tells no noise",
)
