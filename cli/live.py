"""``mirrorskin live``: reconstruct while the stage moves."""

from __future__ import annotations

import gc
import signal
import threading
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from mirrorskin.cli import options, scans
from mirrorskin.cli.groups import Option

if TYPE_CHECKING:
    from mirrorskin.cli.status import Newest
    from mirrorskin.engine.live import LiveEstimator, Loop
    from mirrorskin.hw.rig.plans import Plan
    from mirrorskin.hw.rig_file import RigSettings
    from mirrorskin.io import Calibration, LiveSource

_ENDING = "SIGINT", "SIGTERM", "SIGHUP"
_LATENCY = "100ms"
_OURS = ("window", "threshold", "hold", "noise", "contact", "device")  # options of our own estimators
_THRESHOLD, _HOLD = 0.5, 2
# What would bring a map that is missing: keys of the rig file.
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
        bool, Option("--overwrite", help="Replace an existing recording of that name.")
    ] = False,
    output: Annotated[
        Path | None,
        Option("--output", "-o", metavar="RES.h5", help="Result to write at the end: HDF5, or NAME.zarr."),
    ] = None,
    view: Annotated[
        str | None,
        Option(metavar="WHERE", help="Show pictures in a 'window', a 'browser', or write a FILE.rrd."),
    ] = None,
    window: Annotated[
        int | None,
        Option(
            min=3, max=64, motions=("axial",), help="frames of a turn to use.", show_default="all, up to 64"
        ),
    ] = None,
    latency: Annotated[
        str, Option(metavar="TIME", help="Age from which on a frame is skipped, but the newest.")
    ] = _LATENCY,
    threshold: Annotated[
        float | None,
        Option(
            motions=("vertical",),
            help="share of the way from dark to bright that is light.",
            show_default=str(_THRESHOLD),
        ),
    ] = None,
    hold: Annotated[
        int | None,
        Option(
            motions=("vertical",), help="light frames in a row that make an onset.", show_default=str(_HOLD)
        ),
    ] = None,
    noise: Annotated[
        float | None,
        Option(metavar="COUNTS", help="Standard deviation of a sample; else told from the frames."),
    ] = None,
    contact: options.Contact = None,
    estimator: Annotated[
        str | None,
        Option(metavar="MODULE:CLASS", help="Your own class; see 'run --help'.", show_default="the motion's"),
    ] = None,
    calibration: options.Calibration = None,
    device: options.Device = None,
    **given: Annotated[Any, scans.PLAN],
) -> None:
    """Reconstruct while the stage moves; Ctrl-C stops it, and what was found and recorded is kept."""
    from mirrorskin import io
    from mirrorskin.cli.quantity import duration
    from mirrorskin.engine.running import load_operation
    from mirrorskin.hw.rig_file import load_rig

    rig = load_rig(rig_file)
    plan = scans.make_plan(context, given, rig)
    own = None if estimator is None else load_operation(estimator)
    ours = [name for name in _OURS if context.params[name] is not None]
    if own and ours:
        raise io.InputError(f"--{ours[0]} does not apply to an --estimator of your own. Remove it")
    if overwrite and record is None:
        raise io.InputError("--overwrite is for --record: leave it out")
    inputs = rig_file, calibration, contact
    if record is not None:
        io.check_output(record, *inputs, replaces="anything" if overwrite else "nothing")
    if output is not None:
        io.check_output(output, *inputs, record, or_zarr=True)
    known = scans.open_calibration(calibration, rig)
    values = {**context.params, "latency": duration(latency, "--latency"), "own": own}
    _Live(rig, plan, values, known).run()


class _Live:
    """A run, of which what was found is kept whatever ends it; the command's options are `given`."""

    def __init__(
        self, settings: RigSettings, plan: Plan, given: Mapping[str, Any], calibration: Calibration | None
    ) -> None:
        from mirrorskin.io import open_result

        self._settings, self._plan, self._given = settings, plan, given
        self._calibration = calibration
        if given["contact"] is not None:
            open_result(given["contact"])  # refused before anything moves
        self._loop: Loop | None = None
        self._estimator: LiveEstimator | None = None

    def run(self) -> None:
        """Reconstruct while the stage moves, and save the result."""
        from mirrorskin.cli.status import summary
        from mirrorskin.hw.errors import HardwareError
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
            raise
        assert self._loop is not None
        click.echo(f"{name}: {summary(self._loop.status)}")
        self._save()

    def _reconstruct(self) -> None:
        """Open all, begin with the work when it is warm, and leave the stage at rest."""
        from mirrorskin.cli.status import show_status
        from mirrorskin.engine.live import Loop
        from mirrorskin.hw.rig.rig import open_rig
        from mirrorskin.io import Calibrated, StreamRecorder

        given, settings, known = self._given, self._settings, self._calibration
        with ExitStack() as stack:
            rig = stack.enter_context(open_rig(settings))
            scan = scans.make_scan(rig, self._plan, given["settle"], given["frames"])
            view = given["view"]
            shown = stack.enter_context(_viewer(view, scan.shape[1:], settings)) if view else None
            tell = stack.enter_context(show_status())
            record = given["record"]
            recorder = None
            if record is not None:
                recorder = StreamRecorder(scan, record, calibration=known, overwrite=given["overwrite"])
            source: LiveSource = scan if recorder is None else recorder
            if known is not None:
                source = Calibrated(source, known)
            stack.enter_context(scans.kept(recorder))
            stack.enter_context(source)
            self._estimator = estimator = self._make_estimator(source, rig.rate)
            estimator.warm()

            def on_update(update: Any, status: Any) -> None:
                tell(status)
                if recorder is not None:
                    recorder.add_maps(update.time, update.height, update.contact_area)
                if shown is not None:
                    shown.show(update, status)

            mark = None if recorder is None else recorder.mark
            guard = _Guard()
            self._loop = Loop(
                source, estimator, latency=given["latency"], on_update=on_update, mark=mark, guard=guard
            )
            gc.freeze()  # a collector that looks through all that was there before would hold up frames
            try:
                with guard.installed():
                    self._loop.run()
            finally:
                gc.unfreeze()

    def _make_estimator(self, source: LiveSource, rate: float) -> LiveEstimator:
        """Make what estimates the maps; the source has its references."""
        from mirrorskin.engine.live import (
            LiveOwn,
            LivePress,
            LiveRocking,
            LiveRotation,
            LiveSlip,
            choose_window,
        )
        from mirrorskin.hw.rig.plans import AxialPlan, HorizontalPlan, RockPlan, TwistPlan

        given, plan = self._given, self._plan
        if given["own"] is not None:
            return LiveOwn(source, given["own"])
        known: dict[str, Any] = {"noise": given["noise"], "device": given["device"]}
        if isinstance(plan, AxialPlan):
            window, every = choose_window(plan.frames_a_turn(rate, given["frames"] or 1), given["window"])
            return LiveRotation(source, window=window, every=every, **known)
        if isinstance(plan, RockPlan):
            return LiveRocking(source, **known)
        if isinstance(plan, HorizontalPlan | TwistPlan):
            return LiveSlip(source, contact=self._given["contact"], **known)
        threshold = _THRESHOLD if given["threshold"] is None else given["threshold"]
        hold = _HOLD if given["hold"] is None else given["hold"]
        return LivePress(source, threshold=threshold, hold=hold, **known)

    def _save(self) -> None:
        """Write the result, if that is asked for, and say what it lacks."""
        output = self._given["output"]
        if output is None:
            return
        from mirrorskin.cli.output import report_contact, report_levels, report_missing_maps, save_and_report

        assert self._estimator is not None
        result = self._estimator.result()
        report_missing_maps(self._settings.name, result.process, _REMEDIES)
        report_contact(self._settings.name, result.process)
        save_and_report(result, output, self._given["device"], as_json=False)
        report_levels(self._settings.name, result.process)


class _Guard:
    """While frames are pushed, signals that end the program wait: what was pushed and counted agrees."""

    def __init__(self) -> None:
        self._handlers: dict[int, Any] = {}
        self._busy = False
        self._waiting: list[tuple[int, Any]] = []

    @contextmanager
    def installed(self) -> Iterator[None]:
        """Take over the signals for a while."""
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
    """Show pictures in a thread of its own, and say in the end if that failed."""
    from mirrorskin.cli.status import Newest
    from mirrorskin.view.live import LiveView

    viewer = Newest(LiveView(where, shape, settings.camera.pixel_sides))
    try:
        yield viewer
    finally:
        viewer.close()
        if viewer.error is not None:
            click.echo(f"the pictures ended early: {viewer.error}", err=True)
