"""Options that take a number or a value for each pixel, as a picture or an array."""

import cv2
import numpy as np
import pytest
from commands import done, run
from stacks import ball

from mirrorskin import io

TRAVEL = np.round(np.arange(0.0, 1.3, 0.1), 10)


@pytest.fixture(autouse=True)
def press(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    source = ball((20, 24), 0.3, TRAVEL)
    np.save("press.npy", source.read(np.empty(source.shape, source.dtype)).frames)
    done("import press.npy -o press.h5 --motion vertical --travel-step 0.1mm --pixel-size 0.3mm")


def heights(dark, name):
    done(f"reconstruct press.h5 --dark {dark} --bright 200 -o {name}")
    return io.open_result(name)


@pytest.mark.parametrize("name", ["dark.png", "dark.tif", "dark.npy"])
def test_a_map_in_a_file_is_used(name):
    values = np.full((20, 24), 20, np.uint8)
    np.save(name, values) if name.endswith("npy") else cv2.imwrite(name, values)
    result, same = heights(name, "map.h5"), heights("20", "number.h5")
    np.testing.assert_array_equal(result.height, same.height)
    assert result.process["dark"] == "map given"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("none.png", "none.png: no such file"),
        ("press.npy", "press.npy has shape (13, 20, 24): a map (H, W) is needed"),
        ("small.npy", "(2, 3)"),
        ("20x", "a number of counts is needed"),
    ],
)
def test_another_file_is_refused_in_one_line(name, message):
    np.save("small.npy", np.zeros((2, 3)))
    ended = run(f"reconstruct press.h5 --dark {name} --bright 200")
    assert ended.code == 2
    assert message in ended.said
    assert ended.said.count("\n") == 1
