"""Matplotlib figures, maps with colour bars, and output of figures to files and windows."""

from __future__ import annotations

import logging
import os
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.io import InputError
from mirrorskin.io.base.text import printable
from mirrorskin.io.base.types import Floats
from mirrorskin.io.model.maps import FILLED_SHADES
from mirrorskin.io.model.parameters import Part, parameters
from mirrorskin.io.storage.atomic import write_new
from mirrorskin.view.drawing.colours import MISSING, SEQUENTIAL

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage
    from matplotlib.text import Text

Extent = tuple[float, float, float, float]
"""Outer edges of a map's pixels: left, right, bottom and top."""

BESIDE: Mapping[str, Any] = {"loc": "center left", "bbox_to_anchor": (1.0, 0.5), "frameon": False}
"""Position of a legend outside of a panel, to the right of it."""

_ROUND = 1, 2, 5, 10
_DPI = 110  # pixels per inch in files
_ENLARGED = 1.2  # by what the layout may make axes larger than they were

FIGURE_SUFFIXES = (".png", ".pdf", ".svg")
"""Suffixes of files that figures are written to: pixels, or lines and texts."""


_SHOWN = 1.0, 99.0  # percentiles at the ends of the colour scale


def check_drawing() -> None:
    """Raise InputError if figures cannot be drawn, before any work is done."""
    if find_spec("matplotlib") is None:
        raise InputError("figures need Matplotlib: pip install 'mirrorskin[view]'")
    # Matplotlib warns if the home directory cannot be written, and uses a temporary folder.
    logging.getLogger("matplotlib").setLevel(logging.ERROR)


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure with a size in inches."""
    check_drawing()
    import matplotlib
    from matplotlib.figure import Figure

    if Path(matplotlib.matplotlib_fname()).absolute().parent == Path.cwd():  # perhaps of a stranger
        matplotlib.rcParams["text.usetex"] = False  # which runs LaTeX
    return Figure(figsize=(width, height), layout="constrained")


def save_figure(figure: Figure, title: str, path: Path, resolution: float = 1.0) -> None:
    """Write a figure with its title, or raise InputError; see `write_figure`."""
    figure.suptitle(title, x=0.02, ha="left", weight="bold")
    write_figure(figure, path, resolution)


def write_figure(figure: Figure, path: Path, resolution: float = 1.0) -> None:
    """Write a figure as PNG, PDF or SVG, which appears complete or not at all, or raise InputError.

    The resolution of pixels is relative to that of other figures.
    """
    suffix = path.suffix.lower()
    drawn = (
        encode_figure(figure, resolution * _DPI)
        if suffix == ".png"
        else _encode_lines(figure, suffix.removeprefix("."))
    )
    write_new(path, [drawn])


def _encode_lines(figure: Figure, form: str) -> bytes:
    """Return a figure as PDF or SVG, the same for the same figure; texts can be selected and searched."""
    import matplotlib

    _print_texts_as_they_are(figure)
    date = {"pdf": "CreationDate", "svg": "Date"}[form]
    target = BytesIO()
    settings: Any = {"svg.fonttype": "none", "svg.hashsalt": "mirrorskin", "pdf.fonttype": 42}
    with matplotlib.rc_context(settings), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from font")
        figure.savefig(target, format=form, dpi=_DPI, metadata={date: None})
    return target.getvalue()


def encode_figure(figure: Figure, dpi: float) -> bytes:
    """Return a figure as a PNG."""
    from PIL import Image

    target = BytesIO()
    Image.fromarray(figure_pixels(figure, dpi)).save(target, format="png", dpi=(dpi, dpi))
    return target.getvalue()


def figure_pixels(figure: Figure, dpi: float) -> NDArray[np.uint8]:
    """Return a figure's pixels, (H, W, 3): red, green and blue."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    _print_texts_as_they_are(figure)
    figure.set_dpi(dpi)
    canvas = FigureCanvasAgg(figure)
    with warnings.catch_warnings(), _thinned_out(figure):
        warnings.filterwarnings("ignore", "Glyph .* missing from font")
        canvas.draw()  # type: ignore[no-untyped-call]  # once; savefig draws twice
    return np.asarray(canvas.buffer_rgba())[..., :3]  # type: ignore[no-untyped-call]


@contextmanager
def _thinned_out(figure: Figure) -> Iterator[None]:
    """Thin out maps with twice as many pixels as are drawn: Matplotlib takes long to resample large ones."""
    whole = []
    for axes in figure.axes:
        box = axes.get_position()
        width, height = (
            max(1.0, _ENLARGED * n) for n in (box.width * figure.bbox.width, box.height * figure.bbox.height)
        )
        for image in axes.images:
            values: Any = image.get_array()
            rows, columns = values.shape[:2]
            step = int(min(rows // height, columns // width))
            if step < 2:
                continue
            whole.append((image, values))
            if values.ndim == 2:  # numbers, of which one for each pixel is drawn
                image.set_data(values[step // 2 :: step, step // 2 :: step])
            else:
                import cv2

                size = -(-columns // step), -(-rows // step)
                image.set_data(cv2.resize(np.asarray(values), size, interpolation=cv2.INTER_AREA))
    try:
        yield
    finally:
        for image, values in whole:
            image.set_data(values)


def _print_texts_as_they_are(figure: Figure) -> None:
    """Print "$" in titles, labels and legends literally: names of files and maps are not formulas.

    Tick labels are formulas made by Matplotlib.
    """
    for text in _texts(figure):
        text.set_parse_math(False)
        text.set_text("\n".join(map(printable, text.get_text().split("\n"))))


def _texts(artist: Artist) -> Iterator[Text]:
    """Yield the texts below an artist, but for those of ticks, which Matplotlib makes when it draws."""
    from matplotlib.axis import Axis
    from matplotlib.text import Text

    if isinstance(artist, Text):
        yield artist
    for part in [artist.label] if isinstance(artist, Axis) else artist.get_children():
        yield from _texts(part)


def extent(x: Floats, y: Floats) -> Extent:
    """Return the outer edges of a map's pixels, in the unit of ``x`` and ``y``.

    A picture of one row or one column gets square pixels; one of a single pixel
    is 1 x 1.
    """
    steps = [abs(float(along[1] - along[0])) if len(along) > 1 else None for along in (x, y)]
    across, up = ((step or steps[1 - axis] or 1.0) / 2 for axis, step in enumerate(steps))
    return float(x[0] - across), float(x[-1] + across), float(y[-1] - up), float(y[0] + up)


def draw_image(
    axes: Axes,
    values: NDArray[Any],
    place: Extent | None = None,
    label: str = "",
    extend: str = "neither",
    **colours: Any,
) -> AxesImage:
    """Draw a map, pixel by pixel; undefined pixels have their own colour."""
    axes.set_facecolor(MISSING)
    picture = axes.imshow(values, extent=place, **{"interpolation": "nearest", **colours})
    if label:
        explain_colours(axes, picture, label, extend)
    return picture


def explain_colours(axes: Axes, picture: ScalarMappable, label: str, extend: str = "neither") -> None:
    """Draw a colour bar adjacent to a map."""
    bar = axes.inset_axes((1.03, 0, 0.04, 1))
    axes.figure.colorbar(picture, cax=bar, label=label, extend=extend)
    bar.yaxis.label.set_parse_math(False)


def explain_heights(
    axes: Axes,
    ends: tuple[float, float],
    label: str,
    extend: str = "neither",
    *,
    filled: bool,
    text: float,
    place: tuple[float, float],
) -> None:
    """Draw a colour bar of heights adjacent to a panel, and with ``filled`` one of filled heights next to it.

    The bars have one scale and their names on them, in letters of that size. The first starts at ``place[0]``
    and each has the width ``place[1]``, relative to the panel.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    left, width = place
    shades = {"measured": (SEQUENTIAL, "white")} | ({"filled": (filled_colours(), "black")} if filled else {})
    for number, (name, (colours, ink)) in enumerate(shades.items()):
        bar = axes.inset_axes((left + 1.15 * width * number, 0, width, 1))
        axes.figure.colorbar(ScalarMappable(Normalize(*ends), colours), cax=bar, extend=extend)
        if filled:
            bar.text(
                *(0.5, 0.5, name),
                transform=bar.transAxes,
                rotation=90,
                ha="center",
                va="center",
                fontsize=text,
                color=ink,
            )
        if number < len(shades) - 1:
            bar.set_yticks([])
    bar.set_ylabel(label, parse_math=False)


def exceeded(values: NDArray[Any], low: float, high: float) -> str:
    """Return which ends of the colour scale are exceeded, as an argument of ``explain_colours``."""
    below, above = bool(np.any(values < low)), bool(np.any(values > high))
    return {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}[below, above]


def draw_classes(
    axes: Axes,
    classes: NDArray[np.uint8],
    colours: Sequence[str],
    labels: Mapping[int, str],
    place: Extent | None = None,
    interpolation: str = "nearest",
) -> AxesImage:
    """Draw a map of classes, with a legend of those that have a label."""
    from matplotlib.colors import to_rgb
    from matplotlib.patches import Patch

    table = np.array([np.multiply(255, to_rgb(colour)).round() for colour in colours], np.uint8)
    picture = draw_image(axes, table[classes], place, interpolation=interpolation)
    patches = [
        Patch(facecolor=colours[number], edgecolor="0.5", label=label) for number, label in labels.items()
    ]
    axes.legend(handles=patches, handlelength=1, handleheight=1, **BESIDE)
    return picture


def filled_colours() -> Colormap:
    """Return the colour map of filled heights."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("filled", FILLED_SHADES)


def round_length(length: float, up: bool = False) -> float:
    """Return the nearest 1, 2 or 5 times a power of ten that is not longer, or with ``up`` not shorter."""
    power = 10.0 ** np.floor(np.log10(length))
    steps = [factor * power for factor in _ROUND]
    if up:
        return float(next(step for step in steps if step >= length * (1 - 1e-9)))
    return float(max(step for step in steps if step <= length * (1 + 1e-9)))


_SCREEN = 1600, 900  # largest size of a window in pixels
_DISPLAYS = "DISPLAY", "WAYLAND_DISPLAY"  # variables of screens of Linux


def has_screen() -> bool:
    """Return whether Matplotlib can open windows, also considering ``MPLBACKEND``."""
    check_drawing()
    import matplotlib
    from matplotlib.backends.registry import BackendFilter, backend_registry

    opens = backend_registry.list_builtin(BackendFilter.INTERACTIVE)  # type: ignore[no-untyped-call]
    chosen = matplotlib.get_backend(auto_select=False)
    has_display = sys.platform != "linux" or any(map(os.environ.get, _DISPLAYS))
    if not has_display if chosen is None else chosen.lower() not in opens:
        return False  # as pyplot would find, which takes long to import
    from matplotlib import pyplot

    try:
        pyplot.switch_backend(matplotlib.get_backend())
    except ImportError:  # the requested backend is not installed
        return False
    return matplotlib.get_backend().lower() in opens


def show_figure(figure: Figure, title: str) -> None:
    """Show a figure in a window, until it is closed."""
    from matplotlib import pyplot

    def ready(*_: Any, **__: Any) -> Figure:
        return figure

    _print_texts_as_they_are(figure)
    figure.set_dpi(min(figure.get_dpi(), *np.divide(_SCREEN, figure.get_size_inches())))
    # pyplot creates windows only for figures that it creates itself.
    pyplot.figure(num=title, FigureClass=cast("type[Figure]", ready))
    pyplot.show()


def new_sheet(width: float, height: float) -> Figure:
    """Return an empty figure, in inches, on which colour bars stay next to their maps."""
    figure = new_figure(width, height)
    figure.set_layout_engine("compressed")
    return figure


def draw_pixels(
    axes: Axes, values: ArrayLike, title: str, label: str, colours: str = SEQUENTIAL, even: bool = False
) -> None:
    """Draw a map of all pixels, with a colour bar."""
    shown = np.asarray(values, np.float64)
    finite = shown[np.isfinite(shown)]
    low, high = (float(v) for v in np.percentile(finite, _SHOWN)) if finite.size else (0.0, 1.0)
    if even:
        high = max(abs(low), abs(high))
        low = -high
    if high - low <= 1e-6 * max(abs(low), abs(high)):  # a single value has no range
        low, high = low - 0.5, high + 0.5
    beyond = exceeded(finite, low, high)
    draw_image(axes, shown, label=label, extend=beyond, cmap=colours, vmin=low, vmax=high)
    summary = f"median {np.median(finite):.4g} {label.split()[0]}" if finite.size else "no answer"
    blue = "; blue: no answer" if 0 < finite.size < shown.size else ""
    axes.set(title=f"{title}\n{summary}{blue}", xlabel="column (px)", ylabel="row (px)")


def draw_parameter(axes: Axes, part: Part, name: str, colours: str = SEQUENTIAL) -> None:
    """Draw a map of a calibration, with the text and in the unit that are declared."""
    declaration = parameters(part)[name]
    values = getattr(part, name) * declaration.factor
    draw_pixels(axes, values, declaration.text.partition(";")[0], declaration.shown_unit, colours)
