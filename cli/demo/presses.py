"""The paper's vertical experiments, section 3.2, from its idealisations to a real sensor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import click

from mirrorskin.cli.output import print_table

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from mirrorskin import hw, io
    from mirrorskin.hw.twin import Camera, ContactName, OpticsName


class Sensor(NamedTuple):
    """How true to life the twin is."""

    contact: ContactName
    optics: OpticsName

    @property
    def name(self) -> str:
        """Its name in the JSON."""
        return f"{self.contact}, {self.optics}"

    @property
    def title(self) -> str:
        """What to call it in tables and figures."""
        contact = "ideal contact" if self.contact == "conform" else "elastic body"
        return f"{contact}, {'ideal light' if self.optics == 'ideal' else 'lit wall'}"


PAPERS = Sensor("conform", "ideal")
SENSORS = (
    PAPERS,
    Sensor("conform", "cylinder"),
    Sensor("elastic", "ideal"),
    Sensor("elastic", "cylinder"),
)


@dataclass(frozen=True)
class Experiment:
    """One press of the paper, section 3.2, on several sensors."""

    name: str
    thing: str
    title: str
    size: int
    pixel_size: float
    frames: int
    step: float
    sensors: tuple[Sensor, ...] = SENSORS
    surface: bool = False
    detail: tuple[float, float] | None = None  # heights, mm, that are drawn on a scale of their own


EXPERIMENTS = (
    Experiment("fig5", "sphere", "Fig. 5: sphere, 10 mm, 30 x 0.1 mm", 240, 0.05, 30, 0.1, surface=True),
    Experiment(
        "fig6",
        "coin",
        "Fig. 6: 5 yen coin, 22 mm, 90 x 0.02 mm",
        640,
        0.041,
        90,
        0.02,
        SENSORS[:2],
        detail=(-0.3, 0.02),
    ),
    Experiment(
        "fig6-soft",
        "coin",
        "5 yen coin, 30 x 0.12 mm: an elastic body needs more depth",
        256,
        0.1025,
        30,
        0.12,
    ),
)
_HEAD = [
    "experiment",
    "contact, light",
    "method",
    "answered",
    "untouched",
    "RMS",
    "mean",
    "99 %",
    "shared",
    "cost",
]
_LEGEND = """\
Errors in mm. answered: pixels with a height over the object. untouched: pixels with a height where
nothing touches. shared: RMS error on the pixels that all sensors of an experiment answer. cost: by how
much that is above the paper's idealisations. ideal contact: the sheet takes the object's shape (eq. 1).
ideal light: it depends on the zenith alone."""

# Of a sensor and a method: the fields of a Score, pixels answered without contact, and the RMS error on
# the pixels that all sensors answer.
Outcome = dict[str, float]
Outcomes = dict[str, dict[str, Outcome]]


def lab_camera() -> Camera:
    """Return a camera with read and shot noise, deviations of the pixels, and a lens."""
    from mirrorskin.hw.twin import Camera

    return Camera(noise=1.0, electrons=40.0, gain_deviation=0.02, offset_deviation=0.5, point_spread=0.5)


def record(twin: hw.Twin, path: Path, doing: str, overwrite: bool) -> io.Truth:
    """Record all frames of a twin, with a bar that says what it is doing; return the truth."""
    from mirrorskin import io
    from mirrorskin.cli.output import progress

    with (
        io.Recorder(twin, path, truth=lambda: twin.truth, overwrite=overwrite) as recorder,
        progress(doing, twin.shape[0]) as show,
    ):
        recorder.drain(show)
    return twin.truth


def print_outcomes(outcomes: Mapping[str, Outcomes]) -> None:
    """Print the errors of all presses, and what the columns are."""
    print_table(_HEAD, [row for name, by_sensor in outcomes.items() for row in _rows(name, by_sensor)])
    click.echo(_LEGEND)


def run(experiment: Experiment, folder: Path, device: str | None, overwrite: bool = False) -> Outcomes:
    """Press on the object with each sensor, and draw what comes out; return outcomes by sensor and method."""
    import numpy as np

    from mirrorskin import view

    truths, results = {}, {}
    for sensor in experiment.sensors:
        base = folder / f"{experiment.name}-{sensor.contact}-{sensor.optics}"
        truths[sensor] = _record(experiment, sensor, base.with_suffix(".h5"), device, overwrite)
        results[sensor] = _reconstruct(base, sensor, device)
    best = {sensor.title: by_method["sub-frame"] for sensor, by_method in results.items()}
    path = (folder / experiment.name).with_suffix(".png")
    view.height_figure(
        best,
        truths[PAPERS],
        experiment.title,
        path,
        surface=experiment.surface,
        detail=experiment.detail,
    )
    shared = np.logical_and.reduce([np.isfinite(_height(result)) for result in best.values()])
    return {
        sensor.name: {method: _judge(result, truths[sensor], shared) for method, result in by_method.items()}
        for sensor, by_method in results.items()
    }


def _record(
    experiment: Experiment, sensor: Sensor, path: Path, device: str | None, overwrite: bool
) -> io.Truth:
    """Press with a camera as labs have it, and references taken with a ball."""
    from mirrorskin import hw, io
    from mirrorskin.hw.twin import Vertical

    twin = hw.Twin(
        object=experiment.thing,
        shape=(experiment.size, experiment.size),
        pixel_size=experiment.pixel_size,
        movement=Vertical(io.Steps(experiment.step, experiment.step).positions(experiment.frames)),
        contact=sensor.contact,
        optics=sensor.optics,
        camera=lab_camera(),
        references="ball",
        device=device,
    )
    return record(twin, path, f"pressing on the {experiment.thing} ({sensor.title})", overwrite)


def _reconstruct(base: Path, sensor: Sensor, device: str | None) -> dict[str, io.Result]:
    """Reconstruct from the recording; of the paper's own sensor by eq. 4 as well."""
    from mirrorskin import engine, io
    from mirrorskin.cli.output import progress

    methods = {"eq. 4": False, "sub-frame": True} if sensor == PAPERS else {"sub-frame": True}
    results = {}
    with io.open_recording(base.with_suffix(".h5")) as recording:
        for method, subframe in methods.items():
            with progress("reconstructing", recording.shape[0]) as show:
                results[method] = engine.reconstruct(
                    recording, subframe=subframe, device=device, progress=show
                )
    io.save_result(results["sub-frame"], base.with_name(f"{base.name}-result.h5"))
    return results


def _judge(result: io.Result, truth: io.Truth, shared: NDArray[np.bool_]) -> Outcome:
    import numpy as np

    from mirrorskin import engine

    height = _height(result)
    parts = height, np.where(shared, height, np.float32(np.nan))
    whole, shared_part = (engine.score(result.assign(height=part), truth).height for part in parts)
    assert whole is not None
    assert shared_part is not None
    return {
        **asdict(whole),
        "untouched": int(np.count_nonzero(np.isfinite(height) & (truth.contact == 0))),
        "shared_rms": shared_part.rms,
    }


def _height(result: io.Result) -> NDArray[np.float32]:
    """Return the measured heights; filled ones are in the table of surfaces."""
    import numpy as np

    height: NDArray[np.float32] | None = result.height
    assert height is not None
    return height if result.filled is None else np.where(result.filled, np.float32(np.nan), height)


def _rows(name: str, by_sensor: Outcomes) -> list[list[str]]:
    ideal = by_sensor[PAPERS.name]["sub-frame"]["shared_rms"]
    titles = {sensor.name: sensor.title for sensor in SENSORS}
    return [
        [name, titles[sensor], method, *_cells(outcome, ideal)]
        for sensor, methods in by_sensor.items()
        for method, outcome in methods.items()
    ]


def _cells(outcome: Outcome, ideal: float) -> list[str]:
    return [
        f"{outcome['answered']} px",
        f"{outcome['untouched']} px",
        f"{outcome['rms']:.3f}",
        f"{outcome['mean']:+.3f}",
        f"{outcome['p99']:.3f}",
        f"{outcome['shared_rms']:.3f}",
        f"{outcome['shared_rms'] - ideal:+.3f}",
    ]
