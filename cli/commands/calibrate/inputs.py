"""Common parts of the commands that calibrate: recordings, the file, the report."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import click

from mirrorskin.cli import scans
from mirrorskin.cli.groups import Option
from mirrorskin.cli.stack import stack_options

if TYPE_CHECKING:
    from mirrorskin.cli.stack import StackOptions
    from mirrorskin.hw.rig.plans import AxialPlan, Plan, VerticalPlan
    from mirrorskin.hw.rig.scan import PlannedScan
    from mirrorskin.io import Calibration, CameraId, Recording, Source
    from mirrorskin.io.base.types import ProcessValue
    from mirrorskin.io.model.parameters import Part

TILT, _PHASE_STEP = "2.5deg", "45deg"
BALL = "put the ball at place {} of {}, all over the field"
_BLOCK = 16  # frames that are read at a time, at most
_STILL = 0.05  # mm: movement of the body "at rest", because a press has at least two steps

OptionalRig = Annotated[
    Path | None,
    Option("--rig", metavar="RIG.toml", help="Capture the recordings first, with this rig."),
]
Overwrite = Annotated[
    bool, Option("--overwrite", help="With --rig: replace existing recordings of these names.")
]
Settle = Annotated[
    str | None,
    Option(metavar="TIME", help="With --rig: time from rest to the first exposure.", show_default="100ms"),
]
Places = Annotated[int, Option(min=1, help="With --rig: number of places of the ball.")]


def press_option(example: str) -> Any:
    """Return the option for the travel of a press on a rig."""
    return Option(metavar="LENGTH", help=f"With --rig: how far the body is lowered: {example}.")


def check_call(
    output: Path,
    presses: Sequence[Path],
    rig: Path | None,
    plates: Sequence[Path] = (),
    **options: str | bool | None,
) -> Calibration | None:
    """Check inputs and output, and return the calibration to which a part is added.

    Presses are either named or captured on a rig; ``options`` need a rig.
    """
    from mirrorskin import io

    if rig is None and not (presses or plates):
        raise io.InputError("no recordings: name those of a ball, or capture them with --rig RIG.toml")
    if rig is not None and presses:
        raise io.InputError("recordings and --rig both give the presses: leave one of them out")
    for name, value in options.items():
        if rig is None and value not in (None, False):
            raise io.InputError(f"--{name} applies to presses on a rig: add --rig, or remove it")
    io.check_output(output, *presses, *plates, rig, replaces="calibration")
    return io.open_calibration(output) if output.exists() else None


@contextmanager
def open_all(
    paths: Sequence[Path],
    options: StackOptions,
    calibration: Calibration | None,
    output: Path,
    with_turns: bool = False,
) -> Iterator[tuple[list[Source], CameraId]]:
    """Open recordings with the pixel size of the calibration's scale, and return them and their camera.

    With ``with_turns``, the recording of a touch is two: its press, and then its turn.
    """
    from mirrorskin import io
    from mirrorskin.io.files.touch_file import TURN, has_turn

    options = _scaled(options, calibration)
    with ExitStack() as opening:
        sources = []
        for path in paths:
            sources.append(opening.enter_context(io.open_recording(path, **options)))
            if with_turns and has_turn(path):
                turn = io.open_recording(path, **(options | {"dataset": TURN}))
                sources.append(opening.enter_context(turn))
        yield [*sources], _one_camera(sources, calibration, output)


def _scaled(options: StackOptions, calibration: Calibration | None) -> StackOptions:
    """Return the options with the pixel size of the calibration's scale; another one is refused."""
    from mirrorskin.io import InputError
    from mirrorskin.io.model.calibrated import differ

    if calibration is None or calibration.lens is None:
        return options
    size = calibration.lens.pixel_size
    option = options.get("pixel_size", size)
    if differ(option, size):
        raise InputError(
            f"--pixel-size {option[0]:.5g} mm: the scale of {calibration.name} is {size[0]:.5g} mm;"
            " remove the option"
        )
    return options | {"pixel_size": size}


def open_still(path: Path, **stack: Any) -> Recording:
    """Open frames at rest; those of other programs have no positions, and need none here."""
    from mirrorskin import io
    from mirrorskin.io.formats.registry import is_of_others

    if is_of_others(path):
        return io.open_recording(path, motion="vertical", travel=io.Steps(1.0), **stack)
    return io.open_recording(path, **stack)


def camera_name(names: Sequence[str]) -> str:
    """Return the name of the only camera of recordings; an empty name is unknown."""
    from mirrorskin.io import InputError

    cameras = set(names) - {""}
    if len(cameras) > 1:
        raise InputError(f"the recordings are of {' and '.join(sorted(cameras))}: take all with one camera")
    return "".join(cameras)


def _one_camera(sources: Sequence[Source], calibration: Calibration | None, output: Path) -> CameraId:
    """Return the common camera of all recordings; a calibration must be of it too."""
    from mirrorskin import io
    from mirrorskin.io.model.calibrated import check_camera

    name = camera_name([source.header.camera for source in sources])
    cameras = [io.CameraId(source.header.camera, source.shape[1:], source.dtype) for source in sources]
    first = cameras[0]
    for source, camera in zip(sources, cameras, strict=True):
        if (camera.shape, camera.dtype) != (first.shape, first.dtype):
            raise io.InputError(
                f"{source.name} is of {camera}, {sources[0].name} of {first}: take all with one camera"
            )
    camera = io.CameraId(name, first.shape, first.dtype)
    if calibration is not None:
        check_camera(calibration, camera, sources[0].name, f"name another file than {output} with -o")
    return camera


def process_of(source: Source | None = None, **facts: ProcessValue | list[Path]) -> dict[str, ProcessValue]:
    """Return the provenance of a part: program, date, facts, and the pixel size of a source."""
    from mirrorskin.engine.base.provenance import signature
    from mirrorskin.io.model.calibrated import size_facts

    size = None if source is None else source.header.pixel_size
    texts = {
        name: ", ".join(map(str, value)) if isinstance(value, list) else value
        for name, value in facts.items()
    }
    return {**signature(), **texts, **({} if size is None else size_facts(size))}


class Capture(NamedTuple):
    """Settings of a capture, if a rig is given."""

    rig: Path | None = None
    places: Callable[[], list[Place]] = list  # called with a rig only; may remove options of the stack
    settle: str | None = None
    overwrite: bool = False
    # raises what rules out the fit, for a recording that is still to be captured
    check: Callable[[Source, Calibration | None], None] = lambda planned, calibration: None


class Learned(NamedTuple):
    """A part of a calibration, and the report about it."""

    part: Part
    facts: Mapping[str, ProcessValue | list[Path]]  # provenance
    numbers: Mapping[str, Any]  # printed with --json
    line: str  # printed otherwise
    notes: Sequence[str] = ()  # printed to standard error
    also: Sequence[Part] = ()  # other parts, with the same provenance


def learn(
    output: Path,
    presses: Sequence[Path],
    fit: Callable[[list[Source], Calibration | None, list[Path]], Learned],
    stack: dict[str, Any],
    as_json: bool,
    capture: Capture | None = None,
    plates: Sequence[Path] = (),
    with_turns: bool = False,
    **options: str | None,
) -> None:
    """Fit a part to recordings, add it to a calibration, and report it.

    Presses are named or captured with a rig, which ``options`` need; plates are always named. ``fit`` gets
    all recordings, open, and the paths of the presses, which come first. ``stack`` describes the recordings.
    ``with_turns``: the recording of a touch is a press, and then a turn.
    """
    capture = capture or Capture()
    needs_rig = options | {"settle": capture.settle, "overwrite": capture.overwrite}
    calibration = check_call(output, presses, capture.rig, plates, **needs_rig)
    paths = list(presses)
    places = [] if capture.rig is None else capture.places()
    opening = stack_options(stack)
    if capture.rig is not None:
        size = _scaled(opening, calibration).get("pixel_size")

        def check(planned: PlannedScan) -> None:
            if size is not None:
                planned.header = replace(planned.header, pixel_size=size)
            capture.check(planned, calibration)

        places = [place._replace(check=check) for place in places]
        if plates:
            with open_all(plates, opening, calibration, output):
                pass  # refused before anything moves
        paths = take(capture.rig, output, places, capture.settle, capture.overwrite)
    with open_all([*paths, *plates], opening, calibration, output, with_turns) as (sources, camera):
        learned = fit(sources, calibration, paths)
        process = process_of(sources[0], **learned.facts)
    save(output, camera, learned, process, as_json)


def save(
    output: Path, camera: CameraId, learned: Learned, process: dict[str, ProcessValue], as_json: bool
) -> Calibration:
    """Add a part to a calibration, and report it."""
    from mirrorskin import io
    from mirrorskin.cli.output import print_json

    calibration = io.update_calibration(output, learned.part, camera, process)
    for part in learned.also:
        calibration = io.update_calibration(output, part, camera, process)
    if as_json:
        print_json({"output": str(output), **learned.numbers})
    else:
        click.echo(f"{output}: {learned.line}")
    for note in learned.notes:
        click.echo(note, err=True)
    return calibration


# --- on a rig -----------------------------------------------------------------------------------------------


class Place(NamedTuple):
    """A recording that is captured."""

    name: str  # part of the file's name: "dark", "ball-1"
    prompt: str  # instruction for the user: "put the ball at place 1 of 9"
    plan: Plan  # movement of the body
    frames: int = 1  # at each step of a plan in steps
    check: Callable[[PlannedScan], None] = lambda planned: None  # raises what rules out its use


def take(
    rig_file: Path,
    calibration: Path,
    places: Sequence[Place],
    settle: str | None = None,
    overwrite: bool = False,
) -> list[Path]:
    """Capture recordings into files next to the calibration: CAL-dark.h5 for CAL.h5 and a place "dark".

    For each place the body is lifted, and the user is asked to follow the prompt and to press Enter. Plans,
    files and the calibration's camera are checked before any movement.
    """
    import numpy as np

    from mirrorskin import io
    from mirrorskin.cli.output import progress
    from mirrorskin.cli.quantity import duration
    from mirrorskin.hw.base.rig_file import load_rig
    from mirrorskin.hw.rig.plans import check_plan
    from mirrorskin.hw.rig.rig import open_rig
    from mirrorskin.hw.rig.scan import PlannedScan
    from mirrorskin.hw.rig.sweep import make_scan

    settings = load_rig(rig_file)
    seconds = None if settle is None else duration(settle, "--settle")
    if seconds is not None and seconds < 0:
        raise io.InputError(f"--settle {settle}: a time must not be negative")
    paths = [calibration.with_name(f"{calibration.stem}-{place.name}.h5") for place in places]
    if calibration.exists():
        scans.open_calibration(calibration, settings)
    for place, path in zip(places, paths, strict=True):
        check_plan(place.plan, settings.stage, settings.name)
        planned = PlannedScan(settings, place.plan)
        scans.check_recording(planned, path, rig_file, overwrite=overwrite)
        place.check(planned)
    with open_rig(settings) as rig:
        for place, path in zip(places, paths, strict=True):
            scan = make_scan(rig, place.plan, seconds, place.frames)
            scan.lift()
            click.echo(f"{place.prompt}, then press Enter", err=True)
            if not sys.stdin.readline():  # end of input
                raise click.Abort
            recorder = io.StreamRecorder(scan, path, overwrite=overwrite)
            with scans.kept(recorder), recorder, progress(place.name, recorder.shape[0]) as show:
                buffer = np.empty((_BLOCK, *recorder.shape[1:]), recorder.dtype)
                while recorder.read(buffer) is not None:
                    show(recorder.count)
    return paths


def at_each(part: str, prompt: str, count: int, plan: Plan, frames: int = 1) -> list[Place]:
    """Return one plan at several places; the prompt is a format for the number and the count of places."""
    numbers = range(1, count + 1)
    return [Place(f"{part}-{n}", prompt.format(n, count), plan, frames) for n in numbers]


def turn_plan(press: str | None, tilt: float | None, phase_step: float | None, example: str) -> AxialPlan:
    """Return the plan of a rotation on a ball, by default of eight steps and a tilt of 2.5 degrees."""
    from mirrorskin.cli.quantity import angle, length
    from mirrorskin.hw.rig.plans import AxialPlan
    from mirrorskin.io import InputError

    if press is None:
        raise InputError(
            f"--press is missing: give the travel of the press on the ball, such as --press {example}"
        )
    return AxialPlan(
        length(press, "--press"),
        angle(TILT) if tilt is None else tilt,
        phase_step=angle(_PHASE_STEP) if phase_step is None else phase_step,
    )


def still_plan(rig_file: Path, travel: float | None = None) -> VerticalPlan:
    """Return a plan in which the body hardly moves, lifted or at a travel, mm."""
    from mirrorskin.hw.base.rig_file import load_rig
    from mirrorskin.hw.rig.plans import VerticalPlan

    start = load_rig(rig_file).stage.limits.travel[0] if travel is None else travel - _STILL
    return VerticalPlan(start, start + _STILL, step=_STILL)
