"""The light of the pixels of a window under a lit wall.

It is that of `mirrorskin.engine.calibration.wall_model`, of points of any surface instead of balls. A line of
sight that is inclined by k per millimetre from the axis sees the point of height z above the rest plane that
is at ``p = X - k z (X - axis)``, with X where the line meets the rest plane. With the slopes g of the heights
from pixel to pixel, those of the surface are ::

    s = g / (1 - k z - k (X - axis) . g)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.calibration import wall_model as model
from mirrorskin.engine.calibration.ball import rotations
from mirrorskin.engine.calibration.touches.light import FOOTPRINT, Lit, Seen
from mirrorskin.engine.calibration.wall_fit import ROUGH
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.rotation.response import lamp_light, sight_of, sight_slopes

_OF_MOVEMENT = ("pivot_x", "pivot_y", "pivot_z", "phase_offset")
_OF_PATH = tuple(name for name in model.SENSOR[: model.GEOMETRIC] if name not in _OF_MOVEMENT)
_SHADE = model.SENSOR[model.GEOMETRIC + 2 :]
_CURVE = model.curve_from_steps(rising=True)
_ANGLE = 1e-5  # radians: step of numerical derivatives
_SMALL = 1e-5  # the same of a parameter, relative to its scale
_BENT = 0.25  # pixels: step of second derivatives


@dataclass(frozen=True, slots=True, eq=False)
class WallLight:
    """The light of n pixels under a wall whose print gets brighter from the rim down."""

    dark: Doubles  # (n,) counts
    span: Doubles  # (n,) counts from dark to full light
    place: Doubles  # (2, n): where lines of sight meet the rest plane, mm
    press: float  # mm that surfaces are pressed in
    pivot: tuple[float, float, float]  # as it was assumed, mm

    names: ClassVar[tuple[str, ...]] = ("lag", *_OF_PATH, "lamp_x", "lamp_y", *_SHADE, *model.STEP_NAMES)

    def of(self, seen: Seen, chosen: NDArray[np.bool_], named: Mapping[str, float]) -> Lit:
        """Return the light of chosen pixels."""
        shape = seen.slopes.shape[1:]
        share = (1 + seen.gains) * self.span[chosen]
        surface = _Surface(seen, self.place[:, chosen], self.press, self.pivot)
        met = surface.met(named)
        curve = _CURVE @ np.array([named[name] for name in model.STEP_NAMES])
        wall = model.reach_wall(met, named)
        basis = model.curve_means(wall.low, wall.high)
        level, factor = np.einsum("nk,k->n", basis, curve), model.lamps_and_shade(met, wall, named)
        per_width = factor / (wall.high - wall.low)
        by_high = per_width * (model.curve_values(curve, wall.high) - level)
        by_low = per_width * (level - model.curve_values(curve, wall.low))

        def change(points: model.SheetPoints, changed: Mapping[str, float] = named) -> Doubles:
            other = model.reach_wall(points, changed)
            by_ends = by_high * (other.high - wall.high) + by_low * (other.low - wall.low)
            by_factor = level * (model.lamps_and_shade(points, other, changed) - factor)
            return np.asarray(share * (by_ends + by_factor).reshape(shape))

        light = (factor * level).reshape(shape)
        bend: Doubles = np.zeros(shape)
        for along in seen.changes:
            sides = [
                model.light_of(surface.met(named, step * along[:, np.newaxis]), named, curve)
                for step in (_BENT, -_BENT)
            ]
            bend += ((sides[0] + sides[1]).reshape(shape) - 2 * light) / (2 * _BENT**2)
        bend *= FOOTPRINT * share
        shown = share * light + (1 + named["footprint"]) * bend
        before = np.concatenate([shown[:1], shown[:-1]])
        of_path = []
        for name in _OF_PATH:
            step = _SMALL * model.SCALES[name]
            changed = {**named, name: named[name] + step}
            points = met if name in model.OF_THE_WALL else surface.met(changed)
            of_path.append(change(points, changed) / step)
        lamps = lamp_light(wall.ray, (named["lamp_x"], named["lamp_y"]))
        of_light = np.concatenate(
            [
                factor * level / lamps * wall.ray.at,
                lamps * level * model.shading(met, named["radius"]),
                factor * (basis @ _CURVE).T,
            ]
        )
        return Lit(
            self.dark[chosen] + shown + seen.offsets + named["lag"] * (before - shown),
            np.stack([change(surface.met(named, _ANGLE * axis)) / _ANGLE for axis in _AXES]),
            self.span[chosen] * light,
            change(surface.met(named, tilt=_ANGLE)) / _ANGLE,
            change(surface.met(named, phase=_ANGLE)) / _ANGLE,
            bend,
            np.concatenate([[before - shown], of_path, share * of_light.reshape(len(of_light), *shape)]),
        )


def even_steps() -> Doubles:
    """Return the steps of a print whose light rises evenly from 0 at the rim to 1 at the rest plane."""
    return np.asarray(np.linalg.solve(_CURVE, model.even_curve()), np.float64)


def roughness() -> Doubles:
    """Return the inverse covariance of steps of smooth curves, without their lower differences."""
    rough = model.curve_roughness() @ _CURVE / ROUGH
    return np.asarray(rough.T @ rough)


_AXES = np.eye(2).reshape(2, 2, 1, 1)


@dataclass(frozen=True, slots=True)
class _Surface:
    """Points of a surface that pixels see in the frames of a turn."""

    seen: Seen
    place: Doubles  # (2, m)
    press: float
    pivot: tuple[float, float, float]

    def met(
        self, named: Mapping[str, float], slopes: Doubles | float = 0.0, tilt: float = 0.0, phase: float = 0.0
    ) -> model.SheetPoints:
        """Return the points, with changes of slopes, tilt and phase."""
        seen = self.seen
        angles, azimuths = seen.tilt + tilt, seen.phase + phase
        turns = rotations(np.concatenate([angles * np.cos(azimuths), angles * np.sin(azimuths)], axis=1))
        sight = named["sight_0"], named["sight_2"]
        above = seen.heights + self.press
        from_axis, leaning = model.look(self.place, named)
        inclination = sight[0] + sight[1] * np.sum(from_axis**2, axis=0)
        gradient = seen.slopes + slopes
        gradient = gradient / (1 - inclination * above + np.einsum("am,atm->tm", leaning, gradient))
        flat = 1 / np.sqrt(1 + gradient[0] ** 2 + gradient[1] ** 2)
        normal = np.stack([-gradient[0] * flat, -gradient[1] * flat, flat])
        normal = np.einsum("tij,jtm->itm", turns, normal).reshape(3, -1)
        pivot = np.array([*self.pivot[:2], self.pivot[2] + seen.pivot_z])
        point = np.stack([*(self.place + above * leaning), above])
        moved = pivot[:, np.newaxis, np.newaxis] + np.einsum(
            "tij,jm->itm", turns, point - pivot[:, np.newaxis]
        )
        x, y, z = moved.reshape(3, -1)
        x, y = x - named["axis_x"], y - named["axis_y"]
        back = np.stack([x, y]) - z * sight_slopes(np.stack([x, y]), sight)
        return model.SheetPoints(x, y, z, sight_of(sight_slopes(back, sight)), normal)
