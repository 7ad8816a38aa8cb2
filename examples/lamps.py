"""Normals, albedo and heights from pictures under one lamp after another.

A matt relief with a printed pattern is photographed under eight lamps. The brightness of each pixel gives its
normal and its albedo, so that print is not mistaken for shape; integration gives heights.
"""

import matplotlib.pyplot as plt
import numpy as np

from mirrorskin import engine

SIZE, PIXEL, LAMPS, ZENITH = 200, 0.05, 8, np.radians(35)  # pixels of a side, mm, lamps, radians
rng = np.random.default_rng(5)

rows, columns = np.indices((SIZE, SIZE))
x, y = PIXEL * (columns - SIZE / 2 + 0.5), PIXEL * (SIZE / 2 - 0.5 - rows)
distance = np.hypot(x, y)
true = 0.5 * np.exp(-((distance - 2.5) ** 2) / 0.8) + 0.15 * np.cos(2.2 * x) * np.exp(
    -(distance**2) / 9
)  # mm
down, across = np.gradient(true, PIXEL)
normals = np.dstack([-across, down, np.ones_like(true)])
normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
print_pattern = np.where((columns // 25 + rows // 25) % 2, 150.0, 210.0)  # counts in full light

azimuth = 2 * np.pi * np.arange(LAMPS) / LAMPS
lamps = np.column_stack(
    [np.sin(ZENITH) * np.cos(azimuth), np.sin(ZENITH) * np.sin(azimuth), np.full(LAMPS, np.cos(ZENITH))]
)
light = print_pattern * np.maximum(np.einsum("hwk,tk->thw", normals, lamps), 0)
frames = np.rint(light + rng.normal(0, 1, light.shape)).clip(0, 255).astype(np.uint8)

estimate = engine.optical.photometric_stereo(frames, azimuth, zenith=ZENITH, shadow=4)
angle = np.degrees(np.arccos(np.clip(np.sum(estimate.normals * normals, axis=-1), -1, 1)))
slopes = -estimate.normals[..., :2] / estimate.normals[..., 2:]
surface = engine.integrate(slopes[..., 0], slopes[..., 1], PIXEL)
error = surface.height - surface.height.mean() - true + true.mean()
print(
    f"normals: median error {np.nanmedian(angle):.2f} degrees, albedo {np.median(estimate.albedo):.0f} counts"
)
print(f"heights: RMS error {1e3 * np.nanstd(error):.1f} µm of {1e3 * np.ptp(true):.0f} µm")

side = SIZE * PIXEL / 2
figure, axes = plt.subplots(1, 4, figsize=(17, 4.2), layout="constrained")
for panel, values, label, title, colours in (
    (axes[0], frames[0], "counts", "first frame", "gray"),
    (axes[1], estimate.albedo, "counts", "albedo: the print", "gray"),
    (axes[2], 0.5 + 0.5 * estimate.normals, "", "normals as colours", None),
    (axes[3], surface.height - surface.height.mean(), "height (mm)", "height", "viridis"),
):
    picture = panel.imshow(values, extent=(-side, side, -side, side), cmap=colours)
    if label:
        figure.colorbar(picture, ax=panel, label=label, shrink=0.75)
    panel.set(xlabel="x (mm)", ylabel="y (mm)", title=title)
figure.savefig("lamps.png", dpi=80)
