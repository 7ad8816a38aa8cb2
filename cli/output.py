"""What commands print: lines, tables, JSON, and a progress bar."""

from __future__ import annotations

import dataclasses
import json
import math
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mirrorskin.io.base import text

if TYPE_CHECKING:
    from mirrorskin.io import Recording, Result

_NO_GEL = "none: the calibration has no gel"
_ASCII = {"±": "+-", "µ": "u", "°": " deg", "²": "^2", "³": "^3", "\u2212": "-"}
_UNTOLD = "none: "  # begins the reason for a missing map in a process


def save_and_report(
    result: Result,
    path: Path,
    device: str | None,
    as_json: bool,
    must_answer: bool = True,
    overwrite: bool = False,
) -> None:
    """Write a result and print its summary; see `report_saved`."""
    from mirrorskin import io

    io.save_result(result, path, overwrite=overwrite)
    report_saved(result, path, device, as_json, must_answer)


def report_saved(
    result: Result, path: Path, device: str | None, as_json: bool, must_answer: bool = True
) -> None:
    """Print the summary of a result in a line, or with its process as JSON.

    Without an answer at any pixel, the command then ends with exit code 1 and the reason, if it
    ``must_answer``.
    """
    from mirrorskin.engine.base.summary import status_shares, summarise
    from mirrorskin.kernels.device import open_devices

    summary, pieces = summarise(result), _pieces(result)
    if as_json:
        devices = open_devices(device) if "device" in result.process else []
        profile = [record for opened in devices for record in opened.profile.records()]
        facts = {"summary": summary.as_dict() | pieces, "process": result.process}
        print_json({"output": str(path), **facts, "profile": profile})
    else:
        click.echo(printable(", ".join([f"{path}: {summary}", *_words(**pieces)])))
    if must_answer and summary.is_empty:
        shares = status_shares(result)
        raise click.ClickException(f"{path}: no {summary.what} at any pixel{shares and f': {shares}'}")


def _pieces(result: Result) -> dict[str, int]:
    """Count connected pieces, and those of unknown offset."""
    import numpy as np

    unknown = result.offset_unknown
    if unknown is None:
        return {}
    return {"components": unknown.size, "offset_unknown": int(np.count_nonzero(unknown))}


def _words(components: int = 1, offset_unknown: int = 0) -> Iterator[str]:
    """Yield remarks about connected pieces."""
    if components > 1:
        yield f"in {components} pieces"
    if offset_unknown:
        of = "" if offset_unknown == components else f" of {offset_unknown}"
        yield f"absolute height unknown{of}"


def make_folder(folder: Path, parents: bool = False) -> None:
    """Create a folder for output, unless it exists; with ``parents``, also those above it."""
    from mirrorskin.io import InputError

    try:
        folder.mkdir(parents=parents, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{folder}: the folder cannot be created: {error.strerror}. Choose another with -o"
        ) from None


def printable(value: object) -> str:
    """Return a text in the encoding of standard output, without characters that control terminals.

    Texts in files, and names of files, may hold any characters. What the encoding lacks is written in ASCII
    where that is usual, as in "+-" and "um", and as "?" otherwise.
    """
    encoding, words = getattr(sys.stdout, "encoding", None) or "utf-8", str(value)
    try:
        words.encode(encoding)
    except UnicodeEncodeError:
        for letter, ascii_text in _ASCII.items():
            words = words.replace(letter, ascii_text)
        words = words.encode(encoding, "replace").decode(encoding)
    return text.printable(words)


def print_json(value: Any) -> None:
    """Print a value as JSON; dataclasses become objects, and NaN and infinities null."""
    click.echo(json.dumps(_plain(value), indent=2))


def print_fields(fields: Mapping[str, object]) -> None:
    """Print names and values in two columns."""
    width = max(map(len, fields), default=0)
    for name, value in fields.items():
        click.echo(f"{printable(name):<{width}}  {printable(value)}")


def print_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print rows under their heads in aligned columns."""
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    for row in (head, *rows):
        cells = (f"{printable(cell):<{width}}" for cell, width in zip(row, widths, strict=True))
        click.echo("  ".join(cells).rstrip())


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return _plain(dataclasses.asdict(value))
    if isinstance(value, Mapping):
        return {name: _plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def report_missing_maps(name: str, process: Mapping[str, object], remedies: Mapping[str, str]) -> None:
    """Print which maps and forces are missing, why, and the remedy; and what was done about a gel."""
    for what, remedy in remedies.items():
        reason = str(process.get(what))
        if reason.startswith(_UNTOLD):
            reason = reason.removeprefix(_UNTOLD)
            click.echo(printable(f"{name}: no {what}: {reason}; give {remedy}"), err=True)
    gel = str(process.get("gel", ""))
    force = str(process.get("force", ""))
    if force.startswith(_UNTOLD):
        click.echo(printable(f"{name}: no force: {force.removeprefix(_UNTOLD)}"), err=True)
    if gel and gel != _NO_GEL:
        what = f"not corrected for the gel: {gel.removeprefix(_UNTOLD)}" if gel.startswith(_UNTOLD) else gel
        click.echo(printable(f"{name}: heights {what}"), err=True)


def make_strict(strict: bool) -> None:
    """Turn warnings of mirrorskin into errors, if requested."""
    if strict:
        from mirrorskin.io import MirrorskinWarning

        warnings.simplefilter("error", MirrorskinWarning)


def report_notes(name: str, process: Mapping[str, object]) -> None:
    """Print what else was found about the frames; warnings are printed when they occur."""
    if "notes" in process:
        from mirrorskin.io.base.findings import named

        click.echo(printable(named(name, str(process["notes"]))), err=True)


def report_unverified(recording: Recording) -> None:
    """Print that parts of frames cannot be compared with the checksums of whole frames."""
    from mirrorskin.io.base.checksums import UNVERIFIED_PARTS

    if UNVERIFIED_PARTS in recording.findings:
        click.echo(printable(f"{recording.name}: {UNVERIFIED_PARTS.text}"), err=True)


def report_contact(name: str, process: Mapping[str, object]) -> None:
    """Print a warning if the contact of a slide or a twist is wider than that of the skin."""
    widened = {
        "estimated": "the contact is estimated from the movement of the skin;"
        " give --contact, a press's result",
        "given, by light": "the contact given is where a press saw light, which runs ahead of the skin;"
        " reconstruct that press with the calibration of a gel and --modulus",
    }
    warning = widened.get(str(process.get("contact")))
    if warning is not None:
        click.echo(printable(f"{name}: {warning}"), err=True)


@contextmanager
def progress(what: str, total: int | None) -> Iterator[Callable[[int], None]]:
    """Show a progress bar on a terminal, none in a pipe; yields a function that takes how much is done.

    How much there is may be unknown.
    """
    if not sys.stderr.isatty():
        yield lambda count: None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=total)
        yield lambda count: bar.update(task, completed=count)
