"""Integration of slopes: the engine against the limits and against peers, on one surface."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.harness import Measured, Work, take_turns
from mirrorskin.bench.limits import Limits
from mirrorskin.bench.memory import check_memory
from mirrorskin.bench.ours import OURS
from mirrorskin.bench.peers.integration import find_absent, find_peers, scipy_
from mirrorskin.bench.peers.integration.graph import link
from mirrorskin.bench.peers.integration.rectangle import divisors
from mirrorskin.bench.peers.integration.system import as_map, components
from mirrorskin.bench.results import Case, Row
from mirrorskin.bench.same import check_surface
from mirrorskin.bench.slopes import PIXEL, blob_mask, drifting_slopes, noisy_slopes, random_cuts
from mirrorskin.bench.solvers import (
    PYAMG,
    SETUP,
    SLOPES,
    SOLVE,
    mask_works,
    pyamg_works,
    rectangle_works,
    transform_works,
    work_name,
)
from mirrorskin.bench.truth import Truth, find_truth
from mirrorskin.engine import Integrator
from mirrorskin.kernels.device import Device

_MOVED = {SLOPES: 2 * 4 + 4, SETUP: 2 * 4, SOLVE: 2 * 4}  # bytes of a pixel of a full picture: in and out
_MASKED = {SLOPES: 2 * 4 + 1 + 4, SETUP: 4 * 4, SOLVE: 4 * 4}  # within a mask; or of links and source
_ROOM, _DIRECT = 400, 1200  # bytes of a pixel for what all works keep, and for the direct solution
_FRAMES, _CHANGE = 16, 0.01  # of a circle of live frames, and what changes from one to the next
_LOOKS = 3  # at what kernels move
_FULL, _SOLVED, _WAIVED = 1e-4, 1e-3, 1e-2  # of the range, by which heights may differ


@dataclass(frozen=True, slots=True)
class IntegrationCase:
    """A picture of slopes.

    Attributes
    ----------
    name : str
    shape : (int, int)
        Rows and columns.
    cuts : int
        Line segments on which the surface is cut.
    """

    name: str
    shape: tuple[int, int]
    cuts: int = 0

    @property
    def pixels(self) -> int:
        """Of the picture, within a mask and without."""
        return self.shape[0] * self.shape[1]

    @property
    def size(self) -> str:
        """Of the picture, in words."""
        return f"{' x '.join(map(str, self.shape))} float32"


def run_rectangle(case: IntegrationCase, device: Device, rounds: int) -> Case:
    """Time the direct solver of a full picture, the limits and the peers; heights must be the same first.

    Bytes are those of the source, or of the slopes, and of the heights, each once.

    Raises
    ------
    mirrorskin.io.InputError
        There is not enough memory.
    DisagreementError
        Heights are not the same.
    """
    check_memory(case.name, _ROOM * case.pixels)
    slopes = noisy_slopes(case.shape)
    source = link(slopes, PIXEL).source
    exact = scipy_.solve(source, divisors(case.shape, np.float64))
    single = source.astype(np.float32)
    works = rectangle_works(slopes, single, device)
    for peer in find_peers():
        works |= transform_works(peer, slopes, single)
    errors = {}

    def check(results: dict[str, Any]) -> None:
        for name in works:
            check_surface(name, exact, results[name], _FULL)
            errors[name] = float(np.sqrt(np.mean(np.square(results[name] - exact))) / np.ptp(exact))

    limits = Limits(device, np.zeros(_MOVED[SOLVE] * case.pixels, np.uint8))
    measured = take_turns({**limits.works(), **works}, rounds, device.profile, check)
    rows = limits.rows(measured, first="triad") + _rows(measured, works, _MOVED, case)
    solve = work_name(OURS, SOLVE)
    traffic = _traffic(solve, works[solve], device, rows[0])
    notes = (_ratios(measured, "SciPy"), _accuracy(errors), traffic)
    return Case(case.name, f"heights of a full picture; {case.size}", rows, {}, notes)


def run_mask(case: IntegrationCase, device: Device, rounds: int) -> Case:
    """Time heights within a mask, cut or not, the limits, and pyamg until its error is as small as ours.

    Bytes are those of the slopes with mask and edges, or of links and source, and of the heights, each once.

    Raises
    ------
    mirrorskin.io.InputError
        There is not enough memory.
    DisagreementError
        Heights are not those of a direct solver.
    """
    check_memory(case.name, (_ROOM + _DIRECT) * case.pixels)
    mask, edges = blob_mask(case.shape), random_cuts(case.shape, case.cuts) if case.cuts else None
    given = noisy_slopes(case.shape), mask, edges
    truth = find_truth(*given)
    works, absent, said = mask_works(*given, device), find_absent(), []
    if not absent:
        first = np.asarray(works[work_name(OURS, SLOPES)]())
        check_surface(work_name(OURS, SLOPES), truth.map, first, _SOLVED)
        error = truth.error(first)
        theirs, count = pyamg_works(*given, truth, error)
        works |= theirs
        said = [f"{PYAMG} does {count} iterations: as few as leave no larger an error than {error:.1e}"]
    errors = {}

    def check(results: dict[str, Any]) -> None:
        for name in works:
            errors[name] = truth.error(results[name])
            settled = as_map(truth.system, truth.settle(results[name]), truth.wanted)
            check_surface(name, truth.map, results[name] if SLOPES in name else settled, _SOLVED)

    moved = _MASKED | {SLOPES: _MASKED[SLOPES] + (edges is not None)}
    limits = Limits(device, np.zeros(moved[SLOPES] * case.pixels, np.uint8))
    measured = take_turns({**limits.works(), **works}, rounds, device.profile, check)
    rows = limits.rows(measured, first="triad") + _rows(measured, works, moved, case)
    solve = work_name(OURS, SOLVE)
    said += [] if absent else [_ratios(measured, PYAMG)]
    said += [_accuracy(errors), _traffic(solve, works[solve], device, rows[0])]
    return Case(case.name, _title(case, truth), rows, absent, tuple(said))


def run_frames(case: IntegrationCase, device: Device, rounds: int) -> Case:
    """Time live frames within a mask: slopes in, heights out, each frame a little unlike the one before.

    A turn is a circle of frames, one after the other. Bytes are, of each frame, those of slopes, mask and
    heights, each once; the limits are those of as many bytes as one frame moves.

    Raises
    ------
    DisagreementError
        Heights after a circle are not nearly those of a direct solver.
    """
    mask = blob_mask(case.shape)
    frames = drifting_slopes(case.shape, _FRAMES, _CHANGE)
    truth = find_truth(frames[-1], mask, None)
    integrator = Integrator(case.shape, PIXEL, device=device)
    seconds: list[float] = []
    errors = {}

    def circle() -> NDArray[np.float32]:
        for dz_dx, dz_dy in frames:
            begun = time.perf_counter()
            integrator.push(dz_dx, dz_dy, mask=mask)
            height = integrator.result().height
            seconds.append(time.perf_counter() - begun)
        return height

    def check(results: dict[str, Any]) -> None:
        check_surface(OURS, truth.map, results[OURS], _WAIVED)
        errors[OURS] = truth.error(results[OURS])
        seconds.clear()  # of the warm-up

    moved = _MASKED[SLOPES] * case.pixels
    limits = Limits(device, np.zeros(moved, np.uint8))
    measured = take_turns({**limits.works(), OURS: circle}, rounds, device.profile, check)
    rows = [*limits.rows(measured, first="triad"), Row(OURS, measured[OURS], _FRAMES * moved, _FRAMES)]
    lower, middle, upper = 1e3 * np.percentile(seconds, [25, 50, 75])
    frame = f"a frame: median {middle:.2f} ms, quartiles {lower:.2f}-{upper:.2f}"
    notes = (frame, _accuracy(errors), _traffic(OURS, circle, device, rows[0]))
    return Case(case.name, f"live, warm; {_title(case, truth)}", rows, {}, notes)


def _rows(
    measured: Mapping[str, Measured], names: Iterable[str], moved: Mapping[str, int], case: IntegrationCase
) -> list[Row]:
    return [Row(name, measured[name], moved[name.rpartition(", ")[2]] * case.pixels) for name in names]


def _title(case: IntegrationCase, truth: Truth) -> str:
    """Say what is within the mask."""
    count, _ = components(truth.system)
    share = np.count_nonzero(truth.wanted) / case.pixels
    cuts = f", {case.cuts} cuts" if case.cuts else ""
    return f"heights of {100 * share:.0f} % of {case.size}{cuts}, in {count} components"


def _ratios(measured: Mapping[str, Measured], who: str) -> str:
    """Say how many times as fast we are, part by part."""
    told = []
    for part in (SLOPES, SETUP, SOLVE):
        theirs, ours = (measured[work_name(name, part)].wall.median for name in (who, OURS))
        told.append(f"{part} {theirs / ours:.1f}")
    return f"{OURS} against {who}, times as fast: {', '.join(told)}"


def _accuracy(errors: Mapping[str, float]) -> str:
    """Say how far each answer is from the exact one."""
    told = (f"{name} {error:.1e}" for name, error in errors.items() if not name.endswith(SETUP))
    return f"root mean square error, in ranges of the heights: {'; '.join(told)}"


def _traffic(name: str, work: Work, device: Device, limit: Row) -> str:
    """Say which share of the limit a work's kernels reach with what they move in truth."""
    rates, moved = [], 0
    for _ in range(_LOOKS):
        device.profile.clear()
        work()
        kernels = [record for record in device.profile.records() if record.kind == "kernel"]
        moved = sum(record.bytes for record in kernels)
        rates.append(moved / max(sum(record.seconds for record in kernels), 1e-9))
    share = float(np.median(rates)) / limit.kernel_bandwidth
    return f"{name}: kernels move {moved / 1e6:.1f} MB a turn at {100 * share:.0f} % of the {limit.name}"
