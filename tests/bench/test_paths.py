"""Whole paths: what is compared, what is judged, and what the files are."""

import json
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from mirrorskin import io
from mirrorskin.bench.harness import Measured, Timing
from mirrorskin.bench.paths import CASES, batch, budget, child, cold, files, lab, press, targets, turns, whole
from mirrorskin.bench.paths.child import Memory
from mirrorskin.bench.paths.labs import find_labs
from mirrorskin.bench.paths.reading import READ
from mirrorskin.bench.results import Row
from mirrorskin.bench.same import DisagreementError
from mirrorskin.kernels.device import open_device

SHAPE = (12, 48, 64)
FRAMES = {"file-turns": 64, "file-turns-wave": 64, "batch-small": 36}


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Have temporary files where they can be looked for."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return tmp_path


@pytest.fixture
def timed(monkeypatch):
    """Collect what was timed."""
    collected = []
    monkeypatch.setattr("mirrorskin.bench.harness._measured", lambda *given: collected.append(given))
    return collected


def row(name, seconds, size=0, kernels=0.0):
    timing, inside = (Timing(median, median, median, 3) for median in (seconds, kernels))
    return Row(name, Measured(timing, {"kernel": inside}, {}, seconds, 0.0), size)


@pytest.mark.parametrize("name", [name for name in CASES if name != "file-budget"])
def test_a_quick_case_agrees_and_leaves_nothing_behind(name, folder):
    case = CASES[name](open_device(), True)
    names = [one.name for one in case.rows]
    assert case.name == name
    assert names[:3] == ["read limit", "copy limit", "triad limit"]
    assert len(set(names)) == len(names)
    frames = FRAMES.get(name, 12)
    paths = [one for one in case.rows if one.frames and one.name != turns.CACHED]
    assert len(paths) >= 3
    assert {(one.frames, one.bytes) for one in paths} == {(frames, frames * 48 * 64)}
    assert case.targets == ()  # times mean nothing
    assert not list(folder.iterdir())


@pytest.mark.parametrize(
    ("compression", "told"),
    [("raw", "all else 45.0"), ("bitshuffle", "reading and decoding 30.0, all else 15.0")],
)
def test_parts_of_the_time_add_up(compression, told):
    parts = {press.OPEN: 0.002, press.FINGERPRINT: 0.005, press.SAVE: 0.02, READ: 0.03}
    rows = parts | {press.KERNEL: 0.1, press.IN_MEMORY: 0.11, whole.PATH: 0.2}
    known = {name: row(name, seconds, kernels=0.12) for name, seconds in rows.items()}
    assert press._tell_parts(press.PressCase("file", SHAPE, compression), known) == (
        "of the 200.0 ms from file to result: kernels 120.0, opening 2.0, fingerprint 3.0, maps 10.0, "
        f"saving 20.0, {told}"
    )


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("file-press", "file to result differs from .* in memory in the height of 1 of 3072 values"),
        ("file-turns", "file to result differs from .* in memory in the normals of 1 of 9216 values"),
        ("file-turns-wave", "file to result differs from .* in memory in the cosine of 1 of 3072 values"),
        ("file-lab", "file to result: 1 heights lie outside of the step of equation 4"),
        ("batch-small", "in a loop differs from .* in memory in the height of 1 of 3072 values"),
    ],
)
def test_a_path_that_differs_is_named_and_nothing_is_timed(monkeypatch, timed, name, said):
    right = whole.reconstruct

    def wrong(source, **options):
        result = right(source, **options)
        if options.get("subframe") is False:
            return result
        word = next(word for word in ("normals", "cosine", "height") if word in result.maps())
        values = result.maps()[word].copy()
        place = tuple(np.argwhere(np.isfinite(values))[0])
        values[place] += 1.0
        return replace(result, **{word: values})

    monkeypatch.setattr(whole, "reconstruct", wrong)
    with pytest.raises(DisagreementError, match=f"mirrorskin.*{said}") as caught:
        CASES[name](open_device(), True)
    assert "nothing was timed" in str(caught.value)
    assert not timed


def test_a_lab_whose_heights_differ_is_named(monkeypatch, timed):
    def wrong(path, dataset, dark, bright, target):
        return np.zeros(SHAPE[1:], np.float32)

    monkeypatch.setattr(lab, "find_labs", lambda: ({"Pencil": wrong}, {}))
    with pytest.raises(DisagreementError, match="Pencil, file to result differs from mirrorskin"):
        CASES["file-lab"](open_device(), True)
    assert not timed


@pytest.mark.parametrize("state", ["kept", "failed"])
def test_a_batch_that_did_not_do_all_is_not_timed(monkeypatch, timed, state):
    right = batch.run_local

    def wrong(*given):
        yield from (replace(outcome, state=state, message="it rained") for outcome in right(*given))

    monkeypatch.setattr(batch, "run_local", wrong)
    with pytest.raises(DisagreementError, match=rf"press-000.h5 {state}: it rained"):
        CASES["batch-small"](open_device(), True)
    assert not timed


def test_a_child_gives_the_same_maps_and_tells_its_memory(monkeypatch):
    seen = []
    judge = budget._judge

    def look(case, kind, memory):
        seen.append((kind, memory))
        return judge(case, kind, memory)

    monkeypatch.setattr(budget, "_judge", look)
    monkeypatch.setattr(budget, "KINDS", {"chunks long in time": budget.KINDS["chunks long in time"]})
    case = budget.run_budget(budget.BudgetCase("file-budget", (160, 48, 64)), open_device(), False)
    ((kind, memory),) = seen
    assert kind == "chunks long in time"
    assert 0 < memory.peak < 100e6
    assert case.rows == []
    (target,) = case.targets
    assert target.bound == "at most 0 MB, the budget of 0 and 10 %"
    assert not target.met  # maps alone take more than a tenth of this file


@pytest.mark.parametrize("kind", sorted(budget.KINDS))
def test_a_file_of_any_kind_holds_the_same_press(kind, folder):
    made, path = press.make_press(SHAPE), folder / "press.h5"
    budget.KINDS[kind](made, path)
    with io.open_recording(path) as recording:
        frames = np.concatenate([block.frames.copy() for block in iter(recording.read, None)])
        np.testing.assert_array_equal(recording.travel, made.block.travel)
        np.testing.assert_array_equal(recording.header.bright, made.header.bright)
        assert recording.header.pixel_size is None
        assert recording.storage.startswith({"b": "chunks (1, 48", "c": ("in one", "chunks (1, 6")}[kind[0]])
    np.testing.assert_array_equal(frames, made.block.frames)


MEMORY_THAT_COMES_AND_GOES = """
import json, time
from dataclasses import asdict
import numpy as np
from mirrorskin.bench.paths import child
kept = np.ones(30_000_000, np.uint8)
with child.watch_memory() as told:
    more = np.ones(80_000_000, np.uint8)
    time.sleep(1)  # long enough to be seen
    del more
assert kept[0] == 1
print(json.dumps(asdict(told.memory)))
"""


@pytest.mark.skipif(not child.is_told(), reason="this system does not tell")
def test_memory_is_what_came_on_top_even_if_it_is_gone():
    # As it is used, in a process of its own: in this one, what other tests left may go at the same time.
    command = [sys.executable, "-P", "-c", MEMORY_THAT_COMES_AND_GOES]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=300)
    told = json.loads(done.stdout)
    assert told["peak"] == pytest.approx(80e6, rel=0.1)
    assert told["anonymous"] == pytest.approx(80e6, rel=0.1)


def test_memory_is_judged_by_all_that_is_resident():
    case = budget.BudgetCase("file-budget", (1000, 1000, 2000))
    within, beyond = (
        budget._judge(case, "mapped", Memory(peak, 10**6)) for peak in (219_000_000, 221_000_000)
    )
    assert (within.met, beyond.met) == (True, False)
    assert within.bound == "at most 220 MB, the budget of 200 and 10 %"
    assert within.measured == "219 MB, 1 of these its own"


def test_targets_are_ratios_of_medians():
    ours, theirs = row("ours", 0.2), row("theirs", 0.1)
    missed = targets.at_most("path", 1.25, ours, theirs, "reading")
    assert (missed.met, missed.bound) == (False, "at most 1.25 times reading")
    assert missed.measured == "2.00 times (200 against 100 ms)"
    assert targets.at_most("path", 2.0, ours, theirs, "reading").met
    met = targets.as_fast_as("path", 2, theirs, ours)
    assert (met.met, met.bound) == (True, "at least 2 times as fast as ours")
    assert not targets.as_fast_as("path", 2.1, theirs, ours).met


@pytest.mark.parametrize(
    ("cached", "met", "told"),
    [(None, False, "30 % of read"), (20.0, False, "30 % of read"), (4.0, True, "75 % of arithmetic")],
)
def test_a_rotation_is_judged_by_the_limit_that_binds(cached, met, told):
    rows = {"read limit": row("read limit", 1, 10**10), whole.PATH: row(whole.PATH, 1, 3 * 10**9)}
    if cached is not None:
        rows[turns.CACHED] = row(turns.CACHED, 1, int(cached * 1e9))
    target = turns._judge(rows)
    assert (target.met, target.measured.split(" (")[0]) == (met, told)


@pytest.mark.parametrize(("spent", "met"), [(11.9, True), (12.1, False)])
def test_a_batch_is_judged_by_what_it_takes_beyond_compute_and_reading_and_writing(spent, met):
    assert batch._judge(spent, 7.0).met is met


def test_the_press_is_one_of_a_ball_where_pixels_have_a_size(folder):
    made = press.make_press((100, 60, 80))
    path = folder / "press.h5"
    files.record(made, path)
    size = press.pixel_size(made.shape)
    result = whole.to_result(path, None, open_device(), {"pixel_size": size}, fill=False)
    radius = np.hypot(result.x, result.y[:, np.newaxis])
    ball = np.sqrt(np.maximum(2 * 7.0**2 - radius**2, 0)) - 7.0 * np.sqrt(2)
    step = made.block.travel[1]
    found = np.isfinite(result.height)
    assert found.mean() > 0.4
    assert np.abs(result.height - ball)[found].max() < 6 * step


def test_turns_begin_again_after_some():
    frames = turns.make_turns((1040, 6, 8)).block.frames
    np.testing.assert_array_equal(frames[512:1024], frames[:512])
    np.testing.assert_array_equal(frames[1024:], frames[:16])
    assert (frames[8:16] != frames[:8]).any()


def test_frames_in_memory_lie_where_a_device_can_work():
    frames = files.in_memory((3, 5, 7), np.dtype(np.uint16))
    assert frames.ctypes.data % 4096 == 0
    assert frames.base is not None
    source = files.Frames(frames, io.Header("vertical"), np.arange(3.0))
    blocks = list(iter(lambda: source.read(np.empty((2, 5, 7), np.uint16)), None))
    assert [(block.index, len(block.frames), block.lent) for block in blocks] == [(0, 2, True), (2, 1, True)]
    np.testing.assert_array_equal(blocks[1].travel, [2.0])


def test_a_file_is_dropped_from_the_page_cache_and_read_again(folder):
    path = folder / "file"
    path.write_bytes(bytes(3 * files._FAR // 2))
    files.settle(path)
    if not files.can_drop(path):
        pytest.skip("this file system cannot")
    with path.open("rb") as file:
        files.read_plainly(path, bytearray(2**20))
        assert files._is_cached(file.fileno(), files._FAR)
        files.drop(path)


def test_a_path_is_not_timed_cold_where_files_cannot_be_dropped(monkeypatch, folder):
    monkeypatch.setattr(cold, "can_drop", lambda path: False)
    rows, absent = cold.measure_cold(folder / "file", lambda: None, open_device(), 1, 2, 3)
    assert rows == []
    assert absent == {cold.COLD: "pages of this file cannot be dropped from the cache"}


def test_a_case_without_room_for_its_files_is_refused(monkeypatch):
    monkeypatch.setattr(files.shutil, "disk_usage", lambda path: SimpleNamespace(free=1000))
    with pytest.raises(io.InputError, match=r"case file-press needs .* choose another folder with --folder"):
        CASES["file-press"](open_device(), True)


def plainly(frames, travel, dark, bright):
    """Return equation 4 with hold 2, pixel by pixel."""
    height = np.full(frames.shape[1:], np.nan)
    for place in np.ndindex(*frames.shape[1:]):
        half = dark[place] + 0.5 * (bright[place] - dark[place])
        light = [sample >= half for sample in frames[(slice(None), *place)].astype(float)]
        runs = [t for t in range(len(light)) if light[t] and (t + 1 == len(light) or light[t + 1])]
        if runs and runs[0] > 0:
            height[place] = -travel[runs[0]]
    return height


@pytest.mark.parametrize("name", ["h5py and NumPy argmax", "h5py and Numba", "h5py and Numba in tiles"])
def test_a_lab_finds_what_equation_4_says(name, folder):
    known, absent = find_labs()
    if name in absent:
        pytest.skip(absent[name])
    generator = np.random.default_rng(3)
    frames = files.in_memory((9, 6, 11), np.dtype(np.uint8))
    frames[:] = generator.integers(0, 256, frames.shape) * (generator.random(frames.shape) < 0.7)
    dark = generator.integers(0, 160, (6, 11)).astype(np.float32) / 8
    bright = dark + generator.integers(800, 1500, (6, 11)).astype(np.float32) / 8
    bright[2, 3] = np.nan
    made = files.Frames(frames, io.Header("vertical", dark=dark, bright=bright), np.arange(9) * 0.1)
    files.record(made, folder / "press.h5")
    found = known[name](folder / "press.h5", io.layout.STACK, dark, bright, folder / "height.npy")
    expected = plainly(frames, made.block.travel, dark, bright)
    assert 0.2 < np.isfinite(expected).mean() < 0.95
    np.testing.assert_array_equal(found, expected.astype(np.float32))
    np.testing.assert_array_equal(np.load(folder / "height.npy"), found)
