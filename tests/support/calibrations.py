"""Artificial calibrations, and their comparison."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np

from mirrorskin import io

SHAPE = (5, 7)


def a_map(seed, shape=SHAPE, middle=10.0):
    """Return a map in which no two pixels are equal."""
    return np.random.default_rng(seed).normal(middle, 1.0, shape).astype(np.float32)


def some_references(shape=SHAPE, dark=10.0, bright=200.0):
    """Return references whose last pixel is dead."""
    defects = np.zeros(shape, np.uint8)
    defects[-1, -1] = 2
    maps = [a_map(seed, shape, middle) for seed, middle in enumerate((dark, bright))]
    maps = [np.where(defects, np.float32(np.nan), values) for values in maps]
    return io.References(*maps, a_map(2, shape, 0.1), a_map(3, shape, 0.2), defects)


def a_precession(**changes):
    """Return a precession that goes round the other way, on an ellipse."""
    parameters = {
        "tilt": 0.04,
        "phase_offset": 0.3,
        "direction": -1,
        "ellipticity": 0.05,
        "major_axis": 1.0,
        "centre": (0.001, -0.002),
        "pivot": (0.5, -0.25, 12.0),
        "sigma": {"tilt": 1e-4, "pivot_z": 0.3},
    }
    return io.Precession(**parameters | changes)


def a_response(shape=SHAPE):
    """Return the response to a wall."""
    return io.WallResponse(
        radius=17.5,
        rim=40.0,
        axis=(0.2, -0.1),
        sight=(0.01, 1e-5),
        lamps=(0.05, 0.0),
        scatter=0.02,
        curve=np.array([0.9, -0.5, -0.1]),
        reach=(0.02, 0.6),
        shade=np.linspace(-0.01, 0.01, 5),
        pattern="graded",
        zenith_sigma=a_map(4, shape, 0.01),
        azimuth_sigma=a_map(5, shape, 0.02),
        parameters=("radius", "k0"),
        covariance=np.array([[1.0, 0.5], [0.5, 2.0]]),
        error=0.003,
    )


def a_linear_response(shape=SHAPE):
    """Return the response that touches determine."""
    return io.LinearResponse(
        gain=a_map(6, shape, 350.0),
        offset=a_map(7, shape, -60.0),
        gamma=1.02,
        names=("gamma", "zenith_gain"),
        values=np.array([0.02, 0.0]),
        information=np.array([[4e4, 1e3], [1e3, 9e4]]),
        pull=np.array([10.0, -20.0]),
        touches=3,
        time=1.7e9,
        sigma={"gain": 1.2, "offset": 0.4, "gamma": 0.005},
    )


def a_lens(shape=SHAPE):
    """Return a lens with a little of everything."""
    return io.Lens(
        pixel_size=(0.5, 0.6),
        camera=np.array([[0.5, 0.0, -1.5], [0.0, -0.6, 1.2], [1e-4, 0.0, 1.0]]),
        distortion=np.array([-0.1, 0.01, 1e-4, 0.0, 0.0]),
        matrix=np.array([[9.0, 0.0, 3.0], [0.0, 9.0, 2.0], [0.0, 0.0, 1.0]]),
        shape=shape,
        error=0.05,
    )


def a_calibration(shape=SHAPE, dtype="uint8", name="left", only=None):
    """Return a calibration of all parts, or of some; next to that of touches, the wall is uniform."""
    parts = {
        "references": some_references(shape),
        "lens": a_lens(shape),
        "zenith": a_response(shape),
        "precession": a_precession(),
        "gel": io.Gel(threshold=0.2, compliance=0.05, axis=(0.1, 0.3), sigma={"threshold": 0.01}),
        "stiffness": io.Stiffness(0.12, (0.5, -1.0, 0.1), 1e-6 * np.eye(4), 0.01, 0.2, 0.011, 6),
        "response": a_linear_response(shape),
    }
    process = {"references.program": "mirrorskin", "tilt.frames": 8, "zenith.weight": 0.5, "scale.dots": True}
    chosen = {part: value for part, value in parts.items() if only is None or part in only}
    if {"zenith", "response"} <= chosen.keys():
        chosen["zenith"] = replace(chosen["zenith"], pattern="uniform")
    return io.Calibration(io.CameraId(name, shape, np.dtype(dtype)), **chosen, process=process)


def assert_same(actual, expected):
    """Hold two calibrations, or two parts, equal: arrays to the last bit and type, the rest by value."""
    assert type(actual) is type(expected)
    for field in fields(expected):
        mine, right = getattr(actual, field.name), getattr(expected, field.name)
        if hasattr(right, "__dataclass_fields__"):
            assert_same(mine, right)
        elif isinstance(right, np.ndarray):
            assert mine.dtype == right.dtype, field.name
            np.testing.assert_array_equal(mine, right, err_msg=field.name)
        elif field.name != "name" or not isinstance(expected, io.Calibration):
            assert repr(mine) == repr(right) if isinstance(right, float) else mine == right, field.name
