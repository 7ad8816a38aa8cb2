import math
from dataclasses import replace

import numpy as np
import pytest

from mirrorskin.hw.base.stage import Position, Report
from mirrorskin.hw.rig.plans import AxialPlan, VerticalPlan
from mirrorskin.hw.rig.track import LiveTrack, Progress, Track, even_times
from mirrorskin.hw.stages.trajectory import Trapezoid

LENGTH, SPEED = 2.0, 1.0
TRUE = Trapezoid(LENGTH, 0.97, 8.0)  # a stage that is slower than planned
PLAN = Trapezoid.planned(LENGTH, SPEED)
BEGAN = 100.3


def reports(seed, jitter=0.004, lag=0.07):
    """Reports at 20 Hz, rounded as GRBL does, of which each tells a time that is wrong by some ms."""
    random = np.random.default_rng(seed)
    time = np.arange(BEGAN - 0.2, BEGAN + 2.6, 0.05) + random.uniform(0, 0.05)
    places = np.round(TRUE.place(time - BEGAN - lag), 3)
    return time + jitter * random.standard_normal(len(time)), places


@pytest.mark.parametrize("seed", range(4))
def test_a_track_is_more_accurate_than_single_reports(seed):
    time, places = reports(seed)
    track = Track(time, places, PLAN)
    frames = np.linspace(BEGAN - 0.5, BEGAN + 3, 500)
    error = track.at(frames) - TRUE.place(frames - BEGAN - 0.07)
    assert np.sqrt(np.mean(error**2)) < 0.002  # mm; a report errs by 4
    assert abs(error).max() < 0.008
    assert 0.001 < track.spread < 0.01


def test_exact_reports_give_the_exact_way():
    time = np.arange(BEGAN - 0.2, BEGAN + 2.6, 0.05)
    track = Track(time, TRUE.place(time - BEGAN), PLAN)
    assert track.began == pytest.approx(BEGAN, abs=1e-5)
    assert track.path.speed == pytest.approx(0.97, rel=1e-5)
    assert track.path.acceleration == pytest.approx(8.0, rel=1e-2)


def test_a_stage_that_pauses_is_followed():
    time = np.arange(0.0, 5.0, 0.05)
    places = np.interp(time, [1, 2, 3, 4], [0, 1, 1, 2])
    frames = np.linspace(0, 5, 300)
    error = Track(time, places, PLAN).at(frames) - np.interp(frames, [1, 2, 3, 4], [0, 1, 1, 2])
    assert abs(error).max() < 0.1
    assert np.sqrt(np.mean(error**2)) < 0.04


def test_a_move_too_short_for_any_report_is_assumed_at_its_command():
    track = Track([BEGAN, BEGAN + 5], [0.0, LENGTH], PLAN)
    assert track.began == BEGAN
    np.testing.assert_array_equal(track.at([BEGAN - 1, BEGAN + 5]), [0, LENGTH])


def live(time, method, frames, began=BEGAN):
    """Tell the live ways at some times, each with the reports that were there 20 ms later."""
    track = LiveTrack(PLAN, began)
    next_report, actual = 0, []
    for frame in frames:
        while next_report < len(time) and time[next_report] < frame + 0.02:
            track.add(time[next_report], method[next_report])
            next_report += 1
        actual.append(float(track.at([frame])[0]))
    return np.array(actual)


@pytest.mark.parametrize("seed", range(4))
def test_the_live_distance_is_accurate_and_never_decreases(seed):
    time, places = reports(seed)
    frames = np.linspace(BEGAN, BEGAN + 3, 600)
    actual = live(time, places, frames)
    error = actual - TRUE.place(frames - BEGAN - 0.07)
    assert np.all(np.diff(actual) >= 0)
    assert actual[0] == 0
    assert actual[-1] == LENGTH
    assert abs(error).max() < 0.12  # before the first report of the move nothing tells that it began late
    assert np.sqrt(np.mean(error[frames > BEGAN + 0.5] ** 2)) < 0.006


def test_the_live_distance_increases_between_reports():
    track = LiveTrack(PLAN, BEGAN)
    for time in np.arange(BEGAN + 0.3, BEGAN + 1.0, 0.1):
        track.add(time, float(PLAN.place(time - BEGAN)))
    assert track.at([BEGAN + 1.2])[0] == pytest.approx(float(PLAN.place(1.2)), abs=1e-9)


def test_the_progress_of_a_press_is_its_travel_from_the_start():
    progress = Progress(VerticalPlan(0.5, 1.5, speed=1))
    ways = [progress(Report(k, Position(travel), "run")) for k, travel in enumerate([0.4, 0.5, 0.9, 1.6])]
    assert ways == pytest.approx([0, 0, 0.4, 1])


def test_the_progress_of_a_rotation_counts_whole_turns():
    plan = AxialPlan(1.0, 0.05, turns=3, rate=2.0)
    progress = Progress(plan)
    time = np.arange(0, plan.path.duration + 0.3, 0.1)
    places = plan.path.place(time - 0.15)  # begins late
    actual = [progress(Report(t, plan.place(w), "run")) for t, w in zip(time, places, strict=True)]
    np.testing.assert_allclose(actual, places, atol=1e-9)


@pytest.mark.parametrize("acceleration", [2.0, 500.0])
def test_the_progress_of_strokes_counts_them_and_their_track_is_found(acceleration):
    plan = VerticalPlan(0.2, 0.7, speed=0.6, strokes=6)
    true = replace(plan.path, speed=0.57, acceleration=acceleration)
    progress = Progress(plan)
    time = np.arange(0, true.duration + 0.4, 0.04) + 0.004 * np.random.default_rng(3).uniform(-1, 1)
    places = true.place(time - 0.15)
    actual = [progress(Report(t, plan.place(w), "run")) for t, w in zip(time, places, strict=True)]
    assert abs(actual - places).max() < 0.57 * 0.04, "a turn between two reports may be told late"
    frames = np.arange(0, true.duration + 0.2, 0.01)
    travel = plan.recorded(Track(time, actual, plan.path).at(frames))
    error = travel - plan.recorded(true.place(frames - 0.15))
    assert np.sqrt(np.mean(error**2)) < 0.004


@pytest.mark.parametrize("window", [5, 25])
def test_times_become_even_and_keep_what_was_lost(window):
    random = np.random.default_rng(1)
    number = np.delete(np.arange(400), slice(100, 117))
    true = 5.0 + number / 60 * (1 + 1e-4)
    actual = even_times(number, np.maximum.accumulate(true + 0.004 * random.standard_normal(383)), window)
    assert np.all(np.diff(actual) > 0)
    error = actual - true
    assert error.std() < 0.004 / math.sqrt(window)


@pytest.mark.parametrize("jitter", [0.0005, 0.004])
def test_frames_that_were_lost_unnoticed_are_noticed(jitter):
    random = np.random.default_rng(2)
    shown = np.delete(np.arange(300), [80, 150, 151, 220])
    arrival = np.maximum.accumulate(shown / 30 + jitter * random.standard_normal(len(shown)))
    error = even_times(np.arange(len(shown)), arrival) - shown / 30
    assert abs(error).max() < 0.6 * jitter


def test_jitter_is_seldom_taken_for_lost_frames():
    random, number = np.random.default_rng(0), np.arange(400)
    off = []
    for _ in range(100):
        arrival = np.maximum.accumulate(number / 100 + 0.0025 * random.standard_normal(400))
        off.append(abs(even_times(number, arrival, 400) - number / 100).max())
    assert np.count_nonzero(np.array(off) > 0.002) < 10, "a frame that counts as lost makes 5 ms"
