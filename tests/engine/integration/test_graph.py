"""Components are the sets of linked pixels, numbered in reading order."""

from __future__ import annotations

import numpy as np
import pytest

from mirrorskin.engine.integration.graph import find_components
from mirrorskin.kernels.integration.links import DOWN, KNOWN, LOST, RIGHT, SLOPE


def walk(flags):
    """Number the components by walking from pixel to pixel."""
    labels, count = np.full(flags.shape, -1), 0
    for first in np.ndindex(flags.shape):
        if labels[first] >= 0 or not flags[first] & (SLOPE | KNOWN):
            continue
        labels[first], found = count, [first]
        while found:
            y, x = found.pop()
            near = []
            near += [(y, x + 1)] * bool(flags[y, x] & RIGHT) + [(y + 1, x)] * bool(flags[y, x] & DOWN)
            near += [(y, x - 1)] * bool(x and flags[y, x - 1] & RIGHT)
            near += [(y - 1, x)] * bool(y and flags[y - 1, x] & DOWN)
            for place in near:
                if labels[place] < 0:
                    labels[place] = count
                    found.append(place)
        count += 1
    return labels, count


def picture(shape, seed, cut):
    """Flags of random pixels; all neighbours are linked, or most."""
    random = np.random.default_rng(seed)
    answered = random.random(shape) < 0.7
    flags = np.where(answered, SLOPE, LOST * (random.random(shape) < 0.5))
    flags |= KNOWN * (answered & (random.random(shape) < 0.02))
    linked = [random.random(shape) < 0.8 if cut else np.ones(shape, bool) for _ in range(2)]
    flags[:, :-1] |= RIGHT * (answered[:, :-1] & answered[:, 1:] & linked[0][:, :-1])
    flags[:-1] |= DOWN * (answered[:-1] & answered[1:] & linked[1][:-1])
    return flags.astype(np.uint8)


@pytest.mark.parametrize("shape", [(1, 1), (17, 1), (40, 61)])
@pytest.mark.parametrize("cut", [False, True], ids=["whole", "cut"])
def test_components_are_what_links_hold_together(shape, cut):
    for seed in range(3):
        flags = picture(shape, seed, cut)
        labels, count = walk(flags)
        found = find_components(flags, cut)
        np.testing.assert_array_equal(found.labels, labels)
        assert found.labels.dtype == np.int32
        known = {labels[place] for place in np.argwhere(flags & KNOWN).tolist() for place in [tuple(place)]}
        assert [n in known for n in range(count)] == (~found.offset_unknown).tolist()
        assert min(shape) == 1 or 10 < count < 400
