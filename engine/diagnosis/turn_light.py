"""The light of a pixel in the frames of a rotation, and its derivatives: the model of `turn_nuisances`.

The model of a sample in frame t, at a pixel with the normal n, is ::

    y = dark + (1 + g_t) (1 + u) R (l / R)^(1 + c) + o_t,    l = base + z + (1 + r) gain angle(n, t) - dark,

with gains g and offsets o of the frames, uneven light u, a quadratic of the place without its mean, the
camera's gamma 1 + c, an error r of the zenith gain and z of the zenith offset. A frame may show a share
of the one before (lag). R is full light.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.numerics.least_squares import gram

GLOBALS = ("gamma", "zenith_gain", "zenith_offset", "tilt", "phase", "lag")
"""Names of the nuisances of all frames in the order of a fit; the terms of uneven light follow."""

UNEVEN = 5
"""Number of terms of uneven light."""


def uneven_terms(x: Doubles, y: Doubles) -> Sequence[Doubles]:
    """Return the terms of uneven light, each with a mean of 0 over the picture; x and y are from -1 to 1."""
    return x, y, x * x - 1 / 3, x * y, y * y - 1 / 3


class AxisAngles(NamedTuple):
    """Angles between normals and the body's axis, and their derivatives, radians, (T, n)."""

    angle: Doubles
    by_zenith: Doubles
    by_azimuth: Doubles  # for a rotation of the normal by an angle
    by_tilt: Doubles
    by_phase: Doubles

    @classmethod
    def of(
        cls,
        zenith: Doubles,
        azimuth: Doubles,
        phase: Doubles,
        lean: float | Doubles,
        upright: float | Doubles,
    ) -> AxisAngles:
        """Return the angles at phases, (T, 1), for sine and cosine of the tilt, numbers or (T, 1)."""
        sine, cosine = np.sin(zenith), np.cos(zenith)
        turned = azimuth - phase
        along = cosine * upright - sine * lean * np.cos(turned)
        angle = np.arccos(np.clip(along, -1, 1))
        down = np.maximum(np.sin(angle), 1e-9)
        by_zenith = (sine * upright + cosine * lean * np.cos(turned)) / down
        by_azimuth = -lean * np.sin(turned) / down
        by_tilt = (cosine * lean + sine * upright * np.cos(turned)) / down
        return cls(angle, by_zenith, by_azimuth, by_tilt, -by_azimuth * sine)


class SlopeAngles(NamedTuple):
    """Angles between the normals of slopes and the body's axis, and their derivatives, radians, (T, n).

    With the slopes s, L^2 = 1 + s^2, and the direction e of the lean by d, the angle a has ::

        cos a = u = (cos d + sin d (s . e)) / L
    """

    angle: Doubles
    by_slopes: Doubles  # (2, T, n)
    by_tilt: Doubles
    by_phase: Doubles
    bend: Doubles  # half of the second derivatives along some changes of the slopes, summed

    @classmethod
    def of(
        cls, slopes: Doubles, phase: Doubles, tilt: Doubles, changes: Sequence[Doubles] = ()
    ) -> SlopeAngles:
        """Return the angles for slopes, (2, T, n), at phases and tilts, (T, 1), and changes, (2, n)."""
        lean, upright, cosine, sine = np.sin(tilt), np.cos(tilt), np.cos(phase), np.sin(phase)
        outwards, onwards = cosine * slopes[0] + sine * slopes[1], cosine * slopes[1] - sine * slopes[0]
        shortened = 1 / np.sqrt(1 + slopes[0] ** 2 + slopes[1] ** 2)  # 1 / L
        along = shortened * (upright + lean * outwards)
        angle = np.arccos(np.clip(along, -1, 1))
        steep = 1 / np.maximum(np.sin(angle), 1e-9)

        def rise(change: Doubles) -> Doubles:
            onto = slopes[0] * change[0] + slopes[1] * change[1]
            moved = lean * (cosine * change[0] + sine * change[1]) - along * shortened * onto
            return np.asarray(shortened * moved)

        bend = np.zeros_like(angle)
        for change in changes:
            first = rise(change)
            both = shortened**2 * (slopes[0] * change[0] + slopes[1] * change[1])
            square = shortened**2 * (change[0] ** 2 + change[1] ** 2)
            second = -2 * both * first - along * (square - both**2)
            bend -= (second * steep + along * first**2 * steep**3) / 2
        by_slopes = np.stack([-steep * rise(axis) for axis in np.eye(2)])
        by_tilt = steep * shortened * (lean - upright * outwards)
        return cls(angle, by_slopes, by_tilt, -steep * shortened * lean * onwards, bend)


class PixelScale(NamedTuple):
    """How counts depend on the zenith at some pixels: each a number or (n,), counts."""

    gain: Doubles  # per radian
    base: Doubles  # at zenith 0
    dark: Doubles
    full: float  # full light


class Light(NamedTuple):
    """Light of pixels in frames, and its derivatives, (T, n), counts."""

    light: Doubles  # without dark level and offset of the frames
    by_angle: Doubles  # per radian
    by_gain: Doubles  # by gains of the frames
    by_globals: Doubles  # (6 + 5, T, n): by `GLOBALS` and the terms of uneven light


def light_of(
    angles: AxisAngles | SlopeAngles, bent: Doubles | float, scale: PixelScale, gains: Doubles,
    offsets: Doubles, values: Doubles, places: Doubles, all_derivatives: bool = True,
) -> Light:  # fmt: skip
    """Return the light of normals at angles to the axis plus ``bent``, (T, n) radians.

    ``gains`` and ``offsets`` are (T, 1), ``values`` those of `GLOBALS` and the terms of uneven light, and
    ``places`` (5, n). The derivative by the tilt is that by radians. Unless all derivatives are asked for,
    the last ones are empty.
    """
    gamma, gain, offset, _, _, lag = values[: len(GLOBALS)]
    uneven = values[len(GLOBALS) :]
    angle = angles.angle + bent
    linear = np.maximum(scale.base + offset + (1 + gain) * scale.gain * angle - scale.dark, 1e-6 * scale.full)
    ratio = linear / scale.full
    light = scale.full * ratio ** (1 + gamma)
    share = (1 + gains) * (1 + uneven @ places)
    shown = share * light
    before = np.concatenate([shown[:1], shown[:-1]])
    steep = share * (1 + gamma) * ratio**gamma  # counts of the frame per count of linear light
    by_angle = steep * (1 + gain) * scale.gain
    by_gain = (1 + uneven @ places) * light
    total = shown + offsets + lag * (before - shown)
    if not all_derivatives:
        return Light(total, by_angle, by_gain, np.empty((0, *by_gain.shape)))
    by_globals = np.stack([
        shown * np.log(ratio), steep * scale.gain * angle, steep, by_angle * angles.by_tilt,
        by_angle * angles.by_phase, before - shown, *((1 + gains) * light * places[:, np.newaxis]),
    ])  # fmt: skip
    return Light(total, by_angle, by_gain, by_globals)


class Sums(NamedTuple):
    """Normal equations of samples: of each pixel's own parameters, of the nuisances, and of both.

    The p parameters of a pixel are those of its normal, and maybe more. The nuisances are the gains of T
    frames, their offsets, and the others.
    """

    matrices: Doubles  # (n, p, p)
    cross: Doubles  # (n, p, K)
    own: Doubles  # (K, K)
    push: Doubles  # (n, p): by the residuals
    pull: Doubles  # (K,)

    @classmethod
    def of(cls, left: Doubles, normal: Doubles, gain: Doubles, rest: Doubles) -> Sums:
        """Return the sums of residuals, (T, n), and derivatives: (p, T, n), (T, n) and (k, T, n)."""
        frames, count = left.shape
        size = 2 * frames + len(rest)
        matrices = np.einsum("ati,bti->iab", normal, normal)
        cross = np.empty((count, len(normal), size))
        cross[:, :, :frames] = np.moveaxis(normal * gain, 2, 0)
        cross[:, :, frames : 2 * frames] = np.moveaxis(normal, 2, 0)
        cross[:, :, 2 * frames :] = np.einsum("ati,kti->iak", normal, rest)
        own = np.zeros((size, size))
        at = np.arange(frames)
        own[at, at] = np.sum(gain**2, axis=1)
        own[at, frames + at] = own[frames + at, at] = np.sum(gain, axis=1)
        own[frames + at, frames + at] = count
        own[2 * frames :, :frames] = np.einsum("kti,ti->kt", rest, gain)
        own[2 * frames :, frames : 2 * frames] = np.sum(rest, axis=2)
        own[: 2 * frames, 2 * frames :] = own[2 * frames :, : 2 * frames].T
        lines = rest.reshape(len(rest), -1)
        own[2 * frames :, 2 * frames :] = gram(lines.T)
        push = np.einsum("ati,ti->ia", normal, left)
        by_gain, by_offset = np.sum(gain * left, axis=1), np.sum(left, axis=1)
        return cls(
            matrices,
            cross,
            own,
            push,
            np.concatenate([by_gain, by_offset, np.einsum("kti,ti->k", rest, left)]),
        )
