from .board import Charuco, Dots, mean_of_still, paint_board
from .brightness import LinearBrightness, WallBrightness
from .check import Check, ErrorMap, ErrorSummary, check_ball, compare_brightness
from .force import KnownPress, StiffnessFit, fit_stiffness, known_press
from .gel import BallOnset, BallPlace, GelFit, ball_onset, fit_gel
from .lens import LensFit, calibrate_lens
from .references import LevelReport, Measured, measure_references
from .tilt import PrecessionFit, fit_precession
from .tilt_tracks import BallTrack, PlateTrack, track_ball, track_plate
from .touches import Estimate, Stated, TouchFit, from_touches
from .wall import fit_zenith
from .wall_response import threshold_zenith

__all__ = [
    "BallOnset",
    "BallPlace",
    "BallTrack",
    "Charuco",
    "Check",
    "Dots",
    "ErrorMap",
    "ErrorSummary",
    "Estimate",
    "GelFit",
    "KnownPress",
    "LensFit",
    "LevelReport",
    "LinearBrightness",
    "Measured",
    "PlateTrack",
    "PrecessionFit",
    "Stated",
    "StiffnessFit",
    "TouchFit",
    "WallBrightness",
    "ball_onset",
    "calibrate_lens",
    "check_ball",
    "compare_brightness",
    "fit_gel",
    "fit_precession",
    "fit_stiffness",
    "fit_zenith",
    "from_touches",
    "known_press",
    "mean_of_still",
    "measure_references",
    "paint_board",
    "threshold_zenith",
    "track_ball",
    "track_plate",
]
