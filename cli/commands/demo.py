"""``mirrorskin demo``: the figures of the paper, from experiments on the digital twin."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from mirrorskin.cli import options
from mirrorskin.cli.commands.simulate import make_twin, preset, record
from mirrorskin.cli.groups import Option
from mirrorskin.cli.output import make_folder, print_json, print_table, printable, progress

if TYPE_CHECKING:
    from mirrorskin import io
    from mirrorskin.engine.metrology.scoring import Score

Results = dict[str, "io.Result"]
Scores = dict[str, "Score"]
Draw = Callable[..., None]


@dataclass(frozen=True)
class Press:
    """A press of the paper's section 3.2, and how it is drawn."""

    title: str
    line: str  # motion and options of 'simulate'
    surface: bool = False  # drawn in space as well
    detail: tuple[float, float] | None = None  # heights, mm, that have a colour scale of their own


# The paper's ideal sensor; its camera has noise, uneven pixels and a lens.
_CAMERA = "--noise 1 --electrons 40 --gain-deviation 0.02 --offset-deviation 0.5 --point-spread 0.5"
PRESSES = {
    "fig5": Press(
        "Fig. 5: ball, 10 mm in diameter, pressed in 30 steps of 0.1 mm",
        f"vertical {_CAMERA} --size 240x240 --pixel-size 0.05mm --frames 30 --travel-step 0.1mm"
        " --travel-start 0.1mm",
        surface=True,
    ),
    "fig6": Press(
        "Fig. 6: 5 yen coin, 22 mm in diameter, pressed in 90 steps of 0.02 mm",
        f"vertical {_CAMERA} --object coin --size 640x640 --pixel-size 0.041mm --frames 90"
        " --travel-step 0.02mm --travel-start 0.02mm",
        detail=(-0.3, 0.0),
    ),
}
LABELS = {
    "sub-frame": "onset between frames",
    "eq. 4": "first bright frame (eq. 4)",
    "paper": "paper's method",
    "exact": "maximum likelihood",
    "exact, registered": "as b, frames registered",
    "rotation, registered": "rotation (frames registered)",
}
"""Names in figures of methods whose names in tables are short."""
_HEIGHTS_TITLE = "Fig. 10 (b): ball, 10 mm in diameter, integrated from the normals of a rotation"
_FUSED_TITLE = "Fig. 5 and Fig. 10 fused: ball, 10 mm in diameter, from a press and a rotation"
_TURN_TITLE = "Fig. 10 (a): normals of a ball, 10 mm in diameter, from 8 frames of a turn at a tilt of 2.5°"
TURN = (
    f"axial {_CAMERA} --size 240x240 --pixel-size 0.05mm --pattern linear --references exact"
    " --frames 8 --press 1.5mm --tilt 2.5deg"
)
_TOUCH_TITLE = "Touch: ball, 10 mm in diameter, until 95 % of the pixels have a standard deviation of 1 µm"
_TOUCH: dict[str, Any] = {"shape": (96, 128), "pixel_size": 0.03, "pattern": "linear", "rate": 20.0}
_TOUCH_SIGMA, _TOUCH_DEEPEST, _TOUCH_START = 0.001, 0.6, -1.0  # mm
_TURN, _FUSED_PRESS = "fig10a", "fig5"
# The method of the normals, and whether the frames are registered with the true heights.
_METHODS = {"paper": ("paper", False), "exact": ("exact", False), "exact, registered": ("exact", True)}
_STEPS = len(PRESSES) + 3

_HEIGHTS = ["figure", "method", "answered", "RMS", "mean", "99 %", "filled", "RMS of filled"]
_HEIGHTS_LEGEND = """\
Errors of heights in micrometres. answered: measured pixels whose true height is known. filled: pixels
without a measurement that are surrounded by measured ones; only 'RMS of filled' includes them. A rotation
gives relative heights: their mean error is subtracted. registered: the frames follow the object, by its
true heights; the fused surface is registered with the heights that it found."""
_NORMALS = [
    "figure",
    "method",
    "answered",
    "median",
    "RMS",
    "99 %",
    "chi2",
    "lost and flagged",
    "wrongly flagged",
]
_NORMALS_LEGEND = """\
Angles between normals and truth in degrees. answered: share of the pixels in contact in every frame that
have an answer and are marked as in contact. chi2: mean of (error / predicted error)^2. The dark end of the
linear pattern hides zeniths below 13 degrees, its bright end those above 43."""
_MICROMETRES = 1e3  # in a millimetre


def command(
    output: Annotated[Path, Option("--output", "-o", metavar="DIR", help="Folder for all files.")] = Path(
        "demo"
    ),
    overwrite: Annotated[
        bool, Option("--overwrite", help="Replace recordings and results of an earlier demo in that folder.")
    ] = False,
    device: options.Device = None,
    as_json: options.Json = False,
) -> None:
    """Draw the figures of the paper from experiments on the twin."""
    from mirrorskin import view

    view.check_drawing()
    make_folder(output, parents=True)
    scores: dict[str, Scores] = {}
    with _drawing() as draw:
        for number, (name, press) in enumerate(PRESSES.items(), 1):
            _announce(f"{number} of {_STEPS}: {press.title}")
            scores[name] = _press(name, press, output, device, overwrite, draw)
        _announce(f"{_STEPS - 2} of {_STEPS}: {_TURN_TITLE}")
        truth, results = _turn(output, device, overwrite, draw)
        scores[_TURN] = _judge(results, truth)
        _announce(f"{_STEPS - 1} of {_STEPS}: {_FUSED_TITLE}")
        scores |= _surfaces(results, truth, output, device, overwrite, draw)
        _announce(f"{_STEPS} of {_STEPS}: {_TOUCH_TITLE}")
        scores["touch"] = _touch(output, device, overwrite, draw)
    if as_json:
        print_json(scores)
        return
    _print_heights({figure: by_method for figure, by_method in scores.items() if figure != _TURN})
    click.echo()
    _print_normals(scores[_TURN])
    click.echo(f"recordings, results and figures are in {output}: look at {output / 'fig5.png'}")


def _announce(step: str) -> None:
    click.echo(printable(step), err=True)


def _named(results: Results) -> Results:
    """Return results by their names in figures."""
    return {LABELS.get(name, name): result for name, result in results.items()}


@contextmanager
def _drawing() -> Iterator[Draw]:
    """Draw figures in a thread, while kernels of the next experiment are compiled and run."""
    with warnings.catch_warnings(), ThreadPoolExecutor(max_workers=1) as thread:
        # Set here because threads share the filters: a thread that restores them removes those of another.
        warnings.filterwarnings("ignore", "Non-empty compiler output")
        figures = {}

        def draw(
            draw_figure: Draw, results: Results, truth: io.Truth, title: str, path: Path, **style: Any
        ) -> None:
            figures[path] = thread.submit(draw_figure, _named(results), truth, title, path, **style)

        yield draw
        for path, figure in figures.items():
            _announce(f"  drawing {path.name}")
            figure.result()


def _press(name: str, press: Press, folder: Path, device: str | None, overwrite: bool, draw: Draw) -> Scores:
    """Press on the object, reconstruct with sub-frame onsets and by eq. 4, and draw both."""
    from mirrorskin import engine, io, view

    path = folder / f"{name}.h5"
    truth = _record(press.line, path, device, overwrite)
    results: Results = {}
    with io.open_recording(path) as recording:
        assert recording.travel is not None
        first_travel = float(recording.travel[0])
        for method, subframe in (("sub-frame", True), ("eq. 4", False)):
            _announce(f"  reconstructing heights: {LABELS[method]}")
            with progress("reconstructing", recording.shape[0]) as show:
                results[method] = engine.reconstruct(
                    recording, subframe=subframe, device=device, progress=show
                )
    io.save_result(results["sub-frame"], folder / f"{name}-result.h5", overwrite=overwrite)
    figure = folder / f"{name}.png"
    draw(
        view.height_figure,
        *(results, truth, press.title, figure),
        surface=press.surface,
        detail=press.detail,
        first_travel=first_travel,
    )
    return _judge(results, truth)


def _turn(folder: Path, device: str | None, overwrite: bool, draw: Draw) -> tuple[io.Truth, Results]:
    """Turn about the centre of the sheet, and draw the normals by each method."""
    from mirrorskin import engine, io, view

    path = folder / f"{_TURN}.h5"
    truth = _record(TURN, path, device, overwrite)
    results: Results = {}
    with io.open_recording(path) as recording:
        for name, (method, registered) in _METHODS.items():
            _announce(f"  reconstructing normals: {name}")
            heights = truth.height if registered else None
            results[name] = engine.reconstruct(recording, method=method, heights=heights, device=device)
            target = folder / f"{_TURN}-{name.replace(', ', '-')}-result.h5"
            io.save_result(results[name], target, overwrite=overwrite)
    draw(view.normal_figure, results, truth, _TURN_TITLE, path.with_suffix(".png"))
    return truth, results


def _surfaces(
    turned: Results, truth: io.Truth, folder: Path, device: str | None, overwrite: bool, draw: Draw
) -> dict[str, Scores]:
    """Draw the heights of the rotation, and those of the press and the rotation fused."""
    from mirrorskin import io, view

    rotation = {"rotation, registered": turned["exact, registered"], "rotation": turned["exact"]}
    draw(view.surface_figure, rotation, truth, _HEIGHTS_TITLE, folder / "fig10b.png")
    fused = {
        "press": io.open_result(folder / f"{_FUSED_PRESS}-result.h5"),
        "rotation": turned["exact"],
        "press and rotation": _fuse(folder, device, overwrite),
    }
    draw(view.surface_figure, fused, truth, _FUSED_TITLE, folder / "fused.png")
    judged = {name: result for name, result in fused.items() if name != "rotation"}  # that is in fig10b
    return {"fig10b": _judge(rotation, truth), "fused": _judge(judged, truth)}


def _fuse(folder: Path, device: str | None, overwrite: bool) -> io.Result:
    """Fuse the recordings of the press and of the rotation, and save the result."""
    from mirrorskin import engine, io
    from mirrorskin.engine.fusion.fusion import frames_to_read

    _announce("  fusing the press and the rotation")
    with (
        io.open_recording(folder / f"{_FUSED_PRESS}.h5") as vertical,
        io.open_recording(folder / f"{_TURN}.h5") as axial,
        progress("fusing", frames_to_read(vertical, axial, register=True)) as show,
    ):
        result = engine.fuse(vertical, axial, device=device, progress=show)
    io.save_result(result, folder / "fused-result.h5", overwrite=overwrite)
    return result


def _touch(folder: Path, device: str | None, overwrite: bool, draw: Draw) -> Scores:
    """Touch a ball on the emulated rig, on simulated time, and draw its surface and that of the press."""
    import numpy as np

    from mirrorskin import engine, io, view
    from mirrorskin.engine.fusion.solver import is_relative
    from mirrorskin.hw.rig.rig import Rig
    from mirrorskin.hw.rig.touch import RigTouch
    from mirrorskin.twin import Axial
    from mirrorskin.twin.emulator.rig import EmulatedRig
    from mirrorskin.twin.emulator.simulated_clock import SimulatedClock

    clock = SimulatedClock()
    with EmulatedRig("sphere", clock=clock, **_TOUCH) as emulated:
        settings = emulated.settings
        with (
            Rig(emulated.open_stage(settings.stage), emulated.camera, settings, clock) as rig,
            RigTouch(rig, _TOUCH_DEEPEST, _TOUCH_START) as sensor,
        ):
            outcome = engine.live.touch(sensor, _TOUCH_SIGMA, device=device)
        header, phase = outcome.turn.header, outcome.turn.phase
        assert header.tilt is not None
        assert header.press is not None
        assert phase is not None
        truth = emulated.twin(Axial(phase, header.tilt, header.press)).truth
    _announce(f"  {outcome}")
    io.save_touch(folder / "touch.h5", outcome.press, outcome.turn, overwrite=overwrite)
    io.save_result(outcome.result, folder / "touch-result.h5", overwrite=overwrite)
    with io.open_recording(folder / "touch.h5") as press:
        pressed = engine.reconstruct(press, method="change-point", fill=False, device=device)
    result = outcome.result
    # What a touch counts: beyond the normals only the press has heights, and some parts have no offset.
    counted = (np.isfinite(result.normals[..., 0]) & ~is_relative(result)) | (result.filled > 0)
    touched = result.assign(
        height=np.where(counted, result.height, np.float32(np.nan)),
        offset_unknown=np.zeros_like(result.offset_unknown),
    )
    results = {"press": pressed, "touch": touched}
    draw(view.surface_figure, results, truth, _TOUCH_TITLE, folder / "touch.png")
    return _judge(results, truth)


def _record(line: str, path: Path, device: str | None, overwrite: bool) -> io.Truth:
    """Record a preset; return the truth."""
    _announce(f"  simulating the sensor: {path.name}")
    motion, values = preset(line)
    twin = make_twin(motion, values, device=device)
    record(twin, path, overwrite)
    return twin.truth


def _judge(results: Results, truth: io.Truth) -> Scores:
    from mirrorskin import engine

    return {name: engine.score(result, truth) for name, result in results.items()}


def _print_heights(scores: Mapping[str, Scores]) -> None:
    """Print the errors of all heights, and explain the columns."""
    rows = [
        [figure, method, *_height_cells(score)]
        for figure, by_method in scores.items()
        for method, score in by_method.items()
    ]
    print_table(_HEIGHTS, rows)
    click.echo(_HEIGHTS_LEGEND)


def _height_cells(score: Score) -> list[str]:
    measured, filled = score.height, score.filled
    assert measured is not None
    return [
        f"{measured.answered} px",
        f"{_MICROMETRES * measured.rms:.1f}",
        f"{_MICROMETRES * measured.mean:+.1f}",
        f"{_MICROMETRES * measured.p99:.1f}",
        f"{filled.answered if filled else 0} px",
        f"{_MICROMETRES * filled.rms:.1f}" if filled else "-",
    ]


def _print_normals(scores: Scores) -> None:
    """Print the errors of all normals, and explain the columns."""
    print_table(_NORMALS, [[_TURN, method, *_normal_cells(score)] for method, score in scores.items()])
    click.echo(_NORMALS_LEGEND)


def _normal_cells(score: Score) -> list[str]:
    normal, contact = score.normal, score.contact
    assert normal is not None
    flags = ["-", "-"]
    if contact is not None:
        flags = [f"{100 * contact.lost_flagged:.1f} %", f"{100 * contact.wrongly_flagged:.1f} %"]
    return [
        f"{100 * normal.coverage:.1f} %",
        f"{normal.median:.2f}",
        f"{normal.rms:.2f}",
        f"{normal.p99:.2f}",
        f"{normal.chi_square:.2f}",
        *flags,
    ]
