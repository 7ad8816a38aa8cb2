"""Right sides of full rectangles, and their heights by SciPy's transforms in float64."""

from __future__ import annotations

import numpy as np
import scipy.fft


def put(device, values):
    array = device.array("source", values.shape, np.float32)
    array.write(values)
    return array


def source_of(surface, wx=1.0, wy=1.0, screening=0.0):
    """What links ask for to have this surface, in float64."""
    source = screening * surface
    for axis, weight in ((1, wx), (0, wy)):
        step = weight * np.diff(surface, axis=axis)
        edge = [(1, 1) if axis == direction else (0, 0) for direction in (0, 1)]
        source -= np.diff(np.pad(step, edge), axis=axis)
    return source


def solve_by_cosines(source):
    """The same by transforms in float64, for links of weight 1."""
    waves = [4 * np.sin(np.pi * np.arange(count) / (2 * count)) ** 2 for count in source.shape]
    divisor = waves[0][:, np.newaxis] + waves[1]
    divisor[0, 0] = np.inf
    return scipy.fft.idctn(scipy.fft.dctn(source.astype(np.float64)) / divisor)


def scene(shape, lean, noise=0.03):
    """A bump, a little noise, and a slope as steep as said."""
    y, x = np.indices(shape) / max(shape)
    rough = np.random.default_rng(1).normal(0, noise, shape)
    return 40 * np.exp(-((x - 0.4) ** 2 + (y - 0.3) ** 2) / 0.02) + rough + lean * max(shape) * (x + 0.4 * y)
