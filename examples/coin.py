"""The depth of a coin's relief.

A press on a 5 yen coin in steps of 0.02 mm: the paper's Fig. 6. The coin's faces are level and stay dark; its
slopes turn bright one after the other, and the areas between them are filled smoothly. A cross-section goes
through the middle.
"""

import numpy as np

from mirrorskin import engine
from mirrorskin.engine.base.summary import summarise
from mirrorskin.engine.metrology import section
from mirrorskin.twin import Camera, Twin, Vertical
from mirrorskin.view.result import figures_of

press = Twin(
    object="coin",
    shape=(260, 260),
    pixel_size=0.09,
    movement=Vertical(0.02 * np.arange(1, 31)),
    camera=Camera(electrons=40),
)
result = engine.reconstruct(press)
print(summarise(result))

error = engine.score(result, press.truth).height
print(
    f"RMS error {error.rms:.4f} mm on the slopes; standard deviation of a step: {0.02 / np.sqrt(12):.4f} mm"
)

profile = section(result, (-11.5, 0.0), (11.5, 0.0))
print(
    f"along {profile.distance[-1]:.1f} mm: from {np.nanmin(profile.height):.3f}"
    f" to {np.nanmax(profile.height):.3f} mm"
)

figures = figures_of(result, name="a 5 yen coin", section=((-11.5, 0.0), (11.5, 0.0)))
for what in ("height", "section"):
    figures[what].savefig(f"{what}.png", dpi=110)
