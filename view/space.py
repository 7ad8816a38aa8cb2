"""A surface in 3D, shown in rerun's viewer."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mirrorskin.engine.summary import summarise
from mirrorskin.io import InputError, Mesh, Result, select_turn, surface_mesh
from mirrorskin.io.mesh import normals_around
from mirrorskin.io.units import numbers_with_unit
from mirrorskin.view.colours import FILLED_RGB, Colours, height_colours, span
from mirrorskin.view.viewer import close_stream, load_rerun, open_stream

_END = 60.0  # seconds to wait until the surface has reached the viewer


def show_surface(result: Result, where: str | Path, name: str) -> None:
    """Show the heights of a result as a surface, in millimetres along all three axes.

    Colours go from violet to yellow with the height; filled heights are orange, and holes are kept.

    Parameters
    ----------
    result : Result
        Maps of one turn, with heights and pixel size.
    where : str or Path
        "window", "browser", or the name of a file; see ``open_stream``.
    name : str
        Name of the result.

    Raises
    ------
    mirrorskin.io.InputError
        The result has no three adjacent heights, or no pixel size; rerun is not installed or does
        not start, or the file cannot be written.
    """
    result = select_turn(result, None)
    mesh = _mesh(result, name)
    assert result.height is not None
    rr = load_rerun()
    stream = open_stream(where, "--3d")
    stream.send_blueprint(_blueprint(name))
    stream.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    surface = rr.Mesh3D(
        vertex_positions=mesh.vertices,
        triangle_indices=mesh.faces,
        vertex_normals=normals_around(mesh, np.ones(len(mesh.vertices), bool)),
        vertex_colors=_colours(result, mesh),
    )
    stream.log("surface", surface, static=True)
    text = "\n\n".join(_description(result, name))
    stream.log("about", rr.TextDocument(text, media_type="text/markdown"), static=True)
    close_stream(stream, _END)


def _mesh(result: Result, name: str) -> Mesh:
    """Return the surface; InputError if there is none."""
    if result.height is None:
        raise InputError(f"{name} has no heights: there is no surface to show")
    if result.x is None or result.y is None:
        raise InputError(f"{name} has no pixel size: reconstruct it again with --pixel-size")
    mesh = surface_mesh(result.height, result.x, result.y, component=result.component)
    if not mesh.faces.size:
        raise InputError(f"{name} has no three neighbours with heights: there is no surface to show")
    return mesh


def _colours(result: Result, mesh: Mesh) -> Colours:
    """Return the colours of the vertices, (N, 3)."""
    assert result.height is not None
    colours = height_colours(result.height, *span(result.height)).reshape(-1, 3)[mesh.pixels]
    if result.filled is not None:
        colours[result.filled.ravel()[mesh.pixels] > 0] = FILLED_RGB
    return colours


def _description(result: Result, name: str) -> Iterator[str]:
    """Yield a description in paragraphs."""
    assert result.height is not None
    (low, high), unit = numbers_with_unit(span(result.height), "mm")
    yield f"**{name}**"
    yield str(summarise(result))
    yield "x to the right, y up the picture, z towards the camera; all in millimetres"
    yield f"heights from {low} (violet) to {high} {unit} (yellow)"
    if result.filled is not None and result.filled.any():
        yield "orange: not measured but filled"
    if result.offset_unknown is not None and result.offset_unknown.any():
        yield "heights of each piece are relative to its mean: the absolute offset is unknown"


def _blueprint(name: str) -> Any:
    """Return the layout of the viewer."""
    import rerun.blueprint as rrb

    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(origin="/", name=name),
            rrb.TextDocumentView(origin="about", name="About"),
            column_shares=[4, 1],
        ),
        auto_views=False,
        collapse_panels=True,
    )
