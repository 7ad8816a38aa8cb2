"""A pose graph: maps, the motions between pairs of them, and one adjustment of all."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from mirrorskin.engine.pose.correlation import SIDE, Relief, Start, starts, working_pixel
from mirrorskin.engine.pose.fit import MIN_COMMON, PairFit
from mirrorskin.engine.pose.maps import PoseMap
from mirrorskin.engine.pose.motion import STILL, Motion
from mirrorskin.engine.pose.pose import IDENTITY, Pose, pose_of
from mirrorskin.io import InputError
from mirrorskin.io.base.findings import Finding
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.device import Device

_MAX_CHI2 = 4.0  # largest chi square of a link between two maps
_ITERATIONS, _ROUNDS = 5, 2  # steps for the poses; rounds in which links are added and poses computed
_UNFIT = 1e-9  # smallest information of a direction, relative to the largest
_MAX_LOOP_CHI2 = 4.0  # chi square of the loops per degree of freedom above which the poses have a warning
_MAX_SEARCHES = 20  # pairs that are searched at all rotations
_TILTED = 0.2  # components of an undetermined direction below which it is z
_RIVAL_PEAK = 0.8  # height of a peak, relative to the highest, above which another motion is possible
_NEAR = 0.1  # error of a stated offset, relative to the field


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """The motions from the first map to each, with their common covariance.

    Attributes
    ----------
    poses : tuple of Pose
        The first one is the identity.
    covariance : ndarray, (6 n, 6 n)
        Of all poses, as that of `mirrorskin.engine.pose.Pose`; 0 for the first one.
    loop_chi_square : float
        Chi square of the links per degree of freedom of the adjustment; NaN without loops. The covariance is
        multiplied by it, if it exceeds 1.
    """

    poses: tuple[Pose, ...]
    covariance: Doubles
    loop_chi_square: float
    findings: tuple[Finding, ...]


class PoseGraph:
    """Links maps that share pixels.

    Parameters
    ----------
    maps : sequence of PoseMap
    names : sequence of str
        For messages.
    device : Device
    offsets : sequence of (float, float), optional
        x and y, mm, of each map's centre relative to that of the map before it, as stated by the user.

    Attributes
    ----------
    links : dict
        The motion from the first of two maps to the second, by their numbers.
    """

    def __init__(
        self,
        maps: Sequence[PoseMap],
        names: Sequence[str],
        device: Device,
        offsets: Sequence[tuple[float, float]] | None = None,
    ) -> None:
        self.links: dict[tuple[int, int], Pose] = {}
        self._maps, self._names, self._device = maps, names, device
        self._places = None if offsets is None else np.cumsum([(0.0, 0.0), *offsets], axis=0)
        self._ambiguous: list[Finding] = []
        self._searches = 0
        self._best: tuple[float, str] | None = None  # chi square of the best pair without a link, and text
        self._connect()

    # --- links ----------------------------------------------------------------------------------------------

    def _connect(self) -> None:
        """Link pairs until all maps are connected; the most similar ones first."""
        candidates = sorted(self._candidates(), key=lambda pair: -pair[2][0].significance if pair[2] else 0.0)
        for first, second, guesses in candidates:
            if not self._connected(first, second):
                self._link(first, second, [self._stated(first, second)], guesses)
        if self._places is None:
            pairs = sorted(
                itertools.combinations(range(len(self._maps)), 2), key=lambda pair: pair[1] - pair[0]
            )
            for first, second in pairs:
                if not self._connected(first, second) and self._searches < _MAX_SEARCHES:
                    self._searches += 1
                    self._link(first, second, None, [])
        apart = next((n for n in range(len(self._maps)) if not self._connected(0, n)), None)
        if apart is not None:
            raise InputError(self._refusal(apart))

    def _candidates(self) -> Iterator[tuple[int, int, list[Start]]]:
        """Yield pairs with the peaks of their correlation, near a stated offset if there is one."""
        for first, second in itertools.combinations(range(len(self._maps)), 2):
            mine, theirs = self._reliefs[first], self._reliefs[second]
            if self._places is None:
                yield first, second, starts(mine, theirs, MIN_COMMON)
            elif self._overlap(first, second) >= MIN_COMMON:
                x, y, _ = self._stated(first, second).shift
                reach = _NEAR * max(mine.reach, theirs.reach)
                yield first, second, starts(mine, theirs, MIN_COMMON / 2, near=(float(x), float(y), reach))

    def _stated(self, first: int, second: int) -> Motion:
        """Return the motion between two fields at their stated places; without them, none."""
        if self._places is None:
            return STILL
        return Motion(np.eye(3), np.array([*(self._places[first] - self._places[second]), 0.0]))

    @cached_property
    def _reliefs(self) -> list[Relief]:
        pixel = working_pixel(self._maps, SIDE)
        return [Relief.of(map_, pixel) for map_ in self._maps]

    def _overlap(self, first: int, second: int) -> float:
        """Return the share of the smaller field that two fields share at their stated places."""
        assert self._places is not None
        share = 1.0
        for axis in (0, 1):
            a, b = (self._maps[n].shape[1 - axis] * self._maps[n].grid[2 + axis] for n in (first, second))
            apart = abs(float(self._places[first][axis] - self._places[second][axis]))
            share *= min(max((a + b) / 2 - apart, 0.0) / min(a, b), 1.0)
        return share

    def _connected(self, first: int, second: int) -> bool:
        return second in self._tree(first)

    def _tree(self, root: int) -> dict[int, Motion]:
        """Return the motions from a map to those connected with it."""
        tree = {root: STILL}
        queue = [root]
        for number in queue:
            for (first, second), pose in self.links.items():
                if first == number and second not in tree:
                    tree[second] = tree[number].then(pose.motion)
                    queue.append(second)
                elif second == number and first not in tree:
                    tree[first] = tree[number].then(pose.motion.inverse())
                    queue.append(first)
        return tree

    def _link(self, first: int, second: int, far: list[Motion] | None, guesses: Sequence[Start]) -> None:
        """Link two maps if their best motion fits: from some starts, or by a search if ``far`` is None."""
        fit = PairFit(self._maps[first], self._maps[second], self._device)
        try:
            if far is None:
                pose = pose_of(fit, *fit.solve())
            else:
                pose = pose_of(fit, *fit.solve_from(far, [guess.motion for guess in guesses]))
        except InputError:
            return
        if self._is_link(pose, first, second):
            self.links[first, second] = pose
            if self._places is None and not len(pose.undetermined):
                self._compare_rivals(fit, pose, first, second, guesses)
        else:
            text = (
                f"{self._names[first]} and {self._names[second]} share {self._share(pose, first, second):.0%}"
                f" of their pixels and differ there by {pose.chi_square**0.5:.2g} sigmas"
            )
            self._best = min(self._best or (np.inf, ""), (pose.chi_square, text))

    def _compare_rivals(
        self, fit: PairFit, pose: Pose, first: int, second: int, guesses: Sequence[Start]
    ) -> None:
        """Keep a finding if another peak of the correlation leads to another motion that fits as well."""
        highest = max((guess.significance for guess in guesses), default=0.0)
        rivals = [guess.motion for guess in guesses if guess.significance > _RIVAL_PEAK * highest]
        other = fit.rival(pose.motion, rivals)
        if other is not None:
            x, y, _ = other.shift - pose.translation
            text = (
                f"{self._names[first]} and {self._names[second]} fit as well if shifted by {x:.3g} and"
                f" {y:.3g} mm along x and y: state --offset, if the surface repeats itself"
            )
            self._ambiguous.append(Finding("ambiguous motion", text))

    def _is_link(self, pose: Pose, first: int, second: int) -> bool:
        return pose.chi_square < _MAX_CHI2 and self._share(pose, first, second) >= MIN_COMMON

    def _share(self, pose: Pose, first: int, second: int) -> float:
        return pose.pixels / min(self._maps[n].extent.pixels for n in (first, second))

    def _refusal(self, apart: int) -> str:
        """Return the message about a map that no link connects to the first one."""
        if self._places is None:
            some = f" (the {_MAX_SEARCHES} nearest pairs)" if self._searches == _MAX_SEARCHES else ""
            tried = f"as they are, at the peaks of their correlation, and at all rotations about z{some}"
            remedy = "give results that share a fifth of their pixels or more, or state --offset"
        else:
            tried = f"at the stated offset and at shifts within {_NEAR:.0%} of the field of it"
            remedy = "check --offset, and its signs, or leave it out"
        best = "" if self._best is None else f"; at best {self._best[1]}"
        return f"{self._names[apart]} shares too little with the others, tried {tried}{best}: {remedy}"

    def differences(self, number: int) -> float:
        """Return the mean chi square of a map's links."""
        return float(np.mean([pose.chi_square for pair, pose in self.links.items() if number in pair]))

    # --- adjustment -----------------------------------------------------------------------------------------

    def solve(self) -> Poses:
        """Link all pairs that overlap, and return the poses that fit all links best."""
        tree = self._tree(0)
        motions = [tree[number] for number in range(len(self._maps))]
        for _ in range(_ROUNDS):
            before = len(self.links)
            for first, second in itertools.combinations(range(len(self._maps)), 2):
                if (first, second) not in self.links:
                    self._close(first, second, motions)
            motions, covariance, chi_square = self._adjusted(motions)
            if len(self.links) == before:
                break
        return self._poses(motions, covariance, chi_square)

    def _close(self, first: int, second: int, motions: Sequence[Motion]) -> None:
        """Link two maps if they overlap at their present poses, and agree there."""
        start = motions[first].inverse().then(motions[second])
        fit = PairFit(self._maps[first], self._maps[second], self._device)
        if not fit.shares_enough(start):
            return
        try:
            pose = pose_of(fit, *fit.solve(start, near=True))
        except InputError:
            return
        if self._is_link(pose, first, second):
            self.links[first, second] = pose

    def _adjusted(self, motions: Sequence[Motion]) -> tuple[list[Motion], Doubles, float]:
        """Return the motions, by least squares over all links, their covariance, and chi square."""
        count = 6 * len(self._maps)
        covariance = np.zeros((count, count))
        for _ in range(_ITERATIONS):
            normal, gradient = np.zeros((count, count)), np.zeros(count)
            for (first, second), link in self.links.items():
                rest, parts = _residual(link, motions[first], motions[second])
                weight = _information(link)
                for i, jacobian_i in zip((first, second), parts, strict=True):
                    for k, jacobian in zip((first, second), parts, strict=True):
                        normal[part(i), part(k)] += jacobian_i.T @ weight @ jacobian
                    gradient[part(i)] -= jacobian_i.T @ weight @ rest
            covariance[6:, 6:] = np.linalg.pinv(normal[6:, 6:], _UNFIT, hermitian=True)
            step = (covariance @ gradient).reshape(-1, 6)
            motions = [motion.small_step(d, np.zeros(3)) for motion, d in zip(motions, step, strict=True)]
        values = np.linalg.eigvalsh(normal[6:, 6:])
        squares, freedom = 0.0, -int(np.count_nonzero(values > _UNFIT * values[-1]))
        for pair, link in self.links.items():
            squares += self._closure(pair, motions)
            freedom += 6 - len(link.undetermined)
        return list(motions), covariance, squares / freedom if freedom > 0 else np.nan

    def _poses(self, motions: Sequence[Motion], covariance: Doubles, chi_square: float) -> Poses:
        if chi_square > 1:
            covariance = covariance * chi_square
        poses = [IDENTITY]
        for number, motion in enumerate(motions[1:], 1):
            pair = min((pair for pair in self.links if number in pair), key=lambda pair: pair[1] != number)
            link = self.links[pair] if pair[1] == number else self.links[pair].inverse()
            rotation = np.asarray(Rotation.from_matrix(motion.turn).as_rotvec())
            block = np.asarray(covariance[part(number), part(number)], np.float64)
            poses.append(replace(link, rotation=rotation, translation=motion.shift, covariance=block))
        findings = list(self._ambiguous)
        undetermined = [
            str(name)
            for name, pose in zip(self._names, poses, strict=True)
            if np.abs(pose.undetermined[:, :5]).max(initial=0)
            > _TILTED  # an open z is that of unknown offsets
        ]
        if undetermined:
            source = "that of the best correlation, or none" if self._places is None else "as stated"
            text = (
                f"the surfaces do not determine all of the motion of {_some(undetermined)}: the rest of it is"
                f" {source}, and no sigma includes its error"
            )
            findings.append(Finding("undetermined motion", text))
        if chi_square > _MAX_LOOP_CHI2:
            worst = max(self.links, key=lambda pair: self._closure(pair, motions))
            names = " and ".join(self._names[number] for number in worst)
            text = (
                f"motions around loops of results do not cancel: they differ by {chi_square**0.5:.2g} sigmas,"
                f" most between {names}; sigmas of the poses are multiplied by it"
            )
            findings.append(Finding("open loop", text))
        return Poses(tuple(poses), covariance, chi_square, tuple(findings))

    def _closure(self, pair: tuple[int, int], motions: Sequence[Motion]) -> float:
        """Return chi square of a link at the adjusted motions."""
        rest, _ = _residual(self.links[pair], motions[pair[0]], motions[pair[1]])
        return float(rest @ _information(self.links[pair]) @ rest)


def part(number: int) -> slice:
    """Return where a map's pose is in the covariance of all poses."""
    return slice(6 * number, 6 * number + 6)


def _some(names: Sequence[str]) -> str:
    """Return the first three names."""
    more = len(names) - 3
    return ", ".join(names[:3]) + (f" and {more} more" if more > 0 else "")


def _residual(link: Pose, first: Motion, second: Motion) -> tuple[Doubles, tuple[Doubles, Doubles]]:
    """Return the motion, (6,), from a link to that of two poses, and its derivatives by them."""
    between = first.inverse().then(second)
    error = link.motion.inverse().then(between)
    rest = np.concatenate([np.asarray(Rotation.from_matrix(error.turn).as_rotvec()), error.shift])
    return rest, (-between.adjoint(), np.eye(6))


def _information(pose: Pose) -> Doubles:
    """Return the inverse of a pose's covariance, 0 along undetermined directions."""
    variance = np.diag(pose.covariance)
    lengths = np.sqrt(np.where(variance > _UNFIT**2 * variance.max(), variance, 1.0))
    scaled = pose.covariance / np.outer(lengths, lengths)
    return np.asarray(np.linalg.pinv(scaled, _UNFIT, hermitian=True) / np.outer(lengths, lengths))
