"""The device layer: the choice, arrays in both kinds of memory, builds that fail, profiles."""

import doctest
import os
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace
from weakref import WeakSet

import numpy as np
import pyopencl as cl
import pytest
from injected_faults import lost

from mirrorskin.kernels import device as device_layer
from mirrorskin.kernels import embedded
from mirrorskin.kernels.array import fetch
from mirrorskin.kernels.device import list_devices, open_device, open_devices
from mirrorskin.kernels.errors import DeviceError, DeviceMemoryError, UnknownDeviceError

MACROS = {"LANES": 16, "WORDS": 64, "STRIDE": 1}


def test_a_device_is_chosen_by_part_of_its_name_in_any_case():
    info = list_devices()[0]
    assert open_device(info.title.upper()).info == info
    assert open_device(info.kind).info.kind == info.kind


@pytest.mark.parametrize("name", ["99", "no such thing", ""])
def test_an_unknown_device_is_refused_and_the_known_ones_are_listed(name):
    with pytest.raises(UnknownDeviceError, match="no such device") as caught:
        open_device(name)
    assert list_devices()[0].name in str(caught.value)
    assert caught.value.exit_code == 2


def test_the_environment_may_choose(monkeypatch):
    monkeypatch.setenv("PYOPENCL_CTX", "0:0")
    assert open_device().info == list_devices()[0]
    monkeypatch.setenv("PYOPENCL_CTX", "99")
    with pytest.raises(UnknownDeviceError, match="PYOPENCL_CTX='99' matches no device"):
        open_device()


def test_without_any_device_the_remedy_is_named(monkeypatch):
    monkeypatch.setattr(device_layer, "_find", list)
    monkeypatch.setattr(embedded, "why_no_device", lambda: None)
    with pytest.raises(DeviceError, match="no OpenCL device found: install"):
        open_device()


@pytest.fixture
def machine(monkeypatch):
    """A machine with several devices: names of those that cannot be opened."""
    info = replace(list_devices()[0], platform="maker")
    devices = {
        "small card": replace(info, kind="gpu", shares_memory=False, compute_units=10, memory=2**33),
        "integrated": replace(info, kind="gpu", shares_memory=True, compute_units=99, memory=2**36),
        "processor": replace(info, kind="cpu", shares_memory=True, compute_units=8, memory=2**34),
        "large card": replace(info, kind="gpu", shares_memory=False, compute_units=132, memory=2**36),
    }
    broken = set()

    class Opened(str):
        """An open device: its name, and its description."""

        @property
        def info(self):
            return replace(devices[self], name=self)

    def opened(name):
        if name in broken:
            raise DeviceError(f"{name} cannot be used")
        return Opened(name)

    monkeypatch.delenv("PYOPENCL_CTX", raising=False)
    monkeypatch.setattr(device_layer, "_opened", WeakSet())
    monkeypatch.setattr(device_layer, "_left_out", set())
    monkeypatch.setattr(device_layer, "_find", lambda: list(devices))
    monkeypatch.setattr(device_layer, "_describe", lambda name: replace(devices[name], name=name))
    monkeypatch.setattr(device_layer, "_open", opened)
    return broken


def test_the_best_device_that_works_is_opened(machine, caplog):
    for best in ("large card", "small card", "integrated", "processor"):
        assert open_device() == open_device() == best
        machine.add(best)
    with pytest.raises(DeviceError, match="processor cannot be used"):
        open_device()
    left_out = [record.getMessage() for record in caplog.records]
    assert left_out == [
        f"maker: {name} is left out: {name} cannot be used"
        for name in ("large card", "small card", "integrated")
    ]


def test_all_devices_like_the_default_one_are_opened_the_best_first(machine):
    assert open_devices("all") == ["large card", "small card", "integrated"]
    machine.add("large card")
    assert open_devices(" All ") == ["small card", "integrated"]
    assert open_device("all") == "small card"


def test_a_list_of_devices_is_opened_in_its_order_and_none_twice(machine):
    assert open_devices(["processor", "integrated", "2"]) == ["processor", "integrated"]
    assert open_devices(["processor", "all"]) == ["processor", "large card", "small card", "integrated"]
    assert open_device(["processor", "integrated"]) == "processor"


def test_an_empty_list_of_devices_is_refused():
    with pytest.raises(UnknownDeviceError, match="no device is given: give at least one"):
        open_devices([])


def test_a_device_that_is_named_is_not_replaced(machine):
    machine |= {"large card", "small card", "integrated"}
    for name in ("large card", "gpu"):
        with pytest.raises(DeviceError, match="cannot be used"):
            open_device(name)


def test_a_kernel_that_does_not_compile_is_quoted(device):
    with pytest.raises(DeviceError, match=r"limits.cl line \d+ does not compile") as caught:
        device.kernel("limits", "read_all", get_global_id="1", **MACROS)
    assert "\n" not in str(caught.value)
    assert "`const long item = get_global_id(0);`" in str(caught.value)


def test_a_program_is_kept_and_a_damaged_one_is_built_again(device, tmp_path, monkeypatch):
    monkeypatch.setattr(device_layer, "_is_pocl", lambda _: False)  # which keeps its programs by itself
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for damaged in (False, False, True):
        opened = device_layer.Device(device.context.devices[0])
        words = opened.from_host("words", np.arange(8), np.uint32)
        opened.kernel("limits", "copy_all", **{**MACROS, "LANES": 2, "WORDS": 2})(
            1, words=words, count=2, moved=32
        )
        assert words.read().tolist() == [0, 1, 2, 3] * 2
        (file,) = (tmp_path / "mirrorskin").glob("program-*")
        if damaged:
            assert file.stat().st_size > 1000
        file.write_bytes(file.read_bytes()[:1000])


def test_a_kernel_of_ones_own_runs_and_may_use_what_ours_share(device, tmp_path):
    (tmp_path / "mine.cl").write_text(
        """#include "common.clh"
        __kernel void roots(const int count, OUT x)
        {
            for (int i = get_global_id(0) * TILE; i < LESSER((int)(get_global_id(0) + 1) * TILE, count); ++i)
                x[i] = root(x[i]);
        }"""
    )
    x = device.from_host("x", np.arange(1.0, 3000.0))
    device.kernel(tmp_path / "mine.cl", "roots")(2999, count=2999, x=x, moved=0)
    np.testing.assert_allclose(x.read(), np.sqrt(np.arange(1.0, 3000.0)), rtol=1e-6)
    (tmp_path / "worse.cl").write_text("__kernel void worse(const int x) { y = x; }")
    with pytest.raises(DeviceError, match=r"worse\.cl line 1 does not compile"):
        device.kernel(tmp_path / "worse.cl", "worse")


TWICE = """
#include "common.clh"
__kernel void twice(__global int *values, const int count) {
    const int item = get_global_id(0);
    if (item < count) values[item] *= 2;
}
"""


def test_a_kernel_in_a_text_runs_and_one_that_does_not_compile_is_quoted(device):
    values = device.from_host("values", np.arange(5), np.int32)
    device.kernel(TWICE, "twice")(5, values=values, count=5, moved=40)
    assert values.read().tolist() == [0, 2, 4, 6, 8]
    with pytest.raises(DeviceError, match=r"text\.cl line 5 does not compile.*`if .item < count. valus"):
        device.kernel(TWICE.replace("values[item]", "valus[item]"), "twice")


def test_a_kernel_that_is_not_in_the_source_is_one_line(device):
    with pytest.raises(DeviceError, match="there is no kernel two in the source; it has one"):
        device.kernel("__kernel void one(__global float *values, const int count) {}", "two")


def test_a_kernel_that_has_the_name_of_a_function_of_opencl_runs_or_is_one_line(device):
    values, message = device.array("values", (1,), np.float32), ""
    try:  # NVIDIA's compiler allows it
        source = "__kernel void cross(__global float *values) { values[0] = 7; }"
        device.kernel(source, "cross")(1, values=values, moved=4)
    except DeviceError as error:
        message = str(error)
    assert "cross is a function of OpenCL: rename the kernel" in message or values.read() == 7


def test_arguments_are_named_and_numbers_get_the_type_of_the_source(device):
    numbers = device.from_host("numbers", np.ones((8, 16), np.float32))
    kernel = device.kernel("limits", "multiply_all", LANES=16, WORDS=8, STRIDE=1)
    kernel(1, summand=np.float64(0.5), factor=2, numbers=numbers, steps=np.int64(1), count=8, moved=0)
    assert np.all(numbers.read() == 2.5)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"words": None, "size": 1}, r"missing: \['count'\]; unknown: \['size'\]; it takes"),
        ({"words": 1, "count": 1}, "words must be an array"),
        ({"words": None, "count": 0.5}, "count cannot be 0.5"),
        ({"words": None, "count": 2**31}, "count cannot be 2147483648"),
    ],
)
def test_wrong_arguments_are_defects(device, wrong, message):
    with pytest.raises(TypeError, match=f"^copy_all: .*{message}"):
        device.kernel("limits", "copy_all", **MACROS)(1, moved=0, **wrong)


def test_arguments_have_the_types_that_macros_and_conditions_give_them(device):
    source = """
    #define MAP __global const float *restrict  // one map
    #if BITS == 8 && !defined(WIDE)
    #define EXTRA MAP extra,
    #elif 1
    #define EXTRA
    #endif
    __kernel void one(MAP map, EXTRA const FRAME top
    #ifdef TAIL
        , const long tail
    #endif
    ) { }
    """
    short, long = (
        device.kernel(source, "one", FRAME="uchar", **more)
        for more in ({"BITS": 8}, {"BITS": 8, "WIDE": 1, "TAIL": 1})
    )
    assert (short.arguments, long.arguments) == (("map", "extra", "top"), ("map", "top", "tail"))
    long(1, map=None, top=255, tail=2**40, moved=0)
    with pytest.raises(TypeError, match="top cannot be 256"):
        long(1, map=None, top=256, tail=0, moved=0)


def test_an_argument_that_no_number_becomes_is_one_line(device):
    with pytest.raises(
        DeviceError, match="argument taken is of type sampler_t: use a number or a __global pointer"
    ):
        device.kernel("__kernel void one(const sampler_t taken) { }", "one")


def test_a_vector_is_an_argument_of_as_many_numbers(device):
    source = (
        "__kernel void one(const float4 numbers, __global float *sum) { *sum = numbers.x + 4 * numbers.w; }"
    )
    one, total = device.kernel(source, "one"), device.array("sum", (1,), np.float32)
    one(1, numbers=(1, 0, 0, 0.5), sum=total, moved=0)
    assert total.read()[0] == 3
    with pytest.raises(TypeError, match="4 numbers are needed"):
        one(1, numbers=(1, 0), sum=total, moved=0)


def test_a_parked_array_keeps_its_content(device):
    array = device.array("numbers", (3, 5), np.float32)
    array.write(np.arange(15).reshape(3, 5))
    for work in (lambda: None, lambda: array.write(np.full(5, 7), row=1)):
        array.park()
        work()
        array.park()
        expected = array.read()
        device.kernel(TWICE, "twice")(1, values=array, count=0, moved=0)
        np.testing.assert_array_equal(array.read(), expected)
    np.testing.assert_array_equal(expected, [[0, 1, 2, 3, 4], [7] * 5, [10, 11, 12, 13, 14]])


def test_zeros_and_numbers_that_no_kernel_has_seen_outlast_a_park(device):
    array = device.array("numbers", (2, 3), np.float32)
    array.park()
    array.write(np.ones(3), row=1)
    assert array.read().tolist() == [[0, 0, 0], [1, 1, 1]]
    array.park()
    array.fill(4)
    assert array.read().tolist() == [[4] * 3] * 2


def test_rows_are_read_and_written_and_the_others_stay(device):
    array = device.from_host("numbers", np.arange(12).reshape(4, 3), np.int32)
    array.write(np.array([30, 31, 32, 40]), row=2)
    expected = [[0, 1, 2], [3, 4, 5], [30, 31, 32], [40, 10, 11]]
    assert array.read().tolist() == expected
    assert array.read(2).tolist() == expected[2]
    rows = array.read(slice(1, 3))
    rows[...] = 0  # a copy
    assert array.read(slice(1, 3)).tolist() == expected[1:3]
    assert array.read(-1).tolist() == expected[-1]


def test_an_array_that_the_host_never_wrote_is_filled_or_left_on_the_device(device):
    device.profile.clear()
    zeros = device.array("zeros", (5, 7), np.uint8)
    for _ in range(2):
        device.kernel(TWICE, "twice")(1, values=zeros, count=0, moved=0)
        assert not zeros.read().any()
    device.array("anything", (5, 7), np.uint8, zeroed=False)
    zeros.fill(3)
    assert np.all(zeros.read() == 3)
    counts = device.array("counts", (5,), np.float32)
    counts.fill(-0.0)
    assert np.all(np.signbit(counts.read()))
    assert not [record for record in device.profile.records() if record.kind == "upload"]


def test_parts_of_several_arrays_are_waited_for_once(device):
    arrays = [device.from_host(name, np.full((3, 4), n), np.int32) for n, name in enumerate("abc")]
    for keep in (True, False):
        device.profile.clear()
        parts = fetch([(arrays[0], slice(None)), (arrays[1], 2), (arrays[2], slice(1, 3))], [keep] * 3)
        assert [part.shape for part in parts] == [(3, 4), (4,), (2, 4)]
        assert [int(part.max()) for part in parts] == [int(part.min()) for part in parts] == [0, 1, 2]
        records = [record for record in device.profile.records() if record.kind == "download"]
        assert sum(record.bytes for record in records) == (0 if device.info.shares_memory else 4 * 24)
        if not device.info.shares_memory:
            assert sum(record.runs for record in device.profile.records() if record.kind == "wait") == 1


def test_a_lack_of_memory_has_its_own_error(small_device):
    small_device.max_allocation = 100
    with pytest.raises(DeviceMemoryError, match="no memory for too much"):
        small_device.array("too much", (101,), np.uint8)
    small_device.array("just enough", (100,), np.uint8)


def test_a_drivers_own_lack_of_memory_has_its_own_error(small_device, monkeypatch):
    small_device.max_allocation = 2**60
    monkeypatch.setattr(small_device, "info", replace(small_device.info, shares_memory=False))
    with pytest.raises(DeviceMemoryError, match="no memory for maps"):
        small_device.array("maps", (2**50,), np.uint8)


def test_the_profile_lists_what_was_run(device):
    device.profile.clear()
    words = device.array("words", (128, 16), np.uint32)
    for _ in range(3):
        device.kernel("limits", "copy_all", **MACROS)(1, words=words, count=64, moved=8192)
    words.read()
    records = {(record.kind, record.name): record for record in device.profile.records()}
    kernel = records["kernel", "copy_all"]
    assert (kernel.runs, kernel.bytes) == (3, 3 * 8192)
    assert 0 < kernel.fastest <= kernel.seconds
    assert kernel.bandwidth == pytest.approx(kernel.bytes / kernel.seconds)
    copied = not device.info.shares_memory
    assert (("fill", "words") in records) is copied
    assert ("upload", "words") not in records
    assert records["wait", "words"].runs == 1
    assert (("download", "words") in records) is copied


def test_the_profile_stays_bounded(device):
    device.profile.clear()
    array = device.array("source", (1, 16), np.uint32)
    kernel = device.kernel("limits", "copy_all", **MACROS)
    for _ in range(2500):
        kernel(1, words=array, count=0, moved=1)
    assert len(device.profile._pending) < 1024
    runs = {record.name: record.runs for record in device.profile.records()}
    assert runs["copy_all"] == 2500


def test_a_work_group_is_no_larger_than_its_kernel_allows(device, monkeypatch):
    """A kernel that uses many registers allows less than its device."""
    ask = cl.Kernel.get_work_group_info

    def limited(kernel, param, on):
        limit = ask(kernel, param, on)
        return 2 if param == cl.kernel_work_group_info.WORK_GROUP_SIZE else limit

    monkeypatch.setattr(cl.Kernel, "get_work_group_info", limited)
    monkeypatch.setattr(device, "layout", replace(device.layout, group=64))
    assert device.kernel("__kernel void limited(__global uchar *values) { }", "limited").group == 2


PRESSED = """
import numpy as np
from mirrorskin import engine
from mirrorskin.kernels.device import open_device
from mirrorskin.kernels.layout import GPU_LAYOUT

device = open_device("Portable Computing")
device.layout = GPU_LAYOUT
frames = np.where(np.arange(9) < 5, 20, 200).astype(np.uint8)[:, None, None] * np.ones((1, 300), np.uint8)
found = engine.find_onset(frames, np.arange(9.0), device=device)
print(device.context.devices[0].max_work_group_size, np.isfinite(found.height).all())
"""


def test_work_groups_are_no_larger_than_the_device_allows():
    if not any("Portable Computing" in info.platform for info in list_devices()):
        pytest.skip("only PoCL can be told a limit")
    limited = {**os.environ, "POCL_MAX_WORK_GROUP_SIZE": "64"}
    command = [sys.executable, "-P", "-c", PRESSED]
    child = subprocess.run(command, env=limited, capture_output=True, text=True)
    assert child.stdout == "64 True\n", child.stderr


def test_a_cache_that_cannot_be_written_is_reported(device, monkeypatch):
    def refuse(file, options):
        raise PermissionError(13, "Permission denied", "/home/cache")

    monkeypatch.setattr(device, "_program", refuse)
    with pytest.raises(DeviceError, match="set XDG_CACHE_HOME"):
        device.kernel("limits", "copy_all", ANEW=1, **MACROS)


def test_a_kernel_that_cannot_be_read_is_reported(device, tmp_path):
    with pytest.raises(DeviceError, match=r"gone\.cl cannot be read .*; reinstall mirrorskin"):
        device.kernel(tmp_path / "gone.cl", "copy_all")


def test_a_lost_queue_is_reported(device, monkeypatch):
    def flush():
        raise lost()

    monkeypatch.setattr(device, "queue", SimpleNamespace(flush=flush))
    with pytest.raises(DeviceError, match=r"cannot start its work: .*; if this persists, choose another"):
        device.flush()


def test_the_example_runs():
    assert doctest.testmod(device_layer).failed == 0


FORKED = """
import os, signal
from mirrorskin.kernels.device import DeviceError, open_device
open_device({choice!r})
if not os.fork():
    signal.alarm(20)
    try:
        open_device({choice!r})
    except DeviceError as error:
        print(error, flush=True)
    os._exit(0)
os.wait()
"""


def test_a_forked_process_is_refused_instead_of_waiting_for_ever(device):
    script = FORKED.format(choice=device.info.title)
    completed = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert "forked from one that had used OpenCL" in completed.stdout


def test_an_array_is_copied_by_numpy_and_its_rows_stay_on_the_device(device):
    values = np.arange(24, dtype=np.float32).reshape(4, 3, 2)
    array = device.from_host("values", values)
    np.testing.assert_array_equal(np.asarray(array, np.float64), values)
    assert array[0:4] is array
    part = array[1:3]
    assert (len(part), part.ndim, part[1].shape) == (2, 3, (3, 2))
    np.testing.assert_array_equal(part.read(), values[1:3])
    np.testing.assert_array_equal(array.copy_region(5, (2, 4)).read(), values.ravel()[5:13].reshape(2, 4))


def test_a_copy_that_is_dropped_at_once_is_not_written_to_the_next_arrays_memory(device):
    source = device.from_host("source", np.ones((64, 1 << 16)))
    for _ in range(20):
        source.copy_region(0, source.shape)
        kept = device.from_host("kept", np.zeros(source.shape))
        device.finish()
        assert not kept.read().any()


@pytest.mark.filterwarnings("ignore:Non-empty compiler output")  # Intel's is never empty
def test_pyopencl_works_in_the_memory_of_an_array(device):
    array = device.from_host("values", np.arange(6.0))
    exported = array.as_pyopencl()
    exported += 1
    np.testing.assert_array_equal(array.read(), np.arange(1.0, 7.0))
    del array
    others = [device.from_host("others", np.full(6, -1.0)) for _ in range(3)]
    np.testing.assert_array_equal(exported.get(), np.arange(1.0, 7.0))
    assert len(others) == 3


def test_memory_of_the_host_is_exported_without_a_copy_and_other_memory_refused(device):
    array = device.from_host("values", np.arange(6.0))
    if array.is_shared:
        exported = np.from_dlpack(array)
        np.testing.assert_array_equal(exported, np.arange(6.0))
        assert np.may_share_memory(exported, array.release())
    else:
        with pytest.raises(BufferError, match=r"other libraries cannot use: copy it with read\(\)"):
            np.from_dlpack(array)


def test_a_device_may_be_given_by_its_number():
    assert open_device(0) is open_device("0")
    assert open_devices([np.int64(0)]) == [open_device("0")]


@pytest.mark.parametrize("choice", [1.5, True, b"0", {}])
def test_what_cannot_name_a_device_is_refused_with_the_remedy(choice):
    with pytest.raises(UnknownDeviceError, match="give a number of list_devices, a part of a name"):
        open_device(choice)
