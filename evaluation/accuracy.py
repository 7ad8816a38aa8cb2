"""Write the tables of docs/accuracy.md from stored results: ``make accuracy``.

``python evaluation/accuracy.py [NAME ...]`` measures the tables with these names first, and stores them:
normals and ramps in a minute, fusion, calibration and bounds in about ten each.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path

import msgspec
import numpy as np

from mirrorskin.cli.commands.bench.records import Run, open_run
from mirrorskin.evaluation import bounds, ramps, robust, sample_fusion
from mirrorskin.evaluation.base.tables import Table, replace_part
from mirrorskin.evaluation.calibration import report
from mirrorskin.evaluation.faults import hard, matrix
from mirrorskin.evaluation.scenes import rotations
from mirrorskin.kernels.device import open_device

PAGE = Path(__file__).resolve().parents[1] / "docs" / "accuracy.md"
ZENITHS = (0, 1), (1, 2), (2.4, 2.6), (4, 5), (7.5, 10), (15, 20), (30, 35), (55, 60)  # bins, degrees

_STORED = Path(__file__).with_name("stored")
_BOUNDS = _STORED / "bounds.json"
_DRAWS = 20_000


def measure_normals() -> Table:
    """Return the errors of both methods of normals in bins of zenith, and the smallest possible ones."""
    stack = rotations.draw(rotations.SETUPS["uint8"], _DRAWS, seed=1, bins=ZENITHS)
    errors = {"Cramér-Rao bound": np.sqrt(stack.bound.mean(axis=-1))}
    for method in ("exact", "paper"):
        normals = rotations.estimate_stack(stack, method=method).normals
        between = rotations.between(normals.astype(float), stack.normals)
        errors[f"`{method}`"] = np.sqrt(np.nanmean(between**2, axis=-1))  # NaN if all samples are equal
    head = ("zenith", *(f"{low:g}-{high:g}" for low, high in ZENITHS))
    rows = [(name, *(f"{degrees:.3f}" for degrees in np.degrees(error))) for name, error in errors.items()]
    return Table("RMS angle to the true normal, degrees", head, rows)


TABLES: Mapping[str, Callable[[], Table]] = {
    "normals": measure_normals,
    "ramps": ramps.measure,
    "fusion": sample_fusion.measure,
    "calibration": report.measure,
}


def measure(name: str) -> None:
    """Measure a table, and store it; or the bounds of this device."""
    if name == "bounds":
        _BOUNDS.write_bytes(bounds.measure(open_device(), more=robust.CASES).as_json())
        return
    table = msgspec.json.format(msgspec.json.encode(TABLES[name]()), indent=1)
    (_STORED / f"{name}.json").write_bytes(table + b"\n")


def stored(name: str) -> Table:
    """Return a table as it was stored."""
    return msgspec.json.decode((_STORED / f"{name}.json").read_bytes(), type=Table)


def with_tables(page: str) -> str:
    """Return the text of the page with all stored results."""
    for name in TABLES:
        page = replace_part(page, name, stored(name).as_markdown())
    run = open_run(_BOUNDS)
    page = replace_part(page, "bounds", _as_summary(run))
    page = replace_part(page, "all bounds", _as_table(run))
    page = replace_part(page, "faults", matrix.as_summary())
    return replace_part(page, "hard surfaces", hard.as_summary())


def _as_summary(run: Run) -> str:
    rows = []
    for case in run.cases:
        missed = [f"{target.what}: {target.measured}" for target in case.targets if not target.met]
        met = f"{len(case.targets) - len(missed)} of {len(case.targets)}"
        rows.append((case.name, case.title, met, "; ".join(missed) or "none"))
    table = Table("", ("case", "about", "bounds met", "missed"), rows).as_markdown()
    return f"{table}\nMeasured on {run.date[:10]} with {run.device.name}, {run.threads} threads.\n"


def _as_table(run: Run) -> str:
    rows = [
        (case.name, target.what, target.bound, target.measured)
        for case in run.cases
        for target in case.targets
    ]
    return Table("", ("case", "error", "bound", "measured"), rows).as_markdown()


def main() -> None:
    """Measure what is named, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"{', '.join(TABLES)} or bounds")
    for name in parser.parse_args().names:
        measure(name)
    PAGE.write_text(with_tables(PAGE.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
