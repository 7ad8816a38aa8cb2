"""An operation of one's own: a pixel's height is where its brightness rises most from frame to frame.

mirrorskin run examples/steepest_rise.py:SteepestRise press.h5 --least-rise 5 -o heights.h5
"""

import numpy as np

from mirrorskin import engine, hw, io


class SteepestRise(engine.Operation):
    """Height from the largest rise of a pixel's brightness between two frames."""

    least_rise: float = engine.option(0.0, "counts", within=(0, None), help="smaller rises are ignored")

    height = io.Map("height at the steepest rise", "mm", quantity="height")
    rise = io.Map("largest rise between two frames", "counts", colours="positive")

    def start(self, shape, dtype):
        """Prepare for frames of a shape, (H, W), and a type."""
        self.last = None
        self.largest = np.full(shape, self.least_rise, np.float32)
        self.heights = np.full(shape, np.nan, np.float32)

    def push(self, frames, *, travel):
        """Take in the next frames, (n, H, W), and the travel of each, mm."""
        for frame, at in zip(frames.astype(np.float32), travel, strict=True):
            if self.last is not None:
                rise = frame - self.last[0]
                larger = rise > self.largest
                self.largest[larger] = rise[larger]
                self.heights[larger] = -(at + self.last[1]) / 2
            self.last = frame, at

    def result(self):
        """Return the maps by name."""
        return {"height": self.heights, "rise": self.largest}


if __name__ == "__main__":
    press = hw.Twin(
        object="sphere", shape=(60, 80), pixel_size=0.1, movement=hw.twin.Vertical(np.arange(0, 1.5, 0.05))
    )
    result = engine.run(press, SteepestRise)
    error = result.height - press.truth.height
    print(f"{np.isfinite(error).sum()} heights, median error {np.nanmedian(np.abs(error)):.3f} mm")
