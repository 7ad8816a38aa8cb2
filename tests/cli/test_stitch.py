"""``mirrorskin stitch`` on results in files."""

import numpy as np
import pytest
from commands import done, refused, run
from moved_surfaces import bumpy, sampled

from mirrorskin import io


@pytest.fixture
def names():
    rng = np.random.default_rng(0)
    for number, shift in enumerate((0.0, -1.2)):
        io.save_result(sampled(bumpy, shift=(shift, 0.0, 0.0), rng=rng), f"touch-{number}.h5")
    return ["touch-0.h5", "touch-1.h5"]


def test_touches_become_a_result_that_is_wider(names):
    ended = run("stitch", *names, "-o", "whole.h5")
    assert (ended.code, ended.said) == (0, "")
    assert ended.out.startswith("whole.h5: height at ")
    whole = io.open_result("whole.h5")
    assert whole.height.shape[1] == pytest.approx(80 + 1.2 / 0.05, abs=4)
    assert whole.process["touch_1"] == "touch-1.h5"


def test_a_stated_offset_is_used(names):
    done("stitch", *names, "--offset", "1.2mm,0mm", "-o", "whole.h5")
    assert io.open_result("whole.h5").height.shape[1] == pytest.approx(80 + 1.2 / 0.05, abs=4)
    refused("check --offset", "stitch", *names, "--offset=-3mm,0mm", "-o", "other.h5")
    refused("--offset", "stitch", *names, "--offset", "1.2", "-o", "other.h5")


def hills(x, y):
    """Steep nearly everywhere, as the sensor sees no level ground; mm."""
    waves = 0.12 * np.sin(2 * x + 0.3) * np.cos(1.7 * y) + 0.08 * np.sin(2.1 * y + 1.3 * x)
    return waves - 0.02 * x * x - 0.05 * y * y - 0.1


def test_presses_of_an_object_wider_than_the_field_become_all_of_it():
    x, y = np.meshgrid(*(np.arange(-reach, reach + 1) * 0.05 for reach in (70, 45)))
    np.save("wide.npy", hills(x, -y))  # from the upper edge on
    field = "--size 64x48 --pixel-size 0.05mm --frames 30 --travel-step 0.03mm --references exact"
    for number, along in enumerate((0.0, 1.13, -1.06)):
        shift = f"--object-shift={along}mm,0.07mm"
        words = "--object", "wide.npy", *field.split(), shift, "-o", f"{number}.h5"
        assert run("simulate vertical", *words).code == 0
        assert run("reconstruct", f"{number}.h5").code == 0
    done("stitch", *(f"{number}-result.h5" for number in range(3)), "-o", "whole.h5")
    whole = io.open_result("whole.h5")
    # The first press has the object's middle at y 0.07 mm; its highest point is at height 0.
    error = whole.height - (hills(*np.meshgrid(whole.x, whole.y - 0.07)) - hills(x, y).max())
    finite = np.isfinite(error)
    across = whole.x[finite.any(axis=0)]
    assert across[-1] - across[0] > 1.5 * 64 * 0.05
    measured = io.open_result("0-result.h5").filled == 0
    assert finite.sum() > 1.4 * measured.sum()
    assert np.median(np.abs(error[finite])) < 0.01  # steps of 0.03 mm
    agree = whole.status == 1
    assert 0.7 < np.mean((error[agree] / whole.height_sigma[agree]) ** 2) < 1.4


def test_a_single_touch_is_refused_in_a_line(names):
    refused("two or more", "stitch", names[0], "-o", "whole.h5")


def test_the_output_is_none_of_the_inputs(names):
    refused("", "stitch", *names, "-o", names[1])
