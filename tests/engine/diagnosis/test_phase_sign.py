"""Reversed phases are detected by slopes that belong to no surface."""

import warnings

import numpy as np
import pytest

from mirrorskin import engine, io
from mirrorskin.io.files.arrays import ArrayRecording
from mirrorskin.twin import Axial, Twin


def warnings_of(shape, sign):
    """Return the warnings of a rotation whose phases have a sign."""
    phase = np.arange(8) * np.pi / 4
    movement = Axial(phase, np.radians(2.5), 1.0)
    twin = Twin(object=shape, shape=(160, 160), pixel_size=0.04, movement=movement, pattern="linear")
    header = twin.header
    options = {name: getattr(header, name) for name in ("pixel_size", "tilt", "zenith_gain", "zenith_offset")}
    frames = twin.read(np.empty(twin.shape, twin.dtype)).frames
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", io.MirrorskinWarning)
        result = engine.reconstruct(ArrayRecording(frames, {"phase": sign * phase}, options))
    return str(result.process.get("warnings", ""))


@pytest.mark.parametrize("shape", ["coin", "cone"])
def test_a_mirrored_surface_is_reported(shape):
    assert "the slopes fit together better with the phases reversed" in warnings_of(shape, -1)


@pytest.mark.parametrize("shape", ["coin", "cone", "sphere", "texture", "plane"])
def test_a_surface_as_it_is_is_not_mirrored(shape):
    assert "reversed" not in warnings_of(shape, 1)
