"""Your own camera and stage: heights from OpenCV frames while the body moves down.

``python own_camera.py`` uses the first camera, ``python own_camera.py press.avi`` the frames of a video.
"""

import math
import sys
import time

import cv2
import numpy as np

from mirrorskin import engine, io

STEP, SPEED = 0.1, 0.5  # mm from frame to frame of the video; mm/s of the stage, which you move

live = len(sys.argv) == 1
video = cv2.VideoCapture(0 if live else sys.argv[1])
size = int(video.get(cv2.CAP_PROP_FRAME_HEIGHT)), int(video.get(cv2.CAP_PROP_FRAME_WIDTH))
header = io.Header("vertical", pixel_size=(0.0375, 0.0375))
press = engine.Press(dark=16, bright=223)  # counts
start, number = time.monotonic(), 0

with engine.live.Stream(press, size, header=header, latency=0.1 if live else math.inf) as stream:
    while video.grab():
        grey = cv2.cvtColor(video.retrieve()[1], cv2.COLOR_BGR2GRAY)
        stream.push(grey, travel=SPEED * (time.monotonic() - start) if live else STEP * number)
        number += 1
        newest = stream.latest()
        if live and newest is not None and newest.height is not None:
            print(f"{newest.frames} frames, {np.isfinite(newest.height).sum()} pixels have a height")
    result = stream.result()

io.save_result(result, "own.h5", overwrite=True)
print(f"{number} frames: from {np.nanmin(result.height):.2f} to {np.nanmax(result.height):.2f} mm")
