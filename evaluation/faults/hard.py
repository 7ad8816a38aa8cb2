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
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mirrorskin.engine.base.errors import NotConverged
from mirrorskin.evaluation.base.tables import Table, replace_part
from mirrorskin.evaluation.faults.camera import FAULTS, MORE_FAULTS, PAIRS, SENSORS, Fault, combined
from mirrorskin.evaluation.faults.estimators import ARRAYS, RECORDINGS, applies
from mirrorskin.evaluation.faults.judge import CAUTIOUS, REASON, Cell, inside, judge
from mirrorskin.evaluation.faults.matrix import PAGE, digits
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
_LONG = {**DOORS} | {f"array-{door}": f"{name}, function on arrays" for door, name in DOORS.items()}
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
    "lag 7 %",
    "moving lamp",
    "wave 1 %",
    "fading 3 %",
    "unstated codec",
    "usual deviations",
)
_PROCESSES = 2
_STORED = Path(__file__).with_suffix(".json")
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
        marks = {"x": self.failed, "*": self.lies, "~": self.cautious, "w": self.cell.warned}
        return next((mark for mark, applies_here in marks.items() if applies_here), " ")

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
        and not (door.startswith("array-") and (ALL_FAULTS[fault].stated or ALL_FAULTS[fault].stated_codec))
    ]


def fault_of(place: Place) -> Fault:
    """Return the fault of a cell with the sensor's noise; a video holds 8 bits."""
    fault = combined(SENSORS[place.sensor], ALL_FAULTS[place.fault])
    return replace(fault, bits=8) if fault.codec not in ("", "dct") else fault


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
        alarm_count = sum(one.cell.warned for one in plain)
        lines.append(
            f"{name:9} {len(part):4} cells: {said}; {alarm_count} of {len(plain)} without a fault warned"
        )
    return "\n".join(lines)


def save(outcomes: Sequence[Outcome], path: Path) -> None:
    """Store outcomes."""
    path.write_text(json.dumps([asdict(outcome) for outcome in outcomes], indent=1) + "\n", encoding="utf-8")


def load(path: Path) -> list[Outcome]:
    """Return stored outcomes."""
    content = json.loads(path.read_text(encoding="utf-8"))
    return [
        Outcome(**{**one, "place": Place(**one["place"]), "cell": Cell(**one["cell"])}) for one in content
    ]


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


def without_fault(count: int) -> dict[str, list[Outcome]]:
    """Return so many presses and turns without a fault, over objects, sheets and sensors."""
    doors = {"presses": GROUPS["press"], "rotations": ("heights", "heights2")}
    every = {
        name: itertools.cycle(itertools.product(OBJECTS, SHEETS, SENSORS, some))
        for name, some in doors.items()
    }
    return {
        name: list(
            measured(
                Place(door, thing, sheet, sensor, "none", 100 + number)
                for number, (thing, sheet, sensor, door) in zip(range(count), cells, strict=False)
            )
        )
        for name, cells in every.items()
    }


def alarms(outcomes: Sequence[Outcome]) -> str:
    """Return the warnings of recordings without a fault, by their objects."""
    warned = [outcome for outcome in outcomes if outcome.cell.warned]
    lies, cautious = (
        sum(which) for which in zip(*((one.lies, one.cautious) for one in outcomes), strict=True)
    )
    kinds = Counter(
        f"{outcome.place.thing}, {outcome.place.sheet:g} px: {re.sub('[-0-9.]+', 'N', text)[:80]}"
        for outcome in warned
        for text in outcome.warnings.split("; ")
    )
    head = f"{len(warned)} of {len(outcomes)} warned, {lies} lie, {cautious} over-cautious"
    return "\n".join([head, *(f"  {number} x {kind}" for kind, number in kinds.most_common())])


# --- What is stored ------------------------------------------------------------------------------------


def stored() -> dict[str, Any]:
    """Return the stored chi^2 and marks, by door, fault and object, and the counts of false alarms."""
    if not _STORED.exists():
        return {"cells": {}, "without a fault": {}}
    return dict(json.loads(_STORED.read_text(encoding="utf-8")))


def freeze(outcomes: Sequence[Outcome], plain: Mapping[str, Sequence[Outcome]] | None = None) -> None:
    """Store cells, and the counts of recordings without a fault, and write the page.

    SystemExit if a cell lies that did not.
    """
    content = stored()
    cells, worse = content["cells"], []
    for outcome in outcomes:
        place = outcome.place
        row = cells.setdefault(place.door, {}).setdefault(place.fault, {})
        if outcome.lies and not row.get(place.thing, "*").endswith("*"):
            worse.append(str(outcome))
        row[place.thing] = f"{outcome.cell.chi2:.3g}{outcome.mark.strip()}"
    if worse:
        raise SystemExit("not stored, as these became wrong:\n" + "\n".join(worse))
    for name, some in (plain or {}).items():
        content["without a fault"][name] = [len(some), sum(outcome.cell.warned for outcome in some)]
    lines = [
        f"  {json.dumps(door)}: {{\n"
        + ",\n".join(f"   {json.dumps(fault)}: {json.dumps(row)}" for fault, row in rows.items())
        + "\n  }"
        for door, rows in cells.items()
    ]
    alarms_text = json.dumps(content["without a fault"])
    text = '{\n "cells": {\n' + ",\n".join(lines) + '\n },\n "without a fault": ' + alarms_text + "\n}\n"
    _STORED.write_text(text, encoding="utf-8")
    PAGE.write_text(with_tables(PAGE.read_text(encoding="utf-8")), encoding="utf-8")


def with_tables(page: str) -> str:
    """Return the text of the page with the stored cells in its tables."""
    content = stored()
    page = replace_part(page, "hard totals", _counts(content["cells"]))
    for door in USUAL_DOORS:
        rows = content["cells"][door]
        shown = [(fault, *(_shown(rows[fault][name]) for name in OBJECTS)) for fault in USUAL_FAULTS]
        page = replace_part(page, f"hard {door}", Table("", ("fault", *OBJECTS), shown).as_markdown())
    alarms_text = "; ".join(
        f"{warned} of {count} {name} have a warning"
        for name, (count, warned) in content["without a fault"].items()
    )
    return replace_part(page, "hard false alarms", f"Without a fault, {alarms_text}.\n")


def as_summary() -> str:
    """Return the number of cells, and of those that lie."""
    rows = [row for faults in stored()["cells"].values() for row in faults.values()]
    chosen, held_out = (_tally(rows, things) for things in (CHOSEN, HELD_OUT))
    return (
        f"On hard surfaces, {chosen['lies']} of {chosen['cells']} have one on the objects that methods are\n"
        f"chosen on, {held_out['lies']} of {held_out['cells']} on others.\n"
    )


def _tally(rows: Iterable[Mapping[str, str]], things: Iterable[str]) -> dict[str, int]:
    cells = [row[name] for row in rows for name in things if name in row]
    kinds = {"lies": "*", "over-cautious": "~", "warned": "w", "errors": "x"}
    return {"cells": len(cells)} | {
        kind: sum(cell.endswith(mark) for cell in cells) for kind, mark in kinds.items()
    }


def _counts(cells: Mapping[str, Mapping[str, Mapping[str, str]]]) -> str:
    """Return a table of counts by door, of single faults and of pairs."""
    halves, pairs = {"chosen": CHOSEN, "held out": HELD_OUT}, {fault.name for fault in PAIRS}
    rows: list[tuple[str, ...]] = []
    for door, name in _LONG.items():
        for kind in ("", ", pairs"):
            of_kind = [row for fault, row in cells.get(door, {}).items() if (fault in pairs) is bool(kind)]
            tallies = [_tally(of_kind, things) for things in halves.values()]
            if of_kind:
                rows.append((name + kind, *("; ".join(map(str, tally.values())) for tally in tallies)))
    return Table("", ("estimator", *halves), rows).as_markdown()


def _shown(cell: str) -> str:
    """Return chi^2 as the other matrix shows it: bold if it is too large and nothing is said."""
    value, mark = cell.rstrip("*~wx"), cell[-1]
    if mark == "x":
        return "error"
    text = digits(float(value))
    return {"*": f"**{text}**", "~": f"*{text}*", "w": f"{text}, warned"}.get(mark, text)


def main() -> None:
    """Measure cells, and print them."""
    parser = argparse.ArgumentParser(description=__doc__)
    names = {"objects": OBJECTS, "sheets": SHEETS, "sensors": SENSORS}
    for option, known in names.items():
        parser.add_argument(f"--{option}", help=f"of {', '.join(map(str, known))}; by commas")
    parser.add_argument("--faults", help="names or parts of them, by commas; or 'all', 'single', 'pairs'")
    parser.add_argument("--doors", help=f"of {', '.join([*GROUPS, *DOORS])}, array-...; by commas")
    parser.add_argument("--seeds", type=int, default=1, help="number of recordings of each cell")
    parser.add_argument("-o", type=Path, metavar="FILE.json", help="store the cells")
    parser.add_argument("--compare", type=Path, metavar="OLD.json", help="print what has changed")
    parser.add_argument("--false-alarms", type=int, metavar="N", help="presses and turns without a fault")
    parser.add_argument("--freeze", action="store_true", help="store the cells, and write the page")
    parser.add_argument("--processes", type=int, default=_PROCESSES)
    parser.add_argument("-v", action="store_true", help="print all cells with their warnings")
    asked = parser.parse_args()
    if asked.false_alarms:
        plain = without_fault(asked.false_alarms)
        for name, some in plain.items():
            print(name, alarms(some))
        if asked.freeze:
            freeze([], plain)
        return
    faults = {
        "all": list(ALL_FAULTS),
        "single": [fault.name for fault in (*FAULTS, *MORE_FAULTS)],
        "pairs": [fault.name for fault in PAIRS],
    }
    doors = _names(asked.doors) or list(USUAL_DOORS)
    chosen = places(
        _names(asked.objects) or OBJECTS,
        faults.get(asked.faults) or _faults(asked.faults) or USUAL_FAULTS,
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
    if asked.freeze:
        freeze(outcomes)


def _faults(text: str | None) -> list[str]:
    """Return the faults with these names, or with a part of one in theirs."""
    return [
        name
        for part in _names(text)
        for name in ([part] if part in ALL_FAULTS else ALL_FAULTS)
        if part in name
    ]


def _names(text: str | None) -> list[str]:
    return text.split(",") if text else []


if __name__ == "__main__":
    main()
