"""Measurements on height maps, with uncertainties: forms, areas, volumes, sections, steps and roughness."""

from mirrorskin.engine.metrology.extent import HighestPoint, highest_point
from mirrorskin.engine.metrology.forms import Plane, Sphere, fit_plane, fit_sphere
from mirrorskin.engine.metrology.measures import FormName, Measures, group_of, measure
from mirrorskin.engine.metrology.parameters import PARAMETERS, Parameter
from mirrorskin.engine.metrology.profile import profile_parameters
from mirrorskin.engine.metrology.quantity import Quantity
from mirrorskin.engine.metrology.sections import Section, StepHeight, section, section_columns, step_height
from mirrorskin.engine.metrology.texture import Roughness, roughness

__all__ = [
    "PARAMETERS",
    "FormName",
    "HighestPoint",
    "Measures",
    "Parameter",
    "Plane",
    "Quantity",
    "Roughness",
    "Section",
    "Sphere",
    "StepHeight",
    "fit_plane",
    "fit_sphere",
    "group_of",
    "highest_point",
    "measure",
    "profile_parameters",
    "roughness",
    "section",
    "section_columns",
    "step_height",
]
