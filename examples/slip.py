"""A ball that slides and one that twists.

A ball is pressed on a speckled skin and slid, or twisted, until the rim of the contact slips. The frames
give the displacement of the skin, where and when it starts to slip, and which share still sticks. The last
agrees with the closed forms of Cattaneo and Mindlin (slide) and of Lubkin (twist).
"""

import math
from pathlib import Path

import numpy as np
from scipy import special

from mirrorskin import engine, hw, io, view
from mirrorskin.hw.twin import Body, Camera, Horizontal, SheetTexture, Sphere, Twist

RADIUS, PRESS, FRICTION = 5.0, 0.5, 0.5  # mm, mm
FRAMES, SIZE, PIXEL = 16, 128, 0.03  # frames, pixels of a side, mm


def find_slip(movement, stick_ratio):
    """Simulate a movement and find its slip; `stick_ratio` is the closed form for each frame."""
    twin = hw.Twin(
        object=Sphere(2 * RADIUS),
        shape=(SIZE, SIZE),
        pixel_size=PIXEL,
        movement=movement,
        contact="elastic",
        body=Body(friction=FRICTION),
        camera=Camera(noise=1.0, electrons=40.0, gain_deviation=0.02, offset_deviation=0.5, point_spread=0.5),
        texture=SheetTexture("flakes", size=0.12, contrast=0.9),
    )
    frames = np.empty(twin.shape, twin.dtype)
    twin.read(frames)
    contact = twin.sheet(0).contact
    slip = engine.slip.Slip(pixel_size=PIXEL, motion=twin.motion, contact=contact)
    slip.push(frames, **{"twist" if twin.motion == "twist" else "displacement": movement.path})
    x, y = io.pixel_axes(twin.shape[1:], (PIXEL, PIXEL))
    return view.Slipped(slip.result(), twin.truth, contact, stick_ratio, x, y)


# A slide to 0.9 of the distance at which the whole contact slips.
share = np.linspace(0, 0.9, FRAMES)
slide = Horizontal(np.outer(1.5 * FRICTION * PRESS * share, [1.0, 0.0]), PRESS)
# A twist after which half of the radius of the contact sticks (Lubkin, 1951).
stuck = np.linspace(1, 0.5, FRAMES)
largest = 4 * FRICTION * math.sqrt(PRESS / RADIUS) / math.pi
twist = Twist(largest * (special.ellipk(1 - stuck**2) - special.ellipe(1 - stuck**2)), PRESS)

slid, twisted = find_slip(slide, 1 - share), find_slip(twist, stuck**2)
for name, found in (("slide", slid), ("twist", twisted)):
    error = 1000 * np.sqrt(np.nanmean(found.displacement_error**2))
    radii = (found.found.stick_ratio[-1], found.true_ratio[-1], found.closed[-1])
    ratios = ", ".join(
        f"{what} {math.sqrt(ratio):.3f}"
        for what, ratio in zip(("found", "true", "closed form"), radii, strict=True)
    )
    print(f"{name}: displacement within {error:.2f} µm RMS; of the contact's radius sticks: {ratios}")
turned = math.degrees(twisted.found.process["angle"])
print(f"twist: {turned:.3f} degrees, true {-math.degrees(twist.path[-1]):.3f}")

title = "Slip: a ball of 10 mm, friction 0.5 (black: contact; red: what sticks at the end)"
view.slip_figure(slid, twisted, title, Path("slip.png"))
