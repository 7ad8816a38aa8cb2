"""Frames and maps on a device: the same answers as for arrays on the host, and no copies in between."""

import numpy as np
import pyopencl as cl
import pyopencl.array
import pytest

from mirrorskin import engine, io
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.errors import DeviceMemoryError

SHAPE, FRAMES = (60, 75), 16
LARGER = 8, 8  # times the shape, so that samples of a map are few
# Bytes per pixel of larger pictures: tables of frames; a map's samples; a solver's flags and partial sums.
TABLES, SAMPLES, STATE = 0.1, 4 * 72_100 / 288_000, 6
RANDOM = np.random.default_rng(1)
PRESS = RANDOM.normal(np.where(np.arange(FRAMES) < 9, 30, 200)[:, None, None], 2, (FRAMES, *SHAPE)).astype(
    np.uint8
)
TRAVEL, PHASE = 0.1 * np.arange(FRAMES), 2 * np.pi / 8 * np.arange(FRAMES)
WAVE = 10 * np.cos(PHASE - 0.5)[:, None, None]
TURNS = RANDOM.normal(100 + WAVE, 1, (FRAMES, *SHAPE)).astype(np.uint8)
LEVELS = {"dark": 30, "bright": 200}
SENSOR = {"tilt": 0.05, "zenith_gain": 200}
SLOPES = RANDOM.normal(0, 0.1, (2, *SHAPE)).astype(np.float32)
NORMALS = np.dstack([-SLOPES[0], -SLOPES[1], np.ones(SHAPE)]).astype(np.float32)
MASK = np.ones(SHAPE, np.uint8)
MASK[:20, :30] = 0
HOLE = SLOPES.copy()
HOLE[:, 30, 40] = np.nan
MAPS_OF_A_FIT = {"mean", "cosine", "sine", "residual"}

ON_FRAMES = {
    "onset": (engine.find_onset, PRESS, TRAVEL, LEVELS, {"height", "status", "frame"}),
    "levels of scatter": (
        engine.find_onset,
        PRESS,
        TRAVEL,
        LEVELS | {"dark_sigma": 1.0},
        {"height", "status", "frame"},
    ),
    "change point": (engine.find_change_point, PRESS, TRAVEL, LEVELS, {"height"}),
    "change point, no levels": (engine.find_change_point, PRESS, TRAVEL, {}, {"height"}),
    "correlation": (engine.correlate, TURNS, PHASE, {}, MAPS_OF_A_FIT),
    "weights": (
        engine.correlate,
        TURNS,
        PHASE,
        {"frame_weights": np.linspace(0.5, 1, FRAMES)},
        MAPS_OF_A_FIT,
    ),
    "window": (engine.correlate, TURNS, PHASE, {"window_frames": 8}, set()),
    "normals": (
        *(engine.estimate_normals, TURNS, PHASE, SENSOR),
        MAPS_OF_A_FIT | {"normals", "normals_sigma", "contact"},
    ),
    "each turn": (engine.estimate_normals, TURNS, PHASE, SENSOR | {"per_turn": True}, set()),
    "a missing frame": (
        *(engine.estimate_normals, TURNS, PHASE, SENSOR | {"frame_weights": np.arange(FRAMES) != 3}),
        set(),
    ),
    "fringes": (
        *(engine.optical.fit_fringes, TURNS, PHASE, {}),
        {"phase", "phase_sigma", "mean", "modulation", "residual"},
    ),
    "focus": (engine.optical.find_focus, PRESS, TRAVEL, {"noise": 2.0}, {"height", "status", "sharpness"}),
    "lamps": (
        *(engine.optical.photometric_stereo, TURNS, PHASE, {"zenith": 0.7}),
        {"normals", "albedo", "residual", "samples", "normals_sigma", "albedo_sigma"},
    ),
}
INTEGRATED = {
    "slopes": ({"dz_dx": SLOPES[0], "dz_dy": SLOPES[1]}, {}),
    "within a mask": ({"dz_dx": SLOPES[0], "dz_dy": SLOPES[1]}, {"mask": MASK}),
    "a slope is missing": ({"dz_dx": HOLE[0], "dz_dy": HOLE[1]}, {}),
    "normals": ({"normals": NORMALS}, {"mask": MASK}),
    "weight": ({"normals": NORMALS}, {"slope_weights": 100.0}),
}


def ours(device, values):
    return device.from_host("given", values, values.dtype)


def of_pyopencl(device, values):
    return pyopencl.array.to_device(device.queue, np.ascontiguousarray(values))


def copies(device, call):
    """Return bytes per pixel that go up and down in a call that is made again, and what it returns."""
    call()
    device.finish()
    device.profile.clear()
    result = call()
    records = device.profile.records()
    up, down = (sum(item.bytes for item in records if item.kind == kind) for kind in ("upload", "download"))
    return up / 288_000, down / 288_000, result


@pytest.mark.parametrize("put", [ours, of_pyopencl])
@pytest.mark.parametrize("name", ON_FRAMES)
def test_frames_on_the_device_give_the_same_maps(device, name, put):
    function, frames, positions, options, stay = ON_FRAMES[name]
    expected = function(frames, positions, **options, device=device)
    result = function(put(device, frames), positions, **options, device=device)
    assert {key for key in result if result.on_device(key) is not None} == stay
    assert list(result) == list(expected)
    assert {**result.process, "date": ""} == {**expected.process, "date": ""}
    for key in stay:
        np.testing.assert_array_equal(result.on_device(key).read(), expected[key], err_msg=key)
    for key in expected:
        np.testing.assert_array_equal(result[key], expected[key], err_msg=key)


@pytest.mark.parametrize("put", [ours, of_pyopencl])
@pytest.mark.parametrize("name", INTEGRATED)
def test_slopes_and_normals_on_the_device_give_the_same_heights(device, name, put):
    maps, options = INTEGRATED[name]
    expected = engine.integrate(**maps, pixel_size=0.1, **options, device=device)
    placed = {key: put(device, np.ascontiguousarray(values)) for key, values in maps.items()}
    surface = engine.integrate(**placed, pixel_size=0.1, **options, device=device)
    assert isinstance(surface.on_device("height"), Array)
    # The kernel may divide by one unit of float32 differently than NumPy.
    np.testing.assert_allclose(surface.height, expected.height, atol=1e-6)
    np.testing.assert_allclose(surface.height_sigma, expected.height_sigma, rtol=1e-4)
    np.testing.assert_array_equal(surface.component, expected.component)


@pytest.mark.parametrize("name", ["robust", "known_heights", "slope_weights"])
def test_what_is_solved_from_maps_on_the_host_takes_arrays_on_the_device(device, name):
    placed = {
        "robust": True,
        "known_heights": np.where(RANDOM.random(SHAPE) < 0.01, 1.0, np.nan),
        "slope_weights": RANDOM.uniform(50, 100, SHAPE),
    }
    options = {name: placed[name], "pixel_size": 0.1, "device": device}
    expected = engine.integrate(normals=NORMALS, **options)
    surface = engine.integrate(normals=ours(device, NORMALS), **options)
    np.testing.assert_array_equal(surface.height, expected.height)


def test_edges_of_normals_on_the_device_stay_there(device):
    maps = NORMALS / np.linalg.norm(NORMALS, axis=2, keepdims=True), np.full(SHAPE, 0.01, np.float32), MASK
    expected = engine.find_edges(*maps, device=device)
    edges = engine.find_edges(*(ours(device, values) for values in maps))
    assert expected.any()
    assert isinstance(edges, Array)
    np.testing.assert_array_equal(np.asarray(edges), expected)


@pytest.mark.parametrize("name", ["onset", "change point", "correlation", "normals"])
def test_frames_on_a_card_are_not_copied_and_maps_only_when_they_are_used_or_checked(card, name):
    function, frames, positions, options, stay = ON_FRAMES[name]
    options = options | {"noise": 1.0} if name != "correlation" else options
    placed = ours(card, np.tile(frames, (1, *LARGER)))
    up, down, result = copies(card, lambda: function(placed, positions, **options))
    # What checks look at; status and frame of a change-point are completed on the host.
    few = {"onset": 1, "change point": 7, "correlation": 0, "normals": 8}[name]
    assert up < TABLES
    assert down < few + SAMPLES
    card.profile.clear()
    used = result[max(stay)]
    down = sum(record.bytes for record in card.profile.records() if record.kind == "download")
    assert down in (0, used.nbytes)  # 0: it was computed on the host
    assert used is result[max(stay)]


def test_a_chain_from_frames_to_heights_copies_only_what_checks_look_at(card):
    frames = ours(card, np.tile(TURNS, (1, *LARGER)))

    def chain():
        result = engine.estimate_normals(frames, PHASE, **SENSOR, noise=1.0)
        normals, sigma, contact = map(result.on_device, ("normals", "normals_sigma", "contact"))
        surface = engine.integrate(normals=normals, pixel_size=0.1, sigma=False)
        return surface.on_device("height"), engine.find_edges(normals, sigma, contact)

    up, down, (height, edges) = copies(card, chain)
    assert height.shape == edges.shape == (480, 600)
    assert up < TABLES
    assert down < 8 + 3 * SAMPLES + STATE


def test_an_operation_that_takes_none_gets_numpy_arrays(device):
    class Last(engine.Operation):
        last = io.Map("last frame", "counts")

        def push(self, frames):
            assert type(frames) is np.ndarray
            self.frame = frames[-1]

        def result(self):
            return {"last": self.frame}

    np.testing.assert_array_equal(engine.run(ours(device, PRESS), Last())["last"], PRESS[-1])


def textures(dtype, larger=(1, 1)):
    """Return a texture, and frames in which it moves by a pixel each time."""
    texture = np.tile(RANDOM.normal(100, 20, SHAPE), larger).astype(dtype)
    return texture, np.stack([np.roll(texture, n, axis=1) for n in (1, 2)])


@pytest.mark.parametrize("put", [ours, of_pyopencl])
@pytest.mark.parametrize("dtype", ["uint8", "float32"])
def test_displacements_of_frames_on_the_device_stay_there(device, put, dtype):
    texture, moved = textures(dtype)
    expected = engine.slip.find_displacement(texture, moved, 0.1, device=device)
    slip = engine.slip.find_displacement(put(device, texture), put(device, moved), 0.1)
    assert {name for name in slip if slip.on_device(name) is not None} == set(slip) - {"status"}
    for name, values in expected.items():
        np.testing.assert_array_equal(slip[name], values, err_msg=name, strict=True)


def test_a_step_beyond_the_texture_s_grain_is_found_on_the_device(device):
    texture = np.kron(RANDOM.normal(100, 20, (15, 18)), np.ones((4, 4))).astype(np.float32)
    moved = np.roll(texture, 11, axis=1)[None]
    expected, slip = (
        engine.slip.find_displacement(put(texture), put(moved), 0.1, noise=1.0, device=device).displacement
        for put in (np.asarray, lambda values: ours(device, values))
    )
    np.testing.assert_array_equal(slip, expected)


def test_frames_of_a_texture_on_a_card_are_not_copied_and_displacements_only_when_they_are_used(card):
    texture, moved = textures("uint8", LARGER)
    up, down, expected = copies(card, lambda: engine.slip.find_displacement(texture, moved, 0.1, device=card))
    placed = ours(card, texture), ours(card, moved)
    fewer_up, fewer_down, slip = copies(card, lambda: engine.slip.find_displacement(*placed, 0.1))
    assert up - fewer_up == pytest.approx(len(moved) + 1)
    assert down - fewer_down == pytest.approx(2 * 8 * len(moved))
    np.testing.assert_array_equal(slip.displacement, expected.displacement)


def surfaces(shape):
    """Return maps of a wavy surface, and of the same one when it has moved."""
    y, x = np.indices(shape) * 0.05
    for shift in (0.0, 0.02):
        z = 0.3 * np.sin(2 * (x - shift)) * np.cos(1.3 * y)
        across, up = (np.gradient(z, 0.05, axis=axis) for axis in (1, 0))
        normals = np.dstack([-across, up, np.ones(shape)])
        normals /= np.linalg.norm(normals, axis=2, keepdims=True)
        sigma = np.full(shape, 0.01)
        maps = {"height": z, "height_sigma": 0.1 * sigma, "normals": normals, "normals_sigma": sigma}
        maps = {name: values.astype(np.float32) for name, values in maps.items()}
        yield maps | {"contact": (RANDOM.random(shape) < 0.999).astype(np.uint8)}


@pytest.mark.parametrize("put", [ours, of_pyopencl])
@pytest.mark.parametrize(
    "names", [{"height", "height_sigma"}, {"normals", "normals_sigma"}, {"contact"}, None]
)
def test_maps_on_the_device_give_the_same_motion(device, put, names):
    pair = [*surfaces(SHAPE)]
    expected = engine.pose.estimate_pose(*pair, 0.05, device=device)
    placed = [
        {
            name: put(device, values) if names is None or name in names else values
            for name, values in maps.items()
        }
        for maps in pair
    ]
    motion = engine.pose.estimate_pose(*placed, 0.05)
    np.testing.assert_array_equal(motion.translation, expected.translation)
    np.testing.assert_array_equal(motion.covariance, expected.covariance)


def test_maps_of_other_types_on_the_device_give_the_same_motion(device):
    pair = [{name: values.astype(np.float64) for name, values in maps.items()} for maps in surfaces(SHAPE)]
    expected = engine.pose.estimate_pose(*pair, 0.05, device=device)
    placed = [{name: ours(device, values) for name, values in maps.items()} for maps in pair]
    motion = engine.pose.estimate_pose(*placed, 0.05)
    np.testing.assert_array_equal(motion.translation, expected.translation)


def test_maps_on_a_card_are_not_copied_for_a_motion(card):
    shape = SHAPE[0] * LARGER[0], SHAPE[1] * LARGER[1]
    placed = [{name: ours(card, values) for name, values in maps.items()} for maps in surfaces(shape)]
    up, _, motion = copies(card, lambda: engine.pose.estimate_pose(*placed, 0.05))
    assert up < TABLES
    np.testing.assert_allclose(motion.translation, [0.02, 0, 0], atol=1e-3)


def test_a_surface_is_fused_on_the_device_of_its_maps_which_are_copied_once(card):
    maps = next(surfaces(SHAPE))
    heights, normals = (
        {name: values for name, values in maps.items() if name.startswith(kind)}
        for kind in ("height", "normal")
    )
    up, down, expected = copies(card, lambda: engine.fuse(heights, normals, 0.05, device=card))
    placed = [{name: ours(card, values) for name, values in kind.items()} for kind in (heights, normals)]
    same_up, more_down, fused = copies(card, lambda: engine.fuse(*placed, 0.05))
    assert same_up == up
    nbytes = sum(values.nbytes for kind in (heights, normals) for values in kind.values())
    assert more_down - down == pytest.approx(nbytes / 288_000)
    np.testing.assert_array_equal(fused.height, expected.height)


def test_a_result_keeps_maps_on_the_device_when_others_are_assigned(device):
    fit = engine.correlate(ours(device, TURNS), PHASE)
    changed = fit.assign(mean=None, sine=np.zeros(SHAPE))
    assert changed.on_device("sine") is changed.on_device("mean") is None
    assert changed.on_device("cosine") is fit.on_device("cosine")


def test_an_array_on_another_device_is_refused(device, card):
    with pytest.raises(
        io.InputError, match=r"given is on .*, not on .*: compute there, or pass a NumPy array"
    ):
        engine.correlate(ours(device, TURNS), PHASE, device=card)
    with pytest.raises(io.InputError, match="given is on"):
        engine.integrate(ours(device, SLOPES[0]), ours(card, SLOPES[1]), 0.1)


def test_an_array_of_another_context_is_refused(device):
    queue = cl.CommandQueue(cl.Context([device.context.devices[0]]))
    with pytest.raises(io.InputError, match="frames belongs to an OpenCL context that is not mirrorskin's"):
        engine.correlate(pyopencl.array.to_device(queue, TURNS), PHASE)


def test_an_array_out_of_order_is_refused(device):
    with pytest.raises(
        io.InputError, match=r"frames is uint8 \(16, 75, 60\) on a device: numbers in C order"
    ):
        engine.correlate(of_pyopencl(device, TURNS).transpose((0, 2, 1)), PHASE)


@pytest.mark.parametrize(
    ("slopes", "message"),
    [
        ((SLOPES[0], SLOPES[1].astype(np.float64)), r"float64 \(60, 75\): two maps of slopes \(H, W\)"),
        ((SLOPES[0], np.ascontiguousarray(SLOPES[1][:9])), r"float32 \(9, 75\): two maps of slopes"),
    ],
    ids=["type", "shape"],
)
def test_slopes_that_cannot_be_used_are_refused(device, slopes, message):
    with pytest.raises(io.InputError, match=message):
        engine.integrate(*(ours(device, values) for values in slopes), 0.1)


def test_slopes_and_normals_at_once_are_refused(device):
    slopes = [ours(device, slope) for slope in SLOPES]
    with pytest.raises(io.InputError, match="both slopes and normals are given: leave one of the two out"):
        engine.integrate(*slopes, 0.1, normals=ours(device, NORMALS))


def test_a_slope_on_the_host_next_to_one_on_the_device_is_refused(device):
    with pytest.raises(io.InputError, match="two maps of slopes"):
        engine.integrate(ours(device, SLOPES[0]), SLOPES[1], 0.1)


def test_frames_without_room_for_maps_next_to_them_are_refused(card, monkeypatch):
    frames = ours(card, PRESS)
    monkeypatch.setattr(card, "max_allocation", 4 * PRESS[0].size)
    with pytest.raises(
        DeviceMemoryError, match="has no memory for maps besides 16 frames: pass the frames as a"
    ):
        engine.find_onset(frames, TRAVEL, **LEVELS)
