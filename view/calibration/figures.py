"""Figures of a calibration: one for each part that there is."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mirrorskin.io import Calibration, InputError
from mirrorskin.io.calibration.types import GROUPS
from mirrorskin.view.calibration.gel import draw_gel
from mirrorskin.view.calibration.lens import draw_lens
from mirrorskin.view.calibration.references import draw_references
from mirrorskin.view.calibration.tilt import draw_precession
from mirrorskin.view.calibration.zenith import draw_response
from mirrorskin.view.canvas import check_drawing, save_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DRAW: Mapping[str, Callable[[Any], Figure]] = {
    "references": draw_references,
    "lens": draw_lens,
    "zenith": draw_response,
    "precession": draw_precession,
    "gel": draw_gel,
}


def calibration_figures(calibration: Calibration, folder: Path) -> list[Path]:
    """Draw the parts of a calibration into PNGs.

    Parameters
    ----------
    calibration : Calibration
    folder : Path
        Where ``references.png``, ``scale.png``, ``zenith.png``, ``tilt.png`` and ``elastic.png`` go, as many
        as the calibration has parts; it is made if it is not there.

    Returns
    -------
    list of Path
        What was written.

    Raises
    ------
    InputError
        Matplotlib is not installed, or a file cannot be written.
    """
    check_drawing()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder} cannot be made: {error.strerror}; name another folder with -o") from error
    written = []
    for name, part in calibration.parts().items():
        path = folder / f"{GROUPS[name]}.png"
        save_figure(_DRAW[name](part), f"{Path(calibration.name).name}: {GROUPS[name]}", path)
        written.append(path)
    return written
