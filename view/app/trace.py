"""The brightness of one pixel over the frames, and what was computed from it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.metrology import Quantity
from mirrorskin.io import Fitted
from mirrorskin.io.base.types import Floats
from mirrorskin.view.app.session import Session

_CURVE = 181  # points of the fitted cosine


@dataclass(frozen=True)
class Trace:
    """Brightness of a pixel over the position of the body.

    Attributes
    ----------
    position, brightness : ndarray, (T,)
        Of the frames that were used, in `unit` and counts.
    axis, unit : str
        What the position is.
    levels : dict of str to float
        Dark and bright level, and the threshold between them, counts.
    event, event_sigma : float
        Position of the onset or release, and its standard deviation; NaN without one.
    curve : (ndarray, ndarray), optional
        Fitted cosine: position and brightness.
    facts : dict of str to str
        Values in words.
    """

    position: Floats
    brightness: Floats
    axis: str
    unit: str
    levels: Mapping[str, float] = field(default_factory=dict)
    event: float = math.nan
    event_sigma: float = math.nan
    curve: tuple[Floats, Floats] | None = None
    facts: Mapping[str, str] = field(default_factory=dict)


def trace_of(session: Session) -> Trace | None:
    """Return the brightness of the session's pixel; None if no pixel of the used region is chosen."""
    if session.pixel is None or session.whole is None:
        return None
    part = session.part()
    row, column = (at - first for at, first in zip(session.pixel, part.origin, strict=True))
    if not (0 <= row < part.shape[1] and 0 <= column < part.shape[2]):
        return None
    axis, unit, position = _positions(session)
    frames = session.brightness(row, column)
    counts = frames.astype(np.float64)
    if part.motion == "axial":
        return _turn(session, row, column, position, frames, axis, unit)
    if part.motion == "vertical":
        return _press(session, row, column, position, counts, axis, unit)
    return Trace(position, counts, axis, unit)


def _positions(session: Session) -> tuple[str, str, Floats]:
    part = session.part()
    if part.travel is not None and part.motion == "vertical":
        return "travel", "mm", part.travel
    if part.phase is not None:
        return "phase", "deg", np.degrees(part.phase)
    if part.displacement is not None:
        start = part.displacement[0]
        return "distance slid", "mm", np.asarray(np.hypot(*(part.displacement - start).T))
    if part.twist is not None:
        return "twist", "deg", np.degrees(part.twist)
    return "frame", "", np.arange(part.shape[0], dtype=np.float64)


def _press(
    session: Session, row: int, column: int, travel: Floats, counts: Floats, axis: str, unit: str
) -> Trace:
    levels = levels_at(session, row, column)
    facts = {name: f"{value:.1f} counts" for name, value in levels.items()}
    height, sigma, status = (_at(session, name, row, column) for name in ("height", "height_sigma", "status"))
    event = (session.now.result.fitted.event if session.now else None) or "onset"
    if session.now is not None and status is not None:
        codes = session.now.result.declaration("status").codes
        facts["Status"] = codes.get(int(status), "unknown")
    if height is not None and math.isfinite(height):
        filled = bool(_at(session, "filled", row, column) or 0)
        error = math.nan if sigma is None else sigma
        facts["Height"] = f"{Quantity(height, error, 'mm')}{', filled, not measured' if filled else ''}"
        if filled:
            height = math.nan
        else:
            facts[f"Travel at the {event}"] = str(Quantity(-height, error, "mm"))
    at = math.nan if height is None else -float(height)
    return Trace(
        travel, counts, axis, unit, levels, at, math.nan if sigma is None else float(sigma), facts=facts
    )


def _at(session: Session, name: str, row: int, column: int) -> float | None:
    """Return the value of a map of the result at a pixel; None while another result is computed."""
    if session.computing or session.now is None or (values := session.now.result.maps().get(name)) is None:
        return None
    if session.now.result.fitted.undistorted:  # its pixels are not those of the camera
        return None
    return float(values[row, column]) if values.shape == session.part().shape[1:] else None


def levels_at(session: Session, row: int, column: int) -> dict[str, float]:
    """Return the levels of dark, threshold and bright that were used at a pixel, counts."""
    part, source, levels = session.part(), session.source(), {}
    fitted = session.now.result.fitted if session.now is not None else Fitted()
    estimated = {"dark": fitted.dark_level, "bright": fitted.bright_level}
    for name in ("dark", "bright"):
        option = session.options().get(name)
        chosen = None if option is None else option.check(session.value(name))
        level = chosen if chosen is not None else getattr(source.header, name)
        if level is None:
            level = estimated[name]
        if level is None:
            level = _end_of_type(part.dtype, name)
        values = np.asarray(level, np.float64)
        levels[name.capitalize()] = float(values if values.ndim == 0 else values[row, column])
    threshold = fitted.threshold
    if threshold is not None:
        low, high = levels.values()
        levels = {"Dark": low, "Threshold": low + threshold * (high - low), "Bright": high}
    return levels


def _end_of_type(dtype: np.dtype[Any], name: str) -> float:
    """Return the least or the greatest value of the samples' type."""
    if dtype.kind != "u":
        return 0.0 if name == "dark" else 1.0
    return float(getattr(np.iinfo(dtype), "min" if name == "dark" else "max"))


def _turn(
    session: Session, row: int, column: int, degrees: Floats, frames: NDArray[Any], axis: str, unit: str
) -> Trace:
    """Return the brightness over the phase with the cosine that fits it, as `engine.correlate` does."""
    from mirrorskin import engine

    phase = np.radians(degrees)
    facts: dict[str, str] = {}
    curve = None
    if len(frames) >= 3:
        fit = engine.correlate(frames[:, np.newaxis, np.newaxis], phase, device=session.opening.device)
        mean, cosine, sine, residual = (
            float(fit[name][0, 0]) for name in ("mean", "cosine", "sine", "residual")
        )
        along = np.linspace(float(phase.min()), float(phase.max()), _CURVE)
        curve = np.degrees(along), mean + cosine * np.cos(along) + sine * np.sin(along)
        facts = {
            "Mean": f"{mean:.2f} counts",
            "Amplitude": f"{math.hypot(cosine, sine):.2f} counts",
            "Phase of the maximum": f"{math.degrees(math.atan2(sine, cosine)):.1f} deg",
            "Standard deviation of the residual": f"{residual:.2f} counts",
        }
    return Trace(degrees, frames.astype(np.float64), axis, unit, curve=curve, facts=facts)
