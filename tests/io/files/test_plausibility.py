"""The plausibility report: it contains an expert's doubts about the numbers, and no others."""

import cv2
import numpy as np
import pytest

from mirrorskin import io
from mirrorskin.twin import Camera, Twin, Vertical

SHAPE, PIXEL, STEP = (60, 80), 0.1, 0.05
TRAVEL = STEP * np.arange(30)
PHASE = 2 * np.pi * np.arange(24) / 24


def gap():
    """Distance of a ball of 20 mm from the sheet, mm."""
    x, y = io.pixel_axes(SHAPE, (PIXEL, PIXEL))
    return 10 - np.sqrt(np.maximum(100 - x**2 - y[:, np.newaxis] ** 2, 0))


def noisy(brightness, noise=1.0):
    counts = brightness + np.random.default_rng(1).normal(0, noise, brightness.shape)
    return np.clip(np.rint(counts), 0, 255).astype(np.uint8)


def pressed():
    """Brightness of a press: the sheet turns light where the ball touches it."""
    above = TRAVEL[:, np.newaxis, np.newaxis] - gap()
    return 20 + 160 * np.clip(above / 0.04 + 0.5, 0, 1)


def turned(phase=PHASE):
    """Brightness of a rotation: a cosine of the phase whose phase and amplitude differ between pixels."""
    x, y = io.pixel_axes(SHAPE, (PIXEL, PIXEL))
    y = y[:, np.newaxis]
    return 90 + 15 * np.hypot(x, y) * np.cos(phase[:, np.newaxis, np.newaxis] - np.arctan2(y, x))


def found(frames, *, pixel_size=(PIXEL, PIXEL), where=None, **series):
    from mirrorskin.io.files.arrays import ArrayRecording

    names = series or {"travel": TRAVEL}
    return io.check(ArrayRecording(frames, names, {"pixel_size": pixel_size}), **(where or {}))


def kinds(check):
    return [finding.kind for finding in check.findings]


@pytest.mark.parametrize(
    ("brightness", "series"),
    [
        (pressed(), {"travel": TRAVEL}),
        (pressed()[::-1], {"travel": TRAVEL[::-1]}),
        (turned(), {"phase": PHASE}),
    ],
    ids=["press", "release", "rotation"],
)
def test_what_is_plausible_has_no_findings(brightness, series):
    assert kinds(found(noisy(brightness), **series)) == []


@pytest.mark.parametrize("factor", [1000, 0.001], ids=["in micrometres", "in metres"])
def test_travel_in_another_unit_is_found(factor):
    assert kinds(found(noisy(pressed()), travel=factor * TRAVEL)) == ["travel"]


@pytest.mark.parametrize("factor", [1000, 0.001])
def test_a_pixel_size_in_another_unit_is_found(factor):
    assert kinds(found(noisy(pressed()), pixel_size=(factor * PIXEL, factor * PIXEL))) == ["field"]


def test_the_limits_can_be_chosen():
    large = {"field_limits": (1.0, 1e6), "travel_limits": (0.1, 1e4)}
    frames, size = noisy(pressed()), (100.0, 100.0)
    assert kinds(found(frames, pixel_size=size, travel=1000 * TRAVEL, where=large)) == []


def onto(depth, travel, noise=1.0):
    """Frames of a press onto an object at some depth below the sheet, mm."""
    above = (travel[:, np.newaxis, np.newaxis] - depth) / 0.02
    return noisy(20 + 160 / (1 + np.exp(-np.clip(above, -500, 500))), noise)


def coordinates():
    x, y = io.pixel_axes(SHAPE, (PIXEL, PIXEL))
    return x, y[:, np.newaxis]


X, Y = coordinates()
OBJECTS = {
    "bowl": (X**2 + Y**2) / 8,
    "cone": 0.6 * np.hypot(X, Y),
    "waves": 0.7 + 0.5 * np.sin(X) * np.cos(Y),
}


@pytest.mark.parametrize("depth", OBJECTS.values(), ids=OBJECTS)
@pytest.mark.parametrize("noise", [0.0, 3.0])
def test_a_travel_that_is_implausible_on_its_field_is_found(depth, noise):
    frames = onto(depth, TRAVEL, noise)
    assert kinds(found(frames)) == []
    for where in ({"travel": 10 * TRAVEL}, {"pixel_size": (PIXEL / 10, PIXEL / 10), "travel": TRAVEL}):
        (finding,) = found(frames, **where).findings
        assert finding.kind == "steep slopes"
        assert "degrees typical, which no sheet follows: are both in mm?" in finding.text
    assert kinds(found(frames[::-1].copy(), travel=10 * TRAVEL[::-1])) == ["steep slopes"]


@pytest.mark.parametrize(
    "depth", [0 * X + 0 * Y + 0.5, 0.2 + 0.5 * (X > 0) + 0 * Y, 0.01 * (X**2 + Y**2) + 0.3]
)
def test_a_flat_object_shows_nothing_of_the_units(depth):
    assert kinds(found(onto(depth, TRAVEL), travel=10 * TRAVEL)) == []


def test_heights_of_neighbours_that_do_not_agree_show_nothing_of_the_units():
    depth = np.random.default_rng(2).uniform(0.1, 1.3, SHAPE)
    assert kinds(found(onto(depth, TRAVEL), travel=10 * TRAVEL)) == []


def test_slopes_without_a_pixel_size_are_unknown():
    assert kinds(found(onto(OBJECTS["bowl"], TRAVEL), travel=10 * TRAVEL, pixel_size=None)) == []


@pytest.mark.parametrize(
    ("travel", "expected"),
    [
        (TRAVEL, "0 to 1.45 mm, 0.05 mm a frame"),
        (TRAVEL[::-1], "1.45 to 0 mm, 0.05 mm a frame"),
        (np.concatenate([TRAVEL[::2], TRAVEL[1::2][::-1]]), "0 to 1.45 to 0.05 mm, about 0.1 mm a frame"),
        (np.abs(TRAVEL - 0.5), "0.5 to 0 to 0.95 mm, 0.05 mm a frame"),
    ],
    ids=["press", "release", "stroke", "release and press"],
)
def test_the_range_of_the_travel_is_that_of_all_frames(travel, expected):
    assert found(noisy(pressed()), travel=travel).facts["travel"] == expected


def turn_on(slope_x, slope_y, phase=PHASE, noise=1.0):
    """Frames of a rotation, of which the zenith and azimuth of slopes determine mean and phase."""
    steep, azimuth = np.hypot(slope_x, slope_y), np.arctan2(slope_y, slope_x)
    return noisy(60 + 80 * np.arctan(steep) + 15 * np.cos(phase[:, np.newaxis, np.newaxis] - azimuth), noise)


SURFACES = {
    "saddle": (Y + 0 * X + 0.03, X + 0 * Y + 0.02),
    "cone": (0.5 * X / np.hypot(X, Y), 0.5 * Y / np.hypot(X, Y)),
    "waves": (np.cos(X + Y), np.cos(X + Y) + 0.3),
}
SCALE = {"zenith_offset": 60.0, "zenith_gain": 80.0}


DIRECTIONS = {"slopes": SCALE, "directions": {}}


def turned_kinds(frames, sign, header):
    from mirrorskin.io.files.arrays import ArrayRecording

    return kinds(io.check(ArrayRecording(frames, {"phase": sign * PHASE}, header)))


@pytest.mark.parametrize("name", SURFACES)
@pytest.mark.parametrize("known", DIRECTIONS)
def test_a_reversed_turn_is_found(name, known):
    frames, header = turn_on(*SURFACES[name]), {"pixel_size": (PIXEL, PIXEL), **DIRECTIONS[known]}
    unknown = (name, known) == ("waves", "directions")
    assert turned_kinds(frames, 1, header) == []
    assert turned_kinds(frames, -1, header) == ([] if unknown else ["mirrored"])


FLAT = 0 * X + 0 * Y


@pytest.mark.parametrize(
    "slopes", [(FLAT + 0.3, FLAT + 0.2), (FLAT + np.cos(X), FLAT + 0.1)], ids=["plane", "ridges"]
)
def test_a_surface_in_a_mirror_may_be_another_surface(slopes):
    header = {"pixel_size": (PIXEL, PIXEL), **SCALE}
    assert [turned_kinds(turn_on(*slopes), sign, header) for sign in (1, -1)] == [[], []]


def test_phases_in_degrees_are_found():
    assert kinds(found(noisy(turned()), phase=np.degrees(PHASE)))[0] == "phases"


def test_frames_in_reverse_order_are_found():
    (finding,) = found(noisy(pressed()[::-1])).findings
    assert finding.kind == "reversed"
    assert "--event release" in finding.text


def test_a_rotation_with_travels_is_not_a_press():
    brightness = turned(2 * np.pi * np.arange(30) / 30)
    assert kinds(found(noisy(brightness))) == ["not a press"]


def test_a_press_and_its_release_return():
    target = np.concatenate([pressed()[::2], pressed()[::-2]])
    assert kinds(found(noisy(target), travel=np.concatenate([TRAVEL[::2], TRAVEL[::2][::-1]]))) == []


def test_a_press_with_phases_is_not_a_rotation():
    assert kinds(found(noisy(pressed()), phase=2 * np.pi * np.arange(30) / 30)) == ["not a rotation"]


def test_axes_in_the_order_of_matlab_are_found():
    rows = np.repeat(pressed(), 2, axis=2)[:, :, :150]
    stack = np.moveaxis(noisy(np.repeat(rows, 3, axis=1)), 0, -1)  # (H, W, T)
    assert "axes" in kinds(found(stack, travel=STEP * np.arange(len(stack))))


ORDERS = [(1, 2, 0), (1, 0, 2), (2, 1, 0), (2, 0, 1)]


def off_centre(shape=(40, 48, 64), noise=1.0):
    """Frames of a press on a bowl whose centre is not in the middle, which reaches all sides."""
    x, y = io.pixel_axes(shape[1:], (3.2 / shape[2], 2.4 / shape[1]))
    depth = (x - 0.4) ** 2 / 4 + (y[:, np.newaxis] + 0.2) ** 2 / 2 + 0.3
    above = (1.95 * np.linspace(0, 1, shape[0])[:, np.newaxis, np.newaxis] - depth) / 0.01
    return noisy(20 + 180 / (1 + np.exp(-np.clip(above, -500, 500))), noise)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize(
    "frames",
    [noisy(pressed()), off_centre(), off_centre(noise=0.0), off_centre((60, 120, 160)), off_centre()[::-1]],
    ids=["ball", "off-centre", "without noise", "large", "release"],
)
def test_other_orders_of_the_axes_of_a_press_are_found(frames, order):
    stack = np.transpose(frames, order)
    assert kinds(found(stack, travel=STEP * np.arange(len(stack)))) == ["axes"]


@pytest.mark.parametrize("frames", [off_centre(), off_centre(noise=0.0), off_centre((60, 120, 160))])
@pytest.mark.parametrize("order", [(0, 1, 2), (0, 2, 1)])
def test_the_order_of_the_axes_of_a_press_is_recognised(frames, order):
    stack = np.transpose(frames, order)
    assert kinds(found(stack, travel=STEP * np.arange(len(stack)))) == []


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("frames", [8, 24, 48])
def test_other_orders_of_the_axes_of_a_turn_are_found(frames, order):
    stack = np.transpose(noisy(turned(2 * np.pi * np.arange(frames) / frames)), order)
    assert "axes" in kinds(found(stack, phase=2 * np.pi * np.arange(len(stack)) / len(stack)))


def test_a_wedge_in_reverse_order_may_have_other_axes():
    """Brightness of a wedge changes once along its slope, too."""
    depth = 0.2 + 0.1 * np.arange(SHAPE[1]) * np.ones((SHAPE[0], 1)) / 8
    above = (TRAVEL[:, np.newaxis, np.newaxis] - depth) / 0.04
    wedge = noisy(20 + 160 * np.clip(above + 0.5, 0, 1))
    assert kinds(found(wedge)) == []
    (finding,) = found(wedge[::-1].copy()).findings
    assert finding.text.endswith("(--event release), or is the order of the axes not (T, H, W)?")


def test_a_frame_that_is_there_twice_is_found():
    frames = noisy(pressed())
    frames[12] = frames[11]
    (finding,) = found(frames).findings
    assert finding.kind == "repeated frames"
    assert finding.text.startswith("frame 12: identical to the one before")


def test_frames_that_came_late_are_found_if_positions_were_computed():
    time = np.arange(30) / 30
    time[20:] += 2 / 30
    source = Timed(noisy(pressed()), TRAVEL, time)
    (finding,) = io.check(source).findings
    assert finding.text.startswith("frame 20 came late, as if 2 frames were missing")


def test_frames_that_came_late_are_no_matter_if_positions_were_measured():
    time = np.arange(30) / 30
    time[20:] += 2 / 30
    travel = TRAVEL + np.random.default_rng(0).normal(0, 0.002, 30)
    travel[20:] += 2 * STEP
    assert kinds(io.check(Timed(noisy(pressed()), np.sort(travel), time))) == []


def jumped(steps, count=24):
    """Phases of a rotation of which frames were lost, or one is there twice, before frame 10."""
    return np.where(np.arange(count) >= 10, PHASE + steps * PHASE[1], PHASE)


@pytest.mark.parametrize(("fraction", "expected"), [(0.01, ["outliers"]), (0.001, [])])
def test_outlying_samples_of_a_press_are_found(fraction, expected):
    generator, frames = np.random.default_rng(2), noisy(pressed())
    wrong = generator.random(frames.shape) < fraction
    frames[wrong] = generator.integers(0, 256, np.count_nonzero(wrong))
    assert kinds(found(frames)) == expected


def test_a_frame_that_is_brighter_than_its_neighbours_has_no_outliers():
    lamp = np.where(np.arange(30) == 15, 1.2, 1)[:, np.newaxis, np.newaxis]
    assert kinds(found(noisy(pressed() * lamp))) == ["flicker"]


@pytest.mark.parametrize(
    ("steps", "text"),
    [
        (1, "from frame 10 on, the brightness fits phases 15 degrees further, as if a frame before it was"),
        (2, "from frame 10 on, the brightness fits phases 30 degrees further, as if 2 frames before it were"),
        (-1, "from frame 10 on, the brightness fits phases 15 degrees back, as if a frame before it was"),
    ],
)
def test_a_lost_frame_of_a_rotation_is_found_by_the_brightness(steps, text):
    (finding,) = found(noisy(turned(jumped(steps))), phase=PHASE).findings
    assert (finding.kind, finding.text[: len(text)]) == ("phase jump", text)


def test_phases_that_are_measured_may_jump():
    assert kinds(found(noisy(turned(jumped(1))), phase=jumped(1))) == []


def test_phases_are_not_judged_by_pixels_that_all_respond_alike():
    counts = np.broadcast_to(90 + 30 * np.cos(jumped(1))[:, np.newaxis, np.newaxis], (24, *SHAPE))
    assert kinds(found(noisy(counts), phase=PHASE)) == []


def test_lost_frames_are_a_note():
    source = Timed(noisy(pressed()), TRAVEL, np.arange(30) / 30)
    source.dropped = np.eye(30, dtype=np.int32)[7]
    check = io.check(source)
    assert (kinds(check), check.warnings) == (["lost frames"], ())


def test_flicker_is_found():
    lamp = 1 + np.random.default_rng(3).normal(0, 0.03, 30)
    assert kinds(found(noisy(pressed() * lamp[:, np.newaxis, np.newaxis]))) == ["flicker"]


def test_flicker_of_a_rotation_is_found():
    lamp = 1 + np.random.default_rng(3).normal(0, 0.03, 24)
    assert kinds(found(noisy(turned() * lamp[:, np.newaxis, np.newaxis]), phase=PHASE)) == ["flicker"]


def test_a_dark_level_that_drifts_is_found():
    drift = np.linspace(0, 8, 30)[:, np.newaxis, np.newaxis]
    far = np.pad(pressed(), ((0, 0), (20, 20), (20, 20)), constant_values=20)
    assert kinds(found(noisy(far + drift))) == ["drift"]


def test_brightness_that_drifts_during_a_rotation_is_found():
    drift = np.linspace(0, 6, 24)[:, np.newaxis, np.newaxis]
    assert kinds(found(noisy(turned() + drift), phase=PHASE)) == ["drift"]


def test_light_beyond_the_scale_is_found():
    assert kinds(found(noisy(1.6 * pressed()))) == ["cut off"]


def rising(amplitude, noise=0.0, width=0.08):
    """Brightness of a press of 12 bits that rises smoothly, before it is cut off."""
    above = (TRAVEL[:, np.newaxis, np.newaxis] - gap()) / width
    light = 200 + amplitude / (1 + np.exp(-np.clip(above, -500, 500)))
    return light + np.random.default_rng(4).normal(0, noise, light.shape)


def stored(light, top=4095):
    return np.clip(np.rint(light), 0, top).astype(np.uint16)


def corrected(light, dark_noise=20.0, flat_noise=0.05):
    """Samples less a dark frame, over a flat one: each pixel has an end of its own."""
    generator = np.random.default_rng(5)
    dark = generator.normal(150, dark_noise, SHAPE)
    return ((light - dark) / (1 + flat_noise * generator.normal(size=SHAPE))).astype(np.float32)


PACKINGS = {
    "12 bits": lambda light: stored(light),
    "12 in the upper bits": lambda light: stored(light) << 4,
    "10 in the upper bits": lambda light: stored(light) >> 2 << 6,
    "14 in the upper bits": lambda light: stored(light) << 2 << 2,
    "12 bits, scaled": lambda light: (stored(light) / 4095).astype(np.float32),
    "12 bits, of a sensor that is full before": lambda light: stored(light, 3800),
    "8 bits, of a sensor that is full before": lambda light: (stored(light, 3800) >> 4).astype(np.uint8),
    "scaled, of a sensor that is full before": lambda light: (stored(light, 3800) * 0.01).astype(np.float32),
}


@pytest.mark.parametrize("noise", [0.0, 1.0, 12.0])
@pytest.mark.parametrize("pack", PACKINGS.values(), ids=PACKINGS)
def test_saturated_samples_are_found_whatever_their_end(pack, noise):
    report = found(pack(rising(6500, noise)))
    assert kinds(report) == ["cut off"]
    assert report.facts["cut off"] == "100 % of the pixels reach the end of the scale"
    assert "cut off" not in kinds(found(pack(rising(3000, noise))))


@pytest.mark.parametrize("noise", [2.0, 12.0])
@pytest.mark.parametrize("flat_noise", [0.0, 0.05])
def test_saturated_samples_are_found_after_a_correction_of_each_pixel(noise, flat_noise):
    assert "cut off" in kinds(found(corrected(stored(rising(6500, noise)), flat_noise=flat_noise)))
    assert "cut off" not in kinds(found(corrected(stored(rising(3000, noise)), flat_noise=flat_noise)))


@pytest.mark.parametrize("width", [0.002, 0.01, 0.03, 0.08, 0.2])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_frames_without_noise_that_reach_their_light_are_not_saturated(width, dtype):
    scale = 1 / 16 if dtype is np.uint8 else 1.0
    light = (
        np.rint(scale * rising(3000, width=width)) if dtype is not np.float32 else rising(3000, width=width)
    )
    assert "cut off" not in kinds(found(light.astype(dtype)))
    assert "cut off" not in kinds(found((light / light.max()).astype(np.float32)))


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_an_edge_of_brightness_itself_is_not_saturation(noise):
    assert "cut off" not in kinds(found(noisy(pressed(), noise)))
    assert "cut off" not in kinds(found(noisy(np.where(pressed() > 100, 180, 20), noise)))


@pytest.mark.parametrize(
    ("pack", "expected"),
    [
        (lambda light: np.clip(light, 0, 1023).astype(np.uint16) << 6, True),
        (lambda light: np.clip(light, 0, 700), True),
        (lambda light: light, False),
        (lambda light: light.astype(np.uint16) << 4, False),
    ],
)
def test_saturation_of_a_rotation_is_found(pack, expected):
    light = np.rint(noisy(turned(), 1.0).astype(float) * 8)
    samples = pack(light)
    samples = samples if samples.dtype == np.uint16 else samples.astype(np.float32)
    assert ("cut off" in kinds(found(samples, phase=PHASE))) is expected


@pytest.mark.parametrize("level", [20.0, 200.0])
def test_frames_that_never_change_are_found(level):
    assert kinds(found(noisy(np.full((30, *SHAPE), level)))) == ["no response"]


@pytest.mark.parametrize(
    ("frames", "bits"),
    [
        (noisy(pressed()).astype(np.uint16) * 16, "(12 bits in use, the lowest 4 of them 0)"),
        (noisy(pressed()).astype(np.uint16) * 20 + 1, "(12 bits in use)"),
    ],
)
def test_the_bits_in_use_are_a_fact(frames, bits):
    assert found(frames).facts["brightness"].endswith(bits)


def test_what_was_found_at_an_import_stays_in_the_recording(tmp_path):
    source = Timed(noisy(pressed()), TRAVEL, np.arange(30) / 30)
    source.findings = (io.Finding("lossy", "the frames were compressed"), io.Finding("grey", "a note", False))
    with io.Recorder(source, tmp_path / "rec.h5") as recorder:
        recorder.drain(lambda finished: None)
    with io.open_recording(tmp_path / "rec.h5") as recording:
        assert recording.findings == source.findings
    assert io.describe(tmp_path / "rec.h5")["finding: lossy"] == "the frames were compressed"


def as_jpeg(frames, quality):
    settings = [cv2.IMWRITE_JPEG_QUALITY, quality]
    encoded = [cv2.imencode(".jpg", frame, settings)[1] for frame in frames]
    return np.stack([np.asarray(cv2.imdecode(jpeg, cv2.IMREAD_GRAYSCALE)) for jpeg in encoded])


SQUARES = 0.5 + 0.5 * (np.add.outer(np.arange(60) // 8, np.arange(80) // 8) % 2)
LIT = {"a press": (pressed, "travel", TRAVEL), "a turn": (turned, "phase", PHASE)}


@pytest.mark.parametrize("quality", [75, 90, 95])
@pytest.mark.parametrize("part", [np.s_[:], np.s_[:, 3:, 5:]], ids=["whole", "cropped"])
@pytest.mark.parametrize(("light", "name", "positions"), LIT.values(), ids=LIT)
def test_frames_of_an_array_that_were_jpeg_have_a_finding(light, name, positions, part, quality):
    frames = as_jpeg(noisy(light(), 1.4), quality)[part]
    assert "lossy compression" in kinds(found(frames, **{name: positions}))


@pytest.mark.parametrize("noise", [0.0, 0.4, 1.4, 4.0])
@pytest.mark.parametrize(("light", "name", "positions"), LIT.values(), ids=LIT)
def test_frames_that_were_not_compressed_have_no_such_finding(light, name, positions, noise):
    frames = noisy(light(), noise)
    twice = frames.repeat(2, axis=1).repeat(2, axis=2)
    binned = frames.reshape(len(frames), 30, 2, 40, 2).mean(axis=(2, 4)).astype(np.uint8)
    for each in (frames, noisy(light() * SQUARES, noise), twice, binned, frames // 8 * 8):
        assert "lossy compression" not in kinds(found(each, **{name: positions}))


@pytest.mark.parametrize(("shape", "pixel", "frames"), [((96, 128), 0.05, 3), ((120, 160), 0.04, 5)])
def test_a_periodic_texture_in_few_frames_is_no_compression(shape, pixel, frames):
    travel = np.linspace(0.0, 0.6, frames)
    scene = {"object": "texture", "shape": shape, "pixel_size": pixel, "pattern": "linear"}
    press = Twin(movement=Vertical(travel), camera=Camera(seed=1), references="ball", **scene)
    assert "lossy compression" not in kinds(io.check(press))


def test_few_pixels_contain_no_information():
    assert kinds(found(np.zeros((5, 3, 4), np.uint8), travel=TRAVEL[:5])) == []


def test_pixels_that_are_unknown_are_left_out():
    frames = pressed().astype(np.float32)
    frames[3, 10:20] = np.nan
    frames += np.random.default_rng(0).normal(0, 1, frames.shape).astype(np.float32)
    assert kinds(found(frames)) == []


def test_the_report_is_printed_line_by_line():
    lines = str(found(noisy(pressed()), travel=1000 * TRAVEL)).splitlines()
    assert lines[1] == "frames      30 of 80 x 60, uint8"
    assert lines[-1].startswith("warning: the travel is 1450 mm in all")


def test_a_path_is_opened_with_what_is_given(tmp_path):
    np.save(tmp_path / "press.npy", noisy(pressed()))
    check = io.check(tmp_path / "press.npy", travel=TRAVEL, pixel_size=(0.1, 0.1))
    assert check.facts["field"] == "8 x 6 mm, 0.1 x 0.1 mm a pixel"


def test_what_belongs_to_the_opening_is_refused_for_an_open_source():
    from mirrorskin.io.files.arrays import ArrayRecording

    source = ArrayRecording(noisy(pressed()), {"travel": TRAVEL}, {})
    with pytest.raises(io.InputError, match=r"is open: give pixel_size to io\.open_recording"):
        io.check(source, pixel_size=(0.1, 0.1))


class Timed:
    """A source of an array with times."""

    rewindable, name, motion, header = True, "timed", "vertical", io.Header("vertical")
    dropped = None

    def __init__(self, frames, travel, time):
        self._frames, self._travel, self._time = frames, travel, time
        self.shape, self.dtype = frames.shape, frames.dtype
        self.rewind()

    def __enter__(self):
        return self

    def __exit__(self, *error):
        pass

    def rewind(self):
        self._left = True

    def read(self, out=None, /):
        if not self._left:
            return None
        self._left = False
        return io.Block(self._frames, 0, time=self._time, travel=self._travel)
