"""How much the brightness of a sensor has changed since its calibration, by an ordinary recording.

The swing of a rotation's brightness, and the full light of a press, are compared with what the calibration
states; of a rotation without one, with the stated zenith gain and tilt. Their ratios, at a grid of pixels,
are a weighted sum ::

    ratio - 1 = change + towards_x x + towards_y y + to_rim (x^2 + y^2) + skew x y + nuisances,

with x and y from -1 to 1 over the picture, and each of the four terms without its mean over the pixels.
The nuisances have priors; what is uncertain of the calibration
itself is added to the standard deviations. See the documentation, "Health of a sensor".
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike

from mirrorskin.engine.diagnosis.footprint import LEAST_BLUR, PIXEL
from mirrorskin.engine.diagnosis.swing import Swing
from mirrorskin.engine.diagnosis.turn_nuisances import shift_of
from mirrorskin.io import Calibrated, Fitted, Header, Result, Source
from mirrorskin.io.base.findings import Finding, with_findings
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.numerics.least_squares import OUTLYING, gram, mad_sigma

KIND = "brightness change"
"""Kind of the finding."""

_WIDE = 1.0  # standard deviation of a change of brightness before the recording: it may be any
_SHOWN = 0.015  # standard deviation, without that of the calibration, of a mean that an object shows
_MOST_INFLATED = 5.0  # ratio of standard deviations with and without nuisances that an object separates
_LEAST_PRIOR = 1e-6  # standard deviation of a nuisance that is known
_ROUNDS = 4  # in which outliers are left out
_LEAST_PIXELS = 100  # that show a change
_TO_RIM = 4 / 3  # mean of x^2 + y^2 over the border of the picture, minus that at the centre
_CLEAR = 4.0  # standard deviations from which on a change is reported
_GAMMA = 0.6  # root mean square of 1 + ln(light) over usual zeniths: gamma changes the swing by so much
_PER_ZENITH = 3.0  # per radian: its derivative by the zenith
_USUAL_ZENITH = 0.2  # radians: standard deviation of zeniths on which heights may depend
_AREA = 0.25  # square pixels: standard deviation of the area that a pixel sees
_MOST_TURNED = 0.2  # square of the angle by which azimuths turn over an area: its effect is proportional
_LEAST_CHANGE = 0.02  # that is reported


Parts = tuple[float, float, float, float]


class LightChange(NamedTuple):
    """Relative change of the brightness, and its standard deviation.

    The four values are the mean over the pixels that show it; the increase from the centre of the picture to
    the right border, and to the upper one; and the increase from the centre to the rim.
    """

    value: Parts
    sigma: Parts


class Reference(NamedTuple):
    """What the brightness is compared with, as a finding states it."""

    fallen: str  # verb of less brightness
    risen: str
    compared: str  # what follows the amount
    remedy: str
    warning: bool  # whether a change makes the maps wrong


CALIBRATION = Reference(
    "has fallen by",
    "has risen by",
    "since the calibration, because of the lamp or the gel",
    "calibrate the zenith again",
    True,
)
_REFERENCES = CALIBRATION._replace(
    compared="since the references, because of the lamp or the gel",
    remedy="take references again",
    warning=False,
)
_STATED = Reference(
    "is lower by",
    "is higher by",
    "than the stated zenith gain and tilt predict",
    "check both, or calibrate the zenith",
    True,
)


def reference_of(source: Source, gain: ArrayLike | None = None) -> Reference:
    """Return what the brightness of a source is compared with.

    Of a rotation it is the calibrated response, or the stated zenith gain and tilt: those of the header, or
    ``gain``, counts per radian, if another one was given. Of a press it is the references.
    """
    if source.motion == "vertical":
        return _REFERENCES
    calibration = source.calibration if isinstance(source, Calibrated) else None
    calibrated = calibration is not None and (calibration.zenith or calibration.response) is not None
    given = gain is not None and not np.array_equal(gain, np.asarray(source.header.zenith_gain))
    return CALIBRATION if calibrated and not given else _STATED


class Samples(NamedTuple):
    """Ratios of the brightness to what a calibration states, at some pixels."""

    ratio: Doubles  # (n,)
    sigma: Doubles  # (n,): standard deviations
    response: Doubles  # (n,): changes of the ratios for those of the brightness
    x: Doubles  # (n,): places, from -1 to 1
    y: Doubles
    nuisances: Doubles  # (n, k): what else may change the ratio: its derivatives
    expected: Doubles  # (k,): the nuisances before the recording
    prior: Doubles  # (k,): their standard deviations


def find_light_change(samples: Samples, common: float, uneven: float) -> LightChange | None:
    """Return the change of the brightness; None if the object does not show its mean.

    Parameters
    ----------
    samples : Samples
    common : float
        Relative standard deviation of what the calibration states of all pixels together.
    uneven : float
        The same, of each term of uneven light over the picture.
    """
    ratio, sigma, response, x, y, nuisances, expected, prior = samples
    usable = np.isfinite(ratio) & np.isfinite(sigma) & (sigma > 0) & np.isfinite(nuisances).all(axis=1)
    if np.count_nonzero(usable) < _LEAST_PIXELS:
        return None
    terms = np.stack([np.ones_like(x), x, y, x * x + y * y, x * y], axis=1)
    columns = np.concatenate([terms * response[:, np.newaxis], nuisances], axis=1)[usable]
    values = ratio[usable] - 1 - nuisances[usable] @ expected
    weights = 1 / sigma[usable]
    columns, values = columns * weights[:, np.newaxis], values * weights
    # The change is that of the pixels that show it: outside of the contact, it is not known.
    at = columns[:, 0] @ columns[:, 1 : terms.shape[1]] / (columns[:, 0] @ columns[:, 0])
    columns[:, 1 : terms.shape[1]] -= np.multiply.outer(columns[:, 0], at)
    priors = np.concatenate([np.full(terms.shape[1], _WIDE), np.maximum(prior, _LEAST_PRIOR)])
    precision = np.diag(priors**-2.0)
    kept = np.full(len(values), True)
    for _ in range(_ROUNDS):
        used = columns.compress(kept, axis=0)
        products = gram(used)
        factors = np.linalg.solve(products + precision, used.T @ values[kept])
        residual = values - columns @ factors
        before, kept = kept, np.abs(residual) <= OUTLYING * max(mad_sigma(residual), 1e-9)
        if np.array_equal(before, kept) or np.count_nonzero(kept) < _LEAST_PIXELS:
            break
    spread = max(1.0, float(np.mean(residual[before] ** 2)))
    covariance = np.linalg.inv(products / spread + precision)
    scale = np.array([1.0, 1.0, 1.0, _TO_RIM])
    variance = scale**2 * np.diag(covariance)[:4]
    # A fit that separates effects which are nearly the same relies on a model that is not exact: on a ball,
    # places, zeniths and movements in the picture change together.
    light, others = np.split(used, [terms.shape[1]], axis=1)
    alone = spread * np.linalg.inv(gram(light) + precision[: terms.shape[1], : terms.shape[1]])
    confused = variance > scale**2 * np.diag(alone)[:4] * _MOST_INFLATED**2
    if variance[0] > _SHOWN**2 or confused[0]:
        return None
    mixed = alone @ light.T @ others / spread
    variance += np.where(confused, scale**2 * np.sum((mixed[:4] * prior) ** 2, axis=1), 0.0)
    known = common, uneven, uneven, _TO_RIM * uneven
    return LightChange(
        cast("Parts", tuple((scale * factors[:4]).tolist())),
        cast("Parts", tuple(np.sqrt(variance + np.square(known)).tolist())),
    )


def with_light_change(result: Result, change: LightChange | None, reference: Reference) -> Result:
    """Return a result that states a change of the brightness, with a finding if it is significant."""
    if change is None:
        return result
    fitted = replace(result.fitted, light_change=change.value, light_change_sigma=change.sigma)
    finding = find_clear_change(fitted, reference)
    result = result.assign(fitted=fitted)
    return result if finding is None else with_findings(result, finding)


def find_clear_change(fitted: Fitted, reference: Reference) -> Finding | None:
    """Return the finding about the stated change of the brightness; None if it is not significant.

    It is that of the mean, of the rim or of one side, whichever is the most significant. A rotation whose
    brightness has changed has wrong normals: a warning. Heights of a press only have the note.
    """
    if fitted.light_change is None or fitted.light_change_sigma is None:
        return None
    value, sigma = np.array(fitted.light_change), np.array(fitted.light_change_sigma)
    score = np.where(np.abs(value) > _LEAST_CHANGE, np.abs(value) / sigma, 0.0)
    if not np.max(score) > _CLEAR:
        return None
    part = int(np.argmax(score))
    amount, error = float(value[part]), float(sigma[part])
    place = ""
    if part in (1, 2):  # a lamp that fades is more usual than one that grows brighter
        side = (("left", "right"), ("lower border", "upper border"))[part - 1][amount < 0]
        place, amount = f" towards the {side}", -abs(amount)
    elif part == 3:
        place = " from the centre to the rim"
    verb = reference.fallen if amount < 0 else reference.risen
    percent = f"{100 * abs(amount):.2g} ± {100 * error:.1g} %"
    text = f"brightness{place} {verb} {percent} {reference.compared}: {reference.remedy}"
    return Finding(KIND, text, reference.warning)


def change_of_swing(
    swing: Swing | None,
    header: Header,
    tilt: float,
    gain_sigma: float | None = None,
    tilt_sigma: float | None = None,
) -> LightChange | None:
    """Return the change of the brightness by the swing of a rotation.

    ``gain_sigma`` is the relative standard deviation of the swing by a calibrated response, which contains
    that of its curvature; by default it is that of gain and gamma. ``tilt_sigma`` is that of a calibrated
    tilt.
    """
    if swing is None:
        return None
    footprint = PIXEL + LEAST_BLUR**2
    # Where azimuths turn by much within the area that a pixel sees, its effect is not proportional.
    sigma = swing.sigma * (1 + (_AREA * swing.turning / _MOST_TURNED) ** 2)
    gamma, shift = header.prior("gamma_sigma"), shift_of(header, tilt) / tilt
    # Points move in the picture by their height above the pivot, which differs from place to place.
    x, y = swing.x, swing.y
    moved = swing.bending[:, np.newaxis] * np.stack(
        [np.ones_like(x), swing.zenith / _USUAL_ZENITH, x, y, x * x + y * y - 2 / 3], axis=1
    )
    samples = Samples(
        swing.ratio - swing.sigma**2 / 2,  # an amplitude by noisy waves is too large on average
        sigma,
        swing.response,
        x,
        y,
        np.concatenate([np.stack([swing.turning, swing.zenith], axis=1), moved], axis=1),
        np.array([-footprint / 2, *[0.0] * 6]),
        np.array([_AREA / 2, _PER_ZENITH * gamma, *[shift] * 5]),
    )
    if gain_sigma is None:
        gain_sigma = math.hypot(header.prior("zenith_gain_sigma"), _GAMMA * gamma)
    tilt_sigma = header.prior("tilt_sigma") if tilt_sigma is None else tilt_sigma
    common = math.hypot(gain_sigma, tilt_sigma)
    return find_light_change(samples, common, header.prior("uneven_light_sigma"))
