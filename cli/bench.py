"""``mirrorskin bench``: how fast, and how near the limit."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from mirrorskin.cli import options
from mirrorskin.cli.output import print_json, print_table

if TYPE_CHECKING:
    from mirrorskin.bench import Row


def command(
    quick: Annotated[bool, typer.Option("--quick", help="Small stacks, to see that it works.")] = False,
    device: options.Device = None,
    as_json: options.Json = False,
) -> None:
    """Time the kernels against the limit of memory."""
    import numpy as np

    from mirrorskin.bench import run_onset
    from mirrorskin.kernels.device import open_device

    opened = open_device(device)
    shape, rounds = ((16, 480, 640), 3) if quick else ((64, 1080, 1920), 9)
    cases = {
        f"{' x '.join(map(str, shape))} {dtype}": run_onset(opened, shape, np.dtype(dtype), rounds)
        for dtype in ("uint8", "uint16")
    }
    if as_json:
        told = {title: [_told(row, rows[0]) for row in rows] for title, rows in cases.items()}
        print_json({"device": opened.info, "cases": told})
        return
    typer.echo(opened.info.title)
    for title, rows in cases.items():
        typer.echo(f"\n{title}")
        head = ["work", "median", "quartiles", "bandwidth", "of the read limit"]
        print_table(head, [_cells(row, rows[0]) for row in rows])


def _told(row: Row, limit: Row) -> dict[str, object]:
    share = row.bandwidth / limit.bandwidth
    return {
        "name": row.name,
        "timing": row.timing,
        "bytes": row.bytes,
        "bandwidth": row.bandwidth,
        "share": share,
    }


def _cells(row: Row, limit: Row) -> list[str]:
    return [
        row.name,
        f"{1e3 * row.timing.median:.1f} ms",
        f"{1e3 * row.timing.lower:.1f} to {1e3 * row.timing.upper:.1f}",
        f"{row.bandwidth / 1e9:.2f} GB/s",
        f"{100 * row.bandwidth / limit.bandwidth:.0f} %",
    ]
