"""However a recording is stored, and whatever memory there is, its result is the same to the last bit."""

import numpy as np
import pytest
from presses import SPEC, random_press

from mirrorskin import engine, io
from mirrorskin.engine.streaming import push_block
from mirrorskin.kernels.device import open_device


class Pressed:
    """Frames of a press, in memory."""

    name, motion, rewindable = "pressed", "vertical", True

    def __init__(self, frames, header):
        self.frames, self.header = frames, header
        self.shape, self.dtype = frames.shape, frames.dtype
        self.travel = 0.1 * np.arange(len(frames))
        self.rewind()

    def rewind(self):
        self.next = 0

    def read(self, out=None):
        part = slice(self.next, min(self.next + len(out), len(self.frames)))
        if part.start == part.stop:
            return None
        out[: part.stop - part.start] = self.frames[part]
        self.next = part.stop
        return io.Block(out[: part.stop - part.start], part.start, travel=self.travel[part])

    def __enter__(self):
        return self

    def __exit__(self, *error):
        pass


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
@pytest.mark.parametrize("compression", ["raw", "bitshuffle", "gzip"])
@pytest.mark.parametrize("method", ["threshold", "change-point"])
def test_storage_and_memory_do_not_change_a_result(device, tmp_path, dtype, compression, method):
    dark, bright = (np.full((21, 34), level, np.float32) for level in SPEC[dtype])
    frames = random_press(dtype, 37, (21, 34), seed=3)
    source = Pressed(frames, io.Header("vertical", dark=dark, bright=bright))
    wanted = engine.reconstruct(source, method=method, device=device)
    source.rewind()
    with io.Recorder(source, tmp_path / "press.h5", compression) as recorder:
        recorder.drain(lambda done: None)
    for limit in (1, 10 * frames[0].nbytes, 10**9):
        with io.open_recording(tmp_path / "press.h5", memory_limit=limit) as recording:
            result = engine.reconstruct(recording, method=method, device=device, memory_limit=limit)
        for name, values in wanted.maps().items():
            np.testing.assert_array_equal(result.maps()[name], values)


def test_a_result_outlives_its_recording(tmp_path):
    frames = random_press("uint8", 20, (64, 64), seed=4)
    source = Pressed(frames, io.Header("vertical"))
    with io.Recorder(source, tmp_path / "press.h5") as recorder:
        recorder.drain(lambda done: None)
    recording = io.open_recording(tmp_path / "press.h5")
    search = engine.OnsetSearch((64, 64), "uint8", device=open_device())
    while (block := recording.read(search.room)) is not None:
        push_block(search, block)
    recording.close()
    (tmp_path / "press.h5").unlink()
    wanted = engine.find_onset(frames, source.travel)
    np.testing.assert_array_equal(search.result().height, wanted.height)
