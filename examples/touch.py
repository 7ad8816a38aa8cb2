"""A touch: press and turn on an emulated rig until the surface has the requested standard deviation.

The rig knows nothing of the object. It finds contact, plans a recipe, and adds frames until 95 % of the
pixels have a measured standard deviation of at most 3 µm.
"""

import matplotlib.pyplot as plt
import numpy as np

from mirrorskin import engine, hw
from mirrorskin.hw.rig.rig import Rig
from mirrorskin.twin import Axial
from mirrorskin.twin.emulator.rig import EmulatedRig
from mirrorskin.twin.emulator.simulated_clock import SimulatedClock

SIGMA = 3e-3  # mm
CLOCK = SimulatedClock()  # waits take no time; your rig: hw.open_rig(hw.load_rig("rig.toml"), steps=True)
SCENE = {"shape": (96, 128), "pixel_size": 0.03, "pattern": "linear"}

surfaces = []


def show(text, result):
    """Print what happens, and keep how good the surface is."""
    print(text)
    if result is not None:
        surfaces.append(result)


with EmulatedRig("cone", rate=20.0, clock=CLOCK, **SCENE) as emulated:
    rig = Rig(emulated.open_stage(emulated.settings.stage), emulated.camera, emulated.settings, CLOCK)
    with rig, hw.RigTouch(rig, press=0.6, start=-0.8) as sensor:
        outcome = engine.live.touch(sensor, SIGMA, on_update=show)
    surface, turn = outcome.result, outcome.turn
    truth = emulated.twin(Axial(turn.phase, turn.header.tilt, turn.header.press)).truth
print(outcome)

known = np.isfinite(surface.normals[..., 0]) & (surface.height_sigma <= SIGMA)
error = 1e3 * (surface.height - truth.height)
print(f"RMS error {np.sqrt(np.mean(error[known] ** 2)):.2f} µm where at most 3 µm are requested")

figure, (left, middle, right) = plt.subplots(1, 3, figsize=(12, 3.6), layout="constrained")
extent = surface.x[0], surface.x[-1], surface.y[-1], surface.y[0]
shown = left.imshow(surface.height, extent=extent)
figure.colorbar(shown, label="height (mm)")
shown = middle.imshow(1e3 * surface.height_sigma, extent=extent, vmin=0, vmax=6)
figure.colorbar(shown, label="standard deviation (µm)")
for number, result in enumerate([*surfaces, surface], 1):
    values = np.sort(1e3 * result.height_sigma[np.isfinite(result.normals[..., 0])])
    right.plot(values, np.linspace(0, 100, len(values)), label=f"surface {number}")
right.axvline(1e3 * SIGMA, color="grey", linestyle=":")
right.set(xlim=(0, 10), xlabel="standard deviation (µm)", ylabel="pixels with normals (%)")
right.legend()
for axes in (left, middle):
    axes.set(xlabel="x (mm)", ylabel="y (mm)")
plt.savefig("touch.png", dpi=150)
