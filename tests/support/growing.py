"""An artificial live source, and a process that records it: ``python growing.py FILE PACKING RATE``."""

from __future__ import annotations

import itertools
import subprocess
import sys
import time

import numpy as np

from mirrorskin import io

SHAPE = (5, 7)


def frames_of(numbers, shape=SHAPE, dtype="u1"):
    """Return what the frames of these numbers hold: nothing like their neighbours."""
    numbers = np.asarray(numbers, np.int64)[:, None, None]
    pixels = np.arange(np.prod(shape)).reshape(shape)
    return ((numbers * 7919 + pixels * 31 + numbers * pixels) % 251).astype(dtype)


class Feed:
    """Frames in blocks of given sizes, over and over; in the end, or at some frame, an error may come.

    The live positions are 0.01 a frame; the corrected ones 0.001 more. Frame k was taken at k seconds, or
    with a rate when it came.
    """

    rewindable = False
    name = "feed"

    def __init__(
        self,
        count=20,
        cuts=(1,),
        motion="vertical",
        shape=SHAPE,
        dtype="u1",
        stays_valid=True,
        fails=None,
        rate=None,
        announced=None,
    ):
        self.header = io.Header(motion, title="a feed", pixel_size=(0.1, 0.1), press=1.0, tilt=0.04)
        self.motion, self.dtype = motion, np.dtype(dtype)
        self.shape = (announced or count, *shape)
        self.read_so_far, self.left, self.entered = 0, False, False
        self._count, self._cuts, self._stays_valid = count, itertools.cycle(cuts), stays_valid
        self._fails, self._rate, self._start = fails, rate, time.monotonic()
        self._room = np.empty((max(cuts), *shape), dtype)

    def read(self, out=None, /):
        if self._fails is not None and self.read_so_far >= self._fails[0]:
            raise self._fails[1]
        n = min(next(self._cuts), self._count - self.read_so_far)
        if not n:
            return None
        numbers = np.arange(self.read_so_far, self.read_so_far + n)
        self.read_so_far += n
        if self._rate is not None:
            time.sleep(max(0.0, self._start + self.read_so_far / self._rate - time.monotonic()))
        frames = frames_of(numbers, self.shape[1:], self.dtype)
        if not self._stays_valid:
            self._room[:n] = frames
            frames = self._room[:n]
        return io.Block(
            frames,
            int(numbers[0]),
            time=numbers * 1.0 if self._rate is None else np.full(n, time.monotonic()),
            stays_valid=self._stays_valid,
            dropped=int(numbers[0]) % 3,
            **self.positions_of(numbers, 0.0),
        )

    def positions_of(self, numbers, better):
        name = {"vertical": "travel", "axial": "phase", "horizontal": "displacement", "twist": "twist"}
        values = 0.01 * numbers + better
        if self.motion == "horizontal":
            values = np.stack([values, -values], axis=1)
        return {name[self.motion]: values}

    def positions(self):
        return self.positions_of(np.arange(self.read_so_far), 0.001)

    def now(self):
        return self.read_so_far * 1.0

    def __enter__(self):
        self.entered = True
        return self

    def __exit__(self, *error):
        self.left = True


def stream(source, path, packing="raw", **options):
    """Record all of a source; return the blocks as they went by."""
    with io.StreamRecorder(source, path, packing, **options) as recorder:
        return list(iter(recorder.read, None))


def started(path, packing="raw", rate=400, period=0.1, watched=None):
    """Start a process that records for a long time, and wait until its file is there.

    Where an older file of its name is to be replaced, its file has the name ``watched``.
    """
    words = [sys.executable, __file__, path, packing, rate, period]
    child = subprocess.Popen([str(word) for word in words])
    until = time.monotonic() + 60
    while not (watched or path).exists():
        assert child.poll() is None
        assert time.monotonic() < until
        time.sleep(0.005)
    return child


if __name__ == "__main__":
    stream(
        Feed(10**9, (1, 3, 2), rate=float(sys.argv[3]), announced=5000),
        sys.argv[1],
        sys.argv[2],
        period=float(sys.argv[4]),
        overwrite=True,
    )
