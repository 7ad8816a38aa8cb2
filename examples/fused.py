"""A press and a rotation make one surface.

The press measures the absolute height of slopes, quantized by the step, but no level areas. The rotation
measures the normal of each pixel, but no absolute height. Fused, they give one surface in millimetres: the
crater of the press is closed, and the ball's radius is correct.
"""

import numpy as np

from mirrorskin import engine, io
from mirrorskin.twin import Axial, Camera, Twin, Vertical
from mirrorskin.view.result import figures_of

ball = {"object": "sphere", "shape": (128, 128), "pixel_size": 0.08, "camera": Camera(electrons=40)}
press = Twin(movement=Vertical(0.1 * np.arange(1, 31)), **ball)
turn = Twin(
    movement=Axial(phase=np.radians(45) * np.arange(8), tilt=np.radians(2.5), press=1.5),
    pattern="linear",
    **ball,
)
result = engine.fuse(press, turn)

error = engine.score(result, press.truth).height
print(f"RMS error {1000 * error.rms:.1f} µm at {error.answered} pixels")
quantities = engine.measure(result, form="sphere").quantities
for name in ("sphere radius", "sphere top", "sphere residual RMS"):
    print(f"{name}: {quantities[name]}")

io.export_result(result, "ball.ply")  # triangles in mm, for any program that shows meshes
figures = figures_of(result, name="a ball of 10 mm, fused")
for what in ("height", "section", "normals", "height_sigma"):
    figures[what].savefig(f"{what}.png", dpi=110)
