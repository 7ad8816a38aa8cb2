"""The precession of the body's axis, fitted to balls and plates."""

from __future__ import annotations

import cmath
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.calibration.ball import rotations, smooth_turn
from mirrorskin.engine.calibration.tilt_tracks import BallTrack, PlateTrack
from mirrorskin.io import InputError, Precession
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.numerics import least_squares
from mirrorskin.kernels.numerics.least_squares import mad_sigma

NAMES = ("tilt", "phase_offset", "oval_x", "oval_y", "centre_x", "centre_y", "pivot_x", "pivot_y", "pivot_z")
"""The parameters of the body; in a fit, three for each ball and two for each wedge follow."""

_ACROSS, _DEPTH, _ZENITH = 0, 1, 2  # kinds of residuals: a ball's x and y, its z, a plate's zenith
_NOMINAL = math.radians(2.5)  # initial value of the tilt
_PRIOR = np.array([0.0, 10.0, 1.0, 1.0, 0.2, 0.2, 1e3, 1e3, 1e3])  # weak prior standard deviations
_HALF = 0.5  # prior standard deviation of the tilt relative to its start
_FIXED = 1e-9  # prior standard deviation of a fixed parameter
_REWEIGHTINGS = 5  # number of fits, each weighted by the residuals of the preceding one
_LOSS = least_squares.soft_l1(3.0)  # standard deviations
_OUTLIER_Z_SCORE = 5.0  # standard deviations beyond which a residual is excluded from the scale of its kind
_SETTLED_CHANGE = 0.03  # relative change of the scales that ends the fits
_CLEAR_CHI2 = 16.0  # difference of chi^2 that decides between two solutions
_DIRECTION = 5.0  # standard errors: minimum significance of the sense of rotation
_VAGUE_TILT = 0.1  # relative standard error above which the tilt is not determined
_VAGUE_PHASE = math.radians(5.0)  # the same for the phase offset
_VAGUE_PIVOT = 3.0  # mm: the same for the pivot
_ANY = math.pi / math.sqrt(12)  # standard deviation of an axis of unknown direction
_STILL = (
    "the ball hardly moves in the picture: its centre is too near to the point that the body turns about to"
    " determine phases; take a smaller or a larger one"
)


@dataclass(frozen=True, slots=True, eq=False)
class PrecessionFit:
    """A precession, its residuals, and notes."""

    precession: Precession
    residual: dict[str, float]  # RMS: ``place`` and ``depth`` of balls, mm; ``zenith`` of plates, radians
    notes: tuple[str, ...]  # sentences: assumptions, and parameters that are not determined


def fit_precession(
    balls: Sequence[BallTrack], plates: Sequence[PlateTrack] = (), *, depth_sigma: float = 0.0
) -> PrecessionFit:
    """Fit the lean of the body as a function of the phase, and its pivot, to balls and plates.

    A ball looks the same in any orientation, so pictures only show its centre in each frame. The centre moves
    on a circle, whose radius is the tilt times its vertical distance from the pivot, and up and down by the
    tilt times its horizontal distance from the pivot. One ball at one position does not separate tilt and
    distances. They are separated by a level plate, whose zenith equals the lean; by a wedge, whose zenith
    varies by the tilt; and by balls at several positions or of several sizes. With one ball and plates there
    are two solutions, with the pivot above or below the ball and opposite leans: the phase offset is then
    assumed to be within 90 degrees of 0. Only a level plate determines the mean lean; otherwise the mean pose
    is assumed to be upright.

    The least squares are weighted by the scatter of the residuals, or by the errors of the tracks if larger.

    Parameters
    ----------
    balls : sequence of BallTrack
    plates : sequence of PlateTrack
    depth_sigma : float
        Common standard deviation of all depths, mm; it is added to the uncertainty of the pivot's height.

    Returns
    -------
    PrecessionFit
        Undetermined coordinates of the pivot are NaN.

    Raises
    ------
    mirrorskin.io.InputError
        Tilt or phase offset are not determined.
    """
    if not balls:
        if not plates:
            raise InputError("neither balls nor plates are given: add a turn on a ball")
        tilt = math.degrees(max(_swing(track) for track in plates))
        raise InputError(
            f"a flat shows the half-angle ({tilt:.3f} deg), but neither phases nor direction nor pivot: add a"
            " turn on a ball"
        )
    free_centre = any(track.level for track in plates)
    model = _Model(balls, plates, _direction(balls), free_centre)
    kinds = model.kinds()
    best = _fit(model, _start(model), np.ones(3), _REWEIGHTINGS)
    mirrored = _fit(model, _mirrored(model, best.parameters), best.scale, 1)
    half_a_turn = abs(math.remainder(mirrored.parameters[1] - best.parameters[1], math.tau)) > math.pi / 2
    chi2, other = (float(np.sum((fit.residuals / best.scale[kinds]) ** 2)) for fit in (best, mirrored))
    notes = []
    if half_a_turn and other - chi2 < _CLEAR_CHI2:
        best = min(best, mirrored, key=lambda fit: abs(math.remainder(fit.parameters[1], math.tau)))
        notes.append(
            "the phase offset is assumed to be within 90 deg of 0: a ball at another place would show it"
        )
    if not free_centre:
        notes.append("the mean pose is assumed to be upright: a level plate would show the mean lean")
    precession = _precession(model, best, notes, depth_sigma)
    return PrecessionFit(precession, _residual_rms(model, best.parameters), tuple(notes))


class _Model(NamedTuple):
    """Residuals of tracks as a function of the parameters, for a given sense of rotation.

    The body leans by ``l = centre + tilt (u(a) + oval)`` with a = direction phase + phase_offset,
    u(a) = (cos a, sin a), and oval = (gx cos a + gy sin a, gy cos a - gx sin a), which makes the circle an
    ellipse: (gx, gy) is the ellipticity times (cos, sin) of twice the azimuth of its major axis.
    """

    balls: Sequence[BallTrack]
    plates: Sequence[PlateTrack]
    direction: int
    free_centre: bool  # whether the mean lean is fitted; otherwise it is 0

    def lean(self, parameters: Doubles, phase: Doubles) -> Doubles:
        """Return the lean of the body, (T, 2), radians."""
        tilt, offset, oval_x, oval_y, x, y = parameters[:6]
        angle = self.direction * phase + offset
        cosine, sine = np.cos(angle), np.sin(angle)
        lean_x = x + tilt * (cosine + oval_x * cosine + oval_y * sine)
        lean_y = y + tilt * (sine + oval_y * cosine - oval_x * sine)
        return np.stack([lean_x, lean_y], axis=1)

    def residuals(self, parameters: Doubles, start: Doubles) -> Doubles:
        """Return residuals of the tracks, then of the parameters from a start, in standard deviations."""
        phases = [ball.phase for ball in self.balls] + [plate.phase for plate in self.plates]
        turns = rotations(self.lean(parameters, np.concatenate(phases)))
        each = np.split(turns, np.cumsum([len(phase) for phase in phases])[:-1])
        places = parameters[len(NAMES) : len(NAMES) + 3 * len(self.balls)].reshape(-1, 3)
        wedges = iter(parameters[len(NAMES) + places.size :].reshape(-1, 2))
        pivot = parameters[6:9]
        parts = []
        for ball, turn, place in zip(self.balls, each, places, strict=False):
            off = (ball.centres - pivot - turn @ (place - pivot)) / ball.sigma
            parts.append(off[np.isfinite(off[:, 0])].ravel())
        for plate, turn in zip(self.plates, each[len(self.balls) :], strict=True):
            # For a body with the lean l, an upright normal is inclined by |l| towards l.
            inclined = np.zeros(2) if plate.level else next(wedges)
            normal = turn @ rotations(inclined[np.newaxis])[0, :, 2]
            zenith = np.arctan2(np.sqrt(normal[:, 0] ** 2 + normal[:, 1] ** 2), normal[:, 2])
            parts.append((plate.zenith - zenith) / plate.sigma)
        prior = np.full(len(parameters), 1e3)
        prior[: len(_PRIOR)] = _PRIOR
        prior[0] = _HALF * start[0]
        if not self.free_centre:
            prior[4:6] = _FIXED
        return np.concatenate([*parts, (parameters - start) / prior])

    def kinds(self) -> NDArray[np.intp]:
        """Return the kinds of the tracks' residuals."""
        balls = [
            np.tile([_ACROSS, _ACROSS, _DEPTH], np.count_nonzero(np.isfinite(track.centres[:, 0])))
            for track in self.balls
        ]
        return np.concatenate([*balls, *(np.full(len(track.phase), _ZENITH) for track in self.plates)])


def _direction(balls: Sequence[BallTrack]) -> int:
    """Return 1 if balls move in the sense of the phase, and -1 if they move in the opposite sense."""
    chi2 = 0.0
    for track in balls:
        with_phase, against = _circular_parts(track)
        error = float(np.nanmedian(track.sigma[:, :2])) / math.sqrt(len(track.phase))
        chi2 += (abs(with_phase) ** 2 - abs(against) ** 2) / error**2
    if abs(chi2) < _DIRECTION**2:
        raise InputError(_STILL)
    return 1 if chi2 > 0 else -1


def _circular_parts(track: BallTrack) -> tuple[complex, complex]:
    """Return the parts of a ball's movement that rotate with the phase and against it, mm."""
    _, cosine, sine = smooth_turn(track.centres[:, :2], track.phase) @ (1, 1j)
    return (cosine - 1j * sine) / 2, (cosine + 1j * sine) / 2


def _swing(track: PlateTrack) -> float:
    """Return a first approximation of the tilt from a plate, radians."""
    mean, cosine, sine = smooth_turn(track.zenith[:, np.newaxis], track.phase)[:, 0]
    return float(mean if track.level else math.hypot(cosine, sine))


def _start(model: _Model) -> Doubles:
    """Return initial parameters in the approximation of small angles.

    A lean by the complex number l = tilt exp(i a) moves a ball's centre C by (C.z - pivot.z) l, and lifts it
    by the real part of -conj(C - pivot) l.
    """
    waves = [smooth_turn(track.centres, track.phase) for track in model.balls]
    places = np.array([wave[0] for wave in waves])
    across = places[:, 0] + 1j * places[:, 1]
    shifts = np.array([_circular_parts(track)[0 if model.direction > 0 else 1] for track in model.balls])
    offset = cmath.phase(shifts[np.argmax(np.abs(shifts))])
    arms = (shifts * cmath.exp(-1j * offset)).real  # tilt (C.z - pivot.z)
    lifts = np.array([wave[1, 2] - 1j * model.direction * wave[2, 2] for wave in waves])
    lifted = np.conj(lifts * cmath.exp(-1j * offset))  # -tilt (C - pivot)
    swings = [_swing(track) for track in model.plates]
    tilt = float(np.mean(swings)) if swings else _NOMINAL
    signed = _tilt_of_places(model, places, arms, lifted)
    if signed is not None and signed < 0:
        offset, arms, lifted = offset + math.pi, -arms, -lifted
    if signed is not None and not swings:
        tilt = abs(signed)
    pivot, height = np.mean(across + lifted / tilt), float(np.mean(places[:, 2] - arms / tilt))
    wedges = []
    for track in model.plates:
        if not track.level:  # its zenith is greatest when the body leans towards it
            mean, cosine, sine = smooth_turn(track.zenith[:, np.newaxis], track.phase)[:, 0]
            towards = model.direction * math.atan2(sine, cosine) + offset
            wedges += [mean * math.cos(towards), mean * math.sin(towards)]
    body = [tilt, offset, 0, 0, 0, 0, pivot.real, pivot.imag, height]
    return np.array([*body, *places.ravel(), *wedges])


def _tilt_of_places(
    model: _Model, places: Doubles, arms: Doubles, lifted: NDArray[np.complex128]
) -> float | None:
    """Return the tilt, with its sign, from the different movements of balls at different positions.

    None if it is not significant.
    """
    errors = np.array([np.nanmedian(track.sigma, axis=0) for track in model.balls])
    low = errors[:, 2] ** -2
    flat = 1 / (errors[:, 0] ** 2 + (_NOMINAL * errors[:, 2]) ** 2)
    across = places[:, 0] - 1j * places[:, 1]
    across = across - np.average(across, weights=low)
    deep = places[:, 2] - np.average(places[:, 2], weights=flat)
    lever = float(np.sum(low * np.abs(across) ** 2) + np.sum(flat * deep**2))
    moment = float(np.sum(flat * deep * arms) - np.sum(low * (lifted * across).real))
    error = math.sqrt(2 / (lever * len(model.balls[0].phase) + 1e-12))
    return moment / lever if abs(moment) > _DIRECTION * error * lever and error < _NOMINAL else None


def _mirrored(model: _Model, parameters: Doubles) -> Doubles:
    """Return the body with the opposite lean, and the pivot on the other side of the balls."""
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
    scale: Doubles  # (3,): factor of the tracks' errors, for each kind of residual


def _fit(model: _Model, start: Doubles, scale: Doubles, rounds: int) -> _Fit:
    """Fit parameters; after each round the errors of each kind are scaled by the residuals."""
    kinds = model.kinds()
    parameters = start
    for _ in range(rounds):
        error = np.concatenate([scale[kinds], np.ones(len(start))])
        solution = least_squares.fit(
            functools.partial(model.residuals, start=start), parameters, noise=error, loss=_LOSS
        )
        covariance, parameters = solution.covariance(), solution.parameters.copy()
        spread = np.einsum("nk,kl,nl->n", solution.jacobian, covariance, solution.jacobian)
        if parameters[0] < 0:  # convert to the same lean with a positive tilt
            parameters[:2] = -parameters[0], parameters[1] + math.pi
        freedom = (1 - solution.information * spread)[: len(kinds)]
        residuals = model.residuals(parameters, start)[: len(kinds)]
        before, scale = scale, _scales(residuals, freedom, kinds, scale)
        if np.allclose(before, scale, rtol=_SETTLED_CHANGE):
            break
    return _Fit(parameters, covariance, residuals, scale)


def _scales(residuals: Doubles, freedom: Doubles, kinds: NDArray[np.intp], before: Doubles) -> Doubles:
    """Return the scale of each kind of residual without outliers, (3,), at least 1."""
    scales = before.copy()
    for kind in np.unique(kinds):
        chosen = kinds == kind
        chosen &= np.abs(residuals) <= _OUTLIER_Z_SCORE * mad_sigma(residuals[chosen]) + 1e-12
        degrees = float(np.sum(freedom[chosen]))
        if degrees >= 1:
            scales[kind] = max(1.0, math.sqrt(float(np.sum(residuals[chosen] ** 2)) / degrees))
    return scales


def _residual_rms(model: _Model, parameters: Doubles) -> dict[str, float]:
    """Return the RMS of each kind of residual in its unit."""
    kinds = model.kinds()
    unweighted = model._replace(
        balls=[track._replace(sigma=np.ones_like(track.sigma)) for track in model.balls],
        plates=[track._replace(sigma=np.ones_like(track.sigma)) for track in model.plates],
    )
    residuals = unweighted.residuals(parameters, parameters)[: len(kinds)]
    names = {"place": _ACROSS, "depth": _DEPTH, "zenith": _ZENITH}
    return {
        name: float(np.sqrt(np.mean(residuals[kinds == kind] ** 2)))
        for name, kind in names.items()
        if np.any(kinds == kind)
    }


def _precession(model: _Model, fit: _Fit, notes: list[str], depth_sigma: float) -> Precession:
    """Return the precession of a fit, and add notes about undetermined parameters."""
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
    covariance = fit.covariance[2:4, 2:4]
    sigma["ellipticity"] = math.sqrt(along @ covariance @ along)
    axis_sigma = math.sqrt(across @ covariance @ across) / (2 * ellipticity) if ellipticity > 0 else math.inf
    sigma["major_axis"] = min(axis_sigma, _ANY)
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
