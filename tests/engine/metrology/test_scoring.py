"""Scores, compared with errors added by hand."""

import numpy as np
import pytest

from mirrorskin import engine, io
from mirrorskin.engine.base.summary import summarise
from mirrorskin.evaluation.scenes.rotations import direction
from mirrorskin.io.model.maps import SlipStatus, status_of

NAN = np.float32(np.nan)


def truth_of(height, contact=None):
    flat = np.zeros_like(height)
    touched = np.ones(height.shape, np.uint8) if contact is None else np.array(contact, np.uint8)
    return io.Truth(height, flat, flat, touched)


def truth_of_normals(zenith, azimuth, contact=None):
    """Take degrees."""
    zenith, azimuth = (np.radians(np.array(angle, np.float32)) for angle in (zenith, azimuth))
    touched = np.ones(zenith.shape, np.uint8) if contact is None else np.array(contact, np.uint8)
    return io.Truth(np.zeros_like(zenith), zenith, azimuth, touched)


def normals(zenith, azimuth):
    """Take degrees."""
    return direction(np.radians(zenith), np.radians(azimuth)).astype(np.float32)


def test_errors_are_what_they_are():
    truth = truth_of(np.zeros((2, 3), np.float32), [[1, 1, 1], [1, 0, 0]])
    height = np.array([[0.3, -0.1, NAN], [0.1, 0.1, NAN]], np.float32)
    sigma = np.full((2, 3), 0.1, np.float32)
    score = engine.score(io.Result(height=height, height_sigma=sigma), truth).height
    assert (score.answered, score.touched) == (4, 4)
    assert score.coverage == pytest.approx(0.75)
    assert score.rms == pytest.approx(np.sqrt(0.03))
    assert score.mean == pytest.approx(0.1)
    assert score.median == pytest.approx(0.1)
    assert score.largest == pytest.approx(0.3)
    assert score.chi_square == pytest.approx(3.0)


def test_no_answer_at_all_is_scored_too():
    height = np.full((2, 2), NAN)
    score = engine.score(io.Result(height=height), truth_of(np.zeros((2, 2), np.float32))).height
    assert score.answered == 0
    assert score.coverage == 0
    assert np.isnan([score.rms, score.mean, score.chi_square]).all()
    assert str(summarise(io.Result(height=height))) == "no height at any of 4 pixels"


def test_what_cannot_be_compared_is_refused():
    truth = truth_of(np.zeros((2, 2), np.float32))
    for nothing in (io.Result(), io.Result(mean=np.zeros((2, 2), np.float32))):
        with pytest.raises(io.InputError, match="no heights, normals, azimuths, contact, edges or slip"):
            engine.score(nothing, truth)
    flat = np.zeros((2, 3), np.float32)
    maps = {"height": flat, "azimuth": flat, "normals": flat[..., np.newaxis] * np.ones(3), "contact": flat}
    for name, values in maps.items():
        with pytest.raises(io.InputError, match=r"\(2, 3\) pixels, the truth \(2, 2\): not of one stack"):
            engine.score(io.Result(**{name: values}), truth)


def test_the_far_end_is_the_99th_percentile():
    height = np.arange(1, 102, dtype=np.float32).reshape(1, 101)
    sigma = np.where(height > 50, 0, height).astype(np.float32)  # of a sigma of 0 no ratio can be told
    truth = truth_of(np.zeros_like(height), np.zeros_like(height))
    score = engine.score(io.Result(height=height, height_sigma=sigma), truth).height
    assert score.p99 == pytest.approx(100)
    assert score.chi_square == pytest.approx(1)
    assert np.isnan(score.coverage)
    summary = summarise(io.Result(height=height))
    assert (summary.lowest, summary.highest, summary.answered) == (1, 101, 101)


def test_the_error_of_a_normal_is_the_angle_to_the_true_one():
    # Errors of 3, 4, 0 and 5 degrees, and of 90 where there is no contact and so no truth to compare with.
    truth = truth_of_normals(
        [[30, 30, 0], [80, 45, 45]], [[50, -170, np.nan], [10, 45, 45]], [[1, 1, 1], [1, 0, 1]]
    )
    actual = normals([[33, 26, 0], [85, 45, 45]], [[50, 190, 77], [10, 225, np.nan]])
    sigma = np.full((2, 3), np.radians(2), np.float32)
    score = engine.score(io.Result(normals=actual, normals_sigma=sigma), truth)
    assert score.parts().keys() == {"normal"}
    part = score.normal
    assert (part.answered, part.touched) == (4, 5)
    assert part.coverage == pytest.approx(0.8)
    assert part.rms == pytest.approx(np.sqrt(50 / 4), rel=1e-5)
    assert part.median == pytest.approx(3.5, rel=1e-5)
    assert part.largest == pytest.approx(5, rel=1e-5)
    assert part.p99 == pytest.approx(4.97, rel=1e-5)
    assert part.chi_square == pytest.approx(50 / 4 / 4, rel=1e-5)


@pytest.mark.parametrize("error", [2e-5, 179.999])
def test_small_and_large_angles_are_printed_alike(error):
    across = np.linspace(0, 360, 24, endpoint=False, dtype=np.float32)[np.newaxis]
    truth = truth_of_normals(np.full_like(across, 0.0), across)
    actual = normals(np.full(across.shape, error), across)
    part = engine.score(io.Result(normals=actual), truth).normal
    assert part.largest == pytest.approx(error, rel=1e-5)
    assert part.rms == pytest.approx(error, rel=1e-5)


def test_differences_of_azimuths_are_at_most_half_a_turn():
    truth = truth_of_normals([[30, 30, 0, 30]], [[179, -90, np.nan, 0]], [[1, 1, 1, 0]])
    azimuth = np.radians(np.array([[-179, 90, 5, 77]], np.float32))
    score = engine.score(io.Result(azimuth=azimuth), truth)
    assert score.parts().keys() == {"azimuth"}
    part = score.azimuth
    assert (part.answered, part.touched) == (2, 3)  # what is level has no azimuth
    assert part.largest == pytest.approx(180, rel=1e-5)
    assert part.rms == pytest.approx(np.sqrt((4 + 180**2) / 2), rel=1e-5)
    assert np.isnan(part.chi_square)


def test_contact_is_scored_where_there_is_an_answer_and_as_a_whole():
    touched = [[1, 1, 1, 1, 1], [0, 0, 0, 0, 0]]
    flagged = [[1, 1, 1, 0, 0], [1, 0, 0, 0, 0]]
    truth = truth_of_normals(np.full((2, 5), 20), np.full((2, 5), 20), touched)
    actual = normals(np.full((2, 5), 20), np.full((2, 5), 20))
    actual[0, 4] = actual[1, 4] = np.nan  # without an answer there is nothing to flag
    part = engine.score(io.Result(normals=actual, contact=np.array(flagged, np.uint8)), truth).contact
    assert part.recall == pytest.approx(3 / 5)
    assert part.precision == pytest.approx(3 / 4)
    assert part.lost == 4
    assert part.lost_flagged == pytest.approx(3 / 4)
    assert part.wrongly_flagged == pytest.approx(1 / 4)


def roof(jump, rows=9, columns=12):
    """Return the truth of a roof with its ridge between the columns 5 and 6, in contact but for two rows."""
    azimuth = np.tile(np.where(np.arange(columns) < 6, 180.0, 0.0), (rows, 1))
    contact = np.ones((rows, columns))
    contact[-2:] = 0
    return truth_of_normals(np.full((rows, columns), jump / 2), azimuth, contact)


def marked(*places, shape=(9, 12)):
    edges = np.zeros(shape, np.uint8)
    for place in places:
        edges[place] = 1
    return edges


@pytest.mark.parametrize(
    ("jump", "edges", "recall", "precision"),
    [
        (20, marked(np.s_[:7, 5], np.s_[6]), 1, 1),
        (20, marked(np.s_[:7, 7], np.s_[7]), 1 - 6 / 36, 1),  # a pixel beside the right one
        (20, marked(np.s_[:7, 5], np.s_[3], np.s_[6]), 1, 1 - 8 / 29),  # a line that is not there
        (20, marked(np.s_[6]), 1 - 10 / 36, 1),
        (9, marked(np.s_[6]), 1, 1),
        (9, marked(np.s_[:6, 5]), 3 / 24, 1 / 6),
    ],
)
def test_edges_are_found_within_a_pixel(jump, edges, recall, precision):
    part = engine.score(io.Result(edges=edges), roof(jump)).edges
    assert part.found == np.count_nonzero(edges)
    assert part.true == (24 + 12 if jump > 10 else 24)
    assert part.recall == pytest.approx(recall)
    assert part.precision == pytest.approx(precision)


def test_a_result_for_each_turn_is_scored_over_all_turns():
    truth = truth_of_normals([[30, 40]], [[20, 20]], [[1, 0]])
    actual = np.stack([normals([[30 + error, 40]], [[20, 20]]) for error in (3, 4, 5)])
    flags = np.array([[[1, 0]], [[1, 1]], [[0, 0]]], np.uint8)
    height = np.array([[[0.1, 0.1]], [[0.1, NAN]], [[0.1, 0.1]]], np.float32)
    score = engine.score(io.Result(height=height, normals=actual, contact=flags, edges=flags), truth)
    assert (score.normal.answered, score.normal.touched) == (2, 3)  # the third turn claims no contact
    assert score.normal.rms == pytest.approx(np.sqrt(25 / 2), rel=1e-5)
    assert (score.height.answered, score.height.touched) == (5, 3)
    assert score.contact.recall == pytest.approx(2 / 3)
    assert (score.contact.lost, score.contact.lost_flagged) == (3, pytest.approx(2 / 3))
    assert (score.edges.true, score.edges.recall) == (6, pytest.approx(4 / 6))


def test_a_score_prints_what_there_is():
    truth = truth_of_normals([[30, 40]], [[20, 20]], [[1, 0]])
    result = io.Result(height=np.zeros((1, 2), np.float32), normals=normals([[32, 40]], [[20, 20]]))
    table = engine.score(result, truth).table()
    assert table["height RMS error"] == "0.0000 mm"
    assert table["normal RMS error"] == "2.0000 deg"
    assert table["normal coverage"] == "100.00 % of the 1 pixels in contact"
    assert {name.split()[0] for name in table} == {"height", "normal"}


def in_components():
    """Return heights of two components, one of them relative, with a filled pixel each, and the truth."""
    truth = truth_of(np.array([[0, 1, 2, 3, 4, 5]], np.float32))
    height = np.array([[0.1, 1.1, 2.3, 7, 8.2, NAN]], np.float32)
    maps = {
        "component": np.array([[0, 0, 0, 1, 1, -1]], np.int32),
        "offset_unknown": np.array([0, 1], np.uint8),
        "filled": np.array([[0, 0, 1, 0, 0, 0]], np.uint8),
    }
    return io.Result(height=height, height_sigma=np.full((1, 6), 0.1, np.float32), **maps), truth


def test_relative_heights_are_compared_without_their_mean_difference():
    result, truth = in_components()
    score = engine.score(result, truth)
    # Errors of 0.1 twice in the absolute component, and of -0.1 and 0.1 about the mean of 4.1 in the other.
    assert score.height.answered == 4
    assert score.height.relative == 1
    assert score.height.rms == pytest.approx(0.1, rel=1e-5)
    assert score.height.mean == pytest.approx(0.05, rel=1e-5)
    assert score.height.chi_square == pytest.approx(1, rel=1e-5)
    assert score.table()["height offset"] == ("mean difference taken off; pieces without a known height: 1")


def test_filled_heights_are_scored_separately():
    result, truth = in_components()
    score = engine.score(result, truth)
    assert list(score.parts()) == ["height", "filled"]
    assert (score.filled.answered, score.filled.relative) == (1, 0)
    assert score.filled.rms == pytest.approx(0.3, rel=1e-5)
    assert np.isnan(score.filled.chi_square)  # of what is filled nothing tells how sure it is
    assert score.table()["filled RMS error"] == "0.3000 mm"
    assert "filled offset" not in score.table()
    assert engine.score(result.assign(filled=result.filled * 0), truth).filled is None


def test_each_component_of_each_turn_has_its_own_difference():
    truth = truth_of(np.array([[0, 1, 2]], np.float32))
    height = np.array([[[5, 6, NAN]], [[-3, -2, -1.3]]], np.float32)
    component = np.array([[[0, 0, -1]], [[1, 1, 2]]], np.int32)
    result = io.Result(height=height, component=component, offset_unknown=np.ones(3, np.uint8))
    score = engine.score(result, truth).height
    assert (score.answered, score.relative) == (5, 3)
    assert score.rms == pytest.approx(0, abs=1e-6)


ZENITH = np.radians(np.array([[10, NAN, 45.5], [0, 20, NAN]], np.float32))


@pytest.mark.parametrize(
    ("maps", "line"),
    [
        ({"zenith": ZENITH}, "normals at 4 of 6 pixels, zenith from 0.000 to 45.500 deg"),
        (
            {"zenith": ZENITH, "contact": (ZENITH > 0).astype(np.uint8)},
            "normals at 4 of 6 pixels, zenith from 0.000 to 45.500 deg, in contact at 3",
        ),
        (
            {"zenith": np.stack([ZENITH, ZENITH])},
            "normals at 8 of 12 pixels in 2 turns, zenith from 0.000 to 45.500 deg",
        ),
        ({"zenith": ZENITH * NAN}, "no normals at any of 6 pixels"),
        (
            {"azimuth": ZENITH, "modulation": np.full((2, 3), 7.25, np.float32)},
            "modulation at 6 of 6 pixels, from 7.250 to 7.250 counts",
        ),
        ({"height": ZENITH * 0 - 1, "zenith": ZENITH}, "height at 4 of 6 pixels, from -1.000 to -1.000 mm"),
        (
            {"height": ZENITH * 0 - 1, "filled": (ZENITH == 0).astype(np.uint8)},
            "height at 4 of 6 pixels (1 filled), from -1.000 to -1.000 mm",
        ),
        (
            {"height": ZENITH, "zenith": ZENITH, "offset_unknown": np.array([1, 0], np.uint8)},
            "height at 4 of 6 pixels, from 0.000 to 0.794 mm",
        ),
        (
            {"height": ZENITH, "zenith": ZENITH, "offset_unknown": np.array([1, 1], np.uint8)},
            "normals at 4 of 6 pixels, zenith from 0.000 to 45.500 deg,"
            " relative height from 0.000 to 0.794 mm",
        ),
        (
            {"height": ZENITH * NAN, "zenith": ZENITH, "offset_unknown": np.array([], np.uint8)},
            "normals at 4 of 6 pixels, zenith from 0.000 to 45.500 deg",
        ),
    ],
)
def test_a_result_in_one_line(maps, line):
    assert str(summarise(io.Result(**maps))) == line


def test_the_line_of_slip_has_the_counts_of_the_status_and_the_forces():
    status = np.array([[0, 1, 1], [2, 3, 4]], np.uint8)
    result = io.Result(
        slip_onset=np.where(status == 1, np.float32(0.05), NAN),
        contact=(status != 3).astype(np.uint8),
        status=status,
        stick_ratio=np.array([1.0, 0.25, NAN]),
        force_x=0.5,
        force_x_sigma=0.01,
        declarations={"status": status_of(SlipStatus)},
    )
    assert str(summarise(result)) == (
        "slip onset at 2 of 6 pixels, from 50.000 to 50.000 µm, in contact at 5, 2 slipped, 1 sticks, "
        "1 no contact, 1 no texture, stick ratio 0.25, force x 0.5 ± 0.01 N"
    )


def test_undistorted_maps_are_not_of_the_truth_s_pixels():
    result = io.Result(height=np.zeros((2, 3), np.float32), fitted=io.Fitted(undistorted=True))
    with pytest.raises(io.InputError, match="the result is undistorted"):
        engine.score(result, truth_of(np.zeros((2, 3), np.float32)))


@pytest.mark.parametrize(
    ("heights", "message"),
    [
        ([-1.95, 0.0], "from -1.950 to 0.000 mm"),
        ([-0.0019, 0.0123], "from -1.900 to 12.300 \u00b5m"),
        ([-1.4e-6, 3.2e-6], "from -1.400 to 3.200 nm"),
        ([-1.9500031, -1.9500012], "from -1.95000315 to -1.95000124 mm"),
        ([-0.25, -0.25], "from -0.250 to -0.250 mm"),
    ],
)
def test_the_summary_has_units_and_digits_that_show_the_relief(heights, message):
    text = str(summarise(io.Result(height=np.array([heights], np.float32))))
    assert text == f"height at 2 of 2 pixels, {message}"
