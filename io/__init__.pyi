from .atomic import check_output
from .calibration.file import open_calibration, save_calibration, update_calibration
from .calibration.source import Calibrated, check_camera
from .calibration.types import Calibration, CameraId, Gel, Lens, Precession, References, WallResponse
from .description import describe
from .export import check_export, export_result, save_table
from .frames import open_frames
from .heights import open_heights
from .mesh import Mesh, surface_mesh
from .positions import Positions, check_phase, check_stroke, check_travel
from .recorder import COMPRESSIONS, Compression, Recorder
from .recording import Recording, Steps, open_recording
from .result import open_result, save_result, select_turn
from .selection import Region, source_region
from .streaming import StreamRecorder
from .types import (
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
