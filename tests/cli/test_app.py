"""``mirrorskin app``: refusals, start and end."""

import importlib.util
import os
import signal
import subprocess
import sys
import urllib.request

import pytest
from commands import done, refused
from shown import ball

from mirrorskin import io


def test_without_panel_the_remedy_is_one_line(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    io.save_result(ball(), "ball.h5")
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(
        "mirrorskin.view.app.server.find_spec", lambda name: None if name == "panel" else find_spec(name)
    )
    assert "pip install 'mirrorskin[app]'" in refused("the application needs panel", "app ball.h5")


def test_a_file_that_cannot_be_read_is_refused_before_anything_is_served(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "text.h5").write_text("no HDF5")
    refused("text.h5", "app --no-browser text.h5")


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_it_prints_its_address_serves_and_ends(tmp_path, number):
    path = tmp_path / "press.h5"
    done("simulate vertical --size 48x40 --pixel-size 0.25mm --frames 12 -o", path)
    command = [sys.executable, "-m", "mirrorskin.cli.main", "app", str(path), "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as server:
        address = server.stdout.readline().strip()
        assert address.startswith("http://127.0.0.1:")
        with urllib.request.urlopen(address, timeout=60) as reply:
            assert b"mirrorskin" in reply.read()
        os.kill(server.pid, number)
        _, errors = server.communicate(timeout=60)
    assert server.returncode == (0 if number == signal.SIGINT else 128 + number)
    assert "Traceback" not in errors
