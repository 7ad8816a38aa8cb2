"""The command line: run in this process, which is quick, and the paper's experiments at a size that is."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import sys
from typing import NamedTuple
from unittest import mock

from mirrorskin.cli.demo import presses, rotation
from mirrorskin.cli.main import main

# Pixels across and down of what is small; the press and the rotation on the sphere are fused.
_SIZE, _SPHERE = 24, 48


class Ended(NamedTuple):
    """How a command ended: its exit code, and what it wrote to standard output and standard error."""

    code: int
    out: str
    said: str


def run(*words: object) -> Ended:
    """Run the command line with these words, in the working directory."""
    out, said = io.StringIO(), io.StringIO()
    given = mock.patch.object(sys, "argv", ["mirrorskin", *map(str, words)])
    with given, contextlib.redirect_stdout(out), contextlib.redirect_stderr(said):
        try:
            main()
        except SystemExit as ended:
            code = ended.code or 0
    return Ended(code, out.getvalue(), said.getvalue())


def small_experiments() -> tuple[presses.Experiment, ...]:
    """Return the demo's own experiments over the same fields and travels, of few pixels and frames."""
    frames = 8
    return tuple(
        dataclasses.replace(
            one,
            size=size,
            pixel_size=one.pixel_size * one.size / size,
            frames=frames,
            step=one.step * one.frames / frames,
        )
        for one in presses.EXPERIMENTS
        for size in [_SPHERE if one.thing == "sphere" else _SIZE]
    )


def small_rotations() -> tuple[rotation.Experiment, ...]:
    """Return the demo's own rotations over the same fields, of few pixels."""
    return tuple(
        dataclasses.replace(one, size=_SPHERE, pixel_size=one.pixel_size * one.size / _SPHERE)
        for one in rotation.EXPERIMENTS
    )


def main_with_a_small_demo() -> None:
    """Run the command line of a process, with `mirrorskin demo` small."""
    presses.EXPERIMENTS, rotation.EXPERIMENTS = small_experiments(), small_rotations()
    main()
