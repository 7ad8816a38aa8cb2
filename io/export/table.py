"""CSV: columns with units, for spreadsheets and scripts."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping
from io import StringIO
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from mirrorskin.io.export.writing import write_new


def save_table(
    path: str | Path,
    columns: Mapping[str, NDArray[Any]],
    units: Mapping[str, str],
    notes: Mapping[str, str],
) -> None:
    """Write columns as comma-separated values; the file exists whole or not at all.

    Notes come first, in lines that begin with ``#``; then names with units, as in ``height [mm]``, then the
    rows. A cell without an answer is empty.

    Parameters
    ----------
    path : str or Path
    columns : mapping of ndarray, (n,)
        By name.
    units : mapping of str
        Of the columns that have one.
    notes : mapping of str
        By name; one line each.

    Raises
    ------
    InputError
        It cannot be written there.
    """
    text = StringIO(newline="")
    for name, said in notes.items():
        text.write(f"# {name}: {' '.join(said.split())}\n")
    table = csv.writer(text, lineterminator="\n")
    table.writerow([f"{name} [{units[name]}]" if units.get(name) else name for name in columns])
    table.writerows(zip(*(_cells(values) for values in columns.values()), strict=True))
    write_new(Path(path), [text.getvalue().encode()])


def _cells(values: NDArray[Any]) -> Iterator[str]:
    """Yield numbers with as many digits as float32 has, and nothing for NaN."""
    for value in values.tolist():
        yield "" if math.isnan(value) else f"{value:.9g}"
