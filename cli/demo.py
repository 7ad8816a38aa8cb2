"""``mirrorskin demo``: the paper's experiments, on the digital twin."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mirrorskin.cli import options
from mirrorskin.cli.output import print_json, print_table

if TYPE_CHECKING:
    from mirrorskin import engine


@dataclass(frozen=True)
class _Experiment:
    """One press of the paper, section 3.2."""

    name: str
    title: str
    size: int
    pixel_size: float
    frames: int
    step: float


_EXPERIMENTS = (
    _Experiment("sphere", "Sphere, 10 mm, lowered 30 x 0.1 mm (Fig. 5)", 480, 0.025, 30, 0.1),
    _Experiment("coin", "5 yen coin, 22 mm, lowered 90 x 0.02 mm (Fig. 6)", 640, 0.041, 90, 0.02),
)
_METHODS = {"eq. 4": False, "sub-frame": True}


def command(
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="Folder for all files.")
    ] = Path("demo"),
    device: options.Device = None,
    as_json: options.Json = False,
) -> None:
    """Repeat the paper's vertical experiments on the twin."""
    from mirrorskin import io, view

    view.check_drawing()
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise io.InputError(
            f"{output} cannot be made: {error.strerror}; choose another folder with -o"
        ) from error
    scores = {experiment.name: _run(experiment, output, device) for experiment in _EXPERIMENTS}
    if as_json:
        print_json(scores)
        return
    rows = [
        [name, method, *_cells(score)]
        for name, methods in scores.items()
        for method, score in methods.items()
    ]
    print_table(["object", "method", "answered", "RMS error", "mean error", "99 % within"], rows)
    typer.echo(f"recordings, results and figures are in {output}: look at {output / 'sphere.png'}")


def _run(experiment: _Experiment, folder: Path, device: str | None) -> dict[str, engine.Score]:
    """Press, record, reconstruct from the recording, draw; return the scores by method."""
    from mirrorskin import engine, hw, io, view
    from mirrorskin.cli.progress import progress

    base = folder / experiment.name
    twin = hw.Twin(
        object=experiment.name,
        shape=(experiment.size, experiment.size),
        pixel_size=experiment.pixel_size,
        travel=io.Steps(experiment.step, experiment.step).positions(experiment.frames),
    )
    with (
        io.Recorder(twin, base.with_suffix(".h5"), truth=twin.truth) as recorder,
        progress(f"pressing on the {experiment.name}", experiment.frames) as show,
    ):
        recorder.drain(show)
    scores = {}
    with io.open_recording(base.with_suffix(".h5")) as recording:
        for method, subframe in _METHODS.items():
            recording.rewind()
            with progress("reconstructing", experiment.frames) as show:
                result = engine.reconstruct(recording, subframe=subframe, device=device, progress=show)
            scores[method] = engine.score(result, twin.truth)
    io.save_result(result, base.with_name(f"{experiment.name}-result.h5"))
    view.height_figure(result, twin.truth, experiment.title, base.with_suffix(".png"))
    return scores


def _cells(score: engine.Score) -> list[str]:
    return [
        f"{score.answered} px",
        f"{score.rms:.4f} mm",
        f"{score.mean:+.4f} mm",
        f"{score.p99:.4f} mm",
    ]
