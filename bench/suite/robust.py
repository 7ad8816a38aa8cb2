"""Time of robust integration on surfaces that hide parts of themselves, and of a published method.

Targets: twenty times as fast as the published method; 3 s for a megapixel.
"""

from __future__ import annotations

import time

from mirrorskin.bench.suite.harness import Cases, ratio_target
from mirrorskin.cli.commands.bench.records import Case, Row, Target, Timing
from mirrorskin.cli.commands.bench.timing import OURS, Work, take_turns
from mirrorskin.evaluation.bilateral import integrate_bilaterally
from mirrorskin.evaluation.robust import PEER, PLAIN, integrate
from mirrorskin.evaluation.scenes.depth import SCENES, Scene
from mirrorskin.kernels.device import Device

_SHAPE, _QUICK, _LARGE = (256, 256), (24, 24), (1024, 1024)
_HARDEST = "leaves"
_ROUNDS, _FASTER, _SECONDS = 3, 20.0, 3.0
_BYTES = 3 * 4 + 1 + 4  # bytes per pixel: normals, mask and heights


def run_robust(device: Device, quick: bool) -> Case:
    """Time each scene, the published method only once."""
    shape = _QUICK if quick else _SHAPE
    rows, targets = [], []
    for name, make in list(SCENES.items())[:: 4 if quick else 1]:
        ours, plain, peer = _time(name, make(shape), device, quick)
        rows += [ours, plain, peer]
        targets.append(ratio_target(f"{name}: time", _FASTER, ours, peer, PEER, faster=True))
    title = f"heights of {len(targets)} scenes with hidden parts; {' x '.join(map(str, shape))} float64"
    if quick:
        return Case("integrate-robust", title, rows)
    scene = SCENES[_HARDEST](_LARGE)
    start = time.perf_counter()
    integrate(scene, True, device)
    seconds = time.perf_counter() - start
    rows.append(_once(f"{OURS}, {_HARDEST}, a megapixel", seconds, scene))
    bound = f"at most {_SECONDS:.3g}"
    targets.append(Target(f"{_HARDEST}, a megapixel: s", bound, f"{seconds:.3g}", seconds <= _SECONDS))
    return Case("integrate-robust", title, rows, targets=tuple(targets))


def _time(name: str, scene: Scene, device: Device, quick: bool) -> list[Row]:
    """Return the rows of robust integration, of plain least squares and of the published method."""
    size = _BYTES * scene.mask.size
    works = {
        f"{OURS}, {name}": Work(lambda: integrate(scene, True, device), size),
        f"{OURS}, {name}, {PLAIN}": Work(lambda: integrate(scene, False, device), size),
    }
    rows = take_turns(works, 1 if quick else _ROUNDS, device.profile)
    start = time.perf_counter()
    integrate_bilaterally(scene)
    return [*rows.values(), _once(f"{PEER}, {name}", time.perf_counter() - start, scene)]


def _once(name: str, seconds: float, scene: Scene) -> Row:
    return Row(name=name, wall=Timing.of([seconds]), bytes=_BYTES * scene.mask.size, first=seconds)


CASES: Cases = {"integrate-robust": run_robust}
