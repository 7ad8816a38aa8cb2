"""Objects that hide parts of themselves, by formula: normals, mask and the depth they must give.

Every surface is a quadric cut by quadrics, or a height over the picture's plane; a ray through each pixel's
centre meets them, so depth and normal are exact, whether rays are parallel or come from a pinhole.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine import Camera
from suite.scenes import Shape

Map = NDArray[np.float64]
Mask = NDArray[np.bool_]
Field = Callable[[Map, Map], tuple[Map, Map, Map]]
Vector = Sequence[float]

SPAN = 100.0  # of the picture's shorter side, mm, in the plane z = 0
FAR = 400.0  # from a pinhole to that plane, mm
NOISE = 1.0  # degrees, in each direction

_GRAZING = 0.05  # cosine to the viewer that no normal goes below, as those of photometric stereo do not
_FACING = 0.2  # the same of both surfaces at a seam that fixes how far they are from each other


class Scene(NamedTuple):
    """What is seen, and what is true of it.

    Normals, (H, W, 3), have x to the right, y up the picture and z to the viewer; NaN outside the mask.
    `height` is what they are to give: mm towards the viewer if there is no camera (rays are parallel then),
    else the depth along the axis. `piece` numbers the surfaces that hang together: nothing tells how far one
    is from the next; -1 outside.
    """

    normals: Map
    mask: Mask
    height: Map
    piece: NDArray[np.int32]
    pixel_size: float
    camera: Camera | None

    def slopes(self) -> tuple[Map, Map]:
        """Return dz/dx and dz/dy of parallel rays."""
        return -self.normals[..., 0] / self.normals[..., 2], -self.normals[..., 1] / self.normals[..., 2]

    def error(self, height: NDArray[np.floating[Any]]) -> float:
        """Return the mean absolute error, mm, after each piece's best offset, or with a camera scale."""
        total, (found, true, piece) = 0.0, (one[self.mask] for one in (height, self.height, self.piece))
        order = np.argsort(piece, kind="stable")
        for mine in np.split(order, np.flatnonzero(np.diff(piece[order])) + 1):
            one, other = found[mine].astype(float), true[mine]
            best = one + np.median(other - one) if self.camera is None else one * np.median(other / one)
            total += float(np.abs(best - other).sum())
        return total / len(piece)


class _Solid(NamedTuple):
    """A surface p' Q p = 0, p = (x, y, z, 1), where p' K p <= 0 of all K; it lies within a ball, if given."""

    quadric: Map
    cuts: tuple[Map, ...] = ()
    ball: tuple[Vector, float] | None = None

    def meet(self, start: Map, way: Map) -> tuple[Map, Map]:
        """Return where rays meet a solid, infinity where they miss it, and its normal there."""
        to_start = np.tensordot(self.quadric, start, 1)
        square = np.einsum("ihw,ihw->hw", way, np.tensordot(self.quadric, way, 1))
        half, constant = (np.einsum("ihw,ihw->hw", one, to_start) for one in (way, start))
        away = np.full(square.shape, np.inf)
        with np.errstate(invalid="ignore", divide="ignore"):
            root = np.sqrt(half**2 - square * constant)
            sum_ = -(half + np.where(half < 0, -root, root))
            for found in (sum_ / square, constant / sum_):
                place = start + found * way
                kept = np.isfinite(found) & (found < away)
                for cut in self.cuts:
                    kept &= np.einsum("ihw,ihw->hw", place, np.tensordot(cut, place, 1)) <= 0
                away = np.where(kept, found, away)
            place = start + np.where(np.isfinite(away), away, 0) * way
        normal = np.tensordot(self.quadric, place, 1)[:3]
        return away, normal / np.linalg.norm(normal, axis=0)


class _Sheet(NamedTuple):
    """A height z(x, y) with its derivatives, where `inside` is not negative."""

    field: Field
    inside: Callable[[Map, Map], Map]

    def meet(self, start: Map, way: Map) -> tuple[Map, Map]:
        """Return the same of a sheet, by Newton's method: parallel rays need one step, others some more."""
        away = start[2]  # z = 0
        for _ in range(1 if not way[:2].any() else 5):
            x, y, z = (start + away * way)[:3]
            height, along, upwards = self.field(x, y)
            away = away - (z - height) / (way[2] - along * way[0] - upwards * way[1])
        x, y, _ = (start + away * way)[:3]
        _, along, upwards = self.field(x, y)
        normal = np.stack([-along, -upwards, np.ones_like(x)])
        away = np.where(self.inside(x, y) >= 0, away, np.inf)
        return np.where(np.isfinite(away), away, np.inf), normal / np.linalg.norm(normal, axis=0)


def _ellipsoid(centre: Vector, radii: Vector, turn: Map | None = None, cuts: tuple[Map, ...] = ()) -> _Solid:
    quadric = np.diag([*(1 / np.square(radii)), -1.0])
    return _Solid(*_placed(centre, turn, quadric, *cuts), ball=(centre, float(np.max(radii))))


def _placed(centre: Vector, turn: Map | None, quadric: Map, *cuts: Map) -> tuple[Map, tuple[Map, ...]]:
    """Turn quadrics about the origin, and then move it to the centre."""
    back = np.eye(4)
    back[:3, :3] = np.eye(3) if turn is None else turn.T
    back[:3, 3] = -back[:3, :3] @ np.asarray(centre, float)
    return back.T @ quadric @ back, tuple(back.T @ cut @ back for cut in cuts)


def _plane(normal: Vector, distance: float) -> Map:
    quadric = np.zeros((4, 4))
    quadric[:3, 3] = quadric[3, :3] = np.asarray(normal) / 2
    quadric[3, 3] = -distance
    return quadric


def _slab(normal: Vector, low: float, high: float) -> Map:
    """Return what is not positive between two planes."""
    middle = np.array([*normal, -(low + high) / 2])
    return np.asarray(np.outer(middle, middle) - np.diag([0, 0, 0, ((high - low) / 2) ** 2]))


def _profile(square: float, linear: float, constant: float) -> Map:
    """Return a surface of revolution about y, whose radius squared is a polynomial of y."""
    quadric = np.diag([1.0, -square, 1.0, -constant])
    quadric[1, 3] = quadric[3, 1] = -linear / 2
    return quadric


def _turn(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Map:
    """Return the rotation about z, then y, then x, degrees."""
    found = np.eye(3)
    for angle, (one, other) in ((z, (0, 1)), (y, (2, 0)), (x, (1, 2))):
        cosine, sine = np.cos(np.radians(angle)), np.sin(np.radians(angle))
        step = np.eye(3)
        step[[one, one, other, other], [one, other, one, other]] = cosine, -sine, sine, cosine
        found = step @ found
    return found


def _see(
    shape: Shape,
    things: Sequence[_Solid | _Sheet],
    *,
    perspective: bool = False,
    noise: float = 0.0,
    ragged: bool = False,
) -> Scene:
    """Look at things from the direction of z."""
    rows, columns = shape
    pixel = SPAN / min(shape)
    across = (np.arange(columns) - (columns - 1) / 2) * pixel + np.zeros((rows, 1))
    up = ((rows - 1) / 2 - np.arange(rows)[:, np.newaxis]) * pixel + np.zeros(columns)
    camera = Camera(FAR / pixel, ((columns - 1) / 2, (rows - 1) / 2)) if perspective else None
    zero, one = np.zeros(shape), np.ones(shape)
    if perspective:  # a point at depth t is start + t way
        start, way = np.stack([zero, zero, FAR * one, one]), np.stack([across / FAR, up / FAR, -one, zero])
    else:
        start, way = np.stack([across, up, zero, one]), np.stack([zero, zero, -one, zero])
    depth, normals, number = np.full(shape, np.inf), np.zeros((3, *shape)), np.full(shape, -1)
    for count, thing in enumerate(things):
        seen = _window(thing, across[0], up[:, 0], perspective)
        away, normal = thing.meet(start[:, *seen], way[:, *seen])
        nearer = away < depth[seen]
        behind = np.einsum("ihw,ihw->hw", normal, way[:3, *seen]) > 0
        depth[seen] = np.where(nearer, away, depth[seen])
        normals[:, *seen] = np.where(nearer, np.where(behind, -normal, normal), normals[:, *seen])
        number[seen] = np.where(nearer, 2 * count + behind, number[seen])
    mask = np.isfinite(depth)
    mask = _tear(mask) if ragged else mask
    view = -way[:3] / np.linalg.norm(way[:3], axis=0)
    normals = _limit(np.where(mask, normals, view), view)
    piece = _pieces(np.where(mask, depth, 0), normals, view, np.where(mask, number, -1), pixel, camera)
    if noise:
        normals = normals + np.radians(noise) * np.random.default_rng(0).standard_normal(normals.shape)
        normals = _limit(normals, view)
    normals = np.moveaxis(np.where(mask, normals, np.nan), 0, -1)
    height = np.where(mask, depth if camera else -depth, np.nan)
    return Scene(normals, mask, height, piece, pixel, camera)


def _window(thing: _Solid | _Sheet, x: Map, y: Map, perspective: bool) -> tuple[slice, slice]:
    """Return the part of the picture in which a thing can be."""
    ball = thing.ball if isinstance(thing, _Solid) else None
    if ball is None:
        return slice(None), slice(None)
    centre, reach = np.asarray(ball[0], float), ball[1]
    scale = FAR / (FAR - centre[2] - reach) if perspective else 1.0
    low, high = (scale * (centre[:2] + sign * reach * 1.05) for sign in (-1, 1))
    low, high = np.minimum(low, centre[:2] - 1.05 * reach), np.maximum(high, centre[:2] + 1.05 * reach)
    (left, right), (below, above) = (
        np.searchsorted(x, [low[0], high[0]]),
        np.searchsorted(-y, [-high[1], -low[1]]),
    )
    return slice(below, above), slice(left, right)


def _limit(normals: Map, view: Map) -> Map:
    """Return unit normals that face the viewer by the least that is measured."""
    normals = normals / np.linalg.norm(normals, axis=0)
    facing = np.einsum("ihw,ihw->hw", normals, view)
    normals = normals + np.maximum(_GRAZING - facing, 0) * view
    return np.asarray(normals / np.linalg.norm(normals, axis=0))


def _tear(mask: Mask) -> Mask:
    """Return a mask without some patches along its border."""
    import cv2

    width = max(3, min(mask.shape) // 32)
    border = cv2.blur(mask.astype(np.float32), (width, width), borderType=cv2.BORDER_CONSTANT) < 0.99
    noise = np.random.default_rng(1).standard_normal(mask.shape, np.float32)
    return np.asarray(mask & ~(border & (cv2.GaussianBlur(noise, (0, 0), width / 6) > 0)))


def _pieces(
    depth: Map, normals: Map, view: Map, number: NDArray[np.int_], pixel: float, camera: Camera | None
) -> NDArray[np.int32]:
    """Give surfaces numbers, one to those that meet at a seam seen from not too flat an angle.

    At a seam the rise from a pixel to the next lies between those that the slopes of both would make.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    facing = np.einsum("ihw,ihw->hw", normals, view)
    towards = facing * np.linalg.norm(view / view[2], axis=0)  # n_z, or what stands for it under perspective
    place, flat = np.arange(depth.size).reshape(depth.shape), (depth * pixel / FAR if camera else pixel)
    ends: list[Map] = []
    for axis, sign in ((1, 1.0), (0, -1.0)):
        here, there = (np.s_[:-1], np.s_[1:]) if axis == 0 else (np.s_[:, :-1], np.s_[:, 1:])
        rise = sign * normals[1 - axis] / towards * flat  # of depth
        gap = depth[there] - depth[here]
        low, high = np.minimum(rise[here], rise[there]), np.maximum(rise[here], rise[there])
        slack = 0.1 * np.maximum(high - low, pixel)
        seam = (
            (gap > low - slack) & (gap < high + slack) & (np.minimum(facing[here], facing[there]) > _FACING)
        )
        linked = (number[here] == number[there]) | (seam & (number[here] >= 0) & (number[there] >= 0))
        ends.append(np.stack([place[here][linked], place[there][linked]]))
    first, second = np.concatenate(ends, axis=1)
    graph = coo_matrix((np.ones(len(first), np.int8), (first, second)), (depth.size,) * 2)
    _, label = connected_components(graph, directed=False)
    found = np.full(depth.size, -1, np.int32)
    found[number.ravel() >= 0] = np.unique(label[number.ravel() >= 0], return_inverse=True)[1]
    return found.reshape(depth.shape)


def ball(shape: Shape) -> Scene:
    """Return a ball that hangs before a leaning wall, and touches it nowhere."""
    return _see(shape, [_Solid(_plane((-0.2, 0.1, 1.0), 0.0)), _ellipsoid((5, -3, 45), (28, 28, 28))])


def balls(shape: Shape) -> Scene:
    """Return three balls without a ground: two have grown together, the third hides parts of both."""
    places = ((-16, -4, -10), 26), ((14, 14, -20), 24), ((12, -18, 30), 20)
    return _see(shape, [_ellipsoid(place, (size,) * 3) for place, size in places], perspective=True)


def torus(shape: Shape) -> Scene:
    """Return a ring that leans, half sunk into a ground, so that it stands above it on one side."""

    def ring(x: Map, y: Map) -> tuple[Map, Map, Map]:
        far = np.maximum(np.hypot(x, y), 1e-9)
        rise = np.sqrt(np.maximum(11**2 - (far - 28) ** 2, 1e-12))
        fall = -(far - 28) / rise / far
        return 3 + 0.35 * x + rise, 0.35 + fall * x, fall * y

    sheet = _Sheet(ring, lambda x, y: 11**2 - (np.hypot(x, y) - 28) ** 2)
    return _see(shape, [_Solid(_plane((0.0, -0.1, 1.0), 0.0)), sheet])


def stairs(shape: Shape) -> Scene:
    """Return five steps on a floor, seen from above and from one side; the other sides are cliffs."""
    faces: list[tuple[Map, tuple[Map, ...]]] = [(_plane((0, 1, 0), 0.0), ())]
    for step in range(5):
        top, front, back = 7.0 * (step + 1), 20.0 - 9 * step, 11.0 - 9 * step
        wide, deep = _slab((1, 0, 0), -24, 24), _slab((0, 0, 1), back, front)
        faces.append((_plane((0, 1, 0), top), (wide, deep)))
        faces.append((_plane((0, 0, 1), front), (wide, _slab((0, 1, 0), top - 7, top))))
        faces.append((_plane((1, 0, 0), 24), (_slab((0, 1, 0), 0, top), deep)))
    turn = _turn(x=35, y=-28)
    return _see(shape, [_Solid(*_placed((0, -10, 0), turn, face, *cuts)) for face, cuts in faces])


def goblet(shape: Shape) -> Scene:
    """Return a goblet with a thin stem, seen from above: its bowl hides the stem, its rim the inside."""
    radius, half, middle, foot, waist = 26.0, 30.0, 14.0, -40.0, -20.0
    joint, top = -8.0, 26.0
    at_joint = radius**2 * (1 - ((joint - middle) / half) ** 2)
    flare = (at_joint - 3.5**2) / (joint - waist) ** 2
    low = -36.0
    at_low = np.sqrt(3.5**2 + flare * (low - waist) ** 2)
    lean = (at_low - 20.0) / (low - foot)
    start = 20.0 - lean * foot
    parts = (
        (_bowl(radius, half, middle), joint, top),
        (_profile(flare, -2 * flare * waist, 3.5**2 + flare * waist**2), low, joint),
        (_profile(lean**2, 2 * lean * start, start**2), foot, low),
    )
    return _see(shape, _pots(parts, (0, 3, 0), 20.0), perspective=True)


def bowl(shape: Shape) -> Scene:
    """Return a bowl on a table, seen from 30 degrees above it: the near rim hides the inside."""
    parts = (_bowl(34, 32, 32), 2.0, 24.0), (_profile(0, 0, 34**2 * (1 - (30 / 32) ** 2)), 0.0, 2.0)
    table = _Solid(_placed((0, -8, 0), _turn(x=30), _plane((0, 1, 0), 0.0))[0])
    return _see(shape, [table, *_pots(parts, (0, -8, 0), 30.0)], perspective=True)


def _bowl(radius: float, half: float, middle: float) -> Map:
    """Return an ellipsoid of revolution about y."""
    share = (radius / half) ** 2
    return _profile(-share, 2 * share * middle, radius**2 - share * middle**2)


def _pots(parts: Sequence[tuple[Map, float, float]], centre: Vector, lean: float) -> list[_Solid]:
    """Return profiles between heights, leaning towards the viewer."""
    turn = _turn(x=lean)
    return [
        _Solid(*_placed(centre, turn, quadric, _slab((0, 1, 0), low, high))) for quadric, low, high in parts
    ]


def bear(shape: Shape, noise: float = NOISE) -> Scene:
    """Return a figure of ellipsoids with bumps, that hide parts of each other; noisy, its border torn."""
    parts = [
        ((0, -17, 0), (23, 25, 20)),
        ((0, 19, 7), (16, 14, 14)),
        ((0, 15, 20), (6, 5, 6)),
        ((0, -20, 14), (13, 14, 9)),
    ]
    for side in (-1, 1):
        parts += [((12 * side, 31, 3), (5, 6, 4)), ((15 * side, -36, 14), (9, 8, 11))]
    things = [_ellipsoid(centre, radii) for centre, radii in parts]
    things += [_ellipsoid((23 * side, -7, 11), (7, 15, 7), _turn(x=-25, z=25 * side)) for side in (-1, 1)]
    for angle, height, size in np.random.default_rng(0).uniform((-1.3, -0.7, 2), (1.3, 0.7, 4), (30, 3)):
        way = np.array([np.sin(angle), 0, np.cos(angle)]) * np.sqrt(1 - height**2) + (0, height, 0)
        things.append(_ellipsoid(way * (23, 25, 20) + (0, -17, 0), (size, size, 0.6 * size)))
    return _see(shape, things, perspective=True, noise=noise, ragged=True)


def leaves(shape: Shape) -> Scene:
    """Return leaves that grow from a ground at angles of their own, and hide it and each other."""
    generator = np.random.default_rng(3)
    things = [_Solid(_plane((0.1, 0.05, 1.0), 0.0))]
    for place in (np.indices((5, 5)).reshape(2, -1).T - 2) * 19.0:
        wide, long, rise, azimuth = generator.uniform((5, 9, 25, 0), (8, 13, 50, 360))
        x, y = place + generator.uniform(-4, 4, 2)
        blade, outline = np.diag([0.03, 0.012, 0, 0]), np.diag([wide**-2, long**-2, 0, 0])
        blade[2, 3] = blade[3, 2] = 0.5
        outline[1, 3] = outline[3, 1] = -1 / long
        centre = (x, y, -0.1 * x - 0.05 * y - 2)
        placed = _placed(centre, _turn(z=azimuth) @ _turn(x=rise), blade, outline)
        things.append(_Solid(*placed, ball=(centre, 2 * long + 3)))
    return _see(shape, things, perspective=True)


def folds(shape: Shape, noise: float = NOISE) -> Scene:
    """Return layers of folded cloth over a body, that end in cliffs or run into each other; noisy, torn."""

    def layer(number: int) -> _Sheet:
        lift, turn, phase = 4.0 * number, 0.5 * number, 1.3 * number

        def field(x: Map, y: Map) -> tuple[Map, Map, Map]:
            first = 0.28 * (x * np.cos(turn) + y * np.sin(turn)) + phase
            second = 0.16 * (y - 0.3 * x) + 2 * phase
            third = x / 16 + phase
            height = 20 - x**2 / 90 - y**2 / 120 + 2.5 * np.sin(first) + 3 * np.sin(second)
            height += lift * np.sin(third)
            along, up = -x / 45, -y / 60
            along += 0.7 * np.cos(turn) * np.cos(first) - 0.144 * np.cos(second) + lift / 16 * np.cos(third)
            up += 0.7 * np.sin(turn) * np.cos(first) + 0.48 * np.cos(second)
            return height, along, up

        def inside(x: Map, y: Map) -> Map:
            body = 1 - (x / 38) ** 2 - (y / 45) ** 2
            hem = 60 - 22 * number - y + 6 * np.sin(x / 9 + phase) if number else body
            return np.minimum(body, hem)

        return _Sheet(field, inside)

    return _see(shape, [layer(number) for number in range(4)], perspective=True, noise=noise, ragged=True)


SCENES: dict[str, Callable[[Shape], Scene]] = {
    scene.__name__: scene for scene in (ball, torus, stairs, balls, goblet, bowl, bear, leaves, folds)
}


def heap(number: int, shape: Shape) -> Scene:
    """Return a random heap of bodies, some cut open, on a ground or before nothing, by its seed."""
    generator = np.random.default_rng(number)
    ground = _Solid(_plane((*generator.uniform(-0.3, 0.3, 2), 1.0), 0.0))
    things: list[_Solid | _Sheet] = [ground] if number % 3 else []
    for _ in range(generator.integers(8, 20)):
        centre, radii = generator.uniform((-38, -38, -5), (38, 38, 30)), generator.uniform(6, 22, 3)
        way = generator.normal(size=3)
        near = float(generator.uniform(-0.3, 0.5) * radii.min())
        cuts = (_plane([*way / np.linalg.norm(way)], near),) if generator.random() < 0.4 else ()
        things.append(_ellipsoid([*centre], [*radii], _turn(*generator.uniform(-90, 90, 3)), cuts))
    noise = NOISE if number % 2 else 0.0
    return _see(shape, things, perspective=number % 4 > 1, noise=noise, ragged=bool(number % 2))


HELD_OUT: dict[str, Callable[[Shape], Scene]] = {f"heap {k}": partial(heap, k) for k in range(10)}
"""Of no part of which any setting was chosen: heaps from 100 on are there for that."""
