"""What commands import: libraries that take long to import are loaded only by what needs them."""

import pytest
from commands import done, loaded

SIZE = "--size", "48x40", "--pixel-size", "0.25mm"
SLOW = {
    "asyncio",
    "dask",
    "matplotlib",
    "numpy.polynomial",
    "numpy.testing",
    "pint",
    "rich",
    "scipy",
    "tifffile",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A press, a rotation, and the surface from both."""
    place = tmp_path_factory.mktemp("start")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        done("simulate", "vertical", *SIZE, "-o", "press.h5")
        done("simulate", "axial", *SIZE, "--pattern", "linear", "-o", "turn.h5")
        done("fuse", "press.h5", "turn.h5", "-o", "fused.h5")
    return place


@pytest.mark.parametrize(
    ("words", "needed"),
    [
        ("reconstruct press.h5 -o press-result.h5", set()),
        ("reconstruct turn.h5 -o turn-result.h5", set()),
        ("fuse press.h5 turn.h5 -o fused.h5", set()),
    ],
)
def test_a_command_imports_only_what_it_needs(words, needed, folder, monkeypatch):
    monkeypatch.chdir(folder)
    modules = loaded(*words.split())
    assert {f"mirrorskin.cli.{words.split()[0]}", "numpy"} <= modules
    assert modules & SLOW == needed
