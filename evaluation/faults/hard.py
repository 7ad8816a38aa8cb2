"""Standard deviations on hard surfaces: six objects, two sheets, three sensors, faults and pairs of faults.

``python -m mirrorskin.evaluation.faults.hard`` measures some cells, and prints tables and totals. A cell
*lies* if its standard deviation is too small without a warning, and is *over-cautious* if it is too large
without a note that states why. Unless ``--sheets`` or ``--sensors`` choose, each cell has one sheet and one
sensor, such that an object, and a fault, meets all of them.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import multiprocessing
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from mirrorskin.engine.base.errors import NotConverged
from mirrorskin.evaluation.faults.camera import FAULTS, MORE_FAULTS, PAIRS, SENSORS, Fault, combined
from mirrorskin.evaluation.faults.estimators import ARRAYS, RECORDINGS, applies
from mirrorskin.evaluation.faults.judge import CAUTIOUS, REASON, Cell, inside, judge
from mirrorskin.evaluation.faults.objects import CHOSEN, HELD_OUT, OBJECTS, SHEETS, under_sheet
from mirrorskin.io.base.types import InputError

DOORS: Mapping[str, str] = {
    "press20": "threshold, steps of 20 µm",
    "press50": "threshold, steps of 50 µm",
    "change20": "change-point, steps of 20 µm",
    "change50": "change-point, steps of 50 µm",
    "normals": "normals of a rotation",
    "heights": "heights of a rotation",
    "normals2": "normals of two turns",
    "heights2": "heights of two turns",
    "fused": "press and rotation, fused",
    "fringes": "fringes",
    "photometric": "photometric stereo",
    "displacement": "displacement",
    "focus": "focus",
}
"""Short names of estimators; "array-" before one is its function on arrays."""

GROUPS: Mapping[str, tuple[str, ...]] = {
    "press": ("press20", "press50", "change20", "change50"),
    "turn": ("normals", "heights", "normals2", "heights2"),
    "recordings": tuple(DOORS),
    "arrays": tuple(f"array-{door}" for door, name in DOORS.items() if name in ARRAYS),
}
ALL_FAULTS = {fault.name: fault for fault in (*FAULTS, *MORE_FAULTS, *PAIRS)}
USUAL_DOORS = "press20", "heights"
USUAL_FAULTS = (
    "none",
    "blur 0.5 px",
    "saturation",
    "gamma 0.9",
    "flicker 2 %",
    "jitter 0.1 steps",
    "vignetting 10 %",
    *(fault.name for fault in MORE_FAULTS),
)
_PROCESSES = 2
_FAILED = "failed: "  # before the text of an error, in place of warnings


@dataclass(frozen=True)
class Place:
    """What a cell is measured with."""

    door: str
    thing: str
    sheet: float
    sensor: str
    fault: str
    seed: int

    @property
    def recording(self) -> tuple[str, ...]:
        """All but the door."""
        return self.thing, str(self.sheet), self.sensor, self.fault, str(self.seed)


@dataclass(frozen=True)
class Outcome:
    """A cell, the median standard deviation, and the texts of findings; the cell's error is the RMS error."""

    place: Place
    cell: Cell
    sigma: float
    warnings: str
    notes: str

    @property
    def lies(self) -> bool:
        """Whether the standard deviation is too small, and nothing is said about it."""
        return not self.cell.honest

    @property
    def cautious(self) -> bool:
        """Whether the standard deviation is too large without a reason."""
        return self.cell.chi2 < CAUTIOUS and REASON not in self.notes + self.warnings

    @property
    def failed(self) -> bool:
        """Whether there is an error instead of a result."""
        return self.warnings.startswith(_FAILED)

    @property
    def mark(self) -> str:
        """One character of what is wrong."""
        return (
            "x"
            if self.failed
            else "*"
            if self.lies
            else "~"
            if self.cautious
            else "w"
            if self.cell.warned
            else " "
        )

    def __str__(self) -> str:
        place, said = self.place, f"  [{self.warnings}]" if self.warnings else ""
        return (
            f"{place.door:9} {place.thing:8} {place.sheet:3g} px {place.sensor:14} {place.fault:18}"
            f" {place.seed}: chi2 {self.cell.chi2:8.2f}{self.mark} beyond {100 * self.cell.beyond:5.1f} %"
            f"  RMS {self.cell.error:.2g}  sigma {self.sigma:.2g}  kept {self.cell.kept:.2f}{said}"
        )


def places(
    things: Iterable[str] = OBJECTS,
    faults: Iterable[str] = USUAL_FAULTS,
    doors: Iterable[str] = USUAL_DOORS,
    *,
    sheets: Sequence[float] = (),
    sensors: Sequence[str] = (),
    seeds: Iterable[int] = (1,),
) -> list[Place]:
    """Return cells to measure; of each object and fault one sheet and sensor, unless some are given."""
    numbers = {name: number for number, name in enumerate(OBJECTS)}
    order = {name: number for number, name in enumerate(ALL_FAULTS)}
    both = list(itertools.product(SENSORS, SHEETS))
    return [
        Place(door, thing, a_sheet, a_sensor, fault, seed)
        for thing, fault, seed in itertools.product(things, faults, seeds)
        for usual in [both[(numbers[thing] + order[fault] + seed - 1) % len(both)]]
        for a_sheet, a_sensor in itertools.product(sheets or (usual[1],), sensors or (usual[0],))
        for door in doors
        if applies(DOORS[door.removeprefix("array-")], ALL_FAULTS[fault])
    ]


def fault_of(place: Place) -> Fault:
    """Return the fault of a cell with the sensor's noise; a video holds 8 bits."""
    fault = combined(SENSORS[place.sensor], ALL_FAULTS[place.fault])
    return replace(fault, bits=8) if fault.codec in ("jpeg", "mpeg") else fault


def _seed(place: Place) -> int:
    """Return the seed of a recording: objects have different noise, and different usual deviations."""
    return place.seed + 1000 * list(OBJECTS).index(place.thing)


def measure(place: Place) -> Outcome:
    """Return what a cell is like."""
    name = place.door.removeprefix("array-")
    answers = (RECORDINGS if name == place.door else ARRAYS)[DOORS[name]]
    try:
        answer = answers(under_sheet(place.thing, place.sheet), fault_of(place), _seed(place))
    except (InputError, NotConverged) as error:
        return Outcome(place, Cell(math.nan, math.nan, 0.0, 0.0, True), math.nan, f"{_FAILED}{error}", "")
    sigma, cell = inside(answer.sigma), judge(answer)
    if cell.kept == 0 and np.isfinite(inside(answer.error)).any():
        return Outcome(place, replace(cell, warned=True), math.nan, f"{_FAILED}no standard deviations", "")
    median = float(np.median(sigma[np.isfinite(sigma)])) if np.isfinite(sigma).any() else math.nan
    return Outcome(place, cell, median, answer.warnings, answer.notes)


def _measure_all(places: Sequence[Place]) -> list[Outcome]:
    return [measure(place) for place in places]


def measured(places: Iterable[Place], processes: int = _PROCESSES) -> Iterator[Outcome]:
    """Measure cells in several processes, those of the same recording in one."""
    groups: dict[tuple[str, ...], list[Place]] = {}
    for place in places:
        groups.setdefault(place.recording, []).append(place)
    if processes == 1:
        yield from itertools.chain.from_iterable(map(_measure_all, groups.values()))
        return
    with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn")) as pool:
        yield from itertools.chain.from_iterable(pool.map(_measure_all, groups.values()))


# --- What is printed and stored ------------------------------------------------------------------------


def as_table(outcomes: Sequence[Outcome]) -> str:
    """Return chi^2 by door, fault and object; the worst, where a cell was measured several times."""
    lines = []
    for door in dict.fromkeys(outcome.place.door for outcome in outcomes):
        of_door = [outcome for outcome in outcomes if outcome.place.door == door]
        things = [name for name in OBJECTS if any(outcome.place.thing == name for outcome in of_door)]
        lines.append(f"{door:22}" + "".join(f"{name:>10}" for name in things))
        for fault in dict.fromkeys(outcome.place.fault for outcome in of_door):
            row = [
                _worst([one for one in of_door if (one.place.fault, one.place.thing) == (fault, name)])
                for name in things
            ]
            lines.append(f"  {fault:20}" + "".join(f"{text:>10}" for text in row))
    return "\n".join(lines)


def _worst(outcomes: Sequence[Outcome]) -> str:
    if not outcomes:
        return ""
    worst = max(outcomes, key=lambda one: (one.lies, one.cautious, abs(math.log(max(one.cell.chi2, 1e-9)))))
    return f"{worst.cell.chi2:.3g}{worst.mark}"


def totals(outcomes: Sequence[Outcome]) -> str:
    """Return counts of cells that lie, are over-cautious, and that are warned of without a fault, by half."""
    parts = {"all": OBJECTS, "chosen": CHOSEN, "held out": HELD_OUT}
    lines = []
    for name, things in parts.items():
        part = [outcome for outcome in outcomes if outcome.place.thing in things]
        if not part:
            continue
        plain = [outcome for outcome in part if outcome.place.fault == "none"]
        counts = {
            "lie": sum(one.lies for one in part),
            "over-cautious": sum(one.cautious for one in part),
            "warned": sum(one.cell.warned for one in part),
            "failed": sum(one.failed for one in part),
        }
        said = ", ".join(f"{count:3} {kind}" for kind, count in counts.items())
        alarms = sum(one.cell.warned for one in plain)
        lines.append(f"{name:9} {len(part):4} cells: {said}; {alarms} of {len(plain)} without a fault warned")
    return "\n".join(lines)


def save(outcomes: Sequence[Outcome], path: Path) -> None:
    """Store outcomes."""
    path.write_text(json.dumps([asdict(outcome) for outcome in outcomes], indent=1) + "\n", encoding="utf-8")


def load(path: Path) -> list[Outcome]:
    """Return stored outcomes."""
    stored = json.loads(path.read_text(encoding="utf-8"))
    return [Outcome(**{**one, "place": Place(**one["place"]), "cell": Cell(**one["cell"])}) for one in stored]


def compared(old: Sequence[Outcome], new: Sequence[Outcome]) -> str:
    """Return the cells of both whose mark or chi^2 has changed, and the totals of both."""
    before = {outcome.place: outcome for outcome in old}
    common = [outcome for outcome in new if outcome.place in before]
    lines = []
    for outcome in common:
        was = before[outcome.place]
        if outcome.mark != was.mark:
            lines.append(f"was {was.cell.chi2:8.2f}{was.mark}, RMS {was.cell.error:.2g}; {outcome}")
    old_totals = totals([before[outcome.place] for outcome in common])
    return "\n".join([*lines, "old", old_totals, "new", totals(common)])


# --- False alarms --------------------------------------------------------------------------------------


def false_alarms(count: int) -> str:
    """Return the warnings of so many presses and turns without a fault, over objects, sheets and sensors."""
    doors = {"presses": GROUPS["press"], "turns": ("heights", "heights2")}
    lines = []
    for name, some in doors.items():
        every = itertools.cycle(itertools.product(OBJECTS, SHEETS, SENSORS, some))
        asked = [
            Place(door, thing, sheet, sensor, "none", 100 + number)
            for number, (thing, sheet, sensor, door) in zip(range(count), every, strict=False)
        ]
        outcomes = list(measured(asked))
        warned = [outcome for outcome in outcomes if outcome.cell.warned]
        lies = sum(outcome.lies for outcome in outcomes)
        cautious = sum(outcome.cautious for outcome in outcomes)
        share = 100 * len(warned) / len(outcomes)
        lines.append(
            f"{name}: {len(warned)} of {len(outcomes)} warned ({share:.1f} %), {lies} lie,"
            f" {cautious} over-cautious"
        )
        kinds = Counter(
            f"{outcome.place.thing}, {outcome.place.sheet:g} px: {text[:80]}"
            for outcome in warned
            for text in outcome.warnings.split("; ")
        )
        lines += [f"  {number} x {kind}" for kind, number in kinds.most_common()]
    return "\n".join(lines)


def main() -> None:
    """Measure cells, and print them."""
    parser = argparse.ArgumentParser(description=__doc__)
    names = {"objects": OBJECTS, "sheets": SHEETS, "sensors": SENSORS}
    for option, known in names.items():
        parser.add_argument(f"--{option}", help=f"of {', '.join(map(str, known))}; by commas")
    parser.add_argument("--faults", help="names, by commas; or 'all', 'single', 'pairs'")
    parser.add_argument("--doors", help=f"of {', '.join([*GROUPS, *DOORS])}, array-...; by commas")
    parser.add_argument("--seeds", type=int, default=1, help="number of recordings of each cell")
    parser.add_argument("-o", type=Path, metavar="FILE.json", help="store the cells")
    parser.add_argument("--compare", type=Path, metavar="OLD.json", help="print what has changed")
    parser.add_argument("--false-alarms", type=int, metavar="N", help="presses and turns without a fault")
    parser.add_argument("--processes", type=int, default=_PROCESSES)
    parser.add_argument("-v", action="store_true", help="print all cells with their warnings")
    asked = parser.parse_args()
    if asked.false_alarms:
        print(false_alarms(asked.false_alarms))
        return
    faults = {
        "all": list(ALL_FAULTS),
        "single": [fault.name for fault in (*FAULTS, *MORE_FAULTS)],
        "pairs": [fault.name for fault in PAIRS],
    }
    doors = _names(asked.doors) or list(USUAL_DOORS)
    chosen = places(
        _names(asked.objects) or OBJECTS,
        faults.get(asked.faults) or _names(asked.faults) or USUAL_FAULTS,
        list(itertools.chain.from_iterable(GROUPS.get(door, (door,)) for door in doors)),
        sheets=[float(sheet) for sheet in _names(asked.sheets)],
        sensors=_names(asked.sensors),
        seeds=range(1, asked.seeds + 1),
    )
    outcomes = list(measured(chosen, asked.processes))
    if asked.v:
        print("\n".join(map(str, outcomes)))
    print(as_table(outcomes), totals(outcomes), sep="\n\n")
    if asked.compare:
        print("", compared(load(asked.compare), outcomes), sep="\n")
    if asked.o:
        save(outcomes, asked.o)


def _names(text: str | None) -> list[str]:
    return text.split(",") if text else []


if __name__ == "__main__":
    main()
