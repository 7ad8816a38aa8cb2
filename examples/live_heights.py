"""Heights while the body moves down.

Frames of a simulated press are pushed one by one, as from a camera, and maps are read while they arrive.
"""

import math

import matplotlib.pyplot as plt
import numpy as np

from mirrorskin import engine
from mirrorskin.twin import Camera, Twin, Vertical

SIZE, PIXEL, STEP, COUNT = 200, 0.05, 0.02, 90  # pixels of a side, mm, mm a frame, frames
press = Twin(
    object="coin",
    shape=(SIZE, SIZE),
    pixel_size=PIXEL,
    movement=Vertical(STEP * np.arange(COUNT)),
    camera=Camera(noise=1.0, electrons=40.0, seed=1),
)
frames = press.read(np.empty(press.shape, press.dtype)).frames

moments, show = [], {30, 50, 89}
with engine.live.Stream(engine.Press(), (SIZE, SIZE), header=press.header, latency=math.inf) as stream:
    for number, frame in enumerate(frames):
        stream.push(frame, travel=press.travel[number])
        if number in show:
            moments.append((number, stream.result()))  # of all frames so far
    result = stream.result()

error = 1e3 * (result.height - press.truth.height)[~result.filled.astype(bool)]
count = np.isfinite(result.height).sum()
print(f"{COUNT} frames: heights at {count} pixels, RMS error {np.nanstd(error):.1f} µm")

side = SIZE * PIXEL / 2
figure, axes = plt.subplots(1, 4, figsize=(17, 4.2), layout="constrained")
axes[0].imshow(frames[50], cmap="gray", extent=(-side, side, -side, side))
axes[0].set(title="frame 50", xlabel="x (mm)", ylabel="y (mm)")
for panel, (number, maps) in zip(axes[1:], moments, strict=True):
    panel.set_facecolor("lightsteelblue")  # not touched yet
    height = np.where(maps.filled, np.nan, maps.height)
    picture = panel.imshow(height, extent=(-side, side, -side, side), vmin=-1.8, vmax=0)
    panel.set(title=f"after frame {number}", xlabel="x (mm)", ylabel="y (mm)")
figure.colorbar(picture, ax=axes[1:], label="height (mm)", shrink=0.85)
figure.savefig("live.png", dpi=80)
