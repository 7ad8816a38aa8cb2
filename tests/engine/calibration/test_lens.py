import functools
import math

import boards
import cv2
import numpy as np
import pytest
from scipy import special

from mirrorskin.engine.base.undistort import picture_places
from mirrorskin.engine.calibration.board import Charuco, Dots, paint_board
from mirrorskin.engine.calibration.lens import calibrate_lens, fit_lens
from mirrorskin.engine.calibration.marks import Marks, centre_marks
from mirrorskin.io import InputError

CHARUCO, DOTS = Charuco(7, 5, 2.0, 1.5), Dots(11, 9, 1.0)
PAINT = {CHARUCO: boards.charuco(7, 5, 2.0, 1.5), DOTS: boards.dots(11, 9, 1.0, 0.5)}
POSES = [(10, 0.3, -0.2), (-80, 5.0, 2.0), (170, -4.0, -3.0), (45, 4.0, -2.5), (-20, -4.0, 3.0)]


def left_over(view, lens, reach):
    """How wrong the undistorted map is over a share of it: in scale, and in pixels when laid on the sheet."""
    rows, columns = lens.shape
    x, y = np.meshgrid(
        np.linspace(-1, 1, 15) * reach * (columns - 1) / 2 * lens.pixel_size[0],
        np.linspace(-1, 1, 15) * reach * (rows - 1) / 2 * lens.pixel_size[1],
    )
    column, row = picture_places(lens, x, y)
    inside = (column > 0) & (column < columns - 1) & (row > 0) & (row < rows - 1)
    assert inside.mean() > 0.8
    mine = x[inside] + 1j * y[inside]
    true = np.empty_like(mine)
    true.real, true.imag = view.sheet(column[inside], row[inside])
    mine, true = mine - mine.mean(), true - true.mean()
    turn = np.vdot(mine, true) / np.vdot(mine, mine)
    off = abs(true - turn / abs(turn) * mine) / lens.pixel_size[0]
    return abs(turn) - 1, off.max()


@functools.cache
def picture(view, board, pose=POSES[0], dtype=np.uint8, **how):
    return boards.photograph(view, PAINT[board], pose, dtype=dtype, **how)


BLURRED = boards.View((201, 281), 0.06, 262.0, tilt=15, towards=30, distortion=(-0.2, 0, 0, 0, 0))
WIDE = boards.View((210, 291), 0.057, 275.0, tilt=9, towards=250, distortion=(0.1, 0.0, 0.001, -0.002, 0.0))
CASES = [
    (CHARUCO, BLURRED, {"blur": 1.7, "noise": 3.0}),
    (DOTS, BLURRED, {"blur": 2.0, "noise": 3.0, "dtype": np.uint16}),
    (CHARUCO, WIDE, {"noise": 3.0, "dtype": np.float32}),
    (DOTS, WIDE, {"blur": 1.0, "noise": 3.0, "counts": (210, 30)}),
]


@pytest.mark.parametrize(("board", "view", "how"), CASES)
def test_one_picture_determines_scale_and_distortion(board, view, how):
    fit = calibrate_lens([("a.png", picture(view, board, **how))], board)
    assert fit.marks == (len(board.marks()),)
    assert fit.lens.error < 0.06
    scale, off = left_over(view, fit.lens, 0.65)
    assert abs(scale) < 1e-3
    assert off < 0.1


def marks_of(view, pose, noise, random, board=CHARUCO, name="a"):
    """The marks of a board as a view sees them, with noise; those in the picture."""
    turn, right, up = pose
    x, y = board.marks().T
    c, s = math.cos(math.radians(turn)), math.sin(math.radians(turn))
    places = np.stack(view.place(c * x - s * y + right, s * x + c * y + up), axis=1)
    places += noise * random.standard_normal(places.shape)
    inside = np.all((places > 0) & (places < np.array(view.shape[::-1]) - 1), axis=1)
    return Marks(name, view.shape, board.marks()[inside], places[inside])


def test_several_pictures_determine_the_whole_picture():
    random = np.random.default_rng(5)
    fit = fit_lens([marks_of(BLURRED, pose, 0.03, random) for pose in POSES])
    scale, off = left_over(BLURRED, fit.lens, 0.9)
    assert abs(scale) < 1e-3
    assert off < 0.1


def test_standard_errors_are_true():
    random = np.random.default_rng(7)
    true = fit_lens([marks_of(WIDE, pose, 0, random) for pose in POSES[:2]]).lens.pixel_size[0]
    fits = [fit_lens([marks_of(WIDE, pose, 0.05, random) for pose in POSES[:2]]) for _ in range(12)]
    off = [(fit.lens.pixel_size[0] / true - 1) / fit.lens.scale_sigma for fit in fits]
    # chi^2 of 12: one in a thousand is beyond either.
    assert 0.42 < np.sqrt(np.mean(np.square(off))) < 1.66
    assert 0.04 < np.mean([fit.lens.error for fit in fits]) / math.sqrt(2) < 0.052


def test_a_mark_that_is_wrong_hardly_pulls():
    random = np.random.default_rng(11)
    marks = [marks_of(WIDE, pose, 0.02, random) for pose in POSES]
    marks[0].places[7] += 2.0
    scale, off = left_over(WIDE, fit_lens(marks).lens, 0.9)
    assert abs(scale) < 1e-3
    assert off < 0.1


def test_a_lens_without_perspective_and_distortion_is_found_to_have_none():
    view = boards.View((101, 141), 0.1, 4000.0)
    lens = fit_lens([marks_of(view, POSES[0], 0, np.random.default_rng(0), DOTS)]).lens
    assert lens.pixel_size == pytest.approx((0.1, 0.1), rel=1e-6)
    assert lens.shape == (101, 141)
    column, row = picture_places(lens, [0, 1, 0], [0, 0, 1])
    np.testing.assert_allclose(column, [70, 80, 70], atol=1e-3)
    np.testing.assert_allclose(row, [50, 50, 40], atol=1e-3)


def test_boards_that_are_not_on_one_plane_are_refused():
    random = np.random.default_rng(0)
    flat = boards.View((201, 281), 0.06, 262.0)
    leaning = boards.View((201, 281), 0.06, 262.0, tilt=10.0)
    marks = [marks_of(flat, POSES[0], 0.02, random), marks_of(leaning, POSES[2], 0.02, random, name="b")]
    with pytest.raises(InputError, match=r"does not fit a flat board.*lay the board flat"):
        fit_lens(marks)


def chessboard(column, row, angle, shear, blur):
    """A blurred corner of a chessboard at a place, not square; each pixel taken at its middle."""
    across, down = np.meshgrid(np.arange(41.0) - column, np.arange(41.0) - row)
    first = math.cos(angle) * across + math.sin(angle) * down
    second = math.cos(angle + shear) * down - math.sin(angle + shear) * across
    return 128 + 90 * special.erf(first / blur) * special.erf(second / blur)


@pytest.mark.parametrize(("blur", "smallest"), [(0.9, 0.003), (1.4, 0.001), (2.8, 0.001)])
def test_corners_are_centred_without_bias(blur, smallest):
    random = np.random.default_rng(0)
    for _ in range(20):
        true = random.uniform(18, 22, 2)
        shown = chessboard(*true, random.uniform(0, 6), random.uniform(-0.2, 0.2), blur)
        places, centred = centre_marks(shown, true[np.newaxis] + random.uniform(-2, 2, (1, 2)), 7.0)
        assert centred.all()
        np.testing.assert_allclose(places[0], true, atol=smallest)


FAMILIES = [cv2.aruco.DICT_5X5_100, cv2.aruco.DICT_6X6_250, cv2.aruco.DICT_7X7_50]


@pytest.mark.parametrize(("family", "legacy"), list(zip(FAMILIES, [False, True, False], strict=True)))
def test_boards_of_all_families_are_known(family, legacy):
    painted = cv2.aruco.CharucoBoard((6, 6), 2.0, 1.5, cv2.aruco.getPredefinedDictionary(family))
    painted.setLegacyPattern(legacy)
    shown = painted.generateImage((288, 288), marginSize=24)
    fit = calibrate_lens([("a.png", shown)], Charuco(6, 6, 2.0, 1.5))
    assert fit.marks == (25,)
    assert fit.lens.pixel_size[0] == pytest.approx(12 / 240, rel=1e-3)


@pytest.mark.parametrize(
    "board", [Charuco(7, 5, 2.0, 1.5), Charuco(6, 4, 1.5, 1.1), Dots(7, 6, 1.0)], ids=str
)
def test_a_painted_board_has_its_true_size(board):
    painted = paint_board(board, 25.4 * 20)
    rows, columns = painted.shape
    assert (columns / 20, rows / 20) == tuple(side + 2 * board.pitch for side in board.size)
    x, y = np.meshgrid((np.arange(columns) + 0.5) / 20, (np.arange(rows) + 0.5) / 20)
    x, y = x - columns / 40, rows / 40 - y
    if isinstance(board, Dots):
        expected = boards.dots(board.columns, board.rows, board.pitch, board.pitch / 2)(x, y)
    else:
        expected = boards.charuco(board.columns, board.rows, board.square, board.marker)(x, y)
    assert set(np.unique(painted)) == {0, 255}
    assert np.mean(painted / 255 != expected) < 0.02  # on edges
    assert calibrate_lens([("a.png", painted)], board).lens.pixel_size[0] == pytest.approx(0.05, rel=1e-3)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Charuco(7, 5, 1.5, 2.0), "is smaller than its square"),
        (lambda: Charuco(4, 4, 2.0, 1.5), "too few corners"),
        (lambda: Dots(2, 20, 1.0), "too few dots"),
        (lambda: Dots(11, 9, 0.0), "above zero"),
        (lambda: Charuco(60, 60, 2.0, 1.5), "fewer squares"),
    ],
)
def test_impossible_boards_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()


def painted(board, pixels_per_mm=14):
    """A sharp, dim picture of a board."""
    return (30 + paint_board(board, 25.4 * pixels_per_mm) * 0.7).astype(np.uint8)


@pytest.mark.parametrize(
    ("shown", "message"),
    [
        (np.full((99, 99), 255, np.uint8), "100% of its pixels are saturated: expose it less"),
        (np.zeros((99, 99), np.uint8), "brightness is the same everywhere"),
        (np.zeros((1, 1), np.uint8), "brightness is the same everywhere"),
        (np.full((50, 50), np.nan, np.float32), "samples that are not finite"),
        (np.random.default_rng(0).integers(0, 99, (40, 41)).astype(np.uint16), "shows no board charuco:7x5"),
        (np.clip(painted(CHARUCO) * 9.0, 0, 255).astype(np.uint8), "are saturated: expose it less"),
        (painted(CHARUCO)[:, ::-1], "in a mirror"),
        (painted(Charuco(8, 6, 2.0, 1.5)), "another board than charuco:7x5:2mm:1.5mm: count"),
        (painted(Charuco(7, 5, 2.0, 1.1)), r"its markers have 1\.\d+ mm: measure"),
        (painted(CHARUCO)[:, :90], "only .* of 24 marks|shows no board"),
    ],
)
def test_a_picture_of_something_else_is_refused_in_one_line(shown, message):
    with pytest.raises(InputError, match=f"^a.png .*{message}|^a.png: {message}") as refused:
        calibrate_lens([("a.png", shown)], CHARUCO)
    assert "\n" not in str(refused.value)


def test_a_picture_with_fewer_pixels_than_dots_need_is_refused():
    noise = np.random.default_rng(0).integers(0, 255, (20, 24)).astype(np.uint8)
    with pytest.raises(InputError, match=r"^a\.png shows no board dots"):
        calibrate_lens([("a.png", noise)], Dots(11, 9, 1.0))


def test_pictures_of_different_sizes_are_refused():
    with pytest.raises(InputError, match=r"a.png and b.png differ: 40 x 30 and 30 x 40 pixels"):
        calibrate_lens([("a.png", np.zeros((30, 40))), ("b.png", np.zeros((40, 30)))], DOTS)
    with pytest.raises(InputError, match="no picture"):
        calibrate_lens([], DOTS)
