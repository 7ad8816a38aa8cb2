"""Which layout a device gets: the fastest, measured once."""

from types import SimpleNamespace

import numpy as np
import pytest

from mirrorskin.engine import OnsetSearch, autotune
from mirrorskin.engine.press.onset import _trial
from mirrorskin.kernels.errors import DeviceError
from mirrorskin.kernels.layout import CPU_LAYOUT, GPU_LAYOUT


def fake_device():
    info = SimpleNamespace(title="Fake: device", driver="1", compute_units=2)
    return SimpleNamespace(info=info, layout=CPU_LAYOUT, tuned=False)


@pytest.fixture
def memory(monkeypatch):
    """Stand in for the cache folder."""
    kept = {}
    monkeypatch.setattr(autotune, "recall", lambda topic, key: kept.get((topic, key)))
    monkeypatch.setattr(autotune, "keep", lambda topic, key, answer: kept.__setitem__((topic, key), answer))
    return kept


@pytest.fixture
def clock(monkeypatch):
    """Let runs take the time they say."""
    now = SimpleNamespace(seconds=0.0)
    monkeypatch.setattr(autotune, "time", SimpleNamespace(perf_counter=lambda: now.seconds))
    return now


def trial(clock, seconds):
    """A trial that takes so long in each shape; None where it cannot run."""
    prepared = []

    def prepare(device):
        takes = seconds[device.layout]
        prepared.append(device.layout)
        if takes is None:
            raise DeviceError(f"no kernel with {device.layout.lanes} lanes")
        return lambda: setattr(clock, "seconds", clock.seconds + takes)

    return prepare, prepared


@pytest.mark.parametrize(
    ("seconds", "best"),
    [
        ({CPU_LAYOUT: 1, GPU_LAYOUT: 2}, CPU_LAYOUT),
        ({CPU_LAYOUT: 2, GPU_LAYOUT: 1}, GPU_LAYOUT),
        ({CPU_LAYOUT: None, GPU_LAYOUT: 9}, GPU_LAYOUT),
    ],
)
def test_the_fastest_layout_is_taken_and_remembered(memory, clock, seconds, best):
    prepare, prepared = trial(clock, seconds)
    first, second = fake_device(), fake_device()
    for device in (first, first, second):
        autotune.choose_layout(device, prepare)
        assert device.layout is best
        assert device.tuned
    assert len(prepared) == 2


def test_another_driver_is_measured_anew(memory, clock):
    prepare, prepared = trial(clock, {CPU_LAYOUT: 1, GPU_LAYOUT: 2})
    autotune.choose_layout(fake_device(), prepare)
    other = fake_device()
    other.info.driver = "2"
    autotune.choose_layout(other, prepare)
    assert len(prepared) == 4


def test_what_is_remembered_wrongly_is_measured_anew(memory, clock):
    prepare, _ = trial(clock, {CPU_LAYOUT: 2, GPU_LAYOUT: 1})
    autotune.choose_layout(fake_device(), prepare)
    for nonsense in ("", "7", "-1", "a shape"):
        memory.update(dict.fromkeys(memory, nonsense))
        device = fake_device()
        autotune.choose_layout(device, prepare)
        assert device.layout is GPU_LAYOUT


def test_a_device_that_runs_in_no_layout_says_so_each_time(memory, clock):
    prepare, _ = trial(clock, {CPU_LAYOUT: None, GPU_LAYOUT: None})
    device = fake_device()
    for _ in range(2):
        with pytest.raises(DeviceError, match="no kernel with 4 lanes"):
            autotune.choose_layout(device, prepare)
    assert not memory


@pytest.mark.slow
def test_the_trial_runs_in_every_layout(device, monkeypatch):
    for shape in (CPU_LAYOUT, GPU_LAYOUT):
        monkeypatch.setattr(device, "layout", shape)
        device.profile.clear()
        _trial(device)()
        assert "onset_scan" in [record.name for record in device.profile.records()]


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
def test_both_layouts_give_the_same(device, monkeypatch, dtype):
    frames = np.random.default_rng(0).integers(0, 256, (70, 13, 29)).astype(dtype)
    found = []
    for shape in (CPU_LAYOUT, GPU_LAYOUT):
        monkeypatch.setattr(device, "layout", shape)
        search = OnsetSearch((13, 29), dtype, dark=10, bright=200, noise=8.0, device=device)
        search.push(frames, travel=np.arange(70.0))
        found.append(search.result())
    for name in ("height", "sigma", "status", "frame"):
        np.testing.assert_array_equal(getattr(found[0], name), getattr(found[1], name))
