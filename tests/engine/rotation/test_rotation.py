"""From an axial source to a result: options, the source's own values, true errors on the twin."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from stacks import MadeUp, assert_same

from mirrorskin import engine, io
from mirrorskin.engine.base.operation import Plan
from mirrorskin.engine.rotation.steps import Edges, Integration, take_slopes
from mirrorskin.evaluation.scenes import rotations
from mirrorskin.evaluation.scenes.rotations import EIGHTHS, TILT, Setup
from mirrorskin.twin import Axial, Body, Camera, Twin

SHAPE = (20, 24)
SETUP = Setup(gain=60.0, noise=20.0, offset=150.0, dtype="uint16")
TURNS = 3
PHASE = np.concatenate([np.array(EIGHTHS) + 2 * np.pi * turn for turn in range(TURNS)])
# Without a pixel size there are normals only, which is quick.
HEADER = io.Header(
    "axial",
    press=1.0,
    tilt=TILT,
    pivot=(0.0, 0.0, 0.0),
    zenith_gain=np.array(SETUP.slope),
    zenith_offset=np.array(SETUP.offset),
    **rotations.EXACT,
)
NO_GAIN = replace(HEADER, zenith_gain=None, zenith_offset=None)
X, Y = np.meshgrid(np.linspace(-1, 1, SHAPE[1]), np.linspace(1, -1, SHAPE[0]))
RATE = np.radians(35)
DOME = rotations.direction(np.radians(8) + RATE * np.hypot(X, Y), np.arctan2(Y, X))
# Pixels on which the dome is a surface: its normals are those of a height.
OF_A_SURFACE = replace(HEADER, pixel_size=(2 / (SHAPE[1] - 1), 2 / (SHAPE[0] - 1)))
DOME_HEIGHT = np.log(np.cos(np.radians(8) + RATE * np.hypot(X, Y))) / RATE
FLAT = np.full(SHAPE, -1.0, np.float32)  # as deep as the press: about a pivot in the sheet, nothing moves


@cache
def frames():
    return rotations.expose(DOME, replace(SETUP, phase=tuple(PHASE)), seed=3)


def source(header=HEADER, **changes):
    fields = {"phase": PHASE, **changes}
    return MadeUp(fields.pop("frames", frames()), header, **fields)


def reconstruct(header=HEADER, **options):
    return engine.reconstruct(source(header), **{"blur": 0.0, **options})


def errors(result):
    """Return the angles to the true normals, radians."""
    return rotations.between(result.normals.astype(float), DOME)


def alike(first, other):
    assert first.maps().keys() == other.maps().keys()
    for name, values in first.maps().items():
        np.testing.assert_array_equal(values, other.maps()[name], err_msg=name)


def test_a_rotation_becomes_normals_and_what_goes_with_them(tmp_path):
    counts = []
    result = reconstruct(OF_A_SURFACE, progress=counts.append)
    maps = "zenith", "azimuth", "normals_sigma", "mean", "modulation", "residual", "edges", "contact"
    maps = (*maps, "height", "height_sigma", "component")
    shapes = {name: values.shape for name, values in result.maps().items()}
    assert shapes == {**dict.fromkeys(maps, SHAPE), "normals": (*SHAPE, 3)}
    assert np.mean((errors(result) / result.normals_sigma) ** 2) == pytest.approx(1, abs=0.25)
    assert result.contact.all()
    assert (result.x.shape, result.y.shape) == ((SHAPE[1],), (SHAPE[0],))
    expected = {"method": "exact", "tilt_from": "recording", "turns": TURNS, "frames": 8 * TURNS}
    expected |= {"per_turn": False, "tilt": TILT, "zenith_gain": SETUP.slope, "zenith_offset": SETUP.offset}
    expected |= {"dark": "range of the type", "bright": "range of the type", "heights": "none"}
    assert {name: result.process[name] for name in expected} == expected
    assert result.process["noise"] == pytest.approx(SETUP.spread, rel=0.1)
    assert counts[-1] == 8 * TURNS
    assert counts == sorted(counts)
    io.save_result(result, tmp_path / "out.h5")
    stored = io.open_result(tmp_path / "out.h5")
    assert_same(stored, result.assign(process=stored.process))


def test_each_turn_may_be_returned_alone():
    result, mean = reconstruct(OF_A_SURFACE, per_turn=True), reconstruct(OF_A_SURFACE)
    for name, values in result.maps().items():
        assert values.shape == (TURNS, *mean.maps()[name].shape)
    assert [np.unique(turn).tolist() for turn in result.component] == [[0], [1], [2]]
    assert result.offset_unknown.tolist() == [1, 1, 1]
    noise = mean.process["noise"]
    for turn in range(TURNS):
        part = slice(8 * turn, 8 * turn + 8)
        alone = engine.reconstruct(source(frames=frames()[part], phase=PHASE[part]), noise=noise, blur=0.0)
        away = rotations.between(result.normals[turn].astype(float), alone.normals.astype(float))
        assert np.median(away / alone.normals_sigma) < 0.05
    assert np.median(mean.normals_sigma / result.normals_sigma[0]) == pytest.approx(3**-0.5, rel=0.02)


def test_without_a_gain_there_is_the_wave_alone():
    result = reconstruct(NO_GAIN)
    assert set(result.maps()) == {"azimuth", "mean", "cosine", "sine", "modulation", "residual"}
    assert result.process["zenith"] == "none: the recording has no zenith gain"
    assert (result.process["method"], result.process["frames"]) == ("correlation", 8 * TURNS)
    wave = engine.correlate(frames(), PHASE)
    np.testing.assert_array_equal(result.mean, wave.mean)
    np.testing.assert_array_equal(result.modulation, wave.modulation)
    turned = result.azimuth - np.arctan2(Y, X)
    assert np.median(np.abs(np.arctan2(np.sin(turned), np.cos(turned)))) < 0.05
    for options in ({"per_turn": True}, {"heights": FLAT}):
        with pytest.raises(io.InputError, match="made up has no zenith gain, so no normals"):
            reconstruct(NO_GAIN, **options)


def test_options_replace_fields_of_the_source():
    wrong = replace(HEADER, zenith_gain=np.array(1.0), zenith_offset=np.array(9.0), tilt=0.3)
    options = {"zenith_gain": SETUP.slope, "zenith_offset": SETUP.offset, "tilt": TILT}
    result = reconstruct(wrong, **options)
    alike(result, reconstruct())
    alike(reconstruct(replace(NO_GAIN, tilt=None), **options), result)
    expected = {"zenith_gain": SETUP.slope, "zenith_offset": SETUP.offset, "tilt": TILT, "tilt_from": "given"}
    assert {name: result.process[name] for name in expected} == expected
    unknown = reconstruct(replace(HEADER, zenith_offset=None))
    alike(unknown, reconstruct(replace(HEADER, zenith_offset=np.array(0.0))))
    assert unknown.process["zenith_offset"] == "0"


def test_maps_of_the_recording_are_used_and_named_in_the_process():
    ones, nine = np.ones(SHAPE), tuple(2 * np.pi * np.arange(9) / 9)
    header = replace(
        HEADER,
        zenith_gain=SETUP.slope * ones,
        zenith_offset=SETUP.offset * ones,
        dark=np.full(SHAPE, 1800, np.float32),  # brightness is linear from zenith 27 on
        bright=np.full(SHAPE, 60_000, np.float32),
    )
    frames_ = rotations.expose(DOME, replace(SETUP, phase=nine), seed=4)
    result = engine.reconstruct(source(header, frames=frames_, phase=np.array(nine)))
    sources = {result.process[name] for name in ("zenith_gain", "zenith_offset", "dark", "bright")}
    assert sources == {"map of the recording"}
    zenith = np.degrees(rotations.angles(DOME)[0])
    assert np.isnan(result.zenith[zenith < 24]).all()
    assert np.isfinite(result.zenith[zenith > 31]).all()


def test_the_tilt_is_estimated_on_request_only():
    unknown = replace(HEADER, tilt=None)
    with pytest.raises(io.InputError, match=r"^made up has no tilt: give it"):
        reconstruct(unknown)
    result = reconstruct(unknown, tilt="estimate")
    assert result.process["tilt_from"] == "estimate"
    assert result.process["tilt"] == pytest.approx(TILT, rel=0.01)
    assert np.median(errors(result) / result.normals_sigma) < 1.2
    assert reconstruct(tilt="estimate").process["tilt"] == result.process["tilt"]


def test_heights_register_the_frames():
    result, mean = reconstruct(OF_A_SURFACE, heights=FLAT), reconstruct()
    assert result.process["heights"] == "given"
    inside = np.isfinite(result.zenith)
    assert 0.6 < inside.mean() < 1
    # Nothing moves but along the second order of the tilt.
    assert np.median(np.degrees(errors(result))[inside]) < 1.5 * np.median(np.degrees(errors(mean)))
    np.testing.assert_array_equal(np.isfinite(result.height), result.contact > 0)
    surface = result.component == 0
    assert surface.sum() > 150
    assert np.std((result.height - DOME_HEIGHT)[surface]) < 0.01
    far = replace(OF_A_SURFACE, pivot=(0.0, 0.0, 400.0))  # all is out of the picture
    lost = engine.reconstruct(source(far), heights=FLAT)
    assert np.isnan([lost.zenith, lost.height]).all()
    assert not lost.contact.any()
    assert (lost.component == -1).all()
    assert lost.offset_unknown.size == 0


def test_the_heights_are_those_that_fit_the_normals():
    result = reconstruct(OF_A_SURFACE)
    assert (result.height.dtype, result.component.dtype) == (np.float32, np.int32)
    error = result.height - (DOME_HEIGHT - DOME_HEIGHT.mean())
    assert np.sqrt(np.mean(error**2)) < 0.005
    assert 0.1 < np.mean((error / result.height_sigma) ** 2) < 4  # one draw of errors that go together
    assert result.height.mean() == pytest.approx(0, abs=1e-6)
    assert result.offset_unknown.tolist() == [1]
    assert result.process["integration"] == "multigrid"
    assert result.process["integration_residual"] < 1e-3
    none = reconstruct()
    assert none.height is none.height_sigma is none.component is none.offset_unknown is none.x is None
    assert none.process["height"] == "none: the recording has no pixel size"


def test_separate_contacts_have_separate_heights():
    stack = frames().copy()
    stack[:, :, 10:13] = 150  # level, which no normal that turns is: no contact
    result = engine.reconstruct(source(OF_A_SURFACE, frames=stack))
    np.testing.assert_array_equal(np.isnan(result.height), result.contact == 0)
    assert result.offset_unknown.tolist() == [1, 1]
    for number, part in enumerate((np.s_[:, :10], np.s_[:, 13:])):
        assert (result.component[part] == number).all()
        assert result.height[part].mean() == pytest.approx(0, abs=1e-6)
        assert np.std(result.height[part] - DOME_HEIGHT[part]) < 0.01


@pytest.mark.parametrize(
    ("robust", "residual", "accepted"), [(True, 5e-5, True), (False, 5e-4, False), (False, np.nan, False)]
)
def test_heights_that_do_not_converge_are_refused(monkeypatch, robust, residual, accepted):
    broken = np.zeros(SHAPE, np.uint8)
    broken[3, 4] = 1

    def miss(*slopes, **options):
        assert options.pop("robust") == robust
        surface = engine.integrate(*slopes, **options)
        surface = surface.with_fitted(integration_converged=False, integration_residual=residual)
        return surface.assign(edges=broken if robust else None)

    monkeypatch.setattr("mirrorskin.engine.integration.normals_to_height.integrate_arrays", miss)
    if accepted:
        assert reconstruct(OF_A_SURFACE, robust=robust).edges[3, 4] == 1
    else:
        with pytest.raises(engine.NotConverged, match="left a residual of"):
            reconstruct(OF_A_SURFACE, robust=robust)


@pytest.mark.parametrize("camera", [{}, {"electrons": 40.0, "gain_deviation": 0.02, "offset_deviation": 0.5}])
def test_registered_frames_of_the_twin_have_true_errors(camera):
    twin = Twin(
        object="sphere",
        shape=(90, 90),
        pixel_size=0.065,
        movement=Axial(EIGHTHS, TILT, press=1.0, pivot=(0.0, 0.0, 0.0)),
        pattern="linear",
        body=Body(height=1e5, scatter=0.0),
        camera=Camera(noise=1.0, seed=5, **camera),
    )
    noise = None if camera else float(np.hypot(1, 12**-0.5))
    truth, results = twin.truth, []
    frames = twin.read(np.empty(twin.shape, twin.dtype)).frames
    header = replace(twin.header, **rotations.EXACT)
    true = rotations.direction(truth.zenith, truth.azimuth)
    for heights in (truth.height, None):
        known = MadeUp(frames, header, phase=np.array(EIGHTHS))
        result = engine.reconstruct(known, heights=heights, noise=noise)
        error, zenith = rotations.between(result.normals.astype(float), true), np.degrees(truth.zenith)
        # Next to the top and the rim, brightness has kinks.
        smooth = (result.contact > 0) & (truth.contact > 0) & (zenith > 8) & (zenith < 29)
        assert smooth.sum() > 2500
        results.append(np.sqrt(np.mean(error[smooth] ** 2)))
        if heights is not None:
            square = np.where(smooth, (error / result.normals_sigma) ** 2, np.nan)
            for low, high in ((8, 15), (15, 22), (22, 29)):
                mean = np.nanmean(square[(zenith > low) & (zenith < high)])
                assert mean == pytest.approx(1, abs=0.25 if camera else 0.15)
            if camera:
                assert result.process["shot_noise"] == pytest.approx(1 / 40, rel=0.15)
    assert results[0] < 0.8 * results[1]


REFUSED = {
    "a press's method": ({}, {"method": "threshold"}, "^unknown method 'threshold'. Use exact or paper"),
    "two frames": ({"frames": slice(2)}, {}, "^made up: 2 frames at 2 different phases"),
    "no phases": ({"phase": None}, {}, "^made up: phase is missing"),
    "a gain of 0": ({}, {"zenith_gain": 0.0}, "^zenith_gain 0.0: counts per radian"),
    "a tilt of 40 degrees": ({}, {"tilt": 0.7}, "^tilt 40.1.* deg: above 0"),
    "heights of others": ({}, {"heights": np.zeros((3, 3))}, r"heights have shape \(3, 3\)"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_used_is_refused_in_one_line(case):
    changes, options, message = REFUSED[case]
    part = changes.get("frames", slice(None))
    series = {"phase": PHASE[part]} if "phase" not in changes else {}
    recording = MadeUp(frames()[part], OF_A_SURFACE, **series)
    with pytest.raises(io.InputError, match=message) as caught:
        engine.reconstruct(recording, **options)
    assert "\n" not in str(caught.value)


def test_operations_run_over_a_source_with_its_properties():
    result = engine.run(source(), engine.Normals)
    options = {"tilt": TILT, "zenith_gain": SETUP.slope, "zenith_offset": SETUP.offset, "header": HEADER}
    alike(result, engine.estimate_normals(frames(), PHASE, **options))
    assert (result.process["operation"], result.process["tilt"]) == ("Normals", TILT)
    assert (result.process["zenith_gain"], result.process["turns"]) == (SETUP.slope, TURNS)
    wave = engine.run(source(), engine.Correlate(window_frames=8))
    np.testing.assert_array_equal(wave.cosine, engine.correlate(frames()[-8:], PHASE[-8:]).cosine)
    last = engine.run(source(), engine.Normals(window_frames=8, noise=20.0))
    alike(last, engine.estimate_normals(frames()[-8:], PHASE[-8:], noise=20.0, **options))
    with pytest.raises(io.InputError, match="tilt is missing"):
        engine.run(source(replace(HEADER, tilt=None)), engine.Normals)
    with pytest.raises(io.InputError, match="window have no weights"):
        engine.run(
            frames(),
            engine.Normals(window_frames=8, **options),
            phase=PHASE,
            frame_weights=np.ones(len(PHASE)),
        )


@pytest.mark.parametrize("kind", [engine.Normals, engine.Correlate])
def test_a_stack_that_stays_valid_may_be_followed_by_other_frames(kind):
    options = {"tilt": TILT, "zenith_gain": SETUP.slope, "zenith_offset": SETUP.offset}
    operation = kind(**options) if kind is engine.Normals else kind()
    blocks = [
        io.Block(frames()[part], part[0], phase=PHASE[part], stays_valid=True)
        for part in np.split(np.arange(len(PHASE)), [12, 17])
    ]
    whole, copied = (engine.Run(Plan(operation, checked=False), source()) for _ in range(2))
    whole.push_block(blocks[0])
    first = whole.result()
    alike(whole.result(), first)
    assert whole.staging_buffer.shape[1:] == SHAPE
    for block in blocks[1:]:
        whole.push_block(replace(block, stays_valid=False))
    copied.push(frames(), phase=PHASE)
    alike(whole.result(), copied.result())


def test_steps_may_follow_any_operation():
    recording = source(OF_A_SURFACE)
    operation = engine.Normals(window_frames=24, noise=20.0).configured_for(recording)
    result = engine.Run(Plan(operation, [Edges(), Integration()]), recording).complete()
    whole = reconstruct(OF_A_SURFACE, noise=20.0)
    assert np.median(np.abs(result.height - whole.height)) < 0.002
    assert (result.edges.shape, result.offset_unknown.tolist()) == (SHAPE, [1])


def test_slopes_may_be_kept_instead_of_heights():
    recording = source(OF_A_SURFACE)
    plan = engine.Rotation(noise=20.0, blur=0.0).slope_plan(recording)
    result, slopes = take_slopes(engine.Run(plan, recording).complete())
    whole = reconstruct(OF_A_SURFACE, noise=20.0)
    assert set(whole) - set(result) == {"height", "height_sigma", "component", "offset_unknown"}
    pixel = OF_A_SURFACE.pixel_size
    surface = engine.integrate(
        slopes.dz_dx, slopes.dz_dy, pixel, mask=slopes.defined, slope_weights=slopes.weights
    )
    np.testing.assert_allclose(surface.height, whole.height, atol=1e-4)


def test_heights_may_be_a_map_a_result_or_a_file(tmp_path):
    io.save_result(io.Result(height=FLAT), tmp_path / "flat.h5")
    heights = reconstruct(OF_A_SURFACE, heights=FLAT)
    alike(reconstruct(OF_A_SURFACE, heights=io.Result(height=FLAT)), heights)
    alike(reconstruct(OF_A_SURFACE, heights={"height": FLAT}), heights)
    alike(reconstruct(OF_A_SURFACE, heights=tmp_path / "flat.h5"), heights)
    relative = io.Result(
        height=FLAT, component=np.zeros(SHAPE, np.int32), offset_unknown=np.ones(1, np.uint8)
    )
    with pytest.raises(io.InputError, match="no height is a number"):
        reconstruct(OF_A_SURFACE, heights=relative)
