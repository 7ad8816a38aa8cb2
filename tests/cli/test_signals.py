"""Repeated signals and limits of the system: one line, and never an abort."""

import os
import resource
import signal
import subprocess
import sys

import pytest
from commands import run
from stacks import record, sphere

from mirrorskin import io


@pytest.fixture
def press(tmp_path):
    return record(sphere(), tmp_path / "press.h5")


@pytest.mark.parametrize("second", ["SIGINT", "SIGTERM"])
def test_a_second_signal_does_not_interrupt_what_the_first_one_began(press, monkeypatch, capfd, second):
    events = []

    def describe(path):
        try:
            signal.raise_signal(signal.SIGINT)
        finally:
            signal.raise_signal(getattr(signal, second))
            events.append("cleaned up")

    monkeypatch.setattr(io, "describe", describe)
    ended = run("info", press)
    assert (ended.code, ended.out, ended.said) == (130, "", "")
    assert events == ["cleaned up"]
    assert capfd.readouterr().err == "mirrorskin: it is being stopped; two more Ctrl-C end it at once\n"


# Waits for a thread that never ends, as for OpenCL at work, while Ctrl-C is pressed four times.
INSISTING = """
import signal, sys, threading
from mirrorskin import io
from mirrorskin.cli.main import program
signal.signal(signal.SIGINT, signal.default_int_handler)

def describe(path):
    try:
        signal.raise_signal(signal.SIGINT)
    finally:
        for _ in range(3):
            signal.raise_signal(signal.SIGINT)
        threading.Event().wait()

io.describe = describe
sys.argv = ["mirrorskin", "info", "press.h5"]
program()
"""


def test_a_repeated_signal_ends_a_hanging_program_at_once_and_without_an_abort(press):
    command = [sys.executable, "-c", INSISTING]
    process = subprocess.run(
        command, cwd=press.parent, capture_output=True, text=True, timeout=120, check=False
    )
    assert (process.returncode, process.stdout) == (130, "")
    assert process.stderr == "mirrorskin: it is being stopped; two more Ctrl-C end it at once\n"


HANDLED = [signal.SIGTERM, signal.SIGHUP, signal.SIGALRM, signal.SIGINT]


def handlers():
    return [signal.getsignal(number) for number in HANDLED]


@pytest.mark.parametrize("own_handler", [False, True])
def test_handlers_of_the_caller_are_restored(press, monkeypatch, own_handler):
    before = handlers()

    class Careless:
        def __del__(self):
            raise KeyboardInterrupt  # is lost, and raised again by alarms

    def describe(path):
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGALRM})
        Careless()
        signal.sigwait({signal.SIGALRM})  # one alarm is missed, as by a program that is about to wait
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGALRM})
        signal.pause()

    try:
        if own_handler:
            for number in HANDLED:
                signal.signal(number, lambda *_: None)
        installed = handlers()
        assert run("info", press).code == 0
        assert handlers() == installed
        monkeypatch.setattr(io, "describe", describe)
        assert run("info", press).code == 130
        assert handlers() == installed
        assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
    finally:
        for number, handler in zip(HANDLED, before, strict=True):
            signal.signal(number, handler)


# The handlers after the command line has run as a program: Ctrl-C ends the interpreter, without a traceback.
RETURNED = """
import contextlib, signal, sys
from mirrorskin.cli.main import program
own = lambda *_: None
for name in sys.argv.pop().split(","):
    signal.signal(getattr(signal, name), own)
with contextlib.suppress(SystemExit):
    program()
names = {own: "own", signal.SIG_DFL: "default"}
print([names[signal.getsignal(getattr(signal, name))] for name in ("SIGTERM", "SIGHUP", "SIGINT")])
"""


@pytest.mark.parametrize(
    ("handler", "expected"),
    [("SIGTERM", ["own", "default", "default"]), ("SIGHUP,SIGINT", ["default", "own", "own"])],
)
def test_handlers_after_a_program(handler, expected):
    command = [sys.executable, "-c", RETURNED, "--version", handler]
    process = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    assert process.stdout.splitlines()[1:] == [str(expected)]


@pytest.mark.parametrize(
    ("limit", "message"), [(400_000 << 10, "512 MB are needed"), (900 << 20, "PoCL needs")]
)
def test_too_little_address_space_is_one_line(press, limit, message):
    # 400 000 KB is 'ulimit -v 400000', with which PoCL's threads aborted; LLVM crashed with 900 MB.
    process = subprocess.run(
        [sys.executable, "-m", "mirrorskin.cli.main", "reconstruct", press, "-o", press.with_name("r.h5")],
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (limit, limit)),
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert process.returncode == 1
    assert process.stderr.count("\n") == 1
    assert f"the address space is limited to {limit >> 20} MB, and" in process.stderr
    assert message in process.stderr


@pytest.mark.parametrize(
    "error",
    [
        ImportError("libscipy_openblas.so: failed to map segment from shared object"),
        OSError(12, "Cannot allocate memory"),
        RuntimeError("can't start new thread"),
    ],
)
def test_memory_that_the_system_refuses_to_a_library_is_one_line(press, monkeypatch, error):
    def describe(path):
        raise error

    monkeypatch.setattr(io, "describe", describe)
    ended = run("info", press)
    assert ended.code == 1
    assert ended.said == (
        f"mirrorskin: not enough memory ({error}): take a smaller region or fewer frames, or end other"
        " programs\n"
    )
