"""How the body's axis goes round, fitted to balls and plates."""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from mirrorskin.engine.calibration.ball import Followed, rotations, smooth_turn
from mirrorskin.engine.calibration.brightness import LinearShown, Shown
from mirrorskin.engine.calibration.tilt_tracks import BallTurn, PlateTurn, Tilts, track_ball, track_plate
from mirrorskin.engine.rotation.design_matrix import check_phases
from mirrorskin.io import InputError, Precession

Doubles = NDArray[np.float64]

NAMES = ("tilt", "phase_offset", "oval_x", "oval_y", "centre_x", "centre_y", "pivot_x", "pivot_y", "pivot_z")
"""The body's parameters, by which each vector begins; then come three of each ball, and two of each wedge."""

AWAY, DEEP, PLATE = 0, 1, 2
"""Kinds of residuals: of a ball's x and y, of its z, and of a plate's zenith."""

_HALF = 0.5  # share of the tilt that one begins with, as its standard error
_WEAK = np.array([0.0, 10.0, 1.0, 1.0, 0.2, 0.2, 1e3, 1e3, 1e3])  # no more is taken for known beforehand
_LEVEL = np.zeros(2)
_NOWHERE = 1e-9  # standard error of what is not free


@dataclass(frozen=True, slots=True, eq=False)
class BallTrack:
    """A ball's places in the frames of a turn; `phase` (T,) in radians, as the recording says."""

    phase: Doubles
    seen: Followed


@dataclass(frozen=True, slots=True, eq=False)
class PlateTrack:
    """A plate's zeniths in the frames of a turn, and whether it is level."""

    phase: Doubles
    seen: Tilts
    level: bool


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """Residuals of tracks, by the parameters of a precession of a given direction.

    The body leans by ``l = centre + tilt (u(a) + oval)`` with a = direction phase + phase_offset, u(a) =
    (cos a, sin a), and oval = (gx cos a + gy sin a, gy cos a - gx sin a), which makes an ellipse of the
    circle: (gx, gy) is the ellipticity times (cos, sin) of twice the azimuth of its major axis.
    """

    balls: Sequence[BallTrack]  # The tracks
    plates: Sequence[PlateTrack]  # The tracks
    direction: int
    free_centre: bool  # Whether the mean lean is looked for, or the mean pose taken for upright

    def lean(self, parameters: Doubles, phase: Doubles) -> Doubles:
        """Return how the body leans, (T, 2), radians."""
        tilt, offset, oval_x, oval_y, x, y = parameters[:6]
        angle = self.direction * phase + offset
        cosine, sine = np.cos(angle), np.sin(angle)
        along = x + tilt * (cosine + oval_x * cosine + oval_y * sine)
        across = y + tilt * (sine + oval_y * cosine - oval_x * sine)
        return np.stack([along, across], axis=1)

    def residuals(self, parameters: Doubles, start: Doubles) -> Doubles:
        """Return what is left, in standard errors, then how far parameters are from a start, (n,)."""
        phases = [ball.phase for ball in self.balls] + [plate.phase for plate in self.plates]
        turns = rotations(self.lean(parameters, np.concatenate(phases)))
        each = np.split(turns, np.cumsum([len(phase) for phase in phases])[:-1])
        places = parameters[len(NAMES) : len(NAMES) + 3 * len(self.balls)].reshape(-1, 3)
        left = [
            _of_ball(track, turn, place, parameters[6:9])
            for track, turn, place in zip(self.balls, each, places, strict=False)
        ]
        wedges = iter(parameters[len(NAMES) + places.size :].reshape(-1, 2))
        for track, turn in zip(self.plates, each[len(self.balls) :], strict=True):
            left.append(_of_plate(track, turn, _LEVEL if track.level else next(wedges)))
        weak = np.full(len(parameters), 1e3)
        weak[: len(_WEAK)] = _WEAK
        weak[0] = _HALF * start[0]
        if not self.free_centre:
            weak[4:6] = _NOWHERE
        return np.concatenate([*left, (parameters - start) / weak])

    def kinds(self) -> NDArray[np.intp]:
        """Return of which kind the residuals are that come before the parameters', (n,)."""
        kinds: list[NDArray[np.intp]] = []
        for track in self.balls:
            known = int(np.isfinite(track.seen.centres[:, 0]).sum())
            kinds.append(np.tile([AWAY, AWAY, DEEP], known))
        kinds += [np.full(len(track.phase), PLATE) for track in self.plates]
        return np.concatenate(kinds)


def _of_ball(track: BallTrack, turns: Doubles, place: Doubles, pivot: Doubles) -> Doubles:
    """Return what is left of a ball's places, in standard errors."""
    left = (track.seen.centres - pivot - turns @ (place - pivot)) / track.seen.sigma
    return np.asarray(left[np.isfinite(left[:, 0])].ravel())


def _of_plate(track: PlateTrack, turns: Doubles, inclined: Doubles) -> Doubles:
    """Return what is left of a plate's zeniths, in standard errors."""
    # A body that leans by l sees an upright normal as one that is inclined by |l| towards l.
    normal = turns @ rotations(inclined[np.newaxis])[0, :, 2]
    zenith = np.arctan2(np.sqrt(normal[:, 0] ** 2 + normal[:, 1] ** 2), normal[:, 2])
    return np.asarray((track.seen.zenith - zenith) / track.seen.sigma)


_NOMINAL = math.radians(2.5)  # where a tilt that nothing tells at first is looked for
_PHASES = 4  # that an ellipse and its mean need, at least
_SAME = 1e-6  # radians
_ROUNDS = 5  # of the fit, each with the errors that the one before left
_STRAY = 3.0  # standard errors from which on a residual counts less
_STEPS = 40  # of a fit, at most
_TOLD = 16.0  # by which chi^2 must be better for one of two answers to be it
_TURNS = 5.0  # standard errors by which a ball must go round one way more than the other
_VAGUE_TILT = 0.1  # share of itself
_VAGUE_PHASE = math.radians(5.0)
_VAGUE_PIVOT = 3.0  # mm
_NO_LEVER = 1e-12
_ALIKE = 0.03  # share by which errors may still change
_BEYOND = 5.0  # standard deviations from which on a residual strays
_MEDIAN = 1.4826  # standard deviations of a normal variate, of its median magnitude
_STILL = (
    "the ball hardly moves in the picture: its centre is too near to the point that the body turns about to"
    " tell phases; take a smaller or a larger one"
)
_ANY = math.pi / math.sqrt(12)  # standard deviation of an axis that may lie anyhow
_SCALES = (1e-3, 1e-2, 1e-3, 1e-3, 1e-3, 1e-3, 0.1, 0.1, 0.1)


@dataclass(frozen=True, slots=True, eq=False)
class Study:
    """A precession, and how it was found.

    Attributes
    ----------
    precession : Precession
    left : mapping of str to float
        RMS of what the fit leaves: ``place`` and ``depth`` of balls, mm, and ``zenith`` of plates, radians.
    notes : tuple of str
        What was taken for granted, and what is not known; sentences.
    """

    precession: Precession
    left: dict[str, float]
    notes: tuple[str, ...]


def fit_precession(turns: Iterable[BallTurn | PlateTurn], shown: Shown) -> Precession:
    """Find out how the body leans with the phase, and about which point; see `study_precession`."""
    return study_precession(turns, shown).precession


def study_precession(turns: Iterable[BallTurn | PlateTurn], shown: Shown) -> Study:
    """Find out how the body leans with the phase, and about which point.

    A ball looks the same however it is turned. So its pictures tell where its centre is in each frame and no
    more: it goes round by the tilt times its distance from the pivot's height, and up and down by the tilt
    times its distance from the pivot across the axis. One ball at one place does not tell the tilt from the
    distances; a level plate, which shows its lean as zenith, or a wedge, whose zenith goes up and down by the
    tilt, tells it, and so do balls at different places or of different sizes. One ball and plates leave open
    whether the body leans to one side with the pivot above, or to the other with the pivot below: then the
    phase's offset is taken to be within 90 degrees of 0. Without a level plate nothing tells the mean lean:
    the mean pose is taken for upright.

    Places and zeniths are measured frame by frame (`track_ball`, `track_plate`) and the parameters then
    fitted to them by weighted least squares. Standard errors are those of what the fit leaves over; that of
    the pivot's height includes what the response may be wrong by in all depths.

    Parameters
    ----------
    turns : iterable of BallTurn and PlateTurn
        One ball at least; see `read_ball` and `read_plate`. One is held at a time if they come as they are
        asked for.
    shown : Shown
        How bright which normal looks.

    Returns
    -------
    Study

    Raises
    ------
    InputError
        Tilt or phase are not determined by these turns, or a ball or plate is not seen. A pivot that is not
        determined is NaN.
    """
    study = study_tracks(*_tracks(turns, shown))
    sigma = dict(study.precession.sigma)
    sigma["pivot_z"] = math.hypot(sigma["pivot_z"], shown.depth_sigma)
    return replace(study, precession=replace(study.precession, sigma=sigma))


def study_tracks(balls: Sequence[BallTrack], plates: Sequence[PlateTrack]) -> Study:
    """Fit a precession to what was measured of balls and plates; see `study_precession`."""
    _check_determined(balls, plates)
    direction = _direction(balls)
    free_centre = any(track.level for track in plates)
    model = Model(balls, plates, direction, free_centre)
    kinds = model.kinds()
    best = _fit(model, _start(model), np.ones(3), _ROUNDS)
    mirrored = _fit(model, _mirrored(model, best.parameters), best.scale, 1)
    half_a_turn = abs(math.remainder(mirrored.parameters[1] - best.parameters[1], math.tau)) > math.pi / 2
    notes = []
    worse = float(
        np.sum((mirrored.residuals / best.scale[kinds]) ** 2)
        - np.sum((best.residuals / best.scale[kinds]) ** 2)
    )
    if half_a_turn and worse < _TOLD:
        best = min(best, mirrored, key=lambda fit: abs(math.remainder(fit.parameters[1], math.tau)))
        notes.append("the phase offset is taken to be within 90 deg of 0: a ball at another place would tell")
    if not free_centre:
        notes.append("the mean pose is taken for upright: a level plate would tell the mean lean")
    return _told(model, best, notes)


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """Parameters, their covariance, the residuals, and by what each kind of them is larger than told."""

    parameters: Doubles
    covariance: Doubles
    residuals: Doubles
    scale: Doubles


def _tracks(turns: Iterable[BallTurn | PlateTurn], shown: Shown) -> tuple[list[BallTrack], list[PlateTrack]]:
    """Measure all frames."""
    balls: list[BallTrack] = []
    plates: list[PlateTrack] = []
    for turn in turns:
        phase = check_phases(turn.phase)
        different = len(np.unique(np.round(np.mod(phase, math.tau) / _SAME)))
        if different < _PHASES:
            raise InputError(f"{turn.name}: {different} different phases, at least {_PHASES} are needed")
        if isinstance(turn, BallTurn):
            balls.append(BallTrack(phase, track_ball(turn, shown)))
        elif isinstance(shown, LinearShown):
            plates.append(PlateTrack(phase, track_plate(turn, shown), turn.level))
        else:
            raise InputError(
                f"{turn.name}: a plate tells its zenith only where brightness is linear in it:"
                " give the zenith gain and offset, or take balls at several places"
            )
    return balls, plates


def _check_determined(balls: Sequence[BallTrack], plates: Sequence[PlateTrack]) -> None:
    """Make sure that there is a ball."""
    if not balls:
        swing = max((_swing(track)[1] for track in plates), default=math.nan)
        told = (
            f"a flat tells the half-angle ({math.degrees(swing):.3f} deg)" if plates else "nothing is given"
        )
        raise InputError(f"{told}, but neither phases nor direction nor pivot: add a turn on a ball")


def _direction(balls: Sequence[BallTrack]) -> int:
    """Tell which way balls go round: as the phase does, or the other way."""
    told = 0.0
    for track in balls:
        forth, back, error = _goes_round(track)
        told += (abs(forth) ** 2 - abs(back) ** 2) / error**2
    if abs(told) < _TURNS**2:
        raise InputError(_STILL)
    return 1 if told > 0 else -1


def _goes_round(track: BallTrack) -> tuple[complex, complex, float]:
    """Return the parts of a ball's way that go round with the phase and against it, mm, and their error."""
    _, cosine, sine = smooth_turn(track.seen.centres[:, :2], track.phase) @ (1, 1j)
    error = float(np.nanmedian(track.seen.sigma[:, :2])) / math.sqrt(len(track.phase))
    return (cosine - 1j * sine) / 2, (cosine + 1j * sine) / 2, error


def _swing(track: PlateTrack) -> tuple[float, float]:
    """Return a plate's mean zenith and, nearly, the tilt that it tells, radians."""
    mean, cosine, sine = smooth_turn(track.seen.zenith[:, np.newaxis], track.phase)[:, 0]
    return float(mean), float(mean if track.level else math.hypot(cosine, sine))


def _start(model: Model) -> Doubles:
    """Return parameters to begin with: those of small angles.

    A lean by the complex number tilt exp(i a) moves a ball's centre C by (C.z - pivot.z) times that, and
    lifts it by the real part of -conj(C - pivot) times that.
    """
    waves = [smooth_turn(track.seen.centres, track.phase) for track in model.balls]
    places = np.array([wave[0] for wave in waves])
    across = places[:, 0] + 1j * places[:, 1]
    ways = np.array([_goes_round(track)[0 if model.direction > 0 else 1] for track in model.balls])
    offset = cmath.phase(ways[np.argmax(np.abs(ways))])
    arms = (ways * cmath.exp(-1j * offset)).real  # tilt (C.z - pivot.z)
    lifts = np.array([wave[1, 2] - 1j * model.direction * wave[2, 2] for wave in waves])
    lifted = np.conj(lifts * cmath.exp(-1j * offset))  # -tilt (C - pivot)
    swings = [_swing(track)[1] for track in model.plates]
    tilt, found = float(np.mean(swings)) if swings else _NOMINAL, _differing(model, places, arms, lifted)
    if found is not None and found < 0:
        offset, arms, lifted = offset + math.pi, -arms, -lifted
    if found is not None and not swings:
        tilt = abs(found)
    pivot, height = np.mean(across + lifted / tilt), float(np.mean(places[:, 2] - arms / tilt))
    wedges = [_wedge(track, model.direction, offset) for track in model.plates if not track.level]
    known = [tilt, offset, 0, 0, 0, 0, pivot.real, pivot.imag, height]
    return np.array([*known, *places.ravel(), *np.ravel(wedges)])


def _differing(model: Model, places: Doubles, arms: Doubles, lifted: NDArray[np.complex128]) -> float | None:
    """Return the tilt, of either sign, by which balls at different places move differently, if it is told."""
    errors = np.array([np.nanmedian(track.seen.sigma, axis=0) for track in model.balls])
    low = errors[:, 2] ** -2
    flat = 1 / (errors[:, 0] ** 2 + (_NOMINAL * errors[:, 2]) ** 2)
    across = places[:, 0] - 1j * places[:, 1]
    across = across - np.average(across, weights=low)
    deep = places[:, 2] - np.average(places[:, 2], weights=flat)
    lever = float(np.sum(low * np.abs(across) ** 2) + np.sum(flat * deep**2))
    told = float(np.sum(flat * deep * arms) - np.sum(low * (lifted * across).real))
    error = math.sqrt(2 / (lever * len(model.balls[0].phase) + _NO_LEVER))
    return told / lever if abs(told) > _TURNS * error * lever and error < _NOMINAL else None


def _wedge(track: PlateTrack, direction: int, offset: float) -> tuple[float, float]:
    """Return a wedge's zenith along x and y, radians: its wave is greatest as the body leans towards it."""
    mean, cosine, sine = smooth_turn(track.seen.zenith[:, np.newaxis], track.phase)[:, 0]
    towards = direction * math.atan2(sine, cosine) + offset
    return mean * math.cos(towards), mean * math.sin(towards)


def _mirrored(model: Model, parameters: Doubles) -> Doubles:
    """Return the body that leans the other way, about a pivot on the other side of the balls."""
    first = len(NAMES)
    balls = parameters[first : first + 3 * len(model.balls)].reshape(-1, 3)
    mirrored = parameters.copy()
    mirrored[1] += math.pi
    mirrored[6:9] = 2 * balls.mean(axis=0) - parameters[6:9]
    mirrored[4:6] *= -1
    mirrored[first + balls.size :] *= -1
    return mirrored


def _fit(model: Model, start: Doubles, scale: Doubles, rounds: int) -> _Fit:
    """Fit parameters; from round to round the residuals tell their own errors, kind by kind."""
    kinds = model.kinds()
    steps = np.concatenate([_SCALES, np.full(len(start) - len(_SCALES), 1e-2)])
    parameters = start
    for _ in range(rounds):
        found = least_squares(
            _weighted,
            parameters,
            x_scale=steps,
            loss="soft_l1",
            f_scale=_STRAY,
            max_nfev=_STEPS,
            args=(model, start, np.concatenate([scale[kinds], np.ones(len(start))])),
        )
        parameters = _upright(found.x)
        jacobian = found.jac * steps
        _, values, ways = np.linalg.svd(jacobian, full_matrices=False)
        spread = ways.T / values
        free = 1 - np.sum((jacobian @ spread) ** 2, axis=1)[: len(kinds)]
        left = model.residuals(parameters, start)[: len(kinds)]
        before, scale = scale, _spreads(left, free, kinds, scale)
        if np.allclose(before, scale, rtol=_ALIKE):
            break
    covariance = (spread @ spread.T) * np.outer(steps, steps)
    return _Fit(parameters, covariance, left, scale)


def _upright(parameters: Doubles) -> Doubles:
    """Return the same with a tilt above 0."""
    if parameters[0] >= 0:
        return parameters
    same = parameters.copy()
    same[0], same[1] = -parameters[0], parameters[1] + math.pi
    return same


def _weighted(parameters: Doubles, model: Model, start: Doubles, error: Doubles) -> Doubles:
    return model.residuals(parameters, start) / error


def _spreads(left: Doubles, free: Doubles, kinds: NDArray[np.intp], known: Doubles) -> Doubles:
    """Return by what the errors of each kind of residual are larger than told, (3,); never smaller.

    Left out is what strays.
    """
    spreads = known.copy()
    for kind in (AWAY, DEEP, PLATE):
        mine = kinds == kind
        if not mine.any():
            continue
        size = np.abs(left)
        kept = mine & (size <= _BEYOND * _MEDIAN * float(np.median(size[mine])) + 1e-12)
        spare = float(np.sum(free[kept]))
        if spare >= 1:
            spreads[kind] = max(1.0, math.sqrt(float(np.sum(left[kept] ** 2)) / spare))
    return spreads


def _left_over(model: Model, parameters: Doubles) -> dict[str, float]:
    """Return the RMS of each kind of residual in its own unit."""
    plain = replace(
        model,
        balls=[BallTrack(track.phase, track.seen.with_sigma(1.0)) for track in model.balls],
        plates=[PlateTrack(track.phase, track.seen.with_sigma(1.0), track.level) for track in model.plates],
    )
    left, kinds = plain.residuals(parameters, parameters), model.kinds()
    names = {AWAY: "place", DEEP: "depth", PLATE: "zenith"}
    here = {name: left[: len(kinds)][kinds == kind] for kind, name in names.items()}
    return {name: float(np.sqrt(np.mean(values**2))) for name, values in here.items() if values.size}


def _told(model: Model, fit: _Fit, notes: list[str]) -> Study:
    """Put a precession together from what a fit determines, or raise InputError."""
    tilt, offset, oval_x, oval_y, *rest = (float(value) for value in fit.parameters[: len(NAMES)])
    errors = np.sqrt(np.diag(fit.covariance))
    sigma = {name: float(error) for name, error in zip(NAMES, errors, strict=False)}
    _check_told(tilt, sigma)
    oval = np.array([oval_x, oval_y])
    ellipticity = float(np.hypot(*oval))
    along = oval / ellipticity if ellipticity > 0 else np.array([1.0, 0.0])
    ovals = fit.covariance[2:4, 2:4]
    sigma["ellipticity"] = math.sqrt(along @ ovals @ along)
    across = math.sqrt(along[::-1] * (-1, 1) @ ovals @ (along[::-1] * (-1, 1)))
    sigma["major_axis"] = min(across / (2 * ellipticity) if ellipticity > 0 else math.inf, _ANY)
    for name in ("oval_x", "oval_y", *(() if model.free_centre else ("centre_x", "centre_y"))):
        del sigma[name]
    pivot = rest[2:5]
    for number, axis in enumerate("xyz"):
        if sigma[f"pivot_{axis}"] > _VAGUE_PIVOT:
            pivot[number] = sigma[f"pivot_{axis}"] = math.nan
            notes.append(f"the pivot's {axis} is not determined")
    precession = Precession(
        tilt=tilt,
        phase_offset=math.remainder(offset, math.tau),
        direction=model.direction,
        ellipticity=ellipticity,
        major_axis=math.atan2(oval_y, oval_x) / 2,
        centre=(rest[0], rest[1]) if model.free_centre else (0.0, 0.0),
        pivot=(pivot[0], pivot[1], pivot[2]),
        sigma=sigma,
    )
    return Study(precession, _left_over(model, fit.parameters), tuple(notes))


def _check_told(tilt: float, sigma: dict[str, float]) -> None:
    """Raise InputError where tilt or phase are not determined."""
    if sigma["tilt"] > _VAGUE_TILT * abs(tilt):
        raise InputError(
            "the half-angle is not determined: a ball at one place tells only its product with the distance"
            " from the pivot; add a turn on a flat plate, or on the ball at other places"
        )
    if sigma["phase_offset"] > _VAGUE_PHASE:
        raise InputError(_STILL)
