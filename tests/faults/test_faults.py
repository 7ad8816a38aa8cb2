"""A failing call of any kind: one line, no half-written file, and the next command works."""

import gc
import re
import sys

import numpy as np
import pytest
from batches import press, rotation
from commands import run
from injected_faults import KINDS, failing

from mirrorskin import io
from mirrorskin.kernels import device as device_layer


@pytest.fixture
def lost(monkeypatch):
    """Errors that nobody could catch, of destructors: Python prints them with a traceback."""
    names = []
    monkeypatch.setattr(sys, "unraisablehook", lambda error: names.append(error.exc_value))
    yield names
    device_layer._open.cache_clear()


@pytest.fixture(params=["press", "rotation", "batch"])
def command(request, tmp_path):
    """A short command, but for its output, and the files that it writes there."""
    if request.param == "batch":
        (tmp_path / "in").mkdir()
        sources = [press(tmp_path / "in" / f"{name}.h5", seed) for seed, name in enumerate("ab")]
        return ["batch", *sources, "-o"], ["a-result.h5", "b-result.h5"]
    make = {"press": press, "rotation": rotation}[request.param]
    return ["reconstruct", make(tmp_path / "in.h5"), "-o"], [""]


def heights(output, names):
    return {name: io.open_result(output / name).height for name in names if (output / name).is_file()}


def check(command, kind, numbers, tmp_path, lost):
    """Let each of these calls fail, or at most as many as there are; return how many ended with a line."""
    words, names = command
    output = tmp_path / "sound"
    with failing(kind) as calls:
        assert run(*words, output).code == 0
    sound, ended_so = heights(output, names), 0
    for number in numbers(calls.count):
        output = tmp_path / f"{kind}-{number}"
        with failing(kind, number):
            ended = run(*words, output)
            gc.collect()
        where = f"{kind} {number} of {calls.count}: {ended}"
        stored = heights(output, names)
        for name, height in stored.items():
            np.testing.assert_array_equal(height, sound[name], where)
        assert not lost, where
        assert not list(tmp_path.rglob("*.part")), where
        if ended.code == 0:
            assert stored.keys() == sound.keys(), where
            continue
        ended_so += 1
        assert ended.code in (1, 2), where
        failures = re.findall("^failed: (.*)$", ended.out, re.MULTILINE)
        if failures:
            assert len(set(failures)) == len(names) - len(stored), where
            assert ended.said == "", where
        else:
            assert re.fullmatch("mirrorskin: .+\n", ended.said), where
            assert not stored, where
        assert "unexpected" not in ended.out, where
    assert run(*words, tmp_path / "after").code == 0
    for name, height in heights(tmp_path / "after", names).items():
        np.testing.assert_array_equal(height, sound[name])
    return ended_so


def at_most(size):
    """Choose so many calls, evenly, of all that there are."""
    return lambda count: range(0, count, 1 + count // size)


@pytest.mark.parametrize("command", ["press"], indirect=True)
@pytest.mark.parametrize("kind", KINDS)
def test_a_call_that_fails_ends_in_a_line(command, kind, tmp_path, lost):
    assert check(command, kind, at_most(3), tmp_path, lost) > 0


@pytest.mark.slow
@pytest.mark.parametrize("command", ["press"], indirect=True)
@pytest.mark.parametrize("kind", KINDS)
def test_whichever_call_fails_it_ends_in_a_line(command, kind, tmp_path, lost):
    assert check(command, kind, range, tmp_path, lost) > 0


@pytest.mark.slow
@pytest.mark.parametrize("command", ["rotation", "batch"], indirect=True)
@pytest.mark.parametrize("kind", KINDS)
def test_a_call_of_a_longer_command_that_fails_ends_in_a_line(command, kind, tmp_path, lost):
    assert check(command, kind, at_most(10), tmp_path, lost) > 0
