"""The solver of `integrate` for anyone's graph Laplacian on a picture."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.errors import NotConverged
from mirrorskin.engine.integration.graph import Links, find_components
from mirrorskin.engine.integration.multigrid import Multigrid
from mirrorskin.engine.integration.validation import check_above_zero
from mirrorskin.io import InputError
from mirrorskin.io.arguments import checked
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.device import Device, open_device
from mirrorskin.kernels.links import DOWN, KNOWN, RIGHT, SLOPE

if TYPE_CHECKING:
    from scipy.sparse.linalg import LinearOperator

Doubles = NDArray[np.float64]


@checked
def invert_laplacian(
    right: ArrayLike,
    down: ArrayLike,
    diagonal: ArrayLike | None = None,
    *,
    tolerance: float | None = 1e-5,
    device: str | Device | None = None,
) -> LinearOperator:
    """Return the inverse of a graph Laplacian of a picture's pixels, as an operator of SciPy.

    The matrix A has for a map u, with neighbours j of pixel i, ::

        (A u)_i = sum of w_ij (u_i - u_j)  +  a_i u_i

    The operator solves A u = b by conjugate gradients with multigrid in float32. As the preconditioner of a
    solver in float64 it makes each of its steps gain the digits of the tolerance.

    Parameters
    ----------
    right : array_like, (H, W - 1)
        Weights w of the links from pixels to those on the right, of any unit; 0 where there is none.
    down : array_like, (H - 1, W)
        Weights w of the links to the pixels below.
    diagonal : array_like, (H, W), optional
        What is added on the diagonal, a; 0 by default. Where no pixel of a connected component has any, A is
        singular: of b the part with the mean 0 there is taken, and the mean of u is 0.
    tolerance : float or None
        Energy norm of the error over that of u, of a solution. None does one multigrid cycle, which is a
        preconditioner: the same for every b, and positive definite.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.

    Returns
    -------
    scipy.sparse.linalg.LinearOperator
        H W by H W, symmetric, for maps that are flattened in C order; for one thread at a time. Of a matrix
        its columns are solved for together, several times as fast as one by one. It raises `NotConverged`
        where weights are too uneven to meet the tolerance.

    Raises
    ------
    mirrorskin.io.InputError
        Maps that do not fit each other, or weights that are negative or no numbers.

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

    maps = [np.asarray(one, np.float64) for one in (right, down)]
    shape = (len(maps[0]), maps[1].shape[-1]) if all(one.ndim == 2 for one in maps) else (0, 0)
    if 0 in shape or maps[0].shape[1] != shape[1] - 1 or maps[1].shape[0] != shape[0] - 1:
        raise InputError(
            f"links have shapes {maps[0].shape} and {maps[1].shape}: (H, W - 1) to the right and (H - 1, W)"
            " down are needed"
        )
    maps.append(np.zeros(shape) if diagonal is None else np.asarray(diagonal, np.float64))
    if maps[2].shape != shape:
        raise InputError(f"diagonal: shape {maps[2].shape}, but links are of {shape}; give maps of one size")
    if not all(np.all((one >= 0) & (one < np.inf)) for one in maps):
        raise InputError("links or diagonal: some are negative or no number; give 0 where there is none")
    check_above_zero(tolerance=tolerance)
    solve = _Solver(open_device(device), maps, tolerance)
    size = shape[0] * shape[1]
    known = {"matvec": solve, "rmatvec": solve, "matmat": solve, "rmatmat": solve}
    return LinearOperator((size, size), **known, dtype=np.float64)


class _Solver:
    """What multiplies by the inverse."""

    def __init__(self, device: Device, maps: list[Doubles], tolerance: float | None) -> None:
        self._tolerance = tolerance
        (right, down, diagonal), weights = maps, np.concatenate([one.ravel() for one in maps])
        weights = weights[weights > 0]
        self._unit = float(np.median(weights)) if weights.size else 1.0
        whole = np.pad(right, ((0, 0), (0, 1))), np.pad(down, ((0, 1), (0, 0))), diagonal
        weigh = [np.asarray(one / self._unit, np.float32) for one in whole]
        bits = zip(weigh, (RIGHT, DOWN, KNOWN), strict=True)
        flags = np.bitwise_or.reduce([np.where(one > 0, bit, SLOPE).astype(np.uint8) for one, bit in bits])
        components = find_components(flags | np.uint8(SLOPE), cut=True)
        self._labels = components.labels.ravel()
        self._free, self._pixels = components.offset_unknown, np.bincount(self._labels)
        arrays = [device.given("links", one) for one in weigh]
        anchor = arrays[2] if weigh[2].any() else None
        source = device.given("source", np.zeros(diagonal.shape))
        self._links = Links(device, diagonal.shape, arrays[0], arrays[1], anchor, source)
        self._multigrid = Multigrid(self._links)

    def __call__(self, sources: NDArray[Any]) -> Doubles:
        """Return the solutions u of A u = b, for b (N,) or (N, K)."""
        exact = self._centred(np.asarray(sources, np.float64).reshape(len(sources), -1).T)
        sizes = np.abs(exact).max(axis=1, initial=0)
        if not (sizes < np.inf).all():
            raise InputError("the right side of the Laplacian has values that are no numbers: leave them out")
        if not sizes.any():
            return exact.T.reshape(np.shape(sources))
        scales = np.where(sizes > 0, sizes, 1)[:, np.newaxis]
        given = (exact / scales).reshape(-1, *self._links.shape)
        maps = self._links.device.given("sources", given)
        height = self._multigrid.precondition(maps) if self._tolerance is None else self._solve(maps)
        found = self._centred(height.download().reshape(exact.shape) * (scales / self._unit))
        return found.T.reshape(np.shape(sources))

    def _solve(self, maps: Array) -> Array:
        found = self._multigrid.solve_many(maps, tolerance=self._tolerance)
        if not found.converged:
            raise NotConverged(
                f"the Laplacian's solution did not converge: {found.iterations} iterations left a residual of"
                f" {found.residual:.2g}, more than {self._tolerance:.2g}; give a larger tolerance"
            )
        return found.height

    def _centred(self, values: Doubles) -> Doubles:
        """Return values, (K, N), less the mean of each component whose offset is free."""
        means = [np.bincount(self._labels, one) / self._pixels for one in values]
        return values - np.where(self._free, means, 0.0)[:, self._labels]
