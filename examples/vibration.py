"""Three vibrations: strokes, rocking and dither.

A press that goes up and down averages its strokes and measures the hysteresis of the stage. A body that
rocks about one axis gives the slope along that axis. A press that dithers in contact gives the rate at
which the lit area grows.
"""

import math

import matplotlib.pyplot as plt
import numpy as np
from scipy import ndimage

from mirrorskin import engine, io
from mirrorskin.engine.vibration.lock_in import LockIn
from mirrorskin.io.model.positions import stroke_starts
from mirrorskin.twin import Camera, HeightMap, Leaning, Twin, Vertical

SIZE, FIELD = 110, 6.0  # pixels of a side, mm
LAB = Camera(noise=1.0, electrons=40.0, gain_deviation=0.02, offset_deviation=0.5, point_spread=0.5)


def simulate(thing, movement, *, camera=LAB, **sensor):
    """Return a twin, and its frames."""
    options = {"shape": (SIZE, SIZE), "pixel_size": FIELD / SIZE, "camera": camera, **sensor}
    twin = Twin(object=thing, movement=movement, **options)
    frames = np.empty(twin.shape, twin.dtype)
    twin.read(frames)
    twin.rewind()
    return twin, frames


def rms(values):
    """Return the root mean square of the defined values."""
    return float(np.sqrt(np.nanmean(np.square(values, dtype=float))))


# 16 strokes of a stage with a backlash of 0.05 mm: on the way up it lags behind the reported travel.
TRAVEL, TURN, BACKLASH, STROKES = 1.2, 0.388, 0.05, 16
travel = TRAVEL / 2 * (1 - np.cos(TURN * np.arange(round(STROKES * math.tau / TURN))))
true = [0.0]
for place in travel[1:]:
    true.append(float(np.clip(true[-1], place, place + BACKLASH)))
twin, frames = simulate("sphere", Vertical(np.array(true)), references="exact")
# At the zenith where the wall begins, pixels hardly turn bright, and noise crosses their threshold.
truth = np.where(twin.truth.zenith > math.radians(14), twin.truth.height, np.nan)
reached = truth > -TRAVEL + BACKLASH
run = engine.Run(engine.press.Strokes(dark=twin.header.dark, bright=twin.header.bright))
curve = []
ends = stroke_starts(travel, 1)[::2].tolist()
for start, stop in zip([0, *ends], ends, strict=False):
    run.push(frames[start:stop], travel=travel[start:stop])
    onset = run.result()
    error = np.where(reached, onset.height - truth, np.nan)
    curve.append(
        (len(curve) + 1.0, rms(error), rms(np.where(np.isfinite(error), onset.height_sigma, np.nan)))
    )
run.push(frames[ends[-1] :], travel=travel[ends[-1] :])
x, y = io.pixel_axes(twin.shape[1:], twin.header.pixel_size)
pressed = run.result().assign(x=x, y=y)
lag = 1000 * float(np.nanmean(pressed.hysteresis[np.isfinite(truth)]))
count, rms_error, expected = (round(curve[-1][0]), 1000 * curve[-1][1], 1000 * curve[-1][2])
print(f"height after {count} strokes: RMS error {rms_error:.1f} µm, expected {expected:.1f} µm")
print(f"hysteresis: {lag:.1f} µm, true {1000 * BACKLASH:.0f} µm")

# A body that rocks by 2.5 degrees about the tip of a pyramid with five sides.
SIDES, DIRECTION, DEPTH, PIXEL = 5, 0.6, 1.2, 9.0 / 600
x, y = io.pixel_axes((600, 600), (PIXEL, PIXEL))
around = math.tau * np.arange(SIDES)[:, None, None] / SIDES
distance = (x * np.cos(around) + y[:, None] * np.sin(around)).max(axis=0)
pyramid = HeightMap(-math.tan(math.radians(24)) * distance, (PIXEL, PIXEL), "pyramid")
tilt = math.radians(2.5) * np.sin(0.385 * np.arange(48))
movement = Leaning(np.full(48, DIRECTION), tilt, DEPTH, (0.0, 0.0, DEPTH))
twin, _ = simulate(pyramid, movement, pattern="linear")
rocked = engine.reconstruct(twin)
slope = -np.tan(twin.truth.zenith) * np.cos(twin.truth.azimuth - rocked.fitted.slope_direction)
# Not next to the ridges and the border of the contact.
one_side = ndimage.maximum_filter(slope, 7) - ndimage.minimum_filter(slope, 7) < 1e-3
slope = np.where(one_side & ndimage.binary_erosion(twin.truth.contact == 1, iterations=2), slope, np.nan)
error = np.where(rocked.contact == 1, rocked.slope - slope, np.nan)
sigma = np.where(np.isfinite(error), rocked.slope_sigma, np.nan)
print(f"slope: RMS error {rms(error):.4f}, expected {rms(sigma):.4f}")

# A press that dithers by 0.05 mm on a ball in elastic contact; without noise the area grows by `growth`.
SWING, contact = 0.05, {"contact": "elastic", "references": "exact"}
twin, _ = simulate("sphere", Vertical(1.0 + SWING * np.cos(math.tau / 7.3 * np.arange(74))), **contact)
dithered = LockIn(dither=True).run(twin)
noiseless = Camera(np.dtype(np.uint16), noise=0.0)
twin, frames = simulate("sphere", Vertical(1.0 + SWING * np.array([-0.5, 0.5])), camera=noiseless, **contact)
lit = (frames - twin.header.dark.astype(float)) / (twin.header.bright - twin.header.dark)
growth = float(np.sum(lit[1] - lit[0])) * (FIELD / SIZE) ** 2 / SWING
grown, grown_sigma = dithered.process["area_growth"], dithered.process["area_growth_sigma"]
print(f"lit area: grows by {grown:.3f} ± {grown_sigma:.3f} mm² for each mm of travel, true {growth:.3f}")

# The strokes: height after each, hysteresis, and errors divided by their standard deviations.
figure, axes = plt.subplots(2, 3, figsize=(15, 8), layout="constrained")
count, height_error, height_sigma = np.array(curve).T
panel = axes[0, 0]
panel.loglog(count, 1000 * height_error, "o", label="RMS error")
panel.loglog(count, 1000 * height_sigma, label="predicted")
panel.loglog(count, 1000 * height_error[0] / np.sqrt(count), ":", color="0.6", label="first error / √strokes")
panel.set(xlabel="strokes down", ylabel="height (µm)", title="an oscillating press", xticks=[1, 2, 4, 8, 16])
panel.minorticks_off()
panel.set_yticks([6, 10, 20, 30, 60])
for axis in (panel.xaxis, panel.yaxis):
    axis.set_major_formatter("{x:g}")
panel.legend()
valid = np.isfinite(pressed.hysteresis + truth)
lags = 1000 * pressed.hysteresis[valid]
panel = axes[0, 1]
panel.hist(lags, np.linspace(*np.percentile(lags, [0.2, 99.8]), 60))
panel.axvline(1000 * BACKLASH, color="tab:red", label="true")
panel.set(xlabel="release - onset (µm)", ylabel="pixels", title=f"hysteresis: mean {lag:.1f} µm")
panel.legend()
bins, panel = np.linspace(-4, 4, 65), axes[0, 2]
for name, ratio in (
    ("height", (pressed.height - truth) / pressed.height_sigma),
    ("hysteresis", (pressed.hysteresis - BACKLASH)[valid] / pressed.hysteresis_sigma[valid]),
    ("slope", error / sigma),
):
    label = f"{name}: mean square {np.nanmean(ratio**2):.2f}"
    panel.hist(ratio[np.isfinite(ratio)], bins, density=True, histtype="step", label=label)
panel.plot(bins, np.exp(-(bins**2) / 2) / math.sqrt(math.tau), color="0.6", label="normal")
panel.set(xlabel="error / standard deviation", ylim=(0, 1.1), title="errors and their prediction")
panel.legend()

# The maps of rocking and dither.
measured = np.where(rocked.contact == 1, rocked.slope, np.nan)
largest = np.nanpercentile(dithered.growth, 99.5)
area = f"dither: {grown:.2f} mm²/mm, true {growth:.2f}"
for panel, values, label, title, limit in (
    (axes[1, 0], measured, "slope", "rocking: slope along one direction", np.nanmax(np.abs(slope))),
    (axes[1, 1], error, "error of the slope", f"its error: RMS {rms(error):.3f}", 4 * rms(error)),
    (axes[1, 2], dithered.growth, "growth (1/mm)", area, largest),
):
    panel.set_facecolor("lightsteelblue")  # undefined
    extent = (-FIELD / 2, FIELD / 2, -FIELD / 2, FIELD / 2)
    picture = panel.imshow(values, extent=extent, vmin=-limit, vmax=limit, cmap="coolwarm")
    figure.colorbar(picture, ax=panel, label=label)
    panel.set(xlabel="x (mm)", ylabel="y (mm)", title=title)
figure.savefig("vibration.png", dpi=110)
