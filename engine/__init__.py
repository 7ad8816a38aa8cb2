"""The estimators: what turns frames into maps."""

from mirrorskin.engine.calibrated import calibrated
from mirrorskin.engine.errors import NotConverged
from mirrorskin.engine.fusion import frames_to_read, fuse, fuse_sources
from mirrorskin.engine.integration.integrate import integrate
from mirrorskin.engine.integration.live import Integrator
from mirrorskin.engine.integration.surface import Surface
from mirrorskin.engine.measure.measure import FormName, Measures, measure
from mirrorskin.engine.measure.plane import Plane, fit_plane
from mirrorskin.engine.measure.quantity import Quantity
from mirrorskin.engine.measure.section import Section, section
from mirrorskin.engine.measure.sphere import Sphere, fit_sphere
from mirrorskin.engine.measure.steps import Step, step_height
from mirrorskin.engine.measure.texture import Roughness, roughness
from mirrorskin.engine.press.changepoint import ChangePointSearch, find_change_point
from mirrorskin.engine.press.holes import fill_holes
from mirrorskin.engine.press.onset import OnsetSearch, find_onset
from mirrorskin.engine.press.search import EVENTS, Event, Onset
from mirrorskin.engine.press.vertical import PressMethod, reconstruct_press
from mirrorskin.engine.reconstruct import reconstruct
from mirrorskin.engine.rotation.axial import correlate_source, reconstruct_rotation
from mirrorskin.engine.rotation.correlation import Correlation, Correlator, correlate
from mirrorskin.engine.rotation.edges import find_edges
from mirrorskin.engine.rotation.launch import NormalMethod
from mirrorskin.engine.rotation.normals import NormalEstimator, Normals, estimate_normals
from mirrorskin.engine.rotation.registration import Registered
from mirrorskin.engine.score import AngleScore, ContactScore, EdgeScore, HeightScore, Score, score
from mirrorskin.engine.summary import Summary, summarise

__all__ = [
    "EVENTS",
    "AngleScore",
    "ChangePointSearch",
    "ContactScore",
    "Correlation",
    "Correlator",
    "EdgeScore",
    "Event",
    "FormName",
    "HeightScore",
    "Integrator",
    "Measures",
    "NormalEstimator",
    "NormalMethod",
    "Normals",
    "NotConverged",
    "Onset",
    "OnsetSearch",
    "Plane",
    "PressMethod",
    "Quantity",
    "Registered",
    "Roughness",
    "Score",
    "Section",
    "Sphere",
    "Step",
    "Summary",
    "Surface",
    "calibrated",
    "correlate",
    "correlate_source",
    "estimate_normals",
    "fill_holes",
    "find_change_point",
    "find_edges",
    "find_onset",
    "fit_plane",
    "fit_sphere",
    "frames_to_read",
    "fuse",
    "fuse_sources",
    "integrate",
    "measure",
    "reconstruct",
    "reconstruct_press",
    "reconstruct_rotation",
    "roughness",
    "score",
    "section",
    "step_height",
    "summarise",
]
