import boards
import cv2
import numpy as np
import pytest

from mirrorskin.engine.base.undistort import picture_places, undistort
from mirrorskin.io import Fitted, InputError, Lens, Result, pixel_axes

SIZES = [(1, 1), (1, 9), (7, 11), (33, 20)]
BENT = (-0.12, 0.03, 0.002, -0.003, 0.0)


def lens_of(view):
    """The lens that sees what a view does."""
    rows, columns = view.shape
    matrix = np.array([[view.focal, 0, (columns - 1) / 2], [0, view.focal, (rows - 1) / 2], [0, 0, 1]])
    camera = np.linalg.inv(matrix @ view.plane())
    return Lens((view.scale, view.scale), camera, np.array(view.distortion), matrix, view.shape, 0.0)


def plain(shape, scale=0.03):
    return lens_of(boards.View(shape=shape, scale=scale))


def bent(shape, scale=0.03):
    focal = np.hypot(*shape) / 2 + 1
    return lens_of(boards.View(shape, scale, focal, tilt=8.0, towards=40.0, distortion=BENT))


def maps_of(shape, turns=(), seed=0):
    """All maps that there are, random, with holes."""
    random = np.random.default_rng(seed)
    size = (*turns, *shape)

    def floats(holes=0.2):
        values = random.standard_normal(size).astype(np.float32)
        values[random.random(size) < holes] = np.nan
        values[random.random(size) < 0.1] = -0.0
        return values

    normals = random.standard_normal((*size, 3))
    normals[..., 2] = abs(normals[..., 2]) + 0.2
    normals = (normals / np.linalg.norm(normals, axis=-1, keepdims=True)).astype(np.float32)
    normals[random.random(size) < 0.2] = np.nan
    x, y, z = np.moveaxis(normals, -1, 0)
    names = ["height", "height_sigma", "normals_sigma", "mean", "cosine", "sine", "modulation", "residual"]
    labels = {
        name: random.integers(0, 3, size).astype(np.uint8)
        for name in ("status", "edges", "filled", "contact")
    }
    return Result(
        **{name: floats() for name in names},
        **labels,
        normals=normals,
        zenith=np.arctan2(np.hypot(x, y), z),
        azimuth=np.arctan2(y, x),
        component=random.integers(-1, 3, size).astype(np.int32),
        offset_unknown=np.array([1, 0, 1], np.uint8),
    )


@pytest.mark.parametrize("turns", [(), (3,)])
@pytest.mark.parametrize("shape", SIZES)
def test_a_lens_that_does_nothing_changes_no_bit(shape, turns):
    result = maps_of(shape, turns)
    same = undistort(result, plain(shape))
    for name, values in result.maps().items():
        undistorted = same.maps()[name]
        assert (undistorted.dtype, undistorted.shape) == (values.dtype, values.shape)
        assert undistorted.tobytes() == values.tobytes(), name
    assert same.offset_unknown is result.offset_unknown


def test_a_smooth_map_comes_back_to_the_error_of_interpolation():
    view = boards.View((121, 157), 0.05, 110.0, tilt=10.0, towards=30.0, distortion=BENT)
    x, y = view.sheet(*np.meshgrid(np.arange(157.0), np.arange(121.0)))
    wave = 2.0  # 1/mm
    undistorted = undistort(Result(height=np.sin(wave * x + y).astype(np.float32)), lens_of(view))
    there_x, there_y = np.meshgrid(undistorted.x, undistorted.y)
    off = abs(undistorted.height - np.sin(wave * there_x + there_y))
    column, row = places_of(view)
    between = (column > 0) & (column < 156) & (row > 0) & (row < 120)
    assert between.mean() > 0.8
    # An eighth of the second derivative along each axis, of pixels up to half as large again as the nominal.
    assert off[between].max() < (wave**2 + 1) / 8 * (1.5 * view.scale) ** 2


def by_hand(values, column, row, apart=None):
    """One place of a map: the mean of the four pixels around that count."""
    rows, columns = values.shape
    near = int(np.floor(row + 0.5)), int(np.floor(column + 0.5))
    if not (0 <= near[0] < rows and 0 <= near[1] < columns) or np.isnan(values[near]):
        return np.nan
    total = weight_sum = 0.0
    for i in (int(np.floor(row)), int(np.floor(row)) + 1):
        for j in (int(np.floor(column)), int(np.floor(column)) + 1):
            if not (0 <= i < rows and 0 <= j < columns) or np.isnan(values[i, j]):
                continue
            if apart is not None and apart[i, j] != apart[near]:
                continue
            weight = (1 - abs(row - i)) * (1 - abs(column - j))
            total, weight_sum = total + weight * values[i, j], weight_sum + weight
    return total / weight_sum


def places_of(view):
    x, y = pixel_axes(view.shape, (view.scale, view.scale))
    return view.place(*np.meshgrid(x, y))


@pytest.mark.parametrize(
    ("name", "apart"), [("height", "component"), ("mean", "contact"), ("sine", "contact")]
)
def test_numbers_are_means_of_what_counts(name, apart):
    shape = (23, 31)
    view = boards.View(shape, 0.03, np.hypot(*shape) / 2 + 1, tilt=8.0, towards=40.0, distortion=BENT)
    result = maps_of(shape)
    undistorted = undistort(result, lens_of(view)).maps()[name]
    column, row = places_of(view)
    values, labels = result.maps()[name], result.maps()[apart]
    expected = np.array([by_hand(values, c, r, labels) for c, r in zip(column.flat, row.flat, strict=True)])
    assert np.isnan(expected).any()
    np.testing.assert_allclose(undistorted.ravel(), expected, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("name", ["status", "edges", "filled", "contact", "component"])
def test_labels_are_those_of_the_nearest_pixel(name):
    shape = (23, 31)
    view = boards.View(shape, 0.03, 40.0, tilt=8.0, towards=40.0, distortion=BENT)
    result = maps_of(shape)
    column, row = (np.floor(place + 0.5).astype(int) for place in places_of(view))
    inside = (column >= 0) & (column < 31) & (row >= 0) & (row < 23)
    nearest = result.maps()[name][np.clip(row, 0, 22), np.clip(column, 0, 30)]
    expected = np.where(inside, nearest, -1 if name == "component" else 0)
    assert not inside.all()
    np.testing.assert_array_equal(undistort(result, lens_of(view)).maps()[name], expected)


def test_the_lens_is_that_of_opencv():
    lens = bent((41, 57), 0.02)
    x, y = np.meshgrid(*pixel_axes((41, 57), (0.02, 0.02)))
    # Any plane before the camera will do that is seen as the sheet is.
    rays = np.linalg.solve(lens.camera @ lens.matrix, np.stack([x, y, np.ones_like(x)]).reshape(3, -1)).T
    truth = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), lens.matrix, lens.distortion)[0].reshape(-1, 2)
    column, row = picture_places(lens, x, y)
    np.testing.assert_allclose(column.ravel(), truth[:, 0], atol=1e-9)
    np.testing.assert_allclose(row.ravel(), truth[:, 1], atol=1e-9)


def test_no_answer_does_not_creep():
    shape = (31, 37)
    height = np.ones(shape, np.float32)
    height[10:20, 12:25] = np.nan
    view = boards.View(shape, 0.03, 40.0, distortion=BENT)
    column, row = (np.floor(place + 0.5).astype(int) for place in places_of(view))
    hole = (row >= 10) & (row < 20) & (column >= 12) & (column < 25)
    outside = (row < 0) | (row >= 31) | (column < 0) | (column >= 37)
    undistorted = undistort(Result(height=height), lens_of(view)).height
    np.testing.assert_array_equal(np.isnan(undistorted), hole | outside)


def test_normals_stay_unit_and_their_angles_fit():
    undistorted = undistort(maps_of((33, 47)), bent((33, 47)))
    x, y, z = np.moveaxis(undistorted.normals.astype(np.float64), -1, 0)
    valid = np.isfinite(z)
    assert 0.3 < valid.mean() < 0.95
    np.testing.assert_allclose(np.sqrt(x**2 + y**2 + z**2)[valid], 1, atol=2e-7)
    np.testing.assert_allclose(undistorted.zenith, np.arctan2(np.hypot(x, y), z), atol=1e-6)
    np.testing.assert_allclose(undistorted.azimuth, np.arctan2(y, x), atol=1e-5)


def test_azimuths_are_interpolated_the_short_way_round():
    shape = (9, 11)
    azimuth = np.where(np.arange(11) % 2, 3.1, -3.1).astype(np.float32)
    undistorted = undistort(Result(azimuth=np.broadcast_to(azimuth, shape).copy()), bent(shape)).azimuth
    assert np.isfinite(undistorted).sum() > 30
    assert np.nanmin(abs(undistorted)) > 3.09


def test_no_standard_deviation_is_too_small():
    shape = (31, 37)
    random = np.random.default_rng(3)
    samples = [
        undistort(Result(height=random.standard_normal(shape).astype(np.float32)), bent(shape)).height
        for _ in range(150)
    ]
    sigma = undistort(Result(height_sigma=np.ones(shape, np.float32)), bent(shape)).height_sigma
    inside = np.isfinite(sigma)
    assert (np.std(samples, axis=0)[inside] < 1.25 * sigma[inside]).all()  # six standard errors


def test_each_turn_is_undistorted_as_if_alone():
    result, lens = maps_of((17, 21), (3,)), bent((17, 21))
    undistorted = undistort(result, lens)
    for turn in range(3):
        alone = result.assign({name: values[turn] for name, values in result.maps().items()})
        for name, values in undistort(alone, lens).maps().items():
            np.testing.assert_array_equal(undistorted.maps()[name][turn], values)


@pytest.mark.parametrize("stated", [True, False])
def test_a_part_of_the_picture_is_that_part_of_the_map(stated):
    shape, top, first_column = (41, 57), 9, 15
    result = maps_of(shape).assign(component=None, contact=None)
    part = slice(top, 30), slice(first_column, 49)
    fitted = Fitted(source_region=(top, top + 21, first_column, first_column + 34) if stated else None)
    cropped = result.assign({name: values[part] for name, values in result.maps().items()}, fitted=fitted)
    whole = undistort(result, bent(shape))
    undistorted = undistort(cropped, bent(shape), None if stated else (top, first_column))
    np.testing.assert_array_equal(undistorted.x, whole.x[part[1]])
    np.testing.assert_array_equal(undistorted.y, whole.y[part[0]])
    inside = slice(4, -4), slice(4, -4)
    assert np.isfinite(undistorted.height[inside]).mean() > 0.5
    for name in ("height", "normals", "azimuth", "status"):
        np.testing.assert_array_equal(undistorted.maps()[name][inside], whole.maps()[name][part][inside])


def test_nothing_is_seen_beyond_where_the_model_folds_back():
    view = boards.View((101, 101), 0.05, 60.0, distortion=(-0.5, 0, 0, 0, 0))
    undistorted = undistort(Result(height=np.ones((101, 101), np.float32)), lens_of(view)).height
    x, y = np.meshgrid(*pixel_axes((101, 101), (0.05, 0.05)))
    radius = np.hypot(x, y) / (0.05 * 60.0)
    assert np.isnan(undistorted[radius > np.sqrt(2 / 3) + 1e-9]).all()
    assert np.isfinite(undistorted[radius < np.sqrt(2 / 3) - 0.05]).all()


@pytest.mark.parametrize("origin", [None, (1, 0), (0, 1), (-1, 0)])
def test_maps_of_another_size_are_refused(origin):
    with pytest.raises(InputError, match=r"9 x 8 .*the lens is of"):
        undistort(maps_of((8, 9)), plain((7, 9) if origin is None else (8, 9)), origin)


def test_maps_are_undistorted_once():
    undistorted = undistort(maps_of((8, 9)), plain((8, 9)))
    with pytest.raises(InputError, match="undistorted before"):
        undistort(undistorted, plain((8, 9)))
