"""From the paper's ideal sensor to a real one.

The same press on a ball, and on a 5 yen coin, with four sensors: contact as in the paper (the sheet takes
the object's shape) or that of an elastic body, and light that depends on the zenith alone or is ray-traced
from a lit wall. An elastic body bends ahead of the contact, so that pixels turn bright where nothing
touches: a systematic error, which the calibration of the gel corrects.
"""

from pathlib import Path

import numpy as np

from mirrorskin import engine, view
from mirrorskin.twin import Camera, Twin, Vertical

CONTACTS = {"conform": "ideal contact", "elastic": "elastic body"}
LIGHTS = {"ideal": "ideal light", "cylinder": "lit wall"}
CAMERA = Camera(noise=1.0, electrons=40.0, gain_deviation=0.02, offset_deviation=0.5, point_spread=0.5)


def compare(thing, title, size, pixel_size, step, *, surface=False):
    """Press on an object with each sensor, print the errors, and draw the heights."""
    results, truths = {}, []
    for contact, first in CONTACTS.items():
        for optics, second in LIGHTS.items():
            press = Twin(
                object=thing,
                shape=(size, size),
                pixel_size=pixel_size,
                movement=Vertical(step * np.arange(1, 31)),
                contact=contact,
                optics=optics,
                camera=CAMERA,
                references="ball",
            )
            result, name = engine.reconstruct(press), f"{first}, {second}"
            error = engine.score(result, press.truth).height
            measured = np.isfinite(result.height) & (result.filled == 0)
            untouched = np.count_nonzero(measured & (press.truth.contact == 0))
            print(
                f"{thing}, {name}: RMS error {error.rms:.3f} mm, mean {error.mean:+.3f} mm at"
                f" {error.answered} pixels; {untouched} pixels turned bright without contact"
            )
            results[name] = result
            truths.append(press.truth)
    view.height_figure(results, truths[0], title, Path(f"{thing}.png"), surface=surface)


compare("sphere", "Ball, 10 mm in diameter, 30 steps of 0.1 mm, four sensors", 160, 0.075, 0.1, surface=True)
compare("coin", "5 yen coin, 22 mm in diameter, 30 steps of 0.12 mm, four sensors", 160, 0.164, 0.12)
