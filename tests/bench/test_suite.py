"""The cases: all agree on every device, and nothing is timed where they do not."""

import json

import numpy as np
import pytest

from mirrorskin.bench import (
    NAMES,
    accuracy,
    as_data,
    as_markdown,
    as_notes,
    as_rows,
    choose,
    memory,
    onset,
    paths,
    run_suite,
    scaling,
    sweep,
    twin,
)
from mirrorskin.bench.peers.onset import Peer, numpy_
from mirrorskin.bench.same import DisagreementError
from mirrorskin.bench.summary import is_accuracy
from mirrorskin.io import InputError
from mirrorskin.kernels.device import open_device
from mirrorskin.kernels.errors import DeviceError

TWIN = ["mirrorskin, vertical", "mirrorskin, rotation", "NumPy, vertical"]


FRAME = 48 * 64  # pixels of a quick run
# What has tests of its own.
ELSEWHERE = ("integrate", "file-", "batch-", "sweep-", "accuracy-", "scaling-", "cold-start")
ELSEWHERE = (*ELSEWHERE, "live-vertical", "live-axial")


def moved(name, row):
    """Return the bytes that a row of a quick run should count."""
    size = {"uint16": 2, "float32": 4}.get(name.split("-")[-1], 1)
    limit = "limit" in row
    if name.startswith("normals"):
        return 0 if "multiply" in row else FRAME * (8 * size + 21)
    if name == "sliding":
        return FRAME * 34 * (1 if limit else 16)
    if name.startswith("correlate"):
        return FRAME * (16 if "push only" in row else 32)
    if "elastic" in row:
        return 64 * 64
    return FRAME * size * (1 if limit and name.startswith("live") else 12)


@pytest.mark.parametrize("name", [name for name in NAMES if not name.startswith(ELSEWHERE)])
def test_a_case_agrees_on_every_device(device, name):
    (case,) = run_suite(device, [name], quick=True)
    names = [row.name for row in case.rows]
    rotation = name.startswith(("normals", "correlate", "sliding"))
    limits = ["read limit", "copy limit", "triad limit"]
    assert names[:3] == (["triad limit", "read limit", "copy limit"] if rotation else limits)
    assert case.name == name
    assert case.share(case.rows[0]) == case.kernel_share(case.rows[0]) == 1
    if name == "twin":
        assert names[3:] == [*TWIN, "mirrorskin, elastic 64 x 64"]
    elif rotation:
        assert {"mirrorskin", "NumPy"} <= set(names)
    elif not name.startswith("live"):
        assert {"mirrorskin", "mirrorskin, push only", "NumPy", "OpenCV"} <= set(names)
    for row in case.rows:
        limit, elastic = "limit" in row.name, "elastic" in row.name
        assert row.bytes == pytest.approx(moved(name, row.name), rel=0.02)
        frames = 8 if name.startswith("normals") else 16 if rotation else 12
        assert row.frames == (0 if limit else 1 if elastic else frames)
        on_device = limit or ("mirrorskin" in row.name and not elastic)
        assert ("kernel" in row.measured.device) == on_device


@pytest.mark.parametrize(
    ("name", "word", "spoil"),
    [
        ("equation4-uint8", "frame", {"first_light": lambda frames, light, hold: 7}),
        ("full-uint8", "status", {"status": 9}),
        ("full-uint8", "height", {"height": np.float32(1e-6)}),
        ("full-uint8", "sigma", {"sigma": np.float32(np.nan)}),
    ],
)
def test_a_peer_that_differs_is_named_and_nothing_is_timed(device, monkeypatch, name, word, spoil):
    def first_light(frames, light, hold):
        found = numpy_.first_light(frames, light, hold)
        found[3, 5] += 1
        return found

    def heights(*given):
        maps = numpy_.heights(*given)
        row, column = np.argwhere(maps.status == 1)[0]
        getattr(maps, word)[row, column] += spoil[word]
        return maps

    timed = []
    monkeypatch.setattr(onset, "find_peers", lambda: ([Peer("Odd one", first_light, heights)], {}))
    monkeypatch.setattr("mirrorskin.bench.harness._measured", lambda *given: timed.append(given))
    with pytest.raises(
        DisagreementError, match=f"Odd one differs from mirrorskin in the {word} of 1 of 3072 pixels"
    ):
        run_suite(device, [name], quick=True)
    assert not timed


@pytest.mark.parametrize(
    ("ours", "spoil", "said"),
    [
        (True, lambda frames, clean: frames + np.uint8(1), r"mean of 0\.\d+ "),
        (
            True,
            lambda frames, clean: np.where(np.arange(12) == 7, frames.T - np.uint8(1), frames.T).T,
            "frame 7 ",
        ),
        (True, lambda frames, clean: np.rint(clean).astype(np.uint8), r"spread of 0\.[0-3]"),
        (
            False,
            lambda frames, clean: (clean + 1.2 * (frames - clean)).astype(np.uint8),
            r"spread of 1\.[12]",
        ),
        (False, lambda frames, clean: np.rint(clean[::-1]).astype(np.uint8), "noise"),
    ],
    ids=["brighter", "one frame darker", "no noise", "more noise", "another press"],
)
def test_a_twin_whose_noise_is_not_the_camera_s_is_named_and_nothing_is_timed(monkeypatch, ours, spoil, said):
    kept, timed = {}, []
    clean, render = twin._clean, twin._render if ours else twin._render_numpy

    def keep(*given):
        kept["clean"] = clean(*given)
        return kept["clean"]

    def wrong(given, out):
        out[...] = spoil(render(given, out), kept["clean"])
        return out

    monkeypatch.setattr(twin, "_clean", keep)
    monkeypatch.setattr(twin, "_render" if ours else "_render_numpy", wrong)
    monkeypatch.setattr("mirrorskin.bench.harness._measured", lambda *given: timed.append(given))
    name = "mirrorskin, vertical" if ours else "NumPy, vertical"
    with pytest.raises(DisagreementError, match=f"^{name}: .*{said}") as caught:
        run_suite(open_device(), ["twin"], quick=True)
    assert "\n" not in str(caught.value)
    assert not timed


def test_a_peer_that_takes_too_much_memory_is_named(device, monkeypatch):
    monkeypatch.setattr(onset, "_LARGE", 1)
    (case,) = run_suite(device, ["equation4-uint8"], quick=True)
    assert case.absent["NumPy argmax"] == "takes as much memory again"
    assert "NumPy argmax" not in {row.name for row in case.rows}


def test_a_case_without_enough_memory_is_refused(device, monkeypatch):
    monkeypatch.setattr(memory, "free_memory", lambda: 5000)
    with pytest.raises(InputError, match=r"case full-memory needs 0.0 GB .* close other programs"):
        run_suite(device, ["full-memory"], quick=True)


def test_free_memory_is_told_in_bytes_or_not_at_all(monkeypatch, tmp_path):
    told = memory.free_memory()
    assert told is None or 10**7 < told < 10**14
    monkeypatch.setattr(memory, "_MEMINFO", tmp_path / "no such file")
    assert memory.free_memory() is None
    memory.check_memory("any", 10**18)


def test_a_device_without_room_for_the_stack_is_refused(small_device):
    small_device.max_allocation = 12 * 48 * 64 - 1
    with pytest.raises(DeviceError, match="has no room for 12 frames at once"):
        run_suite(small_device, ["equation4-uint8"], quick=True)


def test_an_unknown_case_is_refused_and_the_nearest_are_named():
    with pytest.raises(InputError, match="case 'liver': no such case; the nearest are live, "):
        run_suite(open_device(), ["live", "liver"])


def test_cases_are_chosen_in_their_order_each_once():
    assert choose(["live-r*", "full-uint?", "full-*", "live"]) == (
        *(name for name in NAMES if name.startswith("full-")),
        "live",
        "live-random",
    )
    assert choose([]) == ()
    assert choose("*") == NAMES


def test_no_case_hides_another_of_its_name():
    parts = [one.CASES for one in (accuracy, paths, scaling, sweep)]
    merged = [name for part in parts for name in part]
    assert len(set(merged)) == len(merged)
    assert set(merged) < set(NAMES)
    assert all(name.startswith(ELSEWHERE) for name in merged)
    assert {name for name in NAMES if is_accuracy({"name": name})} == set(accuracy.CASES)


def test_each_case_is_handed_over_when_it_is_done(device):
    done = []
    found = run_suite(device, ["live", "hold2-uint8"], quick=True, done=done.append)
    assert [case.name for case in done] == ["hold2-uint8", "live"]
    assert done == found


def test_a_run_becomes_json_and_a_page(device):
    data = as_data(
        device, run_suite(device, ["equation4-uint8", "live", "normals-uint8"], quick=True), quick=True
    )
    assert json.loads(json.dumps(data, allow_nan=False)) == data
    assert data["versions"]["numpy"] == np.__version__
    assert data["commit"] is None or len(data["commit"].removesuffix("-dirty")) == 40
    page = as_markdown(data)
    assert page.startswith(f"# {device.info.title} (driver {device.info.driver})")
    assert any("binds" in note for note in as_notes(data["cases"][-1]))
    for case in data["cases"]:
        assert f"## {case['name']}: {case['title']}\n\n| work | ms |" in page
        assert all(note in page for note in as_notes(case))
        for cells in as_rows(case):
            assert f"| {' | '.join(cells)} |" in page
            assert len(cells) == 9
