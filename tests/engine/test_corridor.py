"""How many functions and files a run enters: what an engineer has to read who follows a run through the code.

The limits are those of today. ``pytest -s`` prints the functions of each file.
"""

from __future__ import annotations

import pytest
from commands import done
from entered_functions import as_text, functions_entered

from mirrorskin import engine, io
from mirrorskin.kernels.device import open_device

pytestmark = pytest.mark.skipif(
    not open_device().info.shares_memory, reason="the limits are those of a device in the host's memory"
)

LEVELS = {"dark": 16.0, "bright": 224.0}
BY_CHANCE = 3  # functions: whether an array is copied or used in place depends on its address


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """A press and a rotation in a folder of their own."""
    folder = tmp_path_factory.mktemp("recordings")
    for name in ("press", "turn"):
        done(f"sample {name} -o", folder / f"{name}.h5")
    return folder


def assert_few(call, functions, files):
    """Run a call twice, and compare the numbers of functions and files that the second one enters."""
    entered = functions_entered(call)
    text = as_text(entered)
    print(text)
    assert sum(map(len, entered.values())) <= functions + BY_CHANCE, text
    assert len(entered) <= files, text


@pytest.mark.parametrize("levels", [LEVELS, {}], ids=["levels", "no levels"])
def test_library_run(recordings, levels):
    def run():
        with io.open_recording(recordings / "press.h5") as recording:
            engine.run(recording, engine.Onset(**levels))

    assert_few(run, 396, 57)


@pytest.mark.parametrize(
    ("line", "functions", "files"),
    [
        ("reconstruct press.h5", 570, 75),
        ("reconstruct turn.h5", 781, 98),
        ("fuse press.h5 turn.h5", 963, 115),
    ],
)
def test_command(recordings, monkeypatch, line, functions, files):
    monkeypatch.chdir(recordings)
    assert_few(lambda: done(line, "--overwrite"), functions, files)
