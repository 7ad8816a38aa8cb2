"""Each pass against its reference, on levels of odd sizes with nodes that are odd as well."""

import numpy as np
import pytest
from launches import launch

from mirrorskin.engine.integration.hierarchy import part_of
from mirrorskin.kernels import multigrid

FINE = (0, 13, 32)  # base, rows, stride; 21 columns
COARSE = (15 * 32, 7, 16)
ODD = COARSE[0] + 9 * 16  # the first node without a place in the picture
NODES = ODD + 16
ROWS = 9
PARTS = -(-FINE[1] * FINE[2] // 64)
STEPS = 1.3896, 0.5617
PAIR = (FINE[0], FINE[2], *COARSE)


class Arrays:
    """All that passes work on, at random."""

    def __init__(self, anchored, seed=0):
        rng = np.random.default_rng(seed)
        self.right, self.down, self.anchor = (np.zeros(NODES) for _ in range(3))
        for (base, rows, stride), columns in ((FINE, 21), (COARSE, 11)):
            node = base + stride * (np.arange(rows)[:, np.newaxis] + 1) + np.arange(columns)
            for name, inside in (("right", node[:, :-1]), ("down", node[:-1])):
                weights = rng.uniform(0.1, 3.0, inside.shape) * (rng.random(inside.shape) < 0.8)
                getattr(self, name)[inside] = weights * rng.choice([1, 1e-3], inside.shape, p=[0.9, 0.1])
            if anchored:
                self.anchor[node] = rng.uniform(0, 1, node.shape) * (rng.random(node.shape) < 0.3)
        for name in ("b", "x", "e", "z", "before", "residual", "inverse"):
            setattr(self, name, rng.normal(size=NODES))
        self.inverse = np.abs(self.inverse)
        self.smoother, self.direction, self.image, self.split = (np.zeros(NODES) for _ in range(4))
        self.weight_at = np.abs(rng.normal(size=NODES))
        self.parts = np.zeros(PARTS)
        self.curves = np.zeros(4 * PARTS)
        ends = np.array([[0.5], [0.1], [0.3], [-0.5]])
        self.plane = (ends + 0.1 * rng.random((4, PARTS))).ravel()
        self.same = np.repeat([0.5, 0.5, 0.5, 0.3], PARTS)
        inside = FINE[2] + rng.choice(FINE[1] * FINE[2], ROWS - 3, replace=False)
        self.node = np.sort(np.concatenate([inside, ODD + np.arange(3)]))
        counts = rng.integers(1, 9, ROWS)
        self.start = np.concatenate([[0], np.cumsum(counts)])
        self.column = rng.integers(FINE[2], ODD + 3, self.start[-1])
        self.weight = rng.uniform(0, 2, self.start[-1])
        self.bottom = COARSE[0] + COARSE[2] + np.arange(30)
        self.matrix = rng.normal(size=900)
        self.map_ = rng.normal(size=13 * 21)
        self.level = np.zeros(NODES)
        self.returns, self.evened = np.abs(rng.normal(size=NODES)), np.zeros(NODES)
        self.c = rng.normal(size=6)
        self.flags = rng.choice([1, 4, 6, 8], 13 * 21)

    def all(self):
        return vars(self)


TABLE = "node", "start", "column", "weight"
GRAPH = "right", "down", "anchor"
PASSES = {
    "invert": (FINE, *GRAPH, "inverse"),
    "begin": (FINE, *STEPS, *GRAPH, "inverse", "b", "x"),
    "smooth": (FINE, 0.5617, *GRAPH, "b", "x", "smoother"),
    "residual": (FINE, *GRAPH, "b", "x", "residual"),
    "scaled_residual": (FINE, *GRAPH, "b", "x", "residual"),
    "keep": (FINE, "residual", "x", "b", "smoother"),
    "scale": (FINE, "inverse", "b", "residual"),
    "clear": (FINE, "x"),
    "add": (FINE, "e", "x"),
    "restrict": (PAIR, "right", "down", "residual", "b"),
    "gather": (PAIR, "e", "b"),
    "prolong": (PAIR, 1.0, "right", "down", "inverse", "e", "x", "smoother"),
    "coarsen": (PAIR, 0.25, *GRAPH, *GRAPH, "split"),
    "invert_extra": ((1, 7), *TABLE, "anchor", "inverse"),
    "begin_extra": ((1, 7), *TABLE, *STEPS, "anchor", "inverse", "b", "x"),
    "smooth_extra": ((0, ROWS), *TABLE, 0.5617, "anchor", "inverse", "b", "x", "smoother"),
    "residual_extra": ((2, 7), *TABLE, 1, "anchor", "inverse", "b", "x", "residual"),
    "restrict_extra": ((0, ROWS), *TABLE, "residual", "b"),
    "prolong_extra": ((3, 6), *TABLE, 0.0, "inverse", "e", "x", "smoother"),
    "solve": ((30,), "bottom", "matrix", "b", "x"),
    "direct": (FINE, 0.7, *GRAPH, "z", "before", "direction", "image", "parts"),
    "advance": (FINE, 0.3, "e", "before", "b", "x", "parts"),
    "curve": (FINE, *GRAPH, "b", "z", "before", PARTS, "curves"),
    "follow": (FINE, 5, "weight_at", PARTS, "plane", "z", "before", "x"),
    "follow along one": (FINE, 5, "weight_at", PARTS, "same", "z", "before", "x"),
    "dot": (FINE, "e", "x", "parts"),
    "weigh": (FINE, "weight_at", "x", "parts"),
    "even": (FINE, *GRAPH, "evened"),
    "returns": (FINE, "right", "down", "inverse", "smoother"),
    "returns_extra": ((1, 7), *TABLE, "inverse", "smoother"),
    "local": (FINE, "right", "down", "inverse", "returns", "c", "evened"),
    "local_extra": ((1, 7), *TABLE, "inverse", "returns", "c", "evened"),
    "deviation": ((13, 21, 32), 0.12, 12, "flags", "inverse", "returns", "map_"),
    "admit": ((13, 21, 32), "map_", "level"),
    "release": ((13, 21, 32), "x", "map_"),
}
TYPES = dict.fromkeys(("node", "start", "column", "bottom"), np.int32) | {"flags": np.uint8}
SUMS = "direct", "advance", "curve", "dot", "weigh"  # in parts of 64 nodes here, so that there are several


def items_of(name, device):
    if name in ("restrict", "gather", "prolong", "coarsen"):
        return COARSE[1]
    if name in ("admit", "release", "deviation"):
        return FINE[1]
    if name == "solve":
        return 30
    if name.endswith("extra"):
        return ROWS
    nodes = FINE[1] * FINE[2]
    return -(-nodes // (64 if name in SUMS else device.layout.tile))


@pytest.mark.parametrize("anchored", [True, False], ids=["anchored", "free"])
@pytest.mark.parametrize("name", PASSES)
def test_a_pass_does_what_its_reference_says(device, name, anchored):
    sizes, *arguments = PASSES[name]
    name = name.split()[0]
    arrays = Arrays(anchored).all()
    arrays = {key: value.astype(TYPES.get(key, np.float32)) for key, value in arrays.items()}
    on_device = {}
    for key, value in arrays.items():
        on_device[key] = device.array(key, value.shape, value.dtype)
        on_device[key].host[...] = value
        on_device[key].upload()
    before = {key: value.copy() for key, value in arrays.items()}
    getattr(multigrid, f"multigrid_{name}")(
        *sizes, *(arrays[a] if isinstance(a, str) else a for a in arguments)
    )
    width = 8 if device.layout.tile > 1 else 1
    part = 64 if name in SUMS else part_of(device)  # as the engine has it, so that it is compiled once
    kernel = device.kernel("multigrid", f"multigrid_{name}", ANCHORED=int(anchored), PART=part, WIDTH=width)
    given = [on_device[a] if isinstance(a, str) else a for a in arguments]
    launch(kernel, items_of(name, device), *sizes, *given)
    changed = [key for key in arrays if not np.array_equal(arrays[key], before[key])]
    assert changed
    for key in arrays:
        found = on_device[key].download()
        if key in ("parts", "curves"):
            found, expected = (one.reshape(-1, PARTS).sum(1, np.float64) for one in (found, arrays[key]))
            np.testing.assert_allclose(found, expected, rtol=1e-5)
        else:
            np.testing.assert_allclose(found, arrays[key], rtol=2e-5, atol=2e-5)
