from .arrays import ArrayRecording
from .atomic import check_output, check_result_output
from .calibration.file import open_calibration, save_calibration, update_calibration
from .calibration.source import Calibrated
from .calibration.types import (
    Calibration,
    CameraId,
    Gel,
    Lens,
    Precession,
    References,
    Stiffness,
    WallResponse,
)
from .description import describe
from .export import export_result, save_table
from .findings import Finding, MirrorskinWarning
from .fitted import Fitted
from .maps import Map
from .mcap import save_messages
from .mesh import Mesh, surface_mesh
from .plausibility import check
from .positions import Steps
from .recorder import Recorder
from .recording import Recording, open_heights, open_recording
from .result import Result, select_turn
from .result_file import open_result, save_result
from .selection import Region
from .streaming import StreamRecorder
from .types import (
    Block,
    Header,
    InputError,
    LiveSource,
    Motion,
    Source,
    Truth,
    pixel_axes,
)
from .watch import Check
from .zarr_export import save_zarr

__all__ = [
    "ArrayRecording",
    "Block",
    "Calibrated",
    "Calibration",
    "CameraId",
    "Check",
    "Finding",
    "Fitted",
    "Gel",
    "Header",
    "InputError",
    "Lens",
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
    "save_zarr",
    "select_turn",
    "surface_mesh",
    "update_calibration",
]
