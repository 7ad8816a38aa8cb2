"""A figure in a window of this machine, where there is a screen."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import numpy as np

from mirrorskin.view.canvas import check_drawing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SCREEN = 1600, 900  # pixels that a window may take


def has_screen() -> bool:
    """Tell whether Matplotlib finds a way to open windows here; ``MPLBACKEND`` has its say."""
    check_drawing()
    import matplotlib
    from matplotlib import pyplot
    from matplotlib.backends.registry import BackendFilter, backend_registry

    try:
        pyplot.switch_backend(matplotlib.get_backend())
    except ImportError:  # the one that was asked for cannot be here
        return False
    opens = backend_registry.list_builtin(BackendFilter.INTERACTIVE)  # type: ignore[no-untyped-call]
    return matplotlib.get_backend().lower() in opens


def show_figure(figure: Figure, title: str) -> None:
    """Show a figure in a window, until it is closed."""
    from matplotlib import pyplot

    def ready(*_: Any, **__: Any) -> Figure:
        return figure

    figure.set_dpi(min(figure.get_dpi(), *np.divide(_SCREEN, figure.get_size_inches())))
    # pyplot makes a window only for what it makes itself.
    pyplot.figure(num=title, FigureClass=cast("type[Figure]", ready))
    pyplot.show()
