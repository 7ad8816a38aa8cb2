"""The sphere as a surface: from its normals, Fig. 10 (b) of the paper, and fused with the press."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from mirrorskin.cli.output import print_table

if TYPE_CHECKING:
    from mirrorskin import io
    from mirrorskin.engine.scoring import HeightScore

_PRESS, _ROTATION = "fig5-conform-ideal", "fig10a"
_HEAD = ["experiment", "heights from", "answered", "median", "RMS", "99 %", "filled", "RMS there", "apex"]
_LEGEND = """\
Errors in micrometres. answered: pixels that were measured. filled: pixels that were not, but lie inside;
they count in 'RMS there' and 'apex' alone. apex: error at the top of the sphere. A rotation does not
give absolute heights: its mean error is subtracted. registered: frames follow the object, by its true
heights; those of the fused surface follow the heights that it found."""
_MICROMETRES = 1e3  # in a millimetre


@dataclass(frozen=True, slots=True)
class Shape:
    """Errors of a surface."""

    measured: HeightScore
    filled: HeightScore | None  # of what was not measured, if there is any
    apex: float  # of the picture's middle, mm; NaN where there is no answer


Outcomes = Mapping[str, Mapping[str, Shape]]


def run(folder: Path, device: str | None) -> Outcomes:
    """Draw the heights of the folder's rotation, and fuse it with the folder's press."""
    from mirrorskin import io, view

    with io.open_recording(folder / f"{_ROTATION}.h5") as recording:
        truth = recording.truth
    assert truth is not None
    turned = {
        "rotation": io.open_result(folder / f"{_ROTATION}-exact-result.h5"),
        "rotation, registered": io.open_result(folder / f"{_ROTATION}-exact-registered-result.h5"),
    }
    fused = {
        "press": io.open_result(folder / f"{_PRESS}-result.h5"),
        "rotation": turned["rotation"],
        "press and rotation": _fuse(folder, device),
    }
    # The last is drawn as a whole: the one that needs no true heights.
    turned_back = dict(reversed(turned.items()))
    title = "Fig. 10 (b): sphere, 10 mm, integrated from its normals"
    view.surface_figure(turned_back, truth, title, folder / "fig10b.png")
    title = "Fig. 5 and Fig. 10 fused: sphere, 10 mm, from a press and a rotation"
    view.surface_figure(fused, truth, title, folder / "fused.png")
    del fused["rotation"]  # in the table already
    return {
        name: {way: _judge(result, truth) for way, result in by_way.items()}
        for name, by_way in (("fig10b", turned), ("fused", fused))
    }


def _fuse(folder: Path, device: str | None) -> io.Result:
    """Fuse the press and the rotation on the sphere, and keep the result."""
    from mirrorskin import io
    from mirrorskin.cli.output import progress
    from mirrorskin.engine.fusion import frames_to_read, fuse_sources

    with (
        io.open_recording(folder / f"{_PRESS}.h5") as vertical,
        io.open_recording(folder / f"{_ROTATION}.h5") as axial,
        progress("fusing", frames_to_read(vertical, axial, register=True)) as show,
    ):
        result = fuse_sources(vertical, axial, device=device, progress=show)
    io.save_result(result, folder / "fused-result.h5")
    return result


def _judge(result: io.Result, truth: io.Truth) -> Shape:
    import numpy as np

    from mirrorskin import engine

    score = engine.score(result, truth)
    assert score.height is not None
    assert result.height is not None
    middle = tuple(slice((size - 1) // 2, size // 2 + 1) for size in truth.height.shape)
    return Shape(score.height, score.filled, float(np.mean(result.height[middle] - truth.height[middle])))


def print_outcomes(outcomes: Outcomes) -> None:
    """Print the errors of all surfaces, and what the columns are."""
    print_table(
        _HEAD,
        [[name, way, *_cells(shape)] for name, by_way in outcomes.items() for way, shape in by_way.items()],
    )
    click.echo(_LEGEND)


def _cells(shape: Shape) -> list[str]:
    measured, filled = shape.measured, shape.filled
    return [
        f"{measured.answered} px",
        f"{_MICROMETRES * measured.median:.1f}",
        f"{_MICROMETRES * measured.rms:.1f}",
        f"{_MICROMETRES * measured.p99:.1f}",
        f"{filled.answered if filled else 0} px",
        f"{_MICROMETRES * filled.rms:.1f}" if filled else "-",
        "-" if math.isnan(shape.apex) else f"{_MICROMETRES * shape.apex:+.1f}",
    ]
