"""A camera independent of the twin: its frames of a scene, and all its possible faults.

The light of a scene is computed at 4 x 4 points of each pixel, blurred by a lens, averaged over the pixel,
and turned into counts by a sensor with shot noise and read noise.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from fractions import Fraction
from typing import Any

import av
import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.fft import dctn, idctn
from scipy.ndimage import gaussian_filter1d

Floats = NDArray[np.float64]
Light = Callable[[Floats], Floats]
"""The light of a scene at positions (T, rows of points or 1, 1): shares from 0 to 1, (T, points, points)."""

POINTS = 4  # along each side of a pixel
DARK, SPAN = 20.0, 200.0  # counts of 8 bits: without light, and from there to full light
ELECTRONS = 200.0  # a count of 8 bits
READ_NOISE = 1.2  # counts of 8 bits
HOTTEST = 60.0  # counts of 8 bits: the highest dark level of a hot pixel
_CAMERA = 7  # seed of what stays the same from recording to recording
_BLOCK, _GROUP, _QUANTUM = 8, 12, 6.0  # pixels; frames; counts of 8 bits: of the codec without a container


@dataclass(frozen=True)
class Fault:
    """What goes wrong in a recording; the defaults are a camera without a fault.

    Attributes
    ----------
    name : str
    blur : float
        Standard deviation of the lens's point spread, pixels.
    gamma : float
        Exponent of the response.
    exposure : float
        Times the light that just fits into 8 bits.
    flicker : float
        Standard deviation of the lamp from frame to frame, as a share.
    drift : float
        Rise of the dark level over the recording, counts of 8 bits.
    jitter : float
        Standard deviation of the position, steps from frame to frame.
    stated : bool
        Whether the user states the jitter, or the shutter.
    dropped, duplicated : bool
        Whether the frame in the middle is missing, or is there twice; nobody noticed.
    hot : float
        Share of the samples that are at the end of the scale.
    outliers : float
        Share of the samples that are any number.
    gain : float
        Standard deviation of each pixel's gain.
    vignetting : float
        Loss of light in the corners.
    bits : int
        Of a sample.
    stray : float
        Share of the light of a frame that is spread over the whole frame.
    codec : str
        "jpeg" (quality 90) or "mpeg" (MPEG-4) if frames are compressed, "mpeg array" or "dct" if nothing
        says so.
    shutter : float
        Steps from the first row's exposure to the last row's.
    lag : float
        Share of the frame before that a frame shows.
    lamp : float
        Change of light at the left and right borders, as a share, as the lamp moves to the right.
    wave : float
        Amplitude of one wave of light per turn, or per press, as a share.
    fading : float
        Loss of light over the recording, as a share.
    electrons, read_noise : float
        Electrons of a count of 8 bits; standard deviation without light, counts of 8 bits.
    dark_pattern : float
        Standard deviation of each pixel's dark level, counts of 8 bits.
    hot_pixels : float
        Share of the pixels whose dark level is up to `HOTTEST` counts higher.
    tilt, light, offset, turned : float
        What nobody measured: the tilt and the light over what is stated; the dark level and the phase minus
        what is stated, counts of 8 bits and radians.
    usual : bool
        Whether the recording has the deviations that are usual of a camera that nobody characterised, which
        are drawn for each recording: see `drawn`.
    """

    name: str
    blur: float = 0.0
    gamma: float = 1.0
    exposure: float = 1.0
    flicker: float = 0.0
    drift: float = 0.0
    jitter: float = 0.0
    stated: bool = False
    dropped: bool = False
    duplicated: bool = False
    hot: float = 0.0
    outliers: float = 0.0
    gain: float = 0.0
    vignetting: float = 0.0
    bits: int = 8
    stray: float = 0.0
    codec: str = ""
    shutter: float = 0.0
    lag: float = 0.0
    lamp: float = 0.0
    wave: float = 0.0
    fading: float = 0.0
    electrons: float = ELECTRONS
    read_noise: float = READ_NOISE
    dark_pattern: float = 0.0
    hot_pixels: float = 0.0
    tilt: float = 1.0
    light: float = 1.0
    offset: float = 0.0
    turned: float = 0.0
    usual: bool = False

    @property
    def scale(self) -> float:
        """Counts for a count of 8 bits."""
        return float(2**self.bits - 1) / 255

    @property
    def stated_codec(self) -> str:
        """The compression that a source of the frames states."""
        return self.codec if self.codec in ("jpeg", "mpeg") else ""

    def drawn(self, seed: int) -> Fault:
        """Return the fault with the usual deviations of one recording, if it has any."""
        if not self.usual:
            return self
        generator = np.random.default_rng([seed, _CAMERA])
        draws: dict[str, Any] = {
            name: center + sigma * generator.normal() for name, (center, sigma) in USUAL.items()
        }
        for name in ("blur", "lag", "vignetting"):
            draws[name] = abs(draws[name])
        return replace(self, usual=False, flicker=0.005, **draws)


def combined(*faults: Fault, name: str = "") -> Fault:
    """Return a fault with all that goes wrong in some; the last counts where two are of one kind."""
    plain = Fault("")
    values = {
        field.name: getattr(fault, field.name)
        for fault in faults
        for field in fields(Fault)
        if field.name != "name" and getattr(fault, field.name) != getattr(plain, field.name)
    }
    return replace(plain, **values, name=name or " + ".join(fault.name for fault in faults))


USUAL: dict[str, tuple[float, float]] = {
    "gamma": (1.0, 0.02),
    "fading": (0.0, 0.005),
    "blur": (0.3, 0.3),
    "lag": (0.0, 0.01),
    "vignetting": (0.0, 0.02),
    "tilt": (1.0, 0.01),
    "light": (1.0, 0.01),
    "offset": (0.0, 0.5),
    "turned": (0.0, np.radians(0.3)),
}
"""Means and standard deviations of a machine-vision camera that nobody characterised."""

SENSORS: dict[str, Fault] = {
    "small pixels": Fault(
        "small pixels", electrons=40, read_noise=0.15, gain=0.01, dark_pattern=0.5, hot_pixels=5e-4
    ),
    "machine vision": Fault(
        "machine vision", electrons=120, read_noise=0.1, gain=0.01, dark_pattern=0.2, hot_pixels=2e-4
    ),
    "scientific": Fault(
        "scientific", bits=12, electrons=300, read_noise=0.02, gain=0.01, dark_pattern=0.05, hot_pixels=1e-4
    ),
}
"""Sensors as data sheets after EMVA 1288 describe them, full wells of 10 000, 30 000 and 75 000 electrons."""


FAULTS = (
    Fault("none"),
    Fault("blur 0.5 px", blur=0.5),
    Fault("blur 1.5 px", blur=1.5),
    Fault("saturation", exposure=1.4),
    Fault("gamma 0.9", gamma=0.9),
    Fault("flicker 2 %", flicker=0.02),
    Fault("drift 4 counts", drift=4.0),
    Fault("jitter 0.1 steps", jitter=0.1),
    Fault("the same, stated", jitter=0.1, stated=True),
    Fault("dropped frame", dropped=True),
    Fault("repeated frame", duplicated=True),
    Fault("rolling shutter", shutter=1.0),
    Fault("rolling shutter, stated", shutter=1.0, stated=True),
    Fault("hot 0.1 %", hot=0.001),
    Fault("outliers 1 %", outliers=0.01),
    Fault("gain 3 %", gain=0.03),
    Fault("vignetting 10 %", vignetting=0.1),
    Fault("12 bits", bits=12),
    Fault("stray light 1 %", stray=0.01),
    Fault("JPEG 90", codec="jpeg"),
    Fault("MPEG-4", codec="mpeg"),
)
MORE_FAULTS = (
    Fault("lag 7 %", lag=0.07),
    Fault("moving lamp", lamp=0.02),
    Fault("wave 1 %", wave=0.01),
    Fault("fading 3 %", fading=0.03),
    Fault("unstated codec", codec="dct"),
    Fault("usual deviations", usual=True),
    Fault("unstated MPEG-4", codec="mpeg array"),
)
_MODERATE = (
    Fault("blur", blur=0.7),
    Fault("gamma", gamma=0.95),
    Fault("fading", fading=0.02),
    Fault("flicker", flicker=0.01),
    Fault("jitter", jitter=0.05),
    Fault("saturation", exposure=1.25),
    Fault("vignetting", vignetting=0.05),
    Fault("lag", lag=0.04),
    Fault("codec", codec="dct"),
)
PAIRS = tuple(combined(*pair) for pair in itertools.combinations(_MODERATE, 2))


def points(shape: tuple[int, int], pixel_size: float) -> tuple[Floats, Floats]:
    """Return x, to the right, and y, up, of all points at which light is computed, mm from the centre."""
    rows, columns = (POINTS * size for size in shape)
    x = (np.arange(columns) - (columns - 1) / 2) * pixel_size / POINTS
    y = ((rows - 1) / 2 - np.arange(rows)) * pixel_size / POINTS
    return x[np.newaxis, :], y[:, np.newaxis]


def centres(shape: tuple[int, int], pixel_size: float) -> tuple[Floats, Floats]:
    """Return x and y of the centres of all pixels, mm from the centre of the picture."""
    rows, columns = shape
    x = (np.arange(columns, dtype=np.float64) - (columns - 1) / 2) * pixel_size
    y = ((rows - 1) / 2 - np.arange(rows, dtype=np.float64)) * pixel_size
    return x[np.newaxis, :], y[:, np.newaxis]


def record(
    light: Light, positions: Floats, fault: Fault, seed: int, *, period: int | None = None
) -> NDArray[np.unsignedinteger]:
    """Return the frames of a scene, (T, H, W), at positions, (T,), that are what the user believes.

    ``period`` is the number of frames of a turn, by default all.
    """
    fault = fault.drawn(seed)
    generator = np.random.default_rng(seed)
    middle, step = len(positions) // 2, float(np.median(np.diff(positions)))
    true = positions.copy()
    if fault.dropped:
        true[middle:] = np.append(positions[middle + 1 :], positions[-1] + step)
    if fault.duplicated:
        true[middle:] = positions[middle - 1 : -1]
    true = true + fault.jitter * step * generator.normal(size=len(true))
    frames = [_share(light, position, step, fault) for position in true]
    shares = np.stack(frames)
    flicker = 1 + fault.flicker * generator.normal(size=len(true))
    gain = flicker * _brightness(len(true), period, fault)
    shares = shares * _pixels(shares.shape[1:], fault)[0] * gain[:, np.newaxis, np.newaxis]
    mean_counts = _expose(_smear(shares, fault), fault, generator)
    drift = fault.drift * np.linspace(0, 1, len(true))
    counts = _sample(mean_counts + drift[:, np.newaxis, np.newaxis], fault, generator)
    if fault.duplicated:
        counts[middle] = counts[middle - 1]
    return _compress(counts, fault)


def references(shape: tuple[int, int], fault: Fault, seed: int) -> tuple[Floats, Floats]:
    """Return the levels without and with full light, counts: means of 16 frames of the same camera."""
    steady = replace(fault.drawn(seed), flicker=0.0, drift=0.0, jitter=0.0, dropped=False, duplicated=False)
    steady = replace(steady, hot=0.0, outliers=0.0, codec="", lag=0.0, lamp=0.0, wave=0.0, fading=0.0)
    rows, columns = (POINTS * size for size in shape)
    dark, bright = (
        record(lambda _: np.full((1, rows, columns), level), np.arange(16.0), steady, seed).mean(axis=0)  # noqa: B023
        for level in (0.0, 1.0)
    )
    return dark, bright


def _brightness(count: int, period: int | None, fault: Fault) -> Floats:
    """Return the brightness of the lamp in each frame, over its mean."""
    turn = 2 * np.pi * np.arange(count) / (period or count)
    lamp: Floats = (1 + fault.wave * np.cos(turn - 0.7)) * (1 - fault.fading * np.linspace(0, 1, count))
    return lamp * fault.light


def _pixels(shape: tuple[int, ...], fault: Fault) -> tuple[Floats, Floats]:
    """Return the gain of each pixel, and its dark level above the mean, counts of 8 bits."""
    generator = np.random.default_rng(_CAMERA)
    gain = 1 + fault.gain * generator.normal(size=shape)
    dark = fault.dark_pattern * generator.normal(size=shape)
    hot = generator.random(shape) < fault.hot_pixels
    return gain, dark + HOTTEST * hot * generator.random(shape)


def _smear(shares: Floats, fault: Fault) -> Floats:
    """Return light with that of the frame before, and with a lamp that moves to the right."""
    if fault.lamp:
        along = np.linspace(-1, 1, shares.shape[2])
        shares = shares * (
            1 + fault.lamp * np.linspace(-1, 1, len(shares))[:, np.newaxis, np.newaxis] * along
        )
    if fault.lag:
        before = shares[0]
        shares = shares.copy()
        for frame in shares:
            frame[:] = before = (1 - fault.lag) * frame + fault.lag * before
    return shares


def _share(light: Light, position: float, step: float, fault: Fault) -> Floats:
    """Return the share of full light of each pixel in one frame, behind the lens."""
    shown = np.full((1, 1, 1), position)
    if fault.shutter:
        rows = light(shown).shape[1]
        shown = position + fault.shutter * step * np.linspace(0, 1, rows)[np.newaxis, :, np.newaxis]
    fine = light(shown)[0]
    for axis in (0, 1):
        if fault.blur:
            fine = gaussian_filter1d(fine, fault.blur * POINTS, axis=axis, mode="nearest")
    rows, columns = (size // POINTS for size in fine.shape)
    mean_light: Floats = fine.reshape(rows, POINTS, columns, POINTS).mean(axis=(1, 3))
    mean_light = (1 - fault.stray) * mean_light + fault.stray * mean_light.mean()
    x, y = np.linspace(-1, 1, columns)[np.newaxis], np.linspace(-1, 1, rows)[:, np.newaxis]
    return mean_light * (1 - fault.vignetting * (x**2 + y**2) / 2)


def _expose(shares: Floats, fault: Fault, generator: np.random.Generator) -> Floats:
    """Return counts of 8 bits, without limits."""
    full = fault.exposure * SPAN
    light = np.maximum(shares, 0) ** fault.gamma
    electrons = generator.poisson(light * full * fault.electrons)
    dark = DARK + fault.offset + _pixels(shares.shape[1:], fault)[1]
    return dark + electrons / fault.electrons + generator.normal(0, fault.read_noise, shares.shape)


def _sample(counts: Floats, fault: Fault, generator: np.random.Generator) -> NDArray[np.unsignedinteger]:
    top = 2**fault.bits - 1
    stored = np.rint(counts * fault.scale)
    hot = generator.random(stored.shape) < fault.hot
    any_number = generator.random(stored.shape) < fault.outliers
    stored[hot] = top
    stored[any_number] = generator.integers(0, top + 1, np.count_nonzero(any_number))
    return np.clip(stored, 0, top).astype(np.uint8 if fault.bits == 8 else np.uint16)


def _compress(frames: NDArray[np.unsignedinteger], fault: Fault) -> NDArray[np.unsignedinteger]:
    if fault.codec == "jpeg":
        quality = [cv2.IMWRITE_JPEG_QUALITY, 90]
        stored = [cv2.imencode(".jpg", frame, quality)[1] for frame in frames]
        return np.stack([np.asarray(cv2.imdecode(jpeg, cv2.IMREAD_GRAYSCALE), np.uint8) for jpeg in stored])
    if fault.codec in ("mpeg", "mpeg array"):
        return _filmed(frames)
    if fault.codec == "dct":
        return _quantized(frames, _QUANTUM * fault.scale)
    return frames


def _quantized(frames: NDArray[np.unsignedinteger], quantum: float) -> NDArray[np.unsignedinteger]:
    """Return frames as a codec stores them that predicts each from the one before, without motion.

    Cosines of blocks of 8 x 8 pixels are rounded to multiples of a number; each twelfth frame is whole.
    """
    top = np.iinfo(frames.dtype).max if frames.dtype == np.uint8 else frames.max()
    decoded, before = np.empty_like(frames), np.zeros(frames.shape[1:])
    for number, frame in enumerate(frames):
        if number % _GROUP == 0:
            before = np.zeros(frames.shape[1:])
        blocks = _as_blocks(frame - before)
        cosines = dctn(blocks, axes=(2, 3), norm="ortho")
        blocks = idctn(quantum * np.rint(cosines / quantum), axes=(2, 3), norm="ortho")
        before = np.clip(np.rint(before + blocks.transpose(0, 2, 1, 3).reshape(frame.shape)), 0, top)
        decoded[number] = before
    return decoded


def _as_blocks(picture: Floats) -> Floats:
    rows, columns = (size // _BLOCK for size in picture.shape)
    return picture.reshape(rows, _BLOCK, columns, _BLOCK).transpose(0, 2, 1, 3)


def _filmed(frames: NDArray[np.unsignedinteger]) -> NDArray[np.unsignedinteger]:
    """Return frames as an MPEG-4 video of 4 bits a pixel holds them."""
    encoder = av.CodecContext.create("mpeg4", "w")
    encoder.height, encoder.width = frames.shape[1:]
    encoder.pix_fmt, encoder.time_base, encoder.framerate = "yuv420p", Fraction(1, 25), Fraction(25)
    encoder.bit_rate = 4 * frames[0].size * 25
    decoder = av.CodecContext.create("mpeg4", "r")
    packets = []
    for number, frame in enumerate(frames):
        picture = av.VideoFrame.from_ndarray(_as_yuv(frame), format="yuv420p")
        picture.pts = number
        packets += encoder.encode(picture)
    packets += encoder.encode(None)
    decoded = [picture for packet in packets for picture in decoder.decode(packet)] + decoder.decode(None)
    rows = frames.shape[1]
    return np.stack([picture.to_ndarray()[:rows] for picture in decoded])


def _as_yuv(frame: NDArray[np.unsignedinteger]) -> NDArray[np.uint8]:
    rows, columns = frame.shape
    grey = np.full((rows // 2, columns), 128, np.uint8)
    return np.concatenate([frame, grey]).astype(np.uint8)
