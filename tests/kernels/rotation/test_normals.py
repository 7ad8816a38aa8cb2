"""Normals: the reference compared with simple searches for the maximum, and the kernels with it."""

from dataclasses import fields, replace

import numpy as np
import pytest
from scipy import optimize, special

from mirrorskin.engine.base.picture import vector_lanes
from mirrorskin.engine.correlation.design_matrix import fit_matrix
from mirrorskin.evaluation.scenes import rotations
from mirrorskin.evaluation.scenes.rotations import EIGHTHS, UNEVEN, Setup
from mirrorskin.kernels.device import C_TYPES
from mirrorskin.kernels.rotation import normals
from mirrorskin.kernels.rotation.normals import Answer, Variance, contact_limits

ROOM = 64
UNTOUCHED = 77  # what answers hold before a kernel runs
RANDOM = tuple(float(step) for step in np.cumsum(np.random.default_rng(3).uniform(0.05, 0.15, 64)))

# Noise far below the tilt, so that what is compared is arithmetic and no lack of convergence.
UINT8 = Setup(gain=3.6, noise=0.5, offset=12.0, phase=UNEVEN, tilt=np.radians(6))
UINT16 = Setup(gain=900.0, noise=20.0, offset=300.0, dtype="uint16", phase=UNEVEN)
FLOAT32 = Setup(gain=5.0, noise=0.3, offset=3.0, dtype="float32", phase=UNEVEN)
TURNED = replace(UINT16, gain=-900.0, offset=60_000.0)


def even(count):
    return tuple(2 * np.pi * np.arange(count) / count)


class Turn:
    """A turn's frames, (N, n), and all that the kernels and their reference are told beside them."""

    def __init__(self, frames, setup, *, ends=(None, None), maps=False, weights=None, shot=0.0):
        self.frames, self.tilt = frames, setup.tilt
        self.weights = np.ones(len(frames)) if weights is None else np.asarray(weights, float)
        phase, self.axes = np.array(setup.phase), rotations.axes(setup.phase, setup.tilt)
        matrix = fit_matrix(phase, self.weights)
        self.table = np.stack([np.cos(phase), np.sin(phase), np.sqrt(self.weights), *matrix])
        (mean, *_), (_, cosine, both), (*_, sine) = matrix @ (matrix / self.weights).T
        self.spread = np.array([mean, cosine, both, sine])
        zeniths = [
            np.inf * sign if end is None else (end - setup.offset) / setup.slope
            for end, sign in zip(ends, (-1, 1), strict=True)
        ]
        self.scale = np.array([setup.offset, 1 / setup.slope, *sorted(zeniths)])
        if maps:
            self.scale = np.repeat(self.scale[:, np.newaxis], frames.shape[1], axis=1)
        self.noise = Variance(setup.spread**2 - 50 * shot, shot, 0.5 * setup.spread**2)
        self.limits = contact_limits(len(frames) - 3, setup.tilt)

    def answer(self, method):
        """Answer as the reference does."""
        arguments = self.frames, self.table, self.scale
        if method == "exact":
            return normals.normals_exact(*arguments, self.tilt, self.noise, self.limits)
        return normals.normals_paper(*arguments, self.noise, self.limits, self.spread)


class Answers:
    """Room on a device for the answers of so many pixels, and the kernel that fills it."""

    def __init__(self, device, pixels):
        self.device, self.pixels, self.turns = device, pixels, 0
        self.stride = -(-pixels // 64) * 64
        shapes = {f.name: (3 if f.name == "vectors" else 1, self.stride) for f in fields(Answer)}
        kinds = {name: np.uint8 if name == "contact" else np.float32 for name in shapes}
        self.maps = {name: self.put(np.full(shape, UNTOUCHED, kinds[name])) for name, shape in shapes.items()}

    def put(self, values):
        array = self.device.array("a", values.shape, values.dtype)
        array.write(values)
        return array

    def take(self, method, turn, start=0):
        """Run the kernel on a turn that begins with frame `start` of its stack."""
        count, self.turns = len(turn.frames), self.turns + 1
        # A ring buffer, and a frame behind it, of which the last vector may see some.
        stack = np.concatenate([np.roll(turn.frames, start, axis=0), np.zeros_like(turn.frames[:1])])
        table, scale = np.full((6, ROOM), np.nan, np.float32), turn.scale.astype(np.float32)
        table[:, :count] = turn.table
        if scale.ndim == 2:
            scale = np.pad(scale, [(0, 0), (0, self.stride - self.pixels)], constant_values=np.nan)
        lowest = turn.limits.lowest_tilt - (turn.tilt if method == "exact" else 0)
        reals = (
            np.cos(turn.tilt),
            np.sin(turn.tilt),
            *turn.noise,
            *turn.limits[:2],
            lowest,
            turn.limits.highest_tilt - (turn.tilt if method == "exact" else 0),
            turn.limits.rest,
        )
        per_pixel = int(scale.ndim == 2)
        whole = start, count, self.pixels, self.pixels, self.stride, self.turns
        arrays = [self.put(stack), self.put(table), self.put(scale)]
        arguments = [*arrays, *whole, per_pixel, 0, *reals, *self.maps.values()]
        if method == "paper":
            arguments += [*turn.spread]
        lanes = vector_lanes(self.device)
        kernel = self.device.kernel(
            "normals", f"normals_{method}", FRAME=C_TYPES[turn.frames.dtype.name], LANES=lanes
        )
        items = -(-self.pixels // self.device.layout.tile)
        kernel(items, moved=0, **dict(zip(kernel.arguments, arguments, strict=True)))
        return self

    def read(self):
        """Return the answers; nothing behind the last vector of a plane may have been written."""
        maps = {name: array.read() for name, array in self.maps.items()}
        lanes = vector_lanes(self.device)
        behind = -(-self.pixels // lanes) * lanes
        for name, values in maps.items():
            whole = 3 * behind if name == "vectors" else behind
            np.testing.assert_array_equal(values.reshape(-1)[whole:], UNTOUCHED)
        vectors = maps.pop("vectors").reshape(-1, 3)[: self.pixels]
        return Answer(vectors, **{name: values[0, : self.pixels] for name, values in maps.items()})


def compare(actual, expected, turn, fraction=0.0):
    """Hold answers against the reference's; they may differ by rounding, and by a share of a standard error.

    Zeniths of about 1 radian are good to 5e-7, and what that does to the azimuth grows as sin(zenith) / tilt.
    Next to an axis, the least step turns the direction in which a sample's zenith grows: there, what only the
    steps to come would settle may differ.
    """
    finite = np.isfinite(expected.sigma)
    np.testing.assert_array_equal(np.isfinite(actual.sigma), finite)
    np.testing.assert_array_equal(np.isfinite(actual.vectors), np.repeat(finite[:, np.newaxis], 3, axis=1))
    vectors, sigma = expected.vectors[finite], expected.sigma[finite]
    near = np.min(rotations.between(vectors[:, np.newaxis], turn.axes), axis=1) < 5 * sigma
    error = rotations.between(actual.vectors[finite].astype(float), vectors)
    slant = np.hypot(vectors[:, 0], vectors[:, 1]) / np.sin(turn.tilt)
    limit = 2e-6 * (1 + slant) + np.where(near, 0.3, fraction) * sigma
    assert np.all(error <= limit), np.max(error / limit)
    assert np.all(np.abs(actual.sigma[finite] / sigma - 1) < np.where(near, 0.2, 1e-3 + fraction))
    np.testing.assert_allclose(np.linalg.norm(actual.vectors[finite], axis=1), 1, atol=1e-6)
    settled = ~finite
    settled[finite] = ~near
    np.testing.assert_array_equal(actual.contact[settled].astype(bool), expected.contact[settled])
    counts = 1e-6 * np.nanmax(np.abs(turn.frames.astype(float)), initial=1)
    for name in ("mean", "cosine", "sine", "residual"):
        np.testing.assert_allclose(getattr(actual, name), getattr(expected, name), 2e-6, counts, err_msg=name)


def check(device, method, turn, fraction=0.0, start=0):
    """Answer by both; return the reference's answer."""
    expected = turn.answer(method)
    compare(Answers(device, turn.frames.shape[1]).take(method, turn, start).read(), expected, turn, fraction)
    return expected


def facing(pixels, setup, steepest=55.0):
    """Normals of all directions; the first ones are upright, and those of the axes, where u has none."""
    directions = rotations.random_normals(pixels, seed=pixels, bins=[(0, steepest)])[0]
    for number, normal in enumerate([*rotations.axes(setup.phase[:3], setup.tilt), np.array([0, 0, 1.0])]):
        if number < pixels // 2:
            directions[number] = normal
    return directions


def frames_of(setup, pixels, seed=1):
    return rotations.expose(facing(pixels, setup), setup, seed=seed)


CASES = {
    "uint8, uneven": (UINT8, 481, {}),
    "uint8, one pixel": (UINT8, 1, {}),
    "uint8, odd_sizes, shot noise": (UINT8, 7, {"shot": 1e-3}),
    "uint8, 64 frames, ends": (replace(UINT8, phase=RANDOM), 37, {"ends": (13.0, 254.0)}),
    "uint16, odd_sizes, 3 frames": (replace(UINT16, phase=even(3)), 7, {}),
    "uint16, 5 frames": (replace(UINT16, phase=even(5)), 37, {}),
    "uint16, darker where steeper, more pixels than an item takes": (TURNED, 1300, {"shot": 1e-3}),
    "uint16, 9 frames, each pixel's scale, ends": (
        replace(UINT16, phase=even(9)),
        37,
        {"maps": True, "ends": (301, 64_000)},
    ),
    "float32, odd_sizes, weights, each pixel's scale": (
        FLOAT32,
        7,
        {"maps": True, "weights": [1, 2, 3, 0.3, 1, 1, 1, 0.01]},
    ),
}
BY_PAPER = [case for case, (setup, *_) in CASES.items() if len(setup.phase) == 8]


@pytest.mark.parametrize(
    ("case", "method"), [*((case, "exact") for case in CASES), *((case, "paper") for case in BY_PAPER)]
)
def test_kernel_and_reference_agree(device, case, method):
    setup, pixels, options = CASES[case]
    turn = Turn(frames_of(setup, pixels), setup, **options)
    expected = check(device, method, turn, 2e-3, start=len(case) % 3)
    assert np.isfinite(expected.sigma).mean() > 0.8
    assert np.isfinite(expected.residual).all() == (len(turn.frames) > 3)


@pytest.mark.parametrize("method", ["exact", "paper"])
@pytest.mark.parametrize("setup", [UINT8, FLOAT32])
def test_kernel_and_reference_agree_on_lost_contact(device, setup, method):
    frames = rotations.draw(setup, 40, seed=4, bins=[(12, 50)]).frames[:, 0]
    rest = rotations.expose(np.broadcast_to([0, 0, 1.0], (40, 3)), replace(setup, tilt=0.0), seed=4)
    frames[2:4, ::5] = rest[2:4, ::5]
    frames[:, 1::5] = rest[:, 1::5]
    expected = check(device, method, Turn(frames, setup), 0.02)
    np.testing.assert_array_equal(expected.contact, np.tile([False, False, True, True, True], 8))


# Clipped far from the axes as well: next to them, not much can be compared.
CLIPPED = {
    "uint8": (replace(UINT8, gain=4.6, offset=-30.0, noise=1.0), [(6, 12), (58, 64)]),
    "uint16": (replace(UINT16, gain=1200.0, offset=-12_000.0), [(8, 12), (62, 67)]),
    "uint16, darker where steeper": (replace(UINT16, gain=-1250.0, offset=78_000.0), [(8, 12), (60, 65)]),
}


@pytest.mark.parametrize("case", CLIPPED)
def test_kernel_and_reference_agree_on_clipped_counts(device, case):
    setup, bins = CLIPPED[case]
    frames = rotations.draw(setup, 20, seed=2, bins=bins).frames.reshape(8, -1)
    top = np.iinfo(setup.dtype).max
    for end in (0, top):
        some = np.sum(frames == end, axis=0)
        assert np.count_nonzero((some > 0) & (some < 5)) >= 5
    frames[:, -3:] = np.array([[0, top, 1]])
    frames[::2, -1] = top
    clipped = np.sum((frames == 0) | (frames == top), axis=0)
    expected = check(device, "exact", Turn(frames, setup), 0.03)  # 0.022 on an H100
    assert np.all(np.isnan(expected.sigma[clipped > 5]))
    assert np.isfinite(expected.sigma[clipped < 4]).all()


def test_noise_alone_is_no_loss_of_contact(device):
    setup = replace(UINT16, noise=2000.0)  # of which the wave's amplitude has half; it is 2250 counts
    turn = Turn(rotations.draw(setup, 400, seed=5, bins=[(20, 30)]).frames[:, 0], setup)
    expected = turn.answer("exact")
    result = Answers(device, 400).take("exact", turn).read()
    finite = np.isfinite(expected.sigma)
    assert finite.mean() > 0.9
    for contact in (result.contact, expected.contact):
        assert np.mean(contact[finite]) > 0.99


def test_kernel_and_reference_agree_on_missing_samples(device):
    frames = frames_of(FLOAT32, 37)
    for missing in range(9):
        frames[:missing, -1 - missing] = np.nan
    frames[1::2, -20] = np.nan
    turn = Turn(frames, FLOAT32)
    with np.errstate(invalid="ignore"):  # where two samples are left
        expected = check(device, "exact", turn, 2e-3)
    gone = np.isnan(frames).sum(axis=0)
    np.testing.assert_array_equal(np.isfinite(expected.sigma), gone <= 5)
    np.testing.assert_array_equal(np.isfinite(expected.mean), gone == 0)
    paper = check(device, "paper", turn)
    np.testing.assert_array_equal(np.isfinite(paper.sigma), gone == 0)


def test_what_is_beyond_the_ends_contains_no_information(device):
    normals_ = rotations.random_normals(40, seed=5, bins=[(8, 12)])[0]
    clean = replace(UINT8, gain=3.6, phase=RANDOM)
    setup = replace(clean, low=48.0)  # zenith 10 degrees
    frames = rotations.expose(normals_, setup, seed=5)
    turn = Turn(frames, setup, ends=(48.0, None))
    expected = check(device, "exact", turn, 0.05)
    assert np.isfinite(expected.sigma).all()
    best = np.sqrt(rotations.bound(normals_, setup, rotations.clipped_share(normals_, setup)))
    error = rotations.between(expected.vectors, normals_)
    assert np.sqrt(np.mean((error / best) ** 2)) == pytest.approx(1, abs=0.25)


@pytest.mark.parametrize("method", ["exact", "paper"])
def test_kernel_and_reference_take_turns_into_their_mean(device, method):
    setup = replace(FLOAT32, phase=EIGHTHS)
    turns = [Turn(frames_of(setup, 37, seed), setup, shot=1e-4 * seed) for seed in (1, 2, 3)]
    turns[0].frames[:, 30] = np.nan
    turns[1].frames[:, 31:33] = np.nan
    turns[2].frames[:, 32:34] = np.nan
    for turn in turns:
        turn.frames[:, 34] = np.nan
    turns[1].frames[:4, 20:25] += 100
    answers, expected = Answers(device, 37), None
    for number, turn in enumerate(turns, start=1):
        now = turn.answer(method)
        expected = now if expected is None else normals.add_turn(expected, now, number)
        compare(answers.take(method, turn).read(), expected, turn, 4e-3)
    assert np.isnan(expected.sigma).nonzero()[0].tolist() == [34]
    assert not expected.contact[20:25].any()
    assert not expected.contact[30:35].any()
    assert expected.contact[35:].all()


def misfit(place, samples, setup, turn, frame):
    """Return minus the logarithm of the likelihood of a pixel's samples, by the book."""
    right, up, middle = frame
    normal = middle + place[0] * right + place[1] * up
    low, high = np.sort((turn.scale[2:] / turn.scale[1]) + setup.offset)
    level = np.clip(rotations.levels(normal / np.linalg.norm(normal), setup), low, high)
    evidence = -((np.nan_to_num(samples) - level) ** 2) / (2 * setup.spread**2)
    if turn.frames.dtype.kind == "u":
        top = np.iinfo(turn.frames.dtype).max
        evidence = np.where(samples <= 0, special.log_ndtr((0.5 - level) / setup.spread), evidence)
        evidence = np.where(samples >= top, special.log_ndtr((level - top + 0.5) / setup.spread), evidence)
    return -np.sum(turn.weights * np.where(np.isnan(samples), 0, evidence))


def likeliest(samples, setup, turn, near):
    """Search for the normal of which a pixel's samples are the likeliest, without derivatives."""
    frame, until = (*rotations.tangents(near), near), {"xatol": 1e-6, "fatol": 1e-6}
    angles = optimize.minimize(misfit, [0, 0], (samples, setup, turn, frame), "Nelder-Mead", options=until).x
    normal = near + angles[0] * frame[0] + angles[1] * frame[1]
    return normal / np.linalg.norm(normal)


LIKELY = {
    "nothing missing": (replace(UINT8, noise=1.0), {}),
    "weights": (replace(UINT16, noise=40.0), {"weights": [1, 4, 0.2, 1, 1, 1, 3, 0.1]}),
    "darker where steeper": (TURNED, {}),
    "clipped by the camera": (replace(CLIPPED["uint16"][0], noise=60.0), {}),
    "clipped, darker where steeper": (replace(CLIPPED["uint16, darker where steeper"][0], noise=60.0), {}),
    "missing": (replace(FLOAT32, noise=0.2), {}),
    "beyond an end": (replace(FLOAT32, noise=0.2, high=270.0), {"ends": (None, 270.0)}),
}


@pytest.mark.parametrize("case", LIKELY)
def test_the_reference_finds_the_likeliest_normal(case):
    setup, options = LIKELY[case]
    bins = [(8, 11), (61, 64)] if "clipped" in case else [(1, 5), (50, 55)]
    true = rotations.random_normals(3, seed=6, bins=bins).reshape(-1, 3)
    frames = rotations.expose(true, setup, seed=6)
    if case == "missing":
        frames[range(6), range(6)] = np.nan
    turn = Turn(frames, setup, **options)
    result = turn.answer("exact")
    assert np.isfinite(result.sigma).sum() >= 5
    for pixel in np.flatnonzero(np.isfinite(result.sigma)):
        expected = likeliest(frames[:, pixel].astype(float), setup, turn, true[pixel])
        off = rotations.between(result.vectors[pixel], expected)
        assert off < 0.02 * result.sigma[pixel], (pixel, off / result.sigma[pixel])


@pytest.mark.parametrize("weights", [None, [1, 4, 0.2, 1, 1, 1, 3, 0.1]])
def test_sigma_is_the_bound_at_the_answer(weights):
    turn = Turn(frames_of(UINT16, 60), UINT16, weights=weights)
    result = turn.answer("exact")
    weight = turn.weights[:, np.newaxis]
    expected = np.sqrt(rotations.bound(result.vectors, UINT16, weight))
    away = np.min(rotations.between(result.vectors[:, np.newaxis], turn.axes), axis=1) > 10 * expected
    assert away.sum() > 50
    np.testing.assert_allclose(result.sigma[away], expected[away], rtol=2e-3)
