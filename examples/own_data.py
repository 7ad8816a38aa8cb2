"""Your own frames.

The frames are a dataset of any name in an HDF5 file. In addition, only the travel from frame to frame and the
pixel size are required. This script first writes such a file: a press on a cone, with a 16-bit camera whose
dark level is 300 and whose bright level is 9000 counts.
"""

import h5py
import numpy as np

from mirrorskin import engine, io
from mirrorskin.engine.base.summary import summarise
from mirrorskin.view.result import figures_of

# A file of another program: sixteen frames, 0.1 mm apart, of a cone whose sides fall by 0.4 mm per mm.
y, x = np.mgrid[3.0:-3.0:121j, -4.0:4.0:161j]
height = -0.4 * np.hypot(x, y)
travel = 0.1 * np.arange(16)
light = np.where(travel[:, None, None] > -height, 9000, 300)
noise = np.random.default_rng(1).normal(0, 40, light.shape)
with h5py.File("theirs.h5", "w") as file:
    file["scan_7/camera/images"] = (light + noise).astype(np.uint16)

# mirrorskin needs the name of the dataset, the travel, the pixel size and the dark and bright levels.
with io.open_recording(
    "theirs.h5",
    dataset="/scan_7/camera/images",
    motion="vertical",
    travel=travel,  # one number a frame, mm
    pixel_size=(0.05, 0.05),
) as recording:
    result = engine.reconstruct(recording, dark=300, bright=9000)
print(summarise(result))
print(f"RMS error {np.sqrt(np.nanmean((result.height - height) ** 2)):.3f} mm")

io.save_result(result, "heights.h5", overwrite=True)  # NeXus: silx, h5web and NeXpy plot it unasked
figures = figures_of(result, name="a cone, from somebody's file")
for what in ("height", "section"):
    figures[what].savefig(f"{what}.png", dpi=110)
