"""A mirror's shape from fringes on a screen.

A camera looks straight down at a slightly wavy mirror, and sees in it a screen 300 mm above that shows
shifted fringes. The phases give the point of the screen that each pixel sees, hence the slope of the mirror
(deflectometry), and integration gives its heights.
"""

import matplotlib.pyplot as plt
import numpy as np

from mirrorskin import engine

SIZE, PIXEL = 240, 0.25  # pixels of a side, and mm
DISTANCE, SCREEN = 300.0, 200.0  # mm from the mirror to the screen, and the screen's side
RATES = [1, 7, 40]  # fringes over the screen
SHIFTS = np.arange(8) * 2 * np.pi / 8  # radians
rng = np.random.default_rng(0)

y, x = (PIXEL * (SIZE / 2 - 0.5 - np.indices((SIZE, SIZE))[0]), PIXEL * (np.indices((SIZE, SIZE))[1] - 119.5))
true = 0.05 * np.cos(x / 6) * np.cos(y / 8) + 0.02 * np.exp(-((x - 8) ** 2 + (y - 5) ** 2) / 30)  # mm
rows, columns = np.gradient(true, PIXEL)
slopes = {"x": columns, "y": -rows}  # y points up
places = {"x": x, "y": y}


def seen(axis):
    """Return the coordinate of the screen's point that each pixel sees, mm: a slope turns the ray twice."""
    return places[axis] + DISTANCE * np.tan(2 * np.arctan(slopes[axis]))


def measured(axis):
    """Return the slope along an axis and its standard error, from frames of fringes."""
    fits = []
    for rate in RATES:
        phase = 2 * np.pi * rate * (seen(axis) / SCREEN + 0.5)
        light = 110 + 80 * np.cos(phase - SHIFTS[:, None, None]) + rng.normal(0, 1.5, (8, SIZE, SIZE))
        fits.append(engine.optical.fit_fringes(np.rint(light).astype(np.uint8), SHIFTS))
    unwrapped = engine.optical.unwrap_frequencies(fits, RATES)
    turns = 2 * np.pi * RATES[-1]
    place = np.where(unwrapped.risk <= 1e-3, SCREEN * (unwrapped.phase / turns - 0.5), np.nan)
    slope = np.tan(0.5 * np.arctan((place - places[axis]) / DISTANCE))
    return slope, unwrapped.phase_sigma * SCREEN / turns / (2 * DISTANCE), unwrapped


along_x, sigma_x, fringes = measured("x")
along_y, _, _ = measured("y")
surface = engine.integrate(along_x, along_y, PIXEL)
error = 1e6 * (surface.height - surface.height.mean() - true + true.mean())  # nm
chi2 = np.mean(((along_x - slopes["x"]) / sigma_x) ** 2)
print(f"slopes: error {1e6 * np.std(along_x - slopes['x']):.1f} µrad, (error / standard error)² {chi2:.2f}")
print(f"heights: RMS error {error.std():.0f} nm over {SIZE * PIXEL:g} mm, of {1e3 * np.ptp(true):.0f} µm")

side = SIZE * PIXEL / 2
figure, axes = plt.subplots(1, 4, figsize=(17, 4.2), layout="constrained")
for panel, values, label, title in (
    (axes[0], fringes.phase % (2 * np.pi), "phase (rad)", "phase of the finest fringes"),
    (axes[1], 1e3 * along_x, "slope (mrad)", "slope along x"),
    (axes[2], 1e3 * (surface.height - surface.height.mean()), "height (µm)", "height"),
    (axes[3], error, "error (nm)", f"error: RMS {error.std():.0f} nm"),
):
    colours = "twilight" if panel is axes[0] else "coolwarm" if panel is axes[3] else "viridis"
    picture = panel.imshow(values, extent=(-side, side, -side, side), cmap=colours)
    figure.colorbar(picture, ax=panel, label=label, shrink=0.75)
    panel.set(xlabel="x (mm)", ylabel="y (mm)", title=title)
figure.savefig("fringes.png", dpi=80)
