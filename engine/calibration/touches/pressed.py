"""Heights of the press of a touch, corrected for the elastomer if it is calibrated."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mirrorskin.engine.fusion.fusion import press_evidence
from mirrorskin.io import Calibrated, Gel, InputError, Source
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.device import Device

_INSIDE = 0.99  # share of contact, from that of the cells around a pixel, where the sheet is on the object


class Pressed(NamedTuple):
    """What a press shows of the heights of pixels, (H, W), mm; NaN where it shows nothing."""

    height: Doubles
    middle: Doubles  # of the interval between two frames
    half: Doubles  # half-width of this interval
    error: Doubles  # standard deviation of what heights are corrected by
    by_compliance: Doubles  # derivative of the heights by the gel's compliance, mm per 1/mm
    compliance: float = 0.0  # with which they are corrected, 1/mm

    @classmethod
    def unknown(cls, shape: tuple[int, int]) -> Pressed:
        """Return what no press shows."""
        unknown = np.full(shape, np.nan)
        return cls(unknown, unknown, unknown, unknown, unknown)

    def seen(self, by: Callable[[Doubles], Doubles]) -> Pressed:
        """Return the maps as ``by`` resamples them."""
        height, middle, half, error, by_compliance = map(by, self[:-1])
        return Pressed(height, middle, half, error, by_compliance, self.compliance)


def gel_of(source: Source | None) -> Gel | None:
    """Return the elastomer that the calibration of a press describes."""
    return source.calibration.gel if isinstance(source, Calibrated) else None


def read_press(press: Source, device: str | Device | None) -> Pressed:
    """Return the heights of a press.

    With a gel, they are corrected, and unknown where the sheet is not on the object. The error of its
    compliance is common to all presses: it is a parameter, and not noise of pixels. Other errors of the
    correction are as smooth as its splines, whose pixels count once, and nowhere smaller than their RMS.

    Raises
    ------
    mirrorskin.io.InputError
        No pixel turned light, or heights cannot be corrected for the gel.
    """
    gel, source = gel_of(press), press
    if isinstance(press, Calibrated):
        source = Calibrated(press.source, replace(press.whole, gel=None))
    result, evidence = press_evidence(source, {"device": device})
    height, sigma = (np.asarray(result[name], np.float64) for name in ("height", "height_sigma"))
    middle, half = evidence.heights.height, math.sqrt(3) * evidence.heights.sigma
    if not np.isfinite(height).any():
        raise InputError(f"no pixel of {press.name} turned light: press deeper, or leave it out")
    if gel is None:
        return Pressed(height, middle, half, *np.zeros((2, *height.shape)))
    from mirrorskin.engine.press.elastic import LEARNED_AT, correct_press  # a tenth of a second to load

    firm = replace(gel, sigma={**gel.sigma, "compliance": 0.0})
    corrected, summary, fit = correct_press(result, press, evidence.deepest, LEARNED_AT, firm)
    if fit is None:
        reason = summary.partition(": ")[2]
        raise InputError(f"{press.name} cannot be corrected for the gel: {reason}. Leave it out")
    moved = np.asarray(corrected.height, np.float64) - height
    contact = fit.on_pixels(fit.slopes.contact.astype(np.float64)) > _INSIDE
    more = np.maximum(np.asarray(corrected.height_sigma, np.float64) ** 2 - sigma**2, 0.0)
    if np.isfinite(more[contact]).any():
        more = np.maximum(more, np.nanmean(more[contact])) * fit.pixels_of_a_spline
    middle, half = (np.where(contact, each, np.nan) for each in (middle + moved, half))
    half[np.isnan(middle)] = np.nan
    return Pressed(height + moved, middle, half, np.sqrt(more), fit.by_compliance(), gel.compliance)
