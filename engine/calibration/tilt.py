"""How the body's axis goes round, fitted to balls and plates."""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.calibration.ball import rotations, smooth_turn
from mirrorskin.engine.calibration.tilt_tracks import BallTrack, PlateTrack
from mirrorskin.io import InputError, Precession

Doubles = NDArray[np.float64]

NAMES = ("tilt", "phase_offset", "oval_x", "oval_y", "centre_x", "centre_y", "pivot_x", "pivot_y", "pivot_z")
"""The body's parameters, by which each vector begins; then come three of each ball, and two of each wedge."""

_SCALES = (1e-3, 1e-2, 1e-3, 1e-3, 1e-3, 1e-3, 0.1, 0.1, 0.1)
_ACROSS, _DEPTH, _ZENITH = 0, 1, 2  # kinds of residuals: of a ball's x and y, of its z, of a plate's zenith
_NOMINAL = math.radians(2.5)  # first guess of a tilt
_PRIOR = np.array([0.0, 10.0, 1.0, 1.0, 0.2, 0.2, 1e3, 1e3, 1e3])  # weak standard errors
_HALF = 0.5  # share of the tilt's start that is its prior standard error
_FIXED = 1e-9  # standard error of what is not free
_ROUNDS = 5  # of the fit, each with the errors that the one before left
_STEPS = 40  # of a fit, at most
_OUTLIER = 3.0  # standard errors from which on a residual counts less
_BEYOND = 5.0  # standard deviations from which on a residual is left out of its kind's scale
_MEDIAN = 1.4826  # standard deviations of a normal variate, of its median magnitude
_ALIKE = 0.03  # share by which scales may still change
_CLEAR = 16.0  # difference of chi^2 that decides between two answers
_SURE = 5.0  # standard errors by which a ball must go round one way more than the other
_VAGUE_TILT = 0.1  # standard errors above which a number is not determined: a share of itself,
_VAGUE_PHASE = math.radians(5.0)
_VAGUE_PIVOT = 3.0  # mm
_ANY = math.pi / math.sqrt(12)  # standard deviation of an axis of unknown direction
_STILL = (
    "the ball hardly moves in the picture: its centre is too near to the point that the body turns about to"
    " determine phases; take a smaller or a larger one"
)


@dataclass(frozen=True, slots=True, eq=False)
class PrecessionFit:
    """A precession, and how it was found."""

    precession: Precession
    residual: dict[str, float]  # RMS: ``place`` and ``depth`` of balls, mm; ``zenith`` of plates, radians
    notes: tuple[str, ...]  # assumptions that were made, and what is not determined; sentences


def fit_precession(
    balls: Sequence[BallTrack], plates: Sequence[PlateTrack] = (), *, depth_sigma: float = 0.0
) -> PrecessionFit:
    """Find how the body leans with the phase, and about which point, from balls and plates.

    A ball looks the same however it is turned. So its pictures show where its centre is in each frame and no
    more: it goes round by the tilt times its distance from the pivot's height, and up and down by the tilt
    times its distance from the pivot across the axis. One ball at one place does not separate the tilt from
    the distances; a level plate, which shows its lean as zenith, or a wedge, whose zenith goes up and down by
    the tilt, does, and so do balls at different places or of different sizes. One ball and plates leave open
    whether the body leans to one side with the pivot above, or to the other with the pivot below: then the
    phase's offset is taken to be within 90 degrees of 0. Only a level plate shows the mean lean; otherwise
    the mean pose is taken for upright.

    Weighted least squares; standard errors are those of the residuals, never below the tracks' own.
    ``depth_sigma``, mm, is a common error of all depths, which adds to that of the pivot's height. InputError
    where tilt or phase are not determined; a pivot that is not determined is NaN.
    """
    if not balls:
        swing = max((_swing(track) for track in plates), default=math.nan)
        known = (
            f"a flat shows the half-angle ({math.degrees(swing):.3f} deg)" if plates else "nothing is given"
        )
        raise InputError(f"{known}, but neither phases nor direction nor pivot: add a turn on a ball")
    free_centre = any(track.level for track in plates)
    model = _Model(balls, plates, _direction(balls), free_centre)
    kinds = model.kinds()
    best = _fit(model, _start(model), np.ones(3), _ROUNDS)
    mirrored = _fit(model, _mirrored(model, best.parameters), best.scale, 1)
    half_a_turn = abs(math.remainder(mirrored.parameters[1] - best.parameters[1], math.tau)) > math.pi / 2
    chi2, other = (float(np.sum((fit.residuals / best.scale[kinds]) ** 2)) for fit in (best, mirrored))
    notes = []
    if half_a_turn and other - chi2 < _CLEAR:
        best = min(best, mirrored, key=lambda fit: abs(math.remainder(fit.parameters[1], math.tau)))
        notes.append("the phase offset is taken to be within 90 deg of 0: a ball at another place would tell")
    if not free_centre:
        notes.append("the mean pose is taken for upright: a level plate would tell the mean lean")
    precession = _precession(model, best, notes, depth_sigma)
    return PrecessionFit(precession, _residual_rms(model, best.parameters), tuple(notes))


class _Model(NamedTuple):
    """Residuals of tracks, by the parameters of a precession of a given direction.

    The body leans by ``l = centre + tilt (u(a) + oval)`` with a = direction phase + phase_offset, u(a) =
    (cos a, sin a), and oval = (gx cos a + gy sin a, gy cos a - gx sin a), which makes an ellipse of the
    circle: (gx, gy) is the ellipticity times (cos, sin) of twice the azimuth of its major axis.
    """

    balls: Sequence[BallTrack]
    plates: Sequence[PlateTrack]
    direction: int
    free_centre: bool  # whether the mean lean is looked for, or the mean pose taken for upright

    def lean(self, parameters: Doubles, phase: Doubles) -> Doubles:
        """Return how the body leans, (T, 2), radians."""
        tilt, offset, oval_x, oval_y, x, y = parameters[:6]
        angle = self.direction * phase + offset
        cosine, sine = np.cos(angle), np.sin(angle)
        along = x + tilt * (cosine + oval_x * cosine + oval_y * sine)
        across = y + tilt * (sine + oval_y * cosine - oval_x * sine)
        return np.stack([along, across], axis=1)

    def residuals(self, parameters: Doubles, start: Doubles) -> Doubles:
        """Return residuals of the tracks, then of parameters from a start, in standard errors, (n,)."""
        phases = [ball.phase for ball in self.balls] + [plate.phase for plate in self.plates]
        turns = rotations(self.lean(parameters, np.concatenate(phases)))
        each = np.split(turns, np.cumsum([len(phase) for phase in phases])[:-1])
        places = parameters[len(NAMES) : len(NAMES) + 3 * len(self.balls)].reshape(-1, 3)
        wedges = iter(parameters[len(NAMES) + places.size :].reshape(-1, 2))
        pivot = parameters[6:9]
        found = []
        for ball, turn, place in zip(self.balls, each, places, strict=False):
            off = (ball.centres - pivot - turn @ (place - pivot)) / ball.sigma
            found.append(off[np.isfinite(off[:, 0])].ravel())
        for plate, turn in zip(self.plates, each[len(self.balls) :], strict=True):
            # A body that leans by l sees an upright normal as one that is inclined by |l| towards l.
            inclined = np.zeros(2) if plate.level else next(wedges)
            normal = turn @ rotations(inclined[np.newaxis])[0, :, 2]
            zenith = np.arctan2(np.sqrt(normal[:, 0] ** 2 + normal[:, 1] ** 2), normal[:, 2])
            found.append((plate.zenith - zenith) / plate.sigma)
        prior = np.full(len(parameters), 1e3)
        prior[: len(_PRIOR)] = _PRIOR
        prior[0] = _HALF * start[0]
        if not self.free_centre:
            prior[4:6] = _FIXED
        return np.concatenate([*found, (parameters - start) / prior])

    def kinds(self) -> NDArray[np.intp]:
        """Return the kinds of the tracks' residuals, (n,)."""
        balls = [
            np.tile([_ACROSS, _ACROSS, _DEPTH], np.count_nonzero(np.isfinite(track.centres[:, 0])))
            for track in self.balls
        ]
        return np.concatenate([*balls, *(np.full(len(track.phase), _ZENITH) for track in self.plates)])


def _direction(balls: Sequence[BallTrack]) -> int:
    """Return whether balls go round as the phase does, 1, or the other way, -1."""
    chi2 = 0.0
    for track in balls:
        forth, back = _goes_round(track)
        error = float(np.nanmedian(track.sigma[:, :2])) / math.sqrt(len(track.phase))
        chi2 += (abs(forth) ** 2 - abs(back) ** 2) / error**2
    if abs(chi2) < _SURE**2:
        raise InputError(_STILL)
    return 1 if chi2 > 0 else -1


def _goes_round(track: BallTrack) -> tuple[complex, complex]:
    """Return the parts of a ball's way that go round with the phase and against it, mm."""
    _, cosine, sine = smooth_turn(track.centres[:, :2], track.phase) @ (1, 1j)
    return (cosine - 1j * sine) / 2, (cosine + 1j * sine) / 2


def _swing(track: PlateTrack) -> float:
    """Return, nearly, the tilt that a plate shows, radians."""
    mean, cosine, sine = smooth_turn(track.zenith[:, np.newaxis], track.phase)[:, 0]
    return float(mean if track.level else math.hypot(cosine, sine))


def _start(model: _Model) -> Doubles:
    """Return parameters to begin with: those of small angles.

    A lean by the complex number tilt exp(i a) moves a ball's centre C by (C.z - pivot.z) times that, and
    lifts it by the real part of -conj(C - pivot) times that.
    """
    waves = [smooth_turn(track.centres, track.phase) for track in model.balls]
    places = np.array([wave[0] for wave in waves])
    across = places[:, 0] + 1j * places[:, 1]
    ways = np.array([_goes_round(track)[0 if model.direction > 0 else 1] for track in model.balls])
    offset = cmath.phase(ways[np.argmax(np.abs(ways))])
    arms = (ways * cmath.exp(-1j * offset)).real  # tilt (C.z - pivot.z)
    lifts = np.array([wave[1, 2] - 1j * model.direction * wave[2, 2] for wave in waves])
    lifted = np.conj(lifts * cmath.exp(-1j * offset))  # -tilt (C - pivot)
    swings = [_swing(track) for track in model.plates]
    tilt, found = float(np.mean(swings)) if swings else _NOMINAL, _tilt_of_places(model, places, arms, lifted)
    if found is not None and found < 0:
        offset, arms, lifted = offset + math.pi, -arms, -lifted
    if found is not None and not swings:
        tilt = abs(found)
    pivot, height = np.mean(across + lifted / tilt), float(np.mean(places[:, 2] - arms / tilt))
    wedges = []
    for track in model.plates:
        if not track.level:  # its wave is greatest as the body leans towards it
            mean, cosine, sine = smooth_turn(track.zenith[:, np.newaxis], track.phase)[:, 0]
            towards = model.direction * math.atan2(sine, cosine) + offset
            wedges += [mean * math.cos(towards), mean * math.sin(towards)]
    known = [tilt, offset, 0, 0, 0, 0, pivot.real, pivot.imag, height]
    return np.array([*known, *places.ravel(), *wedges])


def _tilt_of_places(
    model: _Model, places: Doubles, arms: Doubles, lifted: NDArray[np.complex128]
) -> float | None:
    """Return the tilt, of either sign, by which balls at different places move differently, if clear."""
    errors = np.array([np.nanmedian(track.sigma, axis=0) for track in model.balls])
    low = errors[:, 2] ** -2
    flat = 1 / (errors[:, 0] ** 2 + (_NOMINAL * errors[:, 2]) ** 2)
    across = places[:, 0] - 1j * places[:, 1]
    across = across - np.average(across, weights=low)
    deep = places[:, 2] - np.average(places[:, 2], weights=flat)
    lever = float(np.sum(low * np.abs(across) ** 2) + np.sum(flat * deep**2))
    moment = float(np.sum(flat * deep * arms) - np.sum(low * (lifted * across).real))
    error = math.sqrt(2 / (lever * len(model.balls[0].phase) + 1e-12))
    return moment / lever if abs(moment) > _SURE * error * lever and error < _NOMINAL else None


def _mirrored(model: _Model, parameters: Doubles) -> Doubles:
    """Return the body that leans the other way, about a pivot on the other side of the balls."""
    first = len(NAMES)
    balls = parameters[first : first + 3 * len(model.balls)].reshape(-1, 3)
    mirrored = parameters.copy()
    mirrored[1] += math.pi
    mirrored[6:9] = 2 * balls.mean(axis=0) - parameters[6:9]
    mirrored[4:6] *= -1
    mirrored[first + balls.size :] *= -1
    return mirrored


class _Fit(NamedTuple):
    parameters: Doubles
    covariance: Doubles
    residuals: Doubles
    scale: Doubles  # (3,): by which the errors of each kind of residual are larger than the tracks' own


def _fit(model: _Model, start: Doubles, scale: Doubles, rounds: int) -> _Fit:
    """Fit parameters; from round to round the residuals scale their own errors, kind by kind."""
    from scipy.optimize import least_squares

    kinds = model.kinds()
    steps = np.concatenate([_SCALES, np.full(len(start) - len(_SCALES), 1e-2)])
    parameters = start
    for _ in range(rounds):
        error = np.concatenate([scale[kinds], np.ones(len(start))])
        found = least_squares(
            lambda tried, error=error: model.residuals(tried, start) / error,
            parameters,
            x_scale=steps,
            loss="soft_l1",
            f_scale=_OUTLIER,
            max_nfev=_STEPS,
        )
        parameters = found.x
        if parameters[0] < 0:  # the same with a tilt above 0
            parameters[:2] = -parameters[0], parameters[1] + math.pi
        jacobian = found.jac * steps
        _, values, ways = np.linalg.svd(jacobian, full_matrices=False)
        spread = ways.T / values
        freedom = 1 - np.sum((jacobian @ spread) ** 2, axis=1)[: len(kinds)]
        residuals = model.residuals(parameters, start)[: len(kinds)]
        before, scale = scale, _scales(residuals, freedom, kinds, scale)
        if np.allclose(before, scale, rtol=_ALIKE):
            break
    covariance = (spread @ spread.T) * np.outer(steps, steps)
    return _Fit(parameters, covariance, residuals, scale)


def _scales(residuals: Doubles, freedom: Doubles, kinds: NDArray[np.intp], known: Doubles) -> Doubles:
    """Return the scale of each kind of residual without outliers, (3,); never below 1."""
    scales = known.copy()
    for kind in np.unique(kinds):
        mine, size = kinds == kind, np.abs(residuals)
        kept = mine & (size <= _BEYOND * _MEDIAN * float(np.median(size[mine])) + 1e-12)
        spare = float(np.sum(freedom[kept]))
        if spare >= 1:
            scales[kind] = max(1.0, math.sqrt(float(np.sum(residuals[kept] ** 2)) / spare))
    return scales


def _residual_rms(model: _Model, parameters: Doubles) -> dict[str, float]:
    """Return the RMS of each kind of residual in its own unit."""
    plain = model._replace(
        balls=[track._replace(sigma=np.ones_like(track.sigma)) for track in model.balls],
        plates=[track._replace(sigma=np.ones_like(track.sigma)) for track in model.plates],
    )
    kinds = model.kinds()
    residuals = plain.residuals(parameters, parameters)[: len(kinds)]
    names = {"place": _ACROSS, "depth": _DEPTH, "zenith": _ZENITH}
    return {
        name: float(np.sqrt(np.mean(residuals[kinds == kind] ** 2)))
        for name, kind in names.items()
        if np.any(kinds == kind)
    }


def _precession(model: _Model, fit: _Fit, notes: list[str], depth_sigma: float) -> Precession:
    """Return what a fit determines; notes are added of what it does not."""
    tilt, offset, oval_x, oval_y, *rest = (float(value) for value in fit.parameters[: len(NAMES)])
    errors = np.sqrt(np.diag(fit.covariance))
    sigma = {name: float(error) for name, error in zip(NAMES, errors, strict=False)}
    if sigma["tilt"] > _VAGUE_TILT * abs(tilt):
        raise InputError(
            "the half-angle is not determined: a ball at one place shows only its product with the distance"
            " from the pivot; add a turn on a flat plate, or on the ball at other places"
        )
    if sigma["phase_offset"] > _VAGUE_PHASE:
        raise InputError(_STILL)
    oval = np.array([oval_x, oval_y])
    ellipticity = float(np.hypot(*oval))
    along = oval / ellipticity if ellipticity > 0 else np.array([1.0, 0.0])
    across = along[::-1] * (-1, 1)
    ovals = fit.covariance[2:4, 2:4]
    sigma["ellipticity"] = math.sqrt(along @ ovals @ along)
    turned = math.sqrt(across @ ovals @ across) / (2 * ellipticity) if ellipticity > 0 else math.inf
    sigma["major_axis"] = min(turned, _ANY)
    for name in ("oval_x", "oval_y", *(() if model.free_centre else ("centre_x", "centre_y"))):
        del sigma[name]
    pivot = rest[2:5]
    for number, axis in enumerate("xyz"):
        if sigma[f"pivot_{axis}"] > _VAGUE_PIVOT:
            pivot[number] = sigma[f"pivot_{axis}"] = math.nan
            notes.append(f"the pivot's {axis} is not determined")
    sigma["pivot_z"] = math.hypot(sigma["pivot_z"], depth_sigma)
    return Precession(
        tilt=tilt,
        phase_offset=math.remainder(offset, math.tau),
        direction=model.direction,
        ellipticity=ellipticity,
        major_axis=math.atan2(oval_y, oval_x) / 2,
        centre=(rest[0], rest[1]) if model.free_centre else (0.0, 0.0),
        pivot=(pivot[0], pivot[1], pivot[2]),
        sigma=sigma,
    )
