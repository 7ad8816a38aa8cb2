"""``mirrorskin demo``: the paper's experiments, on the digital twin."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from mirrorskin.cli import options
from mirrorskin.cli.output import print_json, print_table

if TYPE_CHECKING:
    from mirrorskin import engine, io
    from mirrorskin.hw.twin import ContactName, OpticsName


class _Sensor(NamedTuple):
    """How true to life the twin is."""

    contact: ContactName
    optics: OpticsName

    @property
    def name(self) -> str:
        """What to call it in tables and figures."""
        return f"{self.contact}, {self.optics}"


_PAPERS = _Sensor("conform", "ideal")
_SENSORS = (
    _PAPERS,
    _Sensor("conform", "cylinder"),
    _Sensor("elastic", "ideal"),
    _Sensor("elastic", "cylinder"),
)


@dataclass(frozen=True)
class _Experiment:
    """One press of the paper, section 3.2, on several sensors."""

    name: str
    thing: str
    title: str
    size: int
    pixel_size: float
    frames: int
    step: float
    sensors: tuple[_Sensor, ...] = _SENSORS
    surface: bool = False


_EXPERIMENTS = (
    _Experiment("fig5", "sphere", "Fig. 5: sphere, 10 mm, 30 x 0.1 mm", 240, 0.05, 30, 0.1, surface=True),
    _Experiment(
        "fig6", "coin", "Fig. 6: 5 yen coin, 22 mm, 90 x 0.02 mm", 640, 0.041, 90, 0.02, _SENSORS[:2]
    ),
    _Experiment("fig6-soft", "coin", "5 yen coin, 22 mm, 30 x 0.12 mm", 256, 0.1025, 30, 0.12),
)
_HEAD = [
    "experiment",
    "contact, optics",
    "method",
    "answered",
    "RMS error",
    "mean error",
    "99 % within",
    "cost",
]


def command(
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="Folder for all files.")
    ] = Path("demo"),
    device: options.Device = None,
    as_json: options.Json = False,
) -> None:
    """Repeat the paper's vertical experiments on the twin, from its idealisations to a real sensor."""
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
    print_table(_HEAD, [row for name, by_sensor in scores.items() for row in _rows(name, by_sensor)])
    typer.echo("cost: RMS error beyond that of the paper's idealisations, conform and ideal")
    typer.echo(f"recordings, results and figures are in {output}: look at {output / 'fig5.png'}")


_Scores = dict[str, dict[str, "engine.Score"]]


def _run(experiment: _Experiment, folder: Path, device: str | None) -> _Scores:
    """Press on the object with each sensor, and draw what comes out; return scores by sensor and method."""
    from mirrorskin import view

    scores: _Scores = {}
    results: dict[str, io.Result] = {}
    for sensor in experiment.sensors:
        base = folder / f"{experiment.name}-{sensor.contact}-{sensor.optics}"
        truth = _record(experiment, sensor, base.with_suffix(".h5"), device)
        results[sensor.name], scores[sensor.name] = _reconstruct(base, sensor, device)
    path = (folder / experiment.name).with_suffix(".png")
    view.height_figure(results, truth, experiment.title, path, surface=experiment.surface)
    return scores


def _record(experiment: _Experiment, sensor: _Sensor, path: Path, device: str | None) -> io.Truth:
    """Press with a camera as labs have it: read and shot noise, deviations of the pixels, a lens."""
    from mirrorskin import hw, io
    from mirrorskin.cli.progress import progress
    from mirrorskin.hw.twin import Camera, Vertical

    twin = hw.Twin(
        object=experiment.thing,
        shape=(experiment.size, experiment.size),
        pixel_size=experiment.pixel_size,
        movement=Vertical(io.Steps(experiment.step, experiment.step).positions(experiment.frames)),
        contact=sensor.contact,
        optics=sensor.optics,
        camera=Camera(noise=1.0, electrons=40.0, gain_deviation=0.02, offset_deviation=0.5, point_spread=0.5),
        references="ball",
        device=device,
    )
    with (
        io.Recorder(twin, path, truth=twin.truth) as recorder,
        progress(f"pressing on the {experiment.thing} ({sensor.name})", experiment.frames) as show,
    ):
        recorder.drain(show)
    return twin.truth


def _reconstruct(
    base: Path, sensor: _Sensor, device: str | None
) -> tuple[io.Result, dict[str, engine.Score]]:
    """Reconstruct from the recording; of the paper's own sensor by eq. 4 as well."""
    from mirrorskin import engine, io
    from mirrorskin.cli.progress import progress

    methods = {"eq. 4": False, "sub-frame": True} if sensor == _PAPERS else {"sub-frame": True}
    scores = {}
    with io.open_recording(base.with_suffix(".h5")) as recording:
        assert recording.truth is not None
        for method, subframe in methods.items():
            recording.rewind()
            with progress("reconstructing", recording.shape[0]) as show:
                result = engine.reconstruct(recording, subframe=subframe, device=device, progress=show)
            scores[method] = engine.score(result, recording.truth)
    io.save_result(result, base.with_name(f"{base.name}-result.h5"))
    return result, scores


def _rows(name: str, by_sensor: _Scores) -> list[list[str]]:
    ideal = by_sensor[_PAPERS.name]["sub-frame"].rms
    return [
        [name, sensor, method, *_cells(score, ideal)]
        for sensor, methods in by_sensor.items()
        for method, score in methods.items()
    ]


def _cells(score: engine.Score, ideal: float) -> list[str]:
    return [
        f"{score.answered} px",
        f"{score.rms:.3f} mm",
        f"{score.mean:+.3f} mm",
        f"{score.p99:.3f} mm",
        f"{math.sqrt(max(0.0, score.rms**2 - ideal**2)):.3f} mm",
    ]
