"""A batch on this machine's devices: all are used, and it ends on request."""

import os
import signal
import subprocess
import sys
import threading
import time
from types import SimpleNamespace

import pytest
from batches import half_written, press

from mirrorskin import io
from mirrorskin.engine.batch import local
from mirrorskin.engine.batch.jobs import Plan, make_jobs
from mirrorskin.engine.batch.local import default_devices, run_local
from mirrorskin.kernels import device as device_layer
from mirrorskin.kernels.device import Device, open_device


@pytest.fixture
def device():
    return open_device()


@pytest.fixture
def jobs(tmp_path):
    return make_jobs([press(tmp_path / f"{name}.h5") for name in "abcd"], tmp_path / "out")


def test_several_devices_work_at_the_same_time(jobs):
    devices = [Device(device_layer._find()[0]) for _ in range(2)]
    met = threading.Barrier(2)
    threads = {}

    def watch(job, frames):
        if frames > 0 and len(threads) < 2:
            threads[job] = threading.get_ident()
            met.wait(timeout=120)

    outcomes = list(run_local(jobs, Plan(), devices, watch))
    assert {outcome.job for outcome in outcomes if outcome.state == "done"} == set(jobs)
    assert len(set(threads.values())) == 2
    assert all(outcome.profile.records() for outcome in devices)


def test_leaving_early_ends_the_batch(jobs, device):
    threads = threading.active_count()
    outcomes = run_local(jobs, Plan(), [device])
    assert next(outcomes).job == jobs[0]
    outcomes.close()
    assert threading.active_count() == threads
    assert not jobs[-1].target.exists()
    assert not half_written(jobs[0].target.parent)


def test_ctrl_c_gives_up_the_job_under_way_and_keeps_the_finished_ones(jobs, device, monkeypatch):
    finished, ending, finish = [], threading.Event(), local._finish
    monkeypatch.setattr(local, "_finish", lambda *threads: (ending.set(), finish(*threads)))

    def interrupt(job, frames):
        if job == jobs[1] and 0 < frames < 8:
            signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
            assert ending.wait(60)

    outcomes = run_local(jobs, Plan(memory_limit=5 * 7), [device], interrupt)
    with pytest.raises(KeyboardInterrupt):
        finished.extend(outcomes)
    assert io.open_result(jobs[0].target).height is not None
    assert [path.name for path in jobs[0].target.parent.iterdir()] == [jobs[0].target.name]
    states = [outcome.state for outcome in run_local(jobs, Plan(memory_limit=5 * 7), [device])]
    assert states == ["kept", "done", "done", "done"]


def test_all_gpus_are_used_where_one_is_the_default(monkeypatch):
    gpu, other_gpu = (SimpleNamespace(info=SimpleNamespace(kind="gpu")) for _ in range(2))
    monkeypatch.setattr(local, "open_device", lambda: gpu)
    monkeypatch.setattr(local, "open_devices", lambda choice: {"all": [gpu, other_gpu]}[choice])
    monkeypatch.delenv("PYOPENCL_CTX", raising=False)
    assert default_devices() == [gpu, other_gpu]
    monkeypatch.setitem(os.environ, "PYOPENCL_CTX", "0:1")
    assert default_devices() == [gpu]


HANGS = """
import signal, threading
from mirrorskin.engine.batch import local
signal.signal(signal.SIGINT, signal.default_int_handler)  # which programs in the background do without
for wait in (0.5, 1.0, 1.5):
    threading.Timer(wait, signal.pthread_kill, [threading.main_thread().ident, signal.SIGINT]).start()
local._wait(threading.Semaphore(0))
"""


@pytest.mark.slow
def test_a_thread_that_hangs_does_not_delay_a_repeated_signal():
    start = time.monotonic()
    ended = subprocess.run([sys.executable, "-c", HANGS], check=False)
    assert ended.returncode == 130
    assert time.monotonic() - start < 40
