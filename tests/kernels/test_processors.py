"""The processors that a process may use: those of its affinity, and of the control groups of a container."""

import json
import os
import subprocess
import sys

import pytest

from mirrorskin import processors

NOTE = "from mirrorskin.kernels.device import open_device; print(open_device().info.note)"
several = pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="one processor cannot be divided")


def run(*words, **variables):
    """Run Python on one processor only."""
    environment = {key: text for key, text in os.environ.items() if key != processors.POCL_THREADS}
    first = min(os.sched_getaffinity(0))
    ended = subprocess.run(
        [sys.executable, *words],
        env=environment | variables,
        preexec_fn=lambda: os.sched_setaffinity(0, {first}),
        capture_output=True,
        text=True,
        timeout=100,
        check=True,
    )
    return ended.stdout


@pytest.fixture(autouse=True)
def _forgotten():
    processors._limit.cache_clear()
    yield
    processors._limit.cache_clear()


@several
def test_the_command_line_gives_pocl_the_processors_that_it_may_use():
    devices = json.loads(run("-m", "mirrorskin", "devices", "--json"))["devices"]
    assert [device["compute_units"] for device in devices if device["name"].startswith("pthread")] == [1]
    chosen = json.loads(run("-m", "mirrorskin", "devices", "--json", **{processors.POCL_THREADS: "2"}))[
        "devices"
    ]
    assert [device["compute_units"] for device in chosen if device["name"].startswith("pthread")] == [2]


@several
def test_in_python_a_note_states_that_there_are_more_threads_than_processors():
    note = run("-c", NOTE)
    assert "threads, and this process may use 1 processor: set POCL_MAX_PTHREAD_COUNT=1 before" in note
    assert "threads" not in run("-c", NOTE, **{processors.POCL_THREADS: "1"})


@pytest.mark.parametrize(
    ("group", "files", "expected"),
    [
        ("0::/", {"cpu.max": "200000 100000\n"}, 2),
        ("0::/", {"cpu.max": "150000 100000\n"}, 2),
        ("0::/", {"cpu.max": "20000 100000\n"}, 1),
        ("0::/", {"cpu.max": "max 100000\n"}, 8),
        ("0::/a/b", {"a/cpu.max": "300000 100000\n", "a/b/cpu.max": "max 100000\n"}, 3),
        ("0::/of/the/host", {"cpu.max": "400000 100000\n"}, 4),
        (
            "4:cpu,cpuacct:/a",
            {f"cpu,cpuacct/a/cpu.cfs_{k}_us": v for k, v in {"quota": "250000", "period": "100000"}.items()},
            3,
        ),
        ("1:cpu:/", {"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, 8),
        ("1:cpu:/", {"cpu/cpu.cfs_quota_us": "50000\n", "cpu/cpu.cfs_period_us": "50000\n"}, 1),
        ("1:cpuset:/\nnonsense", {}, 8),
        ("0::/", {"cpu.max": "\n"}, 8),
    ],
)
def test_the_limit_of_a_container_is_obeyed(group, files, expected, tmp_path, monkeypatch):
    (tmp_path / "cgroup").write_text(f"7:memory:/\n{group}\n")
    for name, text in files.items():
        file = tmp_path / "limits" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    monkeypatch.setattr(processors, "_GROUPS", tmp_path / "cgroup")
    monkeypatch.setattr(processors, "_LIMITS", tmp_path / "limits")
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)))
    assert processors.usable_cores() == expected


def test_without_control_groups_the_affinity_counts(tmp_path, monkeypatch):
    monkeypatch.setattr(processors, "_GROUPS", tmp_path / "none")
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 3})
    assert processors.usable_cores() == 2
