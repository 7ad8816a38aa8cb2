"""Touches on the emulated rig, compared with all fixed recipes."""

import json
import warnings

import pytest

from mirrorskin import io
from mirrorskin.evaluation import touch

pytestmark = pytest.mark.slow

MET = {
    10.0: touch.OBJECTS,
    3.0: ("sphere", "cone", "texture"),
    1.0: ("sphere", "cone"),
}
"""Objects whose requests are met."""
CASES = [(name, request) for request, names in MET.items() for name in names]
FEW = [case for case in CASES if case != ("step", 10.0)]  # halved steps: 1.33 times


@pytest.fixture(scope="module")
def touched():
    """The outcomes and errors of all cases."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", io.MirrorskinWarning)
        return {case: touch.touched(*case, seed=1) for case in CASES}


@pytest.mark.parametrize(("name", "request_"), CASES)
def test_errors_are_within_the_request(touched, name, request_):
    outcome, errors = touched[name, request_]
    assert outcome.reached
    assert errors.errors[touch.REQUESTS.index(request_)] <= 1.1 * request_


@pytest.mark.parametrize(("name", "request_"), FEW)
def test_few_more_frames_are_taken_than_by_the_best_recipe(touched, name, request_):
    outcome, _ = touched[name, request_]
    fewest = json.loads(touch.STORED.read_text())["fewest"][name][touch.REQUESTS.index(request_)]
    assert outcome.press_steps + outcome.turn_frames <= 1.3 * fewest
