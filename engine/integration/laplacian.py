"""The multigrid solver of `integrate` for any graph Laplacian on a picture."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.base.errors import NotConverged
from mirrorskin.engine.integration.graph import Links, find_components
from mirrorskin.engine.integration.multigrid import Multigrid
from mirrorskin.engine.integration.surface import IntegrationOptions
from mirrorskin.io import InputError
from mirrorskin.io.base.arguments import as_array_or_number, check_number, checked, or_none
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.integration.links import DOWN, KNOWN, RIGHT, SLOPE

if TYPE_CHECKING:
    from scipy.sparse.linalg import LinearOperator


@checked(
    right=as_array_or_number,
    down=as_array_or_number,
    diagonal=as_array_or_number,
    tolerance=or_none(check_number),
)
def invert_laplacian(
    right: ArrayLike,
    down: ArrayLike,
    diagonal: ArrayLike | None = None,
    *,
    tolerance: float | None = 1e-5,
    device: str | Device | None = None,
) -> LinearOperator:
    """Return the inverse of a graph Laplacian of a picture's pixels, as a SciPy operator.

    For a map u, and neighbours j of pixel i, the matrix A gives ::

        (A u)_i = sum of w_ij (u_i - u_j)  +  a_i u_i

    The operator solves A u = b by conjugate gradients with multigrid in float32. As the preconditioner of a
    float64 solver, it reduces the error of each of its steps to the tolerance.

    Parameters
    ----------
    right : array_like, (H, W - 1)
        Weights w of the links from pixels to the next ones on the right, in any unit; 0 without a link.
    down : array_like, (H - 1, W)
        Weights w of the links to the pixels below.
    diagonal : array_like, (H, W), optional
        Values a added to the diagonal; 0 by default. A is singular if all are 0 in a connected component:
        then the mean of b over the component is subtracted, and the mean of u is 0.
    tolerance : float or None
        Energy norm of the error over that of u. None does one multigrid cycle, which is a preconditioner:
        linear and positive definite.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.

    Returns
    -------
    scipy.sparse.linalg.LinearOperator
        H W by H W, symmetric, for maps flattened in C order; for one thread at a time. The columns of a
        matrix are solved together, several times as fast as one after the other. `NotConverged` is raised if
        weights are too uneven to reach the tolerance.

    Raises
    ------
    mirrorskin.io.InputError
        Maps of different sizes, or weights that are negative or not finite.

    Examples
    --------
    Random walks of pixels to the left or right border of a picture: where do they end?

    >>> import numpy as np
    >>> from mirrorskin import engine
    >>> held = np.zeros((40, 60))
    >>> held[:, [0, -1]] = 1.0
    >>> inverse = engine.integration.invert_laplacian(np.ones((40, 59)), np.ones((39, 60)), held)
    >>> arrivals = np.zeros((40, 60))
    >>> arrivals[:, -1] = 1.0
    >>> share = (inverse @ arrivals.ravel()).reshape(40, 60)
    >>> round(float(share[20, 45]), 3)
    0.754
    """
    from scipy.sparse.linalg import LinearOperator

    maps = [np.asarray(weights, np.float64) for weights in (right, down)]
    shape = (len(maps[0]), maps[1].shape[-1]) if all(weights.ndim == 2 for weights in maps) else (0, 0)
    if 0 in shape or maps[0].shape[1] != shape[1] - 1 or maps[1].shape[0] != shape[0] - 1:
        raise InputError(
            f"links have shapes {maps[0].shape} and {maps[1].shape}: (H, W - 1) to the right and (H - 1, W)"
            " down are needed"
        )
    maps.append(np.zeros(shape) if diagonal is None else np.asarray(diagonal, np.float64))
    if maps[2].shape != shape:
        raise InputError(f"diagonal: shape {maps[2].shape}, but links are of {shape}; give maps of one size")
    if not all(np.all((weights >= 0) & (weights < np.inf)) for weights in maps):
        raise InputError("links or diagonal: some are negative or not finite; give 0 where there is none")
    options = IntegrationOptions(tolerance=tolerance, device=device)
    solve = _Solver(options.device, maps, options.tolerance)
    size = shape[0] * shape[1]
    products = dict.fromkeys(("matvec", "rmatvec", "matmat", "rmatmat"), solve)
    return LinearOperator((size, size), **products, dtype=np.float64)


class _Solver:
    """Multiplies by the inverse."""

    def __init__(self, device: Device, maps: list[Doubles], tolerance: float | None) -> None:
        self._tolerance = tolerance
        (right, down, diagonal), weights = maps, np.concatenate([plane.ravel() for plane in maps])
        weights = weights[weights > 0]
        self._unit = float(np.median(weights)) if weights.size else 1.0
        whole = np.pad(right, ((0, 0), (0, 1))), np.pad(down, ((0, 1), (0, 0))), diagonal
        weigh = [np.asarray(plane / self._unit, np.float32) for plane in whole]
        bits = zip(weigh, (RIGHT, DOWN, KNOWN), strict=True)
        flags = np.bitwise_or.reduce(
            [np.where(plane > 0, bit, SLOPE).astype(np.uint8) for plane, bit in bits]
        )
        components = find_components(flags | np.uint8(SLOPE), by_links=True)
        self._labels = components.labels.ravel()
        self._free, self._pixels = components.offset_unknown, np.bincount(self._labels)
        arrays = [device.from_host("links", plane) for plane in weigh]
        anchor = arrays[2] if weigh[2].any() else None
        source = device.from_host("source", np.zeros(diagonal.shape))
        self._links = Links(device, diagonal.shape, arrays[0], arrays[1], anchor, source)
        self._multigrid = Multigrid(self._links)

    def __call__(self, sources: NDArray[Any]) -> Doubles:
        """Return the solutions u of A u = b, for b (N,) or (N, K)."""
        exact = self._centred(np.asarray(sources, np.float64).reshape(len(sources), -1).T)
        sizes = np.abs(exact).max(axis=1, initial=0)
        if not (sizes < np.inf).all():
            raise InputError("the right side of the Laplacian has values that are not finite: leave them out")
        if not sizes.any():
            return exact.T.reshape(np.shape(sources))
        scales = np.where(sizes > 0, sizes, 1)[:, np.newaxis]
        scaled = (exact / scales).reshape(-1, *self._links.shape)
        maps = self._links.device.from_host("sources", scaled)
        height = self._multigrid.precondition(maps) if self._tolerance is None else self._solve(maps)
        solution = self._centred(height.read().reshape(exact.shape) * (scales / self._unit))
        return solution.T.reshape(np.shape(sources))

    def _solve(self, maps: Array) -> Array:
        solutions = self._multigrid.solve_many(maps, tolerance=self._tolerance)
        if not solutions.converged:
            raise NotConverged(
                f"the Laplacian's solution did not converge: {solutions.iterations} iterations left a"
                f" residual of {solutions.residual:.2g}, more than {self._tolerance:.2g};"
                " give a larger tolerance"
            )
        return solutions.height

    def _centred(self, values: Doubles) -> Doubles:
        """Return values, (K, N), minus the mean of each component whose offset is free."""
        means = [np.bincount(self._labels, map_) / self._pixels for map_ in values]
        return values - np.where(self._free, means, 0.0)[:, self._labels]
