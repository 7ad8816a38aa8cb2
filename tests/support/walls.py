"""Brightness of mirrors under a lit cylinder, from first principles in float64.

It shares no code with mirrorskin: the wall is found by halving the way, turns are products of plain matrices.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from mirrorskin.io import WallResponse
from mirrorskin.twin.view import View

RADIUS, RIM, SCATTER = 17.5, 40.0, math.radians(3.0)
TILT = math.radians(2.5)
PHASE = np.arange(8) * np.pi / 4 + 0.1
PIVOT = (0.5, -0.4, 3.0)
AXIS = (0.3, -0.2)
SIGHT = (0.006, 1e-6)
LAMPS = (0.04, -0.03)
SHADE = (0.02, -0.01, -0.05, 0.01, -0.03)


def light_at(height, gamma=1.0):
    """Return the light of a height on the wall as the centre sees it, scattered over a box; mean lamps."""
    half = math.atan2(RIM, RADIUS) / 2
    steps = np.linspace(-1, 1, 401)[1::2]
    elevation = np.arctan2(height, RADIUS)[..., np.newaxis] + SCATTER * steps
    fraction = np.clip(1 - elevation / (2 * half), 0, 1)
    return (fraction**gamma).mean(axis=-1)


def response(shape, gamma=1.0, sigma=(0.0, 0.0), **other):
    """Return the response that says so, with a curve of nine numbers."""
    top = math.atan2(RIM, RADIUS)
    elevation = np.linspace(SCATTER, top - SCATTER, 200)
    q, light = np.tan(elevation / 2), light_at(RADIUS * np.tan(elevation), gamma)
    curve = np.polynomial.Polynomial.fit(q, light, 8).convert().coef
    maps = (np.full(shape, value, np.float32) for value in sigma)
    parameters = {
        "radius": RADIUS,
        "rim": RIM,
        "axis": AXIS,
        "sight": SIGHT,
        "lamps": LAMPS,
        "scatter": SCATTER,
        "curve": curve,
        "reach": (float(q[0]), float(q[-1])),
        "shade": np.array(SHADE),
        "pattern": "graded",
        **dict(zip(("zenith_sigma", "azimuth_sigma"), maps, strict=True)),
        "parameters": ("radius",),
        "covariance": np.eye(1),
        "error": 0.002,
    }
    return WallResponse(**(parameters | other))


def light_of(curve, x, y, height, normal, phase, follows, tilt=TILT):
    """Return the light that pixels (n,), at x and y from the axis, get from mirrors at one phase.

    ``height`` is that of the mirrors in the mean pose, (n,); ``normal``, (3,) or (3, n), as the upright body
    sees them.
    """
    turn = about_z(phase) @ about_y(tilt) @ about_z(-phase)
    pivot = np.array([[PIVOT[0] - AXIS[0]], [PIVOT[1] - AXIS[1]], [PIVOT[2]]])
    pixel = np.stack([x, y, 0 * x])
    lean = SIGHT[0] + SIGHT[1] * (x**2 + y**2)
    up = np.stack([-lean * x, -lean * y, 1 + 0 * x])
    point = pivot + turn @ (pixel + height * up - pivot)
    if follows:  # the camera sees the point's new place under another angle
        moved = (point - pixel - height * up)[:2]
        up = up - lean * np.stack([*moved, 0 * x])
    else:
        point = pixel + point[2] * up
    facing = turn @ np.broadcast_to(np.asarray(normal).reshape(3, -1), up.shape)
    sight = -up / np.linalg.norm(up, axis=0)
    ray = sight - 2 * (sight * facing).sum(axis=0) * facing
    near, far = np.zeros_like(x), np.full_like(x, 1e4)
    for _ in range(80):
        middle = (near + far) / 2
        inside = np.hypot(*(point + middle * ray)[:2]) < RADIUS
        near, far = np.where(inside, middle, near), np.where(inside, far, middle)
    end = point + near * ray
    q = np.tan(np.arctan2(end[2], RADIUS) / 2)
    lamp = 1 + (LAMPS[0] * end[0] + LAMPS[1] * end[1]) / RADIUS
    return lamp * np.polynomial.Polynomial(curve)(q)


def about_z(angle):
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1.0]])


def about_y(angle):
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.array([[cosine, 0, sine], [0, 1.0, 0], [-sine, 0, cosine]])


def facing(zenith, azimuth):
    sine = np.sin(zenith)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), np.cos(zenith) + 0 * azimuth], axis=-1)


def response_of_twin(shape, pixel_size, body, distance, sigma=(0.0, 0.0)):
    """Return the response of the twin's linear pattern, told from what it is made of."""
    view = View(shape, (pixel_size, pixel_size), body, distance)
    away, lean = (np.hypot(x, y).ravel() for x, y in ((view.x, view.y), (view.slope_x, view.slope_y)))
    sight = np.linalg.lstsq(np.stack([away, away**3], axis=1), lean, rcond=None)[0]
    lamps = (
        body.asymmetry * math.cos(body.asymmetry_azimuth),
        body.asymmetry * math.sin(body.asymmetry_azimuth),
    )
    wall = response(shape, sigma=sigma, axis=(0.0, 0.0), sight=tuple(sight), lamps=lamps, shade=np.zeros(5))
    return replace(wall, curve=wall.curve / (1 + body.asymmetry))
