"""Shared types, and the files: recordings, results, other people's frames.

Only the types are loaded at once; everything else when it is first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from mirrorskin.io.types import (
    FRAME_DTYPES,
    MOTIONS,
    UNDISTORTED,
    Block,
    Header,
    InputError,
    LiveSource,
    Motion,
    ProcessValue,
    Result,
    Source,
    Truth,
    pixel_axes,
)

if TYPE_CHECKING:
    from mirrorskin.io.atomic import check_output
    from mirrorskin.io.calibration.file import open_calibration, save_calibration, update_calibration
    from mirrorskin.io.calibration.source import Calibrated, check_camera
    from mirrorskin.io.calibration.types import (
        Calibration,
        CameraId,
        Gel,
        Lens,
        Precession,
        References,
        WallResponse,
    )
    from mirrorskin.io.description import describe
    from mirrorskin.io.export import check_export, export_result, save_table
    from mirrorskin.io.frames import open_frames
    from mirrorskin.io.heights import open_heights
    from mirrorskin.io.mesh import Mesh, surface_mesh
    from mirrorskin.io.positions import Positions, check_phase, check_stroke, check_travel
    from mirrorskin.io.recorder import COMPRESSIONS, Compression, Recorder
    from mirrorskin.io.recording import Recording, Steps, open_recording
    from mirrorskin.io.result import open_result, save_result, select_turn
    from mirrorskin.io.selection import Region, source_region
    from mirrorskin.io.streaming import StreamRecorder

__all__ = [
    "COMPRESSIONS",
    "FRAME_DTYPES",
    "MOTIONS",
    "UNDISTORTED",
    "Block",
    "Calibrated",
    "Calibration",
    "CameraId",
    "Compression",
    "Gel",
    "Header",
    "InputError",
    "Lens",
    "LiveSource",
    "Mesh",
    "Motion",
    "Positions",
    "Precession",
    "ProcessValue",
    "Recorder",
    "Recording",
    "References",
    "Region",
    "Result",
    "Source",
    "Steps",
    "StreamRecorder",
    "Truth",
    "WallResponse",
    "check_camera",
    "check_export",
    "check_output",
    "check_phase",
    "check_stroke",
    "check_travel",
    "describe",
    "export_result",
    "open_calibration",
    "open_frames",
    "open_heights",
    "open_recording",
    "open_result",
    "pixel_axes",
    "save_calibration",
    "save_result",
    "save_table",
    "select_turn",
    "source_region",
    "surface_mesh",
    "update_calibration",
]

_MODULES = {
    "atomic": ("check_output",),
    "calibration.file": ("open_calibration", "save_calibration", "update_calibration"),
    "calibration.source": ("Calibrated", "check_camera"),
    "calibration.types": (
        "Calibration",
        "CameraId",
        "Gel",
        "Lens",
        "Precession",
        "References",
        "WallResponse",
    ),
    "description": ("describe",),
    "export": ("check_export", "export_result", "save_table"),
    "frames": ("open_frames",),
    "heights": ("open_heights",),
    "mesh": ("Mesh", "surface_mesh"),
    "positions": ("Positions", "check_phase", "check_stroke", "check_travel"),
    "recorder": ("COMPRESSIONS", "Compression", "Recorder"),
    "recording": ("Recording", "Steps", "open_recording"),
    "result": ("open_result", "save_result", "select_turn"),
    "selection": ("Region", "source_region"),
    "streaming": ("StreamRecorder",),
}
_HOMES = {name: module for module, names in _MODULES.items() for name in names}


if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        """Load what is not a type from its module (PEP 562)."""
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
