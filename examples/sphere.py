"""A ball from a press.

The twin, a simulated sensor, is lowered onto a 10 mm ball in steps of 0.1 mm: the paper's Fig. 5. The
height of a pixel is minus the travel at which it turned bright. The level top never did: this hole is filled
smoothly and marked in `filled`. The errors are known from the ground truth of the simulation.
"""

import numpy as np

from mirrorskin import engine
from mirrorskin.engine.base.summary import summarise
from mirrorskin.twin import Camera, Twin, Vertical
from mirrorskin.view.result import figures_of

press = Twin(
    object="sphere",
    shape=(160, 160),
    pixel_size=0.065,
    movement=Vertical(0.1 * np.arange(1, 31)),
    camera=Camera(electrons=40),  # per grey level: shot noise
)
result = engine.reconstruct(press)
print(summarise(result))

error = engine.score(result, press.truth).height
print(f"mean error {error.mean:+.3f} mm, RMS {error.rms:.3f} mm, at {error.answered} pixels")
print(f"standard deviation of a step of 0.1 mm: {0.1 / np.sqrt(12):.3f} mm")

figures = figures_of(result, name="a ball of 10 mm, from a press")
for what in ("height", "section"):
    figures[what].savefig(f"{what}.png", dpi=110)
