"""The end of a program while daemon threads compute."""

import subprocess
import sys

import numpy as np
import pytest
from stacks import record

from mirrorskin.twin import Twin, Vertical

EXITING = """
import itertools, sys, threading
import cv2
import numpy as np
from mirrorskin import engine, io

SHAPE = 300, 300

class Blurred(engine.Operation):
    motions = ("vertical",)

    def start(self, shape, dtype):
        self.last = np.zeros(shape, np.float32)

    def push(self, frames):
        self.last = cv2.GaussianBlur(frames[-1].astype(np.float32), (0, 0), 9.0)
        busy[0].set()

    def result(self):
        return {"last": self.last}

def blur():
    engine.run(itertools.repeat(np.zeros(SHAPE, np.uint8)), Blurred)

def read():
    while True:
        with io.open_recording(sys.argv[1]) as recording:
            engine.reconstruct(recording)
        busy[1].set()

def stream():
    onset = engine.live.Stream(engine.Onset(dark=0, bright=255), SHAPE)
    for number in itertools.count():
        onset.push(np.full(SHAPE, number % 256, np.uint8), travel=0.001 * number)
        if onset.status.used > 3:
            busy[2].set()

busy = [threading.Event() for _ in range(3)]
for work in (blur, read, stream):
    threading.Thread(target=work, daemon=True).start()
for event in busy:
    assert event.wait(60)
sys.exit(3)
"""


@pytest.fixture(scope="module")
def press(tmp_path_factory):
    """A recording that is read block by block."""
    path = tmp_path_factory.mktemp("exit") / "press.h5"
    movement = Vertical(0.1 * np.arange(12))
    record(Twin(object="sphere", shape=(100, 100), pixel_size=0.1, movement=movement), path)
    return path


def test_a_program_ends_while_daemon_threads_compute(press):
    ended = subprocess.run(
        [sys.executable, "-P", "-c", EXITING, press], capture_output=True, text=True, timeout=120
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (3, "", "")
