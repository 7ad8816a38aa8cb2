"""Shared types, and the files: recordings, results, other people's frames."""

from mirrorskin.io.atomic import check_output
from mirrorskin.io.calibration.file import open_calibration, save_calibration, update_calibration
from mirrorskin.io.calibration.fit import check_camera
from mirrorskin.io.calibration.source import Calibrated
from mirrorskin.io.calibration.types import (
    Calibration,
    CameraId,
    Gel,
    Lens,
    Precession,
    References,
    WallResponse,
)
from mirrorskin.io.describe import describe
from mirrorskin.io.frames import open_frames
from mirrorskin.io.heights import open_heights
from mirrorskin.io.positions import Positions, check_phase, check_stroke, check_travel
from mirrorskin.io.recorder import Recorder
from mirrorskin.io.recording import Recording, Steps, open_recording
from mirrorskin.io.region import Region, part_of
from mirrorskin.io.result import open_result, save_result
from mirrorskin.io.streaming import StreamRecorder
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
from mirrorskin.io.writing import COMPRESSIONS, Compression

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
    "check_output",
    "check_phase",
    "check_stroke",
    "check_travel",
    "describe",
    "open_calibration",
    "open_frames",
    "open_heights",
    "open_recording",
    "open_result",
    "part_of",
    "pixel_axes",
    "save_calibration",
    "save_result",
    "update_calibration",
]
