"""A stack far larger than the memory limit is processed in blocks."""

import subprocess
import sys
import textwrap
import weakref

import numpy as np

from mirrorskin import engine

BLOCK = 8_000_000

PRESS = textwrap.dedent(
    """
    import resource, sys
    import numpy as np
    from mirrorskin import engine, io

    def peak():
        return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    path, limit = sys.argv[1], int(sys.argv[2])
    with io.open_recording(path) as recording:
        engine.find_onset(np.zeros((3, 8, 8), np.uint8), np.arange(3.0))  # compiled and warm before it counts
        before = peak()
        result = engine.reconstruct(recording, memory_limit=limit)
        print(peak() - before, result.height.size, float(np.nanmax(result.height)))
    """
)


def make_recording(path, shape):
    import h5py

    with h5py.File(path, "w") as file:
        frames = file.create_dataset("frames", shape, "u1")
        dark, light = (np.full(shape[1:], level, np.uint8) for level in (20, 200))
        for number in range(shape[0]):
            frames[number] = light if number >= shape[0] // 2 else dark


def test_peak_memory_is_two_blocks_and_the_maps(tmp_path):
    count, rows, columns = 400, 400, 500
    path = tmp_path / "big.h5"
    make_recording(path, (count, rows, columns))
    code = PRESS.replace(
        "io.open_recording(path)", 'io.open_recording(path, motion="vertical", travel=io.Steps(0.01))'
    )
    run = subprocess.run(
        [sys.executable, "-c", code, str(path), str(2 * BLOCK)], capture_output=True, text=True, check=True
    )
    grown, pixels, height = map(float, run.stdout.split())
    assert pixels == rows * columns
    assert abs(height + 0.01 * (count / 2 - 0.5)) < 1e-6
    maps = pixels * 80  # the state, the maps of the answer, and the float64 ones that thresholds are made of
    assert grown < 2 * BLOCK + maps
    assert count * pixels > 2 * (2 * BLOCK + maps)  # the whole stack would not have fitted


def test_memory_of_frames_is_free_when_the_maps_are_completed():
    run = engine.Run(engine.Onset(dark=0, bright=255, noise=1.0))
    frames = np.full((5, 40, 50), 255, np.uint8) * (np.arange(5) > 2)[:, np.newaxis, np.newaxis]
    run.push(frames.astype(np.uint8), travel=np.arange(5.0))
    staging_buffer = weakref.ref(run.staging_buffer)
    assert run.result().height.shape == (40, 50)
    assert staging_buffer() is not None  # more frames may follow
    run.result(ended=True)
    assert staging_buffer() is None
