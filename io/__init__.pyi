from .base.findings import Finding, MirrorskinWarning
from .base.selection import Region
from .base.types import (
    Block,
    Header,
    InputError,
    LiveSource,
    Motion,
    Source,
    Truth,
    pixel_axes,
)
from .files.arrays import ArrayRecording
from .files.description import describe
from .files.heights import open_heights
from .files.opening import open_recording
from .files.plausibility import check
from .files.recorder import Recorder
from .files.recording import Recording
from .files.result_file import check_result_output, open_result, save_result
from .files.streaming import StreamRecorder
from .files.touch_file import save_touch
from .files.zarr_export import save_zarr
from .formats.export import export_result
from .formats.mcap import save_messages
from .formats.registry import Format
from .formats.tables import save_table
from .model.calibrated import Calibrated
from .model.calibration import (
    Calibration,
    CameraId,
    Gel,
    Lens,
    LinearResponse,
    Precession,
    References,
    Stiffness,
    WallResponse,
)
from .model.fitted import Fitted
from .model.frames import FrameReader
from .model.maps import Map
from .model.mesh import Mesh, surface_mesh
from .model.positions import Steps
from .model.result import Result, select_turn
from .storage.atomic import check_output
from .storage.calibration_file import open_calibration, save_calibration, update_calibration
from .watch.watch import CheckReport

__all__ = [
    "ArrayRecording",
    "Block",
    "Calibrated",
    "Calibration",
    "CameraId",
    "CheckReport",
    "Finding",
    "Fitted",
    "Format",
    "FrameReader",
    "Gel",
    "Header",
    "InputError",
    "Lens",
    "LinearResponse",
    "LiveSource",
    "Map",
    "Mesh",
    "MirrorskinWarning",
    "Motion",
    "Precession",
    "Recorder",
    "Recording",
    "References",
    "Region",
    "Result",
    "Source",
    "Steps",
    "Stiffness",
    "StreamRecorder",
    "Truth",
    "WallResponse",
    "check",
    "check_output",
    "check_result_output",
    "describe",
    "export_result",
    "open_calibration",
    "open_heights",
    "open_recording",
    "open_result",
    "pixel_axes",
    "save_calibration",
    "save_messages",
    "save_result",
    "save_table",
    "save_touch",
    "save_zarr",
    "select_turn",
    "surface_mesh",
    "update_calibration",
]
