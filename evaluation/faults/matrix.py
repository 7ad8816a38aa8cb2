"""Errors and standard deviations of each estimator with each fault of a camera.

``python evaluation/faults/matrix.py`` (in the environment) prints the cells; ``--freeze`` stores them in
``evaluation/faults/matrix.json`` and writes the tables of docs/faults.md. It refuses if a standard
deviation became wrong that was right.
"""

from __future__ import annotations

import argparse
import functools
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from mirrorskin.evaluation.base.tables import Table, replace_part
from mirrorskin.evaluation.faults.calibrations import CALIBRATION_FAULTS, of_calibration
from mirrorskin.evaluation.faults.camera import FAULTS, Fault, Floats
from mirrorskin.evaluation.faults.estimators import ARRAYS, RECORDINGS, Answers, Surface, applies
from mirrorskin.evaluation.faults.judge import Answer, Cell, inside, judge, rms
from mirrorskin.evaluation.faults.slopes import SLOPE_FAULTS, integrated
from mirrorskin.evaluation.faults.touches import of_touch
from mirrorskin.evaluation.faults.walls import WALL_FAULTS, of_wall

SHAPE = 48, 64  # pixels
_STORED = Path(__file__).with_suffix(".json")
PAGE = Path(__file__).resolve().parents[2] / "docs" / "faults.md"


# --- Scenes --------------------------------------------------------------------------------------------


def _waves(x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    """Return heights of a wavy surface, and how they change along x and y."""
    u, v = 2 * np.pi * x / 1.6, 2 * np.pi * y / 1.9
    height = 0.2 * np.sin(u) * np.cos(v) - 0.6
    return (
        height,
        0.2 * 2 * np.pi / 1.6 * np.cos(u) * np.cos(v),
        -0.2 * 2 * np.pi / 1.9 * np.sin(u) * np.sin(v),
    )


def _crater(x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    """Return heights of a plate with a round bowl whose rim is sharp, and how they change."""
    radius = np.hypot(x, y)
    inside = radius < 0.9
    height = np.where(inside, -0.5 - 0.4 * (1 - (radius / 0.9) ** 2), -0.5)
    slope = np.where(inside, 0.8 / 0.81, 0.0)
    return height, slope * x, slope * y


WAVES = Surface.from_function("waves", _waves, SHAPE, (0.2, 1.1))
CRATER = Surface.from_function("crater", _crater, SHAPE, (0.2, 1.1))


def _of_slopes(*, weights: bool = False, robust: bool = False) -> Estimator:
    return lambda fault, seed: Answer(*integrated(fault, seed, weights=weights, robust=robust))


Estimator = Callable[[Any, int], Answer]


def _on_waves(answers: Mapping[str, Answers]) -> dict[str, Estimator]:
    """Return the estimators of this matrix among some."""
    left_out = "threshold, steps of 50 µm", "normals of two turns", "heights of two turns"
    rim = {"threshold, rim of a crater": functools.partial(answers[_RIM], CRATER)}
    on_waves = {
        name: functools.partial(answer, WAVES) for name, answer in answers.items() if name not in left_out
    }
    names = list(on_waves)
    ordered = [*names[:2], *rim, *names[2:]]
    return {name: (on_waves | rim)[name] for name in ordered}


_RIM = "threshold, steps of 20 µm"
ESTIMATORS: Mapping[str, Estimator] = {
    **_on_waves(RECORDINGS),
    "touch": functools.partial(of_touch(_waves), WAVES),
    "calibration from touches": of_calibration,
    "calibration of a wall from touches": of_wall,
    "integrate": _of_slopes(),
    "integrate with weights": _of_slopes(weights=True),
    "integrate robustly": _of_slopes(robust=True),
}
FUNCTIONS: Mapping[str, Estimator] = _on_waves(ARRAYS)
"""The estimators that have a function on arrays, which is not what they call above."""


PRESS = [name for name in ESTIMATORS if name.startswith(("threshold", "change-point"))]
SLOPES = [name for name in ESTIMATORS if name.startswith("integrate")]
TOUCHES = ["touch"]
CALIBRATIONS = ["calibration from touches"]
WALLS = ["calibration of a wall from touches"]
OTHERS = [name for name in ESTIMATORS if name not in PRESS + SLOPES + TOUCHES + CALIBRATIONS + WALLS]


# --- Cells ---------------------------------------------------------------------------------------------


def faults_of(estimator: str) -> tuple[Any, ...]:
    """Return the faults of the frames, or of the slopes, that an estimator gets."""
    if estimator in SLOPES:
        return SLOPE_FAULTS
    if estimator in CALIBRATIONS:
        return CALIBRATION_FAULTS
    if estimator in WALLS:
        return WALL_FAULTS
    return tuple(fault for fault in FAULTS if applies(estimator, fault))


def faults_of_arrays(estimator: str) -> tuple[Fault, ...]:
    """Return the faults of frames in an array, of which nobody states anything, not even a compression."""
    return tuple(fault for fault in faults_of(estimator) if not fault.stated)


def row(estimator: str, part_of_name: str = "", seed: int = 1) -> dict[str, Cell]:
    """Return the cells of an estimator by the name of the fault."""
    return _row(ESTIMATORS[estimator], faults_of(estimator), part_of_name, seed)


def row_of_arrays(estimator: str, part_of_name: str = "", seed: int = 1) -> dict[str, Cell]:
    """Return the cells of a function on arrays by the name of the fault."""
    return _row(FUNCTIONS[estimator], faults_of_arrays(estimator), part_of_name, seed)


def _row(
    answer: Callable[[Any, int], Answer], faults: tuple[Any, ...], part_of_name: str, seed: int
) -> dict[str, Cell]:
    usual = rms(inside(answer(faults[0], seed).error))
    return {fault.name: judge(answer(fault, seed), usual) for fault in faults if part_of_name in fault.name}


# --- What is stored ------------------------------------------------------------------------------------


def open_cells() -> dict[str, list[str]]:
    """Return the faults of each estimator because of which its standard deviation is wrong without a word."""
    return {name: faults for name, faults in _stored()["open"].items() if name in ESTIMATORS}


def _stored() -> dict[str, Any]:
    return (
        dict(json.loads(_STORED.read_text(encoding="utf-8")))
        if _STORED.exists()
        else {"open": {}, "cells": {}, "functions": {}}
    )


def freeze(table: Mapping[str, Mapping[str, Cell]], arrays: Mapping[str, Mapping[str, Cell]]) -> None:
    """Store cells, and write the page; SystemExit if a standard deviation became wrong.

    ``arrays`` are the cells of functions on arrays.

    ``first`` keeps the chi^2 with which a cell was first stored.
    """
    stored = _stored()
    before, opened_before, worse = stored["cells"], stored["open"], []
    for name, cells in table.items():
        opened = [fault for fault, cell in cells.items() if not cell.honest]
        worse += [
            f"{name}: {fault}"
            for fault in opened
            if name in opened_before and fault not in opened_before[name] and fault in before[name]
        ]
        opened_before[name] = opened
        before[name] = {
            fault: _rounded(cell)
            | {"first": before.get(name, {}).get(fault, {}).get("first", _number(cell.chi2))}
            for fault, cell in cells.items()
        }
    if worse:
        raise SystemExit("not stored, as these became wrong:\n" + "\n".join(worse))
    functions = stored["functions"] | {
        name: {fault: _rounded(cell) | {"open": not cell.honest} for fault, cell in cells.items()}
        for name, cells in arrays.items()
    }
    content = {"open": opened_before, "cells": before, "functions": functions}
    _STORED.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(with_tables(text), encoding="utf-8")


def _rounded(cell: Cell) -> dict[str, float | bool | None]:
    return {
        name: value if value is True or value is False else _number(value)
        for name, value in asdict(cell).items()
    }


def _number(value: float) -> float | None:
    return None if math.isnan(value) else float(f"{value:.3g}")


def with_tables(page: str) -> str:
    """Return the text of the page with the stored cells in its tables."""
    cells, opened = _stored()["cells"], open_cells()
    parts: tuple[tuple[list[str], tuple[Any, ...]], ...] = (
        (PRESS, FAULTS),
        (OTHERS, FAULTS),
        (SLOPES, SLOPE_FAULTS),
        (TOUCHES, faults_of("touch")),
        (CALIBRATIONS, CALIBRATION_FAULTS),
        (WALLS, WALL_FAULTS),
    )
    for number, (names, faults) in enumerate(parts):
        rows = [
            [fault.name, *(_shown(cells, opened, name, fault.name) for name in names)] for fault in faults
        ]
        page = replace_part(page, f"cells {number}", _table(["fault", *names], rows))
    return replace_part(page, "cells of functions", _about_functions())


def _table(head: list[str], rows: list[list[str]]) -> str:
    return Table("", tuple(head), [tuple(row) for row in rows]).as_markdown()


def as_summary() -> str:
    """Return the number of cells, and of those whose standard deviation is too small without a warning."""
    cells, opened = _stored()["cells"], open_cells()
    count, wrong = (sum(map(len, part.values())) for part in (cells, opened))
    return (
        f"Of {count} combinations of a fault and an estimator, {wrong} have a standard deviation that is\n"
        "too small, without a warning.\n"
    )


def _about_functions() -> str:
    """Return the numbers of wrong cells of functions on arrays, and a table of those right in recordings."""
    cells, opened = _stored()["functions"], open_cells()
    wrong = {(name, fault) for name in cells for fault, cell in cells[name].items() if cell["open"]}
    also = {(name, fault) for name in cells for fault in opened[name] if fault in cells[name]}
    text = (
        f"Of {sum(map(len, cells.values()))} cells, {len(wrong)} are bold for functions on arrays,"
        f" {len(also)} for recordings.\n"
    )
    only = wrong - also
    if not only:
        return text
    names = [name for name in cells if any(name == other for other, _ in only)]
    faults = [fault.name for fault in FAULTS if any(fault.name == other for _, other in only)]
    rows = [
        [fault, *(digits(cells[name][fault]["chi2"]) if (name, fault) in only else "" for name in names)]
        for fault in faults
    ]
    bold = "The table contains the cells that are bold for the function on arrays only.\n"
    return text + bold + "\n" + _table(["$\\chi^2$", *names], rows)


def _shown(cells: Mapping[str, Any], opened: Mapping[str, list[str]], estimator: str, fault: str) -> str:
    """Return error and chi^2 of a cell, bold if the standard deviation is wrong."""
    cell = cells[estimator].get(fault)
    if cell is None:
        return ""
    if cell["chi2"] is None:
        return "no answer"
    text = f"{digits(cell['error'])}; {digits(cell['chi2'])}"
    if cell["first"] is not None and not 0.5 < cell["chi2"] / cell["first"] < 2:
        text += f" (was {digits(cell['first'])})"
    if fault in opened[estimator]:
        return f"**{text}**"
    return f"{text}, warned" if cell["warned"] else text


def digits(value: float) -> str:
    """Return a number with two digits, at least."""
    return f"{value:.0f}" if value >= 100 else f"{value:.2g}" if value < 1 or value >= 10 else f"{value:.1f}"


def main() -> None:
    """Print the cells of some estimators, or store them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("estimator", nargs="*", help="parts of the names of estimators")
    parser.add_argument("--fault", default="", help="part of the name of a fault")
    parser.add_argument("--freeze", action="store_true", help="store all cells of these, and write the page")
    asked = parser.parse_args()
    names = [
        name for name in ESTIMATORS if not asked.estimator or any(part in name for part in asked.estimator)
    ]
    table, arrays = {}, {}
    fault = "" if asked.freeze else asked.fault
    for name in names:
        table[name] = row(name, fault)
        _print(name, table[name])
        if name in FUNCTIONS:
            arrays[name] = row_of_arrays(name, fault)
            _print(f"{name}, function on arrays", arrays[name])
    if asked.freeze:
        freeze(table, arrays)


def _print(name: str, cells: Mapping[str, Cell]) -> None:
    print(name)
    for fault, cell in cells.items():
        print(f"  {fault:18} {cell}")


if __name__ == "__main__":
    main()
