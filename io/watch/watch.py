"""Plausibility checks of frames while they are read: facts and findings."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.checksums import UNVERIFIED_PARTS
from mirrorskin.io.base.findings import Finding
from mirrorskin.io.base.text import course
from mirrorskin.io.base.types import Block, Floats, Source
from mirrorskin.io.model.frames import LOSSY, lossy
from mirrorskin.io.watch.mirrored import MIRRORED, TurnMoments
from mirrorskin.io.watch.traces import FrameSamples, Traces, named_frames

FIELD = (0.05, 200.0)
"""Usual sides of the field of view, mm; the body of the sensor in the paper measures 35 mm."""
TRAVEL = (0.005, 20.0)
"""Usual travel of a press, mm."""

_EVEN = 1e-3  # relative difference up to which steps of a position are even
_GAP = 1.5  # time between two frames above which frames are missing, in intervals

_RESPONDS = 0.3  # least change of a pixel that becomes light, share of the span
_SLOPES, _SLOPES_MIN = 6, 32  # parts of a side over which slopes are computed; their least number
_STEEPEST = 3.0  # typical slope that a press can have
_SURFACE = 0.5  # largest squared step between neighbours, as a share of that between any two: 1 is chance

Limits = tuple[float, float]


@dataclass(frozen=True)
class CheckReport:
    """Facts and findings about frames; ``print`` shows them.

    Attributes
    ----------
    name : str
        Name of the source.
    facts : dict of str
        Names and values to print.
    findings : tuple of Finding
        Warnings and notes.
    """

    name: str
    facts: dict[str, str]
    findings: tuple[Finding, ...] = field(default=())

    @property
    def warnings(self) -> tuple[Finding, ...]:
        """The findings that are warnings: results may be wrong."""
        return tuple(finding for finding in self.findings if finding.warning)

    def __str__(self) -> str:
        width = max(map(len, self.facts), default=0)
        lines = [f"{name:<{width}}  {value}" for name, value in self.facts.items()]
        lines += [f"{'warning' if finding.warning else 'note'}: {finding.text}" for finding in self.findings]
        return "\n".join([self.name, *lines] if lines else [self.name, "nothing is known"])


class FrameChecker:
    """Collects samples and positions of the frames of a source while they are read.

    ``moved``: whether the brightness must respond to the motion. ``phased``: whether it must fit the phases.
    ``alone``: whether no operation looks at the slopes of the frames, on the host.
    """

    def __init__(
        self, source: Source, moved: bool = True, phased: bool = True, *, alone: bool = False
    ) -> None:
        self._source, self._moved, self._phased = source, moved, phased
        self._turn = TurnMoments(source.shape) if alone and source.motion == "axial" else None
        self.samples = FrameSamples(source.shape)
        self._series: dict[str, list[Floats]] = {
            "time": [],
            "travel": [],
            "phase": [],
            "tilt": [],
            "axes": [],
        }
        self._lost = 0

    def push(self, block: Block, samples: NDArray[Any] | None = None) -> None:
        """Add the next frames; their ``samples`` on the grid are given if they are on a device."""
        if samples is None:
            self.samples.push(block.frames)
        else:
            self.samples.push_samples(samples)
        self._lost += block.dropped
        if self._turn is not None:
            self._turn.push(block)
        for name, parts in self._series.items():
            values = getattr(block, name)
            if values is not None:
                parts.append(values)

    def check(self, field_limits: Limits = FIELD, travel_limits: Limits = TRAVEL) -> CheckReport:
        """Return the check of the frames so far."""
        series, traces = self._look()
        source = self._source
        facts = {"frames": f"{self.samples.count} of {source.shape[2]} x {source.shape[1]}, {source.dtype}"}
        facts |= _facts(source, series, traces)
        findings = self._findings(series, traces, field_limits, travel_limits)
        header, order = source.header, any(finding.kind in ("axes", "phases") for finding in findings)
        if self._turn is not None and not order:
            mirrored = self._turn.is_mirrored(header.zenith_offset, header.zenith_gain)
            findings += (MIRRORED,) * mirrored
        return CheckReport(source.name, facts, findings)

    def findings(self) -> tuple[Finding, ...]:
        """Return the findings about the frames so far, for a result, which states their region itself."""
        findings = self._findings(*self._look(), FIELD, TRAVEL)
        return tuple(finding for finding in findings if finding != UNVERIFIED_PARTS)

    def _look(self) -> tuple[dict[str, Floats], Traces]:
        """Return the positions and times of the frames so far, and their brightness."""
        source, series = self._source, self.series
        samples = self.samples.values if self.samples.count else np.empty((0, 0, 0), source.dtype)
        if "axes" in series and "phase" not in series:  # brightness follows the direction of the axis
            x, y = series["axes"][:, :2].T
            return series, Traces(samples, source.motion, {**series, "phase": np.unwrap(np.arctan2(y, x))})
        return series, Traces(samples, source.motion, series)

    @property
    def series(self) -> dict[str, Floats]:
        """Times and positions that all frames so far have, (T,), by name."""
        return {
            name: np.concatenate(parts)
            for name, parts in self._series.items()
            if parts and sum(map(len, parts)) == self.samples.count
        }

    def _findings(
        self, series: Mapping[str, Floats], traces: Traces, field_limits: Limits, travel_limits: Limits
    ) -> tuple[Finding, ...]:
        source = self._source
        dropped = getattr(source, "dropped", None)
        lost = self._lost if dropped is None else int(np.sum(dropped))
        known = getattr(source, "findings", ())
        shown = getattr(source, "shows_compression", lambda: self.samples.compression(source.motion))
        undeclared = shown() and not any(finding.kind == LOSSY and finding.warning for finding in known)
        lengths = tuple(_geometry(source, series, field_limits, travel_limits))
        return (
            *known,
            *([lossy("blocks of 8 x 8 pixels")] if undeclared else []),
            *(lengths or _slopes(source, series, self.samples)),
            *_order(source, series, lost),
            *traces.findings(source.shape, self._moved, self._phased),
        )


def _facts(source: Source, series: Mapping[str, Floats], traces: Traces) -> dict[str, str]:
    facts = {}
    size = source.header.pixel_size
    if size is not None:
        width, height = source.shape[2] * size[0], source.shape[1] * size[1]
        facts["field"] = f"{width:.4g} x {height:.4g} mm, {size[0]:.4g} x {size[1]:.4g} mm a pixel"
    for name, factor, unit in (("travel", 1.0, "mm"), ("phase", math.degrees(1), "deg")):
        if name in series:
            facts[name] = _range_of(series[name] * factor, unit)
    if "time" in series and len(series["time"]) > 1:
        facts["time"] = f"{series['time'][-1] - series['time'][0]:.4g} s"
    levels = [
        "given" if getattr(source.header, level) is not None else "not given" for level in ("dark", "bright")
    ]
    return {**facts, **traces.facts(), "levels": f"dark {levels[0]}, bright {levels[1]}"}


def _range_of(values: Floats, unit: str) -> str:
    steps = np.abs(np.diff(values))
    text = f"{' to '.join(f'{value:.4g}' for value in course(values.tolist()))} {unit}"
    if not len(steps):
        return text
    even = np.ptp(steps) <= _EVEN * max(float(np.max(steps)), 1e-12)
    return f"{text}, {'' if even else 'about '}{np.median(steps):.4g} {unit} a frame"


def _geometry(
    source: Source,
    series: Mapping[str, Floats],
    field_limits: Limits,
    travel_limits: Limits,
) -> Iterator[Finding]:
    """Yield findings about implausible lengths, as caused by a wrong unit."""
    size = source.header.pixel_size
    if size is not None:
        _, rows, columns = getattr(source, "full_shape", source.shape)
        sides = columns * size[0], rows * size[1]
        if max(sides) > field_limits[1] or max(sides) < field_limits[0]:
            yield Finding(
                "field",
                f"the field is {sides[0]:.4g} x {sides[1]:.4g} mm, and {_from_to(field_limits)} are usual:"
                " is the pixel size in mm?",
            )
    if source.motion == "vertical" and "travel" in series:
        extent = float(np.ptp(series["travel"]))
        if 0 < extent < travel_limits[0] or extent > travel_limits[1]:
            yield Finding(
                "travel",
                f"the travel is {extent:.4g} mm in all, and {_from_to(travel_limits)} are usual:"
                " is it in mm?",
            )
    phase = series.get("phase")
    if phase is not None and len(phase) > 2 and (step := float(np.median(np.abs(np.diff(phase))))) > math.pi:
        yield Finding("phases", f"phases step by {step:.4g} rad from frame to frame: are they in degrees?")


def _slopes(source: Source, series: Mapping[str, Floats], samples: FrameSamples) -> Iterator[Finding]:
    """Yield a finding if a press is as deep as is impossible on its field: most slopes are too steep.

    Heights are roughly those of the frames in which pixels become light, on the grid of samples. Where
    neighbours agree no more than other pixels, there is no surface whose slopes show the units.
    """
    size, travel = source.header.pixel_size, series.get("travel")
    if size is None or travel is None or source.motion != "vertical" or len(travel) < 3:
        return
    direction = np.sign(travel[-1] - travel[0])
    if direction == 0 or np.any(np.diff(travel) * direction < 0):
        return
    order = slice(None, None, int(direction))
    counts, depths = samples.values[order].astype(np.float32), travel[order]
    lowest, highest = counts.min(axis=0), counts.max(axis=0)
    responds = highest - lowest > _RESPONDS * float(np.max(highest) - np.min(lowest))
    light = counts > (lowest + highest) / 2
    onset = np.argmax(light, axis=0)
    height = np.where(responds & (onset > 0) & light[-1], depths[onset], np.nan)
    steps = np.concatenate([np.diff(height, axis=axis).ravel() for axis in (0, 1)])
    known, steps = height[np.isfinite(height)], steps[np.isfinite(steps)]
    if len(steps) < _SLOPES_MIN or np.mean(steps**2) > _SURFACE * 2 * np.var(known):
        return
    apart = [max(1, length // _SLOPES) for length in height.shape]
    sides = [
        step * float(axis[1] - axis[0]) * pixel
        for step, axis, pixel in zip(apart, (samples.rows, samples.columns), size[::-1], strict=True)
        if len(axis) > step
    ]
    if len(sides) < 2:
        return
    down, across = apart
    here = height[:-down, :-across]
    slope = np.hypot((height[down:, :-across] - here) / sides[0], (height[:-down, across:] - here) / sides[1])
    slope = slope[np.isfinite(slope)]
    if len(slope) >= _SLOPES_MIN and (typical := float(np.median(slope))) > _STEEPEST:
        extent, angle = float(np.ptp(travel)), math.degrees(math.atan(typical))
        yield Finding(
            "steep slopes",
            f"a travel of {extent:.4g} mm and pixels of {size[0]:.4g} x {size[1]:.4g} mm make slopes of"
            f" {angle:.0f} degrees typical, which no sheet follows: are both in mm?",
        )


def _from_to(limits: Limits) -> str:
    return f"{limits[0]:g} to {limits[1]:g} mm"


def _order(source: Source, series: Mapping[str, Floats], lost: int) -> Iterator[Finding]:
    """Yield findings about missing frames."""
    kinds = {finding.kind for finding in getattr(source, "findings", ())}
    if lost and "lost frames" not in kinds:
        yield Finding("lost frames", f"{lost} frame{'s were' if lost > 1 else ' was'} lost", False)
    time = series.get("time")
    position = series.get({"vertical": "travel", "axial": "phase"}.get(source.motion, ""))
    if time is None or position is None or len(time) < 4 or lost:
        return
    steps = np.diff(time)
    usual = float(np.median(steps))
    late = np.flatnonzero(steps > _GAP * usual)
    moves = np.diff(position)
    even = np.ptp(moves) <= _EVEN * float(np.max(np.abs(moves)))  # computed, not measured
    if even and usual > 0 and 0 < len(late) <= len(steps) // 4:
        missing = round(float(np.sum(steps[late]) / usual)) - len(late)
        yield Finding(
            "time gap",
            f"{named_frames(late + 1)} came late, as if {missing} frames were missing, but positions are"
            " evenly spaced: give the position of each frame",
        )
