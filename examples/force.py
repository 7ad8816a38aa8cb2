"""Forces of presses, in newtons.

The gel and its modulus are calibrated with balls and a scale, as on a real sensor. The forces of other
presses then follow from their frames alone, and are compared with those of the simulation.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from mirrorskin import engine, io
from mirrorskin.engine.calibration.force import fit_stiffness, known_press
from mirrorskin.engine.calibration.gel import ball_onset, fit_gel
from mirrorskin.engine.press.press import Press
from mirrorskin.twin import Body, Camera, Sphere, Twin, Vertical

SIZE, PIXEL = 56, 8.64 / 56  # pixels of a side, and mm
STEP, MODULUS, SCALE_ERROR = 0.03, 0.1, 0.001  # mm, MPa, N


def press(diameter, depth, seed):
    """Return a press of a ball of some diameter to some depth, mm."""
    camera = Camera(
        noise=1.0, electrons=40.0, gain_deviation=0.02, offset_deviation=0.5, point_spread=0.5, seed=seed
    )
    return Twin(
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
calibration = io.Calibration(camera, gel=gel)

# The modulus: four presses on a scale whose readings have a standard deviation of 1 mN.
generator = np.random.default_rng(1)
weighed = [
    known_press(twin, calibration, true_force(twin) + SCALE_ERROR * generator.normal(), SCALE_ERROR)
    for twin in (*balls.values(), press(6, 0.6, 20), press(10, 0.9, 21))
]
for part in (gel, fit_stiffness(weighed, gel).stiffness):
    calibration = io.update_calibration(Path("force-cal.h5"), part, camera)

forces, sigmas, truths = [], [], []
for number, (diameter, depth) in enumerate([(3, 0.81), (5, 0.51), (5, 1.02), (7, 0.75), (9, 1.05)]):
    twin = press(diameter, depth, 40 + number)
    result, true = engine.reconstruct(twin, calibration, fill=False), true_force(twin)
    name = f"ball {diameter} mm, {depth:g} mm deep"
    print(f"{name}: {result.force:.4f} ± {result.force_sigma:.4f} N, true {true:.4f} N")
    forces.append(result.force)
    sigmas.append(result.force_sigma)
    truths.append(true)

# The pressure of the last press, a cut through it, and the errors of all forces.
pressure, x = 1000 * result.pressure, result.x  # kPa
true = 1000 * engine.force.find_force(twin.truth.height, depth, PIXEL, MODULUS).pressure
forces, sigmas, truths = np.array(forces), np.array(sigmas), np.array(truths)
error, row = 100 * (forces - truths) / truths, SIZE // 2

figure, axes = plt.subplots(1, 3, figsize=(14, 4.5), layout="constrained")
side = SIZE * PIXEL / 2
picture = axes[0].imshow(pressure, extent=(-side, side, -side, side))
figure.colorbar(picture, ax=axes[0], label="pressure (kPa)")
axes[0].axhline(result.y[row], color="tab:red", linestyle=":")
axes[0].set(xlabel="x (mm)", ylabel="y (mm)", title=name)
axes[1].plot(x, true[row], color="0.6", linewidth=3, label="true")
axes[1].plot(x, pressure[row], ".", label="estimated")
axes[1].set(xlabel="x (mm)", ylabel="pressure (kPa)", title="along the dotted line")
axes[1].legend()
axes[2].axhline(0, color="0.6")
axes[2].errorbar(truths, error, 100 * sigmas / truths, fmt="o", capsize=3)
rms = np.sqrt(np.mean(error**2))
axes[2].set(xlabel="true force (N)", ylabel="error (%)", title=f"{len(error)} presses: RMS error {rms:.2g} %")
figure.savefig("force.png", dpi=110)
