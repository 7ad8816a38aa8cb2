"""The least standard errors of a calibration from touches of unknown objects (Cramer-Rao bound).

``python evaluation/calibration/fisher.py [--freeze]`` prints the standard errors of one touch of each object,
and stores them, in ``evaluation/stored/fisher.json`` and docs/method/sensor-health.md. It shares no code with
mirrorskin: NumPy and SciPy alone.

A touch is a press, which measures the height of each pixel with `PRESS_SIGMA`, and a turn. In frame t, the
brightness of a pixel whose normal n has the angle a = arccos(n . axis_t) with the body's axis is ::

    y = (1 + g_t) (offset + gain (1 + u_x x + u_y y) (a + c a^2)) + noise,

with x and y from -1 to 1 over the picture. The axis leans by (1 + e cos 2(p - m)) half_angle towards p + pi,
p = phase_t + phase, in the first order of the ellipticity. Normals are those of the heights, by central
differences. The heights of all pixels are unknown: they are parameters, which are marginalised.

A ``real`` sensor has more unknown parameters: instead of c, the exponent of the light l, full (l /
full)^(1 + gamma), uneven light of second order, a share of the frame before that a frame still shows (lag),
and gains and offsets of the frames without their means.

The information of a touch is J^T J / noise^2 over brightness, heights and parameters; the block of the
heights is sparse, and its Schur complement is the information of the parameters. That of several touches is
the sum. The camera is a usual one of 8 bits: see `Sensor`.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

Map = NDArray[np.float64]

STORED = Path(__file__).resolve().parents[1] / "stored" / "fisher.json"
PAGE = Path(__file__).resolve().parents[2] / "docs" / "method" / "sensor-health.md"
_START, _END = "<!-- fisher -->\n", "<!-- end fisher -->"
_UNDETERMINED = 100.0  # from which on a standard error is none

SHAPE = (44, 56)  # pixels
PIXEL = 0.1  # mm
FRAMES = 12  # of a turn
PRESS_SIGMA = 0.006  # mm
UNKNOWN_HEIGHT = 30.0  # mm: standard deviation of the height of a pixel without a press
FRAME_GAIN_SIGMA = 0.005  # as a share: the light of a frame, if it is unknown
FULL = 255.0  # counts of full light
_NO_MEAN = 1e-3  # standard deviation of the mean of gains and offsets of frames, in theirs
_STEP = 1e-6  # by which a parameter or a slope changes, to differentiate the brightness


@dataclass(frozen=True)
class Sensor:
    """Parameters at which the information is computed.

    ``gain`` is in counts per radian, ``offset`` in counts, ``curvature`` c per radian, ``half_angle`` and
    ``phase`` in radians. ``ellipse`` is e cos 2m and e sin 2m. ``noise`` is that of a sample, counts: 1 count
    of read and shot noise, and the rounding of 8 bits.
    """

    gain: float = 265.0
    offset: float = 10.0
    curvature: float = 0.0
    uneven: tuple[float, float] = (0.0, 0.0)
    half_angle: float = math.radians(2.5)
    phase: float = 0.0
    ellipse: tuple[float, float] = (0.0, 0.0)
    noise: float = math.hypot(1.0, 1 / math.sqrt(12))

    def vector(self) -> Map:
        """Return the parameters, relative where `NAMES` says so."""
        values = (self.gain, self.offset, self.curvature, *self.uneven)
        of_real = np.zeros(len(REAL))
        return np.array([*values, self.half_angle, self.phase, *self.ellipse, *of_real])


REAL = {"gamma": 0.2, "lag": 0.01, "uneven xx": 0.05, "uneven xy": 0.05, "uneven yy": 0.05}
"""Parameters that only a real sensor has, 0 here, and standard deviations of their priors."""

OF_FRAMES = 0.02, 0.25  # standard deviations of gains, as a share, and offsets, counts, of a real sensor

NAMES = (
    "gain",
    "offset",
    "curvature",
    "uneven x",
    "uneven y",
    "half-angle",
    "phase",
    "ellipticity x",
    "ellipticity y",
    *REAL,
)


def render(parameters: Map, p: Map, q: Map, x: Map, y: Map, phases: Map) -> Map:
    """Return the brightness, (T, H, W), of slopes p = dz/dx and q = dz/dy at x and y, from -1 to 1."""
    gain, offset, curvature, u_x, u_y, half, shift, e_x, e_y, gamma, lag, *second = parameters
    turned = (phases + shift)[:, np.newaxis, np.newaxis]
    lean = half * (1 + e_x * np.cos(2 * turned) + e_y * np.sin(2 * turned))
    axis = -np.sin(lean) * np.cos(turned), -np.sin(lean) * np.sin(turned), np.cos(lean)
    length = np.sqrt(1 + p**2 + q**2)
    normal = -p / length, -q / length, 1 / length
    across = np.sqrt(
        sum((normal[i] * axis[j] - normal[j] * axis[i]) ** 2 for i, j in ((0, 1), (1, 2), (2, 0)))
    )
    angle = np.arctan2(across, sum(n * a for n, a in zip(normal, axis, strict=True)))
    uneven = 1 + u_x * x + u_y * y + second[0] * x * x + second[1] * x * y + second[2] * y * y
    light = offset + gain * uneven * (angle + curvature * angle**2)
    if gamma:
        light = FULL * np.maximum(light / FULL, 1e-9) ** (1 + gamma)
    return np.asarray(light + lag * (np.concatenate([light[:1], light[:-1]]) - light))


def differences(shape: tuple[int, int], pixel: float) -> tuple[sparse.csr_array, sparse.csr_array]:
    """Return the matrices that take heights, row by row, to dz/dx and dz/dy; y is up the picture."""

    def along(count: int) -> sparse.csr_array:
        rows, columns, values = [], [], []
        for number in range(count):
            before, after = max(0, number - 1), min(count - 1, number + 1)
            rows += [number, number]
            columns += [before, after]
            values += [-1 / ((after - before) * pixel), 1 / ((after - before) * pixel)]
        return sparse.csr_array((values, (rows, columns)), shape=(count, count))

    height, width = shape
    return (
        sparse.csr_array(sparse.kron(sparse.eye_array(height), along(width))),
        sparse.csr_array(sparse.kron(-along(height), sparse.eye_array(width))),
    )


@dataclass(frozen=True)
class Bound:
    """The information of touches about the parameters and, after them, the gains of frames."""

    information: Map
    prior: Map = field(default_factory=lambda: np.zeros(len(NAMES)))

    def sigmas(self) -> dict[str, float]:
        """Return the least standard errors of the parameters, in their units; infinite if undetermined.

        A parameter is undetermined if a direction without information contains it.
        """
        information = self.information + np.diag(self.prior)
        scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
        values, vectors = np.linalg.eigh(information / np.multiply.outer(scale, scale))
        known = values > 1e-10
        variance = np.sum(vectors[:, known] ** 2 / values[known], axis=1) / scale**2
        free = np.sum(vectors[:, ~known] ** 2, axis=1) > 1e-6
        sigma = np.where(free, np.inf, np.sqrt(variance))
        return dict(zip(NAMES, sigma[: len(NAMES)].tolist(), strict=True))


def bound(
    height: Map,
    *,
    pixel: float = PIXEL,
    sensor: Sensor | None = None,
    frames: int = FRAMES,
    press_sigma: float | None = PRESS_SIGMA,
    unknown_frame_gains: bool = False,
    priors: Mapping[str, float] | None = None,
    seen: NDArray[np.bool_] | None = None,
    real: bool = False,
) -> Bound:
    """Return the information of one touch of an object.

    Parameters
    ----------
    height : ndarray, (H, W)
        The object, mm.
    pixel : float
        Size of a pixel, mm.
    sensor : Sensor, optional
    frames : int
        Number of frames of the turn.
    press_sigma : float or None
        Standard deviation of the height of a pixel by the press, mm; None without a press.
    unknown_frame_gains : bool
        Whether the light of each frame is unknown, with a standard deviation of `FRAME_GAIN_SIGMA`.
    priors : mapping, optional
        Standard deviations of parameters, in their units, by name; 0 for a parameter that is known.
    seen : ndarray, (H, W), bool, optional
        Pixels whose brightness is used; by default all.
    real : bool
        Whether the parameters of a real sensor are unknown, too.
    """
    sensor = sensor or Sensor()
    rows, columns = height.shape
    x, y = np.meshgrid(np.linspace(-1, 1, columns), np.linspace(1, -1, rows))
    by_x, by_y = differences((rows, columns), pixel)
    p, q = ((matrix @ height.ravel()).reshape(height.shape) for matrix in (by_x, by_y))
    phases, centre = np.arange(frames) * 2 * np.pi / frames, sensor.vector()

    def brightness(change: Map, dp: float = 0.0, dq: float = 0.0) -> Map:
        light = render(centre + change, p + dp, q + dq, x, y, phases)
        return (light if seen is None else np.where(seen, light, 0.0)).reshape(frames, -1)

    def slope(step: Callable[[float], Map]) -> Map:
        return (step(_STEP) - step(-_STEP)) / (2 * _STEP)

    still = np.zeros(len(NAMES))
    by_p = slope(lambda step: brightness(still, dp=step))
    by_q = slope(lambda step: brightness(still, dq=step))
    unit = np.eye(len(NAMES))
    lines = [slope(lambda step, row=row: brightness(step * row)) for row in unit]  # type: ignore[misc]
    light = brightness(still)
    for size in (light, (light != 0).astype(np.float64))[: 2 if real else unknown_frame_gains]:
        lines += [np.where(np.arange(frames)[:, np.newaxis] == t, size, 0.0) for t in range(frames)]
    by_parameter = np.stack(lines)
    own = np.einsum("kti,lti->kl", by_parameter, by_parameter) / sensor.noise**2
    heights = sparse.eye_array(height.size) / (press_sigma or UNKNOWN_HEIGHT) ** 2
    cross = np.zeros((height.size, len(lines)))
    for t in range(frames):
        jacobian = sparse.diags_array(by_p[t]) @ by_x + sparse.diags_array(by_q[t]) @ by_y
        heights = heights + jacobian.T @ jacobian / sensor.noise**2
        cross += jacobian.T @ by_parameter[:, t].T / sensor.noise**2
    information = own - cross.T @ splu(sparse.csc_array(heights)).solve(cross)
    sigmas = {name: sigma if real else 0.0 for name, sigma in REAL.items()} | dict(priors or {})
    if real:
        sigmas["curvature"] = 0.0
    prior = np.zeros(len(lines))
    prior[len(NAMES) :] = FRAME_GAIN_SIGMA**-2
    if real:
        prior[len(NAMES) :] = np.repeat(OF_FRAMES, frames) ** -2.0
        for start, sigma in zip((len(NAMES), len(NAMES) + frames), OF_FRAMES, strict=True):
            part = slice(start, start + frames)
            information[part, part] += (frames * _NO_MEAN * sigma) ** -2.0
    for name, sigma in sigmas.items():
        prior[NAMES.index(name)] = max(sigma, 1e-9) ** -2
    return Bound((information + information.T) / 2, prior)


# --- objects ------------------------------------------------------------------------------------------------


def axes(shape: tuple[int, int] = SHAPE, pixel: float = PIXEL) -> tuple[Map, Map]:
    """Return x and y of pixels, (H, W), mm."""
    rows, columns = shape
    across = (np.arange(columns) - (columns - 1) / 2) * pixel
    down = ((rows - 1) / 2 - np.arange(rows)) * pixel
    x, y = np.meshgrid(across, down)
    return x, y


def rough(x: Map, y: Map, slope: float = 0.2, length: float = 0.35) -> Map:
    """Return a rough surface of a Gaussian correlation length, mm, and an RMS slope along each axis."""
    white = np.random.default_rng(1).standard_normal(SHAPE)
    f_y, f_x = (np.fft.fftfreq(count, PIXEL) for count in SHAPE)
    spectrum = np.exp(-((np.pi * length) ** 2) * (f_x**2 + f_y[:, np.newaxis] ** 2) / 2)
    waves = np.fft.fft2(white) * spectrum
    height = np.fft.ifft2(waves).real
    waves *= slope / np.sqrt(np.mean(np.gradient(height, PIXEL)[0] ** 2)) / height.size
    corner = axes()[0][0, 0], axes()[1][0, 0]
    turned_x, turned_y = (
        np.exp(2j * np.pi * np.multiply.outer(f, along.ravel()))
        for f, along in ((f_x, x - corner[0]), (f_y, corner[1] - y))
    )
    return np.asarray(np.sum(turned_y * (waves @ turned_x), axis=0).real.reshape(x.shape))


def woven(x: Map, y: Map) -> Map:
    """Return a weave: crossed waves."""
    return np.asarray(0.06 * (np.sin(2 * np.pi * x / 1.1) + np.sin(2 * np.pi * y / 0.9 + 0.4)))


def dimpled(x: Map, y: Map) -> Map:
    """Return a plate of round bumps in a hexagonal grid."""
    step, height = 1.3, np.zeros(x.shape)
    for near_row, near_column in np.ndindex(3, 3):
        row = np.round(y / (step * 0.866)) + near_row - 1
        dx = (x + step / 2 * (row % 2)) / step
        r2 = ((dx - np.round(dx) - near_column + 1) * step) ** 2 + (y - row * step * 0.866) ** 2
        height += 0.2 * np.exp(-r2 / (2 * 0.33**2))
    return height


def knurled(x: Map, y: Map) -> Map:
    """Return a knurl: pyramids with edges that are rounded over two pixels."""
    u, v = (x + y) / math.sqrt(2), (x - y) / math.sqrt(2)
    ridges = [np.sqrt(0.2 + np.sin(np.pi * each / 1.2) ** 2) for each in (u, v)]
    return np.asarray(0.12 * (ridges[0] + ridges[1]))


def cone(x: Map, y: Map) -> Map:
    """Return a cone with a slope of 25 degrees and a tip of 0.25 mm."""
    return np.asarray(-math.tan(math.radians(25)) * np.sqrt(x**2 + y**2 + 0.25**2))


def staircase(x: Map, y: Map) -> Map:
    """Return a staircase: treads that are level, and inclined by 5 degrees, in turn."""
    tread, along = _treads(x)
    return np.asarray(0.15 * tread + math.tan(math.radians(5)) * (tread % 2) * along)


def _treads(x: Map) -> tuple[Map, Map]:
    """Return the number of the tread, and the distance to its middle, mm."""
    tread = np.floor(x / 0.8)
    return tread, x - (tread + 0.5) * 0.8


def _without_risers() -> NDArray[np.bool_]:
    """Return the pixels of the staircase whose differences stay on one tread."""
    tread = _treads(axes()[0])[0]
    padded = np.pad(tread, ((0, 0), (1, 1)), mode="edge")
    return np.asarray((padded[:, :-2] == tread) & (padded[:, 2:] == tread))


OBJECTS: Mapping[str, Callable[[Map, Map], Map]] = {
    "rough": rough,
    "woven": woven,
    "dimpled": dimpled,
    "knurled": knurled,
    "cone": cone,
    "staircase": staircase,
}

COLUMNS: Mapping[str, tuple[str, float]] = {
    "gain": ("gain, %", 100 / Sensor.gain),
    "offset": ("offset, counts", 1.0),
    "curvature": ("curvature, %/rad", 100.0),
    "half-angle": ("half-angle, %", 100 / Sensor.half_angle),
    "phase": ("phase, degrees", math.degrees(1)),
    "ellipticity x": ("ellipticity, %", 100.0),
    "uneven x": ("uneven light, %", 100.0),
    "gamma": ("gamma, %", 100.0),
}
"""Heading of a column, and the factor of its unit."""

CASES: Mapping[str, Mapping[str, object]] = {
    "press and turn": {},
    "press and turn, unknown light of each frame": {"unknown_frame_gains": True},
    "press and turn of a real sensor": {"real": True},
    "turn alone": {"press_sigma": None},
}


def measure() -> dict[str, dict[str, dict[str, float | None]]]:
    """Return the standard errors of one touch by case, object and column; None if undetermined."""
    table: dict[str, dict[str, dict[str, float | None]]] = {}
    for case, options in CASES.items():
        for name, make in OBJECTS.items():
            seen = _without_risers() if name == "staircase" else None
            sigmas = bound(make(*axes()), seen=seen, **options).sigmas()  # type: ignore[arg-type]
            row = {
                head: (value if math.isfinite(value := factor * sigmas[key]) else None)
                for key, (head, factor) in COLUMNS.items()
                if key != ("curvature" if "real" in options else "gamma")
            }
            table.setdefault(case, {})[name] = row
    return table


def as_text(table: Mapping[str, Mapping[str, Mapping[str, float | None]]]) -> str:
    """Return the tables of all cases for a page."""
    lines = []
    for case, rows in table.items():
        heads = list(next(iter(rows.values())))
        lines += [f"| {case} | {' | '.join(heads)} |", f"|---{'|---:' * len(heads)}|"]
        lines += [f"| {name} | {' | '.join(map(_text, row.values()))} |" for name, row in rows.items()]
        lines.append("")
    return "\n".join(lines)


def _text(value: float | None) -> str:
    return "undetermined" if value is None or value > _UNDETERMINED else f"{value:.2g}"


def with_table(page: str, text: str) -> str:
    """Return a page with the tables between its marks."""
    head, rest = page.split(_START)
    return f"{head}{_START}\n{text}\n{_END}{rest.split(_END, 1)[1]}"


def main() -> None:
    """Print the table, and store it."""
    parser = argparse.ArgumentParser(description="The least standard errors of a calibration from touches.")
    parser.add_argument("--freeze", action="store_true", help="store the table, and write it into the page")
    table = measure()
    print(as_text(table))
    if parser.parse_args().freeze:
        STORED.write_text(json.dumps(table, indent=2) + "\n", encoding="utf-8")
        PAGE.write_text(with_table(PAGE.read_text(encoding="utf-8"), as_text(table)), encoding="utf-8")


if __name__ == "__main__":
    main()
