"""What commands print."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from mirrorskin.io import Result


def save_and_tell(result: Result, path: Path, device: str | None, as_json: bool) -> None:
    """Write a result and say in a line what it holds, or in JSON how it came about as well."""
    from mirrorskin import engine, io
    from mirrorskin.kernels.device import open_device

    io.save_result(result, path)
    summary = engine.summarise(result)
    if as_json:
        profile = open_device(device).profile.records()
        print_json({"output": str(path), "summary": summary, "process": result.process, "profile": profile})
    else:
        typer.echo(f"{path}: {summary}")


def print_json(value: Any) -> None:
    """Print a value as JSON; dataclasses become objects, and what is no number null."""
    typer.echo(json.dumps(_plain(value), indent=2))


def print_fields(fields: Mapping[str, object]) -> None:
    """Print names and values in two columns."""
    width = max(map(len, fields), default=0)
    for name, value in fields.items():
        typer.echo(f"{name:<{width}}  {value}")


def print_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print rows under their heads, in columns as wide as they need."""
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    for row in (head, *rows):
        typer.echo("  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip())


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
