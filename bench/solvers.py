"""The works that find heights: the engine's and the peers', from slopes, with their set-up, and alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mirrorskin import engine
from mirrorskin.bench.harness import Work
from mirrorskin.bench.ours import OURS
from mirrorskin.bench.peers.integration import Peer, pyamg_
from mirrorskin.bench.peers.integration.graph import Flags, Floats, link
from mirrorskin.bench.peers.integration.rectangle import divisors
from mirrorskin.bench.peers.integration.system import as_map, assemble, centre
from mirrorskin.bench.slopes import PIXEL
from mirrorskin.bench.truth import Truth
from mirrorskin.engine.integration.graph import Links
from mirrorskin.engine.integration.rectangle import Rectangle
from mirrorskin.engine.integration.vcycle import Multigrid
from mirrorskin.kernels.device import Device

SLOPES, SETUP, SOLVE = "from slopes", "set-up and solve", "solve only"
PYAMG = "pyamg"

_SQUARE = (1.0, 1.0)  # pixel, whose links have the weight 1


def work_name(who: str, part: str) -> str:
    """Return what a work is called: whose it is, and how much of the way it goes."""
    return f"{who}, {part}"


def rectangle_works(slopes: Floats, source: Floats, device: Device) -> dict[str, Work]:
    """Return the engine's works for a full picture; each returns heights, (H, W).

    Parameters
    ----------
    slopes : ndarray, (2, H, W), float32
    source : ndarray, (H, W), float32
        What links of weight 1 make of them.
    device : Device
    """
    given = device.given("source", source)
    rows, columns = source.shape
    ready = Rectangle((rows, columns), _SQUARE, device)
    return {
        work_name(OURS, SLOPES): lambda: _integrate(slopes, None, None, device),
        work_name(OURS, SETUP): lambda: Rectangle((rows, columns), _SQUARE, device).solve(given).download(),
        work_name(OURS, SOLVE): lambda: ready.solve(given).download(),
    }


def transform_works(peer: Peer, slopes: Floats, source: Floats) -> dict[str, Work]:
    """Return the same works of a peer; see `rectangle_works`."""
    shape, dtype = source.shape, np.float32
    ready = divisors(shape, dtype)
    return {
        work_name(peer.name, SLOPES): lambda: peer.solve(
            link(slopes, PIXEL).source.astype(dtype), divisors(shape, dtype)
        ),
        work_name(peer.name, SETUP): lambda: peer.solve(source, divisors(shape, dtype)),
        work_name(peer.name, SOLVE): lambda: peer.solve(source, ready),
    }


def mask_works(slopes: Floats, mask: Flags, edges: Flags | None, device: Device) -> dict[str, Work]:
    """Return the engine's works within a mask; each returns heights, (H, W).

    Only those from slopes have the mean 0 in each component, and NaN outside the mask.
    """
    graph = link(slopes, PIXEL, mask, edges)
    right, down = np.zeros((2, *mask.shape), np.float32)
    right[:, :-1], down[:-1] = graph.right, graph.down
    maps = device.given("right", right), device.given("down", down)
    rows, columns = mask.shape
    links = Links(device, (rows, columns), *maps, None, device.given("source", graph.source))
    ready = Multigrid(links)

    return {
        work_name(OURS, SLOPES): lambda: _integrate(slopes, mask, edges, device),
        work_name(OURS, SETUP): lambda: Multigrid(links).solve().height.download(),
        work_name(OURS, SOLVE): lambda: ready.solve().height.download(),
    }


def pyamg_works(
    slopes: Floats, mask: Flags, edges: Flags | None, truth: Truth, error: float
) -> tuple[dict[str, Work], int]:
    """Return pyamg's works, and the iterations that they do: as few as bring the error to `error`.

    The work from slopes returns a map as `mask_works` does, the others heights of linked pixels, (N,).
    """
    graph, system = link(slopes, PIXEL, mask, edges), truth.system
    ready = pyamg_.set_up(system.matrix)
    count = pyamg_.fewest_iterations(ready, system.source, truth.error, error)

    def solve() -> NDArray[np.float64]:
        return pyamg_.solve(ready, system.source, count)

    def set_up() -> NDArray[np.float64]:
        made = assemble(graph)
        return pyamg_.solve(pyamg_.set_up(made.matrix), made.source, count)

    def whole() -> NDArray[np.float32]:
        made = assemble(link(slopes, PIXEL, mask, edges))
        values = pyamg_.solve(pyamg_.set_up(made.matrix), made.source, count)
        return as_map(made, centre(made, values), mask != 0)

    works: tuple[Work, ...] = (whole, set_up, solve)
    return {work_name(PYAMG, p): w for p, w in zip((SLOPES, SETUP, SOLVE), works, strict=True)}, count


def _integrate(
    slopes: Floats, mask: Flags | None, edges: Flags | None, device: Device
) -> NDArray[np.float32]:
    dz_dx, dz_dy = slopes
    found = engine.integrate(dz_dx, dz_dy, PIXEL, mask=mask, edges=edges, sigma=False, device=device)
    return found.height
