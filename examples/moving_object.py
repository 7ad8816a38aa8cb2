"""An object that moves between touches.

An object without symmetry rolls and turns by 40 degrees between ten touches. Each touch is a press and a
rotation, fused to one surface; the tracker compares these surfaces and returns the motion since the first.
"""

import math

import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial.transform import Rotation

from mirrorskin import engine, io
from mirrorskin.twin import Axial, Camera, HeightMap, Twin, Vertical

TOUCHES, SIZE, FIELD = 10, 80, 5.0  # touches, pixels of a side, mm
SIDE, SAMPLES = 9.0, 240  # of the object: mm, and samples of its height map
DEPTH = 1.4  # mm of the deepest press, from the object's origin


def pebble(x, y):
    """Return the height of a dome with waves, which no motion maps to itself."""
    dome = x * x / 10 + y * y / 7 + x * y / 30
    return 0.1 * np.sin(1.5 * x + 0.3) * np.cos(1.2 * y) + 0.06 * np.sin(2.1 * y + x) - dome


def moved(turn, shift):
    """Return the object after a rotation, (3, 3), and a translation, (3,)."""
    pixel = (SIDE / SAMPLES, SIDE / SAMPLES)
    x, y = io.pixel_axes((SAMPLES, SAMPLES), pixel)
    place = np.stack([*np.meshgrid(x, y), np.zeros((SAMPLES, SAMPLES))], axis=-1)
    for _ in range(20):  # fixed-point iteration for the height of the moved object
        local = (place - shift) @ turn
        place[..., 2] += pebble(local[..., 0], local[..., 1]) - local[..., 2]
    return HeightMap(place[..., 2], pixel, "pebble")


def touch(thing, depth, seed):
    """Press on an object, rotate about the middle of the pressed sheet, and fuse both."""
    turn = Axial(math.tau / 12 * np.arange(12), math.radians(2.5), depth, (0.0, 0.0, depth))
    movements = {"uniform": Vertical(0.05 * np.arange(1, 31)), "linear": turn}
    press, rotation = (
        Twin(
            object=thing,
            shape=(SIZE, SIZE),
            pixel_size=FIELD / SIZE,
            movement=movement,
            pattern=pattern,
            camera=Camera(
                noise=1.0,
                electrons=40.0,
                gain_deviation=0.02,
                offset_deviation=0.5,
                point_spread=0.5,
                seed=2 * seed + number,
            ),
        )
        for number, (pattern, movement) in enumerate(movements.items())
    )
    return engine.fuse(press, rotation)


progress = np.linspace(0, 1, TOUCHES)
shifts = np.stack([progress, 0.6 * np.sin(math.pi * progress), -0.05 * progress], axis=1)  # mm
turns = np.radians(np.stack([8 * np.sin(math.tau * progress), 10 * progress, 40 * progress], axis=1))

tracker, results, poses = engine.pose.PoseTracker(), [], []
for number, (turn, shift) in enumerate(zip(turns, shifts, strict=True)):
    thing = moved(Rotation.from_rotvec(turn).as_matrix(), shift)
    results.append(touch(thing, DEPTH + shift[2], number))
    poses.append(tracker.push(results[-1]))

last = poses[-1]
for axis, value, true in zip("xyz", last.translation, shifts[-1], strict=True):
    print(f"translation along {axis}: {value:+.4f} mm, true {true:+.4f} mm")
for axis, value, true in zip("xyz", np.degrees(last.rotation), np.degrees(turns[-1]), strict=True):
    print(f"rotation about {axis}: {value:+.3f} degrees, true {true:+.3f} degrees")

# Errors are the small motions from the true to the estimated poses.
rotations = np.array([pose.rotation for pose in poses])
translations = np.array([pose.translation for pose in poses])
small = Rotation.from_rotvec(rotations) * Rotation.from_rotvec(turns).inv()
sigmas = np.array([pose.sigma for pose in poses])  # of rotation, then of translation

figure, axes = plt.subplots(2, 3, figsize=(14, 8), layout="constrained")
for panel, result, name in ((axes[0, 0], results[0], "first"), (axes[1, 0], results[-1], "last")):
    panel.set_facecolor("lightsteelblue")  # no height
    picture = panel.imshow(result.height, extent=(-FIELD / 2, FIELD / 2, -FIELD / 2, FIELD / 2))
    figure.colorbar(picture, ax=panel, label="height (mm)")
    panel.plot(*shifts.T[:2], color="w", linewidth=2, label="true path")
    panel.plot(*translations.T[:2], "o", markersize=4, color="tab:red", label="estimated")
    panel.set(xlabel="x (mm)", ylabel="y (mm)", title=f"{name} touch, and the path of the origin")
    panel.legend(loc="lower right")

rows = [
    ("translation (mm)", translations, shifts, "µm", 1000 * (translations - small.apply(shifts)), 1000, 3),
    ("rotation (°)", *np.degrees([rotations, turns]), "°", np.degrees(small.as_rotvec()), 180 / math.pi, 0),
]
for (_, path, wrong), (label, value, true, unit, error, scale, first) in zip(axes, rows, strict=True):
    for part, axis in enumerate("xyz"):
        colour, sigma = f"C{part}", scale * sigmas[:, first + part]
        path.plot(true[:, part], color=colour, linewidth=1)
        path.plot(value[:, part], "o", color=colour, markersize=4, label=axis)
        wrong.fill_between(range(TOUCHES), -sigma, sigma, color=colour, alpha=0.2, linewidth=0)
        wrong.plot(error[:, part], "o-", color=colour, markersize=4, linewidth=1)
    path.set(xlabel="touch", ylabel=label, title="estimated (dots) and true (lines)")
    path.legend()
    rms = np.sqrt(np.mean(error[1:] ** 2))
    wrong.set(xlabel="touch", ylabel=f"error ({unit})", title=f"RMS error {rms:.2g} {unit}; bands: ± 1 sigma")
figure.savefig("pose.png", dpi=110)
