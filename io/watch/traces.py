"""Facts and findings from the brightness of a grid of pixels over all frames."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.findings import Finding
from mirrorskin.io.base.types import Floats, Motion
from mirrorskin.io.watch import axes
from mirrorskin.io.watch.phase_check import PhaseCheck, swing_of
from mirrorskin.io.watch.saturation import MAD, REACHED, scale_ends

_SIDE = 24  # pixels of the grid along each side
_SAMPLES_MAX = 1 << 22  # number of samples above which the grid becomes coarser
_PIXELS_MIN = 64  # minimum number of pixels for findings
_QUANTUM = 1 / math.sqrt(12)  # standard deviation of rounding, counts
_RESPONSE_MIN = 10.0  # minimum change of a pixel that is a response, standard deviations of the noise
_FEW = 0.05  # share of pixels below which their common behaviour is ignored
_CLEARLY = 0.9  # share of pixels that rise, from which frames are those of a press
_MOST_OF = 0.8  # share of pixels that must agree
_FLICKER, _DRIFT = 0.01, 2.0  # tolerated flicker, share of the light; tolerated drift, counts of 8 bits
_PARTS = 10  # of a press, in which its dark level is compared
_DARK, _DARK_PIXELS = 0.25, 0.25  # brightest dark pixel, share of the span; fewest dark pixels, share
_COMMON = 2.0  # minimum change in common, standard deviations of the pixels' own changes
_OF_MEDIAN = math.sqrt(math.pi / 2)  # standard error of a median over that of a mean
_OUTLYING = 0.1  # minimum difference of an outlier from the samples before and after it, share of the span
_OUTLIERS, _FLASH = 0.003, 0.2  # tolerated share of outliers; share in a frame from which it is a flash
_NOISY = 0.3  # share of the pixels that differ between frames because of noise
_AS_ONE = 0.5  # mean direction of the pixels' phases above which all respond alike
_HARMONICS = 3  # number of harmonics of the phase that describe the brightness of a pixel
_PATCH = (64, 96)  # rows and columns in the middle of frames that may show a compression
_PATCH_FRAMES, _PAIRS = 128, 8  # first frames whose patch is kept; pairs of them that are compared
_BLOCK = 8  # pixels of a block of JPEG and of video codecs
_BLOCKY = (1.02, 5.0), (1.08, 8.0)  # ratio and z-score of steps at borders, in both directions or in one
_NO_STEP, _OF_FRAMES = 0.02, 0.4  # steps of frames over other differences; steps of changes over these
_PATTERNS, _REPEATED = 2, 0.45  # that a scene repeats, and their share in its steps
_CONTACT = 0.1  # change of a pixel on contact, at least, share of the span
_ROWS_MIN = 64  # rows with steps at all places of a block
_THIN = 4  # an axis shorter than both others by this factor may be in the wrong place


Samples = NDArray[np.float32]


class FrameSamples:
    """Brightness of a grid of pixels in all frames.

    Parameters
    ----------
    shape : (int, int, int)
        Frames, rows and columns of the source.

    Attributes
    ----------
    rows, columns : ndarray of int
        Rows and columns of the grid in a frame.
    count : int
        Number of frames so far.

    Examples
    --------
    >>> samples = FrameSamples((3, 2, 2))
    >>> samples.push(np.arange(12, dtype=np.uint8).reshape(3, 2, 2))
    >>> samples.values.shape
    (3, 2, 2)
    """

    def __init__(self, shape: tuple[int, int, int]) -> None:
        steps = [-(-length // _SIDE) for length in shape[1:]]
        cuts = [slice((n - 1) % step // 2, None, step) for n, step in zip(shape[1:], steps, strict=True)]
        self._grid = (slice(None), *cuts)
        self.rows, self.columns = (np.arange(n)[part] for n, part in zip(shape[1:], cuts, strict=True))
        self._patch = tuple(
            slice(max(0, n - size) // 2, max(0, n - size) // 2 + size)
            for n, size in zip(shape[1:], _PATCH, strict=True)
        )
        self._parts: list[NDArray[Any]] = []
        self._patches: list[NDArray[Any]] = []
        self.count = 0

    @classmethod
    def of(cls, frames: NDArray[Any]) -> Self:
        """Return samples of a stack."""
        samples = cls((len(frames), frames.shape[1], frames.shape[2]))
        samples.push(frames)
        return samples

    def push(self, frames: NDArray[Any]) -> None:
        """Add the next frames, (n, H, W)."""
        self.push_samples(self.of_frames(frames))

    def of_frames(self, frames: NDArray[Any]) -> NDArray[Any]:
        """Return a copy of the samples of frames, (n, H, W), at the pixels of the grid."""
        if self.count < _PATCH_FRAMES:
            self._patches.append(frames[: _PATCH_FRAMES - self.count, *self._patch].copy())
        return frames[self._grid].copy()

    def push_samples(self, values: NDArray[Any]) -> None:
        """Add the samples of the next frames, (n, rows, columns)."""
        self._parts.append(values)
        self.count += len(values)
        # The grid depends on the number of frames only, which live runs do not know in advance.
        while (
            self.count * len(self.rows) * len(self.columns) > _SAMPLES_MAX
            and len(self.rows) + len(self.columns) > 4
        ):
            down, across = (2, 1) if len(self.rows) >= len(self.columns) else (1, 2)
            self._parts = [part[:, ::down, ::across].copy() for part in self._parts]
            self.rows, self.columns = self.rows[::down], self.columns[::across]
            cuts = (
                slice(int(axis[0]), None, int(axis[1] - axis[0]) if len(axis) > 1 else None)
                for axis in (self.rows, self.columns)
            )
            self._grid = (slice(None), *cuts)

    def of_map(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return a map, (H, W), at the pixels of the grid."""
        return values[self._grid[1:]]

    @property
    def values(self) -> NDArray[Any]:
        """Samples, (T, rows, columns), in the type of the frames."""
        if len(self._parts) > 1:
            self._parts = [np.concatenate(self._parts)]
        return self._parts[0]

    def compression(self, motion: Motion) -> bool:
        """Return whether the changes of neighbouring pixels show blocks of a compression with a loss.

        A codec treats blocks of 8 x 8 pixels, or of a multiple, each for itself, so that their noise changes
        in steps from block to block. Third differences of the change between two frames, across the border
        of two pixels, are larger at every eighth border then. A pattern of this period on the object has
        steps in each frame, which are larger than their changes, or changes that repeat. Pixels of a press
        that change by contact between two frames show the object, and are not compared.
        """
        pairs = [(patch[:-1], patch[1:]) for patch in self._patches if len(patch) > 1]
        single = [patch[0] for patch in self._patches if len(patch) == 1]
        pairs += [(np.stack(single[:-1]), np.stack(single[1:]))] if len(single) > 1 else []
        if not pairs or min(self._patches[0].shape[1:]) < 3 * _BLOCK:
            return False
        before, after = (
            np.concatenate(part) if len(part) > 1 else part[0] for part in zip(*pairs, strict=True)
        )
        chosen = np.unique(np.linspace(0, len(before) - 1, _PAIRS).astype(int))
        first, change = (part[chosen].astype(np.float32) for part in (before, after))
        change -= first
        if not np.isfinite(change).all():
            return False
        limit = np.inf
        if motion == "vertical":
            limit = _CONTACT * float(max(before.max(), after.max()) - min(before.min(), after.min()))
        across = change.swapaxes(1, 2), first.swapaxes(1, 2)
        blocky = [_blocky(change, first, limit), _blocky(*across, limit)]
        (both, clear), (one, clearer) = _BLOCKY
        return all(ratio > both and score > clear for ratio, score in blocky) or (
            any(ratio > one and score > clearer for ratio, score in blocky)
            and all(ratio > 0 for ratio, _ in blocky)
        )


def _blocky(change: Samples, frames: Samples, limit: float) -> tuple[float, float]:
    """Return the ratio of steps across the borders of blocks to others, and its excess in standard errors.

    Borders are those between columns of a change between frames, (n, H, W). Pixels whose change exceeds a
    limit are left out. The ratio is 0 if nothing changes; it is 1, and the excess 0, if the scene explains
    it, or if too few pixels are left.
    """
    middle = change[..., 1:-2] - change[..., 2:-1]
    signed = change[..., 3:] - change[..., :-3] + 3 * middle
    whole = signed.shape[-1] // _BLOCK * _BLOCK
    signed = signed[..., :whole].reshape(-1, whole // _BLOCK, _BLOCK)
    steps = np.sqrt(np.abs(signed))
    large = np.abs(change) > limit
    left = ~(large[..., 3:] | large[..., 2:-1] | large[..., 1:-2] | large[..., :-3])
    left = left[..., :whole].reshape(steps.shape)
    steps[~left] = 0.0
    mean = float(steps.sum()) / max(1, int(left.sum()))
    if mean == 0:
        return 0.0, 0.0
    np.minimum(steps, 2 * mean, out=steps)  # a few large changes, as at the edge of contact, do not decide
    number = left.sum(axis=1)
    rows = number.min(axis=1) > 0
    if np.count_nonzero(rows) < min(_ROWS_MIN, len(rows)):
        return 1.0, 0.0
    series = steps.sum(axis=1)[rows] / number[rows]
    places = series.mean(axis=0)
    border = int(np.argmax(places))
    others = [(border + apart) % _BLOCK for apart in (2, 4, 6)]  # as large in pictures that were enlarged
    other = others[int(np.argmax(places[others]))]
    excess = series[:, border] - series[:, other]
    error = float(np.std(excess)) / math.sqrt(len(excess)) + 1e-9
    ratio, score = float(places[border] / max(places[other], 0.01)), float(excess.mean()) / error
    if score < _BLOCKY[0][1]:
        return ratio, score
    here = frames[..., 3:] - frames[..., :-3] + 3 * (frames[..., 1:-2] - frames[..., 2:-1])
    in_frames = np.sqrt(np.abs(here[..., :whole])).reshape(-1, whole // _BLOCK, _BLOCK).mean(axis=(0, 1))
    scene = in_frames[border] - in_frames[other]
    patterns = np.copysign(steps, signed)
    repeated, usual = (_repeated(patterns[..., place], len(change)) for place in (border, other))
    if scene > max(_NO_STEP * in_frames[other], float(excess.mean()) / _OF_FRAMES):
        return 1.0, 0.0
    return (1.0, 0.0) if repeated > max(_REPEATED, usual + _REPEATED / 3) else (ratio, score)


def _repeated(steps: Samples, frames: int) -> float:
    """Return the share of the two commonest patterns in the steps of each change; 0 if few have steps."""
    rows = steps.reshape(frames, -1)
    sizes = np.linalg.norm(rows, axis=1, keepdims=True)
    rows = rows[sizes[:, 0] > 0] / sizes[sizes[:, 0] > 0]
    if len(rows) <= 2 * _PATTERNS:
        return 0.0
    return float(np.linalg.eigvalsh(np.einsum("in,jn->ij", rows, rows))[-_PATTERNS:].sum()) / len(rows)


def named_frames(numbers: Sequence[int] | NDArray[np.intp]) -> str:
    """Return the names of some frames for a message."""
    shown = ", ".join(str(number) for number in numbers[:3]) + (", ..." if len(numbers) > 3 else "")
    return f"frame {shown}" if len(numbers) == 1 else f"frames {shown}"


class Traces:
    """The brightness of each pixel of the grid over the frames, with facts and findings."""

    def __init__(self, samples: NDArray[Any], motion: Motion, series: Mapping[str, Floats]) -> None:
        self._grid = samples.shape
        self._stored = samples.reshape(len(samples), math.prod(samples.shape[1:]))
        self._integer = samples.dtype.kind == "u"
        self._counts = self._stored.astype(np.float32)
        if not (finite := np.isfinite(self._counts).all(axis=0)).all():
            self._counts = self._counts.compress(finite, axis=1)
        self._motion, self._series = motion, series
        self._known = self._counts.shape[1] >= _PIXELS_MIN and len(self._counts) > 2
        if self._known:
            self._lowest, self._highest = self._counts.min(axis=0), self._counts.max(axis=0)
            self._range = self._highest - self._lowest
            self.span = float(self._highest.max() - self._lowest.min())
            self._fit = self._harmonics()
            self.noise = self._noise()
            self._response = max(_RESPONSE_MIN * self.noise, 0.02 * self.span)  # minimum change of a response
            self._responding = self._range > self._response
            self._share = float(self._responding.mean())

    def facts(self) -> dict[str, str]:
        """Return numbers to print."""
        if not self._known:
            return {}
        low, high = float(self._lowest.min()), float(self._highest.max())
        facts = {"brightness": f"{low:.4g} to {high:.4g} counts{self._depth(high)}"}
        facts["noise"] = f"about {self.noise:.2g} counts"
        facts["cut off"] = f"{_percent(self._clipped)} of the pixels reach the end of the scale"
        facts["respond"] = f"{_percent(self._share)} of the pixels"
        if (flicker := self._flicker) is not None:
            facts["flicker"] = f"{_percent(flicker[0])} of the light"
        if (drift := self._drift) is not None:
            facts["drift"] = f"{drift[0]:.2g} counts of the dark level"
        return facts

    def findings(self, shape: tuple[int, int, int], moved: bool, phased: bool) -> Iterator[Finding]:
        """Yield all findings."""
        if not self._known:
            return
        repeated = list(self._repeated())
        yield from repeated
        if phased:
            yield from self._phases(bool(repeated))
        if not moved:
            return
        if self._share == 0:
            yield Finding(
                "no response", "the brightness changes at no pixel: was there light, and did the body move?"
            )
            return
        order = list(self._axes(shape))
        yield from order
        if self._share > _FEW and not order:
            yield from self._press() if self._motion == "vertical" else self._turn()
        if (clipped := self._clipped) > REACHED:
            ends = self._ends[np.isfinite(self._ends)]
            end = f", {ends[0]:.6g}" if np.ptp(ends) == 0 else ""
            yield Finding(
                "cut off",
                f"{_percent(clipped)} of the pixels reach the end of the scale{end}: shorten the exposure",
            )
        if (flicker := self._flicker) is not None and flicker[0] > max(_FLICKER, 5 * flicker[1]):
            yield Finding(
                "flicker",
                f"the light flickers by {_percent(flicker[0])} from frame to frame: use a steady lamp",
            )
        if (drift := self._drift) is not None and drift[0] > max(_DRIFT * self._scale(), 10 * drift[1]):
            yield Finding(
                "drift",
                f"the dark level drifts by {drift[0]:.2g} counts: let the camera warm up, and keep stray"
                " light away",
            )

    def _scale(self) -> float:
        """Return counts per count of 8 bits."""
        return self.span / 255 if not self._integer or self.span > 255 else 1.0

    def _depth(self, high: float) -> str:
        """Return which bits of integers are in use."""
        if not self._integer:
            return ""
        used = int(np.bitwise_or.reduce(self._stored, axis=None))
        if not used:
            return ""
        idle = (used & -used).bit_length() - 1
        lower = f", the lowest {idle} of them 0" if idle else ""
        return f" ({int(high).bit_length()} bits in use{lower})"

    @functools.cached_property
    def _ends(self) -> NDArray[np.float32]:
        """The end of the scale at each pixel; infinite if unknown."""
        return scale_ends(self._stored, self._counts)

    @functools.cached_property
    def _clipped(self) -> float:
        return float(np.mean(self._highest >= self._ends))

    def _harmonics(self) -> Floats | None:
        """Return the brightness as fitted by harmonics of the phase, (T, n); None without a fit."""
        phase = self._series.get("phase")
        if self._motion != "axial" or phase is None:
            return None
        order = min(_HARMONICS, (len(phase) - 2) // 2)
        if order < 1:
            return None
        angles = phase[:, np.newaxis] * np.arange(1, order + 1)
        columns = np.column_stack([np.ones(len(phase)), np.cos(angles), np.sin(angles)])
        basis = np.linalg.qr(columns)[0].astype(np.float32)
        return np.asarray(basis @ (basis.T @ self._counts))

    def _noise(self) -> float:
        """Return an estimate of the standard deviation of a sample, from the smallest changes."""
        steps = np.diff(self._counts, axis=0)
        estimates = [MAD * float(np.median(_medians(np.abs(steps)))) / math.sqrt(2)]
        if self._fit is not None:
            residual = np.abs(self._counts - self._fit)
            estimates.append(MAD * float(np.median(residual)))
            if len(steps) > 1:
                estimates.append(MAD * float(np.median(np.abs(np.diff(steps, axis=0)))) / math.sqrt(6))
        return max(min(estimates), _QUANTUM if self._integer else 0.0)

    def _repeated(self) -> Iterator[Finding]:
        """Yield a finding for frames identical to the preceding one, if other frames differ everywhere."""
        counts = self._counts
        inside = (counts[1:] > 0) & (counts[1:] < self._ends)  # where noise is not clipped
        differ = np.count_nonzero((counts[1:] != counts[:-1]) & inside, axis=1)
        again = np.flatnonzero((differ == 0) & (inside.sum(axis=1) >= _PIXELS_MIN)) + 1
        if len(again) and np.median(differ) > _NOISY * counts.shape[1]:
            yield Finding(
                "repeated frames",
                f"{named_frames(again)}: identical to the one before, so later positions may be wrong:"
                " remove it, or give the position of each frame",
            )

    def _phases(self, repeated: bool) -> Iterator[Finding]:
        """Yield findings of a jump of the phase, and of a drift of the brightness of all pixels."""
        phase = self._series.get("phase")
        if self._motion != "axial" or phase is None:
            return
        check = PhaseCheck(self._counts, phase)
        if not repeated and (jump := check.jump()) is not None:
            frame, steps, step = jump
            cause = "there twice" if steps < 0 else "missing"
            frames = "a frame" if abs(steps) == 1 else f"{steps} frames"
            yield Finding(
                "phase jump",
                f"from frame {frame} on, the brightness fits phases {abs(math.degrees(steps * step)):.3g}"
                f" degrees {'further' if steps > 0 else 'back'}, as if {frames} before it"
                f" {'was' if abs(steps) == 1 else 'were'} {cause}: give the phase of each frame",
            )
        drift = check.drift()
        if drift is not None and abs(drift[0]) > max(_DRIFT * self._scale(), 10 * drift[1]):
            yield Finding(
                "drift",
                f"the brightness of all pixels drifts by {drift[0]:.2g} counts: let camera and lamp warm up,"
                " and keep stray light away",
            )

    def _axes(self, shape: tuple[int, int, int]) -> Iterator[Finding]:
        """Yield a finding if the last axis seems to be the frames: short, with changing brightness."""
        thin = min(shape[1:])
        if _THIN * thin > min(shape[0], max(shape[1:])):
            return
        samples = self._pictures
        over_time = samples.mean(axis=(1, 2))
        along = samples.mean(axis=(0, 1 if shape[2] == thin else 2))
        if np.nanvar(along) > 4 * np.nanvar(over_time):
            yield axes.finding(
                f"{shape[0]} frames of {shape[2]} x {shape[1]} pixels, whose light changes along their"
                f" {thin} pixels rather than over time"
            )

    def _press(self) -> Iterator[Finding]:
        if not self._goes_down():
            return
        if (outliers := self._outliers()) > _OUTLIERS:
            yield Finding(
                "outliers",
                f"{_percent(outliers)} of the samples differ from both the one before and the one after, so"
                " heights near them are wrong: look for defective pixels, or for errors of the transmission",
            )
        travel = self._series["travel"]
        rises, falls = self._changes(self._of_responding, np.sign(travel[-1] - travel[0]))
        is_press = rises > _CLEARLY or axes.changes_once(self._of_responding) >= axes.CHANGES_ONCE
        if not is_press and (axis := axes.axis_of_press(self._pictures, self._response)):
            yield axes.finding(f"brightness changes once along the {axis} of the pictures, and not over time")
        elif falls > _MOST_OF * (rises + falls) and falls > 0.2:
            axis = axes.axis_of_press(self._pictures, self._response)
            yield Finding(
                "reversed",
                f"brightness falls with travel at {_percent(falls)} of the pixels that respond: are the"
                " frames reversed, or is it a release (--event release)"
                f"{', or is the order of the axes not (T, H, W)' if axis else ''}?",
            )
        elif rises + falls < 1 - _MOST_OF:
            yield Finding(
                "not a press",
                f"brightness returns to where it began at {_percent(1 - rises - falls)} of the pixels that"
                " respond, although the travel does not: is this a rotation?",
            )

    def _outliers(self) -> float:
        """Return the share of samples of a press that differ from those before and after."""
        steps = np.diff(self._counts, axis=0)
        limit = max(_RESPONSE_MIN * self.noise, _OUTLYING * self.span)
        apart = (np.minimum(steps[:-1], -steps[1:]) > limit) | (np.maximum(steps[:-1], -steps[1:]) < -limit)
        of_frame = apart.mean(axis=1)
        return float(np.mean(np.where(of_frame < _FLASH, of_frame, 0)))

    @functools.cached_property
    def _of_responding(self) -> Samples:
        """The brightness of responding pixels, (T, n)."""
        return self._counts.compress(self._responding, axis=1)  # in C order, unlike selection by a mask

    @property
    def _pictures(self) -> Samples:
        """The brightness of all pixels of the grid, (T, rows, columns)."""
        return self._stored.reshape(self._grid).astype(np.float32)

    @staticmethod
    def _changes(counts: Samples, direction: float = 1.0) -> tuple[float, float]:
        """Return the shares of series, (T, n), that end far above and far below their start."""
        few = max(1, len(counts) // 10)
        change = counts[-few:].mean(axis=0) - counts[:few].mean(axis=0)
        change *= direction / np.ptp(counts, axis=0)
        return float(np.mean(change > 0.5)), float(np.mean(change < -0.5))

    def _turn(self) -> Iterator[Finding]:
        phase = self._series.get("phase")
        if self._motion != "axial" or phase is None or len(phase) < 5:
            return
        turned = np.abs(phase - phase[0])
        last = int(np.argmin(np.abs(turned - 2 * math.pi)))
        step = float(np.median(np.abs(np.diff(phase))))
        if step > math.pi / 2 or abs(turned[last] - 2 * math.pi) > 1.5 * step:  # a body may also rock
            return
        counts, extent = self._of_responding, self._range[self._responding]
        jump = float(np.median(np.abs(counts[last] - counts[0]) / extent))
        # A precession whose tilt changes does not return.
        same_tilt = "axes" not in self._series and np.ptp(self._series.get("tilt", np.zeros(1))) == 0
        apart = same_tilt and axes.ends_apart(self._counts) > axes.STAYS_AWAY
        apart = apart and axes.changes_once(counts) < axes.CHANGES_ONCE  # otherwise it is a press
        if apart and (axis := axes.axis_of_turn(self._pictures)):
            yield axes.finding(f"brightness returns along the {axis} of the pictures, and not over time")
        elif jump > 0.5:
            yield Finding(
                "not a rotation",
                f"brightness does not return after a whole turn: half of the pixels that respond end"
                f" {_percent(jump)} of their range away: is this a press?",
            )

    def _common(self, counts: Samples, used: NDArray[np.bool_]) -> tuple[Floats, Floats, float] | None:
        """Return the common deviation of used pixels in each frame, its error, and their level."""
        counted = np.count_nonzero(used, axis=1)
        enough = counted >= _PIXELS_MIN // 2
        if np.count_nonzero(enough) < 5:
            return None
        counts, used, counted = counts[enough], used[enough], counted[enough]
        lit = np.where(used, counts, 0)
        levels = np.sum(lit, axis=0) / np.maximum(np.count_nonzero(used, axis=0), 1)
        offset = _medians(np.where(used, counts - levels, np.inf), counted)
        errors = _OF_MEDIAN * self.noise / np.sqrt(counted)
        return offset, errors, float(np.sum(levels * used) / np.sum(counted))

    @functools.cached_property
    def _flicker(self) -> tuple[float, float] | None:
        """Return the standard deviations of the common light, and of its noise, as shares."""
        if self._fit is not None and len(self._counts) >= 2 * (2 * _HARMONICS + 1):
            residual = self._counts - self._fit
            if float(np.mean(residual**2)) > 0.02 * float(np.var(self._counts)):
                return None  # harmonics do not describe the brightness
            wave = swing_of(self._of_responding, self._series["phase"])
            if wave.size and abs(np.mean(wave / np.abs(wave))) > _AS_ONE:
                return None  # on a flat object, light that is not a cosine would look the same
            gain = np.median(residual / np.maximum(self._fit, 1e-3 * self._highest.max()), axis=1)
            error = 1.25 * self.noise / math.sqrt(self._fit.shape[1]) / float(np.mean(self._fit))
            return float(np.std(gain)), error
        if not self._goes_down() or self._share < _FEW:
            return None
        counts = self._of_responding
        lit = counts - self._lowest[self._responding] > 0.8 * self._range[self._responding]
        lit[2:] &= lit[:-2]  # for two frames
        lit[:2] = False
        lit &= np.count_nonzero(lit, axis=0) >= 5
        common = self._common(counts, lit)
        if common is None or common[2] <= 0:
            return None
        offset, errors, level = common
        return float(np.std(np.diff(offset)) / math.sqrt(2) / level), float(np.mean(errors) / level)

    @functools.cached_property
    def _drift(self) -> tuple[float, float] | None:
        """Return the range of the dark level over the parts of a press, and its error, counts.

        Each part is compared with the first, in the pixels that are still dark in the part after it: a pixel
        that is about to turn light, perhaps after the last frame, becomes brighter without a drift. So does
        a dark pixel next to light ones, because lenses blur. It is brighter than others then, whereas a drift
        is common to many pixels: the differences between them that noise does not explain are small.
        """
        if not self._goes_down() or len(self._counts) < 5:
            return None
        travel = self._series["travel"]
        counts = self._counts if travel[-1] > travel[0] else self._counts[::-1]
        parts = np.array_split(counts, min(_PARTS, len(counts)))
        means = np.stack([part.mean(axis=0) for part in parts])
        change = np.maximum.accumulate([np.abs(part - means[0]).max(axis=0) for part in parts])
        dark = (change < self._response) & (means[0] < self._lowest.min() + _DARK * self.span)
        start = counts[: len(parts[0]) + len(parts[1])].compress(dark[2], axis=1)
        if start.shape[1] < _PIXELS_MIN:
            return None
        noise = MAD / math.sqrt(2) * float(np.median(np.abs(np.diff(start, axis=0))))
        noise = max(noise, _QUANTUM if self._integer else 0.0)
        levels, error = [0.0], 0.0
        for part, mean, used in zip(parts[1:-1], means[1:-1], dark[2:], strict=True):
            pixels = np.count_nonzero(used)
            if pixels < max(_PIXELS_MIN, _DARK_PIXELS * used.size):
                break
            rise = (mean - means[0])[used]
            common = float(np.median(rise))
            spread = MAD * float(np.median(np.abs(rise - common)))
            by_noise = noise * math.sqrt(1 / len(parts[0]) + 1 / len(part))
            levels.append(common if common**2 > _COMMON**2 * (spread**2 - by_noise**2) else 0.0)
            error = max(error, _OF_MEDIAN * by_noise / math.sqrt(pixels))
        return (max(levels) - min(levels), error) if len(levels) > 1 else None

    def _goes_down(self) -> bool:
        """Return whether the travel of a press only rises, or only falls."""
        travel = self._series.get("travel")
        if self._motion != "vertical" or travel is None:
            return False
        delta = float(travel[-1] - travel[0])
        return delta != 0 and bool(np.all(np.diff(travel) * delta >= 0))


def _medians(values: NDArray[Any], count: NDArray[np.intp] | None = None) -> NDArray[Any]:
    """Return the median of each row, (T, n), or of its ``count`` smallest values."""
    if count is None:
        count = np.full(len(values), values.shape[1])
    ordered, row = np.sort(values, axis=1), np.arange(len(values))
    return np.asarray((ordered[row, (count - 1) // 2] + ordered[row, count // 2]) / 2)


def _percent(fraction: float) -> str:
    return f"{100 * fraction:.2g} %" if fraction < 0.995 else f"{100 * fraction:.0f} %"
