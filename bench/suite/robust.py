"""Heights of surfaces that hide parts of themselves: `robust`, plain least squares, and a published method.

Targets on every scene: an error no larger than with the published method, and half of it on average; at most
10 % more than with plain least squares; twenty times as fast as the published method; 3 s for a megapixel.
For held-out heaps, the median and the maximum are tested. Figures, which include pinhole cameras and errors
of normals, are compared with plain least squares only, and their errors with the standard deviations.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin import engine
from mirrorskin.cli.commands.bench.records import Case, Row, Timing
from mirrorskin.cli.commands.bench.timing import OURS, Work, take_turns
from mirrorskin.kernels.device import Device
from suite.bilateral import integrate_bilaterally
from suite.depth_scenes import HELD_OUT, SCENES, Scene
from suite.figure_scenes import CHOSEN_ON, Figure
from suite.figure_scenes import HELD_OUT as HELD_OUT_FIGURES
from suite.harness import Cases, at_most, ratio_target

_SHAPE, _QUICK, _LARGE = (256, 256), (24, 24), (1024, 1024)
_PLAIN, _PEER, _HARDEST = "plain", "Cao et al.", "leaves"
_ROUNDS, _FASTER, _WORSE, _MEAN, _SECONDS = 3, 20.0, 1.1, 0.5, 3.0
_BYTES = 3 * 4 + 1 + 4  # bytes per pixel: normals, mask and heights


def run_robust(device: Device, quick: bool) -> Case:
    """Time each scene, the published method only once, and compare heights with the truth."""
    shape = _QUICK if quick else _SHAPE
    rows, notes, targets, ratios = [], [], [], []
    for name, make in list(SCENES.items())[:: 4 if quick else 1]:
        (mine, least, other), (ours, plain, theirs), steps = _compare(name, make(shape), device, quick)
        rows += [mine, least, other]
        ratios.append(ours / theirs)
        notes.append(
            f"{name}: mean absolute error {ours:.3f} mm, {_PLAIN} {plain:.3f}, "
            f"{_PEER} {theirs:.3f} in {steps} steps"
        )
        targets.append(at_most(f"{name}: error, mm, of {_PEER}", ours, theirs))
        targets.append(at_most(f"{name}: error, mm, {_PLAIN} and a tenth", ours, _WORSE * plain))
        targets.append(ratio_target(f"{name}: time", _FASTER, mine, other, _PEER, faster=True))
    held = [
        _compare(name, make(shape), device, quick)
        for name, make in list(HELD_OUT.items())[: 1 if quick else None]
    ]
    rows += [row for some, _, _ in held for row in some]
    errors = np.array([one for _, one, _ in held])  # ours, plain, theirs
    to_plain, to_peer = errors[:, 0] / errors[:, 1], errors[:, 0] / errors[:, 2]
    for who, ratio in ((_PLAIN, to_plain), (_PEER, to_peer)):
        middle, most = np.median(ratio), ratio.max()
        notes.append(f"held-out heaps, errors over those of {who}: median {middle:.2f}, worst {most:.2f}")
    targets.append(
        at_most(f"held-out heaps: median of errors, of those of {_PEER}", float(np.median(to_peer)), _MEAN)
    )
    targets.append(at_most(f"held-out heaps: worst of errors, of {_PLAIN}", float(to_plain.max()), _WORSE))
    for which, figures in (("chosen on", CHOSEN_ON), ("held out", HELD_OUT_FIGURES)):
        chosen = list(figures.values())[: 1 if quick else None]
        found = np.array([_compare_figure(make(), device) for make in chosen])
        (middle, chi2), (most, worst) = np.median(found, axis=0), found.max(axis=0)
        notes.append(
            f"figures {which}, errors over those of {_PLAIN}: median {middle:.2f}, worst {most:.2f}; "
            f"chi^2: median {chi2:.2f}, worst {worst:.1f}"
        )
        targets.append(at_most(f"figures {which}: worst of errors, of {_PLAIN}", float(most), _WORSE))
        targets.append(at_most(f"figures {which}: median chi^2", float(chi2), 2.0))
    if not quick:
        scene = SCENES[_HARDEST](_LARGE)
        start = time.perf_counter()
        _integrate(scene, True, device)
        seconds = time.perf_counter() - start
        rows.append(_once(f"{OURS}, {_HARDEST}, a megapixel", seconds, scene))
        targets.append(at_most(f"{_HARDEST}, a megapixel: s", seconds, _SECONDS))
        targets.append(at_most(f"mean of errors, of those of {_PEER}", float(np.mean(ratios)), _MEAN))
    count = len(ratios) + len(held)
    title = f"heights of {count} scenes with hidden parts; {' x '.join(map(str, shape))} float64"
    return Case("integrate-robust", title, rows, {}, tuple(notes), () if quick else tuple(targets))


def _compare(
    name: str, scene: Scene, device: Device, quick: bool
) -> tuple[list[Row], tuple[float, float, float], int]:
    """Return rows and errors (ours, plain, published), and the iterations of the published method."""
    size = _BYTES * scene.mask.size
    works = {
        f"{OURS}, {name}": Work(lambda: _integrate(scene, True, device), size),
        f"{OURS}, {name}, {_PLAIN}": Work(lambda: _integrate(scene, False, device), size),
    }
    errors: list[float] = []

    def check(results: dict[str, Any]) -> None:
        errors.extend(scene.error(height) for height in results.values())

    rows = take_turns(works, 1 if quick else _ROUNDS, device.profile, check)
    start = time.perf_counter()
    found, steps = integrate_bilaterally(scene)
    peer = _once(f"{_PEER}, {name}", time.perf_counter() - start, scene)
    return [*rows.values(), peer], (errors[0], errors[1], scene.error(found)), steps


def _compare_figure(figure: Figure, device: Device) -> tuple[float, float]:
    """Return the error over that of plain least squares, and chi^2."""
    plain, ours = (
        engine.integrate(**figure.arguments(), robust=robust, device=device) for robust in (False, True)
    )
    chi2 = float(np.nanmean(figure.scores(ours) ** 2))
    return figure.error(ours.height) / figure.error(plain.height), chi2


CASES: Cases = {"integrate-robust": run_robust}


def _integrate(scene: Scene, robust: bool, device: Device) -> NDArray[np.float32]:
    height: NDArray[np.float32] = engine.integrate(
        normals=scene.normals,
        mask=scene.mask,
        pixel_size=scene.pixel_size,
        robust=robust,
        sigma=False,
        device=device,
    ).height
    return height


def _once(name: str, seconds: float, scene: Scene) -> Row:
    return Row(name=name, wall=Timing.of([seconds]), bytes=_BYTES * scene.mask.size, first=seconds)
