"""The application, driven from Python.

`mirrorskin app` shows a recording with its options and its result in the browser. Here a script does what a
person clicks: it chooses a pixel of a press and of a rotation, and draws what the page shows of it. In a
notebook, an `App` as the last line of a cell shows the page itself.
"""

import numpy as np
from matplotlib.figure import Figure

from mirrorskin import io
from mirrorskin.twin import Axial, Twin, Vertical
from mirrorskin.view.app import App, trace_of

PIXEL = 80, 115  # row and column
MOVEMENTS = {
    "press": Vertical(0.1 * np.arange(1, 31)),
    "rotation": Axial(np.arange(16) * np.pi / 8, tilt=np.radians(2.5), press=1.0),
}
figure = Figure(figsize=(8, 3.4), layout="constrained")
axes = figure.subplots(1, 2)
for axis, (name, movement) in zip(axes, MOVEMENTS.items(), strict=True):
    twin = Twin(
        object="sphere",
        shape=(160, 160),
        pixel_size=0.065,
        pattern="uniform" if name == "press" else "linear",
        movement=movement,
    )
    with io.Recorder(twin, f"{name}.h5", overwrite=True) as recorder:
        recorder.drain()

    app = App(f"{name}.h5")
    app.session.point_at(*PIXEL)
    trace = trace_of(app.session)
    app.close()

    axis.plot(trace.position, trace.brightness, ".", label="brightness")
    for level, counts in trace.levels.items():
        axis.axhline(counts, color="0.5", ls="--", lw=1)
        axis.annotate(level.lower(), (trace.position[0], counts), va="bottom", fontsize=9)
    if trace.curve is None:
        axis.axvline(trace.event, color="tab:green", label="onset")
        true = -twin.truth.height[PIXEL]
        print(f"onset at {trace.event:.3f} ± {trace.event_sigma:.3f} mm, true {true:.3f} mm")
    else:
        axis.plot(*trace.curve, label="fitted cosine")
    print(f"{name}: {', '.join(f'{what} {value}' for what, value in trace.facts.items())}")
    axis.set(xlabel=f"{trace.axis} ({trace.unit})", ylabel="brightness (counts)", title=name)
    axis.legend(loc="center right" if name == "press" else "upper center")
figure.savefig("pixel.png", dpi=110)
