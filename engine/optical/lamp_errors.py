"""Errors of normals from lamps because of the light and the camera, as the residuals of all lamps show them.

Gamma, an offset and its drift, and a gain of each frame change the brightness of all pixels. They are fitted
together, with priors, to the residuals of a grid of pixels. What they do to normals and albedo, and the
covariance of the fit, are added to the standard errors. What they do not explain, such as gloss, is smooth
over the directions of lamps: its size is that of the part of the residuals that is quadratic in them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.base.device_arrays import stored_map
from mirrorskin.engine.base.frames import noise_of_residual, take_places
from mirrorskin.engine.base.steps import Context, Step
from mirrorskin.engine.diagnosis.amplitude_blur import GRID_LINES, find_blur
from mirrorskin.io import Header, Result
from mirrorskin.io.base.findings import Finding, with_findings
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.numerics.least_squares import CLEAR_Z_SCORE, fit_clipped, gram, mad_sigma

if TYPE_CHECKING:
    from mirrorskin.engine.optical.photometric import PhotometricStereo

GAMMA, FRAME_GAIN = (Header("axial").prior(name) for name in ("gamma_sigma", "frame_gain_sigma"))
"""Standard deviations of gamma, and of a frame's gain."""
OFFSET = 0.5 / 255
"""Standard deviation of the offset and of its drift, as a share of the light."""
CELLS = 18
"""Number of cells of a table over the normal's x, and y, from -1 to 1."""

_MIN_PIXELS, _MIN_LAMPS = 64, 5  # that decide
_MAX_SIZE = 4_000_000  # elements of the equations of all pixels
_LEAST_NOISE = 1e-6  # over the light
_ITERATIONS = 4
_GRAZING = 0.1  # cosine of the angle of a lamp below which a pixel may be partly in shadow
_LEAST_PIVOT = 1e-5  # eigenvalue of the lamps' products, relative to the largest, of lamps in a plane
_OUTLYING = 4.0  # residuals of excluded pixels, times the median
_POWER, _STRAY = 0.03, 0.02  # least change of gamma, and of the offset as a share of the light, to report
_NEGLIGIBLE, _DOUBLED = 0.1, 3.0  # variances, divided by that of noise, to leave out, and to report
_SMOOTH = 0.15  # standard deviation over which the misfit is averaged, in components of the normal
_LEAK = 3.0  # variance of a misfit that looks like a normal, over that of its quadratic part
_COLUMNS = 3  # of the equations before those of gains: offset, drift, gamma
_UNIFORM = 2.0  # largest spread of a uniform albedo, standard errors
_POWERS = 0.3, 3.0  # of the light, that a response may have
_CLEARER = 1.02  # least ratio of the spreads of albedos by two explanations
_SIDE_Z_SCORE = 2.0  # standard errors from which on a side of the picture shows stray light


class LampErrors(Step):
    """Report the errors of the light and of the response that are part of the standard errors, or beyond."""

    needs = ("normals", "normals_sigma", "albedo")

    def apply(self, result: Result, context: Context) -> Result:
        """Return the result with findings, if frames show errors."""
        fit = cast("PhotometricStereo", context.operation).lamp_fit
        return result if fit is None else with_findings(result, *fit.findings(), *_stray_light(result, fit))


@dataclass(frozen=True, slots=True)
class LampFit:
    """Errors of the light and of the response, and what they do not explain.

    Attributes
    ----------
    lamps : ndarray, (T, 3)
    noise : float
        Standard deviation of a sample, counts, without these errors.
    reference : float
        Light at which gamma changes nothing, counts.
    error, covariance : ndarray, (3 + T,) and (3 + T, 3 + T)
        Offset, drift of the offset over all frames, counts; gamma - 1; gain of each frame - 1.
    vectors : ndarray, (n, 3)
        Normals times albedo, of the pixels used.
    ratio : ndarray, (n,)
        Variance of the normals because of errors, divided by that because of noise.
    misfit : ndarray, (n,)
        Variance of the residuals' part that is quadratic in the directions of lamps, without noise, counts^2.
    """

    lamps: Doubles
    noise: float
    reference: float
    error: Doubles
    covariance: Doubles
    vectors: Doubles
    ratio: Doubles
    misfit: Doubles

    @property
    def light(self) -> float:
        """Median albedo, counts."""
        return float(np.median(np.linalg.norm(self.vectors, axis=1)))

    @property
    def significant(self) -> bool:
        """Whether errors are not small against noise."""
        return float(np.mean(self.ratio)) > _NEGLIGIBLE or bool(self.misfit.any())

    def findings(self) -> Iterator[Finding]:
        """Yield what the residuals show."""
        error, sigma = self.error, np.sqrt(np.diag(self.covariance))
        clear = np.abs(error) > CLEAR_Z_SCORE * sigma
        light = self.light
        power = 1 + float(error[2])
        if clear[2] and not _POWERS[0] < power < _POWERS[1]:
            yield Finding(
                "not matt",
                "the brightness is not that of a matt surface under these lamps: are their directions and"
                " dark as stated?",
            )
        elif clear[2] and abs(power - 1) > _POWER:
            yield Finding(
                "response",
                f"the brightness is not proportional to the light, but to its power {power:.3g}, as with"
                " gamma (or gloss), so normals are wrong, and their sigma includes it: use a camera with a"
                " linear response",
            )
        texts = []
        gains = error[_COLUMNS:] - np.mean(error[_COLUMNS:])
        if clear[_COLUMNS:].any() and (change := float(np.std(gains))) > 2 * FRAME_GAIN:
            texts.append(f"the brightness of lamps differs by {100 * change:.2g} % from what is stated")
        if clear[0] and abs(error[0]) > _STRAY * light:
            texts.append(f"the dark level is {error[0]:.2g} counts higher than stated, as with stray light")
        if clear[1] and abs(error[1]) > _STRAY * light:
            texts.append(f"the dark level drifts by {error[1]:.2g} counts")
        if texts:
            yield Finding("lamps", f"{' and '.join(texts)}; the errors of normals include it", False)
        if np.mean(_LEAK * self.misfit > _DOUBLED * self.noise**2) > _NEGLIGIBLE:
            yield Finding(
                "not matt",
                f"the brightness differs by {math.sqrt(np.mean(self.misfit)):.2g} counts from that of a matt"
                " surface, as with gloss or light from other parts of it: normals may be wrong by more than"
                " their sigma",
            )

    def tables(self, shadow: float) -> Doubles:
        """Return variances because of errors, by the normal; see `kernels.optical.lambert.lambert_widen`."""
        axis = np.linspace(-1, 1, CELLS + 1)
        x, y = (part.ravel() for part in np.meshgrid(axis, axis, indexing="ij"))
        z = np.sqrt(np.maximum(1 - x * x - y * y, 0.01))
        normals = np.stack([x, y, z], axis=1)
        length = np.linalg.norm(self.vectors, axis=1)
        albedo = float(np.median(length))
        light = albedo * (normals @ self.lamps.T).T
        solved = _solved(light, light > max(shadow, 1e-3 * albedo), self.lamps)
        effects = solved.effects(light, self.reference) / albedo  # for 1 as albedo, but for the first two
        effects[:, :, :2] *= albedo
        normal, radial = _parts(effects, normals)
        second = self.covariance + np.outer(self.error, self.error)
        faces = self.vectors / length[:, np.newaxis]
        across, down = (np.exp(-0.5 * ((faces[:, k, np.newaxis] - axis) / _SMOOTH) ** 2) for k in (0, 1))
        total = across.T @ down
        misfit = ((across * self.misfit[:, np.newaxis]).T @ down / np.maximum(total, 1e-30)).ravel()
        split = np.zeros((3, len(second), len(second)))
        split[0, 2:, 2:], split[2, :2, :2] = second[2:, 2:], second[:2, :2]
        split[1, :2, 2:], split[1, 2:, :2] = second[:2, 2:], second[2:, :2]
        parts = [np.einsum("nik,kl,nil->n", part, each, part) for part in (normal, radial) for each in split]
        return np.asarray(np.nan_to_num([*parts, _LEAK * misfit]))


@dataclass(frozen=True, slots=True)
class _Solved:
    """Least squares of pixels: (n, 3, 3) inverses, usable samples (n, T), and vectors, (n, 3)."""

    inverse: Doubles
    weights: Doubles
    lamps: Doubles
    vectors: Doubles

    def effects(self, light: Doubles, reference: float) -> Doubles:
        """Return derivatives of the vectors by the errors, (n, 3, 3 + T)."""
        return np.asarray(self.inverse @ (self.lamps.T @ self.columns(light, reference)))

    def columns(self, light: Doubles, reference: float) -> Doubles:
        """Return derivatives of usable samples by the errors, (n, T, 3 + T); light is (T, n)."""
        count, pixels = light.shape
        x = np.maximum(light.T, 1e-9)
        columns = np.empty((pixels, count, _COLUMNS + count))
        columns[:, :, 0] = 1
        columns[:, :, 1] = np.linspace(-0.5, 0.5, count)
        columns[:, :, 2] = x * np.log(x / reference)
        columns[:, :, _COLUMNS:] = x[:, :, np.newaxis] * np.eye(count)
        return columns * self.weights[:, :, np.newaxis]

    def residual(self, values: Doubles) -> Doubles:
        """Return what does not look like a vector in usable values, (n, T, ...), that are 0 elsewhere."""
        vectors = self.inverse @ (self.lamps.T @ values)
        return np.asarray(values - (self.lamps @ vectors) * self.weights[:, :, np.newaxis])


def _solved(light: Doubles, usable: NDArray[np.bool_], lamps: Doubles) -> _Solved:
    weights = usable.T.astype(np.float64)
    products = (lamps[:, :, np.newaxis] * lamps[:, np.newaxis]).reshape(len(lamps), 9)
    matrix = (weights @ products).reshape(-1, 3, 3)
    values, axes = np.linalg.eigh(matrix)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverted = np.where(values[:, :1] > _LEAST_PIVOT * values[:, -1:], 1 / values, np.nan)
    inverse = (axes * inverted[:, np.newaxis]) @ axes.swapaxes(1, 2)
    vectors = (inverse @ (lamps.T @ np.where(usable, light, 0)).T[..., np.newaxis])[..., 0]
    return _Solved(inverse, weights, lamps, vectors)


def _parts(effects: Doubles, normals: Doubles) -> tuple[Doubles, Doubles]:
    """Return the parts of effects on vectors, (n, 3, m), across normals, and along them, (n, 1, m)."""
    along = np.einsum("ni,nim->nm", normals, effects)[:, np.newaxis]
    return effects - normals[:, :, np.newaxis] * along, along


def find_lamp_errors(
    light: Doubles, usable: NDArray[np.bool_], lamps: Doubles, limits: tuple[ArrayLike, ArrayLike]
) -> LampFit | None:
    """Fit the errors to the residuals of pixels; None if they are too few, or lamps leave no residual.

    ``light``, (T, n), is brightness less dark; ``lamps`` are vectors, (T, 3); ``limits`` are those of usable
    light.
    """
    count = len(lamps)
    most = _MAX_SIZE // (count * (count + _COLUMNS))
    freedom = usable.sum(axis=0) - 3
    chosen = np.flatnonzero((freedom > 0) & (freedom >= np.max(freedom, initial=0) // 2))
    if min(most, len(chosen)) < _MIN_PIXELS or count < _MIN_LAMPS:
        return None
    chosen = chosen[:: -(-len(chosen) // most)]
    light, usable = light[:, chosen], usable[:, chosen]
    low, high = (np.broadcast_to(limit, freedom.shape)[chosen] for limit in limits)
    for last in (False, True):
        solved = _solved(light, usable, lamps)
        fitted = lamps @ solved.vectors.T
        residual = solved.residual(np.where(usable, light, 0).T[..., np.newaxis])[..., 0]
        freedom = usable.sum(axis=0) - 3
        with np.errstate(invalid="ignore", divide="ignore"):
            square = np.sum(residual**2, axis=1) / np.where(freedom > 0, freedom, np.nan)
            good = np.isfinite(square) & np.all((fitted > 0) | ~usable, axis=0)
        if np.count_nonzero(good) < _MIN_PIXELS:
            return None
        if not last:  # a limit of noisy samples would select those with one sign of the noise
            margin = _OUTLYING * math.sqrt(float(np.median(square[good])))
            dim = _GRAZING * np.linalg.norm(solved.vectors, axis=1)
            usable = usable & (fitted > np.maximum(low + margin, dim)) & (fitted < high - margin)
    good &= square <= _OUTLYING**2 * float(np.median(square[good]))
    parts = (part[good] for part in (solved.inverse, solved.weights, solved.vectors))
    inverse, weights, vectors = parts
    solved = _Solved(inverse, weights, lamps, vectors)
    light, residual, freedom = fitted[:, good], residual[good], freedom[good]
    top, reference = float(np.max(light)), float(np.mean(light))
    apparent = solved.residual(solved.columns(light, reference))
    sigma = np.concatenate([[OFFSET * top, OFFSET * top, GAMMA], np.full(count, FRAME_GAIN)])
    error, covariance, left = _map_estimate(residual, apparent, freedom, sigma)
    noise, misfit = _misfit(left, solved, freedom)
    if np.mean(misfit) > noise**2:  # gloss looks like gamma, but it is not
        sigma[2] = GAMMA / 100
        error, covariance, left = _map_estimate(residual, apparent, freedom, sigma)
        noise, misfit = _misfit(left, solved, freedom)
    # A drift is seen, but not at which frame dark was right.
    covariance[0, 0] += error[1] ** 2 / 4
    normals = solved.vectors / np.linalg.norm(solved.vectors, axis=1)[:, np.newaxis]
    across, _ = _parts(solved.effects(light, reference), normals)
    second = covariance + np.outer(error, error)
    by_noise, _ = _parts(solved.inverse, normals)
    ratio = np.einsum("nik,kl,nil->n", across, second, across)
    ratio /= noise**2 * np.trace(by_noise, axis1=1, axis2=2)
    return LampFit(lamps, noise, reference, error, covariance, solved.vectors, ratio, misfit)


def _map_estimate(
    residual: Doubles, apparent: Doubles, freedom: NDArray[np.intp], sigma: Doubles
) -> tuple[Doubles, Doubles, Doubles]:
    """Return errors with standard deviations ``sigma``, their covariance, and the residuals without them.

    Their derivatives of residuals, (n, T), are ``apparent``, (n, T, k).
    """
    flat = apparent.reshape(-1, apparent.shape[-1])
    matrix, right = flat.T @ flat, flat.T @ residual.ravel()
    left = residual
    for _ in range(_ITERATIONS):  # at first, the noise includes the errors
        rms = np.sqrt(np.sum(left**2, axis=1) / freedom)
        noise = max(noise_of_residual(rms, freedom), _LEAST_NOISE * float(np.abs(apparent).max()))
        covariance = np.linalg.inv(matrix / noise**2 + np.diag(1 / sigma**2))
        error = covariance @ right / noise**2
        left = residual - apparent @ error
        sigma = np.maximum(sigma, np.abs(error))  # a prior that is contradicted is not one
    return error, np.asarray(covariance, np.float64), left


def _misfit(left: Doubles, solved: _Solved, freedom: NDArray[np.intp]) -> tuple[float, Doubles]:
    """Return the noise, and the variance of residuals, (n, T), that is quadratic in the lamps' directions.

    The noise is that of the rest of the residuals. The variance of pixels, (n,), is averaged over pixels that
    face alike; 0 if it is not significant.
    """
    square, none = np.sum(left**2, axis=1), np.zeros(len(left))
    noise = noise_of_residual(np.sqrt(square / freedom), freedom)
    x, y, z = (solved.lamps / np.linalg.norm(solved.lamps, axis=1)[:, np.newaxis]).T
    products = np.stack([x * x, x * y, y * y, x * z, y * z, z * z], axis=1)
    plain = np.linalg.qr(solved.lamps)[0]
    axes, size, _ = np.linalg.svd(products - plain @ (plain.T @ products), full_matrices=False)
    axes = axes[:, size > 0.02 * float(np.linalg.norm(products))]
    number = axes.shape[1]
    whole = solved.weights.all(axis=1)
    if not number or len(solved.lamps) - 3 - number < 2 or np.count_nonzero(whole) < _MIN_PIXELS:
        return noise, none
    low = np.sum((left @ axes) ** 2, axis=1)
    rest = np.sqrt(np.maximum(square - low, 0) / np.maximum(freedom - number, 1))
    noise = noise_of_residual(rest[whole], freedom[whole] - number)
    usual = whole & (square / freedom <= _OUTLYING**2 * float(np.median(square / freedom)))
    faces = solved.vectors[:, :2] / np.linalg.norm(solved.vectors, axis=1)[:, np.newaxis]
    apart = np.sum((faces[:, np.newaxis] - faces) ** 2, axis=2)
    near = np.exp(-0.5 * apart / _SMOOTH**2) * usual
    total = near.sum(axis=1)
    mean = near @ (low / number - noise**2) / total
    error = math.sqrt(2 / number) * noise**2 * np.sqrt(np.sum(near**2, axis=1)) / total
    return noise, np.where(mean > CLEAR_Z_SCORE * error, mean, 0)


def _stray_light(result: Result, fit: LampFit) -> Iterator[Finding]:
    """Yield a finding if the albedo depends on the normal as it does with an offset of the brightness.

    Stray light is a share of the mean brightness of each frame, and so adds that share of the mean vector to
    all vectors, without a residual. The albedo changes with the normal then, on all sides of the picture.
    """
    rows, columns = result.albedo.shape
    if min(rows, columns) < 3:
        return
    thin = max(1, math.isqrt(rows * columns) // GRID_LINES)
    down, right = range(1, rows - 1, thin), range(1, columns - 1, thin)
    maps = [stored_map(result, name) for name in ("normals", "albedo", "albedo_sigma")]
    places = [(0, 0), (0, 1), (0, -1), (1, 0), (-1, 0)]
    faces, [albedo, *_], [sigma, *_] = take_places(maps, down, right, places)
    normal, east, west, south, north = (part.astype(np.float64) for part in faces)
    bend = np.sum((east - west) ** 2 + (south - north) ** 2, axis=0)
    usable = np.isfinite(normal).all(axis=0) & np.isfinite(bend) & (albedo > 0)
    if np.count_nonzero(usable) < _MIN_PIXELS:
        return
    axes = (np.linspace(-1, 1, length) for length in usable.shape)
    y, x = (part[usable] for part in np.meshgrid(*axes, indexing="ij"))
    size = albedo[usable].astype(np.float64)
    dependence = _Dependence(fit, normal[:, usable], size, x, y)
    offset, error, spread = dependence.offset(np.isfinite(size))
    clear = abs(offset) > max(CLEAR_Z_SCORE * error, _STRAY * float(np.median(size)))
    if not clear or spread > _UNIFORM * float(np.median(sigma[usable] / size)):
        return  # a print may depend on the normal by chance
    if find_blur(maps[:1], maps[1]) > 0:
        of_blur = fit_clipped(np.column_stack([bend[usable], dependence.place]), np.log(size))
        if of_blur is None or mad_sigma(of_blur.residuals) < _CLEARER * spread:
            return  # a lens that blurs explains it as well
    sides = map(dependence.offset, (x < 0, x >= 0, y < 0, y >= 0))
    if all(
        side * np.sign(offset) > max(abs(offset) / 3, _SIDE_Z_SCORE * its_error)
        for side, its_error, _ in sides
    ):
        yield Finding(
            "stray light",
            f"the albedo depends on the normal as if {offset:.2g} counts of stray light were everywhere (or"
            " as with gloss or gamma), so normals may be wrong by more than their sigma: keep stray light"
            " away, or include it in dark",
        )


def _without(columns: Doubles, values: Doubles) -> Doubles:
    """Return values, (n,), less their fit by columns, (n, k)."""
    fit = np.linalg.solve(gram(columns), np.einsum("ni,n->i", columns, values))
    return np.asarray(values - np.einsum("ni,i->n", columns, fit))


class _Dependence:
    """How the logarithm of the albedo of some pixels, (n,), depends on their normals, (3, n)."""

    def __init__(self, fit: LampFit, normals: Doubles, albedo: Doubles, x: Doubles, y: Doubles) -> None:
        self.place: Doubles = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
        self._values, self._light = np.log(albedo), float(np.median(albedo))
        mean = np.mean(fit.vectors, axis=0)
        axis = mean / np.mean(fit.lamps @ mean)
        self._along: Doubles = axis @ normals
        # Noise of the vectors changes the albedo and the normal together.
        product = fit.noise**2 * np.linalg.inv(fit.lamps.T @ fit.lamps)
        across = axis[:, np.newaxis] - self._along * normals
        self._shared = np.sum(across * (product @ normals), axis=0) / albedo**2
        self._doubt = np.sum(across * (product @ across), axis=0) / albedo**2

    def offset(self, part: NDArray[np.bool_]) -> tuple[float, float, float]:
        """Return the offset in a part of the picture, its error, counts, and the spread of log albedo."""
        part = part.copy()
        for _ in range(3):  # without outliers
            along, values = (_without(self.place[part], each[part]) for each in (self._along, self._values))
            doubt = float(np.sum(self._doubt[part]))
            square = float(np.sum(along**2)) - doubt
            if square < doubt:
                return 0.0, math.inf, math.inf
            slope = (float(np.sum(along * values)) - float(np.sum(self._shared[part]))) / square
            left = values - slope * along
            spread = mad_sigma(left)
            part[part] = np.abs(left) <= _OUTLYING * spread
        return slope * self._light, self._light * spread / math.sqrt(square), spread
