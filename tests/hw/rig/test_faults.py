"""Faults of a rig during capture: the stage stops, and the frames so far are kept.

On the emulator always, and on a real firmware as well with `make test-hardware GRBL=PATH`.
"""

import pytest
from firmware import PROGRAM, is_hal
from rig_faults import AFTERWARDS, FAULTS, FIRMWARE_ONLY, HAL_SETTINGS, LATE, SETTINGS, try_capture

SOON = 1.0  # seconds in which a firmware's stage stops on a busy machine
PRESS = 7.0  # seconds, of a whole one
HAL = is_hal(PROGRAM)
# GRBL takes a stored offset after the lines before it, grblHAL one that is not stored.
AFTERWARDS = AFTERWARDS | {"G92 by another program" if HAL else "G10 by another program"}
SETTINGS = SETTINGS | HAL_SETTINGS if HAL else SETTINGS
firmware = pytest.mark.skipif(PROGRAM is None, reason="make test-hardware GRBL=PATH gives the program")


def hold(name, ending, within=SOON):
    """Check how a capture ended."""
    words = FAULTS[name][1]
    if name == "none":
        assert (ending.error, ending.state) == (None, "complete")
        return
    late = PRESS if name in AFTERWARDS else 0
    assert ending.moved < within + late
    assert ending.reported < LATE + late
    assert ending.count >= 8
    assert "\n" not in str(ending.error)
    if name not in AFTERWARDS:
        assert ending.state.startswith("cut short: ")
        assert words in ending.state
        assert name == "Ctrl-C" or words in str(ending.error)


@pytest.mark.parametrize("name", [name for name in FAULTS if name not in FIRMWARE_ONLY])
def test_the_stage_stops_and_what_was_taken_is_kept(name):
    hold(name, try_capture(name, "emulator"), within=0.2)


@firmware
@pytest.mark.real_time
@pytest.mark.parametrize("name", FAULTS)
def test_the_firmwares_stage_stops_and_what_was_taken_is_kept(name):
    hold(name, try_capture(name, PROGRAM))


@firmware
@pytest.mark.real_time
@pytest.mark.parametrize("name", SETTINGS)
def test_settings_of_the_firmware_that_do_not_fit_are_refused(name):
    changed, words = SETTINGS[name]
    ending = try_capture("none", PROGRAM, changed)
    assert words in str(ending.error)
    assert (ending.state == "complete") == (words == "")
