"""All numbers of a height map, of surfaces whose numbers are known in closed form."""

import numpy as np
import pytest
from height_maps import cap, places, result_of

from mirrorskin import engine, io
from mirrorskin.engine import metrology
from mirrorskin.io.model.maps import IN_PIXELS

NAN = np.nan
SHAPE, SIZE = (211, 207), (0.03, 0.03)
RADIUS, WIDTH = 5.0, 2.5
SAG = RADIUS - np.sqrt(RADIUS**2 - WIDTH**2)


def values(result, **options):
    return {name: quantity.value for name, quantity in engine.measure(result, **options).quantities.items()}


@pytest.fixture(scope="module")
def ball():
    """A cap that touches the rest plane with its top."""
    return result_of(cap(SHAPE, SIZE, RADIUS, WIDTH), SIZE, sigma=0.001)


def test_a_cap_has_the_numbers_of_its_closed_form(ball):
    measured = values(ball)
    volume = np.pi * SAG**2 * (3 * RADIUS - SAG) / 3
    assert measured["highest point"] == pytest.approx(0, abs=1e-3 * SAG)
    assert measured["lowest point"] == pytest.approx(-SAG, abs=5e-3 * SAG)  # a pixel lies within the rim
    assert measured["height range"] == pytest.approx(SAG, rel=5e-3)
    assert measured["rim height"] == pytest.approx(-SAG, rel=2e-2)
    assert measured["height above rim"] == pytest.approx(SAG, rel=2e-2)
    assert measured["measured area"] == pytest.approx(np.pi * WIDTH**2, rel=1e-3)
    assert "contact area" not in measured
    assert measured["volume above rim"] == pytest.approx(
        volume - (measured["rim height"] + SAG) * np.pi * WIDTH**2, rel=1e-3
    )
    # Here the rim counts, whose pixels are in or out as a whole.
    assert measured["volume below rest plane"] == pytest.approx(np.pi * WIDTH**2 * SAG - volume, rel=2e-3)
    assert measured["sphere radius"] == pytest.approx(RADIUS, rel=1e-6)
    assert measured["Sq"] == pytest.approx(0, abs=1e-3)


def test_a_paraboloid_has_the_volume_of_its_closed_form():
    shape = 90, 121
    size = 3.0 / shape[0], 4.0 / shape[1]  # millimetres up and across
    x, y = places(shape, size[::-1])
    measured = values(result_of(0.5 - (x**2 + y**2) / 40, size[::-1]), form="plane")
    assert measured["highest point"] == pytest.approx(0.5, rel=1e-3)
    assert measured["measured area"] == pytest.approx(12)
    bend = (3**2 + 4**2) / 12 / 40  # the mean of x^2 + y^2 over a rectangle of a x b is (a^2 + b^2) / 12
    assert measured["volume below rest plane"] == pytest.approx(-12 * (0.5 - bend), rel=1e-3)
    assert "sphere radius" not in measured


def test_the_surface_in_contact_is_that_of_the_normals(ball):
    x, y = places(SHAPE, SIZE)
    up = np.sqrt(np.maximum(RADIUS**2 - x**2 - y**2, 0.1)) / RADIUS
    normals = np.stack([x / RADIUS, y / RADIUS, up], axis=-1).astype(np.float32)
    normals[np.isnan(ball.height)] = NAN
    measured = engine.measure(
        ball.assign(normals=normals, normals_sigma=np.full(SHAPE, 1e-3, np.float32))
    ).quantities["measured surface area"]
    assert measured.value == pytest.approx(2 * np.pi * RADIUS * SAG, rel=1e-3)
    assert 0.5e-3 < measured.sigma / measured.value < 1e-2
    assert "measured surface area" not in engine.measure(ball).quantities


def test_a_map_of_contact_gives_the_contact_area(ball):
    x, y = places(SHAPE, SIZE)
    contact = (x**2 + y**2 < 4).astype(np.uint8)
    quantities = engine.measure(ball.assign(contact=contact)).quantities
    assert quantities["contact area"].value == pytest.approx(4 * np.pi, rel=1e-3)
    # Half a pixel all around: a tenth of it to one side, and independently in each pixel of the border.
    border = 4 * np.pi / 0.03
    edge = 0.5 * 0.03**2 / np.sqrt(3) * np.hypot(np.sqrt(border), 0.1 * border)
    assert quantities["contact area"].sigma == pytest.approx(edge, rel=0.15)
    assert quantities["measured area"].value == pytest.approx(np.pi * WIDTH**2, rel=1e-3)


def test_uncertainties_of_volumes_are_those_of_their_errors(ball):
    sure, unsure = (engine.measure(result_of(ball.height, SIZE, sigma=s)).quantities for s in (1e-6, 0.01))
    name = "volume below rest plane"
    border = 2 * np.pi * WIDTH / 0.03
    edge = 0.5 * 0.03**2 / np.sqrt(3) * np.hypot(np.sqrt(border), 0.1 * border) * SAG
    area = sure["measured area"].value
    assert sure[name].sigma == pytest.approx(edge, rel=0.15)
    assert sure[name].sigma < unsure[name].sigma < 0.1 * np.hypot(sure[name].sigma, 0.01 * area)
    slopes = engine.measure(result_of(ball.height, SIZE, sigma=0.01), noise_length=np.inf).quantities
    assert slopes[name].sigma == pytest.approx(np.hypot(sure[name].sigma, 0.01 * area), rel=1e-3)
    lifted = engine.measure(result_of(ball.height + 0.01, SIZE, sigma=0.01)).quantities
    assert lifted[name].value == pytest.approx(unsure[name].value - 0.01 * area)


@pytest.mark.parametrize("step", [0.0, 0.01])
def test_uncertainties_of_sums_and_forms_are_their_scatter(step):
    """Heights of a cap with independent noise, and of a press in steps of the travel."""
    clean, size, errors = cap((61, 61), (0.05, 0.05), RADIUS, 1.4), (0.05, 0.05), []
    sigma = max(0.003, step / np.sqrt(12))
    names = "sphere radius", "volume below rest plane", "rim height"
    true = engine.measure(result_of(clean, size, sigma=1e-6)).quantities
    for seed in range(24):
        rng = np.random.default_rng(seed)
        heights = clean + (rng.normal(0, 0.003, clean.shape) if step == 0 else 0.0)
        if step:
            start = rng.uniform(0, step)
            heights = step * np.round((heights - start) / step) + start
        measured = engine.measure(result_of(heights, size, sigma=sigma)).quantities
        errors.append([(measured[name].value - true[name].value, measured[name].sigma) for name in names])
    error, stated = np.moveaxis(errors, 2, 0)
    ratio = np.sqrt(np.mean(stated**2, axis=0) / np.mean(error**2, axis=0))
    # The error of the border is in that of the volume, but not in this scatter; a rim may be of one step.
    assert np.all((ratio > 0.7) & (ratio < [2.5, 9, 7])), ratio


def test_the_highest_point_is_not_the_one_with_the_largest_error():
    rng = np.random.default_rng(2)
    clean = cap((61, 61), (0.05, 0.05), RADIUS, 1.4)
    pulls, largest = [], []
    for _ in range(40):
        noisy = clean + rng.normal(0, 0.01, clean.shape)
        highest = engine.measure(result_of(noisy, (0.05, 0.05), sigma=0.01), form="none").quantities[
            "highest point"
        ]
        pulls.append(highest.value / highest.sigma)
        largest.append(np.nanmax(noisy))
    assert np.mean(np.abs(pulls) < 2) >= 0.95
    assert abs(np.mean(pulls)) < 0.6
    assert np.mean(largest) > 0.015


def test_the_lowest_of_many_noisy_pixels_is_known_to_be_too_low():
    noisy = np.random.default_rng(3).normal(0, 0.01, (80, 80))
    lowest = engine.measure(result_of(noisy, sigma=0.01)).quantities["lowest point"]
    assert abs(lowest.value) < 2 * lowest.sigma


def test_filled_heights_are_measured_separately(ball):
    filled = np.asarray(ball.height > -0.1).astype(np.uint8)
    sigma = np.where(filled, np.float32(NAN), ball.height_sigma)
    part = engine.measure(ball.assign(filled=filled, height_sigma=sigma))
    whole, measured = engine.measure(ball).quantities, part.quantities
    for name in ("measured area", "volume above rim", "volume below rest plane"):
        assert measured[f"{name} with filled"].value == pytest.approx(whole[name].value)
        assert abs(measured[name].value) < abs(whole[name].value)
        assert np.isfinite(measured[name].sigma)
    assert np.isnan(measured["volume above rim with filled"].sigma)
    # What a press fills it touched, or else surrounded: nobody knows.
    pressed = engine.measure(ball.assign(filled=filled, height_sigma=sigma, fitted=io.Fitted(event="onset")))
    assert pressed.quantities["contact area with filled"] == whole["measured area"]
    assert not {"contact area", "contact area with filled"} & set(measured)
    contact = np.isfinite(ball.height).astype(np.uint8)
    sure = ball.assign(filled=filled, height_sigma=sigma, contact=contact)
    assert engine.measure(sure).quantities["contact area"] == whole["measured area"]
    assert measured["highest point"].value < -0.09
    assert measured["highest point with filled"].value == pytest.approx(0, abs=1e-4)
    assert measured["height above rim with filled"].value == pytest.approx(
        whole["height above rim"].value, abs=1e-3
    )
    assert any(note.startswith("the top was filled, not measured") for note in part.notes)
    assert measured["sphere radius"].value == pytest.approx(RADIUS, rel=1e-6)
    assert f"pixels filled, not measured, that count only in what says 'filled': {filled.sum()}" in part.notes


def test_the_form_is_the_sphere_where_it_leaves_much_less(ball):
    x, _ = places((30, 40), (0.1, 0.1))
    assert "sphere radius" in values(ball)
    assert "plane tilt" in values(result_of(0.3 * x))
    rough = np.random.default_rng(12).normal(0, 0.01, x.shape)
    assert "plane tilt" in values(result_of(0.3 * x + rough))  # a huge sphere fits no worse
    assert "plane tilt" in values(ball, form="plane")
    assert not any("plane " in name and "rest" not in name for name in values(ball, form="none"))
    spoilt = ball.height.copy()
    spoilt[105, 75:85] = 1.0
    notes = engine.measure(result_of(spoilt, SIZE, sigma=0.001)).notes
    assert "outliers left out of the fit of the sphere, but not of its residual: 10" in notes


def test_roughness_is_that_from_the_form(ball):
    x, _ = places(SHAPE, SIZE)
    wave = 0.002 * np.cos(2 * np.pi * x / 0.2)
    measured = values(result_of(ball.height + wave, SIZE))
    assert measured["Sq"] == pytest.approx(2 * np.sqrt(0.5 * (1 - WIDTH**2 / (2 * RADIUS**2))), rel=1e-2)
    filtered = engine.measure(result_of(ball.height + wave, SIZE), l_filter=0.4)
    assert filtered.quantities["Sq"].value == pytest.approx(measured["Sq"] * (1 - 0.5**4), rel=0.02)
    assert any("L-filter 0.4 mm" in note for note in filtered.notes)
    assert not any(note.startswith("pixels left out of texture") for note in filtered.notes)


def test_a_region_is_measured_alone(ball):
    region = io.Region((80, 140), (60, 150))
    measured = values(ball, region=region)
    assert measured["measured area"] == pytest.approx(60 * 90 * SIZE[0] * SIZE[1])
    assert measured["sphere radius"] == pytest.approx(RADIUS, rel=1e-5)
    assert "rim height" not in measured
    assert any("border" in note for note in engine.measure(ball, region=region).notes)
    with pytest.raises(io.InputError, match="--region: a region of rows 0 to 500"):
        engine.measure(ball, region=io.Region((0, 500), (0, 10)))


def components(unknown):
    """Two components: a level one of 6 x 20 pixels at 1 mm, and one of 6 x 10 at 5 mm."""
    height = np.full((20, 20), NAN)
    component = np.full((20, 20), -1, np.int32)
    height[2:8], component[2:8] = 1.0, 0
    height[10:16, :10], component[10:16, :10] = 5.0, 1
    return result_of(height, component=component, offset_unknown=np.array(unknown, np.uint8))


def test_components_whose_height_is_relative_are_not_compared_with_others():
    both, second, largest = (engine.measure(components(unknown)) for unknown in ([0, 0], [0, 1], [1, 1]))
    assert both.quantities["height range"].value == pytest.approx(4)
    assert second.quantities["height range"].value == 0
    assert second.quantities["highest point"].value == 1
    assert "components left out, whose height is only relative: 1" in second.notes
    assert largest.quantities["measured area"].value == pytest.approx(1.2)
    assert "volume below rest plane" not in largest.quantities
    assert largest.notes[0] == "heights are relative: their zero is arbitrary"
    assert largest.notes[1].startswith("only the largest of 2 components")


def test_what_the_pixel_size_is_known_by_goes_into_all_that_depends_on_it(ball):
    lens = io.Lens(SIZE, np.eye(3), np.zeros(5), np.eye(3), SHAPE, 0.1, 0.01)
    plain = engine.measure(ball)
    with_lens = engine.measure(ball.assign(calibration=io.Calibration(camera=None, lens=lens)))
    for name, power in {
        "measured area": 2,
        "sphere radius": 2,
        "sphere centre z": 2,
        "sphere centre x": 1,
        "highest point": 0,
    }.items():
        before, after = (quantities.quantities[name] for quantities in (plain, with_lens))
        assert after.sigma == pytest.approx(np.hypot(before.sigma, power * 0.01 * before.value), rel=1e-3)
    assert any("known within 1 %" in note for note in with_lens.notes)
    assert any("taken as exact" in note for note in plain.notes)


def test_a_section_compares_no_heights_of_relative_components():
    ends = (-0.7, -0.85), (-0.7, 0.95)
    assert engine.measure(components([0, 0]), section=ends).quantities["height difference"].value == -4
    alone = engine.measure(components([1, 1]), section=ends)
    assert alone.quantities["height difference"].value == 0
    assert any(note.startswith("section: an end has no measured height") for note in alone.notes)


def notes_of_fit(height, form, sigma=0.001):
    result = result_of(height, (0.1, 0.1), sigma=sigma)
    return [note for note in engine.measure(result, form=form).notes if "within its errors" in note]


def test_a_form_that_does_not_fit_is_reported():
    shape = 51, 57
    clean = cap(shape, (0.1, 0.1), RADIUS, WIDTH)
    noisy = clean + np.random.default_rng(5).normal(0, 0.001, shape)
    x, y = places(shape, (0.1, 0.1))
    bent = noisy + 0.008 * np.cos(3 * x) * np.cos(3 * y)
    assert notes_of_fit(clean, "sphere") == notes_of_fit(noisy, "sphere") == []
    for form, unlike in {"sphere": bent, "plane": clean}.items():
        (note,) = notes_of_fit(unlike, form)
        assert note.startswith(f"the surface is no {form} within its errors")
        assert notes_of_fit(unlike, form, sigma=None) == []  # which nobody knows


def test_uncertain_pixels_count_neither_as_lowest_nor_as_rough():
    rng = np.random.default_rng(7)
    height = rng.normal(0, 0.001, (40, 50))
    sigma = np.full((40, 50), 0.001, np.float32)
    height[5:7, 30], sigma[5:7, 30] = -0.8, 0.4
    measured = engine.measure(result_of(height, height_sigma=sigma), form="plane")
    assert measured.quantities["lowest point"].value > -0.005
    assert measured.quantities["Sz"].value < 10
    assert "pixels left out of texture and lowest point, far less certain than others: 2" in measured.notes
    sure = engine.measure(result_of(height, sigma=0.001), form="plane").quantities
    assert sure["lowest point"].value == pytest.approx(-0.8)
    assert sure["Sz"].value > 800


def test_heights_without_a_standard_deviation_are_left_out_and_that_is_reported():
    height = np.zeros((9, 9))
    height[4, 4:6] = 3.0
    sigma = np.where(height > 0, NAN, 0.01).astype(np.float32)
    measured = engine.measure(result_of(height, height_sigma=sigma))
    assert measured.quantities["highest point"].value == 0
    assert "pixels left out, whose height has no standard deviation: 2" in measured.notes


@pytest.mark.parametrize(("shape", "sigma"), [((1, 9), None), ((2, 2), 0.0)])
def test_tiny_pictures_of_all_equal_heights_are_measured(shape, sigma):
    quantities = engine.measure(result_of(np.full(shape, -0.5), sigma=sigma)).quantities
    assert (
        quantities["highest point"].value
        == quantities["lowest point"].value
        == quantities["median height"].value
        == -0.5
    )
    assert quantities["Sz"].value == pytest.approx(0, abs=1e-9)
    assert quantities["measured area"].value == pytest.approx(np.prod(shape) * 0.01)
    assert quantities["volume below rest plane"].value == pytest.approx(np.prod(shape) * 0.005)


def test_without_standard_deviations_uncertainties_of_heights_are_unknown(ball):
    for sigma in (None, NAN):
        measured = engine.measure(result_of(ball.height, SIZE, sigma=sigma))
        for name in ("highest point", "lowest point", "volume above rim", "Sq"):
            assert np.isnan(measured.quantities[name].sigma)
        assert np.isfinite(measured.quantities["sphere radius"].sigma)
        assert any("no standard deviations" in note for note in measured.notes)


def test_what_cannot_be_measured_is_refused_in_a_line(ball):
    refused = {
        "has no heights": io.Result(azimuth=np.zeros((3, 3), np.float32)),
        "maps of 2 turns": io.Result(height=np.zeros((2, 3, 3), np.float32)),
        "no pixel size: .*--pixel-size": ball.assign(x=None, y=None),
        "no height was measured": result_of(np.full((3, 3), NAN)),
        "no height was measured there": result_of(np.zeros((3, 3)), filled=np.ones((3, 3), np.uint8)),
        "a single pixel": result_of(np.zeros((1, 1))),
    }
    for message, result in refused.items():
        with pytest.raises(io.InputError, match=message) as caught:
            engine.measure(result)
        assert "\n" not in str(caught.value)
    with pytest.raises(io.InputError, match="no sphere fits"):
        engine.measure(result_of(np.zeros((9, 9))), form="sphere")


@pytest.fixture(scope="module")
def ball_in_pixels(ball):
    """The cap of a picture whose pixel size is unknown."""
    maps = {name: np.asarray(ball[name]) / np.float32(SIZE[0]) for name in ("height", "height_sigma")}
    return io.Result(maps, declarations=IN_PIXELS)


def test_lengths_are_in_pixels_where_the_pixel_size_is_unknown(ball, ball_in_pixels):
    along, scaled = (engine.measure(result).quantities for result in (ball_in_pixels, ball))
    assert {quantity.unit for quantity in along.values()} == {"px", "px2", "px3", "px3/px2", "", "deg", "%"}
    assert along["sphere radius"].value == pytest.approx(RADIUS / SIZE[0], rel=1e-5)
    assert along["measured area"].value == pytest.approx(scaled["measured area"].value / SIZE[0] ** 2)
    assert metrology.Quantity(20.0, 1.0, "ml/m2").in_pixels().value == pytest.approx(0.02)  # 20 µm


def test_a_pixel_size_turns_pixels_into_millimetres(ball, ball_in_pixels):
    measured = values(ball_in_pixels, pixel_size=SIZE[0])
    assert measured["sphere radius"] == pytest.approx(values(ball)["sphere radius"], rel=1e-5)
    with pytest.raises(io.InputError, match="square pixels"):
        engine.measure(ball_in_pixels, pixel_size=(0.03, 0.04))


@pytest.mark.parametrize(
    ("name", "length"),
    [("l_filter", 0.8), ("section", ((0, 0), (1, 0))), ("mask", [metrology.Levels(above=0.0)])],
)
def test_lengths_in_millimetres_are_refused_where_the_pixel_size_is_unknown(ball_in_pixels, name, length):
    with pytest.raises(io.InputError, match=f"{name} is in mm, and the heights are in pixels"):
        engine.measure(ball_in_pixels, **{name: length})


def test_a_table_has_lengths_in_one_unit(ball, ball_in_pixels):
    table = metrology.table({"first": ball_in_pixels, "second": ball})
    assert table.unit("highest point") == "px"
    assert "lengths are in mm, those of the results before in px" in table.rows[1].problem
    whole = metrology.table({"first": ball_in_pixels, "second": ball}, pixel_size=SIZE[0])
    assert [row.problem for row in whole.rows] == ["", ""]
    with pytest.raises(io.InputError, match="px and mm"):
        metrology.subtract(ball_in_pixels, ball)
