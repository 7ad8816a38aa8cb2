"""``mirrorskin stitch``: one larger surface from several touches."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from mirrorskin.cli import options
from mirrorskin.cli.groups import Argument, Option
from mirrorskin.cli.stack import STACK


def command(
    results: Annotated[
        list[Path],
        Argument(metavar="RES.h5...", help="Results of touches that overlap; x and y are the first one's."),
    ],
    output: Annotated[
        Path, Option("--output", "-o", metavar="RES.h5", help="Result to write: HDF5, or NAME.zarr.")
    ],
    offset: Annotated[
        list[str] | None,
        Option(
            metavar="X,Y",
            help="Position of a field relative to the one before it, to a tenth of the field: 4mm,0mm; once"
            " for all, or once for each after the first. By default it is searched.",
        ),
    ] = None,
    overwrite: options.Overwrite = False,
    device: options.Device = None,
    as_json: options.Json = False,
    **chosen: Annotated[Any, STACK.only("pixel_size")],
) -> None:
    """Join several touches to one larger surface."""
    from mirrorskin import engine, io
    from mirrorskin.cli.output import save_and_report
    from mirrorskin.cli.quantity import vector

    io.check_result_output(output, *results, overwrite=overwrite)
    touches = [io.open_result(path) for path in results]
    offsets = [vector(text, 2, "--offset") for text in offset or ()]
    whole = engine.pose.stitch(
        touches,
        chosen.get("pixel_size"),
        offsets=offsets or None,
        names=[str(path) for path in results],
        device=device,
    )
    save_and_report(whole.result, output, device, as_json, overwrite=overwrite)
