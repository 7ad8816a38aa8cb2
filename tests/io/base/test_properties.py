"""A number of recordings needs one declaration: rig files, recordings, MCAP and `info` follow."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import fields

import pytest

from mirrorskin import io
from mirrorskin.io.base.types import PROPERTIES

HUMIDITY = """    humidity: float | None = stated(
        of="stage",
        unit="%",
        text="humidity of the air",
        use="nothing depends on it",
        short="%: humidity of the air",
        kind="percentage",
        within=(0.0, 100.0),
        example="45.5",
    )
"""
# The declaration is added to the text of the module when it is imported.
TRIP = f"""
import importlib.machinery as machinery
import sys

changed = []


class Loader(machinery.SourceFileLoader):
    def source_to_code(self, data, path, **how):
        if path.endswith("io/base/types.py"):
            text = data.decode()
            data = text.replace("    line_time: float", {HUMIDITY!r} + "    line_time: float", 1).encode()
            changed.append(path)
        return super().source_to_code(data, path, **how)

    def get_code(self, name):
        return self.source_to_code(self.get_data(self.path), self.path)


finder = machinery.PathFinder


class Finder:
    def find_spec(self, name, path=None, target=None):
        spec = finder.find_spec(name, path, target)
        if name == "mirrorskin.io.base.types":
            spec.loader = Loader(name, spec.origin)
        return spec


sys.meta_path.insert(0, Finder())

from pathlib import Path

import numpy as np

from mirrorskin import io
from mirrorskin.hw.base.rig_file import TEMPLATE, load_rig
from mirrorskin.hw.rig.plans import VerticalPlan
from mirrorskin.hw.rig.scan import make_header
from mirrorskin.io.files.arrays import ArrayRecording
from mirrorskin.io.files.recorder import Recorder
from mirrorskin.io.formats.mcap import save_messages

assert changed
assert "# humidity = 45.5 " in TEMPLATE
rig = TEMPLATE.replace("# humidity", "humidity").replace('bright = "', '# bright = "')
Path("rig.toml").write_text(rig)
header = make_header(load_rig("rig.toml"), VerticalPlan(0.0, 1.0, speed=1.0))
known = {{"humidity": header.humidity, "title": header.title}}
source = ArrayRecording(np.zeros((3, 4, 5), np.uint8), {{"travel": np.arange(3.0)}}, known)
with Recorder(source, "press.h5") as recorder:
    recorder.drain()
with io.open_recording("press.h5") as recording:
    save_messages(recording, "press.mcap")
with io.open_recording("press.mcap") as messages, Recorder(messages, "again.h5") as recorder:
    recorder.drain()
print(io.describe("again.h5")["humidity"])
Path("rig.toml").write_text(rig.replace("humidity = 45.5", "humidity = 455"))
try:
    load_rig("rig.toml")
except io.InputError as error:
    print(error)
"""


def test_a_property_that_is_declared_travels_from_the_rig_file_to_info(tmp_path):
    pytest.importorskip("mcap_ros2")
    ended = subprocess.run(
        [sys.executable, "-c", TRIP], cwd=tmp_path, capture_output=True, text=True, timeout=120
    )
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.splitlines() == [
        "45.5 %",
        "rig.toml: stage.humidity is 455: a percentage from 0 to 100 % is needed; write e.g. humidity = 45.5",
    ]


def test_declared_properties_are_attributes_of_headers():
    assert {"travel_sigma", "line_time"} < set(PROPERTIES) <= {field.name for field in fields(io.Header)}
    assert "line_time : float or None\n    From the exposure of a row" in str(io.Header.__doc__)
