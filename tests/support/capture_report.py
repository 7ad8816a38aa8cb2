"""What a capture on the emulated rig costs in accuracy, against the twin rendered directly.

Run as a program it prints the table of all motions: ``python tests/support/capture_report.py``.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from mirrorskin import engine
from mirrorskin.engine.scoring import score
from mirrorskin.hw.camera import Frames
from mirrorskin.hw.emulator.rig import EmulatedRig
from mirrorskin.hw.grbl.stage import GrblStage
from mirrorskin.hw.rig.plans import AxialPlan, Plan, VerticalPlan
from mirrorskin.hw.rig.rig import Rig
from mirrorskin.hw.rig.scan import StepScan
from mirrorskin.hw.rig.sweep import SweepScan
from mirrorskin.hw.twin import Axial, Twin, Vertical
from mirrorskin.io.types import Block, Closing, Floats, Header, Truth
from mirrorskin.kernels.correlation import WINDOW

TILT = math.radians(2.5)
PLANS: Mapping[str, Plan] = {
    "vertical, steps": VerticalPlan(0.0, 1.0, step=0.1),
    "vertical, continuous": VerticalPlan(0.0, 1.0, speed=0.5),
    "axial, steps": AxialPlan(1.0, TILT, phase_step=math.radians(45)),
    "axial, continuous": AxialPlan(1.0, TILT, rate=0.2),
}


class Kept(Closing):
    """Frames that are kept, as a source; and what their numbers were."""

    name, rewindable = "kept", True

    def __init__(
        self, frames: NDArray[np.generic], number: NDArray[np.int64], places: Floats, header: Header
    ) -> None:
        self.header, self.motion = header, header.motion
        self.shape, self.dtype = frames.shape, frames.dtype
        self.frames, self.number, self.places = frames, number, places
        vertical = header.motion == "vertical"
        self.travel, self.phase = (places, None) if vertical else (None, places)
        self._next = 0

    def rewind(self) -> None:
        self._next = 0

    def read(self, out=None, /) -> Block | None:
        out = np.empty((1, *self.shape[1:]), self.dtype) if out is None else out
        part = slice(self._next, min(self._next + len(out), len(self.frames)))
        if part.start == part.stop:
            return None
        self._next = part.stop
        out = out[: part.stop - part.start]
        out[:] = self.frames[part]
        travel, phase = (None if one is None else one[part] for one in (self.travel, self.phase))
        return Block(out, index=part.start, travel=travel, phase=phase)


@dataclass(frozen=True, slots=True)
class Compared:
    """RMS errors of a capture and of the twin rendered directly, mm and degrees."""

    frames: int
    dropped: int
    height: tuple[float, float]
    normal: tuple[float, float]
    delay: float


@dataclass(frozen=True, slots=True)
class Watched:
    """A capture, what it was made by, and a twin that saw the same."""

    captured: Kept
    scan: StepScan | SweepScan
    twin: Twin


def watch(
    plan: Plan,
    *,
    shape: tuple[int, int] = (60, 80),
    pixel_size: float = 0.1,
    rate: float = 30.0,
    delay: float = 0.05,
    jitter: float = 0.005,
    seed: int = 0,
    known: Mapping[str, float] = {},
) -> Watched:
    """Capture a sphere on the emulated rig, whose file says of the camera what is known."""
    pattern = "uniform" if plan.motion == "vertical" else "linear"
    optics = {"shape": shape, "pixel_size": pixel_size, "pattern": pattern}
    with EmulatedRig("sphere", **optics, rate=rate, delay=delay, jitter=jitter, seed=seed) as emulated:
        captured, scan = capture(emulated, plan, known)
        return Watched(captured, scan, emulated.twin(_movement(plan, captured.places)))


def compare(watched: Watched) -> Compared:
    """Render a capture anew at its places, and compare the errors."""
    captured, scan, twin = watched.captured, watched.scan, watched.twin
    frames = np.empty_like(captured.frames)
    # The same noise and the same references, so that only the places differ.
    for place, number, frame in zip(captured.places, captured.number, frames, strict=True):
        pose = twin.movement.pose(place)
        twin.look(lambda late, pose=pose: pose, number, frame)
    rendered = Kept(frames, captured.number, captured.places, captured.header)
    height, normal = zip(*(_errors(source, twin.truth) for source in (captured, rendered)), strict=True)
    delay = scan.delay.seconds if isinstance(scan, SweepScan) else math.nan
    return Compared(len(frames), scan.dropped, height, normal, delay)


def capture(
    emulated: EmulatedRig, plan: Plan, known: Mapping[str, float]
) -> tuple[Kept, StepScan | SweepScan]:
    """Return what a scan gave, and the scan."""
    settings = emulated.settings
    settings = replace(settings, camera=structs.replace(settings.camera, **known))
    with Rig(GrblStage(settings.stage), emulated.camera, settings) as rig:
        numbers = _note_numbers(rig)
        blocks = []
        with StepScan(rig, plan) if plan.in_steps else SweepScan(rig, plan, WINDOW) as scan:
            room = np.empty((16, *scan.shape[1:]), scan.dtype)
            while (block := scan.read(room)) is not None:
                blocks.append(replace(block, frames=block.frames.copy()))
        origin = time.monotonic() - scan.now()
        (places,) = scan.positions().values()
    arrival = origin + np.concatenate([block.time for block in blocks])
    known = np.array(list(numbers))
    number = np.array([numbers[known[np.argmin(abs(known - one))]] for one in arrival])
    return Kept(np.concatenate([block.frames for block in blocks]), number, places, scan.header), scan


def _note_numbers(rig: Rig) -> dict[float, int]:
    """Have the rig write down the number of each frame by its arrival."""
    numbers: dict[float, int] = {}
    take = rig.take

    def noted(most: int) -> Frames:
        taken = take(most)
        numbers.update(zip(taken.time.tolist(), taken.number.tolist(), strict=True))
        return taken

    rig.take = noted
    return numbers


def _movement(plan: Plan, places: Floats) -> Vertical | Axial:
    return Axial(places, plan.tilt, plan.press) if isinstance(plan, AxialPlan) else Vertical(places)


def _errors(source: Kept, truth: Truth) -> tuple[float, float]:
    scored = score(engine.reconstruct(source), truth)
    height = math.nan if scored.height is None else scored.height.rms
    return height, math.nan if scored.normal is None else scored.normal.rms


def main() -> None:
    """Print the table."""
    print(f"{'':22} frames  dropped  delay  height, um      ratio  normal, deg     ratio")
    for name, plan in PLANS.items():
        one = compare(watch(plan, shape=(120, 160), pixel_size=0.05))
        (height, height_direct), (normal, normal_direct) = one.height, one.normal
        print(
            f"{name:22} {one.frames:6}  {one.dropped:7}  {1e3 * one.delay:5.1f}"
            f"  {1e3 * height:6.2f} {1e3 * height_direct:6.2f}  {height / height_direct:6.3f}"
            f"  {normal:6.3f} {normal_direct:6.3f}  {normal / normal_direct:6.3f}"
        )


if __name__ == "__main__":
    main()
