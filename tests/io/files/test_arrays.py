"""Files of NumPy's arrays: what they contain is read, or its absence reported."""

import numpy as np
import pytest

from mirrorskin.io import Steps, open_recording

FRAMES = np.random.default_rng(0).integers(1, 256, (8, 5, 7), np.uint8)


def opened(path, **options):
    return open_recording(path, **{"travel": Steps(0.1)} | options)


@pytest.mark.parametrize("order", ["C", "F"])
def test_an_array_that_follows_another_one_in_a_file_is_reported(tmp_path, order):
    with (tmp_path / "a.npy").open("wb") as file:
        for part in np.split(FRAMES, 2):
            np.save(file, np.asarray(part, order=order))
    with opened(tmp_path / "a.npy") as source:
        assert source.shape == (4, 5, 7)
        ((kind, warning, text),) = [(part.kind, part.warning, part.text) for part in source.findings]
    assert (kind, warning) == ("number of frames", True)
    assert "states 4 x 5 x 7, uint8, and another array follows" in text


def test_bytes_after_an_array_are_reported(tmp_path):
    np.save(tmp_path / "a.npy", FRAMES[:5])
    with (tmp_path / "a.npy").open("ab") as file:
        file.write(FRAMES[5:].tobytes())
    with opened(tmp_path / "a.npy") as source:
        assert [part.text.partition(": ")[0] for part in source.findings] == [
            "its header states 5 x 5 x 7, uint8, and 105 bytes follow"
        ]
