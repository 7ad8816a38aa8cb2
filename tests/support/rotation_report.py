"""How far normals are from the truth, by zenith: on data of eq. 10, and on the twin, registered and not.

``python tests/support/rotation_report.py`` prints both tables, in degrees.
"""

from __future__ import annotations

import numpy as np
import rotations
from rotations import BINS, EIGHTHS, SETUPS, TILT
from stacks import read_all

SHAPE, PIXEL, PRESS = (401, 400), 0.018, 1.25
TWIN_BINS = ((0, 2), (2, 3), (3, 5), (5, 10), (10, 15), (15, 20), (20, 25), (25, 30), (30, 35), (35, 40))


def table_of_equation_10(name, draws=20_000):
    """Print the bound, the exact method's error and its own opinion of it, and the paper's error."""
    from mirrorskin.engine import estimate_normals

    setup = SETUPS[name]
    stack = rotations.draw(setup, draws, seed=1)
    known = {"phase": setup.phase, "tilt": setup.tilt, "gain": setup.slope, "offset": setup.offset}
    found = estimate_normals(stack.frames, **known, noise=setup.spread)
    told = rotations.scores(found.vectors, found.sigma, stack)
    paper = estimate_normals(stack.frames, **known, noise=setup.spread, method="paper")
    errors = rotations.between(paper.vectors.astype(float), stack.normals)
    rms = np.degrees(np.sqrt(np.nanmean(errors**2, axis=1)))
    sigma = setup.spread / setup.gain
    print(
        f"\n{name}: {setup.gain:g} counts a degree, one sample's sigma {sigma:.3f} deg, {draws} draws a bin"
    )
    print("zenith           bound    exact    ratio    chi^2    paper")
    columns = np.degrees(told.bound), np.degrees(told.rms), told.ratio, told.chi_square, rms
    for (low, high), *values in sorted(zip(BINS, *columns, strict=True)):
        cells = " ".join(f"{value:8.4f}" for value in values)
        print(f"{low:5.2f} - {high:5.2f} {cells}")


def turn(dtype, noise):
    """Return the twin on a ball, as in Figure 10 (a) of the paper; its wall is linear from zenith 0 on."""
    from mirrorskin import hw

    return hw.Twin(
        object="sphere",
        shape=SHAPE,
        pixel_size=PIXEL,
        movement=hw.twin.Axial(EIGHTHS, TILT, press=PRESS),
        pattern="linear",
        body=hw.twin.Body(height=1e5, scatter=0.0),
        camera=hw.twin.Camera(dtype=np.dtype(dtype), noise=noise, seed=1),
    )


def errors_on_the_twin(dtype, noise, method, registered):
    """Return zenith and angular error where contact lasts, (H, W), degrees.

    The error is NaN where there is no answer, or one that is told to be out of contact.
    """
    from mirrorskin.engine import estimate_normals
    from mirrorskin.engine.rotation.registration import Registered

    twin = turn(dtype, noise)
    truth, header = twin.truth, twin.header
    with Registered(twin, truth.height) if registered else twin as source:
        frames = read_all(source, len(EIGHTHS)).frames
    spread = float(np.hypot(noise, 0 if dtype == "float32" else 1 / np.sqrt(12)))
    known = {"phase": EIGHTHS, "tilt": TILT, "gain": header.zenith_gain, "offset": header.zenith_offset}
    found = estimate_normals(frames, **known, noise=max(spread, 0.1), method=method)
    normals = rotations.direction(truth.zenith, np.nan_to_num(truth.azimuth))
    errors = np.degrees(rotations.between(found.vectors.astype(float), normals))
    zenith = np.where(truth.contact != 0, np.degrees(truth.zenith), np.nan)
    return zenith, np.where(found.contact != 0, errors, np.nan)


def table_of_the_twin(dtype, noise):
    """Print median, RMS and 99 % of the errors, before and after registration."""
    print(f"\ntwin on a ball of 10 mm pressed by {PRESS} mm, {dtype}, noise {noise:g} counts")
    for method in ("exact", "paper"):
        zenith, before = errors_on_the_twin(dtype, noise, method, registered=False)
        _, after = errors_on_the_twin(dtype, noise, method, registered=True)
        print(f"{method:9}   as seen: median, RMS, 99 %, answered    registered")
        for low, high in TWIN_BINS:
            inside = (zenith >= low) & (zenith < high)
            print(f"{low:3} - {high:3}   {_summary(before[inside])}     {_summary(after[inside])}")


def _summary(errors):
    answered = errors[np.isfinite(errors)]
    if answered.size == 0:
        return f"{'nothing':>33}"
    parts = np.median(answered), np.sqrt(np.mean(answered**2)), np.percentile(answered, 99)
    return " ".join(f"{part:8.4f}" for part in parts) + f" {100 * answered.size / errors.size:5.1f} %"


def main():
    for name in SETUPS:
        table_of_equation_10(name)
    for dtype, noise in (("float32", 0.0), ("uint8", 1.0)):
        table_of_the_twin(dtype, noise)


if __name__ == "__main__":
    main()
