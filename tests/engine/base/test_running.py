"""A run: its state, what it refuses, and what its results share with it."""

from __future__ import annotations

import numpy as np
import pytest

from mirrorskin import engine, io

TRAVEL = 0.1 * np.arange(12)
EDGES = np.random.default_rng(0).uniform(0.2, 0.9, (6, 7))
FRAMES = np.where(TRAVEL[:, None, None] > EDGES, 255, 0).astype(np.uint8)
ONSET = engine.Onset(dark=0, bright=255, noise=1.0)
PHASE = np.pi / 4 * np.arange(16)
TURNS = (100 + 15 * np.cos(PHASE)[:, None, None] + EDGES).astype(np.float32)


class Total(engine.Operation):
    total = io.Map("sum of all samples", "counts")

    def start(self, shape, dtype):
        self.sum = np.zeros(shape)

    def push(self, frames):
        self.sum += frames.sum(axis=0)

    def result(self):
        return io.Result(total=self.sum, declarations=self.maps)

    def preview(self, seconds):
        return {"total": self.sum}


def pushed(operation, frames=FRAMES, **positions):
    run = engine.Run(operation)
    run.push(frames, **positions)
    return run


@pytest.mark.parametrize(
    ("frames", "operation", "positions"),
    [
        (TURNS, engine.Normals(tilt=0.05, zenith_gain=300, noise=1.0), {"phase": PHASE}),
        (TURNS, engine.Correlate(), {"phase": PHASE}),
        (FRAMES, ONSET, {"travel": TRAVEL}),
    ],
)
def test_an_iterator_may_reuse_the_memory_of_its_frames(frames, operation, positions):
    memory = np.empty_like(frames[0])

    def reused():
        for frame in frames:
            memory[:] = frame
            yield memory

    expected, actual = (engine.run(each, operation, **positions) for each in (frames, reused()))
    for name in expected:
        np.testing.assert_array_equal(actual[name], expected[name], err_msg=name)


@pytest.mark.parametrize("take", [lambda run: run.result(), lambda run: run.preview(1.0)])
def test_maps_do_not_change_with_later_frames_nor_change_the_run(take):
    run = pushed(Total(), np.ones((2, 3, 4)))
    maps = take(run)
    run.push(np.ones((2, 3, 4)))
    assert (maps["total"] == 2).all()
    maps["total"][:] = 7
    assert (run.result()["total"] == 4).all()


def test_heights_of_a_first_stroke_are_not_those_of_the_run():
    travel = 0.5 - 0.5 * np.cos(0.4 * np.arange(12))
    frames = np.where(travel[:, None, None] > EDGES, 255, 0).astype(np.uint8)
    run = pushed(engine.press.Strokes(noise=1.0), frames, travel=travel)
    heights = run.result().height
    expected = heights.copy()
    heights[:] = 0
    np.testing.assert_array_equal(run.result().height, expected)


def test_a_run_that_has_ended_keeps_its_result_and_takes_no_frames():
    run = pushed(ONSET, travel=TRAVEL)
    result = run.result(ended=True)
    assert run.result() is result
    assert run.preview(1.0) is result
    with pytest.raises(io.InputError, match=r"has ended: push frames into a new one"):
        run.push(FRAMES[-1:], travel=TRAVEL[-1:])


def test_a_complete_run_is_not_repeated():
    recording = io.ArrayRecording(FRAMES, {"travel": TRAVEL}, {})
    run = engine.Run(ONSET, recording)
    assert run.complete() is run.complete()


def test_an_operation_in_use_starts_anew_in_another_run():
    run = pushed(ONSET, travel=TRAVEL)
    again = pushed(run.operation, travel=TRAVEL)
    assert again.result().process["frames"] == len(FRAMES)


def test_a_first_push_that_is_refused_leaves_the_run_as_it_was():
    run = engine.Run(engine.Onset(noise=1.0))
    with pytest.raises(io.InputError, match="float frames have no natural range"):
        run.push(FRAMES.astype(np.float32), travel=TRAVEL)
    run.push(FRAMES, travel=TRAVEL)
    assert run.result().process["frames"] == len(FRAMES)


def test_an_operation_takes_its_levels_from_the_source_of_a_run():
    recording = io.ArrayRecording(FRAMES, {"travel": TRAVEL}, {"dark": 10.0, "bright": 200.0})
    run = engine.Run(engine.Onset(noise=1.0), recording)
    np.testing.assert_array_equal(
        run.complete().height, engine.run(recording, engine.Onset(noise=1.0)).height
    )


@pytest.mark.parametrize("find", [engine.find_onset, engine.find_change_point])
def test_arrays_have_times_for_a_rolling_shutter(find):
    levels = {"dark": 0, "bright": 255, "noise": 1.0}
    still, late = (
        find(FRAMES, TRAVEL, TRAVEL / 3, line_time=seconds, **levels).height for seconds in (None, 1e-3)
    )
    valid = np.isfinite(still)
    rows = 1e-3 * (np.arange(6) - 2.5)[:, np.newaxis] * np.ones((1, 7))
    np.testing.assert_allclose((still - late)[valid], 3 * rows[valid], atol=1e-6)


@pytest.mark.parametrize("method", ["threshold", "change-point"])
def test_scatter_of_levels_is_in_the_errors_of_both_methods(method):
    recording = io.ArrayRecording(FRAMES, {"travel": TRAVEL}, {})
    options = {"method": method, "dark": 0, "bright": 255, "noise": 1.0, "fill": False}
    exact, scattered = (engine.Press(dark_sigma=sigma, **options).run(recording) for sigma in (0.0, 20.0))
    valid = np.isfinite(exact.height_sigma)
    assert (scattered.height_sigma[valid] > exact.height_sigma[valid]).all()
