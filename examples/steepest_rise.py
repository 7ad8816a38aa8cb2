"""An estimator of one's own: a pixel's height is where its brightness rises most from frame to frame.

mirrorskin run examples/steepest_rise.py:SteepestRise press.h5 -o heights.h5
"""

import numpy as np

from mirrorskin import engine, hw


class SteepestRise:
    """Keeps, of each pixel, the largest rise so far and the height that it stands for."""

    def __init__(self, shape, dtype):
        self.shape = shape
        self.reset()

    def reset(self):
        """Forget all frames."""
        self.last = None
        self.rise = np.zeros(self.shape, np.float32)
        self.height = np.full(self.shape, np.nan, np.float32)

    def push(self, frames, *, travel):
        """Take in the next frames, (n, H, W), and the travel of each, mm."""
        for frame, at in zip(frames.astype(np.float32), travel, strict=True):
            if self.last is not None:
                rise = frame - self.last[0]
                larger = rise > self.rise
                self.rise[larger] = rise[larger]
                self.height[larger] = -(at + self.last[1]) / 2
            self.last = frame, at

    def result(self):
        """Return maps by name: a height is one that results know, the rise one of our own."""
        return {"height": self.height, "rise": self.rise}


if __name__ == "__main__":
    press = hw.Twin(
        object="sphere", shape=(60, 80), pixel_size=0.1, movement=hw.twin.Vertical(np.arange(0, 1.5, 0.05))
    )
    result = engine.run(press, SteepestRise)
    error = result.height - press.truth.height
    print(f"{np.isfinite(error).sum()} heights, median error {np.nanmedian(np.abs(error)):.3f} mm")
