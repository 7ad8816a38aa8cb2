"""What is given for a reconstruction is used, and told in its result."""

import numpy as np
import pytest
from stacks import ball

from mirrorskin import engine, io

TRAVEL = 0.1 * np.arange(1, 21)


def twin(**options):
    return ball((40, 50), 0.2, TRAVEL, **options)


def test_the_recordings_own_references_are_used():
    source = twin()
    result = engine.reconstruct(source, fill=False)
    given = engine.find_onset(
        source_frames(twin()), TRAVEL, dark=source.header.dark, bright=source.header.bright
    )
    np.testing.assert_array_equal(result.height, given.height)
    assert result.process["dark"] == result.process["bright"] == "map of the recording"


def source_frames(source):
    return source.read(np.empty(source.shape, source.dtype)).frames


def test_what_is_given_goes_before_what_the_recording_says():
    options = {"dark": 40, "bright": np.full((40, 50), 180.0), "noise": 3.0, "threshold": 0.3, "hold": 3}
    result = engine.reconstruct(twin(), fill=False, **options)
    given = engine.find_onset(source_frames(twin()), TRAVEL, **options)
    np.testing.assert_array_equal(result.height, given.height)
    np.testing.assert_array_equal(result.height_sigma, given.sigma)
    told = {name: result.process[name] for name in ("dark", "bright", "noise", "threshold", "hold")}
    assert told == {"dark": 40.0, "bright": "map given", "noise": 3.0, "threshold": 0.3, "hold": 3}


def test_progress_is_told_to_the_last_frame():
    done = []
    engine.reconstruct(twin(), memory_limit=2 * 7 * 40 * 50, progress=done.append)
    assert done == [7, 14, 20]


def test_float_frames_and_16_bits_go_the_same_way():
    heights = [
        engine.reconstruct(twin(dtype=dtype, noise=0)).height for dtype in ("uint8", "uint16", "float32")
    ]
    np.testing.assert_allclose(heights[0], heights[1], atol=1e-6)
    np.testing.assert_allclose(heights[0], heights[2], atol=1e-6)


class Other:
    """A source of another motion."""

    motion, name = "twist", "turning.h5"


def test_a_motion_without_a_method_is_refused():
    with pytest.raises(io.InputError, match=r"turning\.h5 is of twist motion"):
        engine.reconstruct(Other())
