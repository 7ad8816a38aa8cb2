"""The pages of the commands, from the command line itself."""

from __future__ import annotations

import functools
import html
import inspect
from collections.abc import Iterator
from typing import Any

import click

from mirrorskin.cli.main import app

_PROGRAM = "mirrorskin"
_SEE = {
    "batch": "batch.md",
    "calibrate": "calibration.md",
    "capture": "capture.md",
    "live": "live.md",
    "rig": "rig.md",
    "run": "operations.md",
    "simulate": "twin.md",
    "twin": "twin.md",
}
"""The pages that explain more than a command's help."""


@functools.cache
def pages() -> dict[str, str]:
    """Return a page for each command, by its name in the site; groups have theirs on one page."""
    whole: Any = app
    context = click.Context(whole, info_name=_PROGRAM)
    commands = {name: whole.get_command(context, name) for name in whole.list_commands(context)}
    rows = [f"| [`{_PROGRAM} {name}`]({name}.md) | {_first(command)} |" for name, command in commands.items()]
    index = [
        "# Commands\n",
        f"The output of `--help`. `{_PROGRAM} --debug` before a command shows tracebacks and log messages.\n",
        "| command | |\n|---|---|",
        *rows,
    ]
    by_name = {
        f"commands/{name}.md": "\n".join(_page(command, context, name, 1))
        for name, command in commands.items()
    }
    return {"commands/index.md": "\n".join(index), **by_name}


def uris() -> list[str]:
    """Return the names of the pages, the index first."""
    return list(pages())


def _first(command: Any) -> str:
    return _text(command).partition("\n")[0]


def _text(command: Any) -> str:
    return inspect.cleandoc(command.help or "").partition("\f")[0]


def _page(command: Any, above: Any, name: str, level: int) -> Iterator[str]:
    """Return the lines on a command, and on those below it."""
    context = click.Context(command, info_name=name, parent=above)
    yield f"{'#' * level} {context.command_path}\n"
    yield f"{_text(command)}\n"
    if level == 1 and name in _SEE:
        yield f"See [the guide](../{_SEE[name]}).\n"
    is_group = hasattr(command, "list_commands")
    if command.params or not is_group:  # some groups do something by themselves
        yield from _options(command, context)
    if is_group:
        for below in command.list_commands(context):
            yield from _page(command.get_command(context, below), context, below, level + 1)


def _options(command: Any, context: Any) -> Iterator[str]:
    """Return the lines on a command's usage, and on its arguments and options."""
    yield f"```text\n{' '.join([context.command_path, *command.collect_usage_pieces(context)])}\n```\n"
    yield "| | |\n|---|---|"
    for parameter in command.get_params(context):
        record = parameter.get_help_record(context)
        if record is not None:
            names, meaning = record
            yield f"| <code>{_cell(names).replace('&#124;', '&#124;<wbr>')}</code> | {_cell(meaning)} |"
    yield ""


def _cell(text: str) -> str:
    """Return text with the special characters of Markdown and HTML escaped."""
    escaped = html.escape(" ".join(text.split()))
    for sign in "|*_[`\\":
        escaped = escaped.replace(sign, f"&#{ord(sign)};")
    return escaped
