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
    from mirrorskin.engine.integration.integrate import integrate
    from mirrorskin.engine.integration.live import Integrator
    from mirrorskin.engine.integration.surface import Surface
    from mirrorskin.engine.measure.measure import Measures
    from mirrorskin.engine.press.changepoint import ChangePointSearch, find_change_point
    from mirrorskin.engine.press.holes import fill_holes
    from mirrorskin.engine.press.onset import Onset, OnsetSearch, find_onset
    from mirrorskin.engine.reconstruction import reconstruct
    from mirrorskin.engine.rotation.correlation import Correlation, Correlator, correlate
    from mirrorskin.engine.rotation.edges import find_edges
    from mirrorskin.engine.rotation.normals import NormalEstimator, Normals, estimate_normals
    from mirrorskin.engine.score import Score

_HOMES = {
    "errors": ("NotConverged",),
    "fusion": ("fuse",),
    "integration.integrate": ("integrate",),
    "integration.live": ("Integrator",),
    "integration.surface": ("Surface",),
    "measure.measure": ("Measures", "measure"),
    "press.changepoint": ("ChangePointSearch", "find_change_point"),
    "press.holes": ("fill_holes",),
    "press.onset": ("Onset", "OnsetSearch", "find_onset"),
    "reconstruction": ("reconstruct",),
    "rotation.correlation": ("Correlation", "Correlator", "correlate"),
    "rotation.edges": ("find_edges",),
    "rotation.normals": ("NormalEstimator", "Normals", "estimate_normals"),
    "score": ("Score", "score"),
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


# Until these packages are renamed: a module of a function's name would take its place.
from mirrorskin.engine.measure.measure import measure  # noqa: E402
from mirrorskin.engine.score import score  # noqa: E402
