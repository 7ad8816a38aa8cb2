"""``mirrorskin bench``: how fast, and how near the limit."""

from __future__ import annotations

from typing import Annotated

import typer

from mirrorskin.cli import options
from mirrorskin.cli.output import print_json, print_table


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
        print_json({"device": opened.info, "cases": cases})
        return
    typer.echo(opened.info.title)
    for title, rows in cases.items():
        limit = rows[0].bandwidth
        typer.echo(f"\n{title}")
        print_table(
            ["work", "median", "quartiles", "bandwidth", "of the read limit"],
            [
                [
                    row.name,
                    f"{1e3 * row.timing.median:.1f} ms",
                    f"{1e3 * row.timing.lower:.1f} to {1e3 * row.timing.upper:.1f}",
                    f"{row.bandwidth / 1e9:.2f} GB/s",
                    f"{100 * row.bandwidth / limit:.0f} %",
                ]
                for row in rows
            ],
        )
