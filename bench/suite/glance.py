"""The first table and the chart of the page: ten works of the engine, their peers and their limits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from io import BytesIO

from mirrorskin.cli.commands.bench.records import Case, as_ms

HEAD = ("call", "limit", "mirrorskin", "fastest peer", "times as fast")

_CHOSEN = (
    ("full-memory", "", "onset with sigma, 240 frames of 4K (2 GB)"),
    ("full-uint8", "", "onset with sigma, 64 frames of 1080p"),
    ("equation4-memory", "", "onset by equation 4, 240 frames of 4K"),
    ("normals-uint8", "", "normals with sigma, 8 frames of 1080p"),
    ("normals-4k", "", "normals with sigma, 8 frames of 4K"),
    ("correlate-uint8", "", "correlation, 64 frames of 1080p"),
    ("correlate-4k", "", "correlation, 8 frames of 4K"),
    ("integrate-rectangle", "from slopes", "heights from slopes, 1024 x 1024"),
    ("integrate-mask", "from slopes", "the same within a mask"),
    ("file-lab", "file to result", "HDF5 file to saved heights, 256 frames of 1080p"),
)
"""Case, part of the work, and title in the table, in the order of the table."""
_COLOURS = {
    "NumPy": "tab:blue",
    "SciPy": "tab:cyan",
    "OpenCV": "tab:green",
    "PyTorch": "tab:red",
    "Numba": "tab:purple",
    "pyamg": "tab:brown",
    "h5py and NumPy argmax": "tab:olive",
    "h5py and Numba": "tab:pink",
}


@dataclass(frozen=True, slots=True)
class Entry:
    """Times of one work, s: the limit of memory, the engine, and peers by name."""

    title: str
    limit: float
    ours: float
    peers: Mapping[str, float]


def entries(cases: Mapping[str, Case]) -> list[Entry]:
    """Return the chosen works that were measured."""
    return [_entry(cases[name], part, title) for name, part, title in _CHOSEN if name in cases]


def _entry(case: Case, part: str, title: str) -> Entry:
    works = {row.name: row.wall.median for row in case.rows}
    same = {name.partition(", ")[0]: time for name, time in works.items() if name.partition(", ")[2] == part}
    ours = same.pop("mirrorskin")
    return Entry(title, works["read limit"], ours, {who: same[who] for who in _COLOURS if who in same})


def as_cells(entry: Entry) -> list[str]:
    """Return an entry as cells under `HEAD`."""
    who = min(entry.peers, key=lambda name: entry.peers[name])
    fastest = entry.peers[who]
    ratio = f"{fastest / entry.ours:.1f}"
    return [entry.title, as_ms(entry.limit), as_ms(entry.ours), f"{who} {as_ms(fastest)}", ratio]


def draw(shown: list[Entry]) -> bytes:
    """Return the chart as SVG; the same entries give the same bytes."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context({"svg.hashsalt": "mirrorskin", "svg.fonttype": "none", "font.size": 10}):
        figure = Figure(figsize=(9.5, 0.42 * len(shown) + 1.5), layout="constrained")
        axes = figure.subplots()
        for height, entry in enumerate(reversed(shown)):
            slowest = max(entry.ours, *entry.peers.values())
            axes.plot([entry.limit * 1e3, slowest * 1e3], [height] * 2, color="0.85", linewidth=1, zorder=1)
        heights = range(len(shown) - 1, -1, -1)
        limits, ours = [entry.limit * 1e3 for entry in shown], [entry.ours * 1e3 for entry in shown]
        axes.scatter(limits, heights, marker="|", s=150, color="0.4", label="memory limit")
        axes.scatter(ours, heights, s=90, color="tab:orange", label="mirrorskin")
        for who, colour in _COLOURS.items():
            points = {
                height: entry.peers[who] * 1e3
                for entry, height in zip(shown, heights, strict=True)
                if who in entry.peers
            }
            if points:
                axes.scatter([*points.values()], [*points], s=35, color=colour, marker="D", label=who)
        axes.set_yticks(list(heights), [entry.title for entry in shown])
        axes.set_xscale("log")
        axes.set_xlabel("time of a call in milliseconds, logarithmic; left is faster")
        axes.xaxis.set_major_formatter(lambda value, _position: f"{value:g}")
        axes.grid(axis="x", color="0.92")
        axes.set_axisbelow(True)
        axes.tick_params(axis="y", length=0)
        axes.spines[["top", "right", "left"]].set_visible(False)
        figure.legend(loc="outside upper center", ncols=5, frameon=False)
        file = BytesIO()
        figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    return file.getvalue()
