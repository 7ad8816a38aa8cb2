"""Parts of a calibration made with another pixel size are not used with this one."""

from dataclasses import replace

import numpy as np
import pytest
from calibrations import a_calibration, a_lens
from growing import Feed
from stacks import MadeUp, random_stack

from mirrorskin import io
from mirrorskin.io.model.calibrated import outdated, size_facts

PHASE = np.linspace(0.1, 7.0, 8)


def made_with(size, only, lens=None):
    """Return a calibration whose parts were made with a pixel size, and which has a lens or none."""
    calibration = a_calibration(only=only)
    facts = size_facts(size)
    process = {
        f"{part}.{key}": value for part in ("zenith", "tilt", "elastic") for key, value in facts.items()
    }
    return replace(calibration, lens=lens, process=process, name="cal.h5")


def source(motion="axial", size=(0.1, 0.2)):
    positions = {"phase": PHASE} if motion == "axial" else {"travel": PHASE}
    return MadeUp(random_stack(), io.Header(motion, pixel_size=size), **positions)


@pytest.mark.parametrize(
    ("motion", "only", "command"),
    [("axial", "zenith", "zenith"), ("axial", "precession", "tilt"), ("vertical", "gel", "elastic")],
)
def test_a_part_that_was_made_with_another_pixel_size_is_refused_in_a_line(motion, only, command):
    with pytest.raises(io.InputError) as caught:
        io.Calibrated(source(motion), made_with((0.0998, 0.2), [only]))
    assert str(caught.value) == (
        f"cal.h5: calibrate {command} again: it was made with pixels of 0.0998 x 0.2 mm,"
        " made up states 0.1 x 0.2 mm"
    )


def test_a_new_scale_puts_the_zenith_out_of_use():
    calibration = made_with((0.1, 0.2), ["zenith"])
    assert io.Calibrated(source(), calibration).header.pixel_size == (0.1, 0.2)
    with pytest.raises(
        io.InputError, match=r"calibrate zenith again: .* the scale now states 0\.5 x 0\.6 mm"
    ):
        io.Calibrated(source(), replace(calibration, lens=a_lens()))


def test_a_live_source_is_refused_before_it_moves():
    with pytest.raises(io.InputError, match="calibrate zenith again"):
        io.Calibrated(Feed(8, motion="axial"), made_with((0.1, 0.2), ["zenith"], a_lens()))


@pytest.mark.parametrize("motion", ["axial", "vertical"])
def test_the_scale_takes_precedence_over_the_recording(motion):
    calibration = made_with((0.5, 0.6), ["zenith", "precession", "gel"], a_lens())
    assert io.Calibrated(source(motion), calibration).header.pixel_size == (0.5, 0.6)


def test_a_thousandth_is_the_same_size_and_an_unknown_one_is_accepted():
    parts = ["zenith", "precession", "gel"]
    assert not list(outdated(made_with((0.1, 0.2), parts), (0.10005, 0.19995)))
    assert [part for part, _ in outdated(made_with((0.1, 0.2), parts), (0.1, 0.2003))] == parts
    io.Calibrated(source(size=None), made_with((0.3, 0.3), parts))
    io.Calibrated(source(), a_calibration(only=parts))
