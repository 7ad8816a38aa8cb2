"""Programs built by PoCL are loaded as bitcode by the next process, or built again if that fails."""

import hashlib
import json
import os
import shutil
import subprocess
import sys

import platformdirs
import pytest

from mirrorskin.kernels import bitcode
from mirrorskin.kernels import device as device_layer
from mirrorskin.kernels.device import list_devices

CHANGED = """
__kernel void change(__global float *values, const int count)
{
    const int item = get_global_id(0);
    if (item < count)
        values[item] = CHANGE;
}
"""

# Prints what the kernel makes of 0, 1, 2, and how many programs were compiled for it.
CHANGE = f"""
import json, sys
import numpy as np
from mirrorskin.kernels.device import Device, open_device
compiled, compile = [], Device._compile
Device._compile = lambda *given: compiled.append(1) or compile(*given)
device = open_device("Portable Computing Language")
values = device.from_host("values", [0, 1, 2])
kernel = device.kernel('''{CHANGED}''', "change", CHANGE=sys.argv[1])
kernel(3, values=values, count=3, moved=24)
print(json.dumps([values.read().tolist(), len(compiled)]))
"""
EXP = [1, pytest.approx(2.7182817), pytest.approx(7.389056)]


@pytest.fixture
def start(tmp_path):
    """Start a process that changes numbers, with caches of the test's own."""
    if not any(bitcode.works_with(info.driver) and "Portable" in info.platform for info in list_devices()):
        pytest.skip("another OpenCL than PoCL 3.0")
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}
    environment.pop("POCL_CACHE_DIR", None)
    device_layer.open_device("Portable Computing Language")  # that PoCL can run a kernel is known from now on
    (tmp_path / "mirrorskin").mkdir()
    for record in platformdirs.user_cache_path("mirrorskin").glob("pocl-*"):
        shutil.copy(record, tmp_path / "mirrorskin")

    def begin(change, **variables):
        command, environ = [sys.executable, "-c", CHANGE, change], {**environment, **variables}
        return subprocess.Popen(command, env=environ, stdout=subprocess.PIPE, text=True)

    return begin


@pytest.fixture
def change(start):
    def run(change, **variables):
        with start(change, **variables) as process:
            return json.load(process.stdout)

    return run


def records(tmp_path):
    return list((tmp_path / "mirrorskin").glob("program-*"))


def test_a_program_is_compiled_once_and_works_without_pocls_cache(change, tmp_path):
    assert change("exp(values[item])") == [EXP, 1]
    assert change("exp(values[item])") == [EXP, 0]
    shutil.rmtree(tmp_path / "pocl")
    assert change("exp(values[item])") == [EXP, 0]
    assert len(records(tmp_path)) == 1


def test_kernels_of_one_name_in_several_programs_stay_apart(change, tmp_path):
    assert change("2*values[item]")[0] == [0, 2, 4]
    assert change("7-values[item]")[0] == [7, 6, 5]
    assert change("2*values[item]")[0] == [0, 2, 4]
    assert len(records(tmp_path)) == 2


def test_programs_of_one_processor_are_not_used_for_another(change, tmp_path):
    for processor, compiled in (("x86-64", 1), ("core2", 1), ("x86-64", 0)):
        assert change("exp(values[item])", MIRRORSKIN_PROCESSOR=processor) == [EXP, compiled]
    assert len(records(tmp_path)) == 2


def not_bitcode(record):
    """Replace the bitcode of a record, and seal it anew."""
    head, _, _ = record[32:].partition(b"\n")
    sealed = head + b"\nBC\xc0\xde no bitcode"
    return hashlib.sha256(sealed).digest() + sealed


def test_a_record_that_is_damaged_or_refused_by_pocl_is_made_again(change, tmp_path):
    change("2*values[item]")
    (record,) = records(tmp_path)
    sound = record.read_bytes()
    for damaged in (b"", sound[:-9], sound[:-1] + b"x", not_bitcode(sound)):
        record.write_bytes(damaged)
        assert change("2*values[item]") == [[0, 2, 4], 1]
    assert change("2*values[item]") == [[0, 2, 4], 0]


def test_a_folder_that_cannot_be_written_costs_only_time(change, tmp_path):
    shutil.rmtree(tmp_path / "mirrorskin")
    (tmp_path / "mirrorskin").write_text("a file where the folder should be")
    assert change("2*values[item]") == [[0, 2, 4], 1]


def test_processes_that_start_at_once_get_along(start, change, tmp_path):
    processes = [start(f"{factor}*values[item]") for factor in (2, 2, 3)]
    for process, factor in zip(processes, (2, 2, 3), strict=True):
        with process:
            assert json.load(process.stdout)[0] == [0, factor, 2 * factor]
    assert len(records(tmp_path)) == 2
    assert change("2*values[item]") == [[0, 2, 4], 0]
