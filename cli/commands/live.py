"""``mirrorskin live``: reconstruct while the stage moves."""

from __future__ import annotations

import gc
import math
import signal
import threading
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from mirrorskin.cli import options, scans
from mirrorskin.cli.declared import ClassCommand, declared
from mirrorskin.cli.groups import Option, make_command

if TYPE_CHECKING:
    from mirrorskin.cli.commands.status import Newest
    from mirrorskin.engine.base.method import Method
    from mirrorskin.engine.base.operation import Operation
    from mirrorskin.engine.live import LiveRun, Loop
    from mirrorskin.hw.base.rig_file import RigSettings
    from mirrorskin.hw.rig.plans import Plan
    from mirrorskin.hw.rig.scan import PlannedScan
    from mirrorskin.io import Calibration, LiveSource

_ENDING = "SIGINT", "SIGTERM", "SIGHUP"
_LATENCY = "100ms"
_OPTIONS = (
    *("threshold", "hold", "subframe", "fill", "modulus", "noise"),
    *("window_frames", "robust", "contact", "window_size", "window_step"),
)  # of the methods, which live runs have as well
# Keys of the rig file that are needed for a map.
_REMEDIES = {
    "zenith": "zenith_gain in the rig file",
    "height": "pixel_size in the rig file",
    "fill": "pixel_size in the rig file",
}


def command(
    context: click.Context,
    motion: scans.Motion,
    rig_file: scans.RigFile,
    record: Annotated[
        Path | None,
        Option(
            "--record", metavar="REC.h5|REC.mcap", help="Recording to write meanwhile; MCAP has maps, too."
        ),
    ] = None,
    overwrite: Annotated[
        bool, Option("--overwrite", help="Replace an existing recording or result of that name.")
    ] = False,
    output: Annotated[
        Path | None,
        Option("--output", "-o", metavar="RES.h5", help="Result to write at the end: HDF5, or NAME.zarr."),
    ] = None,
    view: Annotated[
        str | None,
        Option(metavar="WHERE", help="Show pictures in a 'window', a 'browser', or write a FILE.rrd."),
    ] = None,
    latency: Annotated[
        str, Option(metavar="TIME", help="Age from which on a frame is skipped, but the newest.")
    ] = _LATENCY,
    operation: Annotated[
        str | None,
        Option(
            metavar="MODULE:CLASS",
            help="Operation in place of the motion's method, such as your own, with its options.",
        ),
    ] = None,
    calibration: options.Calibration = None,
    device: options.Devices = None,
    **chosen: Annotated[Any, scans.PLAN, declared("reconstruct").only(*_OPTIONS)],
) -> None:
    """Reconstruct while the stage moves. Ctrl-C stops it, and keeps what was computed and recorded."""
    from mirrorskin import io
    from mirrorskin.cli.quantity import duration
    from mirrorskin.engine.base.reconstruction import load_operation, method_for
    from mirrorskin.hw.base.rig_file import load_rig
    from mirrorskin.hw.rig.scan import PlannedScan

    rig = load_rig(rig_file)
    planned = {term.name for term in scans.PLAN.terms}
    plan = scans.make_plan(context, {name: value for name, value in chosen.items() if name in planned}, rig)
    kind = method_for(plan.motion) if operation is None else load_operation(operation)
    shared = () if operation is None else kind.options
    of_kind = {name: value for name, value in chosen.items() if name in shared or name not in planned}
    computed = kind(device=device, **of_kind)
    if overwrite and record is None and output is None:
        raise io.InputError("--overwrite is for --record and -o: leave it out")
    inputs = rig_file, calibration, *(value for value in of_kind.values() if isinstance(value, Path))
    if output is not None:
        io.check_result_output(output, *inputs, record, overwrite=overwrite)
        if record is not None and record.resolve() == output.resolve():
            raise io.InputError(f"--record and -o are both {output}: name two files")
    calibrated = scans.open_calibration(calibration, rig)
    scan = PlannedScan(rig, plan)
    if record is not None:
        scans.check_recording(scan, record, *inputs, calibration=calibrated, overwrite=overwrite)
    values = {**context.params, **chosen, "latency": duration(latency, "--latency")}
    live = _Live(rig, plan, computed, values, calibrated)
    live.check(scan)
    live.run()


class _Live:
    """A run whose result is kept however it ends; `values`: those of the command's options."""

    def __init__(
        self,
        settings: RigSettings,
        plan: Plan,
        computed: Operation | Method,
        values: Mapping[str, Any],
        calibration: Calibration | None,
    ) -> None:
        self._settings, self._plan, self._computed, self._values = settings, plan, computed, values
        self._calibration = calibration
        self._loop: Loop | None = None
        self._run: LiveRun | None = None

    def check(self, planned: PlannedScan) -> None:
        """Refuse what cannot be done with a scan, before the rig is opened."""
        from mirrorskin.engine.live import Loop

        source = self._calibrated(planned)
        run = self._prepare(source, self._settings.camera.rate)
        run.precompile()
        Loop(source, run, latency=self._values["latency"])
        if self._values["view"]:
            from mirrorskin.view.viewer import check_place

            check_place(self._values["view"], "--view")

    def run(self) -> None:
        """Reconstruct while the stage moves, and save the result."""
        from mirrorskin.cli.commands.status import summary
        from mirrorskin.hw.base.errors import HardwareError
        from mirrorskin.io import InputError

        name = self._settings.name
        try:
            self._reconstruct()
        except (HardwareError, InputError, KeyboardInterrupt, SystemExit):
            if self._loop is not None and self._loop.status.used > 0:
                click.echo(f"{name}: cut short: {summary(self._loop.status)}", err=True)
                try:
                    self._save()
                except InputError as lacking:  # why it ended matters more
                    click.echo(f"no result: {lacking}", err=True)
            elif self._values["output"] is not None:
                click.echo("no result: it ended before a frame was used", err=True)
            raise
        assert self._loop is not None
        click.echo(f"{name}: {summary(self._loop.status)}")
        self._save()

    def _reconstruct(self) -> None:
        """Open source and devices, start when the work is compiled, and leave the stage at rest."""
        from mirrorskin.cli.commands.status import show_status
        from mirrorskin.engine.live import Loop
        from mirrorskin.hw.rig.rig import open_rig
        from mirrorskin.hw.rig.sweep import make_scan
        from mirrorskin.io import StreamRecorder

        values, settings, calibration = self._values, self._settings, self._calibration
        with ExitStack() as stack:
            rig = stack.enter_context(open_rig(settings))
            scan = make_scan(rig, self._plan, values.get("settle"), values.get("frames"))
            view = values["view"]
            shown = stack.enter_context(_viewer(view, scan.shape[1:], settings)) if view else None
            tell = stack.enter_context(show_status())
            record = values["record"]
            recorder = None
            if record is not None:
                recorder = StreamRecorder(
                    scan, record, calibration=calibration, overwrite=values["overwrite"]
                )
            source = self._calibrated(scan if recorder is None else recorder)
            stack.enter_context(scans.kept(recorder))
            stack.enter_context(source)
            self._run = run = self._prepare(source, rig.rate)
            run.precompile()

            def on_update(update: Any, status: Any) -> None:
                tell(status)
                if recorder is not None:
                    recorder.add_maps(update.time, update.height, update.contact_area)
                if shown is not None:
                    shown.show(update, status)

            mark = None if recorder is None else recorder.mark
            guard = _Guard()
            self._loop = Loop(
                source, run, latency=values["latency"], on_update=on_update, mark=mark, guard=guard
            )
            gc.freeze()  # a collector that looks through all that was there before would hold up frames
            try:
                with guard.installed():
                    self._loop.run()
            finally:
                gc.unfreeze()

    def _calibrated(self, source: LiveSource) -> LiveSource:
        from mirrorskin.io import Calibrated

        return source if self._calibration is None else Calibrated(source, self._calibration)

    def _prepare(self, source: LiveSource, rate: float | None) -> LiveRun:
        """Connect the operation with the source, its references and its calibration.

        Without a frame rate, the window of a continuous rotation is not determined yet.
        """
        from mirrorskin.engine import Rotation
        from mirrorskin.engine.live import LiveRun
        from mirrorskin.engine.rotation.last_turn import choose_window
        from mirrorskin.hw.rig.plans import AxialPlan

        computed, plan = self._computed, self._plan
        if not (isinstance(plan, AxialPlan) and isinstance(computed, Rotation)):
            return LiveRun(source, computed)
        if rate is None and not plan.in_steps:
            return LiveRun(source, computed)
        per_turn = plan.frames_a_turn(rate or math.nan, self._values.get("frames") or 1)
        window, every = choose_window(per_turn, computed.window_frames)
        return LiveRun(source, computed.with_options(window_frames=window), every=every)

    def _save(self) -> None:
        """Write the result, if requested, and print which maps are missing."""
        output = self._values["output"]
        if output is None:
            return
        from mirrorskin.cli.output import report_contact, report_missing_maps, report_notes, save_and_report

        assert self._run is not None
        result = self._run.result()
        report_missing_maps(self._settings.name, result.process, _REMEDIES)
        report_contact(self._settings.name, result.process)
        save_and_report(
            result,
            output,
            self._values["device"],
            as_json=False,
            must_answer=False,
            overwrite=self._values["overwrite"],
        )
        report_notes(self._settings.name, result.process)


class _Guard:
    """While frames are pushed, signals that end the program wait, so that frames and their count agree."""

    def __init__(self) -> None:
        self._handlers: dict[int, Any] = {}
        self._busy = False
        self._waiting: list[tuple[int, Any]] = []

    @contextmanager
    def installed(self) -> Iterator[None]:
        """Take over the signals within a context."""
        if threading.current_thread() is threading.main_thread():
            numbers = [getattr(signal, name) for name in _ENDING if hasattr(signal, name)]
            self._handlers = {n: handler for n in numbers if callable(handler := signal.getsignal(n))}
        for number in self._handlers:
            signal.signal(number, self._handle)
        try:
            yield
        finally:
            for number, handler in self._handlers.items():
                signal.signal(number, handler)

    def _handle(self, number: int, frame: Any) -> None:
        if self._busy:
            self._waiting.append((number, frame))
        else:
            self._handlers[number](number, frame)

    @contextmanager
    def __call__(self) -> Iterator[None]:
        """Push in this context."""
        self._busy = True
        try:
            yield
        finally:
            self._busy = False
        if self._waiting:
            number, frame = self._waiting.pop(0)
            self._handlers[number](number, frame)


@contextmanager
def _viewer(where: str, shape: tuple[int, int], settings: RigSettings) -> Iterator[Newest]:
    """Show pictures in a separate thread; report at the end if that failed."""
    from mirrorskin.cli.commands.status import Newest
    from mirrorskin.view.live import LiveView

    viewer = Newest(LiveView(where, shape, settings.camera.pixel_sides))
    try:
        yield viewer
    finally:
        viewer.close()
        if viewer.error is not None:
            click.echo(f"the pictures ended early: {viewer.error}", err=True)


app = make_command("live", command, ClassCommand)
