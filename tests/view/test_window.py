"""Windows are opened only if there is a screen."""

import matplotlib
import pytest
from matplotlib import pyplot
from matplotlib.figure import Figure

from mirrorskin.view.drawing import canvas as window


@pytest.fixture
def backend():
    """Matplotlib without windows, and afterwards as it was."""
    before = matplotlib.get_backend()
    pyplot.switch_backend("agg")
    yield
    pyplot.close("all")
    pyplot.switch_backend(before)


@pytest.mark.usefixtures("backend")
def test_without_windows_there_is_no_screen():
    assert not window.has_screen()


@pytest.mark.usefixtures("backend")
@pytest.mark.parametrize("name", ["tkagg", "QtAgg"])
def test_a_means_to_open_windows_is_a_screen(monkeypatch, name):
    asked = []
    monkeypatch.setattr(matplotlib, "get_backend", lambda **_: name)
    monkeypatch.setattr(pyplot, "switch_backend", asked.append)
    assert window.has_screen()
    assert asked == [name]


@pytest.mark.usefixtures("backend")
def test_a_means_that_fails_here_is_not_a_screen(monkeypatch):
    def refuse(name):
        raise ImportError(f"cannot load {name}: headless")

    monkeypatch.setattr(matplotlib, "get_backend", lambda **_: "tkagg")
    monkeypatch.setattr(pyplot, "switch_backend", refuse)
    assert not window.has_screen()


@pytest.mark.usefixtures("backend")
def test_the_figure_itself_is_shown(monkeypatch):
    shown = []
    monkeypatch.setattr(pyplot, "show", lambda: shown.append(pyplot.gcf()))
    figure = Figure(figsize=(3, 2))
    window.show_figure(figure, "ball.h5")
    assert shown == [figure]
    assert figure.canvas.manager.num == pyplot.gcf().number
    assert pyplot.get_figlabels() == ["ball.h5"]
    assert tuple(figure.get_size_inches()) == (3, 2)


@pytest.mark.usefixtures("backend")
@pytest.mark.parametrize(
    ("size", "pixels"), [((20, 5), (1600, 400)), ((4, 30), (120, 900)), ((4, 3), (400, 300))]
)
def test_a_large_figure_is_made_to_fit_a_screen(monkeypatch, size, pixels):
    monkeypatch.setattr(pyplot, "show", lambda: None)
    figure = Figure(figsize=size, dpi=100)
    window.show_figure(figure, "ball.h5")
    assert figure.bbox.size == pytest.approx(pixels)
