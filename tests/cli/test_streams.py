"""Standard streams that are closed, full or not read to the end, and interruptions: no traceback."""

import os
import signal
import socketserver
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path

import pytest
from commands import run

CLOSED = [">&-", ">&- 2>&-", "<&- >&- 2>&-"]
LIMIT = 120  # seconds
PROGRAM = str(Path(sys.executable).with_name("mirrorskin"))
BEGUN = b"HTTP/1.1 200 OK\r\nContent-Length: 1000\r\n\r\n{"
FULL = "mirrorskin: standard output could not be written: No space left on device\n"
UNBUFFERED = pytest.mark.parametrize("unbuffered", ["", pytest.param("1", marks=pytest.mark.slow)])


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("streams") / "press.h5"
    assert (
        run("simulate vertical --size 8x8 --pixel-size 0.4mm --frames 6 --travel-step 0.5mm -o", path).code
        == 0
    )
    return path


def shell(line, unbuffered=""):
    """Run a line of shell, in which $M is the program; return its exit code and what standard error got."""
    environment = {**os.environ, "M": PROGRAM, "PYTHONUNBUFFERED": unbuffered}
    process = subprocess.run(
        ["bash", "-c", line], env=environment, capture_output=True, text=True, timeout=LIMIT
    )
    return process.returncode, process.stderr


@UNBUFFERED
@pytest.mark.parametrize(
    "words", ["info {}", "info {} --json", "--help", "--version", "info --help", "devices --json"]
)
def test_a_full_disk_for_output_is_one_line(recording, words, unbuffered):
    assert shell(f"$M {words.format(recording)} > /dev/full", unbuffered) == (1, FULL)


@UNBUFFERED
def test_a_reader_that_ends_early_is_not_an_error_to_report(recording, unbuffered):
    # The reader is gone before anything is written: it holds no end of the pipe.
    line = f"exec 3> >(exec true); wait $!; $M info {recording} >&3"
    assert shell(line, unbuffered) == (1, "")


@UNBUFFERED
@pytest.mark.parametrize(
    "closed",
    [*[pytest.param(ends, marks=pytest.mark.slow) for ends in ("<&- >&-", "<&-")], *CLOSED],
)
def test_closed_streams_are_nothing_to_stumble_over(recording, tmp_path, closed, unbuffered):
    result = tmp_path / "result.h5"
    code, errors = shell(f"$M reconstruct {recording} -o {result} {closed}", unbuffered)
    assert code == 0, errors
    assert run("info", result).code == 0  # nothing was printed into the file in place of a closed stream


@UNBUFFERED
@pytest.mark.parametrize("stream", ["2>&-", "2> /dev/full"])
def test_an_error_that_cannot_be_printed_keeps_its_exit_code(stream, unbuffered):
    assert shell(f"$M info gone.h5 {stream}", unbuffered) == (2, "")


def test_notes_that_cannot_be_printed_do_not_end_a_command(recording, tmp_path):
    result = tmp_path / "result.h5"
    assert shell(f"$M reconstruct {recording} -o {result} 2> /dev/full") == (0, "")
    assert result.exists()


@pytest.mark.parametrize(
    ("begun", "number", "code"),
    [
        (b"", signal.SIGINT, 130),
        (BEGUN, signal.SIGTERM, 143),
        pytest.param(BEGUN, signal.SIGINT, 130, marks=pytest.mark.slow),
        pytest.param(b"", signal.SIGTERM, 143, marks=pytest.mark.slow),
    ],
    ids=["silent, interrupted", "begun, ended", "begun, interrupted", "silent, ended"],
)
def test_an_interrupted_read_from_a_network_is_quiet(begun, number, code):
    asked = threading.Event()

    class Handler(socketserver.BaseRequestHandler):
        """Answers with what is begun, then waits until the reader is gone, which may be at any time."""

        def handle(self):
            with suppress(ConnectionError):
                self.request.recv(4096)
                self.request.sendall(begun)
                asked.set()
                while self.request.recv(4096):
                    pass

    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever).start()
        address = f"http://127.0.0.1:{server.server_address[1]}/press.zarr"
        try:
            with subprocess.Popen(
                [PROGRAM, "info", address], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
            ) as process:
                assert asked.wait(LIMIT)
                process.send_signal(number)
                out, errors = process.communicate(timeout=LIMIT)
        finally:
            server.shutdown()
    assert (process.returncode, out, errors) == (code, "", "")
