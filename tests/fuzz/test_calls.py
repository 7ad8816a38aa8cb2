"""Public functions answer, or refuse in one line, for any arguments."""

import math

import numpy as np
import pytest
from calls import ELSEWHERE, SHAPE, calls, odd_values, public_functions, trial

from mirrorskin import engine
from mirrorskin.io import InputError


def test_every_public_function_is_tried():
    assert public_functions() == set(calls()) | ELSEWHERE


@pytest.mark.parametrize("name", calls())
@pytest.mark.filterwarnings("ignore")
def test_an_odd_argument_is_answered_or_refused_in_a_line(name):
    function, arguments = calls()[name]
    function(**arguments)
    wrong = {
        f"{argument} {kind}": text
        for argument, sound in arguments.items()
        for kind, value in odd_values(sound)
        if (text := trial(name, argument, value)) is not None
    }
    assert wrong == {}


def test_lists_are_taken_as_arrays():
    function, arguments = calls()["find_onset"]
    arguments |= {"dark": 0.0, "bright": 255.0}
    listed = {name: value.tolist() for name, value in arguments.items() if isinstance(value, np.ndarray)}
    listed["frames"] = arguments["frames"]
    np.testing.assert_array_equal(function(**arguments).height, function(**{**arguments, **listed}).height)


def test_a_masked_sample_is_not_known():
    function, arguments = calls()["find_onset"]
    mask = np.zeros(arguments["frames"].shape, bool)
    mask[:, 3, 4] = True
    frames = np.ma.masked_array(arguments["frames"], mask)
    result = function(**{**arguments, "frames": frames, "dark": 0.0, "bright": 255.0})
    whole = function(**{**arguments, "dark": 0.0, "bright": 255.0})
    assert math.isnan(result.height[3, 4])
    valid = ~mask[0]
    np.testing.assert_allclose(result.height[valid], whole.height[valid], equal_nan=True)


def test_a_masked_height_is_a_hole():
    function, arguments = calls()["fill_holes"]
    mask = np.zeros(SHAPE, bool)
    mask[7:9, 9:11] = True
    height, filled = function(**{**arguments, "height": np.ma.masked_array(arguments["height"], mask)})
    np.testing.assert_array_equal(filled, mask)
    np.testing.assert_allclose(height[mask], arguments["height"][mask], atol=5e-3)


def test_masked_contact_is_none():
    function, arguments = calls()["find_tangential_force"]
    touches = arguments["contact"]
    mask = np.zeros(SHAPE, bool)
    mask[:7] = True
    masked = function(**{**arguments, "contact": np.ma.masked_array(touches, mask)})
    expected = function(**{**arguments, "contact": touches & ~mask})
    assert (masked.force_x, masked.force_y) == (expected.force_x, expected.force_y)


def test_the_argument_is_named():
    with pytest.raises(InputError, match="travel is 'abc': numbers are needed"):
        engine.find_onset(calls()["find_onset"][1]["frames"], "abc")
    with pytest.raises(InputError, match="result is None: a Result, a mapping, a dataset, a path or"):
        engine.measure(None)
