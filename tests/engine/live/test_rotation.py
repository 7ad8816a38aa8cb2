"""A rotation in progress: normals of its last turn, heights that follow, and edges at intervals."""

import math
import threading
from types import SimpleNamespace

import numpy as np
import pytest
from live_frames import PIXEL, paced, phases, press_header, turn_frames, turn_header

from mirrorskin.engine import Correlate, Rotation, Run, estimate_normals, find_edges, integrate
from mirrorskin.engine.integration.normals_to_height import find_slopes
from mirrorskin.engine.integration.warm_start import WarmStartIntegrator
from mirrorskin.engine.live import LiveRun, Loop
from mirrorskin.engine.rotation.last_turn import IdleEdges, choose_window
from mirrorskin.evaluation.scenes import rotations
from mirrorskin.evaluation.scenes.inputs import SCALES, TILT
from mirrorskin.io import Header, InputError, open_result, save_result
from mirrorskin.twin.emulator.simulated_clock import SimulatedClock

SHAPE, WINDOW = (24, 40, 52), 8
PHASE = phases(SHAPE[0])
OFFSET, GAIN, NOISE = SCALES["uint8"]
LAST = slice(-WINDOW, None)
KNOWN = {"tilt": TILT, "zenith_gain": GAIN, "zenith_offset": OFFSET, "noise": NOISE, "blur": 0.0}
OFFLINE = {**KNOWN, "header": Header("axial", **rotations.EXACT)}


def make(device=None, frames=None, header=None, **options):
    frames = turn_frames(SHAPE) if frames is None else frames
    source = paced(frames, header or turn_header(), PHASE)
    options = {"window_frames": WINDOW, "noise": NOISE, "blur": 0.0, **options}
    return frames, LiveRun(source, Rotation(device=device, **options))


def feed(live, frames, cuts):
    updates = []
    for part in np.split(np.arange(SHAPE[0]), np.cumsum(cuts)[:-1]):
        live.push(frames[part], phase=PHASE[part])
        updates.append(live.maps())
        live.idle_work(0.0)
    return updates


def edges_of(result, device=None):
    return find_edges(result.normals, result.normals_sigma, result.contact, device=device)


def best_heights(normals):
    slopes = find_slopes(normals.normals, normals.normals_sigma, normals.contact, normals.process["tilt"])
    weights = slopes.weights
    return integrate(slopes.dz_dx, slopes.dz_dy, PIXEL, mask=slopes.defined, slope_weights=weights).height


def test_an_update_is_of_the_last_turn(device):
    frames, live = make(device)
    live.precompile()
    updates = feed(live, frames, [1] * SHAPE[0])
    assert not any(updates[: WINDOW - 1])
    last = updates[-1]
    exact = estimate_normals(frames[LAST], PHASE[LAST], **OFFLINE, device=device)
    np.testing.assert_array_equal(last["normals"], exact.normals)
    np.testing.assert_array_equal(last["contact"], exact.contact)
    assert last["contact_area"] == pytest.approx(np.count_nonzero(exact.contact) * PIXEL**2)
    assert last["offset_unknown"]


def test_heights_follow_those_that_fit_best(device):
    frames, live = make(device)
    updates = feed(live, frames, [1] * SHAPE[0])
    for update, stop in [(updates[WINDOW - 1], WINDOW), (updates[-1], SHAPE[0])]:
        turn = slice(stop - WINDOW, stop)
        normals = estimate_normals(frames[turn], PHASE[turn], **OFFLINE)
        best = best_heights(normals)
        np.testing.assert_array_equal(np.isnan(update["height"]), np.isnan(best))
        off = (update["height"] - best)[np.isfinite(best)]
        assert np.sqrt(np.mean(off**2)) < 0.01 * np.ptp(best[np.isfinite(best)])


def test_heights_follow_a_contact_that_moves_to_another_part_of_the_picture():
    count, (rows, columns) = 5 * WINDOW, (150, 203)
    phase, small = phases(count), turn_frames((count, 40, 52))
    frames = np.full((count, rows, columns), round(OFFSET), np.uint8)  # without contact
    for turns, top, left in [(slice(3 * WINDOW), 70, 10), (slice(3 * WINDOW, None), 5, 140)]:
        frames[turns, top : top + 40, left : left + 52] = small[turns]
    live = LiveRun(paced(frames, turn_header(), phase), Rotation(window_frames=WINDOW, noise=NOISE, blur=0.0))
    for number in range(count):
        live.push(frames[[number]], phase=phase[[number]])
        update = live.maps()
        if number + 1 in (3 * WINDOW, count):  # a smaller part is in use for long; contact left it
            last = slice(number + 1 - WINDOW, number + 1)
            best = best_heights(estimate_normals(frames[last], phase[last], **OFFLINE))
            np.testing.assert_array_equal(np.isnan(update["height"]), np.isnan(best))
            inside = np.isfinite(best)
            off = (update["height"] - best)[inside]
            assert np.sqrt(np.mean(off**2)) < 0.01 * np.ptp(best[inside])


def test_heights_that_take_long_hold_up_no_normals(monkeypatch):
    frames, live = make()
    live.push(frames[:WINDOW], phase=PHASE[:WINDOW])
    before = live.maps()["height"]
    go_on, find = threading.Event(), WarmStartIntegrator.result
    monkeypatch.setattr(WarmStartIntegrator, "result", lambda self: (go_on.wait(), find(self))[1])
    for number in range(WINDOW, SHAPE[0]):
        live.push(frames[[number]], phase=PHASE[[number]])
        update = live.maps(0.0)
        assert update["height"] is before
    assert update["height_lag"] == SHAPE[0] - WINDOW
    np.testing.assert_array_equal(
        update["normals"], estimate_normals(frames[LAST], PHASE[LAST], **OFFLINE).normals
    )
    go_on.set()
    live.maps()
    assert live.maps()["height_lag"] == 0


@pytest.mark.parametrize("dtype", ["uint8", "float32"])
def test_a_replay_in_other_cuts_is_the_same_bit_by_bit(dtype):
    results = []
    for cuts in ([1] * SHAPE[0], [13, 2, 9], [SHAPE[0]]):
        frames = turn_frames(SHAPE, dtype)
        _, live = make(frames=frames, header=turn_header(dtype), noise=None)
        feed(live, frames, cuts)
        results.append(live.result())
    first = results[0]
    for other in results[1:]:
        for name in ("normals", "normals_sigma", "contact", "mean", "cosine", "sine", "residual", "edges"):
            np.testing.assert_array_equal(getattr(first, name), getattr(other, name), err_msg=name)
        span = np.nanmax(first.height) - np.nanmin(first.height)
        np.testing.assert_allclose(first.height, other.height, atol=1e-3 * span)


def test_the_result_is_whole_and_stores_its_provenance(tmp_path):
    frames, live = make()
    feed(live, frames, [SHAPE[0]])
    save_result(live.result(), tmp_path / "live.h5")
    result = open_result(tmp_path / "live.h5")
    correlate = Run(Correlate(window_frames=WINDOW))
    correlate.push(frames, phase=PHASE)
    np.testing.assert_array_equal(result.cosine, correlate.result().cosine)
    exact = estimate_normals(frames[LAST], PHASE[LAST], **OFFLINE)
    np.testing.assert_array_equal(result.edges, edges_of(exact))
    normals = estimate_normals(frames[LAST], PHASE[LAST], **KNOWN)
    np.testing.assert_array_equal(result.normals, normals.normals)
    np.testing.assert_allclose(result.height, integrate(normals, pixel_size=PIXEL).height, atol=1e-6)
    assert (result.process["window_frames"], result.process["live"]) == (WINDOW, True)
    assert result.process["tilt"] == pytest.approx(TILT)


def test_edges_take_at_most_a_tenth_of_the_time(monkeypatch):
    seconds, spent, draw = 0.0, 0.0, IdleEdges._part

    def draw_slowly(self, window):
        nonlocal seconds, spent
        draw(self, window)
        seconds, spent = seconds + 0.02, spent + 0.02

    clock = SimpleNamespace(perf_counter=lambda: seconds)
    monkeypatch.setattr("mirrorskin.engine.rotation.last_turn.time", clock)
    monkeypatch.setattr(IdleEdges, "_part", draw_slowly)
    frames, live = make()
    feed(live, frames, [SHAPE[0]])
    while seconds < 100:
        live.idle_work(0.01)
        seconds += 0.05
    assert 0.05 < spent / seconds < 0.11


def test_edges_are_drawn_in_the_time_that_is_left(device):
    frames, live = make(device)
    feed(live, frames, [SHAPE[0]])
    assert "edges" not in live.maps()
    for _ in range(400):
        live.idle_work(0.05)
        if "edges" in live.maps():
            break
    normals = estimate_normals(frames[LAST], PHASE[LAST], **OFFLINE, device=device)
    exact = edges_of(normals, device)
    np.testing.assert_array_equal(live.maps()["edges"], exact)
    assert exact.any()


def test_a_sudden_change_is_followed_within_some_frames():
    frames = turn_frames(SHAPE)
    frames[: SHAPE[0] // 2] = frames[: SHAPE[0] // 2, :, ::-1]
    _, live = make(frames=frames)
    update = feed(live, frames, [1] * SHAPE[0])[-1]
    normals = estimate_normals(frames[LAST], PHASE[LAST], **OFFLINE)
    best = best_heights(normals)
    off = (update["height"] - best)[np.isfinite(best)]
    assert np.sqrt(np.mean(off**2)) < 0.02 * np.ptp(best[np.isfinite(best)])


def test_without_contact_there_are_no_heights_and_they_come_with_it():
    frames = turn_frames(SHAPE)
    frames[: WINDOW + 2] = round(OFFSET)
    _, live = make(frames=frames)
    updates = feed(live, frames, [1] * SHAPE[0])
    assert np.isnan(updates[WINDOW]["height"]).all()
    assert updates[WINDOW]["contact_area"] == 0
    assert np.isfinite(updates[-1]["height"]).mean() > 0.3


def test_contact_that_is_lost_is_found_again_with_its_heights():
    frames = np.concatenate([turn_frames(SHAPE)] * 3)
    frames[SHAPE[0] : 2 * SHAPE[0]] = round(OFFSET)
    places = phases(len(frames))
    live = LiveRun(
        paced(frames, turn_header(), places), Rotation(window_frames=WINDOW, noise=NOISE, blur=0.0)
    )
    areas, heights = [], []
    for number in range(len(frames)):
        live.push(frames[[number]], phase=places[[number]])
        update = live.maps()
        areas.append(update.get("contact_area"))
        heights.append(update.get("height"))
    found, lost, again = (turn * SHAPE[0] - 1 for turn in (1, 2, 3))
    assert areas[lost] == 0
    assert areas[again] == pytest.approx(areas[found], rel=0.02)
    off = heights[again] - heights[found]
    assert np.nanstd(off) < 0.02 * np.ptp(heights[found][np.isfinite(heights[found])])


def test_without_a_gain_there_is_the_wave_alone():
    frames, live = make(header=turn_header(zenith_gain=None))
    update = feed(live, frames, [SHAPE[0]])[-1]
    assert set(update) == {"mean", "cosine", "sine", "modulation", "azimuth", "residual"}
    result = live.result()
    assert result.normals is None
    assert np.isfinite(result.azimuth).mean() > 0.9
    assert str(result.process["zenith"]).startswith("none")


def test_without_a_pixel_size_there_are_no_heights():
    frames, live = make(header=turn_header(pixel_size=None))
    update = feed(live, frames, [SHAPE[0]])[-1]
    assert "height" not in update
    assert "contact_area" not in update
    assert live.result().height is None


def test_a_whole_run_uses_each_frame():
    frames = turn_frames(SHAPE)
    source = paced(frames, turn_header(), PHASE, 100.0, SimulatedClock())
    live = LiveRun(source, Rotation(window_frames=WINDOW, noise=NOISE))
    status = Loop(source, live).run()
    assert (status.used, status.updates) == (SHAPE[0], SHAPE[0])
    exact = estimate_normals(frames[LAST], PHASE[LAST], **OFFLINE)
    np.testing.assert_array_equal(live.result().normals, exact.normals)


def test_a_window_is_a_turn_of_at_most_64_frames():
    for turn, window, every in ((8, 8, 1), (64, 64, 1), (65, 32, 2), (400.3, 57, 7), (3.2, 3, 1)):
        assert choose_window(turn) == (window, every)
        assert abs(window * every - turn) <= every
    for turn, frame_count, every in ((40, 24, 1), (40, 20, 2), (40, 8, 5), (39.6, 40, 1), (400, 64, 6)):
        assert choose_window(turn, frame_count) == (frame_count, every)
    for turn in (2.0, math.nan, math.inf):
        with pytest.raises(InputError, match="frames a turn"):
            choose_window(turn)
    with pytest.raises(InputError, match="window_frames 41: a turn has only 40 frames"):
        choose_window(40.2, 41)


def test_a_press_and_a_step_of_none_are_refused():
    with pytest.raises(InputError, match="axial"):
        LiveRun(paced(turn_frames(SHAPE), press_header(), PHASE), Rotation(window_frames=8))
    source = paced(turn_frames(SHAPE), turn_header(), PHASE)
    with pytest.raises(InputError, match="every 0"):
        LiveRun(source, Rotation(window_frames=8), every=0)
