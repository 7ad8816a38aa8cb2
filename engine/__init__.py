"""The estimators: what turns frames into maps, and maps into numbers.

The names below are the public face; each is imported from its module when it is first used.
Everything else is imported from its module, such as `mirrorskin.engine.live`.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mirrorskin.engine.errors import NotConverged
    from mirrorskin.engine.fusion import fuse
    from mirrorskin.engine.integration.integration import Integrator, integrate
    from mirrorskin.engine.integration.surface import Surface
    from mirrorskin.engine.metrology.measures import Measures, measure
    from mirrorskin.engine.press.changepoint import ChangePointSearch, find_change_point
    from mirrorskin.engine.press.holes import fill_holes
    from mirrorskin.engine.press.onset import Onset, OnsetSearch, find_onset
    from mirrorskin.engine.reconstruction import reconstruct
    from mirrorskin.engine.rotation.correlation import Correlation, Correlator, correlate
    from mirrorskin.engine.rotation.edges import find_edges
    from mirrorskin.engine.rotation.normals import NormalEstimator, Normals, estimate_normals
    from mirrorskin.engine.scoring import Score, score

_HOMES = {
    "errors": ("NotConverged",),
    "fusion": ("fuse",),
    "integration.integration": ("Integrator", "integrate"),
    "integration.surface": ("Surface",),
    "metrology.measures": ("Measures", "measure"),
    "press.changepoint": ("ChangePointSearch", "find_change_point"),
    "press.holes": ("fill_holes",),
    "press.onset": ("Onset", "OnsetSearch", "find_onset"),
    "reconstruction": ("reconstruct",),
    "rotation.correlation": ("Correlation", "Correlator", "correlate"),
    "rotation.edges": ("find_edges",),
    "rotation.normals": ("NormalEstimator", "Normals", "estimate_normals"),
    "scoring": ("Score", "score"),
}
_HOME = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [
    "ChangePointSearch",
    "Correlation",
    "Correlator",
    "Integrator",
    "Measures",
    "NormalEstimator",
    "Normals",
    "NotConverged",
    "Onset",
    "OnsetSearch",
    "Score",
    "Surface",
    "correlate",
    "estimate_normals",
    "fill_holes",
    "find_change_point",
    "find_edges",
    "find_onset",
    "fuse",
    "integrate",
    "measure",
    "reconstruct",
    "score",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value  # looked up once, and in the place of a module of that name
    return value


def __dir__() -> list[str]:
    return sorted(set(globals()) | set(__all__))
