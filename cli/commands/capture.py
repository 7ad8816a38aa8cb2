"""``mirrorskin capture``: move the stage, record the camera."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import click

from mirrorskin.cli import options, scans

if TYPE_CHECKING:
    from mirrorskin.hw.rig.scan import Scan
    from mirrorskin.io import StreamRecorder

_TOGETHER = 64
"""Frames that are read at a time, at most."""


def command(
    context: click.Context,
    motion: scans.Motion,
    rig_file: scans.RigFile,
    output: options.NewRecording,
    calibration: options.Calibration = None,
    compression: options.Compression = options.CompressionName.raw,
    overwrite: options.Overwrite = False,
    **chosen: Annotated[Any, scans.PLAN],
) -> None:
    """Move the stage, and record what the camera sees; what was taken is kept whatever happens."""
    from mirrorskin import io
    from mirrorskin.hw.base.rig_file import load_rig
    from mirrorskin.hw.rig.rig import open_rig
    from mirrorskin.hw.rig.scan import PlannedScan
    from mirrorskin.hw.rig.sweep import make_scan
    from mirrorskin.kernels.rotation.correlation import WINDOW

    settings = load_rig(rig_file)
    plan = scans.make_plan(context, chosen, settings)
    calibrated = scans.open_calibration(calibration, settings)
    planned = PlannedScan(settings, plan)
    scans.check_recording(planned, output, rig_file, calibration, calibration=calibrated, overwrite=overwrite)
    with open_rig(settings, plan.in_steps) as rig:
        # Normals are computed from this number of frames of a turn; more would be of no use.
        scan = make_scan(rig, plan, chosen.get("settle"), chosen.get("frames"), turn_frames=WINDOW)
        recorder = io.StreamRecorder(
            scan, output, compression.value, calibration=calibrated, overwrite=overwrite
        )
        with scans.kept(recorder):
            _drain(recorder)
        click.echo(f"{output}: {_summary(scan)}")


def _drain(recorder: StreamRecorder) -> None:
    import numpy as np

    from mirrorskin.cli.output import progress

    with recorder, progress("capturing", recorder.shape[0]) as show:
        buffer = np.empty((_TOGETHER, *recorder.shape[1:]), recorder.dtype)
        while recorder.read(buffer) is not None:
            show(recorder.count)


def _summary(scan: Scan) -> str:
    _, rows, columns = scan.shape
    return (
        f"{scan.count} frames of {columns} x {rows} at {scan.rate:.4g} Hz, {scan.dropped} dropped,"
        f" {scan.rig.camera.counts.late} late{scan.remark}"
    )
