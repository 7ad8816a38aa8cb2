"""A GPU that shares the host's memory: the same answers as with its own memory, and no copies."""

import dataclasses

import numpy as np
import pytest
from operations import CASES, assert_same

from mirrorskin import engine
from mirrorskin.evaluation.scenes.inputs import blob_mask, noisy_slopes, random_cuts, roof
from mirrorskin.kernels import device as device_layer
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.layout import GPU_LAYOUT

SHAPE = 61, 75
SLOPES, MASK = noisy_slopes(SHAPE), blob_mask(SHAPE)
HEIGHTS = np.where(np.arange(SHAPE[1]) < 9, 0.2, np.nan) * np.ones((SHAPE[0], 1))
PROBLEMS = {
    "rectangle": {},
    "within a mask": {"mask": MASK},
    "cuts": {"mask": MASK, "edges": random_cuts(SHAPE, 5)},
    "known heights": {"known_heights": HEIGHTS},
    "robust": {"robust": True},
}


@pytest.fixture(scope="module")
def integrated():
    """A device that is treated as an integrated GPU."""
    opened = Device(device_layer._find()[0])
    if not opened.info.shares_memory:
        pytest.skip("the device has memory of its own")
    opened.info = dataclasses.replace(opened.info, kind="gpu")
    opened.layout = GPU_LAYOUT
    return opened


def copied(device):
    """Return the bytes that were copied between host and device."""
    return sum(record.bytes for record in device.profile.records() if record.kind in ("upload", "download"))


@pytest.mark.parametrize("name", CASES)
def test_operations_copy_nothing_and_have_the_answers_of_a_card(integrated, card, name):
    result = CASES[name].whole(device=integrated)
    assert copied(integrated) == 0
    assert_same(result, CASES[name].whole(device=card))


@pytest.mark.parametrize("name", PROBLEMS)
def test_integrations_copy_nothing_and_have_the_heights_of_a_card(integrated, card, name):
    result, expected = (
        engine.integrate(*SLOPES, 0.05, **PROBLEMS[name], device=device) for device in (integrated, card)
    )
    assert copied(integrated) == 0
    np.testing.assert_array_equal(result.height, expected.height)


def test_edges_copy_nothing_and_are_those_of_a_card(integrated, card):
    result, expected = (engine.find_edges(*roof(SHAPE), device=device) for device in (integrated, card))
    assert copied(integrated) == 0
    np.testing.assert_array_equal(result, expected)


def test_frames_are_used_where_they_are(integrated):
    frames = np.zeros((17, 64, 64), np.uint8)[:16]  # the memory after the last frame is readable
    assert np.shares_memory(integrated.share("frames", frames).host, frames)
