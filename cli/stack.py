"""Options that describe a stack of frames: positions, pixel size, region, frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict

from mirrorskin.cli.declared import Term, Terms, term
from mirrorskin.cli.groups import MOTIONS
from mirrorskin.io.formats.registry import sources

if TYPE_CHECKING:
    from mirrorskin.io import Motion, Region
    from mirrorskin.io.base.types import Floats
    from mirrorskin.io.model.positions import Positions


class StackOptions(TypedDict, total=False):
    """The keywords of ``io.open_recording`` that describe a stack; those not given are missing."""

    dataset: str
    channel: int
    motion: Motion
    travel: Positions
    phase: Positions
    tilt: float
    pixel_size: tuple[float, float]
    region: Region
    frames: tuple[int, int | None]
    verify: bool


_PRESS, _TURN = ("vertical",), ("axial",)

STACK = Terms(
    [
        term(
            "dataset",
            "the stack in another program's file: a dataset, array, topic, or number of a series or stream",
            "/entry/data",
            kind="text",
        ),
        Term("channel", "integer", "channel of a TIFF, or colour: 0 red, 1 green, 2 blue", least=0),
        Term("motion", "choice", "how the body moved, if the file does not say", choices=MOTIONS),
        term("travel_step", "travel from frame to frame: 0.1mm", "mm", motions=_PRESS),
        term("travel_start", "travel of the first frame; without it 0mm", "mm", motions=_PRESS),
        term(
            "travel",
            "travel of all frames, mm, one number a frame: a text, CSV or NPY",
            "FILE.csv",
            kind="file",
            motions=_PRESS,
        ),
        term("phase_step", "phase from frame to frame: 45deg", "rad", motions=_TURN),
        term(
            "phases",
            "phases of all frames, a text of angles: 178.1deg 220.8deg ...",
            "FILE.txt",
            kind="file",
            motions=_TURN,
        ),
        term("tilt", "half-angle of the precession: 2.5deg", "rad", motions=_TURN),
        term("pixel_size", "size of a pixel at the sheet: 0.03mm", "mm,mm"),
        term("region", "only W x H pixels, from column X and row Y on: 100,50,640x480", "region"),
        term("frames", "only frames A to B - 1; the first frame is 0", "range"),
        term("verify", "compare whole frames with the checksums in the file", kind="flag", shown="verify"),
    ]
)
"""Properties that a recording may lack, and the part of it that is used."""
RECORDING = STACK.without("tilt")
CHOICE = STACK.only("dataset", "channel")
IMPORTED = STACK.without("motion", "region", "frames")
FORMATS = sources()
"""Source of the frames."""


def stack_options(chosen: dict[str, Any], where: str = "--") -> StackOptions:
    """Remove the options of a stack, except the tilt, and return keywords of `io.open_recording`.

    Messages put ``where`` before an option's name.
    """
    names = [term.name for term in STACK.terms if term.name != "tilt"]
    values = {name: chosen.pop(name) for name in names if name in chosen}
    options = StackOptions()
    for name in ("dataset", "channel", "motion", "pixel_size", "region", "frames", "verify"):
        if name in values:
            options[name] = values[name]
    if isinstance(chosen.get("tilt"), float):
        options["tilt"] = chosen["tilt"]
    return options | _travel(values, where) | _phase(values)


def stack_words(chosen: Mapping[str, Any]) -> list[str]:
    """Return the words of a command for the options of a stack that are given, except for region and frames.

    Examples
    --------
    >>> stack_words({"travel_step": 0.1, "pixel_size": (0.03, 0.04), "threshold": 0.4})
    ['--travel-step=0.1mm', '--pixel-size=0.03mm,0.04mm']
    >>> stack_words({"verify": False})
    ['--no-verify']
    """
    words = []
    for option in STACK.terms:
        if option.name not in chosen or option.name in ("region", "frames"):
            continue
        value = chosen[option.name]
        if option.kind == "flag":
            words.append(option.flag if value else f"--no-{option.flag[2:]}")
            continue
        values = value if isinstance(value, tuple) else (value,)
        unit = option.unit.partition(",")[0] if option.unit in ("mm", "rad", "mm,mm") else ""
        words.append(f"{option.flag}={','.join(f'{part}{unit}' for part in values)}")
    return words


def _travel(values: Mapping[str, Any], where: str) -> StackOptions:
    from mirrorskin.io import InputError, Steps

    other = where.rpartition(" ")[2]
    if "travel" in values:
        if "travel_step" in values or "travel_start" in values:
            raise InputError(
                f"{where}travel is that of all frames. Remove {other}travel-step and {other}travel-start"
            )
        return {"travel": read_travel(values["travel"])}
    if "travel_step" in values:
        return {"travel": Steps(values["travel_step"], values.get("travel_start", 0.0))}
    if "travel_start" in values:
        raise InputError(f"{where}travel-start needs {other}travel-step: give both")
    return {}


def _phase(values: Mapping[str, Any]) -> StackOptions:
    from mirrorskin.io import InputError, Steps

    if "phase_step" in values and "phases" in values:
        raise InputError("--phase-step and --phases both give the phases. Remove one of them")
    if "phase_step" in values:
        return {"phase": Steps(values["phase_step"])}
    return {"phase": read_phases(values["phases"])} if "phases" in values else {}


@dataclass(frozen=True, slots=True)
class Listed:
    """Positions listed by a file, one per frame, mm or radians; see ``io.Positions``."""

    path: Path
    what: str
    values: tuple[float, ...]

    def positions(self, count: int) -> Floats:
        """Return the positions of ``count`` frames; InputError if their number differs."""
        import numpy as np

        from mirrorskin.io import InputError

        if len(self.values) != count:
            raise InputError(
                f"{self.path} lists {len(self.values)} {self.what} for {count} frames: one a frame is needed"
            )
        return np.array(self.values)


def read_phases(path: Path) -> Listed:
    """Read the phase of each frame: angles with units, or numbers under a heading with a unit."""
    from mirrorskin.cli.table import read_column

    remedy, names = "write one angle a frame in it, such as 178.1deg", (("phase", "phases"), ("angle",))
    return Listed(path, "phases", read_column(path, "angle", "phases", remedy, names))


def read_travel(path: Path) -> Listed:
    """Read the travel of each frame: an array of NumPy's, mm, or a table.

    Numbers in a table are mm unless they, or the heading of their column, state another unit.
    """
    from mirrorskin.cli.table import read_column

    if path.suffix.lower() == ".npy":
        from mirrorskin.io.files.arrays import read_array

        return Listed(path, "travels", tuple(map(float, read_array(path).reshape(-1))))
    remedy = "write one length a frame in it, such as 0.15mm"
    names = ("travel", "travels"), ("position", "pos"), ("z",), ("depth", "displacement")
    return Listed(path, "travels", read_column(path, "length", "travels", remedy, names, "mm"))
