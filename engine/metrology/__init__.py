"""Measurements on height maps, with uncertainties: forms, areas, volumes, sections, steps and roughness."""

from mirrorskin.engine.metrology.extent import HighestPoint, highest_point
from mirrorskin.engine.metrology.forms import (
    Plane,
    Polynomial,
    Sphere,
    fit_plane,
    fit_polynomial,
    fit_sphere,
)
from mirrorskin.engine.metrology.masks import Defects, Levels, Picture, Polygon
from mirrorskin.engine.metrology.measures import FormName, Measures, group_of, measure
from mirrorskin.engine.metrology.parameters import PARAMETERS, Parameter
from mirrorskin.engine.metrology.profile import profile_parameters
from mirrorskin.engine.metrology.quantity import Quantity
from mirrorskin.engine.metrology.reference import subtract
from mirrorskin.engine.metrology.sections import (
    Groove,
    Section,
    StepHeight,
    groove,
    section,
    section_columns,
    step_height,
)
from mirrorskin.engine.metrology.tables import Limit, Table, Verdict, table
from mirrorskin.engine.metrology.texture import Roughness, roughness

__all__ = [
    "PARAMETERS",
    "Defects",
    "FormName",
    "Groove",
    "HighestPoint",
    "Levels",
    "Limit",
    "Measures",
    "Parameter",
    "Picture",
    "Plane",
    "Polygon",
    "Polynomial",
    "Quantity",
    "Roughness",
    "Section",
    "Sphere",
    "StepHeight",
    "Table",
    "Verdict",
    "fit_plane",
    "fit_polynomial",
    "fit_sphere",
    "groove",
    "group_of",
    "highest_point",
    "measure",
    "profile_parameters",
    "roughness",
    "section",
    "section_columns",
    "step_height",
    "subtract",
    "table",
]
