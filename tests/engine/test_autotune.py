"""Which layout a device gets: the fastest, measured once."""

from types import SimpleNamespace

import numpy as np
import pytest

from mirrorskin.engine import OnsetSearch, autotune
from mirrorskin.engine.press.onset import _trial
from mirrorskin.kernels.errors import DeviceError
from mirrorskin.kernels.layout import CPU_LAYOUT, GPU_LAYOUT


@pytest.fixture
def trial(monkeypatch):
    """Makes a device for whose trial each layout takes so many seconds, None where it cannot run."""
    kept, now, prepared = {}, SimpleNamespace(seconds=0.0), []
    monkeypatch.setattr(autotune, "recall", lambda topic, key: kept.get((topic, key)))
    monkeypatch.setattr(autotune, "keep", lambda topic, key, answer: kept.__setitem__((topic, key), answer))
    monkeypatch.setattr(autotune, "time", SimpleNamespace(perf_counter=lambda: now.seconds))

    def choose(seconds, driver="1"):
        info = SimpleNamespace(title="Fake: device", driver=driver, compute_units=2)
        device = SimpleNamespace(info=info, layout=CPU_LAYOUT, tuned=False)

        def prepare(device):
            takes = seconds[device.layout]
            prepared.append(device.layout)
            if takes is None:
                raise DeviceError(f"no kernel with {device.layout.lanes} lanes")
            return lambda: setattr(now, "seconds", now.seconds + takes)

        autotune.choose_layout(device, prepare)
        assert device.tuned
        return device.layout

    return SimpleNamespace(choose=choose, prepared=prepared, kept=kept)


@pytest.mark.parametrize(
    ("cpu", "gpu", "best"), [(1, 2, CPU_LAYOUT), (2, 1, GPU_LAYOUT), (None, 9, GPU_LAYOUT)]
)
def test_the_fastest_layout_is_taken_and_kept_for_this_driver(trial, cpu, gpu, best):
    seconds = {CPU_LAYOUT: cpu, GPU_LAYOUT: gpu}
    assert trial.choose(seconds) is trial.choose(seconds) is best
    assert len(trial.prepared) == 2
    trial.choose(seconds, driver="2")
    assert len(trial.prepared) == 4
    for nonsense in ("", "7", "-1", "a shape"):
        trial.kept.update(dict.fromkeys(trial.kept, nonsense))
        assert trial.choose(seconds) is best


def test_a_device_that_runs_in_no_layout_says_so_each_time(trial):
    for _ in range(2):
        with pytest.raises(DeviceError, match="no kernel with 4 lanes"):
            trial.choose({CPU_LAYOUT: None, GPU_LAYOUT: None})
    assert not trial.kept


@pytest.mark.slow
def test_the_trial_runs_in_every_layout_and_all_give_the_same(device, monkeypatch):
    frames = np.random.default_rng(0).integers(0, 256, (70, 13, 29)).astype("uint16")
    found = []
    for layout in (CPU_LAYOUT, GPU_LAYOUT):
        monkeypatch.setattr(device, "layout", layout)
        device.profile.clear()
        _trial(device)()
        assert "onset_scan" in [record.name for record in device.profile.records()]
        search = OnsetSearch((13, 29), "uint16", dark=10, bright=200, noise=8.0, device=device)
        search.push(frames, travel=np.arange(70.0))
        found.append(search.result())
    for name in ("height", "sigma", "status", "frame"):
        np.testing.assert_array_equal(getattr(found[0], name), getattr(found[1], name))
