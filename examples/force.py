"""Forces of presses, in newtons.

The gel and its modulus are calibrated with balls and a scale, as on a real sensor. The forces of other
presses then follow from their frames alone, and are compared with those of the simulation.
"""

from pathlib import Path

import numpy as np

from mirrorskin import engine, hw, io, view
from mirrorskin.engine.calibration.force import fit_stiffness, known_press
from mirrorskin.engine.calibration.gel import ball_onset, fit_gel
from mirrorskin.engine.press.press import Press
from mirrorskin.hw.twin import Body, Camera, Sphere, Vertical

SIZE, PIXEL = 56, 8.64 / 56  # pixels of a side, and mm
STEP, MODULUS, SCALE_ERROR = 0.03, 0.1, 0.001  # mm, MPa, N


def press(diameter, depth, seed):
    """Return a press of a ball of some diameter to some depth, mm."""
    camera = Camera(
        noise=1.0, electrons=40.0, gain_deviation=0.02, offset_deviation=0.5, point_spread=0.5, seed=seed
    )
    return hw.Twin(
        object=Sphere(diameter),
        shape=(SIZE, SIZE),
        pixel_size=PIXEL,
        movement=Vertical(STEP * np.arange(1, round(depth / STEP) + 1)),
        contact="elastic",
        optics="cylinder",
        body=Body(modulus=MODULUS),
        camera=camera,
        references="ball",
    )


def true_force(twin):
    """Return the force at the end of a press, N."""
    return float(twin.truth.force[-1, 2])


# The gel: how far ahead of the contact pixels turn bright, learned from two balls of known diameter.
balls = {4: press(4, 1.2, 0), 8: press(8, 1.2, 1)}
gel = fit_gel([ball_onset(Press(fill=False).run(twin), twin, size / 2) for size, twin in balls.items()]).gel
camera = io.CameraId("", (SIZE, SIZE), np.dtype(balls[4].dtype))
known = io.Calibration(camera, gel=gel)

# The modulus: four presses on a scale whose readings have a standard deviation of 1 mN.
generator = np.random.default_rng(1)
weighed = [
    known_press(twin, known, true_force(twin) + SCALE_ERROR * generator.normal(), SCALE_ERROR)
    for twin in (*balls.values(), press(6, 0.6, 20), press(10, 0.9, 21))
]
for part in (gel, fit_stiffness(weighed, gel).stiffness):
    known = io.update_calibration(Path("force-cal.h5"), part, camera)

results, truths = {}, {}
for number, (diameter, depth) in enumerate([(3, 0.81), (5, 0.51), (5, 1.02), (7, 0.75), (9, 1.05)]):
    twin = press(diameter, depth, 40 + number)
    name = f"ball {diameter} mm, {depth:g} mm deep"
    results[name], truths[name] = engine.reconstruct(twin, known, fill=False), true_force(twin)
    found, sigma = results[name].force, results[name].force_sigma
    print(f"{name}: {found:.4f} ± {sigma:.4f} N, true {truths[name]:.4f} N")

pressure = engine.force.find_force(twin.truth.height, depth, PIXEL, MODULUS).pressure
title = "Forces of presses: gel of 100 kPa, calibrated with a scale"
view.force_figure(results, truths, pressure, title, Path("force.png"))
