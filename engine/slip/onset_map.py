"""Onsets of slip at nodes: the most likely map, estimated from all frames at once."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy import sparse
from scipy.sparse.linalg import splu

from mirrorskin.kernels.array_types import Doubles

_CANDIDATES = 48  # number of onsets tried for the initial map
_EVIDENCE = 8.0  # minimum log-likelihood ratio of a departure for the initial onset of a node
_MAX_STEPS = 20  # maximum number of Gauss-Newton steps
_WIDE = 5  # number of initial steps in which departures begin gradually
_MAX_FINE_NODES = 1000  # number of nodes above which a quarter of them is fitted first, to save time
_LAST_CHANGE = 1e-6  # change of an onset, relative to the path, that ends the steps
_NEAR = 0.01  # change of an onset, relative to the path, below which steps reuse earlier equations
_MAX_GROWTH = 1.0  # maximum change of the growth's logarithm in a step
_SHARES = 1.0, 0.5, 0.25, 0.125, 0.06  # of a step that are tried, until one lowers the cost
_LOCKING = 0.05  # prior sigma of the bias of displacements towards halves of a pixel, pixels
_POWER_SIGMA = 0.1  # standard deviation of the power; those of slides and twists differ by twice that
_INDEPENDENT_DISTANCE = 9  # distance of nodes above which errors of onsets are independent
_NO_SLIP_ONSET = 1.5  # onset, relative to the path, of a node that has not slipped
_MIN_WEIGHT = 1e-6  # weight added to all equations, so that they have a solution


@dataclass(frozen=True, slots=True)
class Expected:
    """Prior knowledge of the departures of a motion.

    Attributes
    ----------
    power : float
        Exponent of the departure, accurate to ±0.1.
    onset_bend : float
        Standard deviation of the third difference of onsets over the contact's radius, relative to the path.
    growth_bend : float
        Standard deviation of the second difference of the growth's logarithm.
    """

    power: float
    onset_bend: float
    growth_bend: float


@dataclass(frozen=True, slots=True)
class Locking:
    """Bias of displacements towards halves of a pixel, which depends on the displacement itself.

    It is computed from the fitted departure: computed from the measured one, it would contain its noise, and
    explain it where the body moves by whole pixels.

    Attributes
    ----------
    rest : ndarray, (2, T, rows, columns), float64
        Displacement of skin that sticks, along x and y, pixels.
    back : ndarray, (2, rows, columns), float64
        By how much the skin is displaced less where it lags by 1 mm, pixels.
    size : ndarray, (2,), float64
        Sides of a pixel, mm.
    """

    rest: Doubles
    back: Doubles
    size: Doubles

    def part(self, nodes: Any) -> Locking:
        """Return the locking of some of the nodes."""
        return Locking(self.rest[nodes], self.back[nodes], self.size)

    def of(self, departure: Doubles) -> tuple[Doubles, Doubles]:
        """Return the changes of departures, mm, for an amplitude of one pixel along x, and along y.

        The second array, of the same shape (2, T, rows, columns), is their derivative by the departure.
        """
        place = 2 * np.pi * (self.rest - departure * self.back[:, None])
        unit = self.back * self.size[:, None, None]  # component of the lag along an axis
        changes = -unit * self.size[:, None, None]
        return changes[:, None] * np.sin(place), 2 * np.pi * unit[:, None] ** 2 * np.cos(place)


@dataclass(frozen=True, slots=True)
class OnsetMap:
    """Onsets of departure, and their standard deviations, (rows, columns), in the unit of the path.

    An onset beyond the end of the path has not happened. If it is before the start of the path, the departure
    began before the first frame.
    """

    onset: Doubles
    sigma: Doubles


def fit_onsets(
    departure: Doubles,
    sigma: Doubles,
    distance: Doubles,
    window: float,
    radius: float,
    expected: Expected,
    locking: Locking,
) -> OnsetMap:
    """Fit ``growth (distance - onset)^power``, zero before the onset, to departures blurred by windows.

    The departure of a window is the mean over it. Where the onset changes by ``slope`` from node to node, it
    is the mean over onsets within ± slope window / 2. The prior penalises second differences of the growth,
    and third differences of the onsets, which are 0 for the paraboloid under a ball. Both maps are estimated
    jointly by Gauss-Newton steps, together with the amplitude of the bias of displacements towards halves of
    a pixel. The standard deviation combines the noise and the change of the onset for another power.

    Parameters
    ----------
    departure : (T, rows, columns), mm, in the frames after the reference; NaN where unknown
    sigma : (rows, columns), standard deviation of a departure, mm; half of the variance is the reference's,
        which is common to all frames
    distance : (T,), distance travelled by the body since the reference
    window : side of the window over which a departure is averaged, nodes
    radius : radius of a disc as large as the contact, nodes
    expected : prior knowledge of the motion
    locking : bias of the displacements
    """
    fit = _fit(departure, sigma, distance, window, radius, expected, locking)
    length = float(distance[-1])
    if fit is None:
        return OnsetMap(np.full(sigma.shape, _NO_SLIP_ONSET * length), np.full(sigma.shape, length))
    return OnsetMap(length * fit.onset, length * np.sqrt(fit.system.variances() + fit.shift**2))


class _Fit(NamedTuple):
    """Maps of onsets, relative to the path, and of the growth's logarithm, and the amplitude of the locking.

    ``shift`` is the change of the onset for another power.
    """

    onset: Doubles
    log_growth: Doubles
    lock: Doubles
    system: _Normal
    shift: Doubles


class _Evaluated(NamedTuple):
    """The model at a point: scaled growth, half width of the blur, derivatives, residual, pull of the prior.

    ``columns`` are the derivatives for both maps, ``locks`` those for the locking.
    """

    growth: Doubles
    half: Doubles
    columns: Doubles
    locks: Doubles
    residual: Doubles
    pull: Doubles


def _fit(
    departure: Doubles,
    sigma: Doubles,
    distance: Doubles,
    window: float,
    radius: float,
    expected: Expected,
    locking: Locking,
) -> _Fit | None:
    """Return the best fit; None without a departure. For many nodes, every second one is fitted first."""
    power = expected.power
    measured = np.isfinite(departure).all(axis=0) & np.isfinite(sigma)
    scale = np.divide(1.0, sigma, out=np.zeros(sigma.shape), where=measured)
    data = _whitened(np.where(measured, departure * scale, 0.0))
    times = (distance / distance[-1])[:, None, None]
    second, third = (_bending(measured.shape, order) for order in (2, 3))
    onset_stiff = third * (radius**3 / expected.onset_bend) ** 2
    stiff = sparse.block_diag([onset_stiff, second * (radius**2 / expected.growth_bend) ** 2], format="csc")
    prior = stiff + _MIN_WEIGHT * sparse.identity(stiff.shape[0], format="csc")

    coarse, number = None, 0
    if measured.size > _MAX_FINE_NODES:
        half = np.s_[..., ::2, ::2]
        coarse = _fit(
            departure[half], sigma[half], distance, window / 2, radius / 2, expected, locking.part(half)
        )
    if coarse is not None:
        onset, log_growth = (_finer(values, measured.shape) for values in (coarse.onset, coarse.log_growth))
        lock, number = coarse.lock, _WIDE
    else:
        first = _first_onsets(data, scale, times, onset_stiff, power)
        if first is None:
            return None
        onset, usual = first
        log_growth, lock = np.full_like(onset, math.log(usual)), np.zeros(2)

    def evaluate(maps: Doubles, lock: Doubles, number: int) -> tuple[float, _Evaluated]:
        """Return the cost of maps, (2, rows, columns), and of a locking, and what the next step needs."""
        onset, log_growth = maps
        half = np.hypot(*np.gradient(onset)) * window / 2
        half = np.maximum(half, max(0.5, 2.0 - 0.5 * number) / len(distance))  # wider at first
        growth = np.exp(log_growth)
        lag, rate = (growth * part for part in _blurred(times - onset, half, power))
        changes, derivatives = (part * (number >= _WIDE) for part in locking.of(lag))
        kept = scale * (1 + np.tensordot(lock, derivatives, 1))
        locks = _whitened(scale * changes)
        residual = data - _whitened(scale * lag) - np.tensordot(lock, locks, 1)
        columns = _whitened(kept * np.stack([-rate, lag]))
        bent = stiff @ maps.ravel()
        cost = np.sum(residual**2) + bent @ maps.ravel() + lock @ lock / _LOCKING**2
        return float(cost), _Evaluated(growth * kept, half, columns, locks, residual, -bent)

    maps, moved = np.stack([onset, log_growth]), np.inf
    while True:
        cost, here = evaluate(maps, lock, number)
        # Close to the answer, the equations of an earlier step lead to the same one.
        ends = number == _MAX_STEPS or (number >= _WIDE and moved < _LAST_CHANGE)
        if ends or number < _WIDE or moved > _NEAR:
            system = _Normal(here.columns, here.locks, prior)
        if ends:
            break
        step, more = system.solve(here.columns, here.residual, here.pull, -lock / _LOCKING**2)
        # The whole step is shortened: the maps would bend if it were shortened at some nodes.
        longest = min(1.0, _MAX_GROWTH / float(np.abs(step[1][measured]).max(initial=1e-30)))
        shares = (longest * part for part in _SHARES)
        share = next(
            (part for part in shares if evaluate(maps + part * step, lock + part * more, number)[0] < cost),
            0.0,
        )
        maps, lock = maps + share * step, lock + share * more
        # Others, which no frame shows, never settle.
        moved = share * float(np.abs(step[0][measured & (maps[0] < 1.0)]).max(initial=0.0))
        number += 1
    other = _whitened(here.growth * _blurred(times - maps[0], here.half, power + _POWER_SIGMA)[0])
    shift = system.solve(here.columns, other - here.columns[1])[0][0]
    return _Fit(maps[0], maps[1], lock, system, shift)


def _finer(values: Doubles, shape: tuple[int, ...]) -> Doubles:
    """Return values at all nodes, by linear interpolation, of those at every second one."""
    for axis, size in enumerate(shape):
        node, last = np.arange(size), values.shape[axis] - 1
        values = (values.take(node // 2, axis) + values.take(np.minimum((node + 1) // 2, last), axis)) / 2
    return values


class _Normal:
    """The normal equations of both maps, bordered by those of the locking, which all nodes share."""

    def __init__(self, columns: Doubles, locks: Doubles, prior: Any) -> None:
        normal = np.einsum("ityx,jtyx->ijyx", columns, columns).reshape(2, 2, -1)
        self._lu = _factor(sparse.bmat([[sparse.diags(part) for part in row] for row in normal]) + prior)
        self._shape, self._locks = columns.shape[2:], locks
        self._cross = np.einsum("ityx,ktyx->iyxk", columns, locks).reshape(-1, len(locks))
        self._freed = np.asarray(self._lu.solve(self._cross))
        locks_normal = np.einsum("ityx,jtyx->ij", locks, locks) + np.identity(len(locks)) / _LOCKING**2
        self._inner = np.linalg.inv(locks_normal - self._cross.T @ self._freed)

    def solve(
        self,
        columns: Doubles,
        residual: Doubles,
        pull: Doubles | float = 0.0,
        lock_pull: Doubles | float = 0.0,
    ) -> tuple[Doubles, Doubles]:
        """Return the step of the maps, (2, rows, columns), and of the locking, from residuals and priors."""
        step = self._lu.solve(np.sum(columns * residual, axis=1).ravel() + pull)
        more = self._inner @ (
            np.einsum("ktyx,tyx->k", self._locks, residual) + lock_pull - self._cross.T @ step
        )
        return np.asarray((step - self._freed @ more).reshape(2, *residual.shape[1:])), more

    def variances(self) -> Doubles:
        """Return the variances of the first map."""
        shared = np.einsum("nk,kl,nl->n", self._freed, self._inner, self._freed)
        return np.asarray(_variances(self._lu, self._shape) + shared.reshape(2, *self._shape)[0])


def _factor(matrix: Any) -> Any:
    """Factor a symmetric positive definite matrix: without pivots, in half of the time of any other."""
    return splu(
        matrix.tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )


def _whitened(values: Doubles) -> Doubles:
    """Whiten the errors of frames, whose covariance is (I + J) / 2, where all elements of J are 1.

    J is the error of the reference, which is as large as that of a frame.
    """
    part = 1 - 1 / math.sqrt(values.shape[-3] + 1)
    whitened: Doubles = math.sqrt(2) * (values - part * values.mean(axis=-3, keepdims=True))
    return whitened


def _blurred(since: Doubles, half: Doubles | float, power: float) -> tuple[Doubles, Doubles]:
    """Return the mean of ``max(since, 0)^power`` over an interval of ± half, and its derivative."""
    ahead, behind = np.maximum(since + half, 0.0), np.maximum(since - half, 0.0)
    ends = ahead**power, behind**power
    mean = (ahead * ends[0] - behind * ends[1]) / (2 * half * (power + 1))
    return mean, (ends[0] - ends[1]) / (2 * half)


def _first_onsets(
    data: Doubles, scale: Doubles, times: Doubles, stiff: Any, power: float
) -> tuple[Doubles, float] | None:
    """Return a first map of onsets, by grid search at each node, and the growth; None without departure."""
    length = float(times[-1, 0, 0])
    best, onset = np.zeros_like(scale), np.full_like(scale, length)
    for trial in np.linspace(-0.3 * length, length, _CANDIDATES, endpoint=False):
        shape = _whitened(np.maximum(times - trial, 0.0) ** power * scale)
        products, squares = np.sum(shape * data, axis=0), np.sum(shape**2, axis=0)
        gain = np.maximum(products, 0.0) ** 2 / (2 * np.maximum(squares, np.finfo(float).tiny))
        gain = cv2.GaussianBlur(gain, (9, 9), 1.0, borderType=cv2.BORDER_REFLECT)
        onset, best = np.where(gain > best, trial, onset), np.maximum(gain, best)
    evident = best > _EVIDENCE
    if not evident.any():
        return None
    trust = np.where(evident, (_CANDIDATES / length) ** 2, _MIN_WEIGHT)
    onset = _factor(stiff + sparse.diags(trust.ravel())).solve((trust * onset).ravel())
    onset = onset.reshape(scale.shape)
    shape = _whitened(_blurred(times - onset, length / len(times), power)[0] * scale)
    growth = np.sum(shape * data) / max(float(np.sum(shape**2)), np.finfo(float).tiny)
    return (onset, float(growth)) if growth > 0 else None


def _bending(shape: tuple[int, int], order: int) -> Any:
    """Return the matrix of a map's bending energy: the sum of squared differences of an order."""
    rows, columns = (
        [sparse.csr_matrix(np.diff(np.eye(n), k, axis=0)) for k in range(order + 1)] for n in shape
    )
    parts = [
        math.sqrt(math.comb(order, k)) * sparse.kron(rows[order - k], columns[k]) for k in range(order + 1)
    ]
    return sum(part.T @ part for part in parts).tocsc()


def _variances(system: Any, shape: tuple[int, int]) -> Doubles:
    """Estimate the diagonal of a system's inverse for its first map, by probing distant nodes at once."""
    signs = np.random.default_rng(0).choice([-1.0, 1.0], shape)
    diagonal = np.empty(shape)
    for row in range(min(_INDEPENDENT_DISTANCE, shape[0])):
        for column in range(min(_INDEPENDENT_DISTANCE, shape[1])):
            here = np.s_[row::_INDEPENDENT_DISTANCE, column::_INDEPENDENT_DISTANCE]
            right = np.zeros((2, *shape))
            right[0][here] = signs[here]
            answer = system.solve(right.ravel()).reshape(2, *shape)[0]
            diagonal[here] = (answer * signs)[here]
    around = sliding_window_view(np.pad(diagonal, 1, mode="edge"), (3, 3))
    return np.maximum(np.median(around, axis=(2, 3)), 0.0)  # less noise of the probing
