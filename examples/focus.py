"""Heights from a stack of pictures that are in focus at different heights.

A microscope with little depth of focus is lowered over a rough step in steps of 20 µm. Each pixel's
neighbourhood is sharpest in the frame that is focused on its height.
"""

import cv2
import matplotlib.pyplot as plt
import numpy as np

from mirrorskin import engine

ROWS, COLUMNS, PIXEL = 160, 240, 0.005  # pixels, mm
DEPTH = 0.06  # mm from the focus at which a point is blurred over 1.5 pixels (standard deviation)
travel = np.arange(0, 0.62, 0.02)  # mm that the microscope was lowered
rng = np.random.default_rng(3)

column = np.broadcast_to(np.arange(COLUMNS), (ROWS, COLUMNS))
height = -0.4 + 0.15 / (1 + np.exp(-(column - 120) / 6)) + 0.08 * (column > 175) * (column - 175) / 65  # mm
texture = cv2.GaussianBlur(rng.normal(0, 1, (ROWS, COLUMNS)), (0, 0), 0.8)
texture = 110 + 60 * texture / texture.std()

# Each point is blurred by its own distance from the focus: interpolated between uniformly blurred pictures.
widths = np.arange(0, 16, 0.25)
blurred = np.stack([texture, *(cv2.GaussianBlur(texture, (0, 0), width) for width in widths[1:])])
frames = []
for position in travel:
    where = np.minimum(1.5 * np.abs(position + height) / DEPTH / 0.25, len(widths) - 1.001)
    low, fraction = where.astype(int), where % 1
    rows = np.indices((ROWS, COLUMNS))
    frame = (1 - fraction) * blurred[low, *rows] + fraction * blurred[low + 1, *rows]
    frames.append(frame + rng.normal(0, 1, frame.shape))
stack = np.rint(frames).clip(0, 255).astype(np.uint8)

surface = engine.optical.find_focus(stack, travel, noise=1.0, radius=5)
error = 1e3 * (surface.height - height)
inside = np.isfinite(error)
print(f"heights at {100 * inside.mean():.0f} % of the pixels, RMS error {np.std(error[inside]):.1f} µm")
print(f"median standard error {1e3 * np.nanmedian(surface.height_sigma):.1f} µm, steps {1e3 * 0.02:.0f} µm")

extent = (0, COLUMNS * PIXEL, 0, ROWS * PIXEL)
figure, axes = plt.subplots(2, 2, figsize=(11, 7), layout="constrained")
for panel, number in zip(axes[0], (13, 20), strict=True):
    panel.imshow(stack[number], cmap="gray", extent=extent)
    panel.set(title=f"frame at {1e3 * travel[number]:.0f} µm", xlabel="x (mm)", ylabel="y (mm)")
picture = axes[1, 0].imshow(1e3 * surface.height, extent=extent)
figure.colorbar(picture, ax=axes[1, 0], label="height (µm)")
axes[1, 0].set(title="height", xlabel="x (mm)", ylabel="y (mm)")
row = ROWS // 2
place = PIXEL * np.arange(COLUMNS)
axes[1, 1].plot(place, 1e3 * height[row], color="0.6", linewidth=3, label="true")
axes[1, 1].errorbar(
    place[::4], 1e3 * surface.height[row, ::4], 1e3 * surface.height_sigma[row, ::4], fmt=".", label="found"
)
axes[1, 1].set(title="along the middle row", xlabel="x (mm)", ylabel="height (µm)")
axes[1, 1].legend()
figure.savefig("focus.png", dpi=90)
