"""Texts of a report: captions of pictures, meanings of maps, and a result's parameters and provenance."""

from __future__ import annotations

from collections.abc import Mapping

PICTURES: Mapping[str, tuple[str, str]] = {
    "height": (
        "Height. Blue has no answer, and orange was filled, not measured.",
        "Map of the height in millimetres, seen from above",
    ),
    "section": (
        "Cut along the line from A to B; the band is as many expected standard deviations as it says.",
        "Cross-section: height along the line from A to B",
    ),
    "normals": (
        "Normals: red, green and blue stand for their parts along x, y and z; edges are black.",
        "Map of the surface normals in colours",
    ),
    "azimuth": (
        "Azimuth: which way the surface faces, counter-clockwise from x.",
        "Map of the azimuth in the colours of a circle",
    ),
    "modulation": (
        "Modulation: how far the brightness swings in a turn.",
        "Map of the modulation in counts",
    ),
    "edges": ("Edges: where the normal jumps or contact ends.", "Map of the edges"),
    "status": ("What became of each pixel.", "Map of the status of the pixels, with a legend"),
    "sigma": (
        "Expected errors: the standard deviation that is expected of each pixel's answer.",
        "Map of the expected errors",
    ),
    "slope": ("Slope along the direction in which the body rocked.", "Map of the slope along one direction"),
    "hysteresis": (
        "Hysteresis: by how much the release is higher than the onset.",
        "Map of the hysteresis in micrometres",
    ),
    "growth": (
        "Growth: the share of full light that a pixel gains with the travel of a dithering press.",
        "Map of the growth of the light, per millimetre",
    ),
    "displacement": (
        "Displacement of the skin since the first frame, in the last one; arrows point along it.",
        "Map of the skin's displacement in micrometres, with arrows",
    ),
    "slip": ("How far the body had come when the skin broke loose.", "Map of the onset of slip"),
    "histogram": ("How often each height occurs.", "Histogram of the heights"),
}
"""Caption and alternative text of each picture."""

MAPS: Mapping[str, tuple[str, str]] = {
    "height": ("mm", "height of the surface; 0 is the sheet at rest, and z runs towards the camera"),
    "height_sigma": ("mm", "the standard deviation that is expected of the height"),
    "status": (
        "",
        "0 invalid input, 1 onset, 2 never light, 3 light at start; of a release: 1 release, "
        "2 dark at start, 3 light to the end; of a tilt of each frame: 1 normal, 2 none, 4 only a slope; "
        "of a slide or a twist: 0 unknown, 1 slipped, 2 sticks, 3 no contact, 4 no texture; "
        "of a focus stack: 1 in focus, 2 no peak, 3 peak at an end of the stack",
    ),
    "hysteresis": ("mm", "by how much the release is higher than the onset, in a press that oscillates"),
    "hysteresis_sigma": ("mm", "the standard deviation that is expected of the hysteresis"),
    "strokes": ("", "in how many strokes there was what the height is made of"),
    "growth": ("1/mm", "share of full light that a pixel gains with the travel of a dithering press"),
    "growth_sigma": ("1/mm", "the standard deviation that is expected of the growth"),
    "slope": ("", "how much the surface rises along the direction in which the body rocked"),
    "slope_sigma": ("", "the standard deviation that is expected of the slope"),
    "normals": ("", "unit normals of the surface: x, y and z"),
    "zenith": ("rad", "angle between the normal and the direction to the camera"),
    "azimuth": ("rad", "direction in which the normal leans, counter-clockwise from x"),
    "normal_sigma": ("rad", "the angle by which the normal is expected to be wrong (RMS)"),
    "mean": ("counts", "mean brightness over the turn"),
    "cosine": ("counts", "part of the brightness that goes with the cosine of the phase"),
    "sine": ("counts", "part of the brightness that goes with the sine of the phase"),
    "modulation": ("counts", "amplitude of the brightness over the turn"),
    "residual": ("counts", "standard deviation of the brightness that the turn does not explain"),
    "edges": ("", "1 where the normal jumps or contact ends"),
    "filled": ("", "1 where nothing was measured, and the height is a smooth surface between those around"),
    "contact": ("", "1 where the sheet was in contact in every frame"),
    "component": (
        "",
        "connected pixels are one piece, and share a number; heights of two pieces say nothing of "
        "each other. -1: no height",
    ),
    "slope_min": ("rad", "least inclination of the sheet, by the highest level of light that it passes"),
    "slope_max": ("rad", "greatest inclination of the sheet, by the lowest level that it does not pass"),
    "pressure": ("MPa", "between sensor and object at the greatest travel; 0 where nothing touches"),
    "displacement": ("mm", "how far the skin has moved along x and y since the first frame"),
    "displacement_sigma": ("mm", "the standard deviation that is expected of that along either axis"),
    "slip_onset": ("mm, of a twist rad", "the way of the body after which the skin broke loose"),
    "slip_onset_sigma": ("mm, of a twist rad", "the standard deviation that is expected of the onset"),
    "traction": ("MPa", "what the object exerts on the sensor along x and y at the end"),
}
"""Of each map its unit in the file, and what it says."""

UNITS = (
    "Lengths are in millimetres. x runs to the right and y up the picture, both from its centre to the "
    "centres of the pixels; z runs towards the camera. Angles are radians in the file, and degrees in "
    "pictures.",
    "A pixel without an answer is NaN in the file and empty in pictures. Every uncertainty is a standard "
    "uncertainty (k = 1).",
)
"""What holds for all numbers of a result."""

PIXELS = "The pixel size of this result is unknown, so positions are in pixels from the centre."

_FIRST = (
    "program",
    "version",
    "date",
    "source",
    "dataset",
    "source_fingerprint",
    "source_modified",
    "source_region",
    "source_frames",
    "device",
    "driver",
    "calibration",
    "calibration_parts",
)
"""Entries of a process that are provenance; the others are parameters."""

_UNITS = {
    **dict.fromkeys(("tilt", "angle"), "rad"),
    **dict.fromkeys(("centre_x", "centre_y"), "mm"),
    "slope_direction": "rad",
    **dict.fromkeys(("travel", "travel_amplitude"), "mm"),
    **dict.fromkeys(("area_growth", "area_growth_sigma"), "mm^2/mm"),
    **dict.fromkeys(("frequency", "frequency_sigma"), "Hz"),
    "zenith_error": "rad",
    "zenith_gain": "counts/rad",
    **dict.fromkeys(("zenith_offset", "noise", "dark", "bright", "low", "high"), "counts"),
}
_MOTIONS = {"vertical": "Press", "axial": "Rotation"}
_FUSED = "fusion"

Rows = list[tuple[str, str]]


def split_process(process: Mapping[str, object]) -> tuple[dict[str, Rows], dict[str, Rows]]:
    """Split a result's process into parameters and provenance, as text."""
    parameters: dict[str, Rows] = {}
    provenance: dict[str, Rows] = {}
    for name, value in process.items():
        motion, own = _motion_of(name) if process.get("method") == _FUSED else ("", name)
        place = provenance if own in _FIRST else parameters
        place.setdefault(motion, []).append((own.replace("_", " "), _text(own, value)))
    for rows in provenance.values():
        rows.sort(key=lambda row: _FIRST.index(row[0].replace(" ", "_")))
    return parameters, provenance


def _motion_of(name: str) -> tuple[str, str]:
    motion, _, own = name.partition("_")
    return (_MOTIONS[motion], own) if motion in _MOTIONS else ("", name)


def _text(name: str, value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g} {_UNITS.get(name, '')}".strip()
    return str(value)
