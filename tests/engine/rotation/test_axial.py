"""From an axial source to a result: what is asked for, what the source says, honest errors on the twin."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import rotations
from rotations import EIGHTHS, TILT, Setup
from stacks import MadeUp, assert_same

from mirrorskin import engine, hw, io
from mirrorskin.hw.twin import Axial, Body, Camera

SHAPE = (20, 24)
SETUP = Setup(gain=60.0, noise=20.0, offset=150.0, dtype="uint16")
TURNS = 3
PHASE = np.concatenate([np.array(EIGHTHS) + 2 * np.pi * turn for turn in range(TURNS)])
HEADER = io.Header(
    "axial",
    pixel_size=(0.1, 0.1),
    press=1.0,
    tilt=TILT,
    pivot=(0.0, 0.0, 0.0),
    zenith_gain=np.array(SETUP.slope),
    zenith_offset=np.array(SETUP.offset),
)
NO_GAIN = replace(HEADER, zenith_gain=None, zenith_offset=None)
X, Y = np.meshgrid(np.linspace(-1, 1, SHAPE[1]), np.linspace(1, -1, SHAPE[0]))
DOME = rotations.direction(np.radians(8 + 35 * np.hypot(X, Y)), np.arctan2(Y, X))
FLAT = np.full(SHAPE, -1.0, np.float32)  # as deep as the press: about a pivot in the sheet, nothing moves


@pytest.fixture(autouse=True)
def few_draws(monkeypatch):
    """Tell the heights' sigma from a few draws of noise: enough to hold it against errors, and faster."""
    monkeypatch.setattr("mirrorskin.engine.integration.height_variance.DRAWS", 6)
    monkeypatch.setattr("mirrorskin.engine.integration.height_variance.WAVES", 4)


@cache
def frames():
    return rotations.expose(DOME, replace(SETUP, phase=tuple(PHASE)), seed=3)


def source(header=HEADER, **changes):
    given = {"phase": PHASE, **changes}
    return MadeUp(given.pop("frames", frames()), header, **given)


def reconstruct(header=HEADER, **options):
    return engine.reconstruct(source(header), **options)


def errors(result):
    """Return the angles to the true normals, radians."""
    return rotations.between(result.normals.astype(float), DOME)


def alike(one, other):
    assert one.maps().keys() == other.maps().keys()
    for name, values in one.maps().items():
        np.testing.assert_array_equal(values, other.maps()[name], err_msg=name)


def test_a_rotation_becomes_normals_and_what_goes_with_them():
    result = reconstruct()
    assert {name: values.shape for name, values in result.maps().items()} == {
        **dict.fromkeys(
            ("zenith", "azimuth", "normal_sigma", "mean", "modulation", "residual", "edges", "contact"), SHAPE
        ),
        **dict.fromkeys(("height", "height_sigma", "component"), SHAPE),
        "normals": (*SHAPE, 3),
    }
    assert np.mean((errors(result) / result.normal_sigma) ** 2) == pytest.approx(1, abs=0.25)
    assert result.contact.all()
    assert result.x.shape == (SHAPE[1],)
    assert result.y.shape == (SHAPE[0],)
    told = {name: result.process[name] for name in ("method", "tilt_from", "turns", "frames", "per_turn")}
    assert told == {
        "method": "exact",
        "tilt_from": "recording",
        "turns": TURNS,
        "frames": 8 * TURNS,
        "per_turn": False,
    }
    assert result.process["tilt"] == TILT
    assert result.process["zenith_gain"] == SETUP.slope
    assert result.process["zenith_offset"] == SETUP.offset
    assert result.process["noise"] == pytest.approx(SETUP.spread, rel=0.1)
    assert result.process["low"] == result.process["high"] == "range of the type"
    assert result.process["heights"] == "none"


def test_it_is_the_normals_of_the_frames():
    result = reconstruct(method="paper", noise=20.0)
    found = engine.estimate_normals(
        frames(), PHASE, tilt=TILT, gain=SETUP.slope, offset=SETUP.offset, method="paper", noise=20.0
    )
    np.testing.assert_array_equal(result.normals, found.vectors)
    np.testing.assert_array_equal(result.normal_sigma, found.sigma)
    for name in ("zenith", "azimuth", "contact", "mean", "modulation", "residual"):
        np.testing.assert_array_equal(getattr(result, name), getattr(found, name))
    assert result.process["method"] == "paper"
    assert result.process["noise"] == 20.0


@pytest.mark.parametrize("options", [{}, {"per_turn": True}, {"heights": FLAT}, {"tilt": "estimate"}])
def test_it_is_the_same_however_a_source_is_read(options):
    whole = reconstruct(**options)
    frame = 2 * SHAPE[0] * SHAPE[1]
    for count in (1, 3, 11):
        alike(reconstruct(memory_limit=2 * count * frame, **options), whole)
    alike(engine.reconstruct(source(), memory_limit=1, **options), whole)


def test_each_turn_may_be_told_alone():
    result, mean = reconstruct(per_turn=True), reconstruct()
    for name, values in result.maps().items():
        assert values.shape == (TURNS, *mean.maps()[name].shape)
    assert [np.unique(turn).tolist() for turn in result.component] == [[0], [1], [2]]
    assert result.offset_unknown.tolist() == [1, 1, 1]
    assert result.process["per_turn"]
    noise = mean.process["noise"]
    for turn in range(TURNS):
        part = slice(8 * turn, 8 * turn + 8)
        alone = engine.reconstruct(source(frames=frames()[part], phase=PHASE[part]), noise=noise)
        away = rotations.between(result.normals[turn].astype(float), alone.normals.astype(float))
        assert np.median(away / alone.normal_sigma) < 0.05
    assert np.median(mean.normal_sigma / result.normal_sigma[0]) == pytest.approx(3**-0.5, rel=0.02)


def test_without_a_gain_there_is_the_wave_alone():
    result = reconstruct(NO_GAIN)
    assert set(result.maps()) == {"azimuth", "mean", "cosine", "sine", "modulation", "residual"}
    assert result.process["zenith"] == "none: the recording has no zenith gain"
    assert result.process["method"] == "correlation"
    assert result.process["frames"] == 8 * TURNS
    wave = engine.correlate(frames(), PHASE)
    np.testing.assert_array_equal(result.mean, wave.mean)
    np.testing.assert_array_equal(result.modulation, wave.modulation)
    turned = result.azimuth - np.arctan2(Y, X)
    assert np.median(np.abs(np.arctan2(np.sin(turned), np.cos(turned)))) < 0.05


@pytest.mark.parametrize("options", [{"per_turn": True}, {"heights": FLAT}])
def test_without_a_gain_there_are_no_normals_to_ask_for(options):
    with pytest.raises(io.InputError, match="made up has no zenith gain, so no normals"):
        reconstruct(NO_GAIN, **options)


def test_what_is_given_goes_before_what_the_source_says():
    wrong = replace(HEADER, zenith_gain=np.array(1.0), zenith_offset=np.array(9.0), tilt=0.3)
    given = {"gain": SETUP.slope, "offset": SETUP.offset, "tilt": TILT}
    result = reconstruct(wrong, **given)
    alike(result, reconstruct())
    alike(reconstruct(replace(NO_GAIN, tilt=None), **given), result)
    told = {name: result.process[name] for name in ("zenith_gain", "zenith_offset", "tilt", "tilt_from")}
    assert told == {
        "zenith_gain": SETUP.slope,
        "zenith_offset": SETUP.offset,
        "tilt": TILT,
        "tilt_from": "given",
    }


def test_an_offset_that_nobody_knows_is_0():
    unknown = replace(HEADER, zenith_offset=None)
    alike(reconstruct(unknown), reconstruct(replace(HEADER, zenith_offset=np.array(0.0))))
    assert reconstruct(unknown).process["zenith_offset"] == "0"


def test_maps_of_the_recording_are_used_and_said_so():
    ones, nine = np.ones(SHAPE), tuple(2 * np.pi * np.arange(9) / 9)
    header = replace(
        HEADER,
        zenith_gain=SETUP.slope * ones,
        zenith_offset=SETUP.offset * ones,
        dark=np.full(SHAPE, 1800, np.float32),  # brightness is linear from zenith 27 on
        bright=np.full(SHAPE, 60_000, np.float32),
    )
    made = rotations.expose(DOME, replace(SETUP, phase=nine), seed=4)
    result = engine.reconstruct(source(header, frames=made, phase=np.array(nine)))
    told = {result.process[name] for name in ("zenith_gain", "zenith_offset", "low", "high")}
    assert told == {"map of the recording"}
    zenith = np.degrees(rotations.angles(DOME)[0])
    assert np.isnan(result.zenith[zenith < 24]).all()
    assert np.isfinite(result.zenith[zenith > 31]).all()
    assert np.isnan(result.zenith).any()


def test_the_tilt_is_estimated_on_request_only():
    unknown = replace(HEADER, tilt=None)
    with pytest.raises(io.InputError, match=r"^made up does not say how far the body leaned: give the tilt"):
        reconstruct(unknown)
    result = reconstruct(unknown, tilt="estimate")
    assert result.process["tilt_from"] == "estimate"
    assert result.process["tilt"] == pytest.approx(TILT, rel=0.01)
    assert np.median(errors(result) / result.normal_sigma) < 1.2
    assert reconstruct(tilt="estimate").process["tilt"] == result.process["tilt"]


def test_heights_register_the_frames():
    result, mean = reconstruct(heights=FLAT), reconstruct()
    assert result.process["heights"] == "given"
    inside = np.isfinite(result.zenith)
    assert 0.6 < inside.mean() < 1
    # Nothing moves but along the second order of the tilt.
    assert np.median(np.degrees(errors(result))[inside]) < 1.5 * np.median(np.degrees(errors(mean)))
    assert result.contact[inside].all()
    moved = reconstruct(replace(HEADER, pivot=(0.0, 0.0, 5.0)), heights=FLAT)
    assert not np.array_equal(moved.normals, result.normals, equal_nan=True)
    each = reconstruct(heights=FLAT, per_turn=True)
    assert each.normals.shape == (TURNS, *SHAPE, 3)
    np.testing.assert_array_equal(np.isfinite(each.zenith[0]), inside)


# Pixels on which the dome is a surface: its normals are those of a height.
OF_A_SURFACE = replace(HEADER, pixel_size=(2 / (SHAPE[1] - 1), 2 / (SHAPE[0] - 1)))
RATE = np.radians(35)
DOME_HEIGHT = np.log(np.cos(np.radians(8) + RATE * np.hypot(X, Y))) / RATE


def test_the_heights_are_those_that_fit_the_normals():
    result = reconstruct(OF_A_SURFACE)
    assert (result.height.dtype, result.component.dtype) == (np.float32, np.int32)
    error = result.height - (DOME_HEIGHT - DOME_HEIGHT.mean())
    assert np.ptp(DOME_HEIGHT) > 0.8
    assert np.sqrt(np.mean(error**2)) < 0.005
    assert 0.1 < np.mean((error / result.height_sigma) ** 2) < 4  # one draw of errors that go together
    assert result.height.mean() == pytest.approx(0, abs=1e-6)
    assert result.offset_unknown.tolist() == [1]
    assert (result.component == 0).all()
    assert result.process["integration"] == "multigrid"
    assert result.process["integration_residual"] < 1e-3
    assert result.process["integration_iterations"] > 0


def test_the_heights_of_registered_frames_are_told_too():
    result = reconstruct(OF_A_SURFACE, heights=FLAT)
    inside = result.component == 0
    np.testing.assert_array_equal(np.isfinite(result.height), result.contact > 0)
    error = (result.height - DOME_HEIGHT)[inside]
    assert inside.sum() > 150
    assert np.std(error) < 0.01


def test_contacts_apart_have_heights_apart():
    made = frames().copy()
    made[:, :, 10:13] = 150  # level, which no normal that turns is: no contact
    result = engine.reconstruct(source(OF_A_SURFACE, frames=made))
    assert (result.contact[:, 10:13] == 0).all()
    np.testing.assert_array_equal(np.isnan(result.height), result.contact == 0)
    assert result.offset_unknown.tolist() == [1, 1]
    for number, part in enumerate((np.s_[:, :10], np.s_[:, 13:])):
        assert (result.component[part] == number).all()
        assert result.height[part].mean() == pytest.approx(0, abs=1e-6)
        error = result.height[part] - DOME_HEIGHT[part]
        assert np.std(error) < 0.01


def test_without_a_pixel_size_there_are_no_heights():
    result = reconstruct(replace(HEADER, pixel_size=None))
    assert result.height is result.height_sigma is result.component is result.offset_unknown is None
    assert result.process["height"] == "none: the recording has no pixel size"
    assert result.x is None
    assert "integration" not in result.process


def test_the_surface_may_break_on_request(monkeypatch):
    asked = []

    def listen(*slopes, **options):
        asked.append(options.pop("robust"))
        broken = np.zeros(SHAPE, np.uint8)
        broken[3, 4] = 1
        return replace(engine.integrate(*slopes, **options), edges=broken if asked[-1] else None)

    monkeypatch.setattr("mirrorskin.engine.rotation.normals_to_height.integrate", listen)
    whole, robust = reconstruct(), reconstruct(robust=True)
    assert asked == [False, True]
    assert whole.edges[3, 4] == 0
    assert robust.edges[3, 4] == 1
    assert robust.edges.sum() == whole.edges.sum() + 1


def test_heights_that_were_not_found_are_no_answer(monkeypatch):
    def fail(*slopes, **options):
        raise engine.NotConverged("100 iterations left a residual of 0.1")

    monkeypatch.setattr("mirrorskin.engine.rotation.normals_to_height.integrate", fail)
    with pytest.raises(engine.NotConverged, match="100 iterations"):
        reconstruct()


@pytest.mark.parametrize(
    ("residual", "is_told"), [(5e-5, True), (5e-4, False), (np.inf, False), (np.nan, False)]
)
def test_heights_that_are_nearly_as_near_as_asked_are_told_at_once(monkeypatch, residual, is_told):
    found = []

    def miss(*slopes, **options):
        found.append(replace(engine.integrate(*slopes, **options), converged=False, residual=residual))
        return found[-1]

    monkeypatch.setattr("mirrorskin.engine.rotation.normals_to_height.integrate", miss)
    if is_told:
        np.testing.assert_array_equal(reconstruct().height, found[0].height)
    else:
        with pytest.raises(engine.NotConverged, match="left a residual of"):
            reconstruct()
    assert len(found) == 1


@pytest.mark.parametrize("shape", [(3, 3), SHAPE])
def test_heights_at_which_nothing_is_seen_leave_no_answer(shape):
    far = replace(HEADER, pivot=(0.0, 0.0, 400.0))
    made = source(far, frames=frames()[:, : shape[0], : shape[1]])
    result = engine.reconstruct(made, heights=np.full(shape, -1.0))
    assert np.isnan(result.zenith).all()
    assert not result.contact.any()
    assert np.isnan(result.height).all()
    assert (result.component == -1).all()
    assert result.offset_unknown.size == 0


@cache
def twin(**camera):
    """A ball, pressed and turned about the sheet's centre; its brightness is linear from zenith 0 on."""
    return hw.Twin(
        object="sphere",
        shape=(90, 90),
        pixel_size=0.065,
        movement=Axial(EIGHTHS, TILT, press=1.0, pivot=(0.0, 0.0, 0.0)),
        pattern="linear",
        body=Body(height=1e5, scatter=0.0),
        camera=Camera(noise=1.0, seed=5, **camera),
    )


def on_twin(made, heights, **options):
    """Reconstruct; return squared errors in standard errors, errors in degrees, and zeniths, of contact."""
    made.rewind()
    result, truth = engine.reconstruct(made, heights=heights, **options), made.truth
    true = rotations.direction(truth.zenith, truth.azimuth)
    error, zenith = rotations.between(result.normals.astype(float), true), np.degrees(truth.zenith)
    # Next to the top and the rim, brightness has kinks.
    smooth = (result.contact > 0) & (truth.contact > 0) & (zenith > 8) & (zenith < 29)
    assert smooth.sum() > 2500
    return ((error / result.normal_sigma) ** 2)[smooth], np.degrees(error[smooth]), zenith[smooth], result


def test_registered_frames_have_honest_errors_where_the_noise_is_known():
    made = twin()
    known = {"noise": float(np.hypot(1, 12**-0.5))}
    square, error, zenith, _ = on_twin(made, made.truth.height, **known)
    for low, high in ((8, 15), (15, 22), (22, 29)):
        assert np.mean(square[(zenith > low) & (zenith < high)]) == pytest.approx(1, abs=0.15)
    assert np.sqrt(np.mean(error**2)) < 0.8 * np.sqrt(np.mean(on_twin(made, None, **known)[1] ** 2))


def test_registered_frames_have_honest_errors_where_the_noise_is_told():
    made = twin(electrons=40.0, gain_deviation=0.02, offset_deviation=0.5)
    square, _, zenith, result = on_twin(made, made.truth.height)
    assert result.process["shot_noise"] == pytest.approx(1 / 40, rel=0.15)
    for low, high in ((8, 15), (15, 22), (22, 29)):
        assert np.mean(square[(zenith > low) & (zenith < high)]) == pytest.approx(1, abs=0.25)


REFUSED = {
    "a press's method": (
        {},
        {"method": "threshold"},
        "made up is a rotation, which method 'threshold' cannot do: take exact",
    ),
    "two frames": ({"frames": slice(2)}, {}, "^made up: 2 frames at 2 different phases"),
    "no phases": ({"phase": None}, {}, "^made up: phase is missing"),
    "a gain of 0": ({}, {"gain": 0.0}, "^made up: zenith gain 0.0: counts per radian"),
    "a gain of others": ({}, {"gain": np.ones((3, 3))}, r"^made up: zenith gain has shape \(3, 3\)"),
    "a tilt of 40 degrees": ({}, {"tilt": 0.7}, "^made up: tilt 40.1.* deg: above 0"),
    "heights of others": ({}, {"heights": np.zeros((3, 3))}, r"heights have shape \(3, 3\)"),
    "no noise": ({}, {"noise": 0.0}, "^made up: noise 0.0"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_used_is_refused_in_one_line(case):
    changes, options, message = REFUSED[case]
    part = changes.get("frames", slice(None))
    series = {"phase": PHASE[part]} if "phase" not in changes else {}
    made = MadeUp(frames()[part], HEADER, **series)
    with pytest.raises(io.InputError, match=message) as caught:
        engine.reconstruct(made, **options)
    assert "\n" not in str(caught.value)


def test_progress_is_told_to_the_last_frame():
    done = []
    reconstruct(progress=done.append)
    assert done[-1] == 8 * TURNS
    assert done == sorted(done)


def test_a_source_that_can_is_rewound_first():
    made = source()
    made.rewindable, made.rewind = True, lambda: setattr(made, "frames_read", 0)
    made.read(np.empty((5, *SHAPE), np.uint16))
    alike(engine.reconstruct(made), reconstruct())


def test_results_are_saved_and_read_again(tmp_path):
    for options in ({}, {"per_turn": True}):
        result = reconstruct(**options)
        io.save_result(result, tmp_path / "out.h5")
        found = io.open_result(tmp_path / "out.h5")
        assert_same(found, replace(result, process=found.process))
        (tmp_path / "out.h5").unlink()
