"""An operation of one's own: a pixel's height is where its brightness rises most from frame to frame.

mirrorskin run examples/steepest_rise.py:SteepestRise press.h5 -o heights.h5
"""

import numpy as np

from mirrorskin import engine, io
from mirrorskin.io.model.maps import TABLE
from mirrorskin.twin import Twin, Vertical


class SteepestRise(engine.Operation):
    """Height from the largest rise of each pixel's brightness."""

    motions = ("vertical",)

    least: float = engine.option(default=0.0, unit="counts", help="rise above which there is a height")

    height = TABLE["height"]
    rise = io.Map("largest rise of the brightness", "counts")

    def start(self, shape, dtype):
        """Prepare for frames of a shape and type."""
        self.last = None
        self.rises = np.full(shape, self.least, np.float32)
        self.heights = np.full(shape, np.nan, np.float32)

    def push(self, frames, *, travel):
        """Process the next frames, (n, H, W), and the travel of each, mm."""
        for frame, at in zip(frames.astype(np.float32), travel, strict=True):
            if self.last is not None:
                rise = frame - self.last[0]
                larger = rise > self.rises
                self.rises[larger] = rise[larger]
                self.heights[larger] = -(at + self.last[1]) / 2
            self.last = frame, at

    def result(self):
        """Return maps by name."""
        return {"height": self.heights, "rise": self.rises}


if __name__ == "__main__":
    press = Twin(object="sphere", shape=(60, 80), pixel_size=0.1, movement=Vertical(np.arange(0, 1.5, 0.05)))
    result = engine.run(press, SteepestRise)
    error = result.height - press.truth.height
    print(f"{np.isfinite(error).sum()} heights, median error {np.nanmedian(np.abs(error)):.3f} mm")
