"""A ball that slides and one that twists.

A ball is pressed on a speckled skin and slid, or twisted, until the rim of the contact slips. The frames
give the displacement of the skin, where and when it starts to slip, and which share still sticks. The last
agrees with the closed forms of Cattaneo and Mindlin (slide) and of Lubkin (twist).
"""

import math

import matplotlib.pyplot as plt
import numpy as np
from scipy import special

from mirrorskin import engine, io
from mirrorskin.twin import Body, Camera, Horizontal, SheetTexture, Sphere, Twin, Twist

RADIUS, PRESS, FRICTION = 5.0, 0.5, 0.5  # mm, mm
FRAMES, SIZE, PIXEL = 16, 128, 0.03  # frames, pixels of a side, mm


def find_slip(movement):
    """Simulate a movement; return its result, its truth, and where the skin touched the ball before."""
    twin = Twin(
        object=Sphere(2 * RADIUS),
        shape=(SIZE, SIZE),
        pixel_size=PIXEL,
        movement=movement,
        contact="elastic",
        body=Body(friction=FRICTION),
        camera=Camera(noise=1.0, electrons=40.0, gain_deviation=0.02, offset_deviation=0.5, point_spread=0.5),
        texture=SheetTexture("flakes", size=0.12, contrast=0.9),
    )
    contact = twin.sheet(0).contact
    slip = engine.slip.SlipOnset(pixel_size=PIXEL, motion=twin.motion, contact=contact)
    return engine.run(twin, slip), twin.truth, contact


def rms(error):
    """Return the root mean square of an error where it is defined."""
    return math.sqrt(np.nanmean(np.square(error, dtype=float)))


def draw_map(panel, values, contact, sticks, label, title, **colours):
    """Draw a map with the borders of the contact (black) and of the sticking part (red)."""
    side = SIZE * PIXEL / 2
    panel.set_facecolor("lightsteelblue")  # undefined
    picture = panel.imshow(values, extent=(-side, side, -side, side), **colours)
    panel.figure.colorbar(picture, ax=panel, label=label)
    x, y = io.pixel_axes((SIZE, SIZE), (PIXEL, PIXEL))
    for part, colour in ((contact, "k"), (sticks, "tab:red")):
        panel.contour(x, y, part, [0.5], colors=colour, linewidths=1)
    panel.set(xlabel="x (mm)", ylabel="y (mm)", title=title)


# A slide to 0.9 of the distance at which the whole contact slips.
force_ratio = np.linspace(0, 0.9, FRAMES)
slide = Horizontal(np.outer(1.5 * FRICTION * PRESS * force_ratio, [1.0, 0.0]), PRESS)
# A twist after which half of the radius of the contact sticks (Lubkin, 1951).
stuck = np.linspace(1, 0.5, FRAMES)
largest = 4 * FRICTION * math.sqrt(PRESS / RADIUS) / math.pi
twist = Twist(largest * (special.ellipk(1 - stuck**2) - special.ellipe(1 - stuck**2)), PRESS)

figure, axes = plt.subplots(2, 4, figsize=(18, 8), layout="constrained")
figure.suptitle("black: border of the contact; red: border of the part that sticks at the end")
for row, name, movement, theory, closed, unit, scale in (
    (axes[0], "slide", slide, "Cattaneo and Mindlin", 1 - force_ratio, "mm", 1.0),
    (axes[1], "twist", twist, "Lubkin", stuck**2, "°", 180 / math.pi),
):
    result, truth, contact = find_slip(movement)
    distance = result.slide_distance if name == "slide" else result.twist_angle
    onset = np.where(contact, truth.slip_onset, np.nan)
    true = np.array([1 - np.mean(onset[contact] <= distance_slid) for distance_slid in distance])
    error = 1000 * np.linalg.norm(result.displacement - truth.displacement[-1], axis=-1)
    ratios = (result.stick_ratio[-1], true[-1], closed[-1])
    radii = "found {:.3f}, true {:.3f}, closed form {:.3f}".format(*map(math.sqrt, ratios))
    print(f"{name}: displacement within {rms(error):.2f} µm RMS; of the contact's radius sticks: {radii}")

    outlines = contact, contact & np.isnan(onset)
    moved = 1000 * np.linalg.norm(result.displacement, axis=-1)
    title = f"{name}: displacement, RMS error {rms(error):.1f} µm"
    draw_map(row[0], moved, *outlines, "displacement (µm)", title)
    across, up = np.moveaxis(result.displacement[5::10, 5::10], -1, 0)
    arrows = {"angles": "xy", "scale_units": "xy", "scale": 1, "width": 6e-3}
    row[0].quiver(result.x[5::10], result.y[5::10], across, up, color="w", **arrows)
    draw_map(row[1], scale * result.slip_onset, *outlines, f"{name} ({unit})", f"{name} at which slip starts")
    wrong = scale * (result.slip_onset - onset)
    side = np.nanpercentile(np.abs(wrong), 99)
    colours = {"cmap": "coolwarm", "vmin": -side, "vmax": side}
    draw_map(
        row[2], wrong, *outlines, f"error ({unit})", f"its error: RMS {rms(wrong):.2g} {unit}", **colours
    )
    row[3].plot(scale * distance, closed, color="0.6", linewidth=3, label=theory)
    row[3].plot(scale * distance, true, color="tab:red", linewidth=1, label="simulation")
    row[3].plot(scale * distance, result.stick_ratio, "o", markersize=4, label="estimated")
    row[3].set(xlabel=f"{name} ({unit})", ylabel="share of the contact that sticks", ylim=(0, 1.05))
    row[3].legend()

turned = math.degrees(result.process["angle"])
print(f"twist: {turned:.3f} degrees, true {-math.degrees(twist.path[-1]):.3f}")
figure.savefig("slip.png", dpi=80)
